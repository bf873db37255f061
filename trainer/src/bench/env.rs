//! Environment steps per second: random actions, observation, reward, end test and reset included.

use gadm_envs::{EnvOptions, VecEnv, make_with};
use rand::RngExt as _;

use super::{Label, Timing, repeat};
use crate::action_space::{ActionSpace, ContinuousHead};
use crate::error::TrainError;
use crate::seed::SeedTree;

/// Steps `envs` environments on `threads` threads for `seconds`. The actions are drawn beforehand, as the peers do it.
///
/// # Errors
/// Where the environment cannot be made or stepped.
pub fn step(id: &str, envs: usize, threads: usize, seconds: f64) -> Result<Timing, TrainError> {
    let options = EnvOptions::default();
    let made = (0..envs).map(|_| make_with(id, &options)).collect::<Result<Vec<_>, _>>()?;
    let mut row = VecEnv::from_envs(made, 1, threads)?;
    let space = ActionSpace::new(row.spec(), ContinuousHead::Tanh, false);
    let mut rng = SeedTree::new(1).stream("bench");
    let sets = 64;
    let mut actions = vec![0.0; sets * envs * space.slots()];
    let mut drawn = vec![0.0; space.slots()];
    for native in actions.chunks_exact_mut(space.slots()) {
        space.random(&mut rng, &mut drawn);
        space.to_native(&drawn, native);
    }
    let label =
        Label { case: "env", what: format!("{id}, {envs} environments, random actions"), unit: "steps", flop: 0.0 };
    let mut failed = None;
    let each = envs * space.slots();
    let timing = repeat(&label, threads, seconds, || {
        let at = rng.random_range(0..sets) * each;
        if let Err(error) = row.step(&actions[at..at + each]) {
            failed = Some(error);
        }
        envs as u64
    });
    match failed {
        Some(error) => Err(error.into()),
        None => Ok(timing),
    }
}
