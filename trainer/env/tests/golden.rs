//! Every recorded trajectory of a reference program, replayed through our environment of that name.

use std::{
    fs,
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
    assert_eq!(files.len(), 24, "recordings in {}", folder().display());
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
            Err(GoldenError::Env { source: gadm_envs::EnvError::Feature { id, .. }, .. })
                if !cfg!(feature = "mujoco") =>
            {
                left_out.push(id);
            }
            Err(error) => panic!("{error}"),
        }
    }
    if !left_out.is_empty() {
        println!("left out, because this build has no MuJoCo: {}", left_out.join(", "));
    }
    assert!(failed.is_empty(), "{}", failed.join("\n"));
    let mut expected: Vec<_> = gadm_envs::ids().map(str::to_owned).collect();
    seen.extend(left_out);
    seen.sort();
    expected.sort();
    assert_eq!(seen, expected, "one recording for each environment");
}
