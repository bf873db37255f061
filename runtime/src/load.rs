//! Bytes to views: everything that can be wrong with a file is found here, once, so that a step cannot fail later.
#![deny(clippy::arithmetic_side_effects)]

use crate::error::LoadError;
use crate::fields::{bytes_at, u16_at, u32_at, u64_at};
use crate::interface::{
    ACTION_LEN, HEAD_BINARY, HEAD_CONTINUOUS, HEAD_DISCRETE, INTERFACE_HEAD, InterfaceView, OBSERVATION_LEN,
    interface_hash,
};
use crate::part::Part;
use crate::quant::INPUT_BITS;
use crate::schema::{
    FORMAT_VERSION, HEADER_LEN, Header, IMAGE_ALIGN, MAGIC, MAX_ACTIONS, MAX_OBS, MAX_SELF_TESTS, MAX_TEXT, MAX_TYPES,
    NUMERICS_VERSION, RUNTIME_ABI, SECTION_ALIGN, Section, TABLE_LEN, TRAILER_HEAD, WeightKind,
};
use crc::{CRC_32_ISO_HDLC, Crc};

/// The checksum of header, payload and trailer records.
pub(crate) const CRC32: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);
/// Bytes before the first input record.
pub(crate) const INPUT_HEAD: usize = 16;
/// Bytes of an input record: offset and scale.
pub(crate) const INPUT_LEN: usize = 8;
/// Bytes before the first self-test vector.
pub(crate) const SELF_TEST_HEAD: usize = 16;
/// Bytes of the fixed part of the provenance section.
pub(crate) const PROVENANCE_HEAD: usize = 56;

/// What integer and float policies have in common, checked.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Image<'a> {
    pub(crate) header: Header,
    pub(crate) interface: InterfaceView<'a>,
    pub(crate) input: &'a [[u8; INPUT_LEN]],
    /// Bits of a quantised observation.
    pub(crate) input_bits: u16,
    pub(crate) q: Part<'a>,
    pub(crate) confidence: Part<'a>,
    pub(crate) decoder: Part<'a>,
    pub(crate) self_tests: &'a [u8],
    pub(crate) self_test_len: usize,
    pub(crate) interface_len: usize,
    pub(crate) input_len: usize,
    pub(crate) provenance: &'a [u8],
    pub(crate) trailer: &'a [u8],
}

impl<'a> Image<'a> {
    /// Checks all but the networks.
    pub(crate) fn load(image: &'a [u8], weights: WeightKind) -> Result<Self, LoadError> {
        let header = header(image, weights)?;
        let total = header.total_len as usize;
        let file = image.get(..total).ok_or(LoadError::Truncated { expected: total, found: image.len() })?;
        let payload_len = header.payload_len as usize;
        let (payload, trailer) = file
            .get(HEADER_LEN..)
            .and_then(|rest| rest.split_at_checked(payload_len))
            .ok_or(LoadError::Truncated { expected: HEADER_LEN.saturating_add(payload_len), found: total })?;
        let found = CRC32.checksum(payload);
        if found != header.payload_crc32 {
            return Err(LoadError::Checksum { section: Section::Table, expected: header.payload_crc32, found });
        }
        let [interface, input, q, confidence, decoder, self_tests, provenance] = table(payload)?;
        let (interface_len, input_len, self_test_len) =
            (interface.bytes.len(), input.bytes.len(), self_tests.bytes.len());
        let interface = check_interface(&interface)?;
        let found = interface_hash(interface);
        if found != header.interface_hash {
            return Err(LoadError::InterfaceHash { expected: header.interface_hash, found });
        }
        let obs_dim = interface.observations.len();
        let (input, input_bits) = check_input(&input, obs_dim)?;
        let self_tests = check_self_tests(&self_tests, obs_dim, interface.actions.len())?;
        let provenance = check_provenance(&provenance)?;
        check_trailer(trailer, HEADER_LEN.saturating_add(payload_len))?;
        Ok(Self {
            header,
            interface,
            input,
            input_bits,
            q,
            confidence,
            decoder,
            self_tests,
            self_test_len,
            interface_len,
            input_len,
            provenance,
            trailer,
        })
    }
}

fn header(image: &[u8], weights: WeightKind) -> Result<Header, LoadError> {
    let bytes =
        image.first_chunk::<HEADER_LEN>().ok_or(LoadError::Truncated { expected: HEADER_LEN, found: image.len() })?;
    let part = Part { section: Section::Header, bytes, base: 0 };
    let magic: [u8; 8] = bytes_at(bytes, 0).unwrap_or_default();
    if magic != MAGIC {
        return Err(foreign(magic));
    }
    let found = image.as_ptr().addr() % IMAGE_ALIGN;
    if found != 0 {
        return Err(LoadError::Misaligned { expected: IMAGE_ALIGN, found });
    }
    let found = CRC32.checksum(part.slice(0, 60)?);
    let expected = part.u32(60, 0, u32::MAX)?;
    if found != expected {
        return Err(LoadError::HeaderChecksum { expected, found });
    }
    let (format, numerics) = (part.u16(8, 0, u16::MAX)?, part.u16(10, 0, u16::MAX)?);
    let runtime_abi = part.u32(40, 0, u32::MAX)?;
    if format != FORMAT_VERSION || numerics != NUMERICS_VERSION || runtime_abi != RUNTIME_ABI {
        return Err(LoadError::Version { format, numerics, runtime_abi });
    }
    let found = part.u16(44, 0, u16::MAX)?;
    if found != weights.code() {
        return Err(LoadError::WeightKind { expected: weights, found });
    }
    part.zeros(46, 14)?;
    let aligned = |at| {
        let found = part.u32(at, 0, u32::MAX)?;
        let down = found & !15;
        if found == down { Ok(found) } else { part.u32(at, down, down) }
    };
    Ok(Header {
        format,
        numerics,
        total_len: aligned(12)?,
        payload_len: aligned(16)?,
        payload_crc32: part.u32(20, 0, u32::MAX)?,
        interface_hash: u64_at(bytes, 24).unwrap_or_default(),
        policy_seq: part.u32(32, 0, u32::MAX)?,
        scratch_words: part.u32(36, 0, u32::MAX)?,
        runtime_abi,
        weights,
    })
}

/// Names the likely cause of a wrong magic.
fn foreign(found: [u8; 8]) -> LoadError {
    if found == [0xFF; 8] || found == [0; 8] {
        LoadError::Erased
    } else if found.windows(3).any(|window| window == b"GDM") {
        LoadError::TextDamage { found }
    } else {
        LoadError::NotAPolicy { found }
    }
}

/// The sections, which must follow each other without gaps but padding.
fn table(payload: &[u8]) -> Result<[Part<'_>; 7], LoadError> {
    let table = Part { section: Section::Table, bytes: payload, base: HEADER_LEN };
    table.zeros(TABLE_LEN.saturating_sub(8), 8)?;
    let mut parts = Section::IN_TABLE.map(|section| Part { section, bytes: &[], base: 0 });
    let mut cursor = TABLE_LEN;
    let mut at = 0usize;
    for part in &mut parts {
        let len = u32_at(payload, at.saturating_add(4)).unwrap_or_default() as usize;
        let (bytes, next) = table.placed(at, cursor, len)?;
        part.bytes = bytes;
        part.base = table.offset(next.saturating_sub(len));
        cursor = next;
        at = at.saturating_add(8);
    }
    let end = cursor.checked_next_multiple_of(SECTION_ALIGN).unwrap_or(usize::MAX);
    table.exactly(end)?;
    table.zeros(cursor, end.saturating_sub(cursor))?;
    Ok(parts)
}

fn check_interface<'a>(part: &Part<'a>) -> Result<InterfaceView<'a>, LoadError> {
    let obs_dim = usize::from(part.u16(0, 1, limit(MAX_OBS))?);
    let action_dim = usize::from(part.u16(2, 1, limit(MAX_ACTIONS))?);
    let control_period_us = part.u32(4, 1, u32::MAX)?;
    let text_len = part.u32(8, 0, u32::MAX)? as usize;
    part.zeros(12, 4)?;
    let actions_at = obs_dim.saturating_mul(OBSERVATION_LEN).saturating_add(INTERFACE_HEAD);
    let text_at = action_dim.saturating_mul(ACTION_LEN).saturating_add(actions_at);
    part.exactly(text_at.saturating_add(text_len))?;
    let observations = part.slice(INTERFACE_HEAD, actions_at.saturating_sub(INTERFACE_HEAD))?;
    let actions = part.slice(actions_at, text_at.saturating_sub(actions_at))?;
    let mut text = 0usize;
    for index in 0..obs_dim {
        let at = index.saturating_mul(OBSERVATION_LEN).saturating_add(INTERFACE_HEAD);
        text = check_texts(part, at, text_at, text)?;
        let lo = part.number(at.saturating_add(8), |_| true)?;
        part.number(at.saturating_add(12), |hi| hi > lo)?;
    }
    for index in 0..action_dim {
        let at = index.saturating_mul(ACTION_LEN).saturating_add(actions_at);
        text = check_texts(part, at, text_at, text)?;
        check_action(part, at)?;
    }
    if text != text_len {
        return Err(LoadError::SectionLength {
            section: part.section,
            expected: text_at.saturating_add(text),
            found: part.bytes.len(),
        });
    }
    Ok(InterfaceView {
        observations: observations.as_chunks().0,
        actions: actions.as_chunks().0,
        text: part.slice(text_at, text_len)?,
        control_period_us,
    })
}

/// Name and unit of the record at `at`; texts follow each other in the order of the records.
fn check_texts(part: &Part<'_>, at: usize, text_at: usize, text: usize) -> Result<usize, LoadError> {
    let expected = u32::try_from(text).unwrap_or(u32::MAX);
    part.u32(at, expected, expected)?;
    let name_len = usize::from(part.u16(at.saturating_add(4), 1, limit(MAX_TEXT))?);
    let unit_len = usize::from(part.u16(at.saturating_add(6), 0, limit(MAX_TEXT))?);
    let unit = text.saturating_add(name_len);
    part.text(text_at.saturating_add(text), name_len)?;
    part.text(text_at.saturating_add(unit), unit_len)?;
    Ok(unit.saturating_add(unit_len))
}

fn check_action(part: &Part<'_>, at: usize) -> Result<(), LoadError> {
    let [n, lo, hi, safe] = [10, 12, 16, 20].map(|field: usize| at.saturating_add(field));
    match part.u16(at.saturating_add(8), HEAD_CONTINUOUS, HEAD_BINARY)? {
        HEAD_CONTINUOUS => {
            part.zeros(n, 2)?;
            let low = part.number(lo, |_| true)?;
            let high = part.number(hi, |high| high > low && (high - low).is_finite())?;
            part.number(safe, |safe| safe >= low && safe <= high)?;
        }
        HEAD_DISCRETE => {
            let count = part.u16(n, 1, limit(MAX_TYPES))?;
            part.zeros(lo, 8)?;
            part.number(safe, |safe| is_index(safe, count))?;
        }
        _ => {
            part.zeros(n, 10)?;
            part.number(safe, |safe| is_index(safe, 2))?;
        }
    }
    Ok(())
}

/// Whether `value` is one of `0.0, 1.0, ..., count - 1`, with a positive sign.
pub(crate) fn is_index(value: f32, count: u16) -> bool {
    (0..count).any(|index| f32::from(index).to_bits() == value.to_bits())
}

fn check_input<'a>(part: &Part<'a>, obs_dim: usize) -> Result<(&'a [[u8; INPUT_LEN]], u16), LoadError> {
    let bits = part.u16(0, 8, INPUT_BITS)?;
    part.zeros(2, 14)?;
    let len = obs_dim.saturating_mul(INPUT_LEN);
    part.exactly(len.saturating_add(INPUT_HEAD))?;
    for index in 0..obs_dim {
        let at = index.saturating_mul(INPUT_LEN).saturating_add(INPUT_HEAD);
        part.number(at, |_| true)?;
        part.number(at.saturating_add(4), |scale| scale.is_normal() && scale > 0.0)?;
    }
    Ok((part.slice(INPUT_HEAD, len)?.as_chunks().0, bits))
}

/// Bytes of one self-test vector.
pub(crate) fn self_test_len(obs_dim: usize, action_dim: usize) -> usize {
    obs_dim.saturating_add(action_dim).saturating_add(1).saturating_mul(4)
}

fn check_self_tests<'a>(part: &Part<'a>, obs_dim: usize, action_dim: usize) -> Result<&'a [u8], LoadError> {
    let count = usize::from(part.u16(0, 1, limit(MAX_SELF_TESTS))?);
    part.zeros(2, 14)?;
    let len = self_test_len(obs_dim, action_dim);
    let vectors_len = count.saturating_mul(len);
    part.exactly(vectors_len.saturating_add(SELF_TEST_HEAD))?;
    for vector in 0..count {
        let at = vector.saturating_mul(len).saturating_add(SELF_TEST_HEAD);
        for index in 0..obs_dim {
            part.number(index.saturating_mul(4).saturating_add(at), |_| true)?;
        }
        let latent_at = obs_dim.saturating_mul(4).saturating_add(at);
        part.zeros(latent_at.saturating_add(2), 2)?;
        for slot in 0..action_dim {
            part.number(slot.saturating_add(1).saturating_mul(4).saturating_add(latent_at), |_| true)?;
        }
    }
    part.slice(SELF_TEST_HEAD, vectors_len)
}

fn check_provenance<'a>(part: &Part<'a>) -> Result<&'a [u8], LoadError> {
    for at in [24, 28, 36, 40] {
        part.number(at, |_| true)?;
    }
    let mut at = PROVENANCE_HEAD;
    for field in [48, 50, 52, 54] {
        let len = usize::from(part.u16(field, 0, limit(MAX_TEXT))?);
        part.text(at, len)?;
        at = at.saturating_add(len);
    }
    part.exactly(at)?;
    Ok(part.bytes)
}

fn check_trailer(trailer: &[u8], base: usize) -> Result<(), LoadError> {
    let part = Part { section: Section::Trailer, bytes: trailer, base };
    let mut at = 0usize;
    while at < trailer.len() {
        part.zeros(at.saturating_add(2), 2)?;
        part.zeros(at.saturating_add(12), 4)?;
        let len = part.u32(at.saturating_add(4), 0, u32::MAX)? as usize;
        let expected = part.u32(at.saturating_add(8), 0, u32::MAX)?;
        let start = at.saturating_add(TRAILER_HEAD);
        let found = CRC32.checksum(part.slice(start, len)?);
        if found != expected {
            return Err(LoadError::Checksum { section: Section::Trailer, expected, found });
        }
        let end = start.saturating_add(len);
        at = end.checked_next_multiple_of(SECTION_ALIGN).unwrap_or(usize::MAX);
        part.zeros(end, at.saturating_sub(end))?;
    }
    Ok(())
}

/// The optional records of the trailer: kind and content.
pub(crate) fn trailer_records(trailer: &[u8]) -> impl Iterator<Item = (u16, &[u8])> {
    let mut rest = trailer;
    core::iter::from_fn(move || {
        let kind = u16_at(rest, 0)?;
        let len = u32_at(rest, 4)? as usize;
        let data = rest.get(TRAILER_HEAD..)?.get(..len)?;
        let next = len.checked_next_multiple_of(SECTION_ALIGN)?.checked_add(TRAILER_HEAD)?;
        rest = rest.get(next..)?;
        Some((kind, data))
    })
}

/// Limits of the format fit a `u16`.
pub(crate) fn limit(value: usize) -> u16 {
    u16::try_from(value).unwrap_or(u16::MAX)
}
