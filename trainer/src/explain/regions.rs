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

/// Normalised value of point `i` of `points`: the middle of its cell.
fn value(i: usize, points: usize) -> f32 {
    (2 * i + 1) as f32 / points as f32 - 1.0
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
            Some(Region { name, axes, codes: plane(model, &shown.obs, &action, axes, POINTS) })
        })
        .collect()
}

fn slots(spec: &EnvSpec, wanted: impl Fn(ActionHead) -> bool) -> Vec<usize> {
    spec.actions.iter().enumerate().filter(|(_, slot)| wanted(slot.head)).map(|(i, _)| i).collect()
}

/// Latents of a slice through `action` (normalised) in the state `obs`: `points` values of the first slot in `axes` in every row, and
/// as many rows where there is a second one, from below.
pub fn plane(
    model: &mut ActionModel,
    obs: &[f32],
    action: &[f32],
    (first, second): (usize, Option<usize>),
    points: usize,
) -> Vec<u32> {
    let rows = if second.is_some() { points } else { 1 };
    let mut actions = Vec::with_capacity(rows * points * action.len());
    for row in 0..rows {
        for column in 0..points {
            let at = actions.len();
            actions.extend_from_slice(action);
            actions[at + first] = value(column, points);
            if let Some(second) = second {
                actions[at + second] = value(row, points);
            }
        }
    }
    let mut codes = Vec::new();
    model.encode(&obs.repeat(rows * points), &actions, &mut codes);
    codes
}
