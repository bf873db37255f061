//! Settings of the Q-network, with the source of every default.

use serde::{Deserialize, Serialize};

use crate::nn::AdamConfig;

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
