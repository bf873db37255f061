//! Settings of TD3, with the source of every default.

use serde::{Deserialize, Serialize};

use crate::config::Schedule;
use crate::error::TrainError;
use crate::nn::AdamConfig;
use crate::nn::stack::check_hidden;

/// TD3 (Fujimoto et al. 2018; specification 7.1).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Td3Config {
    /// Collection and updates: one environment, one update a step, 25,000 random steps (as the authors do for MuJoCo).
    pub schedule: Schedule,
    /// Widths of the hidden layers of actor and critics.
    pub hidden: Vec<usize>,
    /// Discount γ.
    pub gamma: f64,
    /// Rewards summed before bootstrapping, n.
    pub n_step: usize,
    /// Share by which the targets move towards the networks (Polyak), at every update of the actor.
    pub tau: f64,
    /// Updates of the critics per update of the actor and the targets.
    pub policy_delay: u64,
    /// Standard deviation of the noise on target actions (normalised).
    pub target_noise: f64,
    /// Bound of that noise.
    pub noise_clip: f64,
    /// Standard deviation of the noise on executed actions (normalised).
    pub explore_noise: f64,
    /// Optimiser of the actor.
    pub actor_adam: AdamConfig,
    /// Optimiser of both critics.
    pub critic_adam: AdamConfig,
}

impl Default for Td3Config {
    fn default() -> Self {
        let adam = AdamConfig { learning_rate: 1e-3, grad_clip: 0.0, ..AdamConfig::default() };
        Self {
            schedule: Schedule {
                envs: 1,
                steps_per_round: 1,
                updates: 1,
                batch: 256,
                capacity: 1_000_000,
                random_steps: 25_000,
            },
            hidden: vec![256, 256],
            gamma: 0.99,
            n_step: 1,
            tau: 0.005,
            policy_delay: 2,
            target_noise: 0.2,
            noise_clip: 0.5,
            explore_noise: 0.1,
            actor_adam: adam,
            critic_adam: adam,
        }
    }
}

impl Td3Config {
    /// Checks the settings.
    ///
    /// # Errors
    /// [`TrainError::Config`] with key, expected and found.
    pub fn validate(&self) -> Result<(), TrainError> {
        self.schedule.validate("td3.schedule")?;
        check_hidden("td3.hidden", &self.hidden)?;
        self.actor_adam.validate("td3.actor_adam")?;
        self.critic_adam.validate("td3.critic_adam")?;
        for (key, value, fits, expected) in [
            ("td3.gamma", self.gamma, (0.0..=1.0).contains(&self.gamma), "0 to 1"),
            ("td3.tau", self.tau, self.tau > 0.0 && self.tau <= 1.0, "above 0 and at most 1"),
            ("td3.n_step", self.n_step as f64, self.n_step > 0, "at least 1"),
            ("td3.policy_delay", self.policy_delay as f64, self.policy_delay > 0, "at least 1"),
            ("td3.target_noise", self.target_noise, self.target_noise >= 0.0, "0 or more"),
            ("td3.noise_clip", self.noise_clip, self.noise_clip >= 0.0, "0 or more"),
            ("td3.explore_noise", self.explore_noise, self.explore_noise >= 0.0, "0 or more"),
        ] {
            if !(fits && value.is_finite()) {
                return Err(TrainError::config(key, expected, value));
            }
        }
        Ok(())
    }
}
