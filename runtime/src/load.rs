//! Bytes to views: everything that can be wrong with a file is found here, once, so that a step cannot fail later.
//!
//! The file is read front to back by a [`Reader`], section by section; networks and decoders in `load_net.rs`, the
//! bounds of their sums in `prove.rs`. Sizes are sums and products of counts that were checked against the limits of the
//! format and fit 32 bits.
#![deny(clippy::arithmetic_side_effects)]

use crate::crc::crc32;
use crate::error::LoadError;
use crate::fields::{bytes_at, u16_at, u32_at};
use crate::image::{INPUT_LEN, Image};
use crate::interface::{ACTION_LEN, HEAD_BINARY, HEAD_CONTINUOUS, HEAD_DISCRETE, OBSERVATION_LEN, action_head, fnv};
use crate::load_net::{check_decoder, check_net};
use crate::prove::prove;
use crate::provenance::PROVENANCE_HEAD;
use crate::quant::INPUT_BITS;
use crate::reader::{Reader, short};
use crate::schema::{
    FORMAT_VERSION, HEADER_LEN, IMAGE_ALIGN, MAGIC, MAX_ACTIONS, MAX_OBS, MAX_SELF_TESTS, MAX_TYPES, NUMERICS_VERSION,
    RUNTIME_ABI, RUNTIME_ABI_SEPARATE, SECTION_ALIGN, Section, TABLE_LEN, WeightKind, padded,
};
use crate::scratch::{scratch_words, scratch_words_float};
use crate::space::ActionHead;

/// Checks a file.
pub(crate) fn load<const PROVE: bool>(bytes: &[u8], kind: WeightKind) -> Result<Image<'_>, LoadError> {
    let mut reader = Reader::<PROVE>::new(Image::new(bytes, kind));
    check(&mut reader, kind);
    reader.finish()
}

/// All of it.
#[inline(never)]
fn check<const PROVE: bool>(reader: &mut Reader<'_, PROVE>, kind: WeightKind) {
    header(reader, kind);
    if reader.failed() {
        return;
    }
    let payload_end = (reader.image.word(16) as usize).wrapping_add(HEADER_LEN);
    table(reader, payload_end);
    if PROVE {
        interface(reader);
    } else {
        trusted_interface(reader);
    }
    input(reader);
    check_net(reader, kind, Section::Q);
    let confidence = !reader.image.section(Section::Confidence).is_empty() || reader.image.shared_trunk();
    if confidence {
        check_net(reader, kind, Section::Confidence);
    }
    let head_rows = check_decoder(reader, kind);
    self_tests(reader);
    if PROVE {
        provenance(reader);
        trailer(reader, payload_end);
        if kind == WeightKind::Int8 {
            prove(reader);
        }
    }
    let size = if kind == WeightKind::Int8 { scratch_words } else { scratch_words_float };
    let Image { spec, hidden_width, .. } = &mut reader.image;
    let (obs_dim, latents) = (usize::from(spec.obs_dim), usize::from(spec.num_latents));
    let words = size(obs_dim, usize::from(*hidden_width), latents, confidence, head_rows);
    spec.scratch_words = words;
    if PROVE {
        reader.enter_at(Section::Header, 36, HEADER_LEN);
        reader.exactly(words);
    }
}

/// Length, checksums and versions; the image becomes that of the file, without what follows it in its slot.
fn header<const PROVE: bool>(reader: &mut Reader<'_, PROVE>, kind: WeightKind) {
    let bytes = reader.image.file;
    let cut_off = |expected| LoadError::Truncated { expected, found: bytes.len() };
    let Some(header) = bytes.first_chunk::<HEADER_LEN>() else {
        return reader.fail(cut_off(HEADER_LEN));
    };
    let magic: [u8; 8] = bytes_at(header, 0).unwrap_or_default();
    if magic != MAGIC {
        return reader.fail(if PROVE { foreign(magic) } else { LoadError::NotAPolicy { found: magic } });
    }
    let found = bytes.as_ptr().addr() % IMAGE_ALIGN;
    if found != 0 {
        return reader.fail(LoadError::Misaligned { expected: IMAGE_ALIGN, found });
    }
    let word = |at| u32_at(header, at).unwrap_or_default();
    let half = |at| u16_at(header, at).unwrap_or_default();
    let (expected, found) = (word(60), crc32(header.get(..60).unwrap_or_default()));
    if found != expected {
        return reader.fail(LoadError::HeaderChecksum { expected, found });
    }
    let (format, numerics, runtime_abi) = (half(8), half(10), word(40));
    if format != FORMAT_VERSION
        || numerics != NUMERICS_VERSION
        || !(RUNTIME_ABI_SEPARATE..=RUNTIME_ABI).contains(&runtime_abi)
    {
        return reader.fail(LoadError::Version { format, numerics, runtime_abi });
    }
    let found = half(44);
    if found != kind.code() {
        return reader.fail(LoadError::WeightKind { expected: kind, found });
    }
    if PROVE {
        lengths(reader);
    }
    let (total, payload_len) = (word(12) as usize, word(16) as usize);
    let Some(file) = bytes.get(..total) else {
        return reader.fail(cut_off(total));
    };
    let end = payload_len.saturating_add(HEADER_LEN);
    let Some(payload) = file.get(HEADER_LEN..end) else {
        return reader.fail(LoadError::Truncated { expected: end, found: total });
    };
    let (expected, found) = (word(20), crc32(payload));
    if found != expected {
        return reader.fail(LoadError::Checksum { section: Section::Table, expected, found });
    }
    reader.image.file = file;
}

/// Whole lengths of file and payload, and what of the header is not used.
fn lengths<const PROVE: bool>(reader: &mut Reader<'_, PROVE>) {
    reader.enter_at(Section::Header, 12, HEADER_LEN);
    for _ in 0..2 {
        let found = reader.u32();
        if !found.is_multiple_of(16) {
            reader.at = reader.at.wrapping_sub(4);
            reader.exactly((found & !15) as usize);
        }
    }
    reader.at = 46;
    reader.zeros(14);
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
fn table<const PROVE: bool>(reader: &mut Reader<'_, PROVE>, payload_end: usize) {
    reader.enter_at(Section::Table, HEADER_LEN, payload_end);
    reader.far = HEADER_LEN + TABLE_LEN;
    for _ in Section::IN_TABLE {
        reader.exactly(padded(reader.far, SECTION_ALIGN));
        let len = reader.u32() as usize;
        reader.swap();
        reader.pad();
        reader.take(len);
        reader.swap();
    }
    reader.zeros(8);
    reader.swap();
    reader.pad();
    reader.end();
}

fn interface<const PROVE: bool>(reader: &mut Reader<'_, PROVE>) {
    reader.enter(Section::Interface);
    let start = reader.at;
    let obs_dim = reader.u16(1, MAX_OBS);
    let action_dim = reader.u16(1, MAX_ACTIONS);
    reader.image.spec.obs_dim = short(obs_dim);
    reader.image.spec.action_dim = short(action_dim);
    reader.image.spec.control_period_us = reader.field(4, 1, u32::MAX);
    // The period comes first in the hash, and the counts before what they count.
    reader.hash(start.wrapping_add(4));
    reader.at = start.wrapping_add(2);
    reader.hash(start);
    reader.at = start.wrapping_add(12);
    reader.zeros(4);
    let texts =
        obs_dim.wrapping_mul(OBSERVATION_LEN).wrapping_add(action_dim.wrapping_mul(ACTION_LEN)).wrapping_add(reader.at);
    reader.far = texts;
    for index in 0..obs_dim.wrapping_add(action_dim) {
        if index == obs_dim {
            let at = reader.at;
            reader.at = start.wrapping_add(4);
            reader.hash(start.wrapping_add(2));
            reader.at = at;
        }
        reader.exactly(reader.far.wrapping_sub(texts));
        // Name and unit; texts follow each other in the order of the records.
        for min in [1, 0] {
            reader.text(min);
            reader.hash = fnv(reader.hash, &[0]);
        }
        let at = reader.at;
        if index < obs_dim {
            reader.range(f32::INFINITY);
        } else {
            action(reader);
        }
        reader.hash(at);
    }
    reader.swap();
    reader.end();
    let text_len = reader.at.wrapping_sub(texts);
    reader.at = start.wrapping_add(8);
    reader.exactly(text_len);
    let (expected, found) = (reader.image.interface_hash(), reader.hash);
    if found != expected {
        reader.fail(LoadError::InterfaceHash { expected, found });
    }
}

/// The dimensions, and of the continuous actions the ranges, which a step clamps to; not the names, and not the hash.
fn trusted_interface<const PROVE: bool>(reader: &mut Reader<'_, PROVE>) {
    reader.enter(Section::Interface);
    reader.image.spec.obs_dim = short(reader.u16(1, MAX_OBS));
    reader.image.spec.action_dim = short(reader.u16(1, MAX_ACTIONS));
    reader.image.spec.control_period_us = reader.u32();
    // As many records as there are actions.
    let actions = reader.image.actions();
    reader.at =
        reader.at.wrapping_add(8).wrapping_add(usize::from(reader.image.spec.obs_dim).wrapping_mul(OBSERVATION_LEN));
    reader.take(usize::from(reader.image.spec.action_dim).wrapping_mul(ACTION_LEN));
    for record in actions {
        if let ActionHead::Continuous { lo, hi } = action_head(record) {
            reader.require(lo < hi && hi - lo <= f32::MAX, lo);
        }
    }
}

fn action<const PROVE: bool>(reader: &mut Reader<'_, PROVE>) {
    let kind = short(reader.u16(HEAD_CONTINUOUS.into(), HEAD_BINARY.into()));
    let mut count = 2;
    if kind == HEAD_DISCRETE {
        count = reader.u16(1, MAX_TYPES);
    } else {
        reader.zeros(2);
    }
    if kind == HEAD_CONTINUOUS {
        let (low, high) = reader.range(f32::MAX);
        reader.number(low, high);
    } else {
        reader.zeros(8);
        reader.index(count);
    }
}

fn input<const PROVE: bool>(reader: &mut Reader<'_, PROVE>) {
    reader.enter(Section::Input);
    reader.u16(8, INPUT_BITS.into());
    reader.zeros(14);
    if PROVE {
        for _ in 0..reader.image.spec.obs_dim {
            reader.finite();
            // Positive and normal.
            reader.number(f32::MIN_POSITIVE, f32::MAX);
        }
    } else {
        reader.take(usize::from(reader.image.spec.obs_dim).wrapping_mul(INPUT_LEN));
    }
    reader.end();
}

fn self_tests<const PROVE: bool>(reader: &mut Reader<'_, PROVE>) {
    reader.enter(Section::SelfTest);
    let count = reader.u16(1, MAX_SELF_TESTS);
    reader.zeros(14);
    let (obs_dim, action_dim) = (reader.image.spec.obs_dim.into(), usize::from(reader.image.spec.action_dim));
    if PROVE {
        for _ in 0..count {
            reader.numbers(obs_dim);
            reader.take(2);
            reader.zeros(2);
            reader.numbers(action_dim);
        }
    } else {
        reader.numbers(obs_dim.wrapping_add(action_dim).wrapping_add(1).wrapping_mul(count));
    }
    reader.end();
}

fn provenance<const PROVE: bool>(reader: &mut Reader<'_, PROVE>) {
    reader.enter(Section::Provenance);
    reader.far = reader.at.wrapping_add(PROVENANCE_HEAD);
    reader.take(24);
    for _ in 0..2 {
        reader.numbers(2);
        reader.take(4);
    }
    for _ in 0..4 {
        reader.text(0);
    }
    reader.swap();
    reader.end();
}

fn trailer<const PROVE: bool>(reader: &mut Reader<'_, PROVE>, from: usize) {
    reader.enter_at(Section::Trailer, from, reader.image.file.len());
    while reader.more() {
        reader.take(2);
        reader.zeros(2);
        let len = reader.u32();
        let expected = reader.u32();
        reader.zeros(4);
        let found = crc32(reader.take(len as usize));
        if found != expected {
            reader.fail(LoadError::Checksum { section: Section::Trailer, expected, found });
        }
        reader.pad();
    }
}
