#![allow(clippy::unwrap_used, reason = "tests")]

use std::sync::atomic::AtomicBool;

use super::super::figure::figure;
use super::super::one::{Ended, run_one};
use super::super::plan::Options;
use super::*;
use crate::runner::progress::Style;

/// The runs of a figure that have one of `names` in theirs, as `change` makes them short.
fn short(id: &str, out: &Path, names: &[&str], change: impl Fn(&mut crate::config::TrainConfig)) -> Plan {
    let options = Options { seeds: Some(1), steps: Some(300_000), out: out.to_owned(), only: None };
    let mut plan = Plan::new(figure(id).unwrap(), &options).unwrap();
    plan.runs.retain(|run| names.iter().any(|name| run.name.contains(name)));
    plan.expert = None;
    for run in &mut plan.runs {
        change(&mut run.config);
        run.steps = run.config.steps;
    }
    plan
}

fn train_all(plan: &Plan) {
    for index in 0..plan.runs.len() {
        assert_eq!(run_one(plan, index, Style::Quiet, &AtomicBool::new(false)).unwrap(), Ended::Complete);
    }
}

fn read(plan: &Plan, ending: &str) -> String {
    std::fs::read_to_string(plan.out.join(format!("{}{ending}", plan.figure.id))).unwrap()
}

/// A run of a few hundred steps.
#[cfg(feature = "box2d")]
fn small_lander(config: &mut crate::config::TrainConfig) {
    config.steps = 512;
    config.track.snapshots = vec![0, 256, 100_000];
    (config.track.eval_every, config.track.eval_episodes, config.track.log_every) = (256, 1, 128);
    if let crate::config::Algorithm::Td3(own) = &mut config.algo {
        (own.hidden, own.schedule.envs, own.schedule.steps_per_round, own.schedule.updates) = (vec![16], 4, 64, 1);
        return;
    }
    (config.collect.envs, config.collect.steps_per_round) = (4, 64);
    (config.warmup.steps, config.warmup.updates, config.warmup.confidence_updates) = (128, 20, 20);
    (config.round.action_updates, config.round.confidence_updates, config.round.q_updates) = (1, 1, 1);
    (config.round.batch, config.action_model.hidden, config.dqn.hidden) = (32, 16, vec![16]);
}

#[cfg(feature = "box2d")]
#[test]
fn snapshots_of_a_lander_are_flown_once_and_drawn_in_three_figures() {
    let out = tempfile::tempdir().unwrap();
    let both = ["td3-seed0", "/gadm-dqn-seed0"];
    let plan = short("fig14", out.path(), &both, small_lander);
    train_all(&plan);
    for run in &plan.runs {
        assert_eq!(super::super::state::inspect(run).state, super::super::state::State::Done, "{}", run.name);
    }
    let written = write(&plan, false).unwrap();
    let names: Vec<_> = written.files.iter().map(|file| file.file_name().unwrap().to_str().unwrap()).collect();
    assert_eq!(names, ["fig14.svg", "fig14.md", "fig14.csv", "fig14-flights.csv", "fig14.json"]);
    let rows = &written.results.tables[0].rows;
    let seen: Vec<_> = rows.iter().map(|row| (row[0].as_str().unwrap(), row[2].as_u64().unwrap())).collect();
    let expected: Vec<_> = ["TD3", "GADM+DQN"].iter().flat_map(|a| [0, 256, 512].map(|step| (*a, step))).collect();
    assert_eq!(seen, expected);
    for row in rows {
        let share = row[4].as_f64().unwrap();
        assert!((0.0..=100.0).contains(&share), "{row:?}");
        assert_eq!(row[8..].iter().map(|count| count.as_u64().unwrap()).sum::<u64>(), flights::EPISODES as u64);
    }
    let svg = read(&plan, ".svg");
    for text in ["No engine asked for", "share of steps (%)", "evaluation return"] {
        assert!(svg.contains(text), "{text}");
    }

    // What is stored is taken, and what cannot be read is flown again.
    let path = plan.runs[0].dir.join("flights-256.json");
    let stored = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, stored.replacen("\"no_ops\":", "\"no_ops\":9", 1)).unwrap();
    assert_ne!(write(&plan, false).unwrap().results.tables[0].rows[1], rows[1]);
    std::fs::write(&path, &stored[..stored.len() / 2]).unwrap();
    assert_eq!(&write(&plan, false).unwrap().results.tables[0].rows, rows);
    assert_eq!(std::fs::read_to_string(&path).unwrap(), stored);

    let paths = short("fig15", out.path(), &both, small_lander);
    write(&paths, false).unwrap();
    let svg = read(&paths, ".svg");
    for text in ["TD3, 0 steps", "GADM+DQN, 512 steps", "200 and above", "position x", "h0"] {
        assert!(svg.contains(text), "{text}");
    }

    let landing = short("fig16", out.path(), &["/gadm-dqn-seed0"], small_lander);
    let written = write(&landing, false).unwrap();
    let svg = read(&landing, ".svg");
    for text in ["main throttle", "side throttle", "(chosen)", "<polygon points=", "fig16: step "] {
        assert!(svg.contains(text), "{text}");
    }
    let latents = &written.results.tables[0].rows;
    let area: f64 = latents.iter().map(|row| row[4].as_f64().unwrap()).sum();
    assert!(latents.len() == 8 && (area - 100.0).abs() < 1e-9, "{area}");
    assert_eq!(latents.iter().filter(|row| row[5] == "yes").count(), 1);
}

#[test]
fn toy_runs_share_their_action_model_and_differ_in_their_confidence() {
    let out = tempfile::tempdir().unwrap();
    let change = |config: &mut crate::config::TrainConfig| {
        config.steps = 1;
        (config.warmup.updates, config.warmup.confidence_updates) = (150, 150);
        (config.round.batch, config.action_model.hidden) = (64, 16);
        config.confidence.hidden = vec![16];
        config.confidence.adam.learning_rate = 1e-2;
    };
    let plan = short("fig12", out.path(), &["focal0", "focal50"], change);
    assert_eq!(plan.runs.len(), 2);
    train_all(&plan);
    let written = write(&plan, false).unwrap();
    assert!(written.results.rows.is_empty(), "nothing acted");
    assert!(out.path().join("data/toy-env-5000-seed0.safetensors").exists());
    let rows = &written.results.tables[0].rows;
    let numbers = |row: usize, cells: std::ops::Range<usize>| -> Vec<f64> {
        rows[row][cells].iter().map(|cell| cell.as_f64().unwrap()).collect()
    };
    assert_eq!([rows[0][1].as_f64(), rows[1][1].as_f64()], [Some(0.0), Some(50.0)]);
    assert_eq!(numbers(0, 2..6), numbers(1, 2..6), "the same latents");
    assert!((numbers(0, 2..6).iter().sum::<f64>() - 1.0).abs() < 1e-12);
    assert!((numbers(0, 6..10).iter().sum::<f64>() - 1.0).abs() < 1e-5);
    let apart = |row: usize| rows[row][10].as_f64().unwrap();
    assert!(apart(0) < 0.1 && apart(0) < apart(1), "cross-entropy finds the shares: {} {}", apart(0), apart(1));
    let svg = read(&plan, ".svg");
    for text in ["latent of every action", "Around the data", "γ_f = 50", "share of the data", "1/K", "<polygon"] {
        assert!(svg.contains(text), "{text}");
    }
    // Another state of the same runs, which are not trained again.
    let other = short("fig13", out.path(), &["focal0", "focal50"], change);
    assert_ne!(write(&other, false).unwrap().results.tables[0].rows, *rows);
}
