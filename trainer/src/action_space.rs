//! How an action is written for the networks: slots of an action, inputs of the encoder, outputs of the decoder.
//!
//! Inside the trainer an action has one number per slot: the type index, 0 or 1 for a switch, and the *normalised* value in
//! -1..=1 for a continuous slot. Only the environment sees native units.

use gadm_envs::{ArgumentMask, EnvSpec};
use gadm_runtime::space::ActionHead;
use rand::RngExt as _;
use serde::{Deserialize, Serialize};

use crate::error::TrainError;
use crate::nn::normal;
use crate::seed::Rng;

/// When the value of an edge atom replaces the expectation (paper eq. 14 and its snap rule; specification 2.7).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SnapRule {
    /// Never.
    None,
    /// Only the two edge atoms, at probability 0.9 or more.
    #[default]
    Edges,
    /// Any atom, at probability 0.9 or more.
    Any,
}

/// Head of a continuous slot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", tag = "kind", deny_unknown_fields)]
pub enum ContinuousHead {
    /// `tanh` of one output.
    #[default]
    Tanh,
    /// Extreme Action Regression: expectation of a softmax over equally spaced atoms, both ends included (paper eq. 14).
    Categorical {
        /// Atoms J (the paper's N + 1).
        #[serde(default = "default_atoms")]
        atoms: usize,
        /// Snap rule at evaluation; never used while training or collecting.
        #[serde(default)]
        snap: SnapRule,
    },
}

fn default_atoms() -> usize {
    11
}

/// Probability from which an atom snaps.
pub const SNAP_THRESHOLD: f32 = 0.9;

/// The action space of an environment as the networks see it.
#[derive(Clone, Debug, PartialEq)]
pub struct ActionSpace {
    heads: Vec<ActionHead>,
    mask: ArgumentMask,
    head: ContinuousHead,
}

/// Value of atom `j` of `atoms`: equally spaced on -1..=1.
pub fn atom(j: usize, atoms: usize) -> f32 {
    2.0 * j as f32 / (atoms - 1) as f32 - 1.0
}

impl ActionSpace {
    /// The space of an environment; `masked` = false ignores its argument mask (ablation).
    pub fn new(spec: &EnvSpec, head: ContinuousHead, masked: bool) -> Self {
        Self {
            heads: spec.actions.iter().map(|a| a.head).collect(),
            mask: if masked { spec.argument_mask.clone() } else { ArgumentMask::All },
            head,
        }
    }

    /// Slots of an action.
    pub fn slots(&self) -> usize {
        self.heads.len()
    }

    /// Heads, in slot order.
    pub fn heads(&self) -> &[ActionHead] {
        &self.heads
    }

    /// Refuses an environment with types or switches, for an algorithm that has none.
    ///
    /// # Errors
    /// [`TrainError::Config`] with the first such slot.
    pub fn all_continuous(&self, algorithm: &str, spec: &EnvSpec) -> Result<(), TrainError> {
        match spec.actions.iter().find(|a| !matches!(a.head, ActionHead::Continuous { .. })) {
            None => Ok(()),
            Some(other) => {
                let expected = "another algorithm for an environment with discrete actions";
                let found = format!("{algorithm} (continuous actions only), and `{}` of {}", other.name, spec.id);
                Err(TrainError::config("algo", expected, found))
            }
        }
    }

    /// Head of the continuous slots.
    pub fn continuous_head(&self) -> ContinuousHead {
        self.head
    }

    /// Width of the encoder's action input: one-hot types, ±1 switches, continuous values.
    pub fn input_width(&self) -> usize {
        self.heads.iter().map(|h| if let ActionHead::Discrete { n } = h { usize::from(*n) } else { 1 }).sum()
    }

    /// Width of the decoder's output: logits of types and switches, then `1` or `J` numbers per continuous slot, in slot order.
    pub fn output_width(&self) -> usize {
        self.heads.iter().map(|h| self.outputs_of(*h)).sum()
    }

    fn outputs_of(&self, head: ActionHead) -> usize {
        match (head, self.head) {
            (ActionHead::Discrete { n }, _) => usize::from(n),
            (ActionHead::Continuous { .. }, ContinuousHead::Categorical { atoms, .. }) => atoms,
            _ => 1,
        }
    }

    /// Slots with the outputs that belong to them.
    pub(crate) fn outputs(&self) -> impl Iterator<Item = (ActionHead, std::ops::Range<usize>)> + '_ {
        self.heads.iter().scan(0, |at, &head| {
            let range = *at..*at + self.outputs_of(head);
            *at = range.end;
            Some((head, range))
        })
    }

    /// Whether slot `slot` of `action` has an effect, by the environment's argument mask.
    pub fn counts(&self, action: &[f32], slot: usize) -> bool {
        if !matches!(self.heads[slot], ActionHead::Continuous { .. }) {
            return true;
        }
        let argument = slot - self.heads.iter().filter(|h| !matches!(h, ActionHead::Continuous { .. })).count();
        match &self.mask {
            ArgumentMask::All => true,
            ArgumentMask::ByType(rows) => rows[action[0] as usize][argument],
            ArgumentMask::BySwitch => action[argument] > 0.5,
        }
    }

    /// Writes the encoder's input (`input_width` numbers) for an action. Arguments without effect are 0: the decoder's
    /// are arbitrary, and would make an executed latent fall on another one when it is assigned again.
    pub fn encode(&self, action: &[f32], input: &mut [f32]) {
        let mut at = 0;
        for (slot, (head, &value)) in self.heads.iter().zip(action).enumerate() {
            match head {
                ActionHead::Discrete { n } => {
                    input[at..at + usize::from(*n)].fill(0.0);
                    input[at + value as usize] = 1.0;
                    at += usize::from(*n);
                }
                ActionHead::Binary => {
                    input[at] = 2.0 * value - 1.0;
                    at += 1;
                }
                ActionHead::Continuous { .. } => {
                    input[at] = if self.counts(action, slot) { value } else { 0.0 };
                    at += 1;
                }
            }
        }
    }

    /// Writes the action for one row of decoder outputs: argmax of types, sign of switches, tanh or expectation of the rest.
    /// `snap` switches the snap rule on (evaluation).
    pub fn decode(&self, outputs: &[f32], action: &mut [f32], snap: bool) {
        for ((head, range), slot) in self.outputs().zip(action.iter_mut()) {
            let out = &outputs[range];
            *slot = match (head, self.head) {
                (ActionHead::Discrete { .. }, _) => crate::nn::argmax(out) as f32,
                (ActionHead::Binary, _) => f32::from(out[0] > 0.0),
                (ActionHead::Continuous { .. }, ContinuousHead::Tanh) => out[0].tanh(),
                (ActionHead::Continuous { .. }, ContinuousHead::Categorical { atoms, snap: rule }) => {
                    expectation(out, atoms, if snap { rule } else { SnapRule::None })
                }
            };
        }
    }

    /// Squared distance of `other` from `action`: of the continuous slots that have an effect in `action`, and the square of the
    /// range for every type or switch that differs.
    pub fn distance(&self, action: &[f32], other: &[f32]) -> f32 {
        let slots = self.heads.iter().zip(action.iter().zip(other)).enumerate();
        slots
            .map(|(slot, (head, (a, b)))| match head {
                ActionHead::Continuous { .. } if self.counts(action, slot) => (a - b) * (a - b),
                ActionHead::Continuous { .. } => 0.0,
                _ if a == b => 0.0,
                _ => 4.0,
            })
            .sum()
    }

    /// A uniformly random action: every type, switch and normalised value equally likely.
    pub fn random(&self, rng: &mut Rng, action: &mut [f32]) {
        for (head, slot) in self.heads.iter().zip(action.iter_mut()) {
            *slot = match head {
                ActionHead::Discrete { n } => f32::from(rng.random_range(0..*n)),
                ActionHead::Binary => f32::from(u8::from(rng.random_bool(0.5))),
                ActionHead::Continuous { .. } => rng.random_range(-1.0..=1.0),
            };
        }
    }

    /// Replaces the continuous slots by fair coins in {-1, +1} (extreme Bernoulli noise, specification 4.4).
    pub fn extreme(&self, rng: &mut Rng, action: &mut [f32]) {
        for (head, slot) in self.heads.iter().zip(action.iter_mut()) {
            if let ActionHead::Continuous { .. } = head {
                *slot = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
            }
        }
    }

    /// Adds Gaussian noise of standard deviation `sigma`, cut to ±0.5, to the continuous slots (the authors' first exploration,
    /// specification 4.4: `a + clip(N(0, σ²), -0.5, 0.5)`, cut to -1..=1).
    pub fn gaussian(&self, sigma: f32, rng: &mut Rng, action: &mut [f32]) {
        for (head, slot) in self.heads.iter().zip(action.iter_mut()) {
            if let ActionHead::Continuous { .. } = head {
                *slot = (*slot + (sigma * normal(rng)).clamp(-0.5, 0.5)).clamp(-1.0, 1.0);
            }
        }
    }

    /// The action in native units, as the environment takes it.
    pub fn to_native(&self, action: &[f32], native: &mut [f32]) {
        for ((head, &a), n) in self.heads.iter().zip(action).zip(native) {
            *n = head.denormalise(a);
        }
    }
}

/// Expectation of the softmax of `logits` over equally spaced atoms, with a snap rule.
pub fn expectation(logits: &[f32], atoms: usize, snap: SnapRule) -> f32 {
    let top = logits.iter().fold(f32::NEG_INFINITY, |m, &l| m.max(l));
    let (mut sum, mut weighted, mut best) = (0.0, 0.0, (0, 0.0));
    for (j, &l) in logits.iter().enumerate() {
        let e = (l - top).exp();
        sum += e;
        weighted += e * atom(j, atoms);
        if e > best.1 {
            best = (j, e);
        }
    }
    let edge = best.0 == 0 || best.0 == atoms - 1;
    if best.1 >= SNAP_THRESHOLD * sum && (snap == SnapRule::Any || snap == SnapRule::Edges && edge) {
        return atom(best.0, atoms);
    }
    weighted / sum
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Specification, appendix A, item 4.
    #[test]
    fn snap_rule_follows_the_specification() {
        let mut logits = [0.0; 11];
        logits[10] = 20.0;
        assert_eq!(expectation(&logits, 11, SnapRule::Edges), 1.0);
        let unsnapped = expectation(&logits, 11, SnapRule::None);
        assert!((0.999_999..1.0).contains(&unsnapped) || unsnapped == 1.0);
        let with_probability = |atom: usize, p: f32| {
            let mut logits = [0.0_f32; 11];
            logits[atom] = (p / (1.0 - p) * 10.0).ln();
            logits
        };
        assert!(expectation(&with_probability(0, 0.89), 11, SnapRule::Edges) > -1.0);
        assert_eq!(expectation(&with_probability(0, 0.91), 11, SnapRule::Edges), -1.0);
        assert_ne!(expectation(&with_probability(3, 0.95), 11, SnapRule::Edges), atom(3, 11));
        assert_eq!(expectation(&with_probability(3, 0.95), 11, SnapRule::Any), atom(3, 11));
    }

    #[test]
    fn gaussian_noise_moves_continuous_slots_alone_and_by_half_at_most() {
        let spec = gadm_envs::make("moving").unwrap().spec().clone();
        let space = ActionSpace::new(&spec, ContinuousHead::Tanh, true);
        let mut rng = crate::seed::SeedTree::new(1).stream("noise");
        let n = 4000;
        let (mut squares, mut furthest) = (0.0, 0.0_f32);
        for _ in 0..n {
            let mut action = [2.0, 0.0, 0.9];
            space.gaussian(0.1, &mut rng, &mut action);
            assert!(
                action[0] == 2.0 && action[2] <= 1.0,
                "{action:?}: a type has no noise, a value stays in its range"
            );
            squares += action[1] * action[1];
            let mut far = [0.0; 3];
            space.gaussian(9.0, &mut rng, &mut far);
            furthest = furthest.max(far[1].abs());
        }
        let variance = squares / n as f32;
        assert!((variance - 0.01).abs() < 0.001, "variance at sigma = 0.1: {variance}");
        assert_eq!(furthest, 0.5, "the bound is met and not passed");
    }

    #[test]
    fn the_distance_counts_types_and_what_has_an_effect() {
        let spec = gadm_envs::make("moving").unwrap().spec().clone();
        let space = ActionSpace::new(&spec, ContinuousHead::Tanh, true);
        let turn = [1.0, 0.7, -0.5];
        assert_eq!(space.distance(&turn, &[1.0, -0.9, 0.0]), 0.25, "turning does not use the acceleration");
        assert_eq!(space.distance(&turn, &[0.0, 0.7, -0.5]), 4.0);
        assert_eq!(space.distance(&[0.0, 0.5, 0.1], &[2.0, 0.0, 0.9]), 4.25, "what counts is the first one's");
    }

    #[test]
    fn a_hybrid_action_is_written_and_read_back() {
        let spec = gadm_envs::make("moving").unwrap().spec().clone();
        let space = ActionSpace::new(&spec, ContinuousHead::Tanh, true);
        assert_eq!((space.slots(), space.input_width(), space.output_width()), (3, 5, 5));
        let mut action = [1.0, 0.7, -0.4];
        assert!(space.counts(&action, 0) && !space.counts(&action, 1), "turning does not use the acceleration");
        assert!(space.counts(&action, 2));
        let mut input = [9.0; 5];
        space.encode(&action, &mut input);
        assert_eq!(input, [0.0, 1.0, 0.0, 0.0, -0.4], "what has no effect is not seen");
        space.decode(&[0.0, 3.0, 1.0, 5.0, -5.0], &mut action, true);
        assert_eq!(action[0], 1.0);
        assert!((action[2] + 0.999_909).abs() < 1e-5);
    }
}
