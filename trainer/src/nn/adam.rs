//! Adam over one flat vector, with clipping of the global gradient norm.
//! Source: Kingma & Ba 2015, algorithm 1 (bias-corrected form); clipping as `clip_grad_norm_` of PyTorch.

use serde::{Deserialize, Serialize};

use super::parallel::{halves, join};
use super::vector::vectorised;
use crate::error::TrainError;

/// Settings of the optimiser.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AdamConfig {
    /// Step size.
    pub learning_rate: f64,
    /// Largest global L2 norm of a gradient; longer ones are scaled down. 0 switches clipping off.
    pub grad_clip: f64,
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
    /// Added to the root of the second moment.
    pub epsilon: f64,
    /// Linear decay of the step size; without, it stays. Not in a file that names none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub decay: Option<Decay>,
}

/// A step size that falls linearly with the steps taken, and stays at its end.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Decay {
    /// Step size at the end.
    pub to: f64,
    /// Steps until then, of this optimiser: the updates of its network.
    pub updates: u64,
}

impl Default for AdamConfig {
    fn default() -> Self {
        Self { learning_rate: 3e-4, grad_clip: 0.5, beta1: 0.9, beta2: 0.999, epsilon: 1e-8, decay: None }
    }
}

impl AdamConfig {
    /// Checks the settings; `key` is the dotted key of this table.
    ///
    /// # Errors
    /// [`TrainError::Config`] for a step size or an epsilon that is not positive, a negative clip, or a decay outside 0..1.
    pub fn validate(&self, key: &str) -> Result<(), TrainError> {
        let positive = |v: f64| v.is_finite() && v > 0.0;
        for (name, value, fits, expected) in [
            ("learning_rate", self.learning_rate, positive(self.learning_rate), "above 0"),
            ("epsilon", self.epsilon, positive(self.epsilon), "above 0"),
            ("grad_clip", self.grad_clip, self.grad_clip.is_finite() && self.grad_clip >= 0.0, "0 or more"),
            ("beta1", self.beta1, (0.0..1.0).contains(&self.beta1), "0 or more and below 1"),
            ("beta2", self.beta2, (0.0..1.0).contains(&self.beta2), "0 or more and below 1"),
        ] {
            if !fits {
                return Err(TrainError::config(&format!("{key}.{name}"), expected, value));
            }
        }
        match self.decay {
            Some(Decay { to, .. }) if !(to >= 0.0 && to <= self.learning_rate) => Err(TrainError::config(
                &format!("{key}.decay.to"),
                &format!("0 to {key}.learning_rate = {}", self.learning_rate),
                to,
            )),
            Some(Decay { updates: 0, .. }) => Err(TrainError::config(&format!("{key}.decay.updates"), "at least 1", 0)),
            _ => Ok(()),
        }
    }

    /// Step size after `steps` steps.
    pub fn learning_rate_at(&self, steps: u64) -> f64 {
        self.decay.map_or(self.learning_rate, |Decay { to, updates }| {
            self.learning_rate + (to - self.learning_rate) * (steps as f64 / updates as f64).min(1.0)
        })
    }
}

/// Moments and step count.
#[derive(Clone, Debug, PartialEq)]
pub struct Adam {
    /// Settings.
    pub config: AdamConfig,
    /// First moment.
    pub m: Vec<f32>,
    /// Second moment.
    pub v: Vec<f32>,
    /// Steps taken.
    pub steps: u64,
}

impl Adam {
    /// Zero moments for `len` parameters.
    pub fn new(config: AdamConfig, len: usize) -> Self {
        Self { config, m: vec![0.0; len], v: vec![0.0; len], steps: 0 }
    }

    /// One step on the first `m.len()` parameters with the sum of `grads`, which is left in the first one. Returns the
    /// gradient norm before clipping.
    ///
    /// # Panics
    /// Without a gradient, or where one is shorter than the moments.
    pub fn step(&mut self, params: &mut [f32], grads: &mut [&mut [f32]]) -> f32 {
        let len = self.m.len();
        let middle = halves(len);
        let (sum, more) = grads.split_first_mut().expect("at least one gradient");
        let (sum_a, sum_b) = sum[..len].split_at_mut(middle);
        let more = &*more;
        let (a, b) = join(
            || add_and_square(sum_a, more.iter().map(|g| &g[..middle])),
            || add_and_square(sum_b, more.iter().map(|g| &g[middle..len])),
        );
        let norm = (a + b).sqrt() as f32;
        let clip = self.config.grad_clip as f32;
        let rate = self.config.learning_rate_at(self.steps);
        self.steps += 1;
        let t = self.steps.min(1 << 30) as i32;
        let c1 = 1.0 - self.config.beta1.powi(t);
        let c2 = 1.0 - self.config.beta2.powi(t);
        let step = Step {
            scale: if clip > 0.0 { (clip / (norm + 1e-6)).min(1.0) } else { 1.0 },
            b1: self.config.beta1 as f32,
            b2: self.config.beta2 as f32,
            rate: (rate / c1) as f32,
            root: (1.0 / c2.sqrt()) as f32,
            eps: self.config.epsilon as f32,
        };
        let (params_a, params_b) = params[..len].split_at_mut(middle);
        let (m_a, m_b) = self.m.split_at_mut(middle);
        let (v_a, v_b) = self.v.split_at_mut(middle);
        join(|| step.apply(params_a, sum_a, m_a, v_a), || step.apply(params_b, sum_b, m_b, v_b));
        norm
    }
}

/// The numbers of one step.
#[derive(Clone, Copy)]
struct Step {
    scale: f32,
    b1: f32,
    b2: f32,
    rate: f32,
    root: f32,
    eps: f32,
}

impl Step {
    fn apply(self, params: &mut [f32], grads: &[f32], m: &mut [f32], v: &mut [f32]) {
        let Self { scale, b1, b2, rate, root, eps } = self;
        vectorised!({
            for (((p, &g), m), v) in params.iter_mut().zip(grads).zip(m).zip(v) {
                let g = g * scale;
                *m = b1 * *m + (1.0 - b1) * g;
                *v = b2 * *v + (1.0 - b2) * g * g;
                *p -= rate * *m / (v.sqrt() * root + eps);
            }
        });
    }
}

/// Adds `more` to `sum`; returns the sum of squares of that, taken in eight running sums and added up in f64.
fn add_and_square<'a>(sum: &mut [f32], more: impl Iterator<Item = &'a [f32]>) -> f64 {
    vectorised!({
        for g in more {
            sum.iter_mut().zip(g).for_each(|(s, g)| *s += g);
        }
        let mut lanes = [0.0_f32; 8];
        let chunks = sum.chunks_exact(8);
        let rest: f32 = chunks.remainder().iter().map(|v| v * v).sum();
        for chunk in chunks {
            for (lane, v) in lanes.iter_mut().zip(chunk) {
                *lane += v * v;
            }
        }
        lanes.iter().map(|&l| f64::from(l)).sum::<f64>() + f64::from(rest)
    })
}

#[cfg(test)]
mod tests {
    use super::{Adam, AdamConfig, Decay};

    #[test]
    fn first_step_moves_by_the_learning_rate_against_the_sign() {
        let mut adam = Adam::new(AdamConfig { learning_rate: 0.1, grad_clip: 0.0, ..Default::default() }, 2);
        let mut p = [1.0, 1.0, 7.0];
        adam.step(&mut p, &mut [&mut [4.0, -0.5]]);
        assert!((p[0] - 0.9).abs() < 1e-6 && (p[1] - 1.1).abs() < 1e-6);
        assert_eq!(p[2], 7.0, "buffers behind the trainable part stay");
    }

    #[test]
    fn the_learning_rate_falls_linearly_and_then_stays() {
        let decay = Some(Decay { to: 0.02, updates: 4 });
        let config = AdamConfig { learning_rate: 0.1, grad_clip: 0.0, epsilon: 1e-12, decay, ..Default::default() };
        let mut adam = Adam::new(config, 1);
        let mut p = [0.0];
        // A gradient that never changes moves the parameter by the learning rate itself.
        for rate in [0.1, 0.08, 0.06, 0.04, 0.02, 0.02, 0.02] {
            let before = p[0];
            adam.step(&mut p, &mut [&mut [3.0]]);
            assert!((before - p[0] - rate).abs() < 1e-6, "step {}: {} instead of {rate}", adam.steps, before - p[0]);
        }
    }

    #[test]
    fn a_decay_that_cannot_be_is_refused_by_its_key() {
        let with =
            |to, updates| AdamConfig { decay: Some(Decay { to, updates }), ..Default::default() }.validate("q.adam");
        assert!(with(3e-5, 1).is_ok() && with(0.0, 1).is_ok());
        for (to, updates, key) in
            [(-1e-9, 1, "decay.to"), (f64::NAN, 1, "decay.to"), (1e-3, 1, "decay.to"), (1e-5, 0, "decay.updates")]
        {
            let error = with(to, updates).unwrap_err().to_string();
            assert!(error.contains(&format!("q.adam.{key}")), "{error}");
        }
    }

    #[test]
    fn clipping_reports_the_norm_before_and_matches_a_scaled_gradient() {
        let config = AdamConfig { grad_clip: 0.5, epsilon: 0.1, ..Default::default() };
        let (mut a, mut b) = (Adam::new(config, 2), Adam::new(AdamConfig { grad_clip: 0.0, ..config }, 2));
        let (mut p, mut q) = ([0.0; 2], [0.0; 2]);
        assert_eq!(a.step(&mut p, &mut [&mut [1.0, 4.5], &mut [2.0, -0.5]]), 5.0, "the norm of the sum");
        b.step(&mut q, &mut [&mut [0.3, 0.4]]);
        assert!(p.iter().zip(&q).all(|(x, y)| (x - y).abs() < 1e-8));
    }
}
