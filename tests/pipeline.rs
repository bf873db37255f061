//! The whole path through the two programs, small: train, interrupt, resume, export, inspect, evaluate, drive over the bus, report.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly, its helpers too")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use gadm_integration_tests::programs::program;
use serde_json::Value;

/// A run of seconds: tiny networks, a short warm-up, one evaluation of few episodes.
const SMALL: [&str; 13] = [
    "action_model.latents=8",
    "action_model.hidden=16",
    "confidence.hidden=[16]",
    "confidence.start_after=20",
    "dqn.hidden=[16,16]",
    "dqn.heads=2",
    "round.batch=32",
    "round.action_updates=4",
    "round.q_updates=8",
    "warmup.updates=200",
    "warmup.confidence_updates=100",
    "track.eval_every=2000",
    "track.eval_episodes=3",
];

fn run(name: &str, words: &[&str]) -> Output {
    Command::new(program(name)).args(words).stdin(Stdio::null()).output().unwrap()
}

fn ok(name: &str, words: &[&str]) -> String {
    let out = run(name, words);
    assert!(out.status.success(), "{name} {words:?}: {}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).unwrap()
}

fn json(name: &str, words: &[&str]) -> Value {
    serde_json::from_str(&ok(name, words)).unwrap()
}

fn train_words<'a>(env: &'a str, steps: &'a str, dir: &'a str) -> Vec<&'a str> {
    let mut words = vec!["-q", "train", "--env", env, "--steps", steps, "--out", dir, "--set", "warmup.steps=1024"];
    words.extend(SMALL.iter().flat_map(|set| ["--set", set]));
    words
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn returns(result: &Value) -> Vec<f64> {
    result["returns"].as_array().unwrap().iter().map(|r| r.as_f64().unwrap()).collect()
}

fn whole_path(env: &str) {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("a run");
    let policy = dir.join("policy.bin");
    ok("gadm", &train_words(env, "4096", text(&dir)));
    for file in ["config.toml", "origin.json", "metrics.jsonl", "timing.jsonl", "checkpoints/last.safetensors"] {
        assert!(dir.join(file).exists(), "{file}");
    }
    // So short a run gives a poor policy; only what is measured about it matters here.
    ok("gadm", &["export", text(&dir), "-o", text(&policy), "--episodes", "3", "--force"]);
    let card = std::fs::read_to_string(dir.join("card.toml")).unwrap();
    assert!(card.contains("gadm train --config config.toml"), "settings that the program does not come with: {card}");
    let content = json("gadm", &["inspect", text(&policy), "--json"]);
    assert_eq!((content["self_test"].as_str(), content["latents"].as_u64()), (Some("passed"), Some(8)));
    assert_eq!(content["provenance"]["environment"].as_str(), Some(env));
    let parts = content["parts"].as_array().unwrap().iter().map(|p| p["bytes"].as_u64().unwrap()).sum::<u64>();
    assert_eq!(parts, std::fs::metadata(&policy).unwrap().len());

    let measure = ["--episodes", "4", "--seed", "7", "--json"];
    let on_host = json("gadm", &[&["eval", text(&policy)], &measure[..]].concat());
    let trace = dir.join("bus.log");
    let over_the_bus = json("gadm-sim", &[&["run", text(&policy), "--trace", text(&trace)], &measure[..]].concat());
    let bus_returns: Vec<f64> =
        over_the_bus["episodes"].as_array().unwrap().iter().map(|e| e["return"].as_f64().unwrap()).collect();
    assert_eq!(returns(&on_host), bus_returns, "{env}: the bus changed a return");
    let as_float = json("gadm", &[&["eval", text(&dir)], &measure[..]].concat());
    assert_eq!(returns(&as_float).len(), 4);

    explained(&dir, &policy, &on_host);

    std::fs::write(dir.join("sil.json"), over_the_bus.to_string()).unwrap();
    ok("gadm", &["report", text(&dir), "--sil", text(&dir.join("sil.json")), "--trace", text(&trace)]);
    let html = std::fs::read_to_string(dir.join("report.html")).unwrap();
    assert!(html.contains("<svg") && html.contains("bus.log") && !html.contains("http://cdn"));
    let svg = folder.path().join("curve.svg");
    ok("gadm", &["plot", text(&dir), "-o", text(&svg)]);
    assert!(std::fs::read_to_string(&svg).unwrap().contains("</svg>"));
    // A criterion that cannot be met is exit code 3.
    assert_eq!(run("gadm", &["eval", text(&policy), "--episodes", "1", "--min-return", "1e9"]).status.code(), Some(3));
}

/// The page on a policy, of its file and of its run, tells of the episodes that `gadm eval` measures.
fn explained(dir: &Path, policy: &Path, measured: &Value) {
    let html = dir.join("why.html");
    for (subject, sections) in [(policy, "a policy file holds no encoder"), (dir, "Which actions share a latent: ")] {
        let words =
            ["explain", text(subject), "-o", text(&html), "--episodes", "4", "--seed", "7", "--step", "0", "--json"];
        let told = json("gadm", &words);
        // Flying a run means flying what it exports.
        assert_eq!(returns(&told), returns(measured), "{}", subject.display());
        assert_eq!(told["latent_counts"], measured["latent_counts"]);
        let layers = told["layers"].as_array().unwrap();
        assert_eq!(layers[0]["weights"].is_null(), subject == policy, "{layers:?}");
        for error in ["weights", "activations", "all"] {
            assert!(layers.iter().all(|layer| layer[error].as_f64().is_none_or(|share| share < 0.3)), "{layers:?}");
        }
        let page = std::fs::read_to_string(&html).unwrap();
        assert!(page.contains(sections), "{sections}");
        assert!(page.contains("Step 0: Q and confidence by latent") && !page.contains("<script"), "{page}");
    }
    let late = run("gadm", &["explain", text(policy), "-o", text(&html), "--episodes", "1", "--step", "100000"]);
    let error = String::from_utf8_lossy(&late.stderr).into_owned();
    assert!(!late.status.success() && error.contains("--step: expected 0 to "), "{error}");
}

#[test]
fn a_hybrid_action_space_from_training_to_the_bus() {
    whole_path("moving");
}

#[test]
fn switches_and_parameters_from_training_to_the_bus() {
    whole_path("hard-move-4");
}

#[cfg(feature = "mujoco")]
#[test]
fn a_mujoco_body_from_training_to_the_bus() {
    whole_path("inverted-pendulum-v5");
}

/// Interrupts a run as Ctrl-C does, at some moment, continues it, and compares it with one that was never stopped.
#[cfg(unix)]
#[test]
fn an_interrupted_run_goes_on_as_if_never_stopped() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, cut) = (folder.path().join("whole"), folder.path().join("cut"));
    ok("gadm", &train_words("moving", "12288", text(&whole)));
    let mut child = Command::new(program("gadm"))
        .args(train_words("moving", "12288", text(&cut)))
        .stdin(Stdio::null())
        .stderr(Stdio::null())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    // The handler is set before the folder is made.
    while !cut.join("timing.jsonl").exists() {
        assert!(child.try_wait().unwrap().is_none(), "the run ended before it began");
        std::thread::yield_now();
    }
    let killed = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(killed.success());
    let code = child.wait().unwrap().code();
    assert_eq!(code, Some(130), "interrupted runs say so");
    ok("gadm", &["-q", "train", "--out", text(&cut), "--resume"]);
    let metrics = |dir: &PathBuf| std::fs::read(dir.join("metrics.jsonl")).unwrap();
    assert!(metrics(&whole) == metrics(&cut), "metrics differ after resuming");
}
