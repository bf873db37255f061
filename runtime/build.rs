//! Chooses the kernels by the architecture of the target, which `cfg` does not tell on stable Rust.
#![allow(missing_docs, reason = "a build script is no API")]

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rustc-check-cfg=cfg(armv7em)");
    // Armv7E-M has the DSP instructions; thumbv7m and thumbv8m.main may lack them.
    if std::env::var("TARGET").is_ok_and(|target| target.starts_with("thumbv7em-")) {
        println!("cargo::rustc-cfg=armv7em");
    }
}
