//! What every environment promises: spaces, seeds, limits, restoring, and good errors.
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use std::collections::BTreeSet;

use gadm_envs::{ArgumentMask, Env, EnvError, EnvOptions, EnvState, StartState, ToyOptions, ids, make, make_with};
use gadm_runtime::space::ActionHead;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Ids of environments that this build holds.
fn built() -> Vec<&'static str> {
    ids().filter(|id| !matches!(make(id), Err(EnvError::Feature { .. }))).collect()
}

fn random_action(env: &dyn Env, rng: &mut ChaCha8Rng) -> Vec<f32> {
    env.spec()
        .actions
        .iter()
        .map(|signal| match signal.head {
            ActionHead::Continuous { .. } => signal.head.denormalise(rng.random_range(-1.0..=1.0)),
            ActionHead::Discrete { n } => f32::from(rng.random_range(0..n)),
            ActionHead::Binary => f32::from(u8::from(rng.random::<bool>())),
        })
        .collect()
}

/// Bits of all observations and rewards of `steps` steps from the running episode; episodes follow one another.
fn go_on(env: &mut dyn Env, rng: &mut ChaCha8Rng, mut episode: u64, steps: usize) -> Vec<u64> {
    let mut obs = vec![0.0; env.spec().obs_dim()];
    let mut trace = vec![];
    for _ in 0..steps {
        let action = random_action(env, rng);
        let step = env.step(&action, &mut obs);
        assert!(step.reward.is_finite() && obs.iter().all(|o| o.is_finite()), "{}: {step:?} {obs:?}", env.spec().id);
        trace.push(step.reward.to_bits());
        trace.extend(obs.iter().map(|o| u64::from(o.to_bits())));
        if step.terminated || step.truncated {
            episode += 1;
            env.reset(episode, &mut obs);
            trace.extend(obs.iter().map(|o| u64::from(o.to_bits())));
        }
    }
    trace
}

fn run(env: &mut dyn Env, seed: u64, steps: usize) -> Vec<u64> {
    let mut obs = vec![0.0; env.spec().obs_dim()];
    env.reset(seed, &mut obs);
    let mut trace: Vec<u64> = obs.iter().map(|o| u64::from(o.to_bits())).collect();
    trace.extend(go_on(env, &mut ChaCha8Rng::seed_from_u64(seed), seed, steps));
    trace
}

#[test]
fn specs_are_sound() {
    let dims = [
        ("toy-env", 4, 2),
        ("moving", 10, 3),
        ("sliding", 10, 3),
        ("hard-move-4", 10, 8),
        ("hard-move-10", 10, 20),
        ("pendulum", 3, 1),
        ("lunar-lander", 8, 1),
        ("lunar-lander-continuous", 8, 2),
        ("hopper-v4", 11, 3),
        ("hopper-v5", 11, 3),
        ("half-cheetah-v4", 17, 6),
        ("half-cheetah-v5", 17, 6),
        ("walker2d-v4", 17, 6),
        ("walker2d-v5", 17, 6),
        ("ant-v4", 27, 8),
        ("ant-v4-contact", 111, 8),
        ("ant-v5", 105, 8),
        ("humanoid-v4", 376, 17),
        ("humanoid-v5", 348, 17),
        ("inverted-pendulum-v4", 4, 1),
        ("inverted-pendulum-v5", 4, 1),
    ];
    for id in built() {
        let env = make(id).unwrap();
        let spec = env.spec();
        assert_eq!(spec.id, id);
        if let Some((_, obs, act)) = dims.iter().find(|(known, ..)| *known == id) {
            assert_eq!((spec.obs_dim(), spec.action_dim()), (*obs, *act), "{id}");
        }
        let names: BTreeSet<_> = spec.observations.iter().map(|s| &s.name).collect();
        assert_eq!(names.len(), spec.obs_dim(), "{id}: observation names");
        let names: BTreeSet<_> = spec.actions.iter().map(|s| &s.name).collect();
        assert_eq!(names.len(), spec.action_dim(), "{id}: action names");
        assert!(spec.observations.iter().all(|s| s.lo < s.hi && !s.unit.is_empty()), "{id}: ranges");
        for action in &spec.actions {
            let legal = match action.head {
                ActionHead::Continuous { lo, hi } => lo < hi && (lo..=hi).contains(&action.safe),
                ActionHead::Discrete { n } => action.safe.fract() == 0.0 && (0.0..f32::from(n)).contains(&action.safe),
                ActionHead::Binary => action.safe == 0.0 || action.safe == 1.0,
            };
            assert!(legal, "{id}: {action:?}");
        }
        let continuous: Vec<_> = spec.actions.iter().map(|a| matches!(a.head, ActionHead::Continuous { .. })).collect();
        assert!(continuous.is_sorted(), "{id}: discrete heads come first");
        let numbers = continuous.iter().filter(|c| **c).count();
        match &spec.argument_mask {
            ArgumentMask::All => assert_eq!(numbers, spec.action_dim(), "{id}"),
            ArgumentMask::ByType(mask) => assert!(mask.iter().all(|row| row.len() == numbers), "{id}"),
            ArgumentMask::BySwitch => assert_eq!(2 * numbers, spec.action_dim(), "{id}"),
        }
    }
}

#[test]
fn the_same_seed_gives_the_same_bits_and_another_seed_another_episode() {
    for id in built() {
        let (mut a, mut b) = (make(id).unwrap(), make(id).unwrap());
        let first = run(&mut *a, 3, 300);
        assert_eq!(first, run(&mut *b, 3, 300), "{id}");
        assert_eq!(first, run(&mut *a, 3, 300), "{id}: used environment");
        assert_ne!(first, run(&mut *a, 4, 300), "{id}");
    }
}

#[test]
fn a_restored_environment_goes_on_bit_for_bit() {
    for id in built() {
        for before in [0, 1, 7, 40] {
            let mut original = make(id).unwrap();
            run(&mut *original, 11, before);
            let state = original.state();
            let text = serde_json::to_string(&state).unwrap();
            let mut copy = make(id).unwrap();
            run(&mut *copy, 99, 13); // somewhere else
            copy.restore(&serde_json::from_str(&text).unwrap()).unwrap();
            assert_eq!(copy.state(), state, "{id}: state of the copy");
            let rng = ChaCha8Rng::seed_from_u64(5);
            let expected = go_on(&mut *original, &mut rng.clone(), 1000, 120);
            assert_eq!(go_on(&mut *copy, &mut rng.clone(), 1000, 120), expected, "{id} restored after {before} steps");
        }
    }
}

#[test]
fn a_foreign_state_is_refused_with_its_size() {
    for id in built() {
        let mut env = make(id).unwrap();
        let (empty, good) = (EnvState::default(), env.state());
        let mut long = good.clone();
        long.reals.push(0.0);
        for bad in [&empty, &long] {
            let error = env.restore(bad).unwrap_err();
            assert!(matches!(error, EnvError::State { .. }), "{id}: {error}");
        }
        if !good.reals.is_empty() {
            let mut nan = good.clone();
            nan.reals[0] = f64::NAN;
            assert!(matches!(env.restore(&nan), Err(EnvError::StateValue { .. })), "{id}");
        }
        env.restore(&good).unwrap();
    }
    let mut toy = make("toy-env").unwrap();
    let error = toy.restore(&EnvState { reals: vec![], counts: vec![4, 0] }).unwrap_err();
    assert_eq!(error.to_string(), "state does not fit environment `toy-env`: state number: expected 0 to 3, found 4");
}

/// Number of steps of an episode of safe actions, and how it ended.
fn length(env: &mut dyn Env, seed: u64) -> (u32, bool, bool) {
    let mut obs = vec![0.0; env.spec().obs_dim()];
    let safe: Vec<f32> = env.spec().actions.iter().map(|a| a.safe).collect();
    env.reset(seed, &mut obs);
    for n in 1.. {
        let step = env.step(&safe, &mut obs);
        if step.terminated || step.truncated {
            return (n, step.terminated, step.truncated);
        }
    }
    unreachable!("the loop has no end")
}

#[test]
fn time_limits_are_the_references() {
    assert_eq!(length(&mut *make("toy-env").unwrap(), 0), (100, false, true));
    assert_eq!(length(&mut *make("pendulum").unwrap(), 0), (200, false, true));
    // Their own limits are observed and terminate.
    assert_eq!(length(&mut *make("moving").unwrap(), 0), (201, true, false));
    assert_eq!(length(&mut *make("sliding").unwrap(), 0), (201, true, false));
    assert_eq!(length(&mut *make("hard-move-4").unwrap(), 2), (26, true, false));
    if cfg!(feature = "mujoco") {
        assert_eq!(length(&mut *make("half-cheetah-v5").unwrap(), 0), (1000, false, true));
    }
    for id in built() {
        let mut env = make_with(id, &EnvOptions { time_limit: Some(1), ..EnvOptions::default() }).unwrap();
        assert_eq!(env.spec().time_limit, Some(1));
        let (n, _, truncated) = length(&mut *env, 5);
        assert_eq!((n, truncated), (1, true), "{id}");
    }
}

#[test]
fn extra_dimensions_change_nothing() {
    for id in built() {
        let options = EnvOptions { extra_dims: 2, ..EnvOptions::default() };
        if make(id).unwrap().spec().argument_mask != ArgumentMask::All {
            let error = make_with(id, &options).err().unwrap();
            assert!(error.to_string().contains("extra_dims"), "{error}");
            continue;
        }
        let (mut plain, mut wide) = (make(id).unwrap(), make_with(id, &options).unwrap());
        let n = plain.spec().action_dim();
        assert_eq!(wide.spec().action_dim(), n + 2);
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let (mut a, mut b) = (vec![0.0; plain.spec().obs_dim()], vec![0.0; plain.spec().obs_dim()]);
        plain.reset(1, &mut a);
        wide.reset(1, &mut b);
        for _ in 0..20 {
            let action = random_action(&*wide, &mut rng);
            assert_eq!(plain.step(&action[..n], &mut a), wide.step(&action, &mut b), "{id}");
            assert_eq!(a, b, "{id}");
        }
    }
}

#[test]
fn options_come_from_a_config_and_typos_are_refused() {
    let options: EnvOptions = serde_json::from_str(r#"{"time_limit": 5, "toy": {"start": "uniform"}}"#).unwrap();
    let toy = ToyOptions { start: StartState::Uniform, ..ToyOptions::default() };
    assert_eq!(options, EnvOptions { time_limit: Some(5), toy, ..EnvOptions::default() });
    assert!(serde_json::from_str::<EnvOptions>(r#"{"time_limits": 5}"#).is_err());
    let none = make_with("moving", &EnvOptions { time_limit: Some(0), ..EnvOptions::default() });
    assert_eq!(
        none.err().unwrap().to_string(),
        "environment `moving`: option `time_limit`: expected at least 1, found 0"
    );
}

#[test]
fn an_unknown_id_gets_the_nearest_one() {
    for (typo, meant) in [
        ("hoper-v5", "hopper-v5"),
        ("InvertedPendulum-v5", "inverted-pendulum-v5"),
        ("HalfCheetah-v4", "half-cheetah-v4"),
        ("Moving-v0", "moving"),
        ("LunarLanderContinuous-v3", "lunar-lander-continuous"),
        ("hard_move_7", "hard-move-7"),
        ("hopper", "hopper-v4"),
    ] {
        let error = make(typo).err().unwrap().to_string();
        assert!(
            error.contains(&format!("unknown environment `{typo}` (did you mean `{meant}`?); known: toy-env, ")),
            "{error}"
        );
    }
    let error = make("breakout").err().unwrap().to_string();
    assert!(!error.contains("did you mean") && error.contains("inverted-pendulum-v5"), "{error}");
}

#[cfg(not(feature = "mujoco"))]
#[test]
fn without_the_feature_a_mujoco_id_says_what_is_missing() {
    let error = make("hopper-v5").err().unwrap().to_string();
    assert!(error.contains("`hopper-v5` needs the cargo feature `mujoco`"), "{error}");
}

#[cfg(not(feature = "box2d"))]
#[test]
fn without_the_feature_a_lander_says_what_is_missing() {
    let error = make("lunar-lander").err().unwrap().to_string();
    assert!(error.contains("`lunar-lander` needs the cargo feature `box2d`"), "{error}");
}

/// One environment of each kind, made once per thread: MuJoCo models take a while to load.
fn one_of_each() -> Vec<Box<dyn Env>> {
    let kinds = [
        "toy-env",
        "moving",
        "sliding",
        "hard-move-5",
        "pendulum",
        "lunar-lander",
        "lunar-lander-continuous",
        "hopper-v5",
        "ant-v5",
        "inverted-pendulum-v4",
    ];
    built().into_iter().filter(|id| kinds.contains(id)).map(|id| make(id).unwrap()).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// Any f32 is a legal action: it acts like the nearest value in range, and never spoils an observation.
    #[test]
    fn any_action_acts_like_its_clamped_one(seed: u64, raw in prop::collection::vec(any::<f32>(), 32)) {
        for mut env in one_of_each() {
            let mut obs = vec![0.0; env.spec().obs_dim()];
            let n = env.spec().action_dim();
            let clamped: Vec<f32> = env.spec().actions.iter().zip(&raw).map(|(signal, &a)| match signal.head {
                _ if a.is_nan() => signal.safe,
                ActionHead::Continuous { lo, hi } => a.max(lo).min(hi),
                ActionHead::Discrete { n } => a.round().max(0.0).min(f32::from(n - 1)),
                ActionHead::Binary => if a >= 0.5 { 1.0 } else { 0.0 },
            }).collect();
            env.reset(seed, &mut obs);
            let start = env.state();
            let step = env.step(&raw[..n], &mut obs);
            prop_assert!(step.reward.is_finite() && obs.iter().all(|o| o.is_finite()));
            env.restore(&start).unwrap();
            let mut again = obs.clone();
            prop_assert_eq!(env.step(&clamped, &mut again), step);
            prop_assert_eq!(again, obs);
        }
    }
}
