//! Status codes and their texts.

use core::ffi::CStr;

use gadm_runtime::{ActError, LoadError, Section, SelfTestError};

use crate::types::ErrorDetail;

/// What a call did. The numbers stay as they are; new ones may be added.
#[repr(i32)]
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// Done.
    Ok = 0,
    /// A pointer that must not be is null.
    NullPointer = 1,
    /// A pointer is not a multiple of its type's alignment; the image must start at a multiple of 4.
    MisalignedPointer = 2,
    /// Memory that is written overlaps memory that is read or written by the same call.
    OverlappingMemory = 3,
    /// A length does not fit into the address space.
    BadLength = 4,
    /// No policy was loaded into this `gadm_policy`.
    NotLoaded = 5,
    /// There is no signal of this index.
    NoSuchIndex = 6,

    /// The image is shorter than the policy. `expected` and `found` are bytes.
    Truncated = 16,
    /// The image is erased flash or zeros.
    Erased = 17,
    /// The image starts with something else.
    NotAPolicy = 18,
    /// The image was changed by a transfer in text mode.
    TextDamage = 19,
    /// The header's checksum is wrong. `expected` is stored, `found` computed.
    HeaderChecksum = 20,
    /// Format, numerics or runtime ABI are not known to this library. `index` is the format, `expected` the numerics,
    /// `found` the ABI of the image.
    Version = 21,
    /// The weights are not int8. `found` is their kind.
    WeightKind = 22,
    /// A checksum is wrong. `expected` is stored, `found` computed.
    Checksum = 23,
    /// The interface hash is wrong. `expected` is stored, `found` computed.
    InterfaceHash = 24,
    /// A section has the wrong length. `expected` and `found` are bytes.
    SectionLength = 25,
    /// A field is out of range. `index` is its offset, `expected` the largest value.
    Field = 26,
    /// A number is not finite or out of range. `index` is its offset, `found` its bits.
    Number = 27,
    /// A text is no text. `index` is its offset.
    Text = 28,
    /// A padding byte is not zero. `index` is its offset.
    Padding = 29,
    /// A padding weight is not zero. `index` is 65536 times the layer plus the row.
    PaddedWeight = 30,
    /// A weight is out of range. `index` is 65536 times the layer plus the row.
    Weight = 31,
    /// A sum could leave its range. `index` is 65536 times the layer plus the row.
    Bound = 32,
    /// The image is refused for a reason that this library has no number for.
    LoadOther = 47,

    /// The observation has the wrong length. `expected` and `found` are values.
    ObservationLength = 48,
    /// A value of the observation is NaN or infinite. `index` tells which.
    NonFinite = 49,
    /// The action array is too short. `expected` and `found` are values.
    ActionLength = 50,
    /// The scratch memory is too short. `expected` and `found` are words of 32 bits.
    ScratchLength = 51,
    /// The step was refused for a reason that this library has no number for.
    ActOther = 63,

    /// The self-test chose another latent. `index` is the vector.
    SelfTestLatent = 64,
    /// The self-test computed another action. `index` is 65536 times the vector plus the slot, `expected` and `found` are
    /// bits of floats.
    SelfTestAction = 65,
    /// The self-test failed for a reason that this library has no number for.
    SelfTestOther = 79,
}

impl Status {
    /// All of them.
    pub(crate) const ALL: [Self; 33] = [
        Self::Ok,
        Self::NullPointer,
        Self::MisalignedPointer,
        Self::OverlappingMemory,
        Self::BadLength,
        Self::NotLoaded,
        Self::NoSuchIndex,
        Self::Truncated,
        Self::Erased,
        Self::NotAPolicy,
        Self::TextDamage,
        Self::HeaderChecksum,
        Self::Version,
        Self::WeightKind,
        Self::Checksum,
        Self::InterfaceHash,
        Self::SectionLength,
        Self::Field,
        Self::Number,
        Self::Text,
        Self::Padding,
        Self::PaddedWeight,
        Self::Weight,
        Self::Bound,
        Self::LoadOther,
        Self::ObservationLength,
        Self::NonFinite,
        Self::ActionLength,
        Self::ScratchLength,
        Self::ActOther,
        Self::SelfTestLatent,
        Self::SelfTestAction,
        Self::SelfTestOther,
    ];

    /// What happened and what to do.
    pub(crate) const fn text(self) -> &'static CStr {
        match self {
            Self::Ok => c"done",
            Self::NullPointer => c"a pointer is null: give memory for every argument that must not be null",
            Self::MisalignedPointer => {
                c"a pointer is not aligned: put the image at a multiple of 4, everything else at its type's alignment"
            }
            Self::OverlappingMemory => c"memory that is written overlaps other memory of the call: use separate arrays",
            Self::BadLength => c"a length goes beyond the address space: check the order of the arguments",
            Self::NotLoaded => c"no policy is loaded: call gadm_load and look at its status first",
            Self::NoSuchIndex => c"no signal has this index: see the counts of gadm_get_spec",
            Self::Truncated => c"policy image cut off: copy or flash it again",
            Self::Erased => c"the place is erased or empty: no policy was written there",
            Self::NotAPolicy => c"not a policy image: flash what gadm image wrote, and check the address",
            Self::TextDamage => c"policy image damaged by a text-mode transfer: copy it in binary mode",
            Self::HeaderChecksum => c"header damaged: copy or flash the image again",
            Self::Version => c"format, numerics or runtime ABI unknown: update this library or export the policy again",
            Self::WeightKind => c"the weights are not int8: export the policy without --float",
            Self::Checksum => c"image damaged: copy or flash it again",
            Self::InterfaceHash => c"interface hash wrong: export the policy again",
            Self::SectionLength => c"a section has the wrong length: export the policy again",
            Self::Field => c"a field is out of range: export the policy again",
            Self::Number => c"a number is not finite or out of range: export the policy again",
            Self::Text => c"a text is damaged: export the policy again",
            Self::Padding => c"a padding byte is not zero: export the policy again",
            Self::PaddedWeight => c"a padding weight is not zero: export the policy again",
            Self::Weight => c"a weight is out of range: export the policy again",
            Self::Bound => c"a sum could leave its range: export the policy again",
            Self::LoadOther => c"the image is refused: compare the versions of this library and of the exporter",
            Self::ObservationLength => c"the observation has the wrong length: see obs_dim of gadm_get_spec",
            Self::NonFinite => c"an observation is NaN or infinite: hold the last action and check the sensor",
            Self::ActionLength => c"the action array is too short: see action_dim of gadm_get_spec",
            Self::ScratchLength => c"the scratch memory is too short: see gadm_scratch_words",
            Self::ActOther => c"the step is refused",
            Self::SelfTestLatent => c"self-test: another latent was chosen; do not run this policy",
            Self::SelfTestAction => c"self-test: another action was computed; do not run this policy",
            Self::SelfTestOther => c"self-test failed; do not run this policy",
        }
    }
}

const fn section_code(section: Section) -> i32 {
    match section {
        Section::Header => 0,
        Section::Table => 1,
        Section::Interface => 2,
        Section::Input => 3,
        Section::Q => 4,
        Section::Confidence => 5,
        Section::Decoder => 6,
        Section::SelfTest => 7,
        Section::Provenance => 8,
        Section::Trailer => 9,
        _ => ErrorDetail::NO_SECTION,
    }
}

/// A length for people; lengths that a pointer can have fit.
fn number(value: usize) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

fn index(value: usize) -> u32 {
    u32::try_from(value).unwrap_or(u32::MAX)
}

fn pair(high: u32, low: u32) -> u32 {
    (high << 16) | (low & 0xFFFF)
}

impl From<Status> for ErrorDetail {
    fn from(status: Status) -> Self {
        Self { status, section: Self::NO_SECTION, index: 0, expected: 0, found: 0 }
    }
}

impl ErrorDetail {
    pub(crate) const NO_SECTION: i32 = -1;

    fn of(status: Status, expected: i64, found: i64) -> Self {
        Self { expected, found, ..Self::from(status) }
    }

    fn at(self, section: Section, index: u32) -> Self {
        Self { section: section_code(section), index, ..self }
    }

    pub(crate) fn misaligned(expected: usize, found: usize) -> Self {
        Self::of(Status::MisalignedPointer, number(expected), number(found))
    }

    pub(crate) fn load(error: LoadError) -> Self {
        let row = |layer: u16, row: u16| pair(u32::from(layer), u32::from(row));
        match error {
            LoadError::Truncated { expected, found } => Self::of(Status::Truncated, number(expected), number(found)),
            LoadError::Misaligned { expected, found } => Self::misaligned(expected, found),
            LoadError::Erased => Status::Erased.into(),
            LoadError::NotAPolicy { .. } => Status::NotAPolicy.into(),
            LoadError::TextDamage { .. } => Status::TextDamage.into(),
            LoadError::HeaderChecksum { expected, found } => {
                Self::of(Status::HeaderChecksum, expected.into(), found.into()).at(Section::Header, 0)
            }
            LoadError::Version { format, numerics, runtime_abi } => {
                Self::of(Status::Version, numerics.into(), runtime_abi.into()).at(Section::Header, format.into())
            }
            LoadError::WeightKind { expected, found } => {
                Self::of(Status::WeightKind, expected.code().into(), found.into()).at(Section::Header, 0)
            }
            LoadError::Checksum { section, expected, found } => {
                Self::of(Status::Checksum, expected.into(), found.into()).at(section, 0)
            }
            LoadError::InterfaceHash { expected, found } => {
                Self::of(Status::InterfaceHash, expected.cast_signed(), found.cast_signed()).at(Section::Interface, 0)
            }
            LoadError::SectionLength { section, expected, found } => {
                Self::of(Status::SectionLength, number(expected), number(found)).at(section, 0)
            }
            LoadError::Field { section, offset, max, found, .. } => {
                Self::of(Status::Field, max.into(), found.into()).at(section, index(offset))
            }
            LoadError::Number { section, offset, found } => {
                Self::of(Status::Number, 0, found.to_bits().into()).at(section, index(offset))
            }
            LoadError::Text { section, offset } => Self::from(Status::Text).at(section, index(offset)),
            LoadError::Padding { section, offset } => Self::from(Status::Padding).at(section, index(offset)),
            LoadError::PaddedWeight { section, layer, row: r } => {
                Self::from(Status::PaddedWeight).at(section, row(layer, r))
            }
            LoadError::Weight { section, layer, row: r } => Self::from(Status::Weight).at(section, row(layer, r)),
            LoadError::Bound { section, layer, row: r, limit, found } => {
                Self::of(Status::Bound, limit, found).at(section, row(layer, r))
            }
            _ => Status::LoadOther.into(),
        }
    }

    pub(crate) fn act(error: ActError) -> Self {
        match error {
            ActError::ObservationLength { expected, found } => {
                Self::of(Status::ObservationLength, number(expected), number(found))
            }
            ActError::NonFinite { index: at } => Self { index: index(at), ..Status::NonFinite.into() },
            ActError::ActionLength { expected, found } => {
                Self::of(Status::ActionLength, number(expected), number(found))
            }
            ActError::ScratchLength { expected, found } => {
                Self::of(Status::ScratchLength, number(expected), number(found))
            }
            _ => Status::ActOther.into(),
        }
    }

    pub(crate) fn self_test(error: SelfTestError) -> Self {
        match error {
            SelfTestError::Act(error) => Self::act(error),
            SelfTestError::Latent { vector, expected, found } => {
                Self::of(Status::SelfTestLatent, expected.into(), found.into()).at(Section::SelfTest, index(vector))
            }
            SelfTestError::Action { vector, slot, expected, found } => {
                Self::of(Status::SelfTestAction, expected.to_bits().into(), found.to_bits().into())
                    .at(Section::SelfTest, pair(index(vector), index(slot)))
            }
            _ => Status::SelfTestOther.into(),
        }
    }
}
