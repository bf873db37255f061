//! Says in one sentence what to do when the MuJoCo library is missing, before the linker says it in a hundred.

use std::{env, path::PathBuf, process::exit};

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    let wanted = env::var_os("CARGO_FEATURE_MUJOCO").is_some();
    let other_way = ["MUJOCO_STATIC_LINK_DIR", "MUJOCO_DOWNLOAD_DIR"].iter().any(|v| env::var_os(v).is_some());
    if !wanted || other_way || env::var("CARGO_CFG_TARGET_OS").as_deref() != Ok("linux") {
        return;
    }
    let Some(folder) = env::var_os("MUJOCO_DYNAMIC_LINK_DIR").map(PathBuf::from) else {
        return; // mujoco-rs then asks pkg-config and says so itself
    };
    let library = folder.join("libmujoco.so");
    println!("cargo::rerun-if-changed={}", library.display());
    if !library.exists() {
        println!(
            "cargo::error=the MuJoCo library is missing ({} not found): run `make setup`, or build with \
             `--no-default-features` to leave the MuJoCo environments out",
            library.display()
        );
        exit(1);
    }
}
