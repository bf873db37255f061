//! What people see when something is wrong: each message says what, where, expected and found, and what to do.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly, its helpers too")]

use std::path::Path;
use std::process::{Command, Stdio};

use gadm_integration_tests::programs::program;
use gadm_integration_tests::root;
use gadm_runtime::encode::reseal;

/// Runs a program that has to fail with `code`, and returns what it says. Never a panic.
fn complaint(name: &str, words: &[&str], code: i32) -> String {
    let out = Command::new(program(name)).args(words).stdin(Stdio::null()).output().unwrap();
    let said = String::from_utf8(out.stderr).unwrap();
    assert_eq!(out.status.code(), Some(code), "{name} {words:?}: {said}");
    assert!(!said.contains("panicked") && !said.trim().is_empty(), "{said}");
    said
}

#[track_caller]
fn says(text: &str, parts: &[&str]) {
    for part in parts {
        assert!(text.contains(part), "`{part}` is not in: {text}");
    }
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn shipped(name: &str) -> Vec<u8> {
    std::fs::read(root().join("models").join(name).join("policy.bin")).unwrap()
}

#[test]
fn damaged_foreign_and_newer_policies() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("policy.bin");
    let good = shipped("moving");
    let corrupt = |at: usize| {
        let mut bytes = good.clone();
        bytes[at] ^= 0x10;
        bytes
    };
    let mut newer = good.clone();
    newer[8] = 2;
    reseal(&mut newer);
    let text_mode: Vec<u8> = good.iter().copied().filter(|b| *b != b'\r').collect();
    let cases: [(&str, Vec<u8>, &str); 8] = [
        ("corrupt payload", corrupt(good.len() / 2), "CRC"),
        ("corrupt header", corrupt(20), "CRC"),
        ("truncated", good[..good.len() / 2].to_vec(), "bytes"),
        ("empty", Vec::new(), "bytes"),
        (
            "foreign",
            b"\x7fELF and then something that is no policy at all, long enough to hold a header....".to_vec(),
            "not a policy file",
        ),
        ("erased flash", vec![0xff; 4096], "erased or empty"),
        ("copied as text", text_mode, "text-mode transfer"),
        ("newer", newer, "format"),
    ];
    for (what, bytes, word) in cases {
        std::fs::write(&path, bytes).unwrap();
        for (name, words) in [
            ("gadm", vec!["inspect", text(&path)]),
            ("gadm", vec!["eval", text(&path)]),
            ("gadm-sim", vec!["run", text(&path)]),
        ] {
            let said = complaint(name, &words, 1);
            assert!(said.to_lowercase().contains(&word.to_lowercase()), "{what}: `{word}` is not in: {said}");
        }
        says(&complaint("gadm", &["inspect", text(&path)], 1), &["policy.bin"]);
    }
}

#[test]
fn a_policy_in_the_wrong_environment() {
    let policy = root().join("models/moving/policy.bin");
    let said = complaint("gadm", &["eval", text(&policy), "--env", "pendulum"], 1);
    says(&said, &["moving", "pendulum", "expected", "found"]);
    let said = complaint("gadm-sim", &["run", text(&policy), "--plant", "pendulum"], 1);
    says(&said, &["pendulum", "the plant has 3, the policy 10", "--plant moving"]);
}

#[test]
fn names_and_settings_with_typing_errors() {
    says(&complaint("gadm", &["train", "--env", "movin"], 1), &["movin", "moving"]);
    let said = complaint("gadm", &["train", "--env", "moving", "--set", "dqn.gama=0.9", "--print-config"], 1);
    says(&said, &["dqn.gama", "did you mean `gamma`"]);
    let said = complaint("gadm", &["train", "--env", "moving", "--set", "steps=many"], 1);
    says(&said, &["steps"]);
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("mine.toml");
    std::fs::write(&config, "env = \"moving\"\n\n[dqn]\nhiden = [64]\n").unwrap();
    let said = complaint("gadm", &["train", "--config", text(&config)], 1);
    says(&said, &["mine.toml:4", "hiden", "did you mean `hidden`"]);
    says(&complaint("gadm", &["train", "--config", "no-such.toml"], 1), &["no-such.toml"]);
    says(&complaint("gadm", &["trian"], 2), &["train"]);
    let said = complaint("gadm", &["train", "--env", "moving", "--set", "dqn.gamma=1.5"], 1);
    says(&said, &["dqn.gamma", "0 to 1", "1.5"]);
    says(&complaint("gadm", &["train", "--env", "moving", "--device", "gpu"], 2), &["cuda:N", "`gpu`"]);
    let said = complaint("gadm", &["train", "--env", "moving", "--device", "cuda:1"], 1);
    says(&said, &["cuda:1", "--features cuda", "--device cpu"]);
}

#[test]
fn run_folders_that_exist_are_empty_or_changed() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("run");
    std::fs::create_dir(&dir).unwrap();
    std::fs::write(dir.join("something"), "precious").unwrap();
    let said = complaint("gadm", &["train", "--env", "moving", "--out", text(&dir)], 1);
    says(&said, &["already exists", "--resume", "--out"]);
    assert_eq!(std::fs::read_to_string(dir.join("something")).unwrap(), "precious");
    let said = complaint("gadm", &["train", "--env", "moving", "--out", text(&dir), "--resume"], 1);
    says(&said, &["run"]);
    let said = complaint("gadm", &["export", text(&dir), "-o", "x.bin"], 1);
    says(&said, &["checkpoint"]);
    let said = complaint("gadm", &["plot", text(&dir), "-o", "x.svg"], 1);
    says(&said, &["no run folder", "config.toml"]);
}

/// A place that cannot be written, also for root: below a file.
#[test]
fn places_that_cannot_be_written() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    std::fs::write(&file, "").unwrap();
    let dir = file.join("run");
    says(&complaint("gadm", &["train", "--env", "moving", "--out", text(&dir)], 1), &[text(&dir)]);
    let trace = file.join("bus.log");
    let policy = root().join("models/moving/policy.bin");
    says(&complaint("gadm-sim", &["run", text(&policy), "--trace", text(&trace)], 1), &["bus.log"]);
}

#[test]
fn recordings_that_are_none() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("moving.json.gz");
    std::fs::write(&path, "not compressed").unwrap();
    says(&complaint("gadm", &["env", "check", text(&path)], 1), &["moving.json.gz"]);
}
