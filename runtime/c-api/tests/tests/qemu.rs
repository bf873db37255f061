//! The C example on an emulated Cortex-M4F: every bit as the Rust runtime on the host.
#![allow(clippy::unwrap_used, reason = "tests may panic")]

use std::path::{Path, PathBuf};
use std::process::Command;

use gadm_c_api_tests::{expected, library, observations, policies, root, run, same_lines};
use gadm_runtime::Policy;
use gadm_runtime::encode::AlignedImage;

const TARGET: &str = "thumbv7em-none-eabihf";

/// The example's firmware; `cc` is part of the name, so that it is not built twice at once.
fn firmware() -> PathBuf {
    let elf = Path::new(env!("CARGO_TARGET_TMPDIR")).join("example.elf");
    let board = root().join("examples/mps2-an386");
    run(Command::new("arm-none-eabi-gcc")
        .args([
            "-std=c11",
            "-Wall",
            "-Wextra",
            "-Wconversion",
            "-Werror",
            "-O2",
            "-ffreestanding",
            "-ffunction-sections",
        ])
        .args(["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-nostdlib", "-Wl,--gc-sections"])
        .arg("-I")
        .arg(root().join("include"))
        .arg("-T")
        .arg(board.join("board.ld"))
        .arg(board.join("board.c"))
        .arg(root().join("examples/control.c"))
        .arg(library(Some(TARGET)))
        .args(["-lgcc", "-o"])
        .arg(&elf));
    elf
}

/// What the firmware prints, and whether it ended by itself and without a failure.
fn emulated(elf: &Path, policy: &Path, obs: &Path) -> (String, bool) {
    let loader = |file: &Path, address: &str| format!("loader,file={},addr={address},force-raw=on", file.display());
    let out = Command::new("timeout")
        .args([
            "120",
            "qemu-system-arm",
            "-M",
            "mps2-an386",
            "-display",
            "none",
            "-monitor",
            "none",
            "-serial",
            "stdio",
        ])
        .args(["-semihosting-config", "enable=on,target=native", "-kernel"])
        .arg(elf)
        .args(["-device", &loader(policy, "0x00200000"), "-device", &loader(obs, "0x21000000")])
        .stdin(std::process::Stdio::null())
        .output()
        .unwrap();
    (String::from_utf8_lossy(&out.stdout).replace("\r\n", "\n"), out.status.success())
}

fn temporary(name: &str, bytes: &[u8]) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

#[test]
fn the_example_computes_the_bits_of_the_host() {
    let elf = firmware();
    for (name, file) in policies() {
        let image = AlignedImage::new(&file);
        // The large policy takes most of the emulator's time.
        let observations = observations(&Policy::load(&image).unwrap(), if file.len() > 200_000 { 100 } else { 400 });
        let policy = temporary(&format!("qemu-{name}.bin"), &file);
        let obs = temporary(&format!("qemu-{name}.obs"), &observations.file());
        let (said, ended) = emulated(&elf, &policy, &obs);
        assert!(ended, "{name}: the firmware failed or hung: {}", said.lines().last().unwrap_or_default());
        same_lines(name, &said, &expected(&file, &observations));
    }

    // A damaged and an absent policy: refused, and said why.
    let (_, mut damaged) = policies().swap_remove(0);
    damaged[300] ^= 1;
    let obs = temporary("qemu-none.obs", &[0; 12]);
    let (said, ended) = emulated(&elf, &temporary("qemu-damaged.bin", &damaged), &obs);
    assert!(!ended && said.starts_with("load: image damaged"), "{said}");
    let (said, ended) = emulated(&elf, &temporary("qemu-erased.bin", &[0xFF; 4096]), &obs);
    assert!(!ended && said.starts_with("load: the place is erased or empty"), "{said}");
}
