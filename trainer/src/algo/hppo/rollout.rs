//! The steps of one round, and their advantages.

/// Steps in the order they were taken: all environments of a step, then those of the next.
#[derive(Clone, Debug, Default)]
pub struct Rollout {
    /// Environments.
    pub envs: usize,
    /// Observations, `N x O`.
    pub obs: Vec<f32>,
    /// Successors, `N x O`.
    pub next_obs: Vec<f32>,
    /// Types, `N`.
    pub kinds: Vec<u32>,
    /// Arguments as drawn, `N x arguments`.
    pub x: Vec<f32>,
    /// Log-probability of each type and log-density of its arguments when they were drawn.
    pub log: Vec<[f32; 2]>,
    /// Rewards, `N`.
    pub rewards: Vec<f32>,
    /// The value of the successor counts, `N`: false where the episode ended by its own rules.
    pub goes_on: Vec<bool>,
    /// The episode ended here, by its own rules or by a limit, `N`.
    pub ends: Vec<bool>,
}

impl Rollout {
    /// Steps held.
    pub fn len(&self) -> usize {
        self.rewards.len()
    }

    /// True before the first step.
    pub fn is_empty(&self) -> bool {
        self.rewards.is_empty()
    }

    /// Forgets all steps.
    pub fn clear(&mut self) {
        *self = Self { envs: self.envs, ..Self::default() };
    }

    /// Generalised advantage estimates, `N`, from the values of observations and successors.
    /// Source: Schulman et al. 2016, eq. 16, cut off at the end of the round.
    pub fn advantages(&self, values: &[f32], next_values: &[f32], gamma: f32, lambda: f32) -> Vec<f32> {
        let mut advantages = vec![0.0; self.len()];
        for i in (0..self.len()).rev() {
            let next = if self.goes_on[i] { next_values[i] } else { 0.0 };
            let delta = self.rewards[i] + gamma * next - values[i];
            let later = advantages.get(i + self.envs).copied().filter(|_| !self.ends[i]).unwrap_or(0.0);
            advantages[i] = delta + gamma * lambda * later;
        }
        advantages
    }
}

/// Mean, variance and count of everything seen. Source: Chan, Golub & LeVeque 1979, eq. 2.1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Running {
    /// Mean.
    pub mean: f32,
    /// Variance; 1 before anything was seen.
    pub variance: f32,
    /// Numbers seen.
    pub count: f32,
}

impl Running {
    /// Before anything was seen.
    pub const START: Self = Self { mean: 0.0, variance: 1.0, count: 1e-4 };

    /// Standard deviation.
    pub fn deviation(&self) -> f32 {
        self.variance.sqrt() + 1e-8
    }

    /// Adds numbers.
    pub fn add(&mut self, values: &[f32]) {
        let n = values.len() as f64;
        let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / n;
        let variance = values.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>() / n;
        let (old, count) = (f64::from(self.count), f64::from(self.count) + n);
        let apart = mean - f64::from(self.mean);
        let square = f64::from(self.variance) * old + variance * n + apart * apart * old * n / count;
        self.mean = (f64::from(self.mean) + apart * n / count) as f32;
        (self.variance, self.count) = ((square / count) as f32, count as f32);
    }
}
