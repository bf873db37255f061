//! The loss of one row, with its gradient.

use super::config::HppoConfig;

/// What one row of a batch knows of the past.
#[derive(Clone, Copy, Debug, Default)]
pub struct Old<'a> {
    /// Type taken.
    pub kind: usize,
    /// Arguments drawn, before they were cut to the range of an action.
    pub x: &'a [f32],
    /// Log-probability of the type and log-density of the arguments when they were drawn.
    pub log: [f32; 2],
    /// Advantage, standardised over the batch.
    pub advantage: f32,
    /// Return and value at the start of the pass, in units of the running deviation.
    pub ret: f32,
    /// See `ret`.
    pub value: f32,
}

/// Parts of a loss: policy, value, entropy of the types.
pub type Parts = [f32; 3];

/// `log N(x; μ, σ²)`, all dimensions together.
pub fn log_density(x: &[f32], mu: &[f32], sigma: f32) -> f32 {
    let constant = sigma.ln() + 0.5 * std::f32::consts::TAU.ln();
    x.iter().zip(mu).map(|(x, mu)| -0.5 * ((x - mu) / sigma).powi(2) - constant).sum()
}

/// Replaces logits by log-probabilities.
pub fn log_softmax(logits: &mut [f32]) {
    let top = logits.iter().copied().fold(f32::NEG_INFINITY, |m, l| if l > m { l } else { m });
    let sum: f32 = logits.iter().map(|l| (l - top).exp()).sum();
    let norm = top + sum.ln();
    for l in logits {
        *l -= norm;
    }
}

/// `-min(r A, clip(r) A)` of the ratio `r = e^(new - old)`, and its derivative with respect to `new`.
/// Source: Schulman et al. 2017, eq. 7.
pub fn surrogate(new: f32, old: f32, advantage: f32, clip: f32) -> (f32, f32) {
    let ratio = (new - old).exp();
    let (free, bound) = (ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage);
    if bound < free { (-bound, 0.0) } else { (-free, -free) }
}

/// `½ max((R - V)², (R - V_c)²)` with `V_c` within `clip` of the old value, and its derivative.
pub fn value_loss(value: f32, old: &Old, clip: f32) -> (f32, f32) {
    let change = value - old.value;
    let held = old.value + change.clamp(-clip, clip);
    let (free, bound) = (value - old.ret, held - old.ret);
    if bound * bound > free * free {
        (0.5 * bound * bound, if change.abs() < clip { bound } else { 0.0 })
    } else {
        (0.5 * free * free, free)
    }
}

/// Loss of one row times `scale`. `logits` becomes its own gradient, as do `z` (arguments before their tanh) and `value`.
pub fn row(config: &HppoConfig, old: &Old, scale: f32, logits: &mut [f32], z: &mut [f32], value: &mut f32) -> Parts {
    let (clip, sigma) = (config.clip as f32, config.sigma as f32);
    log_softmax(logits);
    let (mut policy, slope) = surrogate(logits[old.kind], old.log[0], old.advantage, clip);
    let entropy: f32 = -logits.iter().map(|l| l * l.exp()).sum::<f32>();
    let weight = config.entropy_weight as f32;
    for (k, l) in logits.iter_mut().enumerate() {
        let (p, taken) = (l.exp(), f32::from(u8::from(k == old.kind)));
        *l = scale * (slope * (taken - p) + weight * p * (*l + entropy));
    }
    for z in z.iter_mut() {
        *z = z.tanh();
    }
    let (loss, slope) = surrogate(log_density(old.x, z, sigma), old.log[1], old.advantage, clip);
    policy += loss;
    for (z, x) in z.iter_mut().zip(old.x) {
        *z = scale * slope * (x - *z) / (sigma * sigma) * (1.0 - *z * *z);
    }
    let (loss, slope) = value_loss(*value, old, config.value_clip as f32);
    *value = scale * config.value_weight as f32 * slope;
    [scale * policy, scale * loss, scale * entropy]
}
