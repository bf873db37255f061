//! What every environment promises: spaces, seeds, limits, restoring, and good errors.

use gadm_envs::{Env, EnvError, ids, make};
use gadm_runtime::space::ActionHead;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Ids of environments that this build holds.
fn built() -> impl Iterator<Item = &'static str> {
    ids().filter(|id| !matches!(make(id), Err(EnvError::Feature { .. })))
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

/// Observations and rewards of `steps` steps, resetting at ends.
fn run(env: &mut dyn Env, seed: u64, steps: usize) -> (Vec<u32>, Vec<u64>) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut obs = vec![0.0; env.spec().obs_dim()];
    let (mut all_obs, mut rewards) = (vec![], vec![]);
    let mut episode = seed;
    env.reset(episode, &mut obs);
    for _ in 0..steps {
        all_obs.extend(obs.iter().map(|o| o.to_bits()));
        let action = random_action(env, &mut rng);
        let step = env.step(&action, &mut obs);
        assert!(step.reward.is_finite() && obs.iter().all(|o| o.is_finite()), "{}: {step:?} {obs:?}", env.spec().id);
        rewards.push(step.reward.to_bits());
        if step.terminated || step.truncated {
            episode += 1;
            env.reset(episode, &mut obs);
        }
    }
    (all_obs, rewards)
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
