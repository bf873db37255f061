//! Learning algorithms.

pub mod dqn;
pub mod learner;
pub mod listed;
pub mod td3;

pub use learner::{Actor, Explorer, Learner, Report};
