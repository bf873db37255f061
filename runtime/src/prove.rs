//! Proves from the actual weights that no sum of an int8 layer leaves its range, whatever the observation.
//!
//! For a row with weights w, inputs in `lo..=hi` and start value c, the accumulator lies in
//! `c + sum(min(w lo, w hi)) ..= c + sum(max(w lo, w hi))`. Two limits must hold: an accumulator (times 256 for an `a`
//! row) fits 32 bits, so that the wrapping sums of the kernels are exact; and the `SMMLAR` result stays below 2^30, so
//! that it does not wrap and differences of logits fit 32 bits.
#![deny(clippy::arithmetic_side_effects)]

use crate::fields::{i32_at, slice_at};
use crate::kernels::block_len;
use crate::net::Layer;
use crate::quant::input_max;
use crate::reader::Reader;
use crate::schema::{Section, padded};

/// Largest magnitude of an accumulator; times 256 in an `a` row.
pub(crate) const ACC_LIMIT: u32 = (1 << 31) - 1;
/// Largest magnitude of an `SMMLAR` result.
pub(crate) const RESULT_LIMIT: u32 = (1 << 30) - 1;

/// Range of a layer's inputs.
#[derive(Clone, Copy)]
pub(crate) struct Range {
    pub(crate) lo: i32,
    pub(crate) hi: i32,
}

impl Range {
    /// Quantised observations.
    pub(crate) fn input(bits: u16) -> Self {
        let hi = i32::from(input_max(bits));
        Self { lo: !hi, hi }
    }

    /// Activations of `bits` bits.
    pub(crate) fn activation(bits: u16) -> Self {
        Self { lo: 0, hi: 1i32.wrapping_shl(u32::from(bits)).wrapping_sub(1) }
    }
}

/// All layers of a file whose shapes have been checked, for every latent.
#[inline(never)]
pub(crate) fn prove<const PROVE: bool>(reader: &mut Reader<'_, PROVE>) {
    if reader.failed() {
        return;
    }
    let input = Range::input(reader.image.input().0);
    for section in [Section::Q, Section::Confidence, Section::Decoder] {
        reader.enter(section);
        let net = reader.image.net(section);
        // The first layer of a decoder takes multipliers and offsets from the table of the latents.
        let at = if section == Section::Decoder { reader.start.wrapping_add(8) } else { usize::MAX };
        let mut table = slice_at(net.file, at);
        let mut range = input;
        if section == Section::Confidence
            && let Some(trunk) = reader.image.trunk()
        {
            range = Range::activation(trunk.bits);
        }
        reader.layer = 0;
        while let Some(layer) = net.layer(reader.layer.into()) {
            rows(reader, &layer, range, table);
            range = Range::activation(layer.bits);
            table = &[];
            reader.layer = reader.layer.wrapping_add(1);
        }
    }
}

/// One layer; `table` has the multipliers and offsets of a modulated one and is empty for the others.
#[inline(never)]
fn rows<const PROVE: bool>(reader: &mut Reader<'_, PROVE>, layer: &Layer<'_>, range: Range, table: &[u8]) {
    let rows = usize::from(layer.rows);
    let padded_rows = padded(rows, 4);
    let constants_at = block_len(layer.cols, true);
    // Start of the block.
    let mut block = 0usize;
    for row in 0..padded_rows {
        reader.row = row;
        let place = (row % 4).wrapping_mul(4).wrapping_add(block);
        // [raw0, b0, raw1, b1] with raw = 256 a + b; 256 A in `a` rows, B in `b` rows.
        let mut start = word(layer.stream, place);
        let mut scale = 1;
        if row.is_multiple_of(2) {
            start = start.wrapping_sub(word(layer.stream, place.wrapping_add(4)));
            scale = 256;
        }
        // 0 is between the ends of the sum, so the larger magnitude is one of these.
        let (up, down) = sums(reader, layer, range, block.wrapping_add(16));
        let end = |sum: i32| i64::from(sum).wrapping_mul(scale).wrapping_add(i64::from(start));
        let reach = end(up).max(end(down).wrapping_neg()).cast_unsigned();
        reader.bound(ACC_LIMIT, reach);
        let mut used = start;
        let (mut constants, mut at) = (layer.stream, place.wrapping_add(constants_at));
        let mut end = at;
        if !table.is_empty() {
            (constants, at, end) = (table, (row & !3).wrapping_add(row).wrapping_mul(4), table.len());
        }
        loop {
            let (m, p) = (word(constants, at), word(constants, at.wrapping_add(16)));
            // Both ends of the range, rounded outwards. The reach is below 2^31, or a fault.
            let product = (reach & u64::from(u32::MAX)).wrapping_mul(m.unsigned_abs().into()) >> 32;
            reader.bound(RESULT_LIMIT, product.wrapping_add(1).wrapping_add(p.unsigned_abs().into()));
            used |= m | p;
            at = at.wrapping_add(padded_rows.wrapping_mul(8));
            if at >= end {
                break;
            }
        }
        if row >= rows && used != 0 {
            reader.weight(0);
        }
        if row % 4 == 3 {
            block = block.wrapping_add(block_len(layer.cols, !table.is_empty()));
        }
    }
}

/// The ends of the sum of the row, whose weights must be in range and whose padding zero; the block's weights start at
/// `at`. At most 1024 weights of magnitude 128 and inputs of 12 bits: 32 bits hold the sums.
#[inline(never)]
fn sums<const PROVE: bool>(reader: &mut Reader<'_, PROVE>, layer: &Layer<'_>, range: Range, at: usize) -> (i32, i32) {
    // Two columns are two words, one for each pair of rows.
    let mut at = (reader.row & 2).wrapping_mul(2).wrapping_add(at);
    let mut left = if reader.row < layer.rows.into() { layer.cols } else { 0 };
    let (mut sum, mut magnitudes) = (0i32, 0i32);
    for _ in 0..layer.cols.div_ceil(16).wrapping_mul(8) {
        let mut lanes = word(layer.stream, at);
        at = at.wrapping_add(8);
        for _ in 0..2 {
            // The low byte is the `b` weight, sign-extended; what is left is 256 times the `a` weight.
            let [low, high, ..] = lanes.to_le_bytes();
            lanes >>= 16;
            let mut weight = i32::from(low.cast_signed());
            if reader.row.is_multiple_of(2) {
                weight = i32::from(i16::from_le_bytes([low, high])).wrapping_sub(weight) >> 8;
            }
            let magnitude = weight.wrapping_abs();
            let most = if left > 0 { 127 } else { 0 };
            if magnitude > most {
                reader.weight(most);
            }
            left = left.saturating_sub(1);
            sum = sum.wrapping_add(weight);
            magnitudes = magnitudes.wrapping_add(magnitude);
        }
    }
    let positive = magnitudes.wrapping_add(sum) >> 1;
    let negative = magnitudes.wrapping_sub(sum) >> 1;
    let end = |up: i32, down: i32| positive.wrapping_mul(up).wrapping_sub(negative.wrapping_mul(down));
    (end(range.hi, range.lo), end(range.lo, range.hi))
}

/// A number of a stream; 0 beyond its end, which the check of the shapes excludes.
#[inline(never)]
fn word(bytes: &[u8], at: usize) -> i32 {
    i32_at(bytes, at).unwrap_or_default()
}
