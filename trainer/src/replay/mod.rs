//! Transitions: n-step assembly and the two replay buffers.

mod nstep;
mod ring;
mod states;

pub use nstep::{NStep, Transition};
pub use ring::{ActionBuffer, RL_COLUMNS, RlBatch, RlBuffer};
