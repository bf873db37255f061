//! The MuJoCo bodies, after Gymnasium's v4 and v5 environments.
//!
//! [`plant`] is the physics, [`body`] what all tasks share, and one file per body holds its observation, reward and end.

pub(crate) mod ant;
pub(crate) mod body;
mod figure;
pub(crate) mod half_cheetah;
pub(crate) mod hopper;
pub(crate) mod humanoid;
pub(crate) mod inverted_pendulum;
pub(crate) mod plant;
pub(crate) mod walker2d;
