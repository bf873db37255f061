//! Why an image is not run, as one byte for the bus: finer than the fault code, coarser than the runtime's error.

use gadm_runtime::LoadError;
use strum::{FromRepr, IntoStaticStr, VariantArray};

use crate::coded::coded;

/// Why an image is not run. The number is the one on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr, IntoStaticStr, VariantArray)]
#[repr(u8)]
#[strum(serialize_all = "SCREAMING_SNAKE_CASE")]
pub enum Reason {
    /// It is run, or was not tried.
    None = 0,
    /// The slot is erased.
    Erased = 1,
    /// It does not begin as a policy file does.
    NotAPolicy = 2,
    /// It was changed on its way as text is.
    TextDamage = 3,
    /// It is cut off.
    Truncated = 4,
    /// It does not lie at a multiple of 4 bytes.
    Misaligned = 5,
    /// CRC-32 of the header.
    HeaderChecksum = 6,
    /// CRC-32 of the payload or of a trailer record.
    Checksum = 7,
    /// Format, numerics or runtime that this node does not know.
    Version = 8,
    /// Weights in a form that this node does not run.
    WeightKind = 9,
    /// The hash of the interface record.
    InterfaceHash = 10,
    /// A field that the format does not allow.
    Content = 11,
    /// It needs more work memory than this node has.
    Scratch = 12,
    /// It does not fit the bus profile.
    Layout = 13,
    /// It computes something else than its own vectors say.
    SelfTest = 14,
    /// It ran on trial and was not confirmed in time.
    NotConfirmed = 15,
    /// The settings record of the node is damaged, so nothing is run.
    Settings = 16,
}

coded!(Reason);

impl Reason {
    /// What it means, in one line.
    #[must_use]
    pub const fn meaning(self) -> &'static str {
        match self {
            Self::None => "nothing was refused",
            Self::Erased => "the slot is erased: no policy was written there",
            Self::NotAPolicy => "the slot does not begin as a policy file does",
            Self::TextDamage => "the file was changed by a transfer in text mode",
            Self::Truncated => "the file is cut off",
            Self::Misaligned => "the slot does not lie at a multiple of 4 bytes",
            Self::HeaderChecksum => "the CRC-32 of the header is wrong",
            Self::Checksum => "the CRC-32 of the payload or of a trailer record is wrong",
            Self::Version => "format, numerics or runtime of the file are not those of the firmware",
            Self::WeightKind => "the weights are in a form that the firmware does not run",
            Self::InterfaceHash => "the hash of the interface record is wrong",
            Self::Content => "a field holds what the format does not allow",
            Self::Scratch => "the policy needs more work memory than the firmware has",
            Self::Layout => "the policy does not fit the bus profile",
            Self::SelfTest => "the policy computes something else than its own vectors say",
            Self::NotConfirmed => "the policy ran on trial and was not confirmed in time",
            Self::Settings => "the settings record of the node is damaged; write it again",
        }
    }
}

impl From<LoadError> for Reason {
    fn from(error: LoadError) -> Self {
        match error {
            LoadError::Erased => Self::Erased,
            LoadError::NotAPolicy { .. } => Self::NotAPolicy,
            LoadError::TextDamage { .. } => Self::TextDamage,
            LoadError::Truncated { .. } => Self::Truncated,
            LoadError::Misaligned { .. } => Self::Misaligned,
            LoadError::HeaderChecksum { .. } => Self::HeaderChecksum,
            LoadError::Checksum { .. } => Self::Checksum,
            LoadError::Version { .. } => Self::Version,
            LoadError::WeightKind { .. } => Self::WeightKind,
            LoadError::InterfaceHash { .. } => Self::InterfaceHash,
            _ => Self::Content,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_unique_and_come_back() {
        for &r in Reason::ALL {
            assert_eq!(Reason::from_code(r.code()), Some(r));
        }
        assert_eq!(Reason::from_code(17), None);
        assert_eq!(Reason::from(LoadError::Erased), Reason::Erased);
        assert_eq!(Reason::from(LoadError::Truncated { expected: 2, found: 1 }), Reason::Truncated);
    }
}
