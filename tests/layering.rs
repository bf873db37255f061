//! Who may depend on whom: the table in `docs/ARCHITECTURE.md`, section 4, against the manifests.

use std::collections::{BTreeMap, BTreeSet};

use gadm_integration_tests::metadata::{Member, members};
use gadm_integration_tests::{markdown, read, repository_files};

/// A row of the table.
struct Row {
    /// Our packages and the features that may be asked of them.
    ours: BTreeMap<String, BTreeSet<String>>,
    /// Packages of others.
    others: BTreeSet<String>,
    /// Kind: the words `no_std` and `dev` matter.
    kind: String,
}

fn table() -> BTreeMap<String, Row> {
    let page = read("docs/ARCHITECTURE.md");
    let section = markdown::section(&page, "4. Who may depend on whom");
    let rows = markdown::table(section);
    assert_eq!(rows[0], ["crate", "ours", "others", "kind"], "the table of section 4 has other columns");
    let row = |cells: &Vec<String>| {
        let ours = markdown::code_words(&cells[1]).into_iter().map(|word| match word.split_once('[') {
            Some((name, features)) => {
                let features = features.trim_end_matches(']').split(',').map(|f| f.trim().to_owned()).collect();
                (name.to_owned(), features)
            }
            None => (word, BTreeSet::new()),
        });
        let others = markdown::code_words(&cells[2]).into_iter().collect();
        (markdown::code_words(&cells[0]).remove(0), Row { ours: ours.collect(), others, kind: cells[3].clone() })
    };
    rows[1..].iter().map(row).collect()
}

fn in_workspace() -> BTreeMap<&'static str, (Row, &'static Member)> {
    let mut table = table();
    let mut all = BTreeMap::new();
    for (name, member) in members() {
        let row = table.remove(name).unwrap_or_else(|| panic!("{name} has no row in ARCHITECTURE.md, section 4"));
        all.insert(name.as_str(), (row, member));
    }
    let left: Vec<_> =
        table.iter().filter(|(_, row)| !row.kind.contains("own workspace")).map(|(name, _)| name).collect();
    assert!(left.is_empty(), "rows of ARCHITECTURE.md, section 4, without a package: {left:?}");
    all
}

#[test]
fn every_dependency_is_in_the_table() {
    let mut faults = Vec::new();
    for (name, (row, member)) in in_workspace() {
        for dep in &member.dependencies {
            let allowed = if dep.ours {
                // For tests any feature will do, but not another edge.
                row.ours.get(&dep.name).is_some_and(|features| dep.dev || dep.features.is_subset(features))
            } else {
                dep.dev || row.others.contains(&dep.name)
            };
            if !allowed {
                faults.push(format!("{name} -> {} {:?}", dep.name, dep.features));
            }
        }
    }
    assert!(faults.is_empty(), "not in the table of ARCHITECTURE.md, section 4: {faults:#?}");
}

#[test]
fn every_entry_of_the_table_is_used() {
    for (name, (row, member)) in in_workspace() {
        let used: BTreeSet<_> = member.dependencies.iter().map(|dep| &dep.name).collect();
        let unused: Vec<_> = row.ours.keys().chain(&row.others).filter(|entry| !used.contains(entry)).collect();
        assert!(unused.is_empty(), "{name} does not depend on {unused:?}, but ARCHITECTURE.md, section 4, says so");
    }
}

#[test]
fn device_crates_ask_for_no_std() {
    let all = in_workspace();
    let device: Vec<_> = all.iter().filter(|(_, (row, _))| row.kind.contains("no_std")).collect();
    assert_eq!(device.len(), 2, "gadm-runtime and gadm-node are for devices");
    for (name, (_, member)) in device {
        assert!(member.default.is_empty(), "{name} has default features: {:?}", member.default);
        for dep in member.dependencies.iter().filter(|dep| !dep.dev && !dep.ours) {
            assert!(!dep.default_features, "{name} takes {} with its default features", dep.name);
            for feature in ["std", "alloc"] {
                assert!(!dep.features.contains(feature), "{name} takes {} with {feature}", dep.name);
            }
        }
    }
}

/// What must not come in by a side door, directly or not.
#[test]
fn what_a_crate_must_not_reach() {
    let all = members();
    let host_only = ["candle-core", "mujoco-rs", "wrapped2d", "rand", "serde_json", "anyhow"];
    let rules: [(&str, &[&str]); 4] = [
        ("gadm-runtime", &host_only),
        ("gadm-node", &host_only),
        ("gadm-envs", &["candle-core", "gadm-trainer", "gadm-node", "gadm-sim"]),
        ("gadm-sim", &["candle-core", "gadm-trainer"]),
    ];
    for (name, forbidden) in rules {
        for package in forbidden {
            assert!(!all[name].closure.contains(*package), "{name} reaches {package}");
        }
    }
    // The check itself works: the trainer does reach what it is made of.
    assert!(all["gadm-trainer"].closure.contains("candle-core") && all["gadm-trainer"].closure.contains("rand"));
}

#[test]
fn nothing_depends_on_the_tests() {
    for (name, member) in members() {
        assert!(!member.closure.contains("gadm-integration-tests"), "{name} depends on the tests");
    }
}

#[test]
fn versions_are_written_in_the_root_manifest_only() {
    for member in members().values() {
        let manifest = std::fs::read_to_string(&member.manifest).unwrap();
        let mut in_dependencies = false;
        for line in manifest.lines().map(str::trim) {
            if line.starts_with('[') {
                in_dependencies = line.contains("dependencies");
            } else if in_dependencies && !line.is_empty() && !line.starts_with('#') {
                let inherits = line.contains("workspace = true");
                assert!(inherits, "{}: `{line}` is not taken from the workspace", member.manifest);
            }
        }
    }
}

#[test]
fn packages_outside_the_workspace_say_so() {
    let inside: BTreeSet<_> = members().values().map(|member| &member.manifest).collect();
    let root = gadm_integration_tests::root();
    for path in repository_files().iter().filter(|path| path.ends_with("Cargo.toml")) {
        let file = root.join(path);
        let is_root = path.parent().is_some_and(|folder| folder.as_os_str().is_empty());
        if is_root || inside.iter().any(|manifest| std::path::Path::new(manifest) == file) {
            continue;
        }
        let own = read(path).lines().any(|line| line.trim() == "[workspace]");
        assert!(own, "{} is no member and has no [workspace] of its own", path.display());
    }
}
