//! `gadm image` and `gadm image verify` as people meet them.
#![allow(clippy::unwrap_used, reason = "tests may panic")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

fn gadm(folder: &Path, words: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_gadm")).current_dir(folder).arg("image").args(words).output().unwrap()
}

/// Standard output of a call that has to succeed, and its standard error.
#[track_caller]
fn done(folder: &Path, words: &[&str]) -> (String, String) {
    let out = gadm(folder, words);
    let (said, told) = (String::from_utf8(out.stdout).unwrap(), String::from_utf8(out.stderr).unwrap());
    assert!(out.status.success(), "{words:?}: {told}");
    (said, told)
}

/// A call that has to fail with `code` and say all of `parts`; nothing may be written.
#[track_caller]
fn refused(folder: &Path, words: &[&str], code: i32, parts: &[&str]) {
    let before = names(folder);
    let out = gadm(folder, words);
    let told = String::from_utf8(out.stderr).unwrap();
    assert_eq!(out.status.code(), Some(code), "{words:?}: {told}");
    for part in parts {
        assert!(told.contains(part), "{words:?}: `{part}` is not in: {told}");
    }
    assert!(out.stdout.is_empty(), "{words:?}: {:?}", String::from_utf8_lossy(&out.stdout));
    assert_eq!(names(folder), before, "{words:?} left a file");
}

fn names(folder: &Path) -> Vec<PathBuf> {
    let mut names: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    names.sort();
    names
}

/// A folder with a shipped policy in it, and the policy's bytes.
fn with_policy() -> (tempfile::TempDir, Vec<u8>) {
    let folder = tempfile::tempdir().unwrap();
    let bytes =
        std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/../models/inverted-pendulum-v5/policy.bin")).unwrap();
    std::fs::write(folder.path().join("policy.bin"), &bytes).unwrap();
    (folder, bytes)
}

#[test]
fn every_format_is_written_and_verified() {
    let (folder, bytes) = with_policy();
    let folder = folder.path();
    for name in ["a.hex", "a.uf2", "a.elf", "a.bin", "a.h"] {
        let (lines, told) = done(folder, &["policy.bin", "--address", "0x08060000", "--chip", "stm32f405", "-o", name]);
        assert!(told.contains("take 1 erase block of stm32f405") && told.contains("inverted-pendulum-v5"), "{told}");
        assert_eq!(lines.contains("probe-rs download --chip STM32F405RGTx"), name != "a.h", "{lines}");
        assert_eq!(lines.contains("dfu-util -a 0 -s 0x08060000 -D "), name != "a.h", "{lines}");
        let words = ["verify", name, "--address", "0x08060000", "--against", "policy.bin", "--chip", "stm32f405"];
        let (said, _) = done(folder, &words);
        let same = format!("the same {} bytes as policy.bin", bytes.len());
        assert!(said.contains("policy at address 0x08060000, self-test passed") && said.contains(&same), "{said}");
    }
    assert_eq!(std::fs::read(folder.join("a.bin")).unwrap(), bytes);
}

#[test]
fn the_line_of_the_issue_works_without_a_chip_and_says_what_was_not_checked() {
    let (folder, _) = with_policy();
    let (lines, told) = done(folder.path(), &["policy.bin", "--address", "0x08060000", "-o", "policy.hex"]);
    assert!(told.contains("erase blocks not checked") && told.contains("--chip"), "{told}");
    let tools: Vec<_> = lines.lines().map(|line| line.split(' ').next().unwrap()).collect();
    assert_eq!(tools, ["probe-rs", "openocd", "dfu-util"]);
}

#[test]
fn json_on_standard_output() {
    let (folder, bytes) = with_policy();
    let words = ["policy.bin", "--address", "0x10100000", "--chip", "rp2040", "-o", "p.uf2", "-o", "p.elf", "--json"];
    let (said, told) = done(folder.path(), &words);
    assert!(told.is_empty(), "{told}");
    let value: Value = serde_json::from_str(&said).unwrap();
    assert_eq!(
        (&value["version"], &value["chip"], &value["address"]),
        (&1.into(), &"rp2040".into(), &0x1010_0000.into())
    );
    assert_eq!(value["policy"]["bytes"], bytes.len());
    let blocks = value["erase"]["blocks"].as_array().unwrap();
    assert_eq!(blocks.len(), bytes.len().div_ceil(4096));
    assert_eq!(value["files"].as_array().unwrap().len(), 2);
    assert!(value["commands"].as_array().unwrap().iter().any(|line| line["tool"] == "OpenOCD"));
    let (said, _) = done(folder.path(), &["verify", "p.uf2", "--json"]);
    let value: Value = serde_json::from_str(&said).unwrap();
    assert_eq!((&value["self_test"], &value["address"]), (&"passed".into(), &0x1010_0000.into()));
    assert_eq!((&value["uf2_family"], &value["offset"]), (&0xE48B_FF56u32.into(), &Value::Null));
}

#[test]
fn places_that_do_not_suit() {
    let (folder, _) = with_policy();
    let folder = folder.path();
    let at = |address, rest: &[&str], parts: &[&str]| {
        refused(folder, &[&["policy.bin", "-o", "x.hex", "--address", address], rest].concat(), 1, parts);
    };
    at("0x08064000", &["--chip", "stm32f405"], &["inside of the erase block 0x08060000", "fits at 0x080e0000"]);
    at("0x08000000", &["--chip", "stm32f405"], &["core starts from"]);
    at("0x08060008", &[], &["multiple of 16"]);
    at("0x08080000", &["--chip", "stm32f446"], &["not inside of flash"]);
    at("0x08060000", &["--chip", "stm32f405", "--region", "0x08040000..0x08060000"], &["the region", "0x08040000"]);
    at("0x00201000", &["--erase-block", "64K", "--region", "0x00200000..0x00400000"], &["65536 bytes"]);
    at("0x00201000", &["--region", "0x00200000..0x00400000"], &["--erase-block"]);
    refused(folder, &["policy.bin", "-o", "x.bin", "--chip", "stm32g474"], 1, &["no --address", "fit there at"]);
    refused(folder, &["policy.bin", "-o", "x.hex"], 1, &["x.hex", "give --address"]);
    let usage = |words: &[&str], parts: &[&str]| refused(folder, words, 2, parts);
    usage(&["policy.bin", "-o", "x.hex", "--address", "here"], &["`here`", "0x08060000"]);
    usage(&["policy.bin", "-o", "x.hex", "--address", "16", "--chip", "z80"], &["z80", "stm32h743", "--erase-block"]);
    usage(&["policy.bin", "--address", "16"], &["--output"]);
    usage(&[], &["POLICY"]);
}

#[test]
fn what_is_not_written() {
    let (folder, bytes) = with_policy();
    let folder = folder.path();
    let words = |name| ["policy.bin", "--address", "0x08060000", "-o", name];
    refused(folder, &words("policy.bin"), 1, &["policy file itself"]);
    refused(folder, &words("x.txt"), 1, &["x.txt", ".uf2"]);
    refused(folder, &["absent.bin", "--address", "16", "-o", "x.hex"], 1, &["absent.bin"]);
    refused(folder, &words("no/folder/x.hex"), 1, &["create the folder"]);
    let mut damaged = bytes;
    damaged[5000] ^= 1;
    std::fs::write(folder.join("policy.bin"), damaged).unwrap();
    refused(folder, &words("x.hex"), 1, &["policy.bin", "CRC"]);
    std::fs::write(folder.join("policy.bin"), [0xFF; 4096]).unwrap();
    refused(folder, &words("x.hex"), 1, &["erased"]);
}

#[test]
fn verify_says_what_is_wrong() {
    let (folder, bytes) = with_policy();
    let folder = folder.path();
    done(folder, &["policy.bin", "--address", "0x08060000", "-o", "p.hex"]);
    refused(folder, &["verify", "p.hex", "--address", "0x08040000"], 1, &["0x08040000", "found: 0x08060000"]);
    let mut text = std::fs::read_to_string(folder.join("p.hex")).unwrap();
    text.replace_range(100..101, if &text[100..101] == "0" { "1" } else { "0" });
    std::fs::write(folder.join("bad.hex"), text).unwrap();
    refused(folder, &["verify", "bad.hex"], 1, &["bad.hex", "Intel HEX file damaged at record 3"]);
    refused(folder, &["verify", "p.bin"], 1, &["p.bin"]);
    std::fs::write(folder.join("other.bin"), [7; 200]).unwrap();
    refused(folder, &["verify", "other.bin"], 1, &["other.bin", "not a policy file"]);
    refused(folder, &["verify", "policy.bin", "--chip", "stm32f405"], 1, &["holds no address", "--address"]);

    // A dump of flash with the policy in its second slot.
    let mut dump = vec![0xFF; 0x4_0000];
    dump[0x2_0000..0x2_0000 + bytes.len()].copy_from_slice(&bytes);
    std::fs::write(folder.join("dump.bin"), dump).unwrap();
    let (said, _) = done(folder, &["verify", "dump.bin", "--against", "policy.bin"]);
    assert!(said.contains("offset 0x00020000"), "{said}");
    refused(folder, &["verify", "dump.bin", "--address", "0x08040000"], 1, &["found: 0x08060000"]);
}
