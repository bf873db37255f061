//! The discrete side of a parameterised action space: types, or combinations of switches, and the arguments that each uses.

use gadm_envs::EnvSpec;
use gadm_runtime::space::ActionHead;

use crate::action_space::{ActionSpace, ContinuousHead};
use crate::algo::listed;
use crate::error::TrainError;

/// Types with the arguments that they use.
#[derive(Clone, Debug)]
pub struct Types {
    /// Slots of an action, arguments included.
    pub slots: usize,
    /// Where the arguments begin: discrete slots come first.
    pub first: usize,
    /// Actions of each type with all arguments 0, `K x slots`.
    pub rows: Vec<f32>,
    /// Whether type `k` uses argument `j`, `K x arguments`: a dense matrix, since arguments may belong to many types.
    pub uses: Vec<bool>,
}

impl Types {
    /// Of an environment; at most `limit` types.
    ///
    /// # Errors
    /// [`TrainError::Config`] for an environment without types, without arguments, or with too many types.
    pub fn new(spec: &EnvSpec, algorithm: &str, limit: usize) -> Result<Self, TrainError> {
        let space = ActionSpace::new(spec, ContinuousHead::Tanh, true);
        let slots = space.slots();
        let first = space.heads().iter().filter(|h| !matches!(h, ActionHead::Continuous { .. })).count();
        if first == 0 || first == slots {
            let expected = "another algorithm for an environment that has not both discrete choices and arguments";
            return Err(TrainError::config("algo", expected, format!("{algorithm}, and {}", spec.id)));
        }
        if listed::count(&space, 1).is_none_or(|n| n > limit) {
            let expected = format!("at least the number of combinations of types and switches of {}", spec.id);
            return Err(TrainError::config(&format!("{algorithm}.limit"), &expected, limit));
        }
        let rows = listed::product(&space, &[0.0]);
        let uses = rows.chunks_exact(slots).flat_map(|row| (first..slots).map(|slot| space.counts(row, slot)));
        Ok(Self { slots, first, uses: uses.collect(), rows })
    }

    /// Types, K.
    pub fn len(&self) -> usize {
        self.rows.len() / self.slots
    }

    /// Never: there is at least one type.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Arguments.
    pub fn arguments(&self) -> usize {
        self.slots - self.first
    }

    /// Writes the action of type `k` with the arguments `x`.
    pub fn write(&self, k: usize, x: &[f32], action: &mut [f32]) {
        action[..self.first].copy_from_slice(&self.rows[k * self.slots..][..self.first]);
        action[self.first..].copy_from_slice(x);
    }

    /// The type of an action.
    pub fn of(&self, action: &[f32]) -> usize {
        let same = |row: &[f32]| row[..self.first] == action[..self.first];
        self.rows.chunks_exact(self.slots).position(same).unwrap_or(0)
    }
}
