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

use crc::{CRC_8_AUTOSAR, CRC_32_ISO_HDLC, Crc};
use gadm_runtime::Policy;
use gadm_runtime::space::ActionHead;
use heapless::Vec;

use crate::frame::{Frame, Kind, fd_length, standard};
use crate::protocol::{
    CLASSIC_VALUES, FD_VALUES, Function, MAX_ACTION_PARTS, MAX_ACTIONS, MAX_OBSERVATIONS, NO_LATENT, NodeId, address,
    identifier,
};

const CRC8: Crc<u8> = Crc::<u8>::new(&CRC_8_AUTOSAR);
const CRC32: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

/// Number of i16 steps from the middle of a range to its end.
const FULL_SCALE: f32 = 32767.0;
/// The i16 that stands for an invalid value.
pub const INVALID_I16: i16 = i16::MIN;

/// How values travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
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

/// How one value becomes an i16.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Scale {
    /// Over `mid ± half`.
    Range { mid: f32, half: f32 },
    /// As it is: types and switches.
    Integer,
}

impl Scale {
    fn range(lo: f32, hi: f32) -> Option<Self> {
        let (mid, half) = (lo * 0.5 + hi * 0.5, hi * 0.5 - lo * 0.5);
        (mid.is_finite() && half.is_finite() && half > 0.0).then_some(Self::Range { mid, half })
    }

    fn quantise(self, value: f32) -> i16 {
        if !value.is_finite() {
            return INVALID_I16;
        }
        round_i16(match self {
            Self::Range { mid, half } => (value - mid) / half * FULL_SCALE,
            Self::Integer => value,
        })
    }

    fn value(self, q: i16) -> f32 {
        if q == INVALID_I16 {
            return f32::NAN;
        }
        match self {
            Self::Range { mid, half } => mid + f32::from(q) / FULL_SCALE * half,
            Self::Integer => f32::from(q),
        }
    }
}

/// Round to nearest, halves away from zero, saturated at ±32767. `core` has no `f32::round`.
#[expect(clippy::cast_possible_truncation, reason = "truncation is meant; |y| < 2^15")]
fn round_i16(y: f32) -> i16 {
    let y = y.clamp(-FULL_SCALE, FULL_SCALE);
    let whole = y as i16;
    let rest = y - f32::from(whole);
    if rest >= 0.5 {
        whole.saturating_add(1)
    } else if rest <= -0.5 {
        whole.saturating_sub(1)
    } else {
        whole
    }
}

/// Why there is no layout for a policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum LayoutError {
    /// More observation values than the identifiers of OBS hold.
    Observations {
        /// Values of the policy.
        found: usize,
        /// Most values.
        limit: usize,
    },
    /// More action values than the identifiers of ACT hold.
    Actions {
        /// Values of the policy.
        found: usize,
        /// Most values.
        limit: usize,
    },
    /// `classic-i16` needs a finite range `lo < hi`.
    ObservationRange {
        /// Position of the signal.
        index: usize,
    },
    /// `classic-i16` needs a finite range `lo < hi`.
    ActionRange {
        /// Position of the signal.
        index: usize,
    },
}

impl core::fmt::Display for LayoutError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Observations { found, limit } => {
                write!(f, "{found} observation values, the bus has room for {limit}")
            }
            Self::Actions { found, limit } => write!(f, "{found} action values, the bus has room for {limit}"),
            Self::ObservationRange { index } => {
                write!(f, "observation signal {index} has no finite range lo < hi, which classic-i16 needs; use fd-f32")
            }
            Self::ActionRange { index } => {
                write!(f, "action signal {index} has no finite range lo < hi, which classic-i16 needs; use fd-f32")
            }
        }
    }
}

impl core::error::Error for LayoutError {}

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
    /// Latent that was chosen, [`NO_LATENT`] for none.
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

/// How the observations and actions of one policy lie in frames.
#[derive(Clone, Debug)]
pub struct Layout {
    profile: Profile,
    node: NodeId,
    hash: [u8; 4],
    observations: Vec<Scale, MAX_OBSERVATIONS>,
    actions: Vec<Scale, MAX_ACTIONS>,
}

impl Layout {
    /// A layout for the ranges `(lo, hi)` of the observation signals and the heads of the action signals.
    ///
    /// # Errors
    /// Where the protocol has no room, or where `classic-i16` has no range to scale by.
    pub fn new(
        profile: Profile,
        node: NodeId,
        interface_hash: u64,
        observations: impl Iterator<Item = (f32, f32)>,
        heads: impl Iterator<Item = ActionHead>,
    ) -> Result<Self, LayoutError> {
        let [a, b, c, d, ..] = interface_hash.to_le_bytes();
        let mut layout = Self { profile, node, hash: [a, b, c, d], observations: Vec::new(), actions: Vec::new() };
        let classic = profile == Profile::ClassicI16;
        let mut found = 0;
        for (index, (lo, hi)) in observations.enumerate() {
            let scale = match Scale::range(lo, hi) {
                Some(scale) => scale,
                None if classic => return Err(LayoutError::ObservationRange { index }),
                None => Scale::Integer, // fd-f32 does not scale
            };
            found += 1;
            let _full = layout.observations.push(scale);
        }
        if found > MAX_OBSERVATIONS {
            return Err(LayoutError::Observations { found, limit: MAX_OBSERVATIONS });
        }
        let mut found = 0;
        for (index, head) in heads.enumerate() {
            let scale = match head {
                ActionHead::Continuous { lo, hi } => match Scale::range(lo, hi) {
                    Some(scale) => scale,
                    None if classic => return Err(LayoutError::ActionRange { index }),
                    None => Scale::Integer,
                },
                ActionHead::Discrete { .. } | ActionHead::Binary => Scale::Integer,
            };
            found += 1;
            let _full = layout.actions.push(scale);
        }
        if found > MAX_ACTIONS {
            return Err(LayoutError::Actions { found, limit: MAX_ACTIONS });
        }
        Ok(layout)
    }

    /// The layout of a policy.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn of_policy(policy: &Policy, profile: Profile, node: NodeId) -> Result<Self, LayoutError> {
        let ranges = policy.observation_signals().map(|s| (s.lo, s.hi));
        let heads = policy.action_signals().map(|s| s.head);
        Self::new(profile, node, policy.interface_hash(), ranges, heads)
    }

    /// The profile.
    #[must_use]
    pub fn profile(&self) -> Profile {
        self.profile
    }

    /// The node that the action identifiers belong to.
    #[must_use]
    pub fn node(&self) -> NodeId {
        self.node
    }

    /// Values of an observation.
    #[must_use]
    pub fn obs_dim(&self) -> usize {
        self.observations.len()
    }

    /// Values of an action.
    #[must_use]
    pub fn action_dim(&self) -> usize {
        self.actions.len()
    }

    /// Frames of an observation set.
    #[must_use]
    pub fn observation_parts(&self) -> usize {
        self.obs_dim().div_ceil(self.profile.values()).max(1)
    }

    /// Frames of an action set, DECISION not counted.
    #[must_use]
    pub fn action_parts(&self) -> usize {
        self.action_dim().div_ceil(self.profile.values()).max(1)
    }

    /// Payload bytes of a frame that holds `values` values.
    #[must_use]
    pub fn payload_len(&self, values: usize) -> usize {
        match self.profile {
            Profile::ClassicI16 => 8,
            Profile::FdF32 => fd_length(8 + 4 * values.min(FD_VALUES)).unwrap_or(64),
        }
    }

    /// One part of the observation `values` (the whole set, `obs_dim` numbers); `None` where there is no such part.
    #[must_use]
    pub fn observation_frame(&self, part: usize, seq: u16, values: &[f32]) -> Option<Frame> {
        let last = part + 1 == self.observation_parts();
        let number = u8::try_from(part).ok()?;
        let id = identifier(Function::Observation, 0, number)?;
        if values.len() != self.obs_dim() || part >= self.observation_parts() {
            return None;
        }
        let chunk = values.chunks(self.profile.values()).nth(part).unwrap_or(&[]);
        let invalid = chunk.iter().any(|v| !v.is_finite());
        let flags = u8::from(part == 0) | u8::from(last) << 1 | u8::from(invalid) << 2;
        let scales = self.observations.get(part * self.profile.values()..).unwrap_or(&[]);
        self.pack(id, seq, [number, flags], chunk, scales)
    }

    /// Reads one part of an observation set.
    ///
    /// # Errors
    /// [`FrameError::Foreign`] for everything that is not an observation of this layout, else what is wrong with it.
    pub fn observation_part(&self, frame: &Frame) -> Result<Part, FrameError> {
        let found = frame.standard_id().and_then(address).ok_or(FrameError::Foreign)?;
        let part = usize::from(found.part);
        if found.message.function != Function::Observation || part >= self.observation_parts() {
            return Err(FrameError::Foreign);
        }
        let (part, [number, flags]) = self.unpack(frame, part, &self.observations)?;
        let ends = u8::from(part.part == 0) | u8::from(part.part + 1 == self.observation_parts()) << 1;
        if self.profile == Profile::FdF32 && (number != found.part || flags & 3 != ends) {
            return Err(FrameError::Header);
        }
        Ok(part)
    }

    /// One part of the action `values` (the whole set, `action_dim` numbers); `None` where there is no such part.
    #[must_use]
    pub fn action_frame(&self, part: usize, header: ActionHeader, values: &[f32]) -> Option<Frame> {
        if values.len() != self.action_dim() || part >= self.action_parts() {
            return None;
        }
        let id = identifier(Function::Action, self.node.get(), u8::try_from(part).ok()?)?;
        let chunk = values.chunks(self.profile.values()).nth(part).unwrap_or(&[]);
        let [low, high] = header.latent.min(NO_LATENT).to_le_bytes();
        let scales = self.actions.get(part * self.profile.values()..).unwrap_or(&[]);
        self.pack(id, header.seq, [low, high | header.flags.bits() << 3], chunk, scales)
    }

    /// Reads one part of an action set. In `classic-i16` the header holds the sequence only; latent and flags are in
    /// DECISION.
    ///
    /// # Errors
    /// [`FrameError::Foreign`] for everything that is not an action of this layout and node, else what is wrong with it.
    pub fn action_part(&self, frame: &Frame) -> Result<(ActionHeader, Part), FrameError> {
        let found = frame.standard_id().and_then(address).ok_or(FrameError::Foreign)?;
        let part = usize::from(found.part);
        let mine = found.message.function == Function::Action && found.node == self.node.get();
        if !mine || part >= self.action_parts() || part >= MAX_ACTION_PARTS {
            return Err(FrameError::Foreign);
        }
        let (part, [low, high]) = self.unpack(frame, part, &self.actions)?;
        let header = match self.profile {
            Profile::ClassicI16 => ActionHeader { seq: part.seq, latent: NO_LATENT, flags: Flags::default() },
            Profile::FdF32 => ActionHeader {
                seq: part.seq,
                latent: u16::from_le_bytes([low, high]) & NO_LATENT,
                flags: Flags::from_bits(high >> 3),
            },
        };
        Ok((header, part))
    }

    /// DECISION; `None` in `fd-f32`, where ACT says it.
    #[must_use]
    pub fn decision_frame(&self, decision: Decision) -> Option<Frame> {
        if self.profile != Profile::ClassicI16 {
            return None;
        }
        let id = identifier(Function::Decision, self.node.get(), 0)?;
        let [seq, _] = decision.header.seq.to_le_bytes();
        let ([l0, l1], [i0, i1]) = (decision.header.latent.to_le_bytes(), decision.inference_us.to_le_bytes());
        let body = [seq, l0, l1, decision.header.flags.bits(), i0, i1, decision.allowed];
        let [b0, b1, b2, b3, b4, b5, b6] = body;
        Frame::classic(standard(id), &[b0, b1, b2, b3, b4, b5, b6, self.crc8(id, &body)])
    }

    /// Reads DECISION.
    ///
    /// # Errors
    /// [`FrameError::Foreign`] for everything else, else what is wrong with it.
    pub fn decision(&self, frame: &Frame) -> Result<Decision, FrameError> {
        let id = frame.standard_id().ok_or(FrameError::Foreign)?;
        if self.profile != Profile::ClassicI16 || identifier(Function::Decision, self.node.get(), 0) != Some(id) {
            return Err(FrameError::Foreign);
        }
        let [seq, l0, l1, flags, i0, i1, allowed, _] = self.classic_body(frame, id)?;
        Ok(Decision {
            header: ActionHeader {
                seq: u16::from(seq),
                latent: u16::from_le_bytes([l0, l1]),
                flags: Flags::from_bits(flags),
            },
            inference_us: u16::from_le_bytes([i0, i1]),
            allowed,
        })
    }

    fn pack(&self, id: u16, seq: u16, extra: [u8; 2], values: &[f32], scales: &[Scale]) -> Option<Frame> {
        let [s0, s1] = seq.to_le_bytes();
        match self.profile {
            Profile::ClassicI16 => {
                let mut body = [0_u8; 7];
                *body.first_mut()? = s0;
                for ((slot, &value), scale) in body.get_mut(1..)?.chunks_exact_mut(2).zip(values).zip(scales) {
                    slot.copy_from_slice(&scale.quantise(value).to_le_bytes());
                }
                let [b0, b1, b2, b3, b4, b5, b6] = body;
                Frame::classic(standard(id), &[b0, b1, b2, b3, b4, b5, b6, self.crc8(id, &body)])
            }
            Profile::FdF32 => {
                let mut payload = [0_u8; 64];
                payload.first_chunk_mut::<4>()?.copy_from_slice(&[s0, s1, extra[0], extra[1]]);
                for (slot, &value) in payload.get_mut(4..)?.chunks_exact_mut(4).zip(values) {
                    let value = if value.is_finite() { value } else { f32::NAN };
                    slot.copy_from_slice(&value.to_le_bytes());
                }
                let (body, tail) = payload.get_mut(..self.payload_len(values.len()))?.split_last_chunk_mut::<4>()?;
                *tail = self.crc32(id, body).to_le_bytes();
                Frame::fd(standard(id), payload.get(..self.payload_len(values.len()))?, true)
            }
        }
    }

    fn unpack(&self, frame: &Frame, part: usize, scales: &[Scale]) -> Result<(Part, [u8; 2]), FrameError> {
        let id = frame.standard_id().ok_or(FrameError::Foreign)?;
        let first = part * self.profile.values();
        let scales = scales.get(first..).unwrap_or(&[]);
        let count = scales.len().min(self.profile.values());
        let mut values = Vec::new();
        match self.profile {
            Profile::ClassicI16 => {
                let body = self.classic_body(frame, id)?;
                let [seq, numbers @ .., _] = &body;
                for (bytes, scale) in numbers.chunks_exact(2).zip(scales).take(count) {
                    let q = bytes.first_chunk().map_or(INVALID_I16, |b| i16::from_le_bytes(*b));
                    let _full = values.push(scale.value(q));
                }
                Ok((Part { seq: u16::from(*seq), part, first, values }, [0, 0]))
            }
            Profile::FdF32 => {
                if !matches!(frame.kind(), Kind::Fd { .. }) {
                    return Err(FrameError::Kind);
                }
                let (expected, found) = (self.payload_len(count), frame.payload().len());
                let wrong = FrameError::Length { expected, found };
                if expected != found {
                    return Err(wrong);
                }
                let (body, tail) = frame.payload().split_last_chunk::<4>().ok_or(wrong)?;
                if self.crc32(id, body).to_le_bytes() != *tail {
                    return Err(FrameError::Crc);
                }
                let ([s0, s1, e0, e1], numbers) = body.split_first_chunk::<4>().ok_or(wrong)?;
                for bytes in numbers.chunks_exact(4).take(count) {
                    let value = bytes.first_chunk().map_or(f32::NAN, |b| f32::from_le_bytes(*b));
                    let _full = values.push(if value.is_finite() { value } else { f32::NAN });
                }
                Ok((Part { seq: u16::from_le_bytes([*s0, *s1]), part, first, values }, [*e0, *e1]))
            }
        }
    }

    fn classic_body(&self, frame: &Frame, id: u16) -> Result<[u8; 8], FrameError> {
        if frame.kind() != Kind::Classic {
            return Err(FrameError::Kind);
        }
        let found = frame.payload().len();
        let body: [u8; 8] = frame.payload().try_into().map_err(|_| FrameError::Length { expected: 8, found })?;
        let [head @ .., crc] = &body;
        if self.crc8(id, head) == *crc { Ok(body) } else { Err(FrameError::Crc) }
    }

    fn crc8(&self, id: u16, body: &[u8]) -> u8 {
        let mut digest = CRC8.digest();
        digest.update(&id.to_le_bytes());
        digest.update(&self.hash);
        digest.update(body);
        digest.finalize()
    }

    fn crc32(&self, id: u16, body: &[u8]) -> u32 {
        let mut digest = CRC32.digest();
        digest.update(&id.to_le_bytes());
        digest.update(&self.hash);
        digest.update(body);
        digest.finalize()
    }
}

#[cfg(test)]
#[path = "codec_tests.rs"]
mod tests;
