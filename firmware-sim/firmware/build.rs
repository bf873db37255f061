//! Writes the memory map of the chosen board for the linker script of `cortex-m-rt`.

use std::path::PathBuf;
use std::{env, fs};

/// Name of the board, and where its program and its variables lie. The policy slots are outside of both.
const BOARDS: [(&str, &str); 3] = [
    ("mps2-an386", "FLASH : ORIGIN = 0x00000000, LENGTH = 2M\n  RAM : ORIGIN = 0x20000000, LENGTH = 4M"),
    ("mps2-an500", "FLASH : ORIGIN = 0x00000000, LENGTH = 2M\n  RAM : ORIGIN = 0x20000000, LENGTH = 4M"),
    ("netduinoplus2", "FLASH : ORIGIN = 0x08000000, LENGTH = 384K\n  RAM : ORIGIN = 0x20000000, LENGTH = 112K"),
];

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    let feature =
        |name: &str| env::var_os(format!("CARGO_FEATURE_{}", name.to_uppercase().replace('-', "_"))).is_some();
    let chosen: Vec<_> = BOARDS.iter().filter(|(name, _)| feature(name)).collect();
    let [(_, memory)] = chosen[..] else {
        let names = BOARDS.map(|(name, _)| name).join(", ");
        panic!("gadm-firmware is built for one board: give exactly one of the features {names}");
    };
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    fs::write(out.join("memory.x"), format!("MEMORY {{\n  {memory}\n}}\n")).expect("OUT_DIR is writable");
    println!("cargo:rustc-link-search={}", out.display());
    println!("cargo:rustc-link-arg-bins=-Tlink.x");
}
