//! Reconstruction loss of decoder outputs, with its gradient (specification 2.8).

use gadm_runtime::space::ActionHead;

use super::config::RegressionLoss;
use crate::action_space::{ActionSpace, ContinuousHead, atom};
use crate::nn::vector::{exp_sum, max, vectorised};

/// Settings the loss needs.
#[derive(Clone, Copy, Debug)]
pub struct ReconstructionLoss {
    /// Loss of continuous slots.
    pub regression: RegressionLoss,
    /// Weight of the continuous part.
    pub continuous_weight: f32,
    /// Weight of the two-hot cross-entropy (categorical head).
    pub two_hot_weight: f32,
}

/// The parts of a reconstruction loss, each a mean.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Reconstruction {
    /// Mean over the continuous slots that count.
    pub continuous: f32,
    /// Mean over the batch: cross-entropy of the type, plus that of every switch.
    pub types: f32,
    /// Mean cross-entropy to the two-hot projection over the continuous slots that count.
    pub two_hot: f32,
}

impl ReconstructionLoss {
    /// Loss of `outputs` (`batch x output_width`) against `actions` (`batch x slots`); writes the gradient of
    /// `continuous_weight · continuous + types + two_hot_weight · two_hot` into `grad`.
    pub fn evaluate(&self, space: &ActionSpace, outputs: &[f32], actions: &[f32], grad: &mut [f32]) -> Reconstruction {
        let count = Count::of(space, actions);
        vectorised!(self.evaluate_part(space, outputs, actions, grad, count))
    }

    /// [`evaluate`](Self::evaluate) of some of the rows of a batch that has `count` in all: the parts add up to the whole.
    #[inline(always)]
    pub fn evaluate_part(
        &self,
        space: &ActionSpace,
        outputs: &[f32],
        actions: &[f32],
        grad: &mut [f32],
        count: Count,
    ) -> Reconstruction {
        let (slots, width) = (space.slots(), space.output_width());
        let batch = actions.len() / slots;
        let each = 1.0 / count.arguments.max(1) as f32;
        let row = 1.0 / count.rows as f32;
        let mut loss = Reconstruction::default();
        for ((a, o), g) in
            actions.chunks_exact(slots).zip(outputs.chunks_exact(width)).zip(grad.chunks_exact_mut(width)).take(batch)
        {
            for (slot, (head, range)) in space.outputs().enumerate() {
                let (o, g) = (&o[range.clone()], &mut g[range]);
                match head {
                    ActionHead::Discrete { .. } => loss.types += row * cross_entropy(o, a[slot] as usize, row, g),
                    ActionHead::Binary => {
                        let p = 1.0 / (1.0 + (-o[0]).exp());
                        // ln(1 + e^-|x|) form: finite for any logit.
                        loss.types += row * (o[0].max(0.0) - o[0] * a[slot] + (-o[0].abs()).exp().ln_1p());
                        g[0] = row * (p - a[slot]);
                    }
                    ActionHead::Continuous { .. } if !space.counts(a, slot) => g.fill(0.0),
                    ActionHead::Continuous { .. } => match space.continuous_head() {
                        ContinuousHead::Tanh => {
                            let y = o[0].tanh();
                            let (value, slope) = self.pointwise(y - a[slot]);
                            loss.continuous += each * value;
                            g[0] = self.continuous_weight * each * slope * (1.0 - y * y);
                        }
                        ContinuousHead::Categorical { atoms, .. } => {
                            let part = self.categorical(o, a[slot], atoms, each, g);
                            loss.continuous += each * part.0;
                            loss.two_hot += each * part.1;
                        }
                    },
                }
            }
        }
        loss
    }

    #[inline(always)]
    fn pointwise(&self, error: f32) -> (f32, f32) {
        match self.regression {
            RegressionLoss::Mse => (error * error, 2.0 * error),
            RegressionLoss::L1 => (error.abs(), error.signum()),
            RegressionLoss::Huber if error.abs() <= 1.0 => (0.5 * error * error, error),
            RegressionLoss::Huber => (error.abs() - 0.5, error.signum()),
        }
    }

    /// Returns the regression loss of the expectation and the two-hot cross-entropy.
    #[inline(always)]
    fn categorical(&self, o: &[f32], target: f32, atoms: usize, each: f32, g: &mut [f32]) -> (f32, f32) {
        let top = max(o);
        g.copy_from_slice(o);
        let sum = exp_sum(g, top);
        let mut lanes = [0.0_f32; 8];
        let (chunks, rest) = g.as_chunks::<8>();
        for (i, chunk) in chunks.iter().enumerate() {
            for (j, (lane, e)) in lanes.iter_mut().zip(chunk).enumerate() {
                *lane += e * atom(8 * i + j, atoms);
            }
        }
        for (j, (lane, e)) in lanes.iter_mut().zip(rest).enumerate() {
            *lane += e * atom(8 * chunks.len() + j, atoms);
        }
        let value = lanes.iter().sum::<f32>() / sum;
        let (loss, slope) = self.pointwise(value - target);
        let position = (target + 1.0) * 0.5 * (atoms - 1) as f32;
        let low = (position.floor() as usize).min(atoms - 2);
        let high_share = position - low as f32;
        let log_sum = sum.ln() + top;
        let two_hot = (1.0 - high_share) * (log_sum - o[low]) + high_share * (log_sum - o[low + 1]);
        let (regression, inverse) = (self.continuous_weight * slope, 1.0 / sum);
        for (j, g) in g.iter_mut().enumerate() {
            let p = *g * inverse;
            *g = each * p * (regression * (atom(j, atoms) - value) + self.two_hot_weight);
        }
        g[low] -= each * self.two_hot_weight * (1.0 - high_share);
        g[low + 1] -= each * self.two_hot_weight * high_share;
        (loss, two_hot)
    }
}

/// What the means of a batch are taken over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Count {
    /// Rows.
    pub rows: usize,
    /// Continuous slots that count.
    pub arguments: usize,
}

impl Count {
    /// Of a batch of `actions`, one row each.
    pub fn of(space: &ActionSpace, actions: &[f32]) -> Self {
        let slots = space.slots();
        let counts = |a: &[f32]| (0..slots).filter(|&s| is_continuous(space, s) && space.counts(a, s)).count();
        Self { rows: actions.len() / slots, arguments: actions.chunks_exact(slots).map(counts).sum() }
    }
}

fn is_continuous(space: &ActionSpace, slot: usize) -> bool {
    matches!(space.heads()[slot], ActionHead::Continuous { .. })
}

/// Cross-entropy of `logits` with class `class`; writes `scale · (softmax - one-hot)` into `grad`.
#[inline(always)]
pub fn cross_entropy(logits: &[f32], class: usize, scale: f32, grad: &mut [f32]) -> f32 {
    let top = max(logits);
    grad.copy_from_slice(logits);
    let sum = exp_sum(grad, top);
    let factor = scale / sum;
    for g in &mut *grad {
        *g *= factor;
    }
    grad[class] -= scale;
    sum.ln() + top - logits[class]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::seed::SeedTree;
    use gadm_envs::{ActionSignal, ArgumentMask, EnvSpec};
    use rand::RngExt as _;

    fn space(head: ContinuousHead) -> ActionSpace {
        let signal = |head| ActionSignal { name: "a".into(), unit: "1".into(), head, safe: 0.0 };
        let continuous = ActionHead::Continuous { lo: -1.0, hi: 1.0 };
        let spec = EnvSpec {
            id: "test".into(),
            observations: Vec::new(),
            actions: [ActionHead::Binary, ActionHead::Binary, continuous, continuous].map(signal).to_vec(),
            argument_mask: ArgumentMask::BySwitch,
            control_period_us: 1,
            time_limit: None,
            goal_terminal: false,
        };
        ActionSpace::new(&spec, head, true)
    }

    /// Every gradient against central differences of the loss itself.
    #[test]
    fn gradients_are_the_differences_of_the_loss() {
        let mut rng = SeedTree::new(3).stream("loss");
        for head in
            [ContinuousHead::Tanh, ContinuousHead::Categorical { atoms: 5, snap: crate::action_space::SnapRule::None }]
        {
            for regression in [RegressionLoss::Mse, RegressionLoss::L1, RegressionLoss::Huber] {
                let loss = ReconstructionLoss { regression, continuous_weight: 0.7, two_hot_weight: 0.3 };
                let space = space(head);
                let actions = [1.0, 0.0, 0.9, 0.0, 1.0, 1.0, -0.35, 0.2];
                let width = space.output_width();
                let mut out: Vec<f32> = (0..2 * width).map(|_| rng.random_range(-1.5_f32..1.5)).collect();
                let mut grad = vec![9.0; out.len()];
                let total = |out: &[f32]| {
                    let r = loss.evaluate(&space, out, &actions, &mut vec![0.0; out.len()]);
                    let two_hot = if matches!(head, ContinuousHead::Tanh) { 0.0 } else { 0.3 * r.two_hot };
                    0.7 * r.continuous + r.types + two_hot
                };
                loss.evaluate(&space, &out, &actions, &mut grad);
                for i in 0..out.len() {
                    let at = out[i];
                    out[i] = at + 5e-3;
                    let up = total(&out);
                    out[i] = at - 5e-3;
                    let down = total(&out);
                    out[i] = at;
                    assert!((grad[i] - (up - down) / 1e-2).abs() < 2e-4, "{head:?} {regression:?} output {i}");
                }
                // The second switch of the first action is off: its argument has no loss.
                assert!(grad[width - (width - 2) / 2..width].iter().all(|&g| g == 0.0));
            }
        }
    }
}
