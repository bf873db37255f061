//! Proves from the actual weights that no sum of an int8 layer leaves its range, whatever the observation.
//!
//! For a row with weights w, inputs in `lo..=hi` and start value c, the accumulator lies in
//! `c + sum(min(w lo, w hi)) ..= c + sum(max(w lo, w hi))`. Two limits must hold: an accumulator (times 256 for an `a`
//! row) fits 32 bits, so that the wrapping sums of the kernels are exact; and the `SMMLAR` result stays below 2^30, so
//! that it does not wrap and differences of logits fit 32 bits.
#![deny(clippy::arithmetic_side_effects)]

use crate::error::LoadError;
use crate::fields::i32_at;
use crate::kernels::block_len;
use crate::net::{Decoder, LINEAR_BITS, Layer, Net};
use crate::part::Part;
use crate::quant::input_max;
use crate::schema::Section;

/// Largest magnitude of an accumulator; times 256 in an `a` row.
pub(crate) const ACC_LIMIT: i64 = (1 << 31) - 1;
/// Largest magnitude of an `SMMLAR` result.
pub(crate) const RESULT_LIMIT: i64 = (1 << 30) - 1;

/// Range of a layer's inputs.
#[derive(Clone, Copy)]
pub(crate) struct Range {
    pub(crate) lo: i64,
    pub(crate) hi: i64,
}

impl Range {
    /// Quantised observations.
    pub(crate) fn input(bits: u16) -> Self {
        let hi = i64::from(input_max(bits));
        Self { lo: hi.saturating_neg().saturating_sub(1), hi }
    }

    /// Activations of `bits` bits.
    pub(crate) fn activation(bits: u16) -> Self {
        Self { lo: 0, hi: 1i64.wrapping_shl(u32::from(bits)).saturating_sub(1) }
    }

    /// Range after multiplication with weights of these sums of positive and of negative parts.
    fn times(self, positive: i64, negative: i64) -> Self {
        let lo = positive.saturating_mul(self.lo).saturating_sub(negative.saturating_mul(self.hi));
        let hi = positive.saturating_mul(self.hi).saturating_sub(negative.saturating_mul(self.lo));
        Self { lo, hi }
    }

    fn shifted(self, by: i64) -> Self {
        Self { lo: self.lo.saturating_add(by), hi: self.hi.saturating_add(by) }
    }

    fn scaled(self, by: i64) -> Self {
        Self { lo: self.lo.saturating_mul(by), hi: self.hi.saturating_mul(by) }
    }

    fn magnitude(self) -> i64 {
        self.lo.saturating_abs().max(self.hi.saturating_abs())
    }
}

/// All layers of a network.
pub(crate) fn prove_net(part: &Part<'_>, net: &Net<'_>, input_bits: u16) -> Result<(), LoadError> {
    prove_layers(part.section, net, None, input_bits)
}

/// All layers of a decoder, for every latent.
pub(crate) fn prove_decoder(part: &Part<'_>, decoder: &Decoder<'_>, input_bits: u16) -> Result<(), LoadError> {
    match decoder {
        Decoder::Modulated { net, modulation, .. } => prove_layers(part.section, net, Some(modulation), input_bits),
        Decoder::Table { .. } => Ok(()),
    }
}

fn prove_layers(section: Section, net: &Net<'_>, modulation: Option<&[u8]>, input_bits: u16) -> Result<(), LoadError> {
    let mut range = Range::input(input_bits);
    let mut modulation = modulation;
    for (index, layer) in (0u16..).zip(net.layers()) {
        Proof { section, index, layer, range }.run(modulation.take())?;
        range = Range::activation(if layer.bits == LINEAR_BITS { 0 } else { layer.bits });
    }
    Ok(())
}

struct Proof<'a> {
    section: Section,
    index: u16,
    layer: &'a Layer<'a>,
    range: Range,
}

/// Sums of the weights of one row, by sign.
#[derive(Clone, Copy, Default)]
struct Sums {
    positive: i64,
    negative: i64,
}

impl Sums {
    fn add(&mut self, weight: i64) {
        if weight > 0 {
            self.positive = self.positive.saturating_add(weight);
        } else {
            self.negative = self.negative.saturating_sub(weight);
        }
    }
}

impl Proof<'_> {
    fn run(&self, modulation: Option<&[u8]>) -> Result<(), LoadError> {
        let len = block_len(self.layer.cols, modulation.is_some());
        let weights_len = usize::from(self.layer.cols).next_multiple_of(16).saturating_mul(4);
        let mut stream = self.layer.stream;
        let mut first_row = 0u16;
        while first_row < self.layer.rows {
            let Some((block, rest)) = stream.split_at_checked(len) else { break };
            stream = rest;
            let weights = block.get(16..).and_then(|rest| rest.get(..weights_len)).unwrap_or_default();
            let sums = self.weights(first_row, weights)?;
            let accs = self.accumulators(first_row, block, sums)?;
            match modulation {
                None => {
                    let constants = block.get(weights_len.saturating_add(16)..).unwrap_or_default();
                    self.results(first_row, accs, constants)?;
                }
                Some(table) => {
                    let latent_len = usize::from(self.layer.rows).next_multiple_of(4).saturating_mul(8);
                    for latent in table.chunks(latent_len.max(1)) {
                        let at = usize::from(first_row).saturating_mul(8);
                        self.results(first_row, accs, latent.get(at..).unwrap_or_default())?;
                    }
                }
            }
            first_row = first_row.saturating_add(4);
        }
        Ok(())
    }

    fn padding(&self, row: u16) -> LoadError {
        LoadError::PaddedWeight { section: self.section, layer: self.index, row }
    }

    /// Weights in range, padding zero; sums of the four rows.
    fn weights(&self, first_row: u16, weights: &[u8]) -> Result<[Sums; 4], LoadError> {
        let mut sums = [Sums::default(); 4];
        let [row0, row1, row2, row3] = &mut sums;
        for (pair_of_columns, words) in (0u16..).zip(weights.as_chunks::<8>().0) {
            let column = pair_of_columns.saturating_mul(2);
            let &[a, b, c, d, e, f, g, h] = words;
            let lanes = [([a, b], 0), ([c, d], 1), ([e, f], 0), ([g, h], 1)];
            for (pair, (lane, odd)) in [0u16, 0, 1, 1].into_iter().zip(lanes) {
                let lane = i64::from(i16::from_le_bytes(lane));
                // The low byte is the `b` weight, sign-extended; what is left is 256 times the `a` weight.
                let low = lane.saturating_add(128).rem_euclid(256).saturating_sub(128);
                let high = lane.saturating_sub(low).div_euclid(256);
                let row = first_row.saturating_add(pair.saturating_mul(2));
                if !(-127..=127).contains(&low) || !(-127..=127).contains(&high) {
                    return Err(LoadError::Weight { section: self.section, layer: self.index, row });
                }
                let padded_column = column.saturating_add(odd) >= self.layer.cols;
                if (high != 0 && (padded_column || row >= self.layer.rows))
                    || (low != 0 && (padded_column || row.saturating_add(1) >= self.layer.rows))
                {
                    return Err(self.padding(row));
                }
                if pair == 0 {
                    row0.add(high);
                    row1.add(low);
                } else {
                    row2.add(high);
                    row3.add(low);
                }
            }
        }
        Ok(sums)
    }

    /// Ranges of the values that go into `SMMLAR`: 256 A in `a` rows, B in `b` rows.
    fn accumulators(&self, first_row: u16, block: &[u8], sums: [Sums; 4]) -> Result<[Range; 4], LoadError> {
        let start = |word: usize| i32_at(block, word.saturating_mul(4)).unwrap_or_default();
        let (raw0, b0, raw1, b1) = (start(0), start(1), start(2), start(3));
        let starts = [raw0.wrapping_sub(b0), b0, raw1.wrapping_sub(b1), b1];
        let mut ranges = [self.range; 4];
        let rows = first_row..first_row.saturating_add(4);
        for ((((range, sums), start), scale), row) in
            ranges.iter_mut().zip(sums).zip(starts).zip([256, 1, 256, 1]).zip(rows)
        {
            *range = self.range.times(sums.positive, sums.negative).scaled(scale).shifted(i64::from(start));
            let found = range.magnitude();
            if found > ACC_LIMIT {
                return Err(self.bound(row, ACC_LIMIT, found));
            }
            if row >= self.layer.rows && start != 0 {
                return Err(self.padding(row));
            }
        }
        Ok(ranges)
    }

    /// `SMMLAR` results of four rows with `[M x 4] [P x 4]`.
    fn results(&self, first_row: u16, accs: [Range; 4], constants: &[u8]) -> Result<(), LoadError> {
        for ((acc, index), row) in accs.into_iter().zip(0usize..).zip(first_row..first_row.saturating_add(4)) {
            let at = index.saturating_mul(4);
            let m = i64::from(i32_at(constants, at).unwrap_or_default());
            let p = i64::from(i32_at(constants, at.saturating_add(16)).unwrap_or_default());
            if row >= self.layer.rows && (m != 0 || p != 0) {
                return Err(self.padding(row));
            }
            // Both ends of the range, rounded outwards: |acc m| < 2^62.
            let product = acc.magnitude().saturating_mul(m.saturating_abs()).checked_shr(32).unwrap_or(0);
            let found = product.saturating_add(1).saturating_add(p.saturating_abs());
            if found > RESULT_LIMIT {
                return Err(self.bound(row, RESULT_LIMIT, found));
            }
        }
        Ok(())
    }

    fn bound(&self, row: u16, limit: i64, found: i64) -> LoadError {
        LoadError::Bound { section: self.section, layer: self.index, row, limit, found }
    }
}
