//! Learners on latent actions.

pub mod dqn;
