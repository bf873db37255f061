//! The two profiles, and the flags of an action.

use crate::protocol::{CLASSIC_VALUES, FD_VALUES};

/// How values travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum Profile {
    /// CAN FD, exact single precision.
    FdF32,
    /// Classic CAN, 16-bit integers scaled by the declared range of each signal.
    ClassicI16,
}

impl Profile {
    /// Both profiles.
    pub const ALL: [Self; 2] = [Self::FdF32, Self::ClassicI16];

    /// Name as the command line writes it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::FdF32 => "fd-f32",
            Self::ClassicI16 => "classic-i16",
        }
    }

    /// Values that one frame holds.
    #[must_use]
    pub const fn values(self) -> usize {
        match self {
            Self::FdF32 => FD_VALUES,
            Self::ClassicI16 => CLASSIC_VALUES,
        }
    }

    /// Which bits of the tick number a sequence number keeps.
    #[must_use]
    pub const fn seq_mask(self) -> u16 {
        match self {
            Self::FdF32 => 0xFFFF,
            Self::ClassicI16 => 0x00FF,
        }
    }

    /// The sequence number of a tick.
    #[must_use]
    pub const fn seq(self, tick: u32) -> u16 {
        let [low, high, ..] = tick.to_le_bytes();
        u16::from_le_bytes([low, high]) & self.seq_mask()
    }

    /// How far sequence number `seq` is ahead of `reference` (negative: behind), in the shorter direction.
    #[must_use]
    pub const fn ahead(self, seq: u16, reference: u16) -> i16 {
        let [low, high] = seq.wrapping_sub(reference).to_le_bytes();
        match self {
            Self::FdF32 => i16::from_le_bytes([low, high]),
            Self::ClassicI16 => i8::from_le_bytes([low]) as i16,
        }
    }
}

/// What an action frame says besides the values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Flags(u8);

impl Flags {
    /// The safe action, or a step of the ramp to it.
    pub const SAFE: Self = Self(1);
    /// The mask left no latent; the most confident one was taken.
    pub const FALLBACK: Self = Self(2);
    /// A range or rate limit cut a value.
    pub const CLIPPED: Self = Self(4);
    /// The last action again: no good observation set for this tick.
    pub const HELD: Self = Self(8);
    /// The timing is not as agreed: period jitter or bias above 20 %, or a set that came after its tick had passed.
    pub const LATE: Self = Self(16);

    /// Names of the bits, from bit 0.
    pub const NAMES: [&'static str; 5] = ["safe", "fallback", "clipped", "held", "late"];

    /// From the wire; higher bits are cut.
    #[must_use]
    pub const fn from_bits(bits: u8) -> Self {
        Self(bits & 0x1F)
    }

    /// For the wire: bits 0 to 4.
    #[must_use]
    pub const fn bits(self) -> u8 {
        self.0
    }

    /// Both sets together.
    #[must_use]
    pub const fn with(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// `other` added where `on`.
    #[must_use]
    pub const fn when(self, on: bool, other: Self) -> Self {
        if on { self.with(other) } else { self }
    }

    /// True where all bits of `other` are set.
    #[must_use]
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }
}
