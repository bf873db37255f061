//! Campaigns: repeatable whatever the number of threads, resumable, refused where they do not belong, judged.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use std::path::{Path, PathBuf};
use std::process::Command;

use gadm_sim::SimError;
use gadm_sim::campaign::{Campaign, FILES, Options, campaign};
use gadm_sim::scenario::Scenario;
use support::random_policy;

const FAULTS: &str = r#"
policy = "policy.bin"
episodes = 1

[[faults]]
name = "lost, \"some\" & <all>"
layer = "frame"
kind = "drop"
only = ["OBS"]
p = 1.0
window = [20]
sweep = [0.1, 1.0]

[[faults]]
layer = "actuator"
kind = "gain"
factor = 0.5

[criteria]
action_bounds = true
max_action_age = 3

[campaign]
seeds = 2
"#;

/// A folder with a policy for the pendulum and a scenario.
fn folder(text: &str) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let env = gadm_envs::make("pendulum").unwrap();
    std::fs::write(folder.path().join("policy.bin"), random_policy(env.spec(), 2).as_bytes()).unwrap();
    let path = folder.path().join("faults.toml");
    std::fs::write(&path, text).unwrap();
    (folder, path)
}

fn run(scenario: &Path, out: &Path, jobs: usize) -> Result<(Campaign, usize), SimError> {
    let options = Options { jobs, seeds: None, out: out.to_owned(), command: "gadm-sim campaign".to_owned() };
    let mut resumed = 0;
    let found = campaign(&Scenario::load(scenario)?, &options, &mut |p| resumed = p.resumed)?;
    Ok((found, resumed))
}

#[test]
fn threads_change_nothing_and_a_cut_campaign_goes_on() {
    let (folder, scenario) = folder(FAULTS);
    let (a, b) = (folder.path().join("a"), folder.path().join("b"));
    let (one, _) = run(&scenario, &a, 1).unwrap();
    let (three, resumed) = run(&scenario, &b, 3).unwrap();
    assert_eq!((&one, resumed), (&three, 0));
    assert_eq!(one.records.len(), 2 + 3 * 2, "nominal, two intensities and one fault, two seeds each");
    assert!(one.passed(), "{:?}", one.records);
    assert!(one.records.iter().all(|r| r.fault == "nominal" || r.injected > 0));

    let before: Vec<_> = FILES.iter().map(|f| std::fs::read(a.join(f)).unwrap()).collect();
    let log = a.join("runs.jsonl");
    let text = std::fs::read_to_string(&log).unwrap();
    let kept: Vec<&str> = text.lines().take(5).collect();
    std::fs::write(&log, format!("{}\n{}", kept[..4].join("\n"), &kept[4][..40])).unwrap();
    let (again, resumed) = run(&scenario, &a, 2).unwrap();
    assert_eq!((again, resumed), (one, 4), "four whole lines; the fifth was cut short");
    for (name, before) in FILES.iter().zip(before) {
        assert!(std::fs::read(a.join(name)).unwrap() == before, "{name}");
    }
}

#[test]
fn what_is_written_is_well_formed() {
    let (folder, scenario) = folder(FAULTS);
    let out = folder.path().join("out");
    let (found, _) = run(&scenario, &out, 2).unwrap();
    let text = |name| std::fs::read_to_string(out.join(name)).unwrap();
    let csv = text("results.csv");
    assert_eq!(csv.lines().count(), found.records.len() + 1);
    assert!(csv.contains("\"lost, \"\"some\"\" & <all>\""), "{csv}");
    let json: serde_json::Value = serde_json::from_str(&text("results.json")).unwrap();
    assert_eq!(json["runs"], 8);
    assert_eq!(json["tallies"].as_array().unwrap().len(), 4);
    for name in ["junit.xml", "heatmap.svg"] {
        let xml = text(name);
        assert!(xml.contains("lost, &quot;some&quot; &amp; &lt;all&gt;") && !xml.contains("<all>"), "{name}: {xml}");
        let count = |s: &str| xml.matches(s).count();
        assert_eq!(count("<testcase"), count("</testcase>"));
        assert_eq!(count("<text"), count("</text>"));
    }
    assert!(text("junit.xml").contains("tests=\"8\" failures=\"0\" errors=\"0\""));
    let html = text("report.html");
    assert!(html.starts_with("<!DOCTYPE html>") && !html.contains("<script") && !html.contains("http://"));
}

#[test]
fn a_folder_of_another_campaign_is_refused() {
    let (folder, scenario) = folder(FAULTS);
    let out = folder.path().join("out");
    run(&scenario, &out, 2).unwrap();
    std::fs::write(&scenario, FAULTS.replace("factor = 0.5", "factor = 0.6")).unwrap();
    let error = run(&scenario, &out, 2).unwrap_err();
    assert!(matches!(error, SimError::Campaign { .. }) && error.to_string().contains("-o"), "{error}");
}

#[test]
fn exit_codes() {
    let status = |text: &str| {
        let (folder, scenario) = folder(text);
        let mut command = Command::new(env!("CARGO_BIN_EXE_gadm-sim"));
        command
            .arg("campaign")
            .arg(scenario)
            .args(["--quiet", "--json", "--seeds", "1", "-o"])
            .arg(folder.path().join("o"));
        let output = command.output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned(), output.stdout)
    };
    let (code, err, out) = status(FAULTS);
    assert_eq!((code, err.as_str()), (Some(0), ""));
    assert!(serde_json::from_slice::<serde_json::Value>(&out).is_ok());
    let (code, err, _) = status(&FAULTS.replace("max_action_age = 3", "max_action_age = 0"));
    assert_eq!(code, Some(3), "{err}");
    assert!(err.contains("max_action_age: required at most 0, found "), "{err}");
    let (code, err, _) = status(&FAULTS.replace("factor = 0.5", "factor = 0.5\nwindow = [100000]"));
    assert_eq!(code, Some(3), "a fault that is never injected tests nothing: {err}");
    assert!(err.contains("min_injected: required at least 1, found 0"), "{err}");
    let (code, err, _) = status(&FAULTS.replace("kind = \"gain\"", "kind = \"gian\""));
    assert_eq!(code, Some(1));
    assert!(err.contains("faults.toml:14: `faults[1]`") && err.contains("did you mean `gain`?"), "{err}");
}

#[test]
fn shipped_scenarios_are_read_and_name_policies_that_are_there() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenarios");
    let mut count = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let scenario = Scenario::load(&entry.unwrap().path()).unwrap();
        assert!(scenario.policy.exists(), "{scenario:?}");
        assert_ne!(scenario.criteria, gadm_sim::scenario::Criteria::default());
        count += 1;
    }
    assert_eq!(count, 5);
}

#[cfg(feature = "mujoco")]
#[test]
fn shipped_scenarios_without_a_campaign_meet_their_criteria() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenarios");
    for (name, episodes) in [("inverted-pendulum-nominal", 2), ("hopper-nominal", 1), ("hopper-bad-bus", 5)] {
        let mut scenario = Scenario::load(&folder.join(name).with_extension("toml")).unwrap();
        scenario.episodes = episodes;
        let outcome = scenario.run(None, &mut |_| {}).unwrap();
        assert!(outcome.verdict.passed, "{name}: {:?}", outcome.verdict.missed());
    }
}
