//! Settings of HPPO, with the source of every default.

use serde::{Deserialize, Serialize};

use crate::error::TrainError;
use crate::nn::AdamConfig;
use crate::nn::stack::check_hidden;

/// PPO for types with arguments (Fan et al. 2019; specification 7.4).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HppoConfig {
    /// Environments stepped side by side.
    pub envs: usize,
    /// Environment steps per round, over all environments; a multiple of `envs`.
    pub steps_per_round: usize,
    /// Passes over the steps of a round.
    pub epochs: u64,
    /// Rows per update; a last, smaller batch of a pass is left out.
    pub batch: usize,
    /// Widths of the encoder, which all heads share; each head has one more layer as wide as the last one.
    pub hidden: Vec<usize>,
    /// Discount γ.
    pub gamma: f64,
    /// λ of the generalised advantage estimate (Schulman et al. 2016).
    pub gae_lambda: f64,
    /// Bound of the change of each probability ratio.
    pub clip: f64,
    /// Bound of the change of the value, in units of its running standard deviation.
    pub value_clip: f64,
    /// Weight of the value loss.
    pub value_weight: f64,
    /// Weight of the types' entropy.
    pub entropy_weight: f64,
    /// Standard deviation of the arguments (normalised), fixed.
    pub sigma: f64,
    /// Most types, or combinations of switches, that are told apart.
    pub limit: usize,
    /// Optimiser.
    pub adam: AdamConfig,
}

impl Default for HppoConfig {
    fn default() -> Self {
        Self {
            envs: 8,
            steps_per_round: 3200,
            epochs: 10,
            batch: 320,
            hidden: vec![256, 128, 64, 64],
            gamma: 0.99,
            gae_lambda: 0.95,
            clip: 0.2,
            value_clip: 0.2,
            value_weight: 0.5,
            entropy_weight: 0.03,
            sigma: 0.3,
            limit: 4096,
            adam: AdamConfig::default(),
        }
    }
}

impl HppoConfig {
    /// Checks the settings.
    ///
    /// # Errors
    /// [`TrainError::Config`] with key, expected and found.
    pub fn validate(&self) -> Result<(), TrainError> {
        check_hidden("hppo.hidden", &self.hidden)?;
        self.adam.validate("hppo.adam")?;
        let share = |v: f64| (0.0..=1.0).contains(&v);
        for (key, value, fits, expected) in [
            ("hppo.gamma", self.gamma, share(self.gamma), "0 to 1"),
            ("hppo.gae_lambda", self.gae_lambda, share(self.gae_lambda), "0 to 1"),
            ("hppo.clip", self.clip, self.clip > 0.0 && self.clip < 1.0, "above 0 and below 1"),
            ("hppo.value_clip", self.value_clip, self.value_clip > 0.0, "above 0"),
            ("hppo.value_weight", self.value_weight, self.value_weight >= 0.0, "0 or more"),
            ("hppo.entropy_weight", self.entropy_weight, self.entropy_weight >= 0.0, "0 or more"),
            ("hppo.sigma", self.sigma, self.sigma > 0.0, "above 0"),
            ("hppo.envs", self.envs as f64, self.envs > 0, "at least 1"),
            ("hppo.epochs", self.epochs as f64, self.epochs > 0, "at least 1"),
            ("hppo.batch", self.batch as f64, self.batch > 1, "at least 2, for advantages are standardised"),
        ] {
            if !(fits && value.is_finite()) {
                return Err(TrainError::config(key, expected, value));
            }
        }
        let steps = self.steps_per_round;
        if steps < self.batch || !steps.is_multiple_of(self.envs) {
            let expected = format!("a multiple of hppo.envs = {}, at least hppo.batch = {}", self.envs, self.batch);
            return Err(TrainError::config("hppo.steps_per_round", &expected, steps));
        }
        Ok(())
    }
}
