//! The workspace as cargo sees it.

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;
use std::sync::LazyLock;

use serde_json::Value;

/// One dependency as a manifest has it.
#[derive(Debug, Clone)]
pub struct Dependency {
    /// Package name.
    pub name: String,
    /// For tests, examples and benches only.
    pub dev: bool,
    /// A package of this repository.
    pub ours: bool,
    /// Features asked for.
    pub features: BTreeSet<String>,
    /// Whether its default features are on.
    pub default_features: bool,
}

/// A member of the workspace.
#[derive(Debug, Clone)]
pub struct Member {
    /// Dependencies of its manifest.
    pub dependencies: Vec<Dependency>,
    /// Its default features.
    pub default: Vec<String>,
    /// Path of its manifest.
    pub manifest: String,
    /// Names of all packages that it needs when it is built with default features, dev-dependencies excluded.
    pub closure: BTreeSet<String>,
}

/// All members by name, from `cargo metadata` for this machine; needs no network, because the tests have been built.
pub fn members() -> &'static BTreeMap<String, Member> {
    static MEMBERS: LazyLock<BTreeMap<String, Member>> = LazyLock::new(ask_cargo);
    &MEMBERS
}

fn ask_cargo() -> BTreeMap<String, Member> {
    let metadata = metadata();
    let packages = array(&metadata["packages"]);
    let name_of: BTreeMap<&str, &str> = packages.iter().map(|p| (text(&p["id"]), text(&p["name"]))).collect();
    let nodes: BTreeMap<&str, &Value> =
        array(&metadata["resolve"]["nodes"]).iter().map(|node| (text(&node["id"]), node)).collect();
    let ours: BTreeSet<&str> = array(&metadata["workspace_members"]).iter().map(text).collect();
    packages
        .iter()
        .filter(|package| ours.contains(text(&package["id"])))
        .map(|package| {
            let mut seen = BTreeSet::new();
            reach(text(&package["id"]), &nodes, &mut seen);
            let member = Member {
                dependencies: array(&package["dependencies"]).iter().map(dependency).collect(),
                default: package["features"]["default"].as_array().map_or_else(Vec::new, |list| strings(list)),
                manifest: text(&package["manifest_path"]).to_owned(),
                closure: seen
                    .into_iter()
                    .filter(|id| *id != text(&package["id"]))
                    .map(|id| name_of[id].into())
                    .collect(),
            };
            (text(&package["name"]).to_owned(), member)
        })
        .collect()
}

fn metadata() -> Value {
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let version = Command::new(rustc).arg("-vV").current_dir(crate::root()).output().expect("rustc runs");
    let version = String::from_utf8_lossy(&version.stdout).into_owned();
    let host = version.lines().find_map(|line| line.strip_prefix("host: ")).expect("rustc -vV names its host");
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let out = Command::new(cargo)
        .args(["metadata", "--format-version", "1", "--locked", "--offline", "--filter-platform", host])
        .current_dir(crate::root())
        .output()
        .expect("cargo runs");
    assert!(out.status.success(), "cargo metadata: {}", String::from_utf8_lossy(&out.stderr));
    serde_json::from_slice(&out.stdout).expect("cargo metadata prints JSON")
}

/// Adds what `id` needs, directly or not, without dev-dependencies.
fn reach<'a>(id: &'a str, nodes: &BTreeMap<&'a str, &'a Value>, seen: &mut BTreeSet<&'a str>) {
    if !seen.insert(id) {
        return;
    }
    for dep in array(&nodes[id]["deps"]) {
        if array(&dep["dep_kinds"]).iter().any(|kind| kind["kind"].as_str() != Some("dev")) {
            reach(text(&dep["pkg"]), nodes, seen);
        }
    }
}

fn dependency(value: &Value) -> Dependency {
    Dependency {
        name: text(&value["name"]).to_owned(),
        dev: value["kind"].as_str() == Some("dev"),
        ours: value["path"].is_string(),
        features: strings(array(&value["features"])).into_iter().collect(),
        default_features: value["uses_default_features"].as_bool().expect("a flag"),
    }
}

fn text(value: &Value) -> &str {
    value.as_str().expect("cargo metadata has a string here")
}

fn array(value: &Value) -> &[Value] {
    value.as_array().expect("cargo metadata has a list here")
}

fn strings(list: &[Value]) -> Vec<String> {
    list.iter().map(|value| text(value).to_owned()).collect()
}
