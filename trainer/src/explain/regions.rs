//! Which raw actions share a latent: slices of the action space, encoded in one state.

use gadm_envs::{ArgumentMask, EnvSpec};
use gadm_runtime::ActionHead;

use super::Shown;
use crate::discretizer::gadm::ActionModel;

/// Points of a slice along each axis.
pub const POINTS: usize = 80;
/// Slices at most: types of a discrete slot, each with its own.
const MOST_SLICES: usize = 8;

/// A slice of the action space in one state.
#[derive(Clone, Debug, PartialEq)]
pub struct Region {
    /// What is held fixed, such as the type.
    pub name: String,
    /// Slots along the axes; the second is missing where only one is continuous.
    pub axes: (usize, Option<usize>),
    /// Latent of each point, row by row from below, `rows x POINTS`; rows follow the second axis.
    pub codes: Vec<u32>,
}

/// Encodes slices through the action that was taken: of its first two continuous slots, for every type of a discrete slot those
/// that the type uses. Empty for an action space without a continuous slot.
pub fn regions(model: &mut ActionModel, spec: &EnvSpec, shown: &Shown) -> Vec<Region> {
    let continuous: Vec<usize> = slots(spec, |head| matches!(head, ActionHead::Continuous { .. }));
    let taken: Vec<f32> = spec.actions.iter().zip(&shown.action).map(|(slot, &a)| slot.head.normalise(a)).collect();
    let types = slots(spec, |head| matches!(head, ActionHead::Discrete { .. })).first().copied();
    let count = match types.map(|slot| spec.actions[slot].head) {
        Some(ActionHead::Discrete { n }) => usize::from(n),
        _ => 1,
    };
    (0..count.min(MOST_SLICES))
        .filter_map(|kind| {
            let mut action = taken.clone();
            let mut name = String::from("other slots as in the action that was taken");
            if let Some(slot) = types {
                action[slot] = kind as f32;
                name = format!("{} {kind}", spec.actions[slot].name);
            }
            let uses = |place: usize| match &spec.argument_mask {
                ArgumentMask::ByType(rows) => rows[kind][place],
                ArgumentMask::All | ArgumentMask::BySwitch => true,
            };
            let mut used = continuous.iter().enumerate().filter(|(place, _)| uses(*place)).map(|(_, slot)| *slot);
            let axes = (used.next()?, used.next());
            Some(Region { name, axes, codes: plane(model, &shown.obs, &action, axes, &Grid::whole(POINTS)) })
        })
        .collect()
}

fn slots(spec: &EnvSpec, wanted: impl Fn(ActionHead) -> bool) -> Vec<usize> {
    spec.actions.iter().enumerate().filter(|(_, slot)| wanted(slot.head)).map(|(i, _)| i).collect()
}

/// Points of a slice of the action space, normalised: the middles of cells between the ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grid {
    /// Points along each axis.
    pub points: usize,
    /// Ends of the first axis and of the second one.
    pub ends: [[f32; 2]; 2],
}

impl Grid {
    /// All of both axes.
    pub fn whole(points: usize) -> Self {
        Self { points, ends: [[-1.0, 1.0]; 2] }
    }

    fn value(&self, axis: usize, i: usize) -> f32 {
        let [low, high] = self.ends[axis];
        low + (high - low) * (2 * i + 1) as f32 / (2 * self.points) as f32
    }
}

/// Latents of a slice through `action` (normalised) in the state `obs`: the first slot in `axes` along every row, the second one, if
/// there is one, from row to row, from below.
pub fn plane(
    model: &mut ActionModel,
    obs: &[f32],
    action: &[f32],
    (first, second): (usize, Option<usize>),
    grid: &Grid,
) -> Vec<u32> {
    let rows = if second.is_some() { grid.points } else { 1 };
    let mut actions = Vec::with_capacity(rows * grid.points * action.len());
    for row in 0..rows {
        for column in 0..grid.points {
            let at = actions.len();
            actions.extend_from_slice(action);
            actions[at + first] = grid.value(0, column);
            if let Some(second) = second {
                actions[at + second] = grid.value(1, row);
            }
        }
    }
    let mut codes = Vec::new();
    model.encode(&obs.repeat(rows * grid.points), &actions, &mut codes);
    codes
}

#[cfg(test)]
mod tests {
    use super::Grid;

    #[test]
    fn points_are_the_middles_of_cells_between_the_ends() {
        let grid = Grid { points: 4, ends: [[-1.0, 1.0], [0.0, 0.5]] };
        assert_eq!([0, 3].map(|i| grid.value(0, i)), [-0.75, 0.75]);
        assert_eq!([0, 3].map(|i| grid.value(1, i)), [0.0625, 0.4375]);
        assert_eq!(Grid::whole(2).value(1, 0), -0.5);
    }
}
