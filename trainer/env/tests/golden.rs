//! Every recorded trajectory of a reference program, replayed through our environment of that name.
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use std::{
    fs,
    io::Write,
    path::{Path, PathBuf},
};

use gadm_envs::golden::{GoldenError, GoldenReport, Replay, check, check_by};

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/envs")
}

fn recordings() -> Vec<PathBuf> {
    let mut files: Vec<_> = fs::read_dir(folder())
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.to_string_lossy().ends_with(".json.gz"))
        .collect();
    files.sort();
    files
}

/// Whether a feature is in this build.
fn built(feature: &str) -> bool {
    match feature {
        "box2d" => cfg!(feature = "box2d"),
        "mujoco" => cfg!(feature = "mujoco"),
        other => panic!("unknown feature {other}"),
    }
}

fn row(report: &GoldenReport) -> String {
    let cell = |quantity| report.comparison(quantity).map_or("-".to_owned(), |c| format!("{:.1e}", c.largest));
    format!(
        "{:<22} {:>3} {:>5} {:>9} {:>9} {:>9} {:>9}  {}",
        report.id,
        report.trajectories,
        report.steps,
        cell("observation"),
        cell("reward"),
        cell("reward_f32_actions"),
        cell("state"),
        if report.passed() { "ok" } else { "FAILED" }
    )
}

#[test]
fn all_recordings_replay_within_their_tolerances() {
    let files = recordings();
    assert_eq!(files.len(), 26, "recordings in {}", folder().display());
    println!("{:<22} {:>3} {:>5} {:>9} {:>9} {:>9} {:>9}", "", "", "steps", "obs", "reward", "rew. f32", "state");
    let (mut failed, mut left_out, mut seen) = (vec![], vec![], vec![]);
    for path in files {
        match check(&path) {
            Ok(report) => {
                println!("{}", row(&report));
                if !report.passed() {
                    failed.push(format!("{report:#?}"));
                }
                seen.push(report.id);
            }
            Err(GoldenError::Env { source: gadm_envs::EnvError::Feature { id, feature }, .. }) if !built(feature) => {
                left_out.push(id);
            }
            Err(error) => panic!("{error}"),
        }
    }
    if !left_out.is_empty() {
        println!("left out, because this build has no MuJoCo or Box2D: {}", left_out.join(", "));
    }
    assert!(failed.is_empty(), "{}", failed.join("\n"));
    let mut expected: Vec<_> = gadm_envs::ids().map(str::to_owned).collect();
    seen.extend(left_out);
    seen.sort();
    expected.sort();
    assert_eq!(seen, expected, "one recording for each environment");
}

/// Every file also replays from each of its states: the way for another processor.
#[test]
fn recordings_replay_from_each_state() {
    for path in recordings() {
        match check_by(&path, Replay::FromEachState) {
            Ok(report) => assert!(report.passed(), "{report:#?}"),
            Err(GoldenError::Env { source: gadm_envs::EnvError::Feature { feature, .. }, .. }) if !built(feature) => {}
            Err(error) => panic!("{error}"),
        }
    }
}

/// LunarLander's arithmetic is the reference's until something touches: both recordings are equal bit for bit until then, and
/// go on in contact.
#[cfg(feature = "box2d")]
#[test]
fn landers_are_equal_bit_for_bit_in_flight() {
    for name in ["lunar_lander_continuous.json.gz", "lunar_lander.json.gz"] {
        let report = check_by(&folder().join(name), Replay::FromEachState).unwrap();
        assert!(report.passed(), "{report:#?}");
        assert_eq!(report.replay, Replay::WholeRun, "it cannot begin in the middle");
        let (flight, all) = (report.comparison("before_contact").unwrap(), report.comparison("observation").unwrap());
        if cfg!(target_arch = "x86_64") {
            assert_eq!((flight.tolerance, flight.unequal), (0.0, 0));
        }
        // 8 numbers of the observation, 31 of the state, and all rewards but that of the reset.
        assert!(flight.compared > 39 * 300 && all.compared / 8 > flight.compared / 40, "{report:#?}");
    }
}

/// Writes a changed copy of the recording of ToyEnv or Moving and replays it.
fn changed(name: &str, change: impl FnOnce(&mut serde_json::Value)) -> Result<GoldenReport, GoldenError> {
    let file = fs::File::open(folder().join(name)).unwrap();
    let mut document: serde_json::Value = serde_json::from_reader(flate2::read::GzDecoder::new(file)).unwrap();
    change(&mut document);
    replay_text(&serde_json::to_vec(&document).unwrap())
}

fn replay_text(text: &[u8]) -> Result<GoldenReport, GoldenError> {
    let file = tempfile::NamedTempFile::new().unwrap();
    let mut packed = flate2::write::GzEncoder::new(file.reopen().unwrap(), flate2::Compression::fast());
    packed.write_all(text).unwrap();
    packed.finish().unwrap();
    check(file.path())
}

#[test]
fn a_difference_is_found_and_placed() {
    let report = changed("moving.json.gz", |d| {
        let cell = &mut d["trajectories"][2]["obs"][4][7];
        *cell = (cell.as_f64().unwrap() + 1e-9).into();
        d["trajectories"][3]["terminated"][5] = true.into();
    })
    .unwrap();
    assert!(!report.passed());
    let obs = report.comparison("observation").unwrap();
    let at = obs.at.as_ref().unwrap();
    assert_eq!((obs.unequal, at.trajectory.as_str(), at.step), (1, "go_to_target", 5));
    assert!((obs.largest - 1e-9).abs() < 1e-15);
    let flag = report.first_flag.unwrap();
    assert_eq!((flag.at.step, flag.flag, flag.recorded), (6, "terminated", true));
    let others = report.comparisons.iter().filter(|c| c.quantity != "observation");
    assert_eq!(others.map(|c| c.unequal).sum::<u64>(), 0);
}

#[test]
fn a_wrong_file_says_what_is_wrong() {
    type Change = fn(&mut serde_json::Value);
    let cases: [(&str, Change, &str); 19] = [
        ("toy_env.json.gz", |d| d["format"] = 2.into(), "format 2, expected 1"),
        ("toy_env.json.gz", |d| d["env"] = "GoBigger 0.2.x st_t2p2".into(), "out of this crate's scope"),
        ("toy_env.json.gz", |d| d["env"] = "HyAR hard move n=4".into(), "out of this crate's scope"),
        ("toy_env.json.gz", |d| d["env"] = "LunarLander-v2".into(), "no environment `lunar-lander-v2`"),
        ("toy_env.json.gz", |d| d["env"] = "Swimmer-v5".into(), "no environment `swimmer-v5`; known: toy-env"),
        ("toy_env.json.gz", |d| d["env"] = "HardMove-v0 n=77".into(), "no environment `hard-move-77`"),
        ("toy_env.json.gz", |d| d["env"] = "Moving-v0".into(), "init state `x`: missing"),
        ("toy_env.json.gz", |d| d["trajectories"] = serde_json::json!([]), "expected at least one"),
        ("toy_env.json.gz", |d| d["trajectories"][0]["obs"] = serde_json::json!([]), "obs: expected 7 entries"),
        ("toy_env.json.gz", |d| d["trajectories"][0]["rewards"][0] = "x".into(), "not a recording"),
        ("toy_env.json.gz", |d| d["trajectories"][0]["actions"][2] = serde_json::json!([1.0]), "step 3 action"),
        ("toy_env.json.gz", |d| d["trajectories"][0]["init"]["state"]["s"] = ().into(), "is null"),
        ("toy_env.json.gz", |d| d["trajectories"][1]["states"]["s"][0] = 1e300.into(), "step 1 state `s`"),
        ("moving.json.gz", |d| d["trajectories"][0]["actions"][1] = serde_json::json!([3, []]), "type below 3"),
        ("moving.json.gz", |d| d["trajectories"][0]["actions"][1] = serde_json::json!([0, [1, 2, 3]]), "parameters"),
        (
            "lunar_lander.json.gz",
            |d| d["trajectories"][0]["initial_force"] = ().into(),
            "expected 16 numbers, found 14",
        ),
        ("lunar_lander.json.gz", |d| d["trajectories"][0]["info"] = serde_json::json!({}), "info dispersion: expected"),
        (
            "lunar_lander.json.gz",
            |d| d["trajectories"][0]["info"]["dispersion"][6] = serde_json::json!([0.5]),
            "step 7 info dispersion: expected 2 numbers, found 1",
        ),
        ("hard_move_n4.json.gz", |d| d["trajectories"][1]["actions"][0][0] = 16.into(), "index below 2^4"),
    ];
    for (i, (name, change, expected)) in cases.into_iter().enumerate() {
        if name.starts_with("lunar") && !built("box2d") {
            continue;
        }
        let error = changed(name, change).unwrap_err().to_string();
        assert!(error.contains(expected), "case {i}: {error}");
    }
    let error = changed("toy_env.json.gz", |d| d["meta"]["kwargs"] = serde_json::json!({"gravity": 3})).unwrap_err();
    assert!(error.to_string().contains("options that are not offered here: gravity"), "{error}");
}

#[test]
fn bytes_that_are_no_recording_are_refused() {
    let file = tempfile::NamedTempFile::new().unwrap();
    assert!(matches!(check(file.path()), Err(GoldenError::Read { .. })), "empty");
    fs::write(file.path(), b"{\"format\": 1}").unwrap();
    assert!(matches!(check(file.path()), Err(GoldenError::Read { .. })), "not packed");
    let whole = fs::read(folder().join("toy_env.json.gz")).unwrap();
    for cut in [1, 10, whole.len() / 2, whole.len() - 1] {
        fs::write(file.path(), &whole[..cut]).unwrap();
        assert!(check(file.path()).is_err(), "cut at {cut}");
    }
    assert!(matches!(check(Path::new("no-such-file.json.gz")), Err(GoldenError::Read { .. })));
    assert!(matches!(replay_text(b"[1, 2"), Err(GoldenError::Json { .. })));
    assert!(matches!(replay_text(&vec![b' '; (256 << 20) + 1]), Err(GoldenError::TooLarge { .. })));
    assert!(replay_text("[".repeat(100_000).as_bytes()).is_err(), "deep nesting");
}
