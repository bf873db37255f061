//! The switches of Algorithm 1 act as the specification says, seen from outside: buffers, counters and metrics of small runs.

#![allow(clippy::unwrap_used, reason = "tests")]

mod runs;

use std::collections::HashSet;

use gadm_trainer::TrainError;
use gadm_trainer::action_space::{ActionSpace, ContinuousHead, SnapRule};
use gadm_trainer::algo::dqn::TargetUpdate;
use gadm_trainer::config::TrainConfig;
use gadm_trainer::discretizer::gadm::{ActionModel, Trunk, codetable::Codetable};
use gadm_trainer::export::float_model;
use gadm_trainer::metrics::{Record, keys, read_jsonl};
use gadm_trainer::nn::Engine;
use gadm_trainer::runner::checkpoint::{Networks, load_trained};
use gadm_trainer::runner::{Run, checkpoint, train::evaluation_seed};
use gadm_trainer::seed::SeedTree;
use runs::{arrays, assert_same_update, last, metrics, small, start, write_arrays};

fn rounds(run: &mut Run, n: usize) {
    for _ in 0..n {
        run.round().unwrap().unwrap();
    }
}

fn until_warm(run: &mut Run) {
    while !run.counters.warm {
        rounds(run, 1);
    }
}

fn trained(config: TrainConfig) -> (Run, Record) {
    let mut run = Run::new(config).unwrap();
    until_warm(&mut run);
    rounds(&mut run, 8);
    let record = run.record();
    (run, record)
}

#[test]
fn the_warm_up_is_counted_and_its_phases_follow_each_other() {
    let mut run = Run::new(small("pendulum")).unwrap();
    rounds(&mut run, 8);
    let c = &run.counters;
    assert_eq!((c.env_steps, c.action_updates, c.confidence_updates, c.warm), (256, 0, 0, false));
    assert_eq!((run.d_ar.len(), run.d_rl.len()), (256, 0), "random steps go into D_AR only");
    rounds(&mut run, 4);
    let c = &run.counters;
    assert_eq!((c.env_steps, c.action_updates, c.confidence_updates, c.q_updates), (256, 100, 100, 0));
    until_warm(&mut run);
    assert_eq!(run.counters.env_steps, 256);
    rounds(&mut run, 1);
    let c = &run.counters;
    assert_eq!((c.env_steps, c.action_updates, c.confidence_updates), (288, 103, 102), "one round: U_AR, U_LACP");
    assert_eq!(run.d_ar.len(), 288, "the warm-up's pairs stay");
    assert_eq!(run.d_rl.len(), 32 - 4 * 2, "n - 1 transitions of each environment are pending");
    assert_eq!(run.counters.q_updates, 0, "less than a batch in D_RL");
    rounds(&mut run, 1);
    assert_eq!((run.d_rl.len(), run.counters.q_updates), (56, 4));
}

#[test]
fn candle_on_a_device_gives_the_updates_of_the_fused_layers() {
    for env in ["pendulum", "moving"] {
        let mut config = small(env);
        config.warmup.enabled = false;
        (config.round.action_updates, config.round.confidence_updates, config.round.q_updates) = (1, 1, 1);
        // Adam would turn a gradient that is nothing but rounding into a whole step.
        config.action_model.adam.epsilon = 1e-2;
        // Before the first update a code position hardly varies, and dividing by its deviation lifts every rounding above the
        // tolerance; `nn/oracle.rs` compares the standardisation where it varies.
        config.action_model.standardise = false;
        // The first round with a batch is the first one with an update of any network.
        config.collect.steps_per_round = 64;
        assert_same_update(&config);
    }
}

#[test]
fn a_run_on_a_device_trains_to_its_end() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("run");
    Engine::Candle.start().unwrap();
    let outcome = start(&run, &small("pendulum"));
    Engine::Fused.start().unwrap();
    let outcome = outcome.unwrap();
    assert!(outcome.env_steps >= 1024 && outcome.best_return.is_some_and(f64::is_finite));
    assert!(metrics(&run).lines().count() > 3);
}

#[test]
fn without_a_warm_up_the_first_round_acts_with_the_policy() {
    let mut config = small("pendulum");
    config.warmup.enabled = false;
    let mut run = Run::new(config).unwrap();
    rounds(&mut run, 1);
    assert_eq!((run.counters.env_steps, run.d_ar.len(), run.d_rl.len()), (32, 32, 24));
    assert_eq!((run.counters.action_updates, run.counters.confidence_updates), (3, 2));
}

#[test]
fn warm_up_pairs_are_discarded_on_request() {
    let mut config = small("moving");
    config.warmup.keep = false;
    let mut run = Run::new(config).unwrap();
    until_warm(&mut run);
    assert_eq!((run.d_ar.len(), run.counters.action_updates), (0, 100));
    rounds(&mut run, 1);
    assert_eq!(run.d_ar.len(), 32);
}

/// Spec 4.4: independent draws per environment. With one draw per vectorised step, all 40 would be extreme together.
#[test]
fn extreme_noise_is_drawn_per_environment_and_coordinate() {
    let mut config = small("pendulum");
    (config.collect.envs, config.collect.steps_per_round, config.steps) = (40, 4000, 10_000);
    config.warmup.enabled = false;
    (config.round.action_updates, config.round.confidence_updates, config.round.q_updates) = (0, 0, 0);
    (config.replay.ar_capacity, config.replay.rl_capacity) = (10_000, 10_000);
    config.env_options.extra_dims = 1;
    config.explore.extreme_noise = 0.3;
    let extremes = |config: TrainConfig| {
        let mut run = Run::new(config).unwrap();
        rounds(&mut run, 1);
        let actions = run.d_ar.arrays().2.to_vec();
        assert_eq!(actions.len(), 4000 * 2);
        actions.chunks(2).map(|a| (a[0].abs() == 1.0 && a[1].abs() == 1.0).then_some((a[0], a[1]))).collect::<Vec<_>>()
    };
    let drawn = extremes(config.clone());
    let count = |rows: &[Option<(f32, f32)>]| rows.iter().flatten().count() as f64;
    // Mean 1200, standard deviation sqrt(4000 · 0.3 · 0.7) = 29.
    assert!((count(&drawn) - 1200.0).abs() < 5.0 * 29.0, "{}", count(&drawn));
    // Per step, binomial with variance 40 · 0.21 = 8.4; 100 steps give it with a standard error of 1.2.
    let per_step: Vec<f64> = drawn.chunks(40).map(count).collect();
    let mean = per_step.iter().sum::<f64>() / 100.0;
    let variance = per_step.iter().map(|n| (n - mean).powi(2)).sum::<f64>() / 99.0;
    assert!((variance - 8.4).abs() < 5.0 * 1.2, "{variance}");
    for corner in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
        let share = drawn.iter().flatten().filter(|c| **c == corner).count() as f64 / count(&drawn);
        assert!((share - 0.25).abs() < 0.07, "{corner:?}: {share}");
    }
    config.explore.extreme_noise = 0.0;
    assert_eq!(count(&extremes(config)), 0.0);
}

#[test]
fn epsilon_follows_the_schedule_of_the_specification() {
    let mut run = Run::new(small("pendulum")).unwrap();
    for (steps, expected) in [(0, 1.0), (100_000, 0.399), (300_000, 0.097), (1_000_000, 0.050)] {
        run.counters.env_steps = steps;
        assert!((run.epsilon() - expected).abs() < 5e-4, "{steps}: {}", run.epsilon());
    }
}

#[test]
fn epsilon_is_drawn_per_environment() {
    let mut config = small("pendulum");
    (config.collect.envs, config.collect.steps_per_round, config.steps) = (40, 4000, 10_000);
    config.warmup.enabled = false;
    (config.round.action_updates, config.round.confidence_updates, config.round.q_updates) = (0, 0, 0);
    config.replay.rl_capacity = 10_000;
    (config.explore.epsilon_start, config.explore.epsilon_end, config.explore.extreme_noise) = (0.5, 0.5, 0.0);
    config.dqn.n_step = 1;
    let mut run = Run::new(config).unwrap();
    rounds(&mut run, 1);
    let (_, columns) = run.d_rl.arrays();
    let (obs, codes) = (columns[0].clone(), columns[2].clone());
    let mut greedy = Vec::new();
    run.agent.greedy(&obs, 4000, &mut greedy);
    let off = |rows: std::ops::Range<usize>| rows.filter(|&i| codes[i] as u32 != greedy[i]).count() as f64;
    // Half of the draws are random, one in eight of those is the greedy latent: 4000 · 7/16 = 1750, deviation 31.4.
    assert!((off(0..4000) - 1750.0).abs() < 5.0 * 31.4, "{}", off(0..4000));
    assert!((0..100).all(|t| (1.0..39.0).contains(&off(40 * t..40 * (t + 1)))), "never all together");
}

#[test]
fn remapping_off_trains_the_latent_of_collection_time() {
    let mut config = small("moving");
    let (_, record) = trained(config.clone());
    assert!(record.get(keys::REMAPPED).is_some_and(|share| (0.0..=1.0).contains(&share)));
    config.round.remap = false;
    let (_, record) = trained(config.clone());
    assert_eq!(record.get(keys::REMAPPED), None);
    assert!(record.get(keys::Q_LOSS).is_some());

    // With latent 5 written over all stored ones, only its row of the Q-network learns; remapped, others do.
    config.warmup.enabled = false;
    (config.collect.envs, config.collect.steps_per_round) = (1, 1);
    (config.round.action_updates, config.round.confidence_updates) = (0, 0);
    config.dqn.dueling = false;
    for remap in [false, true] {
        config.round.remap = remap;
        let (source, _) = trained(small("moving"));
        let (next, columns) = source.d_rl.arrays();
        let mut columns = columns;
        columns[2].fill(5.0);
        let mut run = Run::new(config.clone()).unwrap();
        assert!(run.d_rl.restore(next, &columns));
        let (name, width) = ("advantage.weight", 3 * 16);
        let before = run.agent.dqn.params.part(name);
        rounds(&mut run, 1);
        let after = run.agent.dqn.params.part(name);
        let moved: Vec<usize> = before
            .chunks(width)
            .zip(after.chunks(width))
            .enumerate()
            .filter_map(|(k, (a, b))| (a != b).then_some(k))
            .collect();
        assert_eq!(moved == [5], !remap, "remap {remap}: rows {moved:?} moved");
    }
}

#[test]
fn without_a_predictor_nothing_is_masked() {
    let mut config = small("moving");
    let (run, record) = trained(config.clone());
    assert!(run.agent.masking());
    let size = record.get(keys::MASK_SIZE).unwrap();
    assert!((1.0..8.0).contains(&size), "{size}");
    assert!(record.get(keys::CONFIDENCE_LOSS).is_some());

    config.confidence.enabled = false;
    let (mut run, record) = trained(config.clone());
    assert!(run.agent.confidence.is_none() && !run.agent.masking());
    assert_eq!(run.counters.confidence_updates, 0);
    assert_eq!((record.get(keys::MASK_SIZE), record.get(keys::CONFIDENCE_LOSS)), (None, None));
    let obs = run.envs.obs().to_vec();
    assert!(run.agent.masks(&obs, 4).is_empty());

    config.confidence.enabled = true;
    config.confidence.start_after = 100 + 2 * 8 + 1;
    let (mut run, _) = trained(config);
    assert!(!run.agent.masking(), "{} updates", run.counters.confidence_updates);
    rounds(&mut run, 1);
    assert!(run.agent.masking());
    let obs = run.envs.obs().to_vec();
    assert_eq!(run.agent.masks(&obs, 4).len(), 4 * 8);
}

/// With a threshold that no score reaches, only the most confident latent is left, and acting takes it wherever it is.
#[test]
fn the_mask_decides_what_is_acted() {
    let mut config = small("moving");
    config.confidence.threshold = 7.999;
    let (mut run, record) = trained(config);
    assert!((record.get(keys::MASK_SIZE).unwrap() - 1.0).abs() < 1e-9);
    assert!(record.get(keys::MASK_FALLBACK).unwrap() > 0.9);
    let obs: Vec<f32> = run.d_rl.arrays().1[0][..200 * 10].to_vec();
    let (mut codes, mut scores) = (Vec::new(), Vec::new());
    run.agent.greedy(&obs, 200, &mut codes);
    run.agent.confidence.as_mut().unwrap().scores(&obs, 200, &mut scores);
    for (code, scores) in codes.iter().zip(scores.chunks(8)) {
        assert!(scores.iter().all(|s| *s <= scores[*code as usize]));
    }
}

/// The predictor on the Q-network's trunk: its updates leave Q as it is, and what is exported is what the agent does.
#[test]
fn a_shared_trunk_is_read_and_exported() {
    for hidden in [vec![], vec![6]] {
        let mut config = small("moving");
        config.confidence.trunk = Trunk::Shared;
        config.confidence.shared_hidden = hidden;
        let (mut run, record) = trained(config.clone());
        let size = record.get(keys::MASK_SIZE).unwrap();
        assert!((1.0..8.0).contains(&size), "{size}");
        let obs: Vec<f32> = run.d_rl.arrays().1[0][..100 * 10].to_vec();
        let before = run.agent.dqn.params.with(<[f32]>::to_vec);
        assert!(run.agent.update_confidence(&obs, &[1; 100]).is_finite());
        assert_eq!(run.agent.dqn.params.with(<[f32]>::to_vec), before);

        let dir = tempfile::tempdir().unwrap();
        start(dir.path(), &config).unwrap();
        let mut stored = load_trained(dir.path(), Networks::Last).unwrap();
        let spec = gadm_envs::make("moving").unwrap().spec().clone();
        let model = float_model(&mut stored, &spec).unwrap();
        assert!(model.shared_trunk);
        let agent = stored.agent().unwrap();
        let (mut codes, mut action) = (Vec::new(), vec![0.0; spec.action_dim()]);
        agent.greedy(&obs, 100, &mut codes);
        let masks = agent.masks(&obs, 100).to_vec();
        let mut same = 0;
        for ((obs, code), mask) in obs.chunks(10).zip(codes).zip(masks.chunks(8)) {
            let decision = model.act(obs, &mut action);
            let alike = (0..8).all(|k| decision.allowed.contains(k) == mask[usize::from(k)]);
            same += usize::from(u32::from(decision.latent) == code && alike);
        }
        // Sums in another order may tip a score over the threshold.
        assert!(same >= 98, "{same} of 100");
    }
}

/// Braking uses neither argument: with the mask there is nothing continuous to reconstruct.
#[test]
fn the_argument_mask_leaves_out_what_a_type_does_not_use() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("braking.safetensors");
    let actions: Vec<f32> = (0..50).flat_map(|i| [2.0, (i % 7) as f32 / 7.0, (i % 5) as f32 / -5.0]).collect();
    write_arrays(&data, &[("obs", &[50, 10], &[0.5; 500]), ("actions", &[50, 3], &actions)]);
    let mut config = small("moving");
    config.warmup.data = Some(data);
    let reconstruction = |config: &TrainConfig| {
        let mut run = Run::new(config.clone()).unwrap();
        rounds(&mut run, 2);
        assert_eq!((run.counters.action_updates, run.counters.env_steps), (100, 0));
        run.record().get(keys::RECON_CONTINUOUS).unwrap()
    };
    assert_eq!(reconstruction(&config), 0.0);
    config.action_model.argument_mask = false;
    assert!(reconstruction(&config) > 0.01);
}

/// Specification 4.2: Moving's own limit ends the value; a limit that a wrapper adds does not.
#[test]
fn own_limits_terminate_and_added_limits_bootstrap() {
    let weights = |env: &str, limit: Option<u32>| {
        let mut config = small(env);
        config.warmup.enabled = false;
        config.env_options.time_limit = limit;
        (config.round.action_updates, config.round.confidence_updates, config.round.q_updates) = (0, 0, 0);
        (config.replay.rl_capacity, config.steps) = (10_000, 10_000);
        let mut run = Run::new(config).unwrap();
        while run.counters.episodes < 8 {
            rounds(&mut run, 1);
        }
        let (_, columns) = run.d_rl.arrays();
        let powers = [0.0, 0.99, 0.99_f64.powi(2), 0.99_f64.powi(3)].map(|g| g as f32);
        let counts = powers.map(|p| columns[4].iter().filter(|w| **w == p).count());
        assert_eq!(counts.iter().sum::<usize>(), run.d_rl.len(), "no other weight");
        (counts, run.counters.episodes as usize)
    };
    let ([ended, one, two, _], episodes) = weights("moving", None);
    assert_eq!((ended, one, two), (3 * episodes, 0, 0), "three starts reach each of the ends");
    let ([ended, one, two, _], episodes) = weights("pendulum", None);
    assert_eq!((ended, one, two), (0, episodes, episodes));
    let ([ended, one, two, _], episodes) = weights("moving", Some(5));
    assert_eq!((one, two), (episodes - ended / 3, episodes - ended / 3));
    assert!(one > 0);
}

/// The observations stored for the export are the newest ones, also where the buffer has wrapped around.
#[test]
fn calibration_takes_the_newest_half_by_age() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join(checkpoint::FOLDER)).unwrap();
    let mut run = Run::new(small("pendulum")).unwrap();
    // Row 120 is overwritten next, so it is the oldest; a row's first number is its age rank.
    let rank = |row: usize| ((row + 500 - 120) % 500) as f32;
    let obs: Vec<f32> = (0..500).flat_map(|row| [rank(row), 0.0, 0.0]).collect();
    let zeros = || vec![0.0; 500];
    assert!(run.d_rl.restore(120, &[obs.clone(), zeros(), zeros(), zeros(), zeros(), obs]));
    checkpoint::save(&run, dir.path()).unwrap();
    let calibration = checkpoint::load_trained(dir.path(), Networks::Last).unwrap().calibration;
    let ranks: Vec<f32> = calibration.chunks(3).map(|o| o[0]).collect();
    assert_eq!(ranks, (250..500).map(|r| r as f32).collect::<Vec<_>>());
}

#[test]
fn an_episode_shorter_than_the_horizon_is_summed_to_its_end() {
    let mut config = small("pendulum");
    config.warmup.enabled = false;
    config.env_options.time_limit = Some(2);
    config.dqn.n_step = 5;
    let mut run = Run::new(config).unwrap();
    rounds(&mut run, 4);
    assert_eq!(run.d_rl.len(), 128, "nothing is pending after an end");
    let (_, columns) = run.d_rl.arrays();
    let expected = [0.99_f32, 0.99_f64.powi(2) as f32];
    assert!(columns[4].iter().all(|w| expected.contains(w)));
}

#[test]
fn evaluation_does_not_disturb_training() {
    let (a, b) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let config = small("moving");
    let mut without = config.clone();
    without.track.eval_every = 0;
    start(&a.path().join("run"), &config).unwrap();
    start(&b.path().join("run"), &without).unwrap();
    let read = |dir: &std::path::Path| {
        let mut records = read_jsonl(&dir.join("run/metrics.jsonl")).unwrap();
        let evaluations = records.iter().filter(|(_, r)| r.contains_key(keys::EVAL_RETURN_MEAN)).count();
        for (_, values) in &mut records {
            values.retain(|key, _| !key.starts_with("eval_"));
        }
        (records, evaluations)
    };
    let ((with, many), (without, few)) = (read(a.path()), read(b.path()));
    assert!(many > few, "{many} and {few} evaluations");
    assert_eq!(with, without);
    assert_eq!(arrays(&last(&a.path().join("run"))).0, arrays(&last(&b.path().join("run"))).0);
}

#[test]
fn evaluation_episodes_are_no_training_episodes() {
    for seed in 0..20 {
        let config = TrainConfig { seed, ..TrainConfig::default() };
        let training = SeedTree::new(seed).number("environments");
        let seeds: HashSet<u64> =
            (0..16).flat_map(|env| (0..1000).map(move |e| gadm_envs::reset_seed(training, env, e))).collect();
        assert_eq!(seeds.len(), 16_000);
        assert!((0..1000).all(|e| !seeds.contains(&gadm_envs::episode_seed(evaluation_seed(&config), e))));
    }
}

/// A ReLU made of `f32::max` turns NaN into zero, and the loss stays finite on a broken batch.
#[test]
fn a_nan_in_a_batch_reaches_the_loss() {
    let spec = gadm_envs::make("pendulum").unwrap().spec().clone();
    let config = small("pendulum").action_model;
    let space = ActionSpace::new(&spec, ContinuousHead::Tanh, true);
    let mut model = ActionModel::new(config, 3, space, 8, &mut SeedTree::new(1).stream("nan")).unwrap();
    let mut obs = vec![0.25; 8 * 3];
    let actions = vec![0.5; 8];
    assert!(model.update(&obs, &actions).loss.is_finite());
    obs[4] = f32::NAN;
    assert!(!model.update(&obs, &actions).loss.is_finite());
}

#[test]
fn impossible_settings_are_named() {
    type Change = fn(&mut TrainConfig);
    let cases: &[(&str, Change)] = &[
        ("steps", |c| c.steps = 256),
        ("collect.envs", |c| c.collect.envs = 0),
        ("collect.steps_per_round", |c| c.collect.steps_per_round = 33),
        ("round.batch", |c| c.round.batch = 0),
        ("round.batch", |c| c.round.batch = 1),
        ("replay.rl_capacity", |c| c.replay.rl_capacity = 31),
        ("replay.ar_capacity", |c| c.replay.ar_capacity = 1),
        ("explore.epsilon_start", |c| c.explore.epsilon_start = 1.1),
        ("explore.extreme_noise", |c| c.explore.extreme_noise = f64::NAN),
        ("explore.epsilon_decay", |c| c.explore.epsilon_decay = f64::INFINITY),
        ("track.stop_at_return", |c| c.track.stop_at_return = Some(f64::NAN)),
        ("action_model.latents", |c| c.action_model.latents = 1),
        ("action_model.latents", |c| c.action_model.latents = 257),
        ("action_model.code_dim", |c| c.action_model.code_dim = 7),
        ("action_model.hidden", |c| c.action_model.hidden = 0),
        ("action_model.commitment", |c| c.action_model.commitment = -1.0),
        ("action_model.adam.learning_rate", |c| c.action_model.adam.learning_rate = f64::INFINITY),
        ("action_model.head.atoms", |c| {
            c.action_model.head = ContinuousHead::Categorical { atoms: 1, snap: SnapRule::Edges };
        }),
        ("confidence.hidden", |c| c.confidence.hidden = vec![16, 0]),
        ("confidence.shared_hidden", |c| {
            (c.confidence.trunk, c.confidence.shared_hidden) = (Trunk::Shared, vec![4, 4]);
        }),
        ("confidence.threshold", |c| c.confidence.threshold = 8.0),
        ("confidence.focal_gamma", |c| c.confidence.focal_gamma = f64::NAN),
        ("dqn.hidden", |c| c.dqn.hidden = vec![]),
        ("dqn.hidden", |c| c.dqn.hidden = vec![0]),
        ("dqn.heads", |c| c.dqn.heads = 0),
        ("dqn.gamma", |c| c.dqn.gamma = 1.01),
        ("dqn.n_step", |c| c.dqn.n_step = 0),
        ("dqn.target.tau", |c| c.dqn.target = TargetUpdate::Soft { tau: f64::NAN }),
        ("dqn.adam.beta2", |c| c.dqn.adam.beta2 = 1.0),
    ];
    for (expected, change) in cases {
        let mut config = small("moving");
        change(&mut config);
        let error = Run::new(config).err().unwrap_or_else(|| panic!("`{expected}` was accepted"));
        let TrainError::Config { key, .. } = &error else { panic!("{expected}: {error}") };
        assert_eq!(key, expected);
    }
}

/// The edges of what is allowed run, and stay finite.
#[test]
fn settings_at_the_edge_run() {
    type Change = fn(&mut TrainConfig);
    let cases: &[(&str, Change)] = &[
        ("one environment, one step a round", |c| (c.collect.envs, c.collect.steps_per_round) = (1, 1)),
        ("a round longer than the run", |c| c.collect.steps_per_round = 4096),
        ("256 latents", |c| c.action_model.latents = 256),
        ("two latents, one head", |c| (c.action_model.latents, c.dqn.heads) = (2, 1)),
        ("buffers of one batch", |c| (c.replay.rl_capacity, c.replay.ar_capacity) = (32, 32)),
        ("a batch above the chunk size", |c| {
            (c.round.batch, c.replay.rl_capacity, c.replay.ar_capacity) = (700, 700, 700);
        }),
        ("a batch of one", |c| (c.round.batch, c.action_model.standardise) = (1, false)),
        ("no hidden layer in the predictor", |c| c.confidence.hidden = vec![]),
        ("no layers after the fusion", |c| {
            (c.action_model.encoder_layers, c.action_model.decoder_layers) = (0, 0);
        }),
        ("a learned table", |c| (c.action_model.codetable, c.action_model.code_dim) = (Codetable::Learned, 3)),
        ("a bisection table", |c| (c.action_model.codetable, c.action_model.code_dim) = (Codetable::Bisection, 2)),
        ("the categorical head", |c| {
            c.action_model.head = ContinuousHead::Categorical { atoms: 2, snap: SnapRule::Any };
            c.action_model.two_hot_weight = 0.5;
        }),
        ("no discount", |c| c.dqn.gamma = 1.0),
        ("no future", |c| c.dqn.gamma = 0.0),
        ("a horizon above the episodes", |c| c.dqn.n_step = 300),
        ("no updates", |c| {
            (c.round.action_updates, c.round.confidence_updates, c.round.q_updates) = (0, 0, 0);
            (c.warmup.updates, c.warmup.confidence_updates) = (0, 0);
        }),
        ("no warm-up steps", |c| c.warmup.steps = 0),
    ];
    for env in ["moving", "pendulum"] {
        for (what, change) in cases {
            let mut config = small(env);
            change(&mut config);
            let mut run = Run::new(config).unwrap();
            while !run.finished() {
                run.round().unwrap().unwrap_or_else(|e| panic!("{env}, {what}: {} is not finite", e.what));
            }
            assert!(run.record().values.iter().all(|(_, v)| v.is_finite()), "{env}, {what}");
        }
    }
}
