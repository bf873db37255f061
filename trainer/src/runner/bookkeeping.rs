//! What every run keeps, whatever learns in it: counters, means since the last record, random streams, and the guard against
//! numbers that are not finite.

use gadm_envs::VecEnv;
use serde::{Deserialize, Serialize};

use crate::action_space::ActionSpace;
use crate::error::TrainError;
use crate::metrics::{Record, keys};
use crate::nn::Params;
use crate::replay::RlBatch;
use crate::seed::{Rng, SeedTree};

/// Counters of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Counters {
    /// Environment steps, warm-up included.
    pub env_steps: u64,
    /// Updates of the Q-network.
    pub q_updates: u64,
    /// Updates of the action model.
    pub action_updates: u64,
    /// Updates of the confidence predictor.
    pub confidence_updates: u64,
    /// Finished training episodes.
    pub episodes: u64,
    /// True once the warm-up is over.
    pub warm: bool,
    /// Highest mean return of an evaluation.
    pub best_return: Option<f64>,
    /// Mean return of the last evaluation.
    pub last_return: Option<f64>,
}

/// Sums since the last metric record.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Window {
    sums: Vec<(String, f64, u64)>,
    /// How often each latent was assigned in the action model's batches.
    pub code_counts: Vec<u64>,
}

impl Window {
    /// Nothing added yet, for that many latents.
    pub fn new(latents: usize) -> Self {
        Self { code_counts: vec![0; latents], ..Self::default() }
    }

    /// Adds a value to the mean of `key`.
    pub fn add(&mut self, key: &str, value: f64) {
        match self.sums.iter_mut().find(|(k, ..)| k == key) {
            Some(entry) => {
                entry.1 += value;
                entry.2 += 1;
            }
            None => self.sums.push((key.to_owned(), value, 1)),
        }
    }

    /// Mean of `key`, if it has values.
    pub fn mean(&self, key: &str) -> Option<f64> {
        self.sums.iter().find(|(k, ..)| k == key).map(|(_, sum, n)| sum / *n as f64)
    }

    /// Codes assigned at least once, and exp of the entropy of their shares.
    pub fn code_use(&self) -> (usize, f64) {
        let total: u64 = self.code_counts.iter().sum();
        let shares = self.code_counts.iter().filter(|c| **c > 0).map(|&c| c as f64 / total as f64);
        (shares.clone().count(), shares.map(|p| -p * p.ln()).sum::<f64>().exp())
    }
}

/// Random streams of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Streams {
    /// Actions of the warm-up.
    pub warmup: Rng,
    /// ε and latents drawn at random.
    pub explore: Rng,
    /// Extreme noise.
    pub noise: Rng,
    /// Batches from D_AR.
    pub sample_ar: Rng,
    /// Batches from D_RL.
    pub sample_rl: Rng,
}

impl Streams {
    /// At their beginning.
    pub fn new(seeds: SeedTree) -> Self {
        Self {
            warmup: seeds.stream("warmup"),
            explore: seeds.stream("explore"),
            noise: seeds.stream("noise"),
            sample_ar: seeds.stream("sample.ar"),
            sample_rl: seeds.stream("sample.rl"),
        }
    }
}

impl Counters {
    /// Updates of all networks so far.
    pub fn updates(&self) -> u64 {
        self.q_updates + self.action_updates + self.confidence_updates
    }
}

/// A loss, gradient or weight that is not a finite number, with the batch that gave it.
#[derive(Clone, Debug)]
pub struct NotFinite {
    /// Which number.
    pub what: &'static str,
    /// The batch: name, numbers per row, values.
    pub arrays: Vec<(&'static str, usize, Vec<f32>)>,
}

impl NotFinite {
    /// `what`, and the transitions that it came of.
    pub fn in_batch(what: &'static str, batch: &RlBatch, obs_dim: usize, slots: usize) -> Self {
        let arrays = [
            ("obs", obs_dim, &batch.obs),
            ("actions", slots, &batch.actions),
            ("returns", 1, &batch.returns),
            ("bootstrap", 1, &batch.bootstrap),
            ("next_obs", obs_dim, &batch.next_obs),
        ];
        Self { what, arrays: arrays.map(|(name, width, v)| (name, width, v.clone())).to_vec() }
    }
}

/// True where every parameter is a finite number.
pub fn finite(params: &Params) -> bool {
    params.with(|p| p.iter().all(|v| v.is_finite()))
}

/// Steps the environments with normalised `actions` and books finished episodes.
///
/// # Errors
/// Those of the environments.
pub fn step_environments(
    envs: &mut VecEnv,
    space: &ActionSpace,
    actions: &[f32],
    counters: &mut Counters,
    window: &mut Window,
) -> Result<(), TrainError> {
    let mut native = vec![0.0; actions.len()];
    for (a, n) in actions.chunks_exact(space.slots()).zip(native.chunks_exact_mut(space.slots())) {
        space.to_native(a, n);
    }
    for end in &envs.step(&native)?.ended {
        counters.episodes += 1;
        window.add(keys::EPISODE_RETURN, end.total_reward);
        window.add(keys::EPISODE_LENGTH, end.length as f64);
    }
    Ok(())
}

/// A record with the means of `keys` that `window` has.
pub fn push_means(record: &mut Record, window: &Window, keys: &[&'static str]) {
    for key in keys {
        if let Some(mean) = window.mean(key) {
            record.push(key, mean);
        }
    }
}
