//! LunarLander on Box2D, after Gymnasium's LunarLander-v3 without wind.
//!
//! [`plant`] is the physics, [`flight`] one episode of it with its random draws and rewards, [`flights`] the place where
//! running episodes are kept, and [`lander`] the task: signals, saving and restoring.

pub(crate) mod flight;
mod flights;
pub(crate) mod lander;
pub(crate) mod plant;
