//! The quantised model with owned data, and its packed form.

use super::model::{HeadEncoding, Interface, ProvenanceOwned};
use std::vec::Vec;

/// One int8 layer. Rows are in file order: even rows are `a` rows, odd rows `b` rows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct IntLayer {
    pub(crate) rows: usize,
    pub(crate) cols: usize,
    /// 8 or 10 after a ReLU, 32 for logits.
    pub(crate) bits: u16,
    /// Row-major, in -127..=127.
    pub(crate) weights: Vec<i8>,
    /// Start values of the value that goes into `SMMLAR`: 256 A in even rows, B in odd rows.
    pub(crate) start: Vec<i32>,
    /// Multiplier and offset per row; one list per latent in a modulated layer.
    pub(crate) constants: Vec<Vec<(i32, i32)>>,
}

/// One int8 network.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct IntNet {
    pub(crate) layers: Vec<IntLayer>,
    pub(crate) frac_bits: u16,
    pub(crate) scale: f32,
}

/// The decoder of a quantised model.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum IntDecoder {
    Modulated(IntNet),
    Table(Vec<Vec<f32>>),
}

/// How well one layer fits its integers.
#[derive(Clone, Debug, PartialEq)]
pub struct LayerReport {
    /// `q.0`, `confidence.1`, `decoder.head`, ...
    pub layer: std::string::String,
    /// Bits of its outputs: 8 or 10, 32 for logits.
    pub out_bits: u16,
    /// Rows whose weights were made smaller to keep the bound of an accumulator.
    pub shrunk_rows: usize,
    /// Share of calibration outputs above the largest activation.
    pub saturated: f64,
    /// Row `i` of the file is row `order[i]` of the float model: hidden rows are paired to suit the bounds of the sums.
    pub order: Vec<usize>,
}

/// What quantisation found out.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct QuantiseReport {
    /// Bits of a quantised observation.
    pub input_bits: u16,
    /// Share of the calibration values of each observation that the input quantiser clamps.
    pub clipped_inputs: Vec<f64>,
    /// One entry per layer.
    pub layers: Vec<LayerReport>,
}

/// A quantised model, ready for [`write_int8`](super::write_int8).
#[derive(Clone, Debug, PartialEq)]
pub struct QuantisedModel {
    pub(crate) interface: Interface,
    /// Offset and scale per observation.
    pub(crate) input: Vec<(f32, f32)>,
    pub(crate) input_bits: u16,
    pub(crate) q: IntNet,
    /// Network and threshold.
    pub(crate) confidence: Option<(IntNet, (u32, u32))>,
    /// The confidence network reads the Q-network's last hidden layer.
    pub(crate) shared_trunk: bool,
    pub(crate) decoder: IntDecoder,
    pub(crate) heads: Vec<HeadEncoding>,
    /// Where the model comes from; returns measured after quantisation may be put in before writing.
    pub provenance: ProvenanceOwned,
    /// What quantisation found out; empty for a model that was read from a file.
    pub report: QuantiseReport,
}

impl QuantisedModel {
    /// What it sees and drives, with finite bounds.
    #[must_use]
    pub fn interface(&self) -> &Interface {
        &self.interface
    }
}

impl IntLayer {
    /// The stream of the layer, and the per-latent table of a modulated layer (empty otherwise).
    pub(crate) fn pack(&self, modulated: bool) -> (Vec<u8>, Vec<u8>) {
        let mut stream = Vec::new();
        let cols = self.cols.next_multiple_of(16);
        let weight = |row: usize, col: usize| {
            let inside = row < self.rows && col < self.cols;
            if inside { i16::from(self.weights[row * self.cols + col]) } else { 0 }
        };
        let start = |row: usize| self.start.get(row).copied().unwrap_or(0);
        for block in (0..self.rows).step_by(4) {
            for pair in [block, block + 2] {
                let (a, b) = (start(pair), start(pair + 1));
                stream.extend(a.wrapping_add(b).to_le_bytes());
                stream.extend(b.to_le_bytes());
            }
            for col in (0..cols).step_by(2) {
                for pair in [block, block + 2] {
                    for col in [col, col + 1] {
                        let lane = weight(pair, col) * 256 + weight(pair + 1, col);
                        stream.extend(lane.to_le_bytes());
                    }
                }
            }
            if !modulated {
                pack_constants(&mut stream, &self.constants[0], block);
            }
        }
        let mut table = Vec::new();
        if modulated {
            for constants in &self.constants {
                for block in (0..self.rows).step_by(4) {
                    pack_constants(&mut table, constants, block);
                }
            }
        }
        (stream, table)
    }
}

/// `[M x 4] [P x 4]` of a block.
fn pack_constants(out: &mut Vec<u8>, constants: &[(i32, i32)], block: usize) {
    let of = |row: usize| constants.get(row).copied().unwrap_or_default();
    out.extend((block..block + 4).flat_map(|row| of(row).0.to_le_bytes()));
    out.extend((block..block + 4).flat_map(|row| of(row).1.to_le_bytes()));
}
