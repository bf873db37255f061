//! Errors: what is wrong, where, what was expected and what was found. All are small and `Copy`.

use crate::schema::{FORMAT_VERSION, NUMERICS_VERSION, RUNTIME_ABI, Section, WeightKind};
use core::fmt;

/// Why an image is not a policy that can be run.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum LoadError {
    /// The slice is shorter than the file it should hold.
    Truncated {
        /// Bytes needed.
        expected: usize,
        /// Bytes given.
        found: usize,
    },
    /// The image does not lie at a multiple of 4 bytes in memory.
    Misaligned {
        /// Alignment needed, in bytes.
        expected: usize,
        /// Address modulo that alignment.
        found: usize,
    },
    /// The first bytes are all `0xFF` or all `0x00`: an erased or empty slot.
    Erased,
    /// The first eight bytes are not those of a policy file.
    NotAPolicy {
        /// The bytes found.
        found: [u8; 8],
    },
    /// The magic was changed as a text-mode transfer or a character-set conversion does.
    TextDamage {
        /// The bytes found.
        found: [u8; 8],
    },
    /// The CRC-32 of the header does not match.
    HeaderChecksum {
        /// Checksum stored in the file.
        expected: u32,
        /// Checksum of the bytes.
        found: u32,
    },
    /// Format, numerics or what the file asks of the runtime is not what this runtime knows.
    Version {
        /// Format of the file.
        format: u16,
        /// Numerics of the file.
        numerics: u16,
        /// Runtime ABI that the file asks for.
        runtime_abi: u32,
    },
    /// The weights are stored in another way than this type runs.
    WeightKind {
        /// What this type runs.
        expected: WeightKind,
        /// Code found in the header.
        found: u16,
    },
    /// The CRC-32 of the payload or of a trailer record does not match.
    Checksum {
        /// Payload ([`Section::Table`]) or trailer.
        section: Section,
        /// Checksum stored in the file.
        expected: u32,
        /// Checksum of the bytes.
        found: u32,
    },
    /// The hash stored in the header is not that of the interface record.
    InterfaceHash {
        /// Hash stored in the header.
        expected: u64,
        /// Hash of the record.
        found: u64,
    },
    /// A section is shorter or longer than its content.
    SectionLength {
        /// Which.
        section: Section,
        /// Bytes that its content needs.
        expected: usize,
        /// Bytes that the section table gives it.
        found: usize,
    },
    /// A field holds a value that the format does not allow.
    Field {
        /// Where.
        section: Section,
        /// Offset of the field from the start of the file, in bytes.
        offset: usize,
        /// Smallest value allowed.
        min: u32,
        /// Largest value allowed.
        max: u32,
        /// Value found.
        found: u32,
    },
    /// A number is not finite or outside of its range.
    Number {
        /// Where.
        section: Section,
        /// Offset of the number from the start of the file, in bytes.
        offset: usize,
        /// Value found.
        found: f32,
    },
    /// A text is not UTF-8 or holds control characters.
    Text {
        /// Where.
        section: Section,
        /// Offset of the text from the start of the file, in bytes.
        offset: usize,
    },
    /// A byte that only pads is not zero.
    Padding {
        /// Where.
        section: Section,
        /// Offset of the padding from the start of the file, in bytes.
        offset: usize,
    },
    /// A weight, start value or multiplier of a padding row or column is not zero.
    PaddedWeight {
        /// Where.
        section: Section,
        /// Layer, from 0.
        layer: u16,
        /// Output row, from 0.
        row: u16,
    },
    /// A weight is outside of -127..=127.
    Weight {
        /// Where.
        section: Section,
        /// Layer, from 0.
        layer: u16,
        /// Output row, from 0.
        row: u16,
    },
    /// A sum of this row could leave its range for some observation, so the result would not be exact.
    Bound {
        /// Where.
        section: Section,
        /// Layer, from 0.
        layer: u16,
        /// Output row, from 0.
        row: u16,
        /// Largest magnitude allowed.
        limit: i64,
        /// Largest magnitude that some observation could reach.
        found: i64,
    },
}

/// Why a step was not computed. No output was written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ActError {
    /// The observation has the wrong length.
    ObservationLength {
        /// Length needed.
        expected: usize,
        /// Length given.
        found: usize,
    },
    /// A value of the observation is NaN or infinite.
    NonFinite {
        /// Index of the first such value.
        index: usize,
    },
    /// The action slice is too short.
    ActionLength {
        /// Length needed.
        expected: usize,
        /// Length given.
        found: usize,
    },
    /// The scratch memory is too short.
    ScratchLength {
        /// Words needed.
        expected: usize,
        /// Words given.
        found: usize,
    },
}

/// Why a policy failed its own vectors. Such a policy must not be run.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum SelfTestError {
    /// A step could not be computed.
    Act(ActError),
    /// Another latent was chosen than the file says.
    Latent {
        /// Vector, from 0.
        vector: usize,
        /// Latent in the file.
        expected: u16,
        /// Latent computed.
        found: u16,
    },
    /// Another action was computed than the file says.
    Action {
        /// Vector, from 0.
        vector: usize,
        /// Action slot, from 0.
        slot: usize,
        /// Value in the file.
        expected: f32,
        /// Value computed.
        found: f32,
    },
}

impl fmt::Display for LoadError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Truncated { expected, found } => {
                write!(f, "policy file is cut off: {expected} bytes needed, {found} given; copy or flash it again")
            }
            Self::Misaligned { expected, found } => write!(
                f,
                "policy image starts {found} bytes beyond a multiple of {expected}; align it (AlignedImage on a host, a \
                 linker section on a device)"
            ),
            Self::Erased => write!(f, "the slot is erased or empty: no policy was written there"),
            Self::NotAPolicy { found } => {
                write!(f, "not a policy file: it starts with {found:02x?}; give the .bin that `gadm export` wrote")
            }
            Self::TextDamage { found } => write!(
                f,
                "policy file damaged by a text-mode transfer: it starts with {found:02x?}; copy it in binary mode"
            ),
            Self::HeaderChecksum { expected, found } => {
                write!(f, "header damaged: CRC-32 {expected:08x} stored, {found:08x} computed; copy the file again")
            }
            Self::Version { format, numerics, runtime_abi } => write!(
                f,
                "file has format {format}, numerics {numerics}, runtime ABI {runtime_abi}; this runtime knows format \
                 {FORMAT_VERSION}, numerics {NUMERICS_VERSION}, runtime ABI {RUNTIME_ABI}: update the runtime or export \
                 the policy again"
            ),
            Self::WeightKind { expected, found } => write!(
                f,
                "file holds weights of kind {found}, {expected:?} ({}) expected; kind 0 is run by Policy, kind 1 by \
                 FloatPolicy",
                expected.code()
            ),
            Self::Checksum { section, expected, found } => {
                let name = if section == Section::Table { "payload" } else { section.name() };
                write!(f, "{name} damaged: CRC-32 {expected:08x} stored, {found:08x} computed; copy the file again")
            }
            Self::InterfaceHash { expected, found } => write!(
                f,
                "interface hash {expected:016x} stored, {found:016x} computed from the interface record; export again"
            ),
            Self::SectionLength { section, expected, found } => {
                write!(f, "{}: its content needs {expected} bytes, it has {found}; export again", section.name())
            }
            Self::Field { section, offset, min, max, found } => {
                write!(f, "{}, offset {offset}: {min}..={max} expected, {found} found; export again", section.name())
            }
            Self::Number { section, offset, found } => {
                write!(f, "{}, offset {offset}: {found} is not finite or out of range; export again", section.name())
            }
            Self::Text { section, offset } => write!(
                f,
                "{}, offset {offset}: text longer than 64 bytes, not UTF-8 or with control characters; export again",
                section.name()
            ),
            Self::Padding { section, offset } => {
                write!(f, "{}, offset {offset}: padding must be zero; export again", section.name())
            }
            Self::PaddedWeight { section, layer, row } => {
                write!(
                    f,
                    "{}, layer {layer}, row {row}: padding of the weights must be zero; export again",
                    section.name()
                )
            }
            Self::Weight { section, layer, row } => {
                write!(
                    f,
                    "{}, layer {layer}, row {row}: a weight is outside of -127..=127; export again",
                    section.name()
                )
            }
            Self::Bound { section, layer, row, limit, found } => write!(
                f,
                "{}, layer {layer}, row {row}: a sum could reach {found}, at most {limit} is exact; export again",
                section.name()
            ),
        }
    }
}

impl fmt::Display for ActError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::ObservationLength { expected, found } => {
                write!(f, "observation: {expected} values expected, {found} given; see observation_signals")
            }
            Self::NonFinite { index } => {
                write!(f, "observation {index} is NaN or infinite; hold the last action and check the sensor")
            }
            Self::ActionLength { expected, found } => {
                write!(f, "action slice: {expected} values needed, {found} given")
            }
            Self::ScratchLength { expected, found } => {
                write!(f, "scratch memory: {expected} words needed, {found} given; see scratch_words")
            }
        }
    }
}

impl fmt::Display for SelfTestError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Act(error) => write!(f, "self-test could not run: {error}"),
            Self::Latent { vector, expected, found } => {
                write!(
                    f,
                    "self-test vector {vector}: latent {expected} expected, {found} computed; do not run this policy"
                )
            }
            Self::Action { vector, slot, expected, found } => write!(
                f,
                "self-test vector {vector}, action slot {slot}: {expected} expected, {found} computed; do not run this \
                 policy"
            ),
        }
    }
}

impl core::error::Error for LoadError {}
impl core::error::Error for ActError {}
impl core::error::Error for SelfTestError {}

impl From<ActError> for SelfTestError {
    fn from(error: ActError) -> Self {
        Self::Act(error)
    }
}
