#![allow(clippy::unwrap_used, reason = "tests")]

use super::super::figure::figure;
use super::super::plan::Options;
use super::super::state::survey;
use super::*;
use crate::config::to_toml;
use crate::metrics::jsonl::TIMING_FILE;
use crate::runner::origin::Origin;
use crate::runner::train::CONFIG_FILE;
use std::path::Path;

fn plan(id: &str, out: &Path, seeds: u64, steps: u64) -> Plan {
    let options = Options { seeds: Some(seeds), steps: Some(steps), out: out.to_owned(), only: None };
    Plan::new(figure(id).unwrap(), &options).unwrap()
}

/// A run folder with these evaluations: step, mean return.
fn folder(run: &PlannedRun, evaluations: &[(u64, f64)]) {
    std::fs::create_dir_all(&run.dir).unwrap();
    std::fs::write(run.dir.join(CONFIG_FILE), to_toml(&run.config).unwrap()).unwrap();
    Origin { commit: "0123abc".to_owned(), machine: "x".to_owned(), built_in: false }.store(&run.dir).unwrap();
    let lines = evaluations.iter().map(|(step, mean)| {
        format!(
            "{{\"env_steps\":{step},\"eval_return_mean\":{mean},\"eval_return_sd\":0.5,\"eval_success_rate\":0.9}}\n"
        )
    });
    std::fs::write(run.dir.join(METRICS_FILE), lines.collect::<String>()).unwrap();
    let last = evaluations.last().unwrap().0;
    std::fs::write(run.dir.join(TIMING_FILE), format!("{{\"env_steps\":{last},\"wall_s\":90.0}}\n")).unwrap();
}

fn named<'a>(plan: &'a Plan, name: &str) -> &'a PlannedRun {
    plan.runs.iter().find(|run| run.name == name).unwrap()
}

#[test]
fn the_return_of_a_run_is_its_last_evaluation_within_the_steps() {
    let out = tempfile::tempdir().unwrap();
    let plan = plan("demo", out.path(), 1, 2_000);
    let run = named(&plan, "pendulum/gadm-dqn-small-seed0");
    // The round that reaches step 2,000 ends at 2,048; the run was then continued.
    folder(run, &[(1_000, 1.0), (1_500, 9.0), (2_048, 3.0), (3_000, 70.0)]);
    let results = Results::read(&plan, &survey(&plan), false).unwrap();
    let seed = &results.rows[0].seeds[0];
    assert_eq!((seed.env_steps, seed.final_return, seed.best_return), (2_048, 3.0, 9.0));
    assert_eq!(seed.last_five, 13.0 / 3.0);
    assert_eq!((seed.success_rate, seed.wall_s, seed.commit.as_deref()), (Some(0.9), 90.0, Some("0123abc")));
    assert_eq!(seed.points.len(), 3);
}

#[test]
fn the_last_five_of_many_evaluations_are_averaged() {
    let out = tempfile::tempdir().unwrap();
    let plan = plan("demo", out.path(), 1, 2_000);
    let evaluations: Vec<(u64, f64)> = (1..=10).map(|i| (200 * i, i as f64)).collect();
    folder(named(&plan, "pendulum/gadm-dqn-small-seed0"), &evaluations);
    let results = Results::read(&plan, &survey(&plan), false).unwrap();
    assert_eq!(results.rows[0].seeds[0].last_five, 8.0);
}

#[test]
fn runs_that_are_not_done_count_only_when_asked_for() {
    let out = tempfile::tempdir().unwrap();
    let plan = plan("demo", out.path(), 2, 2_000);
    folder(named(&plan, "pendulum/gadm-dqn-small-seed0"), &[(2_000, 4.0)]);
    folder(named(&plan, "pendulum/gadm-dqn-small-seed1"), &[(1_000, 6.0)]);
    let row = |partial| Results::read(&plan, &survey(&plan), partial).unwrap().rows.swap_remove(0);
    assert_eq!((row(false).final_return.unwrap().n, row(false).planned), (1, 2));
    assert_eq!(row(true).final_return.unwrap().mean, 5.0);
    let text = Results::read(&plan, &survey(&plan), false).unwrap().to_markdown();
    assert!(
        text.contains("| pendulum | GADM+DQN | 0 | 1 of 2 | 4.000 | 4.000 | 4.000 | 90 % | 1 min 30 s | `0123abc` |"),
        "{text}"
    );
    assert!(text.contains("| pendulum | TD3 | – | 0 of 2 | – |"), "{text}");
}

#[test]
fn a_row_over_all_environments_needs_all_of_them_and_draws_within_each() {
    let out = tempfile::tempdir().unwrap();
    let plan = plan("fig4", out.path(), 2, 100_000);
    for (env, values) in [("moving", [1.0, 1.0]), ("sliding", [2.0, 2.0])] {
        for (seed, value) in values.iter().enumerate() {
            folder(named(&plan, &format!("{env}/gadm-dqn-seed{seed}")), &[(100_000, *value)]);
        }
    }
    let read = || Results::read(&plan, &survey(&plan), false).unwrap();
    assert!(read().rows.iter().all(|row| row.env != "all"), "HardMove is missing");
    for seed in 0..2 {
        folder(named(&plan, &format!("hard-move-10/gadm-dqn-seed{seed}")), &[(100_000, 6.0)]);
    }
    let results = read();
    let all: Vec<&Row> = results.rows.iter().filter(|row| row.env == "all").collect();
    let summary = all[0].final_return.unwrap();
    assert_eq!((all.len(), summary.n, summary.mean, summary.iqm), (1, 6, 3.0, 2.75));
    // Equal runs within each environment: nothing varies, whatever is drawn.
    assert_eq!(summary.iqm_interval, Some(Interval { low: 2.75, high: 2.75 }));
    assert_eq!(results.to_csv().lines().count(), 1 + 6, "the row over all repeats no run");
}

#[test]
fn the_files_hold_every_seed_and_the_drawing_every_panel() {
    let out = tempfile::tempdir().unwrap();
    let plan = plan("fig4", out.path(), 2, 100_000);
    let written = super::super::draw::write(&plan, false).unwrap();
    assert_eq!(written.files.len(), 3, "nothing to draw yet");
    folder(named(&plan, "moving/gadm-dqn-seed0"), &[(50_000, 1.0), (100_000, 1.5)]);
    folder(named(&plan, "moving/gadm-dqn-seed1"), &[(50_000, 1.25), (100_000, 1.75)]);
    super::super::draw::write(&plan, false).unwrap();
    let read = |ending: &str| std::fs::read_to_string(out.path().join(format!("fig4.{ending}"))).unwrap();
    for text in ["fig4: Hybrid actions", "HardMove n=10", "no runs yet", "MPDQN"] {
        assert!(read("svg").contains(text), "{text}");
    }
    let csv = read("csv");
    assert_eq!(csv.lines().nth(2).unwrap(), "moving,gadm-dqn,1,100000,1.75,1.5,1.75,0.9,90.0,0123abc");
    let json: serde_json::Value = serde_json::from_str(&read("json")).unwrap();
    assert_eq!(json["rows"][0]["final_return"]["mean"], 1.625);
    assert_eq!(json["rows"][0]["seeds"][1]["final_return"], 1.75);
    assert!(read("md").contains("1.625 ± 0.177"), "{}", read("md"));
}

#[test]
fn numbers_are_written_for_people() {
    assert_eq!([0.0, 1.8549, -12.34, 2859.65].map(short), ["0.000", "1.855", "-12.3", "2860"]);
    assert_eq!([7, 2_000, 1_000_000].map(grouped), ["7", "2,000", "1,000,000"]);
}
