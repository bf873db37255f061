//! Finds the MuJoCo library that `make setup` brings, or says in one sentence that it is missing.

use std::{
    env,
    path::{Path, PathBuf},
};

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    if env::var_os("CARGO_FEATURE_MUJOCO").is_none() {
        return;
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let canonical = |path: PathBuf| path.canonicalize().ok();
    let given = env::var_os("MUJOCO_DYNAMIC_LINK_DIR").map(PathBuf::from).and_then(canonical);
    // Any other folder, or none, is the business of mujoco-rs: it checks the folder or asks pkg-config.
    if given.is_none() || given != canonical(root.join(".cargo/mujoco")) {
        return;
    }
    let folder = root.canonicalize().unwrap_or(root).join("target/mujoco");
    let library = folder.join("libmujoco.so");
    println!("cargo::rerun-if-changed={}", library.display());
    if !library.exists() {
        println!(
            "cargo::error=the MuJoCo library is missing: run `make setup` (not found: {}), or build with \
             `--no-default-features` to leave the MuJoCo environments out",
            library.display()
        );
        return;
    }
    println!("cargo::rustc-link-search=native={}", folder.display());
}
