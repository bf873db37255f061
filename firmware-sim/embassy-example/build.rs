//! Writes the memory map for the linker script of `cortex-m-rt`: the program in bank 1 of the flash, the policy outside of it.

use std::path::PathBuf;
use std::{env, fs};

/// Bank 1 and the AXI SRAM of the STM32H743ZI. Bank 2, from 0x08100000, belongs to the policy.
const MEMORY: &str = "MEMORY {
  FLASH : ORIGIN = 0x08000000, LENGTH = 1M
  RAM : ORIGIN = 0x24000000, LENGTH = 512K
}
";

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    fs::write(out.join("memory.x"), MEMORY).expect("OUT_DIR is writable");
    println!("cargo:rustc-link-search={}", out.display());
    println!("cargo:rustc-link-arg-bins=-Tlink.x");
}
