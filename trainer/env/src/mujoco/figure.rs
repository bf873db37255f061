//! Where the geoms of a body are, for drawings.

use mujoco_rs::wrappers::mj_model::{MjModel, MjtGeomBase, MjtObjBase};

use super::plant::Plant;
use crate::render::{
    Paint,
    body::{Figure, Form, Geom},
};

/// The first body after the world: the trunk, or the cart.
const TRUNK: usize = 1;

/// The body as its positions are now. A copy of the simulation is asked: after a step the positions of geoms are those
/// of the last internal step, and after a restore there are none.
pub(super) fn figure(plant: &Plant) -> Figure {
    let mut data = plant.data.clone();
    data.kinematics();
    let model = data.model();
    let geoms = (0..data.geom_xpos().len()).filter_map(|i| {
        let size = model.geom_size()[i];
        let form = match model.geom_type()[i] {
            MjtGeomBase::mjGEOM_PLANE => Form::Plane,
            MjtGeomBase::mjGEOM_SPHERE => Form::Capsule { half: 0.0, radius: size[0] },
            MjtGeomBase::mjGEOM_CAPSULE => Form::Capsule { half: size[1], radius: size[0] },
            _ => return None, // in none of the models
        };
        let turn = data.geom_xmat()[i]; // by rows; the third column is the capsule's axis
        let (center, axis) = (data.geom_xpos()[i], [turn[2], turn[5], turn[8]]);
        Some(Geom { form, center, axis, paint: paint(model, model.geom_bodyid()[i] as usize) })
    });
    let torso = data.xpos().get(TRUNK).copied().unwrap_or_default();
    // Only a free joint has a quaternion, and with it one position more than velocities.
    Figure { geoms: geoms.collect(), torso, in_space: plant.nq() != plant.nv() }
}

/// The colour of a body: limbs differ by side where a name tells it, else in turn.
fn paint(model: &MjModel, body: usize) -> Paint {
    match body {
        0 => return Paint::Mark,
        TRUNK => return Paint::Body,
        _ => {}
    }
    let parent = |b: usize| model.body_parentid()[b] as usize;
    let mut at = body;
    loop {
        let name = model.id_to_name(MjtObjBase::mjOBJ_BODY, at).unwrap_or_default();
        if name.contains("left") {
            return Paint::OtherLimb;
        }
        if name.contains("right") {
            return Paint::Limb;
        }
        if parent(at) <= TRUNK {
            break;
        }
        at = parent(at);
    }
    let before = (TRUNK + 1..at).filter(|&b| parent(b) == TRUNK).count();
    if before.is_multiple_of(2) { Paint::Limb } else { Paint::OtherLimb }
}
