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

/// Weights of one row so far; at most 1024 of magnitude 128, so 32 bits hold every sum.
#[derive(Clone, Copy, Default)]
struct Tally {
    sum: i32,
    magnitude: i32,
}

impl Tally {
    #[inline(always)]
    fn add(&mut self, weight: i32) {
        self.sum = self.sum.wrapping_add(weight);
        self.magnitude = self.magnitude.wrapping_add(weight.wrapping_abs());
    }

    fn sums(self) -> Sums {
        let (sum, magnitude) = (i64::from(self.sum), i64::from(self.magnitude));
        Sums { positive: magnitude.saturating_add(sum) / 2, negative: magnitude.saturating_sub(sum) / 2 }
    }
}

/// The two rows of a pair.
#[derive(Clone, Copy, Default)]
struct PairTally {
    a: Tally,
    b: Tally,
    /// A weight was outside of -127..=127.
    outside: bool,
}

impl PairTally {
    #[inline(always)]
    fn add(&mut self, lane: i16) {
        // The low byte is the `b` weight, sign-extended; what is left is 256 times the `a` weight.
        let [low, _] = lane.to_le_bytes();
        let low = i32::from(low.cast_signed());
        let high = i32::from(lane).wrapping_sub(low) >> 8;
        self.outside |= low == -128 || high.wrapping_abs() == 128;
        self.a.add(high);
        self.b.add(low);
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
        let mut pairs = [PairTally::default(); 2];
        let [pair0, pair1] = &mut pairs;
        let used_words = usize::from(self.layer.cols).div_ceil(2);
        let words = weights.as_chunks::<8>().0;
        for &[a, b, c, d, e, f, g, h] in words.iter().take(used_words) {
            pair0.add(i16::from_le_bytes([a, b]));
            pair0.add(i16::from_le_bytes([c, d]));
            pair1.add(i16::from_le_bytes([e, f]));
            pair1.add(i16::from_le_bytes([g, h]));
        }
        // An odd number of columns leaves the second lane of the last words unused.
        let odd_lanes = match words.get(used_words.saturating_sub(1)) {
            Some(&[_, _, c, d, _, _, g, h]) if self.layer.cols % 2 == 1 => [c, d, g, h],
            _ => [0; 4],
        };
        if odd_lanes != [0; 4] || words.iter().skip(used_words).any(|word| *word != [0; 8]) {
            return Err(self.padding(first_row));
        }
        let second = first_row.saturating_add(2);
        for (pair, row) in [(*pair0, first_row), (*pair1, second)] {
            if pair.outside {
                return Err(LoadError::Weight { section: self.section, layer: self.index, row });
            }
        }
        let sums = [pair0.a.sums(), pair0.b.sums(), pair1.a.sums(), pair1.b.sums()];
        for (sums, row) in sums.iter().zip(first_row..first_row.saturating_add(4)) {
            if row >= self.layer.rows && (sums.positive != 0 || sums.negative != 0) {
                return Err(self.padding(row));
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
