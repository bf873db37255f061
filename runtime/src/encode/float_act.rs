//! The step in plain `f32`: the reference that the quantised policy is measured against.

use super::model::{Dense, FloatDecoder, FloatModel, HeadEncoding, Snap};
use super::threshold::threshold;
use crate::LatentMask;
use crate::decision::FloatDecision;
use std::vec;
use std::vec::Vec;

/// `W x + b`.
pub(crate) fn linear(layer: &Dense, x: &[f32]) -> Vec<f32> {
    layer
        .weight
        .chunks_exact(layer.cols)
        .zip(&layer.bias)
        .map(|(row, bias)| {
            // Eight partial sums, so that a compiler can vectorise; the rest of the columns follows.
            let mut sums = [0.0f32; 8];
            let (rows, rest) = row.as_chunks::<8>();
            let (xs, x_rest) = x.as_chunks::<8>();
            for (w, x) in rows.iter().zip(xs) {
                for ((sum, w), x) in sums.iter_mut().zip(w).zip(x) {
                    *sum += w * x;
                }
            }
            let tail: f32 = rest.iter().zip(x_rest).map(|(w, x)| w * x).sum();
            sums.iter().sum::<f32>() + tail + bias
        })
        .collect()
}

pub(crate) fn relu(mut x: Vec<f32>) -> Vec<f32> {
    for value in &mut x {
        *value = value.max(0.0);
    }
    x
}

/// ReLU layers and a linear last one.
pub(crate) fn chain(layers: &[Dense], x: &[f32]) -> Vec<f32> {
    let mut x = x.to_vec();
    for (index, layer) in layers.iter().enumerate() {
        x = linear(layer, &x);
        if index + 1 < layers.len() {
            x = relu(x);
        }
    }
    x
}

/// Index of the largest value, lowest on a tie.
fn argmax(values: impl Iterator<Item = (usize, f32)>) -> (usize, f32) {
    values.fold((0, f32::NEG_INFINITY), |best, next| if next.1 > best.1 { next } else { best })
}

pub(crate) fn softmax_terms(logits: &[f32]) -> (Vec<f32>, f32) {
    let top = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let terms: Vec<f32> = logits.iter().map(|l| (l - top).exp()).collect();
    let sum = terms.iter().sum();
    (terms, sum)
}

impl FloatModel {
    /// The observation as the networks see it.
    pub(crate) fn normalise(&self, obs: &[f32]) -> Vec<f32> {
        obs.iter().zip(&self.obs_mean).zip(&self.obs_std).map(|((x, mean), std)| (x - mean) / std).collect()
    }

    /// The Q-network's last hidden layer for a normalised observation.
    fn trunk(&self, x: &[f32]) -> Vec<f32> {
        let hidden = self.q.len().saturating_sub(1);
        self.q.iter().take(hidden).fold(x.to_vec(), |x, layer| relu(linear(layer, &x)))
    }

    /// Allowed latents of a normalised observation, and whether the empty-mask rule made them.
    pub(crate) fn allowed(&self, x: &[f32]) -> (LatentMask, bool) {
        let latents = self.num_latents() as u16;
        let Some(confidence) = &self.confidence else { return (LatentMask::full(latents), false) };
        let logits = if self.shared_trunk { chain(confidence, &self.trunk(x)) } else { chain(confidence, x) };
        let (terms, sum) = softmax_terms(&logits);
        let (num, den) = threshold(self.beta, latents);
        let mut mask = LatentMask::empty();
        for (latent, &term) in (0..latents).zip(&terms) {
            if term * den as f32 > sum * num as f32 {
                mask.insert(latent);
            }
        }
        if !mask.is_empty() {
            return (mask, false);
        }
        let least = terms.iter().copied().fold(f32::INFINITY, f32::min);
        if (1.0 - least) / sum < 1e-6 {
            return (LatentMask::full(latents), true);
        }
        mask.insert(argmax(logits.iter().copied().enumerate()).0 as u16);
        (mask, true)
    }

    /// First decoder layer of a normalised observation for one latent, after the ReLU.
    pub(crate) fn modulate(state: &Dense, scale: &[f32], shift: &[f32], x: &[f32]) -> Vec<f32> {
        let y = linear(state, x);
        relu(y.iter().zip(scale).zip(shift).map(|((y, scale), shift)| scale * y + shift).collect())
    }

    /// One step in plain `f32`, the reference for the quantised policy; writes one value per action slot, in the units
    /// of the interface.
    ///
    /// # Panics
    /// When the model's own shapes or the slices do not fit together; [`quantise`](super::quantise) checks the model.
    pub fn act(&self, obs: &[f32], action: &mut [f32]) -> FloatDecision {
        assert_eq!(obs.len(), self.interface.observations.len(), "one value per observation signal");
        let x = self.normalise(obs);
        let values = chain(&self.q, &x);
        let (allowed, fallback) = self.allowed(&x);
        let candidates = values.iter().copied().enumerate().filter(|(latent, _)| allowed.contains(*latent as u16));
        let (latent, q) = argmax(candidates);
        for (place, value) in action.iter_mut().zip(self.decode(&x, latent)) {
            *place = value;
        }
        FloatDecision { latent: latent as u16, allowed, fallback, q }
    }

    /// Action of a normalised observation and a latent, in native units.
    pub(crate) fn decode(&self, x: &[f32], latent: usize) -> Vec<f32> {
        let raw = match &self.decoder {
            FloatDecoder::Table { actions } => actions[latent].clone(),
            FloatDecoder::Modulated { state, scale, shift, hidden, head } => {
                let mut y = Self::modulate(state, &scale[latent], &shift[latent], x);
                for layer in hidden {
                    y = relu(linear(layer, &y));
                }
                self.heads(&linear(head, &y))
            }
        };
        raw.iter().zip(&self.interface.actions).map(|(raw, action)| action.head.denormalise(*raw)).collect()
    }

    /// Values of the head layer to slot values.
    fn heads(&self, logits: &[f32]) -> Vec<f32> {
        let mut rest = logits;
        let mut raw = vec![];
        for (encoding, action) in self.heads.iter().zip(&self.interface.actions) {
            let (rows, after) = rest.split_at(encoding.rows(action.head));
            rest = after;
            raw.push(match encoding {
                HeadEncoding::Tanh => rows[0].tanh(),
                HeadEncoding::Categorical { snap, .. } => categorical(rows, *snap),
                HeadEncoding::Types => argmax(rows.iter().copied().enumerate()).0 as f32,
                HeadEncoding::Switch => f32::from(u8::from(rows[0] > 0.0)),
            });
        }
        raw
    }
}

/// Expectation over atoms on -1..=1, or an atom of probability 0.9 or more under the snap rule.
fn categorical(logits: &[f32], snap: Snap) -> f32 {
    let (terms, sum) = softmax_terms(logits);
    let last = logits.len() - 1;
    let support = |j: usize| -1.0 + 2.0 * j as f32 / last as f32;
    let (atom, term) = argmax(terms.iter().copied().enumerate());
    let snaps = match snap {
        Snap::None => false,
        Snap::Edges => atom == 0 || atom == last,
        Snap::Any => true,
    };
    if snaps && term >= 0.9 * sum {
        return support(atom);
    }
    terms.iter().enumerate().map(|(j, term)| term * support(j)).sum::<f32>() / sum
}
