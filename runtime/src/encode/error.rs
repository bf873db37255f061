//! Why a model cannot be written.

use crate::error::{LoadError, SelfTestError};
use std::fmt;
use std::string::String;

/// Why a model cannot be written.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum EncodeError {
    /// A dimension is not what the rest of the model asks for.
    Shape {
        /// Which tensor or list.
        what: String,
        /// Length or width needed.
        expected: usize,
        /// Length or width found.
        found: usize,
    },
    /// A value is outside of what the format holds.
    Value {
        /// Which value, what is allowed and what to do.
        what: String,
        /// Value found.
        found: f64,
    },
    /// The file that was written is refused by the runtime: a defect of the writer.
    Refused(LoadError),
    /// The file that was written fails its own vectors. For an int8 file a defect of the writer; for an `f32` file the
    /// weights are so large that the order of sums changes an action by more than 1e-4 of its range.
    SelfTest(SelfTestError),
}

impl fmt::Display for EncodeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Shape { what, expected, found } => write!(f, "{what}: expected length {expected}, found {found}"),
            Self::Value { what, found } => write!(f, "{what}: found {found}"),
            Self::Refused(error) => write!(f, "the written file is refused by its own reader: {error}"),
            Self::SelfTest(error) => write!(
                f,
                "the written file fails its own vectors (an f32 file: weights too large for the order of sums not to matter): {error}"
            ),
        }
    }
}

impl std::error::Error for EncodeError {}

impl From<LoadError> for EncodeError {
    fn from(error: LoadError) -> Self {
        Self::Refused(error)
    }
}
