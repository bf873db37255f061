//! Small tasks with continuous actions.

pub(crate) mod pendulum;
pub(crate) mod toy_dataset;
pub(crate) mod toy_env;
