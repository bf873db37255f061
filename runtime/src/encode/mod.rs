//! The write side (host only): from a float model to a policy file.

mod error;
mod image;
mod model;
mod quantise;
mod write;

pub use error::EncodeError;
pub use image::AlignedImage;
pub use model::{
    ActionSlot, Dense, FloatDecision, FloatDecoder, FloatModel, HeadEncoding, Interface, ObservationSlot,
    ProvenanceOwned, Snap,
};
pub use quantise::{QuantiseOptions, QuantisedModel, quantise};
pub use write::{FileOptions, TrailerRecord, write_float, write_int8};
