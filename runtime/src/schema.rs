//! Names, limits and fixed records of the policy file, format 1.
//!
//! The byte-level tables are in `docs/src/policy-format.md`; this module is the only place in code that holds them.
//! A change of any byte bumps [`FORMAT_VERSION`]; a change of any computed bit bumps [`NUMERICS_VERSION`].

/// Version of the byte layout that this crate reads and writes.
pub const FORMAT_VERSION: u16 = 1;
/// Version of the integer arithmetic: same file, same observation, same bits out.
pub const NUMERICS_VERSION: u16 = 1;
/// Newest of the versions of what a file may ask of the runtime beyond the two above; a file says the oldest that does.
/// 1: everything but what follows. 2: a confidence network that reads the Q-network's last hidden layer.
pub const RUNTIME_ABI: u32 = 2;
/// What a file without a shared trunk asks for.
pub const RUNTIME_ABI_SEPARATE: u32 = 1;
/// What a file with a shared trunk asks for.
pub const RUNTIME_ABI_SHARED_TRUNK: u32 = 2;

/// First eight bytes of a policy file. The high bit, the CR LF pair and the end-of-file byte make damage by a text-mode
/// transfer visible, as in PNG.
pub const MAGIC: [u8; 8] = [0x89, b'G', b'D', b'M', b'\r', b'\n', 0x1A, b'\n'];
/// Bytes of the header.
pub const HEADER_LEN: usize = 64;
/// Bytes of the section table, padding included.
pub const TABLE_LEN: usize = 64;
/// Bytes before the content of a trailer record.
pub const TRAILER_HEAD: usize = 16;
/// Every section starts at a multiple of this from the start of the file.
pub const SECTION_ALIGN: usize = 16;
/// The address of the image in memory must be a multiple of this.
pub const IMAGE_ALIGN: usize = 4;

/// Largest number of observation signals.
pub const MAX_OBS: usize = 512;
/// Largest number of action slots.
pub const MAX_ACTIONS: usize = 64;
/// Largest number of latents.
pub const MAX_LATENTS: usize = 256;
/// Largest width of a layer (rows or columns).
pub const MAX_WIDTH: usize = 1024;
/// Largest number of layers of one network.
pub const MAX_LAYERS: usize = 8;
/// Largest number of layers of a confidence network on the Q-network's trunk: one buffer of a step holds the trunk.
pub const MAX_LAYERS_ON_TRUNK: usize = 2;
/// Largest number of atoms of a categorical head.
pub const MAX_ATOMS: usize = 64;
/// Largest number of types of a discrete head.
pub const MAX_TYPES: usize = 1024;
/// Largest number of rows of the head layer.
pub const MAX_HEAD_ROWS: usize = 4096;
/// Longest signal name or unit, in bytes of UTF-8.
pub const MAX_TEXT: usize = 64;
/// Largest number of self-test vectors.
pub const MAX_SELF_TESTS: usize = 64;
/// Largest denominator of the mask threshold.
pub const MAX_BETA_DEN: u32 = 1 << 24;

/// `value` rounded up to a multiple of `to`, a power of two: columns are padded to 16, rows to 4, sections to 16 bytes. In
/// two instructions; 0 within `to` of the largest number, which no size in a file is.
pub(crate) const fn padded(value: usize, to: usize) -> usize {
    let most = to.wrapping_sub(1);
    value.wrapping_add(most) & !most
}

/// How the weights of a file are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum WeightKind {
    /// Fused int8 streams, run by [`Policy`](crate::Policy).
    Int8,
    /// Plain `f32` matrices, run by `FloatPolicy` (feature `float`).
    Float32,
}

impl WeightKind {
    /// The value stored in the header.
    #[must_use]
    pub const fn code(self) -> u16 {
        match self {
            Self::Int8 => 0,
            Self::Float32 => 1,
        }
    }
}

/// A part of the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Section {
    /// The first 64 bytes.
    Header,
    /// Where the other sections lie.
    Table,
    /// Names, units, ranges and order of observations and actions; control period.
    Interface,
    /// Offset and scale of each observation.
    Input,
    /// The Q-network.
    Q,
    /// The confidence network and its threshold; empty when the policy has no mask.
    Confidence,
    /// Decoder and action heads.
    Decoder,
    /// Observations with the latent and action they must give.
    SelfTest,
    /// Where the policy comes from.
    Provenance,
    /// Optional records after the payload.
    Trailer,
}

impl Section {
    /// The sections of the table, in file order.
    pub const IN_TABLE: [Self; 7] =
        [Self::Interface, Self::Input, Self::Q, Self::Confidence, Self::Decoder, Self::SelfTest, Self::Provenance];

    /// Offset of its entry in the table, for the sections in it.
    pub(crate) const fn entry(self) -> usize {
        HEADER_LEN + 8 * (self as usize - Self::Interface as usize)
    }

    /// Name for people.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Header => "header",
            Self::Table => "section table",
            Self::Interface => "interface",
            Self::Input => "input quantiser",
            Self::Q => "Q-network",
            Self::Confidence => "confidence network",
            Self::Decoder => "decoder",
            Self::SelfTest => "self-test",
            Self::Provenance => "provenance",
            Self::Trailer => "trailer",
        }
    }
}

/// The header of a loaded file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// Byte layout version.
    pub format: u16,
    /// Arithmetic version.
    pub numerics: u16,
    /// Bytes of the whole file, trailer included.
    pub total_len: u32,
    /// Bytes of the payload that follows the header.
    pub payload_len: u32,
    /// CRC-32/ISO-HDLC of the payload.
    pub payload_crc32: u32,
    /// Hash of the interface record, see [`Policy::interface_hash`](crate::Policy::interface_hash).
    pub interface_hash: u64,
    /// Counts up from export to export; of two slots a device takes the higher one.
    pub policy_seq: u32,
    /// Words of scratch memory that a step needs.
    pub scratch_words: u32,
    /// What the file asks of the runtime.
    pub runtime_abi: u32,
    /// How the weights are stored.
    pub weights: WeightKind,
}

/// What a caller needs to know to run a policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PolicySpec {
    /// Number of observation signals.
    pub obs_dim: u16,
    /// Number of action slots.
    pub action_dim: u16,
    /// Number of latents K.
    pub num_latents: u16,
    /// Time between two steps, in microseconds.
    pub control_period_us: u32,
    /// Length of the memory given to [`Scratch::new`](crate::Scratch::new), in words of 32 bits.
    pub scratch_words: usize,
    /// Multiply-accumulate operations of one step, without padding.
    pub macs: u32,
    /// How the weights are stored.
    pub weights: WeightKind,
}
