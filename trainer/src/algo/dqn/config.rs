//! Settings of the Q-network, with the source of every default.

use serde::{Deserialize, Serialize};

use crate::error::TrainError;
use crate::nn::stack::check_hidden;
use crate::nn::{AdamConfig, Params};

/// How the target network follows (specification 4.3).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", tag = "kind", deny_unknown_fields)]
pub enum TargetUpdate {
    /// Copy every so many updates.
    Hard {
        /// Updates between copies.
        #[serde(default = "default_every")]
        every: u64,
    },
    /// Move by a share of the difference at every update (Polyak).
    Soft {
        /// The share.
        #[serde(default = "default_tau")]
        tau: f64,
    },
}

fn default_every() -> u64 {
    500
}

fn default_tau() -> f64 {
    0.001
}

impl TargetUpdate {
    /// Moves `target` after the update of that number.
    pub fn apply(self, target: &mut Params, params: &Params, updates: u64) {
        match self {
            Self::Hard { every } if updates.is_multiple_of(every.max(1)) => target.copy_from(params),
            Self::Hard { .. } => {}
            Self::Soft { tau } => target.approach(params, tau as f32),
        }
    }
}

/// The Q-network and its update (specification 4.1 to 4.3).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DqnConfig {
    /// Widths of the trunk; both streams repeat the last one.
    pub hidden: Vec<usize>,
    /// Heads E; decisions use their mean, targets their minimum. 1 is plain DQN.
    pub heads: usize,
    /// Separate state value and advantage (Wang et al. 2016, eq. 9).
    pub dueling: bool,
    /// Discount γ.
    pub gamma: f64,
    /// Rewards summed before bootstrapping, n.
    pub n_step: usize,
    /// Target network.
    pub target: TargetUpdate,
    /// Optimiser.
    pub adam: AdamConfig,
}

impl Default for DqnConfig {
    fn default() -> Self {
        Self {
            hidden: vec![256, 256, 128],
            heads: 20,
            dueling: true,
            gamma: 0.99,
            n_step: 3,
            target: TargetUpdate::Soft { tau: 0.001 },
            adam: AdamConfig::default(),
        }
    }
}

impl DqnConfig {
    /// Checks the settings.
    ///
    /// # Errors
    /// [`TrainError::Config`] for an empty trunk or layer, no head, or a discount, target share or step size out of range.
    pub fn validate(&self) -> Result<(), TrainError> {
        check_hidden("dqn.hidden", &self.hidden)?;
        self.adam.validate("dqn.adam")?;
        if let TargetUpdate::Soft { tau } = self.target
            && !(tau > 0.0 && tau <= 1.0)
        {
            return Err(TrainError::config("dqn.target.tau", "above 0 and at most 1", tau));
        }
        if self.heads == 0 {
            return Err(TrainError::config("dqn.heads", "at least 1", 0));
        }
        if !(0.0..=1.0).contains(&self.gamma) {
            return Err(TrainError::config("dqn.gamma", "0 to 1", self.gamma));
        }
        if self.n_step == 0 {
            return Err(TrainError::config("dqn.n_step", "at least 1", 0));
        }
        Ok(())
    }
}
