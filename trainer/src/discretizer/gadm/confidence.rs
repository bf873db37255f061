//! The latent action confidence predictor: which latents the data contains in a state (paper section 3.3, eq. 3; specification 3).

use gadm_runtime::schema::MAX_LAYERS_ON_TRUNK;

use super::config::{ConfidenceConfig, Trunk};
use crate::error::TrainError;
use crate::nn::parallel::{PARTS, each, part_rows, split};
use crate::nn::vector::{exp_sum, max, vectorised};
use crate::nn::{
    Adam, DenseParams, Graph, Init, Packed, ParamLayout, Params, Slot, Weights, Workspace, argmax, declare_dense,
};
use crate::seed::Rng;

/// Scores closer together than this count as untrained: nothing is masked (specification 3.3, rule 2).
const UNIFORM_SPREAD: f32 = 1e-6;
/// Bound of the last layer's start weights: all scores start within about 1e-3 of 1/K (specification 3.1).
const LAST_LAYER_BOUND: f32 = 1e-3;

/// How a mask came about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MaskRule {
    /// At least one latent exceeds the threshold.
    Threshold,
    /// All scores are equal: nothing is masked.
    Uniform,
    /// No latent exceeds the threshold: only the most confident one is allowed.
    Fallback,
}

/// The mask of one state from its scores (softmax outputs), `threshold` = β. Writes one flag per latent.
pub fn mask(scores: &[f32], threshold: f32, allowed: &mut [bool]) -> MaskRule {
    let mut any = false;
    for (a, &s) in allowed.iter_mut().zip(scores) {
        *a = s > threshold;
        any |= *a;
    }
    if any {
        return MaskRule::Threshold;
    }
    let (low, high) = scores.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), &s| (l.min(s), h.max(s)));
    if high - low < UNIFORM_SPREAD {
        allowed.fill(true);
        return MaskRule::Uniform;
    }
    allowed.fill(false);
    allowed[argmax(scores)] = true;
    MaskRule::Fallback
}

/// Softmax of each row of `k` logits, in place.
pub fn softmax_rows(logits: &mut [f32], k: usize) {
    vectorised!(softmax(logits, k));
}

#[inline(always)]
fn softmax(logits: &mut [f32], k: usize) {
    for row in logits.chunks_exact_mut(k) {
        let top = max(row);
        let sum = exp_sum(row, top);
        for v in row {
            *v /= sum;
        }
    }
}

/// Focal loss of one row (eq. 3 with the modulating factor held constant), and its gradient times `scale` into `grad`.
#[inline(always)]
fn focal(logits: &[f32], class: usize, gamma: f32, scale: f32, grad: &mut [f32]) -> f32 {
    let cross_entropy = super::loss::cross_entropy(logits, class, 1.0, grad);
    let p = (-cross_entropy).exp().clamp(1e-6, 1.0);
    let factor = (1.0 - p).powf(gamma);
    for g in grad {
        *g *= scale * factor;
    }
    factor * cross_entropy
}

/// Sum of the focal losses of some rows times `scale`, with its gradient.
#[inline(always)]
fn focal_rows(logits: &[f32], codes: &[u32], gamma: f32, scale: f32, grad: &mut [f32]) -> f32 {
    let k = grad.len() / codes.len().max(1);
    let rows = logits.chunks_exact(k).zip(grad.chunks_exact_mut(k)).zip(codes);
    rows.map(|((l, g), &code)| scale * focal(l, code as usize, gamma, scale, g)).sum()
}

/// The predictor network with its optimiser.
pub struct Confidence {
    config: ConfidenceConfig,
    latents: usize,
    layers: Vec<DenseParams>,
    /// Parameters.
    pub params: Params,
    /// Optimiser state.
    pub adam: Adam,
    graph: Graph,
    obs: Slot,
    out: Slot,
    packed: Packed,
    parts: Vec<(Workspace, f32)>,
}

impl Confidence {
    /// A near-uniform predictor for `latents` codes; `inputs` is the width of what it reads (of the observation, or of the
    /// Q-network's last hidden layer), `batch` the largest number of rows per call.
    ///
    /// # Errors
    /// [`TrainError::Config`] for a threshold outside (0, K), a negative focal exponent, an empty layer or a bad step size.
    pub fn new(
        config: ConfidenceConfig,
        inputs: usize,
        latents: usize,
        batch: usize,
        rng: &mut Rng,
    ) -> Result<Self, TrainError> {
        if !(config.threshold > 0.0 && config.threshold < latents as f64) {
            return Err(TrainError::config(
                "confidence.threshold",
                &format!("above 0 and below {latents}"),
                config.threshold,
            ));
        }
        if !(config.focal_gamma.is_finite() && config.focal_gamma >= 0.0) {
            return Err(TrainError::config("confidence.focal_gamma", "0 or more", config.focal_gamma));
        }
        let (hidden, key) = config.widths();
        if hidden.contains(&0) {
            return Err(TrainError::config(key, "widths of at least 1", format!("{hidden:?}")));
        }
        if config.trunk == Trunk::Shared && hidden.len() >= MAX_LAYERS_ON_TRUNK {
            return Err(TrainError::config(
                key,
                "at most one width: a device has no room for more",
                format!("{hidden:?}"),
            ));
        }
        config.adam.validate("confidence.adam")?;
        let mut layout = ParamLayout::new();
        let mut width = inputs;
        let mut layers = Vec::new();
        for (i, &hidden) in hidden.iter().enumerate() {
            layers.push(declare_dense(&mut layout, &format!("hidden{i}"), width, hidden, Init::torch(width)));
            width = hidden;
        }
        let w = layout.param("scores.weight", &[latents, width], Init::Uniform(LAST_LAYER_BOUND));
        let b = layout.param("scores.bias", &[latents], Init::Zero);
        layers.push(DenseParams { inputs: width, outputs: latents, w, b });
        let params = Params::init(layout, rng)?;
        let mut graph = Graph::new();
        let obs = graph.input(inputs);
        let last = layers.len() - 1;
        let out = layers.iter().enumerate().fold(obs, |x, (i, layer)| graph.dense(x, layer, i < last));
        let adam = Adam::new(config.adam, params.layout().trainable_len());
        let trainable = params.layout().trainable_len();
        let parts = (0..PARTS).map(|_| (graph.workspace(part_rows(batch), trainable), 0.0)).collect();
        let packed = graph.packed();
        Ok(Self { config, latents, layers, params, adam, graph, obs, out, packed, parts })
    }

    /// Settings.
    pub fn config(&self) -> &ConfidenceConfig {
        &self.config
    }

    /// Mask threshold β.
    pub fn threshold(&self) -> f32 {
        (self.config.threshold / self.latents as f64) as f32
    }

    /// Dense layers in order, the last one linear.
    pub fn layers(&self) -> &[DenseParams] {
        &self.layers
    }

    /// One gradient step of the focal loss on `codes` (one per row of `obs`, which here and below stands for what the
    /// predictor reads); returns the mean loss.
    pub fn update(&mut self, obs: &[f32], codes: &[u32]) -> f32 {
        let Self { config, latents, params, adam, graph, obs: input, out, packed, parts, .. } = self;
        let (batch, k, gamma) = (codes.len(), *latents, config.focal_gamma as f32);
        let (rows, width) = (split(batch), obs.len() / batch);
        graph.refresh(params, packed, true);
        params.with(|p| {
            let weights = Weights { flat: p, packed };
            each(parts, &rows, |(ws, loss), rows| {
                let numbers = rows.start * width..rows.end * width;
                ws.value_mut(*input)[..numbers.len()].copy_from_slice(&obs[numbers]);
                graph.forward(weights, ws, rows.len(), true);
                let (logits, grad) = ws.value_and_grad(*out, *out);
                let grad = &mut grad[..rows.len() * k];
                let scale = 1.0 / batch as f32;
                *loss = vectorised!(focal_rows(logits, &codes[rows.clone()], gamma, scale, grad));
                graph.backward(weights, ws);
            });
        });
        let [(a, loss_a), (b, loss_b)] = &mut parts[..] else { unreachable!("two parts") };
        let mut gradients = [a.gradient_mut(), b.gradient_mut()];
        let (gradients, loss) =
            if rows[1].is_empty() { (&mut gradients[..1], *loss_a) } else { (&mut gradients[..], *loss_a + *loss_b) };
        params.with_mut(|p| adam.step(p, gradients));
        loss
    }

    /// Scores of each row: softmax over the latents, `B x K`.
    pub fn scores(&mut self, obs: &[f32], batch: usize, scores: &mut Vec<f32>) {
        let Self { latents, params, graph, obs: input, out, packed, parts, .. } = self;
        let (rows, width, k) = (split(batch), obs.len() / batch.max(1), *latents);
        graph.refresh(params, packed, false);
        scores.resize(batch * k, 0.0);
        let (first, second) = scores.split_at_mut(rows[0].len() * k);
        let [a, b] = &mut parts[..] else { unreachable!("two parts") };
        params.with(|p| {
            let weights = Weights { flat: p, packed };
            each(&mut [(a, first), (b, second)], &rows, |((ws, _), scores), rows| {
                let numbers = rows.start * width..rows.end * width;
                ws.value_mut(*input)[..numbers.len()].copy_from_slice(&obs[numbers]);
                graph.forward(weights, ws, rows.len(), false);
                scores.copy_from_slice(&ws.value(*out)[..rows.len() * k]);
                softmax_rows(scores, k);
            });
        });
    }

    /// Masks of each row, `B x K`; returns how many rows fell back (rules 2 and 3 of specification 3.3).
    pub fn masks(&mut self, obs: &[f32], batch: usize, scores: &mut Vec<f32>, allowed: &mut Vec<bool>) -> usize {
        self.scores(obs, batch, scores);
        allowed.resize(batch * self.latents, true);
        let threshold = self.threshold();
        let rows = scores.chunks_exact(self.latents).zip(allowed.chunks_exact_mut(self.latents));
        rows.filter_map(|(s, a)| (mask(s, threshold, a) != MaskRule::Threshold).then_some(())).count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Specification, appendix A, item 6.
    #[test]
    fn mask_rules() {
        let mut allowed = [false; 4];
        assert_eq!(mask(&[0.25; 4], 0.25, &mut allowed), MaskRule::Uniform);
        assert_eq!(allowed, [true; 4]);
        assert_eq!(mask(&[0.3, 0.25, 0.25, 0.2], 1.5 / 4.0, &mut allowed), MaskRule::Fallback);
        assert_eq!(allowed, [true, false, false, false]);
        assert_eq!(mask(&[0.3, 0.25, 0.26, 0.19], 0.25, &mut allowed), MaskRule::Threshold);
        assert_eq!(allowed, [true, false, true, false]);
    }

    /// Specification 3.2, the table of exact fixed points, by gradient descent on the logits of one state.
    #[test]
    fn focal_fixed_points() {
        let cases: [(&[f32], f32, &[f32]); 4] = [
            (&[0.7, 0.2, 0.1, 0.0], 0.0, &[0.7, 0.2, 0.1, 0.0]),
            (&[0.7, 0.2, 0.1, 0.0], 2.0, &[0.508, 0.297, 0.195, 0.0]),
            (&[0.97, 0.01, 0.01, 0.01], 5.0, &[0.556, 0.148, 0.148, 0.148]),
            (&[0.5, 0.3, 0.1, 0.05, 0.05, 0.0, 0.0, 0.0], 2.0, &[0.384, 0.299, 0.147, 0.085, 0.085, 0.0, 0.0, 0.0]),
        ];
        for (q, gamma, expected) in cases {
            let mut logits = vec![0.0; q.len()];
            let mut grad = vec![0.0; q.len()];
            for _ in 0..40_000 {
                let mut total = vec![0.0; q.len()];
                for (class, &share) in q.iter().enumerate().filter(|(_, s)| **s > 0.0) {
                    focal(&logits, class, gamma, share, &mut grad);
                    total.iter_mut().zip(&grad).for_each(|(t, g)| *t += g);
                }
                logits.iter_mut().zip(&total).for_each(|(l, t)| *l -= 1.0 * t);
            }
            softmax_rows(&mut logits, q.len());
            for (p, e) in logits.iter().zip(expected) {
                assert!((p - e).abs() < 5e-3, "gamma {gamma}: {logits:?}, expected {expected:?}");
            }
        }
    }

    #[test]
    fn the_predictor_starts_near_uniform_and_learns_absent_codes() {
        let mut rng = crate::seed::SeedTree::new(5).stream("conf");
        let config = ConfidenceConfig {
            hidden: vec![32],
            adam: crate::nn::AdamConfig { learning_rate: 3e-3, ..Default::default() },
            ..Default::default()
        };
        let mut conf = Confidence::new(config, 1, 4, 64, &mut rng).unwrap();
        let mut scores = Vec::new();
        conf.scores(&[1.0], 1, &mut scores);
        assert!(scores.iter().all(|s| (s - 0.25).abs() < 2e-3), "{scores:?}");
        let obs: Vec<f32> = (0..64).map(|i| if i % 2 == 0 { 1.0 } else { -1.0 }).collect();
        let codes: Vec<u32> = (0..64).map(|i| if i % 2 == 0 { i / 2 % 2 } else { 3 }).collect();
        for _ in 0..500 {
            conf.update(&obs, &codes);
        }
        let mut allowed = Vec::new();
        conf.masks(&[1.0, -1.0], 2, &mut scores, &mut allowed);
        assert_eq!(allowed, [true, true, false, false, false, false, false, true]);
    }
}
