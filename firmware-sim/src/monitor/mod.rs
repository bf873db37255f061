//! A bus as a person watches it: rates, load, gaps, decoded signals, latents, states of nodes.
//!
//! | module | holds |
//! | --- | --- |
//! | [`model`] | what the frames so far say; a function of frames and their times |
//! | [`source`] | where frames come from: a bus, a trace, candump text on a pipe |
//! | [`view`] | the model on a terminal |

pub mod model;
pub mod source;
pub mod view;

pub use model::{Model, Snapshot};
pub use source::{End, Item, Source};
