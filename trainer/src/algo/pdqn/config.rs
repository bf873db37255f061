//! Settings of PDQN and MPDQN, with the source of every default.

use serde::{Deserialize, Serialize};

use crate::config::{EpsilonConfig, Schedule};
use crate::error::TrainError;
use crate::nn::AdamConfig;
use crate::nn::stack::check_hidden;

/// PDQN (Xiong et al. 2018; specification 7.3).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PdqnConfig {
    /// Collection and updates: 3,200 steps, then 500 updates of 320 rows, both kinds counted.
    pub schedule: Schedule,
    /// Widths of the encoder, which Q-network and arguments share.
    pub hidden: Vec<usize>,
    /// Discount γ.
    pub gamma: f64,
    /// Rewards summed before bootstrapping, n.
    pub n_step: usize,
    /// Share by which the target moves towards the Q-network at every update of it (Polyak).
    pub tau: f64,
    /// Updates of the Q-network in a row.
    pub q_block: u64,
    /// Updates of the arguments in a row, after those.
    pub x_block: u64,
    /// Most types, or combinations of switches, that are told apart.
    pub limit: usize,
    /// Exploration of types.
    pub epsilon: EpsilonConfig,
    /// Standard deviation of the noise on executed arguments (normalised).
    pub explore_noise: f64,
    /// Optimiser of the Q-network with its encoder.
    pub q_adam: AdamConfig,
    /// Optimiser of the arguments.
    pub x_adam: AdamConfig,
}

impl Default for PdqnConfig {
    fn default() -> Self {
        let adam = AdamConfig { grad_clip: 0.0, ..AdamConfig::default() };
        Self {
            schedule: Schedule { steps_per_round: 3200, updates: 500, batch: 320, ..Schedule::default() },
            hidden: vec![128, 128, 64],
            gamma: 0.99,
            n_step: 1,
            tau: 0.001,
            q_block: 5,
            x_block: 5,
            limit: 4096,
            epsilon: EpsilonConfig { end: 0.1, ..EpsilonConfig::default() },
            explore_noise: 0.1,
            q_adam: adam,
            x_adam: adam,
        }
    }
}

impl PdqnConfig {
    /// Checks the settings; `key` is the dotted key of this table.
    ///
    /// # Errors
    /// [`TrainError::Config`] with key, expected and found.
    pub fn validate(&self, key: &str) -> Result<(), TrainError> {
        let name = |name: &str| format!("{key}.{name}");
        self.schedule.validate(&name("schedule"))?;
        self.epsilon.validate(&name("epsilon"))?;
        check_hidden(&name("hidden"), &self.hidden)?;
        self.q_adam.validate(&name("q_adam"))?;
        self.x_adam.validate(&name("x_adam"))?;
        for (at, value, fits, expected) in [
            ("gamma", self.gamma, (0.0..=1.0).contains(&self.gamma), "0 to 1"),
            ("tau", self.tau, self.tau > 0.0 && self.tau <= 1.0, "above 0 and at most 1"),
            ("n_step", self.n_step as f64, self.n_step > 0, "at least 1"),
            ("q_block", self.q_block as f64, self.q_block > 0, "at least 1"),
            ("explore_noise", self.explore_noise, self.explore_noise >= 0.0, "0 or more"),
        ] {
            if !(fits && value.is_finite()) {
                return Err(TrainError::config(&name(at), expected, value));
            }
        }
        Ok(())
    }
}

/// MPDQN (Bester et al. 2019; specification 7.3): PDQN with one pass per type.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MpdqnConfig {
    /// What it shares with PDQN.
    pub pdqn: PdqnConfig,
    /// What a pass sees in place of the arguments that its type does not use (normalised). The original has 0, which is also a
    /// value of an argument; -2, outside their range, is that of the programs that the GADM authors used.
    pub absent: f64,
}

impl Default for MpdqnConfig {
    fn default() -> Self {
        Self { pdqn: PdqnConfig::default(), absent: -2.0 }
    }
}

impl MpdqnConfig {
    /// Checks the settings.
    ///
    /// # Errors
    /// [`TrainError::Config`] with key, expected and found.
    pub fn validate(&self) -> Result<(), TrainError> {
        if !self.absent.is_finite() {
            return Err(TrainError::config("mpdqn.absent", "a finite number", self.absent));
        }
        self.pdqn.validate("mpdqn.pdqn")
    }
}
