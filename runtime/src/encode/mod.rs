//! The write side (host only): from a float model to a policy file.
//!
//! [`quantise`] turns a [`FloatModel`] into a [`QuantisedModel`], [`write_int8`] that into a file; [`write_float`] keeps
//! the `f32` weights. Both read their own file back. Where the bits go is described in `docs/src/numerics.md`.
#![allow(
    clippy::indexing_slicing,
    clippy::expect_used,
    clippy::panic,
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_precision_loss,
    clippy::cast_sign_loss,
    reason = "host only: shapes are checked first, and the numerics are computed in f64 and rounded on purpose"
)]

mod calibrate;
mod check;
mod error;
mod float_act;
mod image;
mod int_model;
#[cfg(test)]
mod kernel_tests;
mod model;
mod quantise;
mod read;
mod rows;
mod threshold;
mod trace;
mod write;

pub use crate::decision::FloatDecision;
pub use error::EncodeError;
pub use image::AlignedImage;
pub use int_model::{LayerReport, QuantiseReport, QuantisedModel};
pub use model::{
    ActionSlot, Dense, FloatDecoder, FloatModel, HeadEncoding, Interface, ObservationSlot, ProvenanceOwned, Snap,
};
pub use quantise::{QuantiseOptions, quantise};
pub use trace::{LayerTrace, Trace};
pub use write::{FileOptions, TrailerRecord, reseal, write_float, write_int8};
