//! The configuration of a training run: one TOML file, every key documented, unknown keys refused.

mod algorithm;
pub mod builtin;
pub mod resolve;
mod stored;

use std::path::PathBuf;

use gadm_envs::EnvOptions;
use serde::{Deserialize, Serialize};

pub use algorithm::{ALGORITHMS, Algorithm, AlgorithmName, EpsilonConfig, Schedule};
pub use resolve::{ConfigError, Layer, config_hash, to_toml};

use crate::algo::dqn::DqnConfig;
use crate::discretizer::gadm::{ActionModelConfig, ConfidenceConfig};
use crate::error::TrainError;

/// Collection of transitions (specification 4.5).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CollectConfig {
    /// Environments stepped side by side.
    pub envs: usize,
    /// Environment steps per round, over all environments; a multiple of `envs`.
    pub steps_per_round: usize,
}

impl Default for CollectConfig {
    fn default() -> Self {
        Self { envs: 8, steps_per_round: 256 }
    }
}

/// Pre-training of the action model (paper, algorithm 1, lines 1 to 9).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WarmupConfig {
    /// False skips the whole phase (ablation).
    pub enabled: bool,
    /// Environment steps with uniformly random actions; they count as steps of the run.
    pub steps: u64,
    /// Updates of the action model.
    pub updates: u64,
    /// Updates of the confidence predictor.
    pub confidence_updates: u64,
    /// A safetensors file with `obs` (N x O) and `actions` (N x slots, normalised) to use instead of random steps.
    pub data: Option<PathBuf>,
    /// Keep the warm-up data in D_AR afterwards (paper) or discard it (the authors' code).
    pub keep: bool,
}

impl Default for WarmupConfig {
    fn default() -> Self {
        Self { enabled: true, steps: 50_000, updates: 10_000, confidence_updates: 10_000, data: None, keep: true }
    }
}

/// Updates per round, in the order of the phases AR, LACP, RL.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RoundConfig {
    /// Updates of the action model, U_AR. The paper has 50; fewer suffice (specification 2.10).
    pub action_updates: u64,
    /// Updates of the confidence predictor, U_LACP.
    pub confidence_updates: u64,
    /// Updates of the Q-network, U_RL.
    pub q_updates: u64,
    /// Rows per update.
    pub batch: usize,
    /// Assign a latent to every sampled action anew (latent action remapping); false trains on the latent of collection time.
    pub remap: bool,
    /// Which latent that is.
    pub assign: Assignment,
}

impl Default for RoundConfig {
    fn default() -> Self {
        Self {
            action_updates: 50,
            confidence_updates: 10,
            q_updates: 50,
            batch: 512,
            remap: true,
            assign: Assignment::Encoded,
        }
    }
}

/// The latent that a stored action gets when it is remapped.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Assignment {
    /// The encoder's (paper).
    #[default]
    Encoded,
    /// The encoder's or the one chosen at collection, whichever decodes nearer to the stored action; the chosen one where both
    /// are as near. What a latent does is then learned for that latent, even where the encoder puts its action elsewhere.
    Nearest,
}

/// What an ε-random choice is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RandomChoice {
    /// A latent, all K equally likely (paper).
    #[default]
    Latent,
    /// A raw action, every type, switch and value equally likely; remapping gives it its latent. Needs `round.remap`.
    Action,
}

/// Exploration (specification 4.4).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ExploreConfig {
    /// ε at step 0.
    pub epsilon_start: f64,
    /// ε in the limit.
    pub epsilon_end: f64,
    /// Environment steps in which the difference falls to 1/e.
    pub epsilon_decay: f64,
    /// What a random choice draws from.
    pub random: RandomChoice,
    /// Probability that the continuous part of an action is replaced by coins in {-1, +1}, drawn per environment.
    pub extreme_noise: f64,
    /// Standard deviation σ of Gaussian noise on the continuous part (normalised), cut to ±0.5 before it is added; 0 is none. The
    /// alternative to extreme noise in the paper's figure 11; the authors' code had 0.1.
    pub gaussian_noise: f64,
}

impl Default for ExploreConfig {
    fn default() -> Self {
        Self {
            epsilon_start: 1.0,
            epsilon_end: 0.05,
            epsilon_decay: 1e5,
            random: RandomChoice::Latent,
            extreme_noise: 0.0,
            gaussian_noise: 0.0,
        }
    }
}

/// Replay buffers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReplayConfig {
    /// Transitions in D_RL.
    pub rl_capacity: usize,
    /// Pairs in D_AR.
    pub ar_capacity: usize,
}

impl Default for ReplayConfig {
    fn default() -> Self {
        Self { rl_capacity: 1_000_000, ar_capacity: 1_000_000 }
    }
}

/// Evaluation, logging and checkpoints; none of it changes what is learned.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrackConfig {
    /// Environment steps between evaluations; 0 for none.
    pub eval_every: u64,
    /// Episodes per evaluation.
    pub eval_episodes: usize,
    /// Environment steps between metric records.
    pub log_every: u64,
    /// Environment steps between checkpoints; 0 for one at the end only.
    pub checkpoint_every: u64,
    /// Stop once an evaluation's mean return reaches this.
    pub stop_at_return: Option<f64>,
    /// Environment steps at which the networks are kept for good, each at the end of the round that reaches it; 0 is before the
    /// first step. Not in a file that names none: what was written before there was this key stays the same.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub snapshots: Vec<u64>,
    /// Step τ of running averages of all networks of GADM + DQN, once a round: `average += τ (network - average)`. Evaluations,
    /// snapshots and exported policies are then those of the averages; what is learned stays the same. 0: no averages.
    #[serde(skip_serializing_if = "is_zero")]
    pub average: f64,
}

/// For a key that is not in a file that does not use it.
#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it so")]
fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

impl Default for TrackConfig {
    fn default() -> Self {
        Self {
            eval_every: 25_000,
            eval_episodes: 10,
            log_every: 5_000,
            checkpoint_every: 100_000,
            stop_at_return: None,
            snapshots: Vec::new(),
            average: 0.0,
        }
    }
}

/// A training run. The tables from `collect` to `dqn` are those of [`Algorithm::GadmDqn`]; every other algorithm has one table
/// of its own, and neither is accepted beside the other.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "stored::Stored", into = "stored::Stored")]
pub struct TrainConfig {
    /// Environment id (`gadm env list`).
    pub env: String,
    /// What learns, with its own settings.
    pub algo: Algorithm,
    /// Seed of every random stream.
    pub seed: u64,
    /// Environment steps, warm-up included.
    pub steps: u64,
    /// Options of the environment.
    pub env_options: EnvOptions,
    /// Collection.
    pub collect: CollectConfig,
    /// Pre-training.
    pub warmup: WarmupConfig,
    /// Updates.
    pub round: RoundConfig,
    /// Exploration.
    pub explore: ExploreConfig,
    /// Replay buffers.
    pub replay: ReplayConfig,
    /// Action model.
    pub action_model: ActionModelConfig,
    /// Confidence predictor.
    pub confidence: ConfidenceConfig,
    /// Q-network.
    pub dqn: DqnConfig,
    /// Evaluation, logging, checkpoints.
    pub track: TrackConfig,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            env: "inverted-pendulum-v5".to_owned(),
            algo: Algorithm::GadmDqn,
            seed: 0,
            steps: 1_000_000,
            env_options: EnvOptions::default(),
            collect: CollectConfig::default(),
            warmup: WarmupConfig::default(),
            round: RoundConfig::default(),
            explore: ExploreConfig::default(),
            replay: ReplayConfig::default(),
            action_model: ActionModelConfig::default(),
            confidence: ConfidenceConfig::default(),
            dqn: DqnConfig::default(),
            track: TrackConfig::default(),
        }
    }
}

impl TrainConfig {
    /// Checks what no single key can show.
    ///
    /// # Errors
    /// [`TrainError::Config`] with key, expected and found.
    pub fn validate(&self) -> Result<(), TrainError> {
        let positive = |key: &str, value: usize| {
            if value == 0 { Err(TrainError::config(key, "at least 1", value)) } else { Ok(()) }
        };
        positive("track.eval_episodes", self.track.eval_episodes)?;
        positive("track.log_every", self.track.log_every as usize)?;
        if self.algo != Algorithm::GadmDqn {
            return self.algo.validate();
        }
        positive("collect.envs", self.collect.envs)?;
        positive("round.batch", self.round.batch)?;
        let CollectConfig { envs, steps_per_round } = self.collect;
        if steps_per_round == 0 || !steps_per_round.is_multiple_of(envs) {
            return Err(TrainError::config(
                "collect.steps_per_round",
                &format!("a multiple of collect.envs = {envs}"),
                steps_per_round,
            ));
        }
        for (key, value) in [
            ("explore.epsilon_start", self.explore.epsilon_start),
            ("explore.epsilon_end", self.explore.epsilon_end),
            ("explore.extreme_noise", self.explore.extreme_noise),
        ] {
            if !(0.0..=1.0).contains(&value) {
                return Err(TrainError::config(key, "a probability, 0 to 1", value));
            }
        }
        let sigma = self.explore.gaussian_noise;
        if !(sigma.is_finite() && sigma >= 0.0) {
            return Err(TrainError::config("explore.gaussian_noise", "a finite number, at least 0", sigma));
        }
        if self.explore.epsilon_decay.is_nan() || self.explore.epsilon_decay <= 0.0 {
            return Err(TrainError::config("explore.epsilon_decay", "above 0", self.explore.epsilon_decay));
        }
        Ok(())
    }
}
