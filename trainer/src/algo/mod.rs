//! Learning algorithms.

pub mod dqn;
pub mod hppo;
pub mod learner;
pub mod listed;
pub mod pdqn;
pub mod td3;

pub use learner::{Actor, Explorer, Learner, Observed, Report};
