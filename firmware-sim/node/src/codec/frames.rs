//! Observation and action sets, and DECISION, written to frames and read from them.

use crc::{CRC_8_AUTOSAR, CRC_32_ISO_HDLC, Crc};
use heapless::Vec;

use super::scale::Scale;
use super::{ActionHeader, Decision, Flags, FrameError, INVALID_I16, Layout, Part, Profile};
use crate::frame::{Frame, Kind, standard};
use crate::protocol::{Function, MAX_ACTION_PARTS, NO_LATENT, address, identifier};

pub(super) const CRC8: Crc<u8> = Crc::<u8>::new(&CRC_8_AUTOSAR);
pub(super) const CRC32: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

impl Layout {
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

    pub(super) fn crc32(&self, id: u16, body: &[u8]) -> u32 {
        let mut digest = CRC32.digest();
        digest.update(&id.to_le_bytes());
        digest.update(&self.hash);
        digest.update(body);
        digest.finalize()
    }
}
