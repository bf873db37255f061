//! Runs of the baseline algorithms: the same numbers for the same seed, also across interruptions; evaluation from the folder; and
//! learning on small problems.

#![allow(clippy::unwrap_used, reason = "tests")]

mod runs;

use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

use gadm_trainer::algo::dqn::{DqnConfig, TargetUpdate};
use gadm_trainer::algo::hppo::HppoConfig;
use gadm_trainer::algo::listed::{DqnClusterConfig, DqnManualConfig, HeadLayout};
use gadm_trainer::algo::pdqn::{MpdqnConfig, PdqnConfig};
use gadm_trainer::algo::td3::Td3Config;
use gadm_trainer::config::{Algorithm, Layer, Schedule, TrainConfig, resolve::resolve, to_toml};
use gadm_trainer::nn::AdamConfig;
use gadm_trainer::runner::checkpoint::Networks;
use gadm_trainer::runner::train::evaluation_seed;
use gadm_trainer::runner::{checkpoint, evaluate, new_run};
use runs::{arrays, assert_same_run, assert_same_update, last, metrics, resume, start, write_arrays};

fn adam() -> AdamConfig {
    AdamConfig { learning_rate: 1e-3, grad_clip: 0.0, ..AdamConfig::default() }
}

/// A run that ends within a second; its replay buffer wraps around.
fn small(env: &str, algo: Algorithm) -> TrainConfig {
    let mut c = TrainConfig { env: env.to_owned(), algo, seed: 3, steps: 768, ..TrainConfig::default() };
    (c.track.log_every, c.track.eval_every, c.track.eval_episodes, c.track.checkpoint_every) = (64, 256, 2, 0);
    c
}

fn td3() -> Td3Config {
    let schedule = Schedule { envs: 2, steps_per_round: 4, updates: 4, batch: 32, capacity: 300, random_steps: 100 };
    Td3Config { schedule, hidden: vec![16, 16], ..Td3Config::default() }
}

/// Networks and schedule of a short run on a list of actions.
fn short(schedule: &mut Schedule, dqn: &mut DqnConfig) {
    *schedule = Schedule { envs: 2, steps_per_round: 4, updates: 2, batch: 32, capacity: 300, random_steps: 20 };
    (dqn.hidden, dqn.target) = (vec![16, 16], TargetUpdate::Hard { every: 7 });
}

fn manual(layout: HeadLayout) -> Algorithm {
    let mut own = DqnManualConfig { layout, ..DqnManualConfig::default() };
    short(&mut own.schedule, &mut own.dqn);
    Algorithm::DqnManual(own)
}

/// Three torques of the pendulum, each with a little wobble, as recorded by an expert.
fn expert() -> PathBuf {
    static FILES: AtomicUsize = AtomicUsize::new(0);
    let number = FILES.fetch_add(1, Ordering::Relaxed);
    let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("expert-{number}.safetensors"));
    let actions: Vec<f32> = (0..90_u16).map(|i| f32::from(i % 3) - 1.0).map(|a| 0.9 * a).collect();
    write_arrays(&path, &[("obs", &[90, 3], &[0.0; 270]), ("actions", &[90, 1], &actions)]);
    path
}

fn clusters() -> Algorithm {
    let mut own = DqnClusterConfig { data: Some(expert()), clusters: 3, ..DqnClusterConfig::default() };
    short(&mut own.schedule, &mut own.dqn);
    Algorithm::DqnCluster(own)
}

fn pdqn() -> PdqnConfig {
    let schedule = Schedule { envs: 2, steps_per_round: 8, updates: 6, batch: 32, capacity: 300, random_steps: 20 };
    PdqnConfig { schedule, hidden: vec![16, 8], q_block: 2, x_block: 2, ..PdqnConfig::default() }
}

fn mpdqn() -> Algorithm {
    Algorithm::Mpdqn(MpdqnConfig { pdqn: pdqn(), ..MpdqnConfig::default() })
}

fn hppo() -> Algorithm {
    let hidden = vec![16, 8];
    Algorithm::Hppo(HppoConfig { envs: 2, steps_per_round: 32, epochs: 2, batch: 16, hidden, ..HppoConfig::default() })
}

/// One of each algorithm, with an environment.
fn every_baseline() -> Vec<TrainConfig> {
    vec![
        small("pendulum", Algorithm::Td3(td3())),
        small("moving", manual(HeadLayout::Auto)),
        small("hard-move-4", manual(HeadLayout::Decoupled)),
        small("pendulum", clusters()),
        small("moving", Algorithm::Pdqn(pdqn())),
        small("moving", mpdqn()),
        small("hard-move-4", mpdqn()),
        small("moving", hppo()),
    ]
}

#[test]
fn the_same_configuration_gives_the_same_run_and_the_seed_counts() {
    for config in every_baseline() {
        let dirs = [0, 1, 2].map(|_| tempfile::tempdir().unwrap());
        let [a, b, other] = dirs.each_ref().map(|dir| dir.path().join("run"));
        start(&a, &config).unwrap();
        start(&b, &config).unwrap();
        assert_same_run(&a, &b);
        start(&other, &TrainConfig { seed: 4, ..config }).unwrap();
        assert_ne!(metrics(&a), metrics(&other));
    }
}

/// One update of each network per round, so that rounding has not had the time to grow.
#[test]
fn candle_on_a_device_gives_the_updates_of_the_fused_layers() {
    for mut config in every_baseline() {
        match &mut config.algo {
            // Adam would turn a gradient that is nothing but rounding into a whole step of the network that the other one reads.
            Algorithm::Td3(own) => (own.schedule.updates, own.policy_delay, own.critic_adam.epsilon) = (1, 1, 1e-2),
            Algorithm::DqnManual(own) => own.schedule.updates = 1,
            Algorithm::DqnCluster(own) => own.schedule.updates = 1,
            Algorithm::Pdqn(own) | Algorithm::Mpdqn(MpdqnConfig { pdqn: own, .. }) => {
                (own.schedule.updates, own.q_block, own.x_block, own.q_adam.epsilon) = (2, 1, 1, 1e-2);
            }
            Algorithm::Hppo(own) => (own.epochs, own.batch) = (1, own.steps_per_round),
            Algorithm::GadmDqn => unreachable!("no baseline"),
        }
        assert_same_update(&config);
    }
}

#[test]
fn an_interrupted_run_is_the_uninterrupted_one() {
    for config in every_baseline() {
        let dirs = [0, 1].map(|_| tempfile::tempdir().unwrap());
        let [whole, parts] = dirs.each_ref().map(|dir| dir.path().join("run"));
        start(&whole, &config).unwrap();
        // Between rounds and in every phase: the steps are no multiples of anything that is counted.
        start(&parts, &TrainConfig { steps: 60, ..config.clone() }).unwrap();
        for steps in [180, 412, 768] {
            resume(&parts, Some(&TrainConfig { steps, ..config.clone() })).unwrap();
        }
        let uninterrupted: Vec<_> = metrics(&whole).lines().map(str::to_owned).collect();
        let last = metrics(&parts).lines().last().unwrap().to_owned();
        assert!(uninterrupted.contains(&last), "{}: {last}", config.algo.name().id());
    }
}

#[test]
fn the_best_networks_of_a_folder_give_the_evaluation_of_training() {
    for mut config in every_baseline() {
        config.track.snapshots = vec![0, config.steps];
        let dir = tempfile::tempdir().unwrap();
        let run = dir.path().join("run");
        let outcome = start(&run, &config).unwrap();
        let mut trained = checkpoint::load_trained(&run, Networks::Best).unwrap();
        let again = evaluate(trained.actor(), &config.env, &config.env_options, 2, evaluation_seed(&config)).unwrap();
        assert_eq!(Some(again.mean()), outcome.best_return, "{}", config.algo.name().id());
        let mut last = checkpoint::load_trained(&run, Networks::Last).unwrap();
        let again = evaluate(last.actor(), &config.env, &config.env_options, 2, evaluation_seed(&config)).unwrap();
        assert_eq!(again.returns, outcome.last.unwrap().returns, "{}", config.algo.name().id());
        assert_eq!(checkpoint::snapshots(&run), [0, config.steps]);
        let mut kept = checkpoint::load_trained(&run, Networks::Snapshot(config.steps)).unwrap();
        let same = evaluate(kept.actor(), &config.env, &config.env_options, 2, evaluation_seed(&config)).unwrap();
        assert_eq!(same, again, "{}", config.algo.name().id());
        let refused = trained.agent().err().unwrap().to_string();
        assert!(refused.contains(config.algo.name().id()) && refused.contains("gadm eval"), "{refused}");
    }
}

/// Rule 8: an algorithm has a table of its own, and the tables of another are refused with both names.
#[test]
fn a_configuration_holds_the_tables_of_its_algorithm_only() {
    let set = |words: &[&str]| {
        let layers: Vec<_> = words.iter().map(|word| Layer::Set((*word).to_owned())).collect();
        resolve::<TrainConfig>(&layers)
    };
    for config in every_baseline() {
        let id = config.algo.name().id();
        let config = set(&[&format!("algo={id}"), "env=pendulum"]).unwrap();
        let (text, table) = (to_toml(&config).unwrap(), id.replace('-', "_"));
        assert!(text.contains(&format!("algo = \"{id}\"\n")) && text.contains(&format!("\n[{table}]\n")), "{text}");
        for other in ["[dqn]", "[action_model]", "[round]"] {
            assert!(!text.contains(other), "{text}");
        }
        let layer = Layer::Toml { origin: "config.toml".to_owned(), text };
        assert_eq!(resolve::<TrainConfig>(&[layer]).unwrap(), config, "what is written is read back");
        let refused = set(&[&format!("algo={id}"), "dqn.gamma=0.9"]).unwrap_err().to_string();
        assert!(refused.contains("[dqn]") && refused.contains("gadm-dqn") && refused.contains(id), "{refused}");
        let back = set(&[&format!("algo={id}"), "algo=gadm-dqn", "dqn.gamma=0.9"]).unwrap();
        assert_eq!((back.algo, back.dqn.gamma), (Algorithm::GadmDqn, 0.9));
    }
    let refused = set(&["td3.gamma=0.9"]).unwrap_err().to_string();
    assert!(refused.contains("td3") && refused.contains("gadm-dqn"), "{refused}");
    let Algorithm::Td3(own) = set(&["algo=td3", "td3.gamma=0.9"]).unwrap().algo else { panic!("not TD3") };
    assert_eq!(own, Td3Config { gamma: 0.9, ..Td3Config::default() });
}

/// Trains to the end and returns the mean return of 20 episodes before and after.
fn learned(config: &TrainConfig) -> (f64, f64) {
    let mut run = new_run(config.clone()).unwrap();
    let score = |actor: &mut dyn gadm_trainer::algo::Actor| {
        evaluate(actor, &config.env, &config.env_options, 20, 99).unwrap().mean()
    };
    let before = score(run.actor());
    while !run.finished() {
        run.round().unwrap().unwrap();
    }
    (before, score(run.actor()))
}

/// Swinging up and staying there gives about -150; an untrained policy gets -1,000 or less.
#[test]
fn td3_learns_to_hold_the_pendulum() {
    let schedule = Schedule { batch: 100, random_steps: 1_000, ..Td3Config::default().schedule };
    let own =
        Td3Config { schedule, hidden: vec![64, 64], actor_adam: adam(), critic_adam: adam(), ..Td3Config::default() };
    let config = TrainConfig { steps: 8_000, ..small("pendulum", Algorithm::Td3(own)) };
    let (before, after) = learned(&config);
    assert!(before < -800.0 && after > -300.0, "{before} -> {after}");
}

/// A checkpoint carries the centres: resuming and evaluating need the expert's file no more.
#[test]
fn centres_come_from_the_expert_and_stay_with_the_run() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("run");
    let mut config = small("pendulum", clusters());
    let gone = dir.path().join("expert.safetensors");
    std::fs::rename(expert(), &gone).unwrap();
    let Algorithm::DqnCluster(own) = &mut config.algo else { panic!("not clusters") };
    own.data = Some(gone.clone());
    start(&run, &TrainConfig { steps: 100, ..config.clone() }).unwrap();
    std::fs::remove_file(&gone).unwrap();
    resume(&run, Some(&config)).unwrap();
    let mut centres: Vec<f32> = arrays(&last(&run)).0["actions/actions"].1.iter().map(|b| f32::from_bits(*b)).collect();
    centres.sort_by(f32::total_cmp);
    assert!(centres.iter().zip([-0.9, 0.0, 0.9]).all(|(a, b)| (a - b).abs() < 1e-6), "{centres:?}");
    let error = start(&dir.path().join("other"), &config).unwrap_err().to_string();
    assert!(error.contains("expert.safetensors"), "{error}");
}

/// Three torques hold the pendulum, from a list and from one group of outputs.
#[test]
fn dqn_on_bins_learns_to_hold_the_pendulum() {
    for layout in [HeadLayout::Flat, HeadLayout::Decoupled] {
        let mut own = DqnManualConfig { layout, ..DqnManualConfig::default() };
        own.schedule =
            Schedule { envs: 4, steps_per_round: 32, updates: 32, batch: 64, capacity: 20_000, random_steps: 0 };
        (own.dqn.hidden, own.dqn.gamma, own.dqn.adam) = (vec![64, 64], 0.95, adam());
        (own.dqn.target, own.epsilon.decay) = (TargetUpdate::Soft { tau: 0.01 }, 2_000.0);
        let config = TrainConfig { steps: 12_000, ..small("pendulum", Algorithm::DqnManual(own)) };
        let (before, after) = learned(&config);
        assert!(before < -800.0 && after > -400.0, "{layout:?}: {before} -> {after}");
    }
}
