//! What learns: one variant per algorithm, each with its own settings.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::algo::hppo::HppoConfig;
use crate::algo::listed::{DqnClusterConfig, DqnManualConfig};
use crate::algo::pdqn::{MpdqnConfig, PdqnConfig};
use crate::algo::td3::Td3Config;
use crate::error::TrainError;

/// What learns.
#[derive(Clone, Debug, Default, PartialEq)]
#[allow(clippy::large_enum_variant, reason = "one of them in a run")]
pub enum Algorithm {
    /// GADM with masked double DQN on its latents, online (paper, algorithm 1).
    #[default]
    GadmDqn,
    /// Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018).
    Td3(Td3Config),
    /// Double DQN on hand-made bins (specification 7.2).
    DqnManual(DqnManualConfig),
    /// Double DQN on the centres of an expert's actions (specification 8.7).
    DqnCluster(DqnClusterConfig),
    /// PDQN (Xiong et al. 2018).
    Pdqn(PdqnConfig),
    /// Multi-pass PDQN (Bester et al. 2019).
    Mpdqn(MpdqnConfig),
    /// PPO with types and arguments (Fan et al. 2019).
    Hppo(HppoConfig),
}

/// Name of an algorithm, as `algo` holds it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AlgorithmName {
    /// [`Algorithm::GadmDqn`].
    #[default]
    GadmDqn,
    /// [`Algorithm::Td3`].
    Td3,
    /// [`Algorithm::DqnManual`].
    DqnManual,
    /// [`Algorithm::DqnCluster`].
    DqnCluster,
    /// [`Algorithm::Pdqn`].
    Pdqn,
    /// [`Algorithm::Mpdqn`].
    Mpdqn,
    /// [`Algorithm::Hppo`].
    Hppo,
}

impl AlgorithmName {
    /// As a configuration has it.
    pub fn id(self) -> &'static str {
        match self {
            Self::GadmDqn => "gadm-dqn",
            Self::Td3 => "td3",
            Self::DqnManual => "dqn-manual",
            Self::DqnCluster => "dqn-cluster",
            Self::Pdqn => "pdqn",
            Self::Mpdqn => "mpdqn",
            Self::Hppo => "hppo",
        }
    }
}

/// Every algorithm as it is named in a configuration, with one line about it.
pub const ALGORITHMS: &[(&str, &str)] = &[
    ("gadm-dqn", "learned latent actions with masked double DQN (any action space)"),
    ("td3", "TD3 (continuous actions)"),
    ("dqn-manual", "double DQN on hand-made bins (any action space)"),
    ("dqn-cluster", "double DQN on the centres of an expert's actions (continuous actions)"),
    ("pdqn", "PDQN (types or switches with arguments)"),
    ("mpdqn", "multi-pass PDQN (types or switches with arguments)"),
    ("hppo", "PPO (types or switches with arguments)"),
];

impl Algorithm {
    /// Its name.
    pub fn name(&self) -> AlgorithmName {
        match self {
            Self::GadmDqn => AlgorithmName::GadmDqn,
            Self::Td3(_) => AlgorithmName::Td3,
            Self::DqnManual(_) => AlgorithmName::DqnManual,
            Self::DqnCluster(_) => AlgorithmName::DqnCluster,
            Self::Pdqn(_) => AlgorithmName::Pdqn,
            Self::Mpdqn(_) => AlgorithmName::Mpdqn,
            Self::Hppo(_) => AlgorithmName::Hppo,
        }
    }

    /// The file with an expert's actions that it learns from, where it has one.
    pub fn data_mut(&mut self) -> Option<&mut PathBuf> {
        match self {
            Self::DqnCluster(config) => config.data.as_mut(),
            _ => None,
        }
    }

    /// Checks the settings of an algorithm with a table of its own.
    ///
    /// # Errors
    /// [`TrainError::Config`] with key, expected and found.
    pub fn validate(&self) -> Result<(), TrainError> {
        match self {
            Self::GadmDqn => Ok(()),
            Self::Td3(config) => config.validate(),
            Self::DqnManual(config) => config.validate(),
            Self::DqnCluster(config) => config.validate(),
            Self::Pdqn(config) => config.validate("pdqn"),
            Self::Mpdqn(config) => config.validate(),
            Self::Hppo(config) => config.validate(),
        }
    }
}

/// Collection and updates of an algorithm that learns from a replay buffer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Schedule {
    /// Environments stepped side by side.
    pub envs: usize,
    /// Environment steps per round, over all environments; a multiple of `envs`.
    pub steps_per_round: usize,
    /// Updates per round.
    pub updates: u64,
    /// Rows per update.
    pub batch: usize,
    /// Transitions in the replay buffer.
    pub capacity: usize,
    /// Environment steps with uniformly random actions and without updates at the beginning; they count as steps of the run.
    pub random_steps: u64,
}

impl Default for Schedule {
    fn default() -> Self {
        Self { envs: 8, steps_per_round: 256, updates: 20, batch: 512, capacity: 1_000_000, random_steps: 0 }
    }
}

impl Schedule {
    /// Checks the settings; `key` is the dotted key of this table.
    ///
    /// # Errors
    /// [`TrainError::Config`] with key, expected and found.
    pub fn validate(&self, key: &str) -> Result<(), TrainError> {
        for (name, value, least) in
            [("envs", self.envs, 1), ("batch", self.batch, 1), ("capacity", self.capacity, self.batch)]
        {
            if value < least {
                return Err(TrainError::config(&format!("{key}.{name}"), &format!("at least {least}"), value));
            }
        }
        if self.steps_per_round == 0 || !self.steps_per_round.is_multiple_of(self.envs) {
            let expected = format!("a multiple of {key}.envs = {}", self.envs);
            return Err(TrainError::config(&format!("{key}.steps_per_round"), &expected, self.steps_per_round));
        }
        Ok(())
    }
}

/// Probability of a random action, which falls exponentially with the environment steps (specification 4.4).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EpsilonConfig {
    /// At step 0.
    pub start: f64,
    /// In the limit.
    pub end: f64,
    /// Environment steps in which the difference falls to 1/e.
    pub decay: f64,
}

impl Default for EpsilonConfig {
    fn default() -> Self {
        Self { start: 1.0, end: 0.05, decay: 1e5 }
    }
}

impl EpsilonConfig {
    /// ε after `steps` environment steps.
    pub fn at(&self, steps: u64) -> f64 {
        self.end + (self.start - self.end) * (-(steps as f64) / self.decay).exp()
    }

    /// Checks the settings; `key` is the dotted key of this table.
    ///
    /// # Errors
    /// [`TrainError::Config`] with key, expected and found.
    pub fn validate(&self, key: &str) -> Result<(), TrainError> {
        for (name, value) in [("start", self.start), ("end", self.end)] {
            if !(0.0..=1.0).contains(&value) {
                return Err(TrainError::config(&format!("{key}.{name}"), "a probability, 0 to 1", value));
            }
        }
        if !(self.decay.is_finite() && self.decay > 0.0) {
            return Err(TrainError::config(&format!("{key}.decay"), "above 0", self.decay));
        }
        Ok(())
    }
}
