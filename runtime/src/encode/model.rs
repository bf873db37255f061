//! The float model that is exported, with owned data.

use crate::provenance::ReturnStats;
use crate::space::ActionHead;
use std::string::String;
use std::vec::Vec;

/// A dense layer `y = W x + b`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Dense {
    /// Outputs.
    pub rows: usize,
    /// Inputs.
    pub cols: usize,
    /// Weights, row-major, `rows x cols`.
    pub weight: Vec<f32>,
    /// Bias, one per row.
    pub bias: Vec<f32>,
}

/// The decoder: from observation and latent to head values.
#[derive(Clone, Debug, PartialEq)]
pub enum FloatDecoder {
    /// `relu(scale_k * (W x + b) + shift_k)`, then ReLU layers, then a linear head layer.
    Modulated {
        /// First layer, on the normalised observation.
        state: Dense,
        /// Per latent, per row of `state`.
        scale: Vec<Vec<f32>>,
        /// Per latent, per row of `state`.
        shift: Vec<Vec<f32>>,
        /// ReLU layers.
        hidden: Vec<Dense>,
        /// Linear layer that feeds the heads.
        head: Dense,
    },
    /// One constant action per latent, one value per slot as it goes into [`ActionHead::denormalise`]: -1..=1 for a
    /// continuous slot, the type index for a discrete one, 0 or 1 for a switch.
    Table {
        /// Per latent, per action slot.
        actions: Vec<Vec<f32>>,
    },
}

/// When a categorical head returns an atom itself instead of the expectation: its probability is at least 0.9.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Snap {
    /// Never.
    None,
    /// For the first and the last atom.
    #[default]
    Edges,
    /// For any atom.
    Any,
}

/// How the rows of the head layer make one action slot. Slots take their rows in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HeadEncoding {
    /// Continuous slot, one row: `tanh`.
    Tanh,
    /// Continuous slot, `atoms` rows: expectation over atoms on -1..=1.
    Categorical {
        /// Number of atoms.
        atoms: usize,
        /// Snap rule.
        snap: Snap,
    },
    /// Discrete slot of `n` types, `n` rows: argmax, ties to the lowest type.
    Types,
    /// Binary slot, one row: on when positive.
    Switch,
}

/// An observation signal, owned.
#[derive(Clone, Debug, PartialEq)]
pub struct ObservationSlot {
    /// Name, unique in the policy.
    pub name: String,
    /// Unit, empty when the signal has none.
    pub unit: String,
    /// Lower bound of the usual range; infinite: taken from the calibration observations.
    pub lo: f32,
    /// Upper bound of the usual range; infinite: taken from the calibration observations.
    pub hi: f32,
}

/// An action slot, owned.
#[derive(Clone, Debug, PartialEq)]
pub struct ActionSlot {
    /// Name, unique in the policy.
    pub name: String,
    /// Unit, empty when the signal has none.
    pub unit: String,
    /// What the slot may hold.
    pub head: ActionHead,
    /// Value that brings the actuator to a safe state.
    pub safe: f32,
}

/// The interface record, owned.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Interface {
    /// Observation signals, in order.
    pub observations: Vec<ObservationSlot>,
    /// Action slots, in order.
    pub actions: Vec<ActionSlot>,
    /// Time between two steps, in microseconds.
    pub control_period_us: u32,
}

/// [`Provenance`](crate::Provenance), owned.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ProvenanceOwned {
    /// Environment id, such as `Hopper-v5`.
    pub environment: String,
    /// Learner, such as `dqn`.
    pub algorithm: String,
    /// Hash of the resolved configuration, in hexadecimal.
    pub config_hash: String,
    /// Commit of the program that exports the file.
    pub commit: String,
    /// Seed of the training run.
    pub train_seed: u64,
    /// Seed of the evaluation episodes.
    pub eval_seed: u64,
    /// Environment steps of the training run.
    pub env_steps: u64,
    /// Return of the float policy.
    pub float_return: ReturnStats,
    /// Return of the policy in the file, on the same seeds.
    pub device_return: ReturnStats,
}

/// A whole float policy.
#[derive(Clone, Debug, PartialEq)]
pub struct FloatModel {
    /// What it sees and drives.
    pub interface: Interface,
    /// Mean of each observation.
    pub obs_mean: Vec<f32>,
    /// Standard deviation of each observation; the networks see `(x - mean) / std`.
    pub obs_std: Vec<f32>,
    /// Q-network: ReLU layers, the last one linear with K rows.
    pub q: Vec<Dense>,
    /// Confidence network: ReLU layers, the last one linear with K rows.
    pub confidence: Option<Vec<Dense>>,
    /// The confidence network reads the Q-network's last hidden layer (after its ReLU) instead of the observation.
    pub shared_trunk: bool,
    /// Mask threshold in 0..1; 1/K by default.
    pub beta: f32,
    /// Decoder.
    pub decoder: FloatDecoder,
    /// One per action slot, in slot order; empty for a table decoder.
    pub heads: Vec<HeadEncoding>,
    /// Where the model comes from.
    pub provenance: ProvenanceOwned,
}

impl HeadEncoding {
    /// Rows of the head layer that a slot of this kind takes.
    #[must_use]
    pub fn rows(self, head: ActionHead) -> usize {
        match (self, head) {
            (Self::Categorical { atoms, .. }, _) => atoms,
            (Self::Types, ActionHead::Discrete { n }) => usize::from(n),
            _ => 1,
        }
    }
}

impl FloatModel {
    /// Number of latents K: rows of the Q-network's last layer.
    #[must_use]
    pub fn num_latents(&self) -> usize {
        self.q.last().map_or(0, |layer| layer.rows)
    }
}

impl Interface {
    /// Replaces infinite observation bounds by the range of `calibration` (`N x observations`, row-major), widened by
    /// `margin` of its width on both sides and at least by 1e-3.
    #[must_use]
    pub fn with_finite_bounds(&self, calibration: &[f32], margin: f32) -> Self {
        let mut interface = self.clone();
        let dim = self.observations.len().max(1);
        for (index, slot) in interface.observations.iter_mut().enumerate() {
            let column = calibration.iter().skip(index).step_by(dim);
            let lo = column.clone().copied().fold(f32::INFINITY, f32::min);
            let hi = column.copied().fold(f32::NEG_INFINITY, f32::max);
            let (lo, hi) = if lo <= hi { (lo, hi) } else { (-1.0, 1.0) };
            let pad = ((hi - lo) * margin).max(1e-3);
            if slot.lo == f32::NEG_INFINITY {
                slot.lo = (lo - pad).min(slot.hi - pad);
            }
            if slot.hi == f32::INFINITY {
                slot.hi = (hi + pad).max(slot.lo + pad);
            }
        }
        interface
    }
}
