//! A run is a function of its configuration: the same bytes again, however often it was interrupted; and what happens to a run
//! folder that is damaged, foreign, full or in the way.

#![allow(clippy::unwrap_used, reason = "tests")]

mod runs;

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use gadm_trainer::TrainError;
use gadm_trainer::config::TrainConfig;
use gadm_trainer::metrics::jsonl::{JsonlSink, METRICS_FILE, TIMING_FILE};
use gadm_trainer::metrics::{keys, read_jsonl};
use gadm_trainer::runner::checkpoint::Networks;
use gadm_trainer::runner::{Run, checkpoint, evaluate, train};
use runs::{arrays, assert_same_run, last, metrics, options, resume, small, start, start_and_stop, write_arrays};

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().unwrap()
}

/// Every snapshot of a run folder by its step: arrays bit for bit, and the state beside them.
fn snapshots(dir: &Path) -> Vec<(u64, runs::Arrays, String)> {
    let of = |step| {
        let (arrays, state) = arrays(&checkpoint::path(dir, &checkpoint::snapshot(step)));
        (step, arrays, state)
    };
    checkpoint::snapshots(dir).into_iter().map(of).collect()
}

#[test]
fn the_same_configuration_gives_the_same_run() {
    for env in ["moving", "pendulum"] {
        let (a, b, other) = (folder(), folder(), folder());
        let config = small(env);
        start(&a.path().join("run"), &config).unwrap();
        start(&b.path().join("run"), &config).unwrap();
        assert_same_run(&a.path().join("run"), &b.path().join("run"));
        start(&other.path().join("run"), &TrainConfig { seed: 4, ..config }).unwrap();
        assert_ne!(metrics(&a.path().join("run")), metrics(&other.path().join("run")), "the seed counts");
    }
}

/// Averages follow the networks, are what is kept, and change nothing of what is learned.
#[test]
fn averages_are_kept_and_not_learned_from() {
    let mut config = small("pendulum");
    let mut plain = Run::new(config.clone()).unwrap();
    config.track.average = 0.25;
    let mut run = Run::new(config).unwrap();
    let mut expected: Option<Vec<f32>> = None;
    while !run.finished() {
        plain.round().unwrap().unwrap();
        run.round().unwrap().unwrap();
        let network = run.agent.dqn.params.with(<[f32]>::to_vec);
        assert_eq!(plain.agent.dqn.params.with(<[f32]>::to_vec), network);
        match &mut expected {
            Some(average) => average.iter_mut().zip(&network).for_each(|(a, n)| *a += 0.25 * (n - *a)),
            None => expected = run.averages.is_some().then_some(network),
        }
        let q = run.averages.iter().flat_map(|averages| &averages.0).find(|(name, _)| *name == "q");
        assert_eq!(q.map(|(_, average)| average.with(<[f32]>::to_vec)), expected);
    }
    let expected = expected.expect("it has trained");
    let dir = folder();
    std::fs::create_dir(dir.path().join(checkpoint::FOLDER)).unwrap();
    checkpoint::save(&run, dir.path()).unwrap();
    let mut kept = checkpoint::load_trained(dir.path(), Networks::Last).unwrap();
    assert_eq!(kept.agent().unwrap().dqn.params.with(<[f32]>::to_vec), expected);
    assert_ne!(plain.agent.dqn.params.with(<[f32]>::to_vec), expected);
}

/// Saved and loaded after every single round, in every phase of the warm-up and of training.
#[test]
fn every_round_can_be_the_last_before_an_interruption() {
    // LunarLander's episodes are flown again after a load.
    let lander = cfg!(feature = "box2d").then_some("lunar-lander-continuous");
    for (env, average) in [("moving", 0.0), ("pendulum", 0.25)].into_iter().chain(lander.map(|env| (env, 0.0))) {
        let mut config = small(env);
        config.track.average = average;
        let (whole, parts) = (folder(), folder());
        for dir in [&whole, &parts] {
            std::fs::create_dir(dir.path().join(checkpoint::FOLDER)).unwrap();
        }
        let mut uninterrupted = Run::new(config.clone()).unwrap();
        let mut interrupted = Run::new(config).unwrap();
        let mut sinks = [&whole, &parts].map(|dir| JsonlSink::create(dir.path()).unwrap());
        let mut phases = Vec::new();
        while !uninterrupted.finished() {
            phases.push(uninterrupted.phase());
            uninterrupted.round().unwrap().unwrap();
            interrupted.round().unwrap().unwrap();
            checkpoint::save(&interrupted, parts.path()).unwrap();
            interrupted = checkpoint::load(parts.path()).unwrap();
            if phases.len() % 3 == 0 {
                sinks[0].write(&uninterrupted.record()).unwrap();
                sinks[1].write(&interrupted.record()).unwrap();
            }
        }
        assert!(uninterrupted.agent.masking() && uninterrupted.counters.q_updates > 50);
        phases.dedup();
        assert_eq!(
            phases,
            ["warm-up: random steps", "warm-up: action model", "warm-up: confidence", "training"],
            "all phases were interrupted"
        );
        checkpoint::save(&uninterrupted, whole.path()).unwrap();
        assert_same_run(whole.path(), parts.path());
    }
}

/// The stop flag, set by another thread at moments that differ from machine to machine, until the run is done.
#[test]
fn a_run_stopped_again_and_again_is_the_uninterrupted_one() {
    let (whole, parts) = (folder(), folder());
    let (whole, parts) = (whole.path().join("run"), parts.path().join("run"));
    let mut config = small("moving");
    config.track.snapshots = vec![0, 300, 700, 1024];
    start(&whole, &config).unwrap();
    assert_eq!(start_and_stop(&parts, &config).env_steps, 0);
    let mut sessions = 0;
    loop {
        let stop = AtomicBool::new(false);
        let lines = metrics(&parts).lines().count();
        let done = AtomicBool::new(false);
        let outcome = std::thread::scope(|scope| {
            scope.spawn(|| {
                // Stops a while after the next record was written.
                while metrics(&parts).lines().count() <= lines && !done.load(Ordering::Relaxed) {
                    std::thread::yield_now();
                }
                stop.store(true, Ordering::Relaxed);
            });
            let outcome = train(&options(&parts, None, true, &stop)).unwrap();
            done.store(true, Ordering::Relaxed);
            outcome
        });
        sessions += 1;
        if !outcome.interrupted {
            break;
        }
    }
    assert!(sessions > 1, "never interrupted");
    assert_same_run(&whole, &parts);
    assert_eq!(checkpoint::snapshots(&whole), [0, 300, 700, 1024]);
    assert!(snapshots(&whole) == snapshots(&parts), "snapshots");
    let walls: Vec<f64> = read_jsonl(&parts.join(TIMING_FILE))
        .unwrap()
        .iter()
        .filter_map(|(_, v)| v.get(keys::WALL_S).copied())
        .collect();
    assert!(walls.is_sorted(), "a session goes on with the clock of the one before: {walls:?}");
}

/// What SIGKILL leaves: a copy of the folder taken while the run goes on, the checkpoint older than the metrics, with a torn
/// line and a half-written checkpoint.
#[test]
fn a_killed_run_goes_on_from_its_newest_checkpoint() {
    let (whole, killed) = (folder(), folder());
    let (whole, killed) = (whole.path().join("run"), killed.path().join("run"));
    let mut config = small("moving");
    config.track.checkpoint_every = 64;
    config.track.snapshots = (1..16).map(|n| 64 * n + 1).collect();
    std::thread::scope(|scope| {
        let run = scope.spawn(|| start(&whole, &config).unwrap());
        let lines = || std::fs::read_to_string(whole.join(METRICS_FILE)).map_or(0, |text| text.lines().count());
        while lines() < 3 && !run.is_finished() {
            std::thread::yield_now();
        }
        std::fs::create_dir_all(killed.join(checkpoint::FOLDER)).unwrap();
        for name in ["config.toml".as_ref(), Path::new(checkpoint::FOLDER).join(checkpoint::LAST).as_path()] {
            std::fs::copy(whole.join(name), killed.join(name)).unwrap();
        }
        std::fs::copy(whole.join(METRICS_FILE), killed.join(METRICS_FILE)).unwrap();
        // Among them some that the checkpoint does not know of yet.
        for name in checkpoint::snapshots(&whole).into_iter().map(checkpoint::snapshot) {
            std::fs::copy(checkpoint::path(&whole, &name), checkpoint::path(&killed, &name)).unwrap();
        }
    });
    let mut text = metrics(&killed);
    text.push_str("{\"env_steps\":99");
    std::fs::write(killed.join(METRICS_FILE), text).unwrap();
    let half = killed.join(checkpoint::FOLDER).join(".gadm-Zz12.tmp");
    std::fs::write(&half, b"half a checkpoint").unwrap();
    let before = checkpoint::load(&killed).unwrap().counters.env_steps;
    resume(&killed, Some(&config)).unwrap();
    assert!(before >= 256, "the copy was of a running run, step {before}");
    assert!(!half.exists(), "the leftover is removed");
    assert_same_run(&whole, &killed);
    assert_eq!(checkpoint::snapshots(&whole).len(), 15);
    assert!(snapshots(&whole) == snapshots(&killed), "none is lost, none differs");
}

#[test]
fn steps_can_be_extended_and_nothing_else_changed() {
    let (whole, parts) = (folder(), folder());
    let (whole, parts) = (whole.path().join("run"), parts.path().join("run"));
    let long = small("pendulum");
    let short = TrainConfig { steps: 512, ..long.clone() };
    start(&whole, &long).unwrap();
    assert_eq!(start(&parts, &short).unwrap().env_steps, 512);

    let mut other = long.clone();
    other.dqn.gamma = 0.9;
    let error = resume(&parts, Some(&other)).unwrap_err();
    assert!(matches!(error, TrainError::ConfigChanged { .. }), "{error}");
    let text = error.to_string();
    assert!(text.contains("gamma = 0.99") && text.contains("gamma = 0.9`"), "{text}");

    assert_eq!(resume(&parts, Some(&long)).unwrap().env_steps, 1024);
    assert_same_run(&whole, &parts);
    let configs = [&whole, &parts].map(|dir| std::fs::read_to_string(dir.join("config.toml")).unwrap());
    assert_eq!(configs[0], configs[1], "the stored configuration has the new number of steps");
    let done = resume(&parts, None).unwrap();
    assert!(!done.interrupted && done.env_steps == 1024, "a finished run stays as it is");
    assert_same_run(&whole, &parts);
}

#[test]
fn snapshots_are_the_networks_of_their_step_and_change_nothing() {
    let dir = folder();
    let [whole, old, never] = ["whole", "old", "never"].map(|name| dir.path().join(name));
    let plain = small("moving");
    let mut config = plain.clone();
    config.track.snapshots = vec![1024, 0, 300, 5000];
    let outcome = start(&whole, &config).unwrap();
    assert_eq!(checkpoint::snapshots(&whole), [0, 300, 1024]);
    let loaded = |networks| checkpoint::load_trained(&whole, networks).unwrap();
    let evaluated = |networks| {
        let seed = gadm_trainer::runner::train::evaluation_seed(&config);
        evaluate(loaded(networks).actor(), &config.env, &config.env_options, 2, seed).unwrap()
    };
    assert_eq!(loaded(Networks::Snapshot(300)).counters.env_steps, 320, "the round that reaches it ends there");
    assert_eq!(evaluated(Networks::Snapshot(1024)), evaluated(Networks::Last));
    assert_eq!(Some(evaluated(Networks::Snapshot(1024))), outcome.last);
    let error = checkpoint::load_trained(&whole, Networks::Snapshot(7)).err().unwrap().to_string();
    assert!(error.contains("step-7.safetensors") && error.contains("kept are: 0, 300, 1024"), "{error}");

    // A folder from before there were snapshots, and one that is resumed without naming them.
    start_and_stop(&old, &plain);
    assert!(!std::fs::read_to_string(old.join("config.toml")).unwrap().contains("snapshots"));
    let further = TrainConfig { steps: 512, ..config.clone() };
    resume(&old, Some(&further)).unwrap();
    resume(&old, Some(&plain)).unwrap();
    assert_eq!(checkpoint::snapshots(&old), [0, 300, 1024]);
    start(&never, &plain).unwrap();
    assert_eq!(metrics(&never), metrics(&whole), "nothing is learned or measured differently");
}

#[test]
fn folders_in_the_way_and_folders_without_a_run_are_refused() {
    let dir = folder();
    let config = small("pendulum");
    let run = dir.path().join("run");
    let error = resume(&run, None).unwrap_err();
    assert!(matches!(error, TrainError::NothingToResume { .. }), "{error}");
    start_and_stop(&run, &config);
    let error = start(&run, &config).unwrap_err();
    assert!(matches!(error, TrainError::RunExists { .. }), "{error}");
    assert!(error.to_string().contains("--resume"), "{error}");
    let file = dir.path().join("file");
    std::fs::write(&file, b"mine").unwrap();
    for dir in [file.clone(), file.join("run")] {
        let error = start(&dir, &config).unwrap_err();
        assert!(error.to_string().contains(&file.display().to_string()), "{error}");
    }
    assert_eq!(std::fs::read(&file).unwrap(), b"mine");
}

#[test]
fn a_refused_configuration_leaves_no_folder_behind() {
    let dir = folder();
    let run = dir.path().join("run");
    let mut config = small("pendulum");
    config.warmup.data = Some(dir.path().join("absent.safetensors"));
    let error = start(&run, &config).unwrap_err();
    assert!(error.to_string().contains("absent.safetensors"), "{error}");
    config.warmup.data = None;
    config.dqn.hidden = vec![0];
    assert!(matches!(start(&run, &config), Err(TrainError::Config { .. })));
    assert!(!run.exists());
}

/// Cut short at many lengths, one bit flipped at many places, or another file altogether: an error that names the file and says
/// what to do, and never a panic or a run on damaged numbers.
#[test]
fn damaged_and_foreign_checkpoints_are_refused() {
    let dir = folder();
    let run = dir.path().join("run");
    let mut config = small("pendulum");
    config.steps = 512;
    start(&run, &config).unwrap();
    let good = std::fs::read(last(&run)).unwrap();
    let refused = |bytes: &[u8], what: &str| {
        std::fs::write(last(&run), bytes).unwrap();
        let Err(error) = checkpoint::load(&run) else { panic!("{what} was accepted") };
        let text = error.to_string();
        assert!(matches!(error, TrainError::Checkpoint { .. }), "{what}: {text}");
        assert!(text.contains("last.safetensors") && text.contains("start a new run"), "{what}: {text}");
        assert_eq!(std::fs::read(last(&run)).unwrap(), bytes, "{what}: the file is left as it is");
    };
    for keep in (0..20).map(|i| good.len() * i / 20).chain([1, 7, 8, 9, good.len() - 1]) {
        refused(&good[..keep], &format!("a file cut to {keep} bytes"));
    }
    let header = u64::from_le_bytes(good[..8].try_into().unwrap()) as usize;
    for i in 0..200 {
        // Half of the flips in the header, half in the arrays.
        let at = if i % 2 == 0 { 8 + header * i / 200 } else { 8 + header + (good.len() - header - 8) * i / 200 };
        let mut bytes = good.clone();
        bytes[at] ^= 1 << (i % 7);
        std::fs::write(last(&run), &bytes).unwrap();
        match checkpoint::load(&run) {
            // A header may stay the same JSON (white space, a renamed key that nobody reads); what was loaded is then unharmed.
            Ok(_) => assert!(at < 8 + header, "a flipped bit at {at} in the arrays was accepted"),
            Err(error) => assert!(matches!(error, TrainError::Checkpoint { .. }), "byte {at}: {error}"),
        }
    }
    let foreign = dir.path().join("foreign.safetensors");
    write_arrays(&foreign, &[("weight", &[2], &[1.0, 2.0])]);
    refused(&std::fs::read(foreign).unwrap(), "another program's file");
    refused(b"PK\x03\x04 not tensors at all", "an archive");
    refused(&std::fs::read(run.join("checkpoints/best.safetensors")).unwrap(), "a checkpoint of networks only");
    std::fs::write(last(&run), &good).unwrap();
    assert_eq!(resume(&run, None).unwrap().env_steps, 512, "the undamaged file is taken");
}

#[test]
fn a_loss_that_is_not_a_number_stops_the_run_with_its_batch() {
    for (part, what) in [("action model", "action-model"), ("confidence", "confidence"), ("q", "Q")] {
        let dir = folder();
        let run = dir.path().join("run");
        let mut config = small("pendulum");
        match part {
            "action model" => config.action_model.adam.learning_rate = 1e30,
            "confidence" => config.confidence.adam.learning_rate = 1e30,
            _ => config.dqn.adam.learning_rate = 1e30,
        }
        let error = start(&run, &config).unwrap_err();
        let TrainError::NotFinite { what: found, batch, .. } = &error else { panic!("{part}: {error}") };
        assert!(found.contains(what), "{part}: {found}");
        assert!(error.to_string().contains("lower the learning rate"), "{error}");
        let (arrays, _) = arrays(batch);
        assert_eq!((&arrays["obs"].0[..], &arrays["actions"].0[..]), (&[32, 3][..], &[32, 1][..]));
        assert_eq!(arrays.contains_key("next_obs"), part == "q");
        let kept = checkpoint::load(&run).unwrap();
        kept.agent.dqn.params.with(|p| assert!(p.iter().all(|v| v.is_finite()), "{part}"));
        kept.agent.model.params.with(|p| assert!(p.iter().all(|v| v.is_finite()), "{part}"));
    }
}

#[test]
fn a_checkpoint_that_cannot_be_written_is_an_error_with_its_path_and_the_old_one_stays() {
    let dir = folder();
    let run_dir = dir.path().join("run");
    start_and_stop(&run_dir, &small("pendulum"));
    let run = checkpoint::load(&run_dir).unwrap();
    let (checkpoints, aside) = (run_dir.join(checkpoint::FOLDER), run_dir.join("aside"));
    std::fs::rename(&checkpoints, &aside).unwrap();
    let old = std::fs::read(aside.join(checkpoint::LAST)).unwrap();
    let names_the_file = |error: TrainError, what: &str| {
        let text = error.to_string();
        assert!(text.contains(&last(&run_dir).display().to_string()), "{what}: {text}");
    };

    names_the_file(checkpoint::save(&run, &run_dir).unwrap_err(), "no folder");
    std::fs::write(&checkpoints, b"a file").unwrap();
    names_the_file(checkpoint::save(&run, &run_dir).unwrap_err(), "a file for a folder");
    std::fs::remove_file(&checkpoints).unwrap();
    std::fs::rename(&aside, &checkpoints).unwrap();

    // The last step, the renaming, fails: nothing of the attempt stays.
    let best = checkpoint::path(&run_dir, checkpoint::BEST);
    std::fs::create_dir(&best).unwrap();
    let error = checkpoint::save_networks(&run, &run_dir, checkpoint::BEST).unwrap_err();
    assert!(error.to_string().contains(&best.display().to_string()), "{error}");
    let names: Vec<_> = std::fs::read_dir(&checkpoints).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(names.len(), 2, "{names:?}");
    assert_eq!(std::fs::read(last(&run_dir)).unwrap(), old);
}

#[cfg(target_os = "linux")]
#[test]
fn a_folder_on_a_system_that_takes_no_files_is_refused_at_the_start() {
    let dir = folder();
    let run = dir.path().join("run");
    // Nobody, not even the superuser, can make a file in there.
    std::os::unix::fs::symlink("/proc", dir.path().join("nowhere")).unwrap();
    let error = start(&dir.path().join("nowhere/run"), &small("pendulum")).unwrap_err();
    assert!(error.to_string().contains("nowhere/run"), "{error}");
    start_and_stop(&run, &small("pendulum"));
    let checkpoints = run.join(checkpoint::FOLDER);
    let old = std::fs::read(last(&run)).unwrap();
    let mut loaded = checkpoint::load(&run).unwrap();
    loaded.round().unwrap().unwrap();
    std::fs::rename(&checkpoints, run.join("aside")).unwrap();
    std::os::unix::fs::symlink("/proc", &checkpoints).unwrap();
    let error = checkpoint::save(&loaded, &run).unwrap_err();
    assert!(error.to_string().contains("last.safetensors"), "{error}");
    assert_eq!(std::fs::read(run.join("aside").join(checkpoint::LAST)).unwrap(), old);
}

#[test]
fn recorded_actions_replace_the_random_steps() {
    let dir = folder();
    let data = dir.path().join("data.safetensors");
    let n = 300;
    let obs: Vec<f32> = (0..n * 10).map(|i| (i % 17) as f32 / 17.0).collect();
    let actions: Vec<f32> = (0..n).flat_map(|i| [(i % 3) as f32, (i % 5) as f32 / 5.0, -0.5]).collect();
    write_arrays(&data, &[("obs", &[n, 10], &obs), ("actions", &[n, 3], &actions)]);
    let mut config = small("moving");
    config.warmup.data = Some(data.clone());
    let mut run = Run::new(config.clone()).unwrap();
    run.round().unwrap().unwrap();
    assert_eq!((run.counters.env_steps, run.d_ar.len()), (0, n));
    let (_, stored_obs, stored) = run.d_ar.arrays();
    assert_eq!((stored_obs, stored), (&obs[..], &actions[..]));
    // The folder is complete: after the start, the data file is not needed any more.
    let (whole, parts) = (dir.path().join("whole"), dir.path().join("parts"));
    start(&whole, &config).unwrap();
    start_and_stop(&parts, &config);
    std::fs::remove_file(&data).unwrap();
    resume(&parts, None).unwrap();
    assert_same_run(&whole, &parts);
    assert!(metrics(&whole).starts_with("{\"env_steps\":128,"), "training starts at step 0");
}

#[test]
fn unfit_data_files_are_refused_with_what_was_expected() {
    let dir = folder();
    let data = dir.path().join("data.safetensors");
    let (obs, actions) = ([0.5; 20], [2.0, 0.0, 0.0, 1.0, 0.0, -1.0]);
    let with = |values: &[f32], at: usize, value: f32| {
        let mut values = values.to_vec();
        values[at] = value;
        values
    };
    let mut config = small("moving");
    config.warmup.data = Some(data.clone());
    let refused = |arrays: &[(&str, &[usize], &[f32])], expected: &str| {
        write_arrays(&data, arrays);
        let error = start(&dir.path().join("run"), &config).unwrap_err();
        let text = error.to_string();
        assert!(text.contains("data.safetensors") && text.contains(expected), "`{expected}` not in: {text}");
        assert!(matches!(error, TrainError::Data { .. }), "{text}");
    };
    refused(&[("obs", &[2, 10], &obs)], "`actions` is missing");
    refused(&[("obs", &[4, 5], &obs), ("actions", &[2, 3], &actions)], "`obs` has shape [4, 5], expected N x 10");
    refused(&[("obs", &[2, 10], &obs), ("actions", &[6], &actions)], "`actions` has shape [6], expected N x 3");
    refused(&[("obs", &[2, 10], &obs), ("actions", &[1, 3], &actions[..3])], "2 observations but 1 actions");
    refused(&[("obs", &[0, 10], &[]), ("actions", &[0, 3], &[])], "at least one");
    refused(&[("obs", &[2, 10], &with(&obs, 13, f32::NAN)), ("actions", &[2, 3], &actions)], "`obs`, row 1");
    for (at, value, expected) in [
        (1, f32::INFINITY, "`actions`, row 0"),
        (0, 3.0, "row 0: `actions` slot 0: expected a whole number below 3, found 3"),
        (3, 0.5, "row 1: `actions` slot 0: expected a whole number"),
        (3, -1.0, "row 1: `actions` slot 0"),
        (4, 1.5, "row 1: `actions` slot 1: expected -1 to 1"),
    ] {
        refused(&[("obs", &[2, 10], &obs), ("actions", &[2, 3], &with(&actions, at, value))], expected);
    }
    std::fs::write(&data, b"no tensors").unwrap();
    let error = start(&dir.path().join("run"), &config).unwrap_err();
    assert!(matches!(error, TrainError::Data { .. }) && error.to_string().contains("data.safetensors"), "{error}");
}

/// Observations near the largest float overflow in the first products, and their variance does even where the loss stays finite.
#[test]
fn huge_observations_in_the_data_stop_the_run() {
    let dir = folder();
    let data = dir.path().join("data.safetensors");
    let obs: Vec<f32> = (0..40 * 3).map(|i| if i % 2 == 0 { 3e38 } else { -3e38 }).collect();
    write_arrays(&data, &[("obs", &[40, 3], &obs), ("actions", &[40, 1], &[0.5; 40])]);
    let mut config = small("pendulum");
    config.warmup.data = Some(data);
    let error = start(&dir.path().join("run"), &config).unwrap_err();
    let TrainError::NotFinite { update, batch, .. } = &error else { panic!("{error}") };
    assert!(*update <= 64, "found in the first round, not at update {update}");
    assert!(
        arrays(batch).0["obs"].1.iter().all(|&bits| f32::from_bits(bits).abs() > 1e38),
        "the batch shows the cause"
    );
}
