//! Observation and action sets as frames, in both profiles.
//!
//! | | `fd-f32` | `classic-i16` |
//! | --- | --- | --- |
//! | values | f32, exact | i16 over the declared range `lo..hi` of the signal, round to nearest, saturated at ±32767 |
//! | invalid value | not a number | −32768 |
//! | values in a part | 14 | 3 |
//! | CRC | CRC-32/ISO-HDLC | CRC-8/AUTOSAR |
//!
//! Both CRCs run over the identifier (two bytes, little endian), the low four bytes of the policy's interface hash
//! (little endian) and the payload up to the CRC, padding included. CAN itself guards the wire; this CRC guards gateways,
//! buffers and software, and lets a frame of another policy's layout fail even where its length fits (the "data id" of
//! AUTOSAR's end-to-end protection).

mod frames;
mod layout;
mod profile;
mod scale;
#[cfg(test)]
mod tests;

use heapless::Vec;

pub use layout::{Layout, LayoutError};
pub use profile::{Flags, Profile};
pub use scale::INVALID_I16;

use crate::protocol::FD_VALUES;

/// Why a frame was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum FrameError {
    /// Another message, another node, or a part that this policy does not have.
    Foreign,
    /// Classic where FD was expected, or the reverse, or a remote frame.
    Kind,
    /// Wrong length.
    Length {
        /// Bytes of this part.
        expected: usize,
        /// Bytes of the frame.
        found: usize,
    },
    /// Part number and identifier, or the first and last flags, contradict each other.
    Header,
    /// The CRC is wrong: damaged, or made for another interface.
    Crc,
}

impl core::fmt::Display for FrameError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Foreign => f.write_str("another message, node or part"),
            Self::Kind => f.write_str("a frame of the other profile"),
            Self::Length { expected, found } => write!(f, "expected {expected} bytes, found {found}"),
            Self::Header => f.write_str("part number or flags contradict the identifier"),
            Self::Crc => f.write_str("wrong CRC (damaged, or made for another policy interface)"),
        }
    }
}

impl core::error::Error for FrameError {}

/// One decoded part of a set.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// Sequence number.
    pub seq: u16,
    /// Part number.
    pub part: usize,
    /// Index of the first value in the set.
    pub first: usize,
    /// Values; an invalid one is not a number.
    pub values: Vec<f32, FD_VALUES>,
}

/// What an action set says besides the values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActionHeader {
    /// Sequence number of the tick that it answers.
    pub seq: u16,
    /// Latent that was chosen, [`NO_LATENT`](crate::protocol::NO_LATENT) for none.
    pub latent: u16,
    /// See [`Flags`].
    pub flags: Flags,
}

/// DECISION of profile `classic-i16`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Decision {
    /// Sequence, latent, flags.
    pub header: ActionHeader,
    /// Time of the last inference, µs; 0 where not measured.
    pub inference_us: u16,
    /// Latents that the mask left, saturated.
    pub allowed: u8,
}
