//! Hand-made lists of actions.

use gadm_runtime::space::ActionHead;
use serde::{Deserialize, Serialize};

use crate::action_space::ActionSpace;

/// Values of the bins of a continuous slot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Grid {
    /// `-1 + 2j/(m - 1)`: both ends included.
    #[default]
    Inclusive,
    /// `-1 + 2j/m`: the grid of the GADM authors' code, which never reaches +1.
    Authors,
}

/// The `m` values of a slot, `j = 0..m`; `m` is at least 2.
pub fn bins(grid: Grid, m: usize) -> Vec<f32> {
    let step = match grid {
        Grid::Inclusive => 2.0 / (m - 1) as f32,
        Grid::Authors => 2.0 / m as f32,
    };
    (0..m).map(|j| -1.0 + step * j as f32).collect()
}

/// Options of a slot: types, switch positions, or bins; a single one where the slot has no effect in `action`.
fn options(space: &ActionSpace, action: &[f32], slot: usize, bins: usize) -> usize {
    match space.heads()[slot] {
        ActionHead::Discrete { n } => usize::from(n),
        ActionHead::Binary => 2,
        ActionHead::Continuous { .. } if space.counts(action, slot) => bins,
        ActionHead::Continuous { .. } => 1,
    }
}

/// Actions of the Cartesian product with that many bins; `None` beyond what can be counted.
pub fn count(space: &ActionSpace, bins: usize) -> Option<usize> {
    fn from(space: &ActionSpace, action: &mut [f32], slot: usize, bins: usize) -> Option<usize> {
        if slot == space.slots() {
            return Some(1);
        }
        let n = options(space, action, slot, bins);
        if matches!(space.heads()[slot], ActionHead::Continuous { .. }) {
            return from(space, action, slot + 1, bins)?.checked_mul(n);
        }
        (0..n).try_fold(0_usize, |sum, value| {
            action[slot] = value as f32;
            sum.checked_add(from(space, action, slot + 1, bins)?)
        })
    }
    from(space, &mut vec![0.0; space.slots()], 0, bins)
}

/// Every combination of types, switches and bins, `K x slots`, the last slot changing fastest. Arguments that a choice ignores
/// are 0 and make no further actions.
pub fn product(space: &ActionSpace, values: &[f32]) -> Vec<f32> {
    fn from(space: &ActionSpace, values: &[f32], action: &mut Vec<f32>, slot: usize, list: &mut Vec<f32>) {
        if slot == space.slots() {
            return list.extend_from_slice(action);
        }
        let n = options(space, action, slot, values.len());
        for i in 0..n {
            action[slot] = match space.heads()[slot] {
                ActionHead::Continuous { .. } if n == 1 => 0.0,
                ActionHead::Continuous { .. } => values[i],
                _ => i as f32,
            };
            from(space, values, action, slot + 1, list);
        }
    }
    let mut list = Vec::new();
    from(space, values, &mut vec![0.0; space.slots()], 0, &mut list);
    list
}
