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

    /// Largest magnitude of `start + scale * sum` for weights of these sums by sign. At most 1024 weights of 127 and
    /// inputs of 12 bits: 64 bits hold everything.
    fn reach(self, sums: Tally, scale: i64, start: i32) -> i64 {
        let magnitude = i64::from(sums.magnitude);
        let sum = i64::from(sums.sum);
        let (positive, negative) = (magnitude.wrapping_add(sum) >> 1, magnitude.wrapping_sub(sum) >> 1);
        let end = |up: i64, down: i64| {
            let total = positive.wrapping_mul(up).wrapping_sub(negative.wrapping_mul(down));
            total.wrapping_mul(scale).wrapping_add(i64::from(start)).wrapping_abs()
        };
        end(self.hi, self.lo).max(end(self.lo, self.hi))
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
            let reach = self.accumulators(first_row, block, sums)?;
            match modulation {
                None => {
                    let constants = block.get(weights_len.saturating_add(16)..).unwrap_or_default();
                    self.results(first_row, reach, constants)?;
                }
                Some(table) => {
                    let latent_len = usize::from(self.layer.rows).next_multiple_of(4).saturating_mul(8);
                    for latent in table.chunks(latent_len.max(1)) {
                        let at = usize::from(first_row).saturating_mul(8);
                        self.results(first_row, reach, latent.get(at..).unwrap_or_default())?;
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
    fn weights(&self, first_row: u16, weights: &[u8]) -> Result<[Tally; 4], LoadError> {
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
        let sums = [pair0.a, pair0.b, pair1.a, pair1.b];
        let mut row = first_row;
        for sums in sums {
            if row >= self.layer.rows && sums.magnitude != 0 {
                return Err(self.padding(row));
            }
            row = row.saturating_add(1);
        }
        Ok(sums)
    }

    /// Largest magnitudes of the values that go into `SMMLAR`: 256 A in `a` rows, B in `b` rows.
    fn accumulators(&self, first_row: u16, block: &[u8], sums: [Tally; 4]) -> Result<[i64; 4], LoadError> {
        let mut reach = [0; 4];
        let mut row = first_row;
        let mut at = 0usize;
        for (reach, sums) in reach.iter_mut().zip(sums) {
            // [raw0, b0, raw1, b1] with raw = 256 a + b.
            let word = i32_at(block, at).unwrap_or_default();
            let a_row = row.is_multiple_of(2);
            at = at.saturating_add(4);
            let start = if a_row { word.wrapping_sub(i32_at(block, at).unwrap_or_default()) } else { word };
            *reach = self.range.reach(sums, if a_row { 256 } else { 1 }, start);
            if *reach > ACC_LIMIT {
                return Err(self.bound(row, ACC_LIMIT, *reach));
            }
            if row >= self.layer.rows && start != 0 {
                return Err(self.padding(row));
            }
            row = row.saturating_add(1);
        }
        Ok(reach)
    }

    /// `SMMLAR` results of four rows with `[M x 4] [P x 4]`.
    fn results(&self, first_row: u16, reach: [i64; 4], constants: &[u8]) -> Result<(), LoadError> {
        let mut row = first_row;
        let mut at = 0usize;
        for reach in reach {
            let m = i64::from(i32_at(constants, at).unwrap_or_default());
            let p = i64::from(i32_at(constants, at.saturating_add(16)).unwrap_or_default());
            if row >= self.layer.rows && (m != 0 || p != 0) {
                return Err(self.padding(row));
            }
            // Both ends of the range, rounded outwards: |acc m| < 2^62.
            let product = reach.wrapping_mul(m.wrapping_abs()) >> 32;
            let found = product.wrapping_add(1).wrapping_add(p.wrapping_abs());
            if found > RESULT_LIMIT {
                return Err(self.bound(row, RESULT_LIMIT, found));
            }
            row = row.saturating_add(1);
            at = at.saturating_add(4);
        }
        Ok(())
    }

    fn bound(&self, row: u16, limit: i64, found: i64) -> LoadError {
        LoadError::Bound { section: self.section, layer: self.index, row, limit, found }
    }
}
