//! Settings of DQN on lists of actions, with the source of every default.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::grid::Grid;
use crate::algo::dqn::{DqnConfig, TargetUpdate};
use crate::config::{EpsilonConfig, Schedule};
use crate::error::TrainError;
use crate::nn::AdamConfig;

/// Outputs of the Q-network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum HeadLayout {
    /// Flat up to `limit` actions, else decoupled.
    #[default]
    Auto,
    /// One output per action of the Cartesian product.
    Flat,
    /// One group of outputs per slot; the value of an action is their mean.
    Decoupled,
}

/// The Q-network of the baselines: as that of GADM+DQN, without its ensemble and clipping (specification 7.2).
fn plain_dqn(hidden: &[usize]) -> DqnConfig {
    DqnConfig {
        hidden: hidden.to_vec(),
        heads: 1,
        target: TargetUpdate::Hard { every: 500 },
        adam: AdamConfig { grad_clip: 0.0, ..AdamConfig::default() },
        ..DqnConfig::default()
    }
}

/// DQN on hand-made bins (specification 7.2).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DqnManualConfig {
    /// Collection and updates: 256 steps, then 20 updates of 512 rows.
    pub schedule: Schedule,
    /// Bins of a continuous slot.
    pub bins: usize,
    /// Their values.
    pub grid: Grid,
    /// Outputs of the Q-network.
    pub layout: HeadLayout,
    /// Most actions of a flat Q-network.
    pub limit: usize,
    /// Exploration.
    pub epsilon: EpsilonConfig,
    /// Q-network and its update. Where the heads are decoupled, `dueling` and `heads` say nothing.
    pub dqn: DqnConfig,
}

impl Default for DqnManualConfig {
    fn default() -> Self {
        Self {
            schedule: Schedule::default(),
            bins: 3,
            grid: Grid::Inclusive,
            layout: HeadLayout::Auto,
            limit: 8192,
            epsilon: EpsilonConfig::default(),
            dqn: plain_dqn(&[256, 256, 128]),
        }
    }
}

impl DqnManualConfig {
    /// Checks the settings.
    ///
    /// # Errors
    /// [`TrainError::Config`] with key, expected and found.
    pub fn validate(&self) -> Result<(), TrainError> {
        self.schedule.validate("dqn_manual.schedule")?;
        self.epsilon.validate("dqn_manual.epsilon")?;
        self.dqn.validate().map_err(|e| e.within("dqn_manual"))?;
        if self.bins < 2 {
            return Err(TrainError::config("dqn_manual.bins", "at least 2", self.bins));
        }
        Ok(())
    }
}

/// DQN on the centres of an expert's actions (specification 8.7).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DqnClusterConfig {
    /// Collection and updates: 256 steps, then 50 updates of 512 rows.
    pub schedule: Schedule,
    /// A safetensors file with the expert's `obs` (N x O) and `actions` (N x slots, normalised); `gadm eval RUN --record FILE`
    /// writes one.
    pub data: Option<PathBuf>,
    /// Centres, K.
    pub clusters: usize,
    /// Rounds of Lloyd's algorithm, at most.
    pub iterations: usize,
    /// Exploration.
    pub epsilon: EpsilonConfig,
    /// Q-network and its update.
    pub dqn: DqnConfig,
}

impl Default for DqnClusterConfig {
    fn default() -> Self {
        Self {
            schedule: Schedule { updates: 50, ..Schedule::default() },
            data: None,
            clusters: 8,
            iterations: 100,
            epsilon: EpsilonConfig::default(),
            dqn: plain_dqn(&[128, 128, 64]),
        }
    }
}

impl DqnClusterConfig {
    /// Checks the settings.
    ///
    /// # Errors
    /// [`TrainError::Config`] with key, expected and found.
    pub fn validate(&self) -> Result<(), TrainError> {
        self.schedule.validate("dqn_cluster.schedule")?;
        self.epsilon.validate("dqn_cluster.epsilon")?;
        self.dqn.validate().map_err(|e| e.within("dqn_cluster"))?;
        if self.clusters < 2 {
            return Err(TrainError::config("dqn_cluster.clusters", "at least 2", self.clusters));
        }
        if self.data.is_none() {
            let expected = "a file with an expert's actions (`gadm eval RUN --record FILE` writes one)";
            return Err(TrainError::config("dqn_cluster.data", expected, "none"));
        }
        Ok(())
    }
}
