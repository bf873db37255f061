//! Does a policy fit a bus: `gadm-sim bus load` and the check before a run.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]
#![cfg(feature = "mujoco")]

mod support;

use serde_json::Value;
use support::program::{policy_file, sim, stderr};

#[test]
fn humanoid_does_not_fit_classic_and_the_answer_says_what_does() {
    let dir = tempfile::tempdir().unwrap();
    // 376 observations, the longest of all environments.
    let policy = policy_file(dir.path(), "humanoid-v4", 11);
    let out = sim(&["bus", "load", &policy, "--profile", "classic-i16", "--bitrate", "500000", "--json"]);
    assert_eq!(out.status.code(), Some(3), "{}", stderr(&out));
    let text = stderr(&out);
    for words in ["376 observations", " 237.6 ", "does not fit: bus load", "fd-f32 at 500/5000 kbit/s"] {
        assert!(text.contains(words), "{words}: {text}");
    }
    let json: Value = serde_json::from_slice(&out.stdout).unwrap();
    let row = &json["profiles"][0];
    // 126 observation and 6 action frames of 135 bits, 2 us each, in 15 ms.
    assert!((row["load"]["sets_percent"].as_f64().unwrap() - 237.6).abs() < 1e-9, "{row}");
    assert_eq!((row["fits"].as_bool(), row["load"]["observation_frames"].as_u64()), (Some(false), Some(126)));
    assert_eq!(json["proposals"].as_array().unwrap().len(), 1, "no classic bit rate will do");
    assert_eq!(json["proposals"][0]["profile"], "fd-f32");

    // What it proposes, it accepts; the next slower one, which it passed over, it does not.
    for (data_rate, code) in [("5000000", 0), ("2000000", 3)] {
        let rates = ["--profile", "fd-f32", "--bitrate", "500000", "--data-bitrate", data_rate];
        let out = sim(&[&["bus", "load", &policy][..], &rates].concat());
        assert_eq!(out.status.code(), Some(code), "{data_rate}: {}", stderr(&out));
    }

    // A run asks the same question first.
    let out = sim(&["run", &policy, "--episodes", "1", "--profile", "classic-i16"]);
    assert_eq!(out.status.code(), Some(3), "{}", stderr(&out));
    for words in ["does not fit: bus load", "fd-f32 at 500/5000 kbit/s", "--allow-overload"] {
        assert!(stderr(&out).contains(words), "{words}: {}", stderr(&out));
    }
    let out = sim(&["run", &policy, "--episodes", "1", "--profile", "classic-i16", "--allow-overload"]);
    assert_eq!(out.status.code(), Some(0), "{}", stderr(&out));
    assert!(stderr(&out).contains("does not fit"), "{}", stderr(&out));
}

#[test]
fn hopper_fits_both_profiles() {
    let dir = tempfile::tempdir().unwrap();
    let policy = policy_file(dir.path(), "hopper-v5", 11);
    let out = sim(&["bus", "load", &policy, "--bitrate", "500000", "--json"]);
    assert_eq!(out.status.code(), Some(0), "{}", stderr(&out));
    let json: Value = serde_json::from_slice(&out.stdout).unwrap();
    let sets = |i: usize| json["profiles"][i]["load"]["sets_percent"].as_f64().unwrap();
    assert!((sets(0) - 7.4).abs() < 0.06 && (sets(1) - 16.9).abs() < 0.06, "{json}");
    assert_eq!(json["control_period_us"], 8000);
    // At a tenth of the rate the classic set takes longer than there is.
    let out = sim(&["bus", "load", &policy, "--bitrate", "50000", "--profile", "classic-i16"]);
    assert_eq!(out.status.code(), Some(3));
}
