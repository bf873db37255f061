//! From a loaded policy back to owned data, so that a file can be written again with other provenance or vectors.

use super::int_model::{IntDecoder, IntLayer, IntNet, QuantiseReport, QuantisedModel};
use super::model::{
    ActionSlot, Dense, FloatDecoder, FloatModel, HeadEncoding, Interface, ObservationSlot, ProvenanceOwned, Snap,
};
use crate::fields::i32_at;
use crate::image::Image;
use crate::net::{ENCODING_CATEGORICAL, ENCODING_SWITCH, ENCODING_TANH, HEAD_LEN, Layer, Net, SNAP_ANY, SNAP_EDGES};
use crate::quant::HIDDEN_SHIFT;
use crate::{Policy, Section};
use std::vec;
use std::vec::Vec;

impl QuantisedModel {
    /// What a loaded policy holds; writing it with the same vectors and options gives the same bytes.
    #[must_use]
    pub fn read(policy: &Policy<'_>) -> Self {
        let image = policy.image();
        let Net { table, heads, .. } = image.net(Section::Decoder);
        let mut net = read_net(image, Section::Decoder);
        let decoder = if let Some(first) = net.layers.first_mut() {
            first.constants = read_table(table, first.rows);
            IntDecoder::Modulated(net)
        } else {
            let values: Vec<f32> = table.as_chunks().0.iter().map(|&value| f32::from_le_bytes(value)).collect();
            let slots = usize::from(policy.spec().action_dim);
            IntDecoder::Table(values.chunks(slots).map(<[f32]>::to_vec).collect())
        };
        Self {
            interface: read_interface(policy),
            input: policy.input_quantisers().map(|quantiser| (quantiser.offset, quantiser.scale)).collect(),
            input_bits: image.input().0,
            q: read_net(image, Section::Q),
            confidence: policy.mask_threshold().map(|threshold| (read_net(image, Section::Confidence), threshold)),
            shared_trunk: policy.shared_trunk(),
            decoder,
            heads: heads.iter().map(|&record| read_head(record)).collect(),
            provenance: policy.provenance().into(),
            report: QuantiseReport::default(),
        }
    }
}

impl QuantisedModel {
    /// The float model whose weights are those of the integers: what a policy computes, less the rounding of inputs and
    /// activations and the clamping of activations from above. Hidden layers count in steps of their activations.
    #[must_use]
    pub fn dequantised(&self) -> FloatModel {
        let chain = |net: &IntNet, logit: f64, modulated: bool| -> Vec<Dense> {
            let last = net.layers.len().saturating_sub(1);
            let unit = |index| match index {
                0 if modulated => Unit::Sum,
                index if index == last => Unit::Logit(logit),
                _ => Unit::Activation,
            };
            net.layers.iter().enumerate().map(|(index, layer)| real_layer(layer, unit(index))).collect()
        };
        let log2 = |net: &IntNet| std::f64::consts::LN_2 / f64::from(1u32 << net.frac_bits);
        let decoder = match &self.decoder {
            IntDecoder::Table(actions) => FloatDecoder::Table { actions: actions.clone() },
            IntDecoder::Modulated(net) => {
                let mut layers = chain(net, log2(net), true);
                let (head, state) = (layers.pop().unwrap_or_default(), layers.remove(0));
                let tables = net.layers.first().map_or(&[][..], |layer| &layer.constants);
                let table = |of: fn((i32, i32)) -> f64| -> Vec<Vec<f32>> {
                    tables.iter().map(|rows| rows.iter().map(|&row| of(row) as f32).collect()).collect()
                };
                let (scale, shift) = (table(|(m, _)| f64::from(m) / HIDDEN_UNIT), table(|(_, p)| hidden_offset(p)));
                FloatDecoder::Modulated { state, scale, shift, hidden: layers, head }
            }
        };
        let threshold =
            self.confidence.as_ref().map_or((1, self.q.layers.last().map_or(1, |l| l.rows) as u32), |c| c.1);
        FloatModel {
            interface: self.interface.clone(),
            obs_mean: self.input.iter().map(|(offset, _)| *offset).collect(),
            obs_std: self.input.iter().map(|(_, scale)| 1.0 / scale).collect(),
            q: chain(&self.q, f64::from(self.q.scale), false),
            confidence: self.confidence.as_ref().map(|(net, _)| chain(net, log2(net), false)),
            shared_trunk: self.shared_trunk,
            beta: threshold.0 as f32 / threshold.1 as f32,
            decoder,
            heads: self.heads.clone(),
            provenance: self.provenance.clone(),
        }
    }
}

/// `SMMLAR` and the shift of a hidden layer divide by this.
const HIDDEN_UNIT: f64 = 4_294_967_296.0 * (1u32 << HIDDEN_SHIFT) as f64;

/// Offset of a hidden layer in steps of its outputs; P holds the half step that makes the shift round.
fn hidden_offset(p: i32) -> f64 {
    f64::from(p) / f64::from(1u32 << HIDDEN_SHIFT) - 0.5
}

/// What the outputs of a dequantised layer count.
#[derive(Clone, Copy)]
enum Unit {
    /// Sums of integers: a modulated layer, whose constants are scale and shift.
    Sum,
    /// Steps of the activations.
    Activation,
    /// Logits, with the value of one integer.
    Logit(f64),
}

/// A layer on the integers of the one before.
fn real_layer(layer: &IntLayer, unit: Unit) -> Dense {
    let (mut weight, mut bias) = (vec![], vec![]);
    for (row, weights) in layer.weights.chunks_exact(layer.cols).enumerate() {
        let (m, p) = layer.constants.first().map_or((0, 0), |rows| rows[row]);
        let (scale, offset) = match unit {
            Unit::Sum => (1.0, 0.0),
            Unit::Activation => (f64::from(m) / HIDDEN_UNIT, hidden_offset(p)),
            Unit::Logit(value) => (f64::from(m) / 4_294_967_296.0 * value, f64::from(p) * value),
        };
        // Sums of an `a` row come as 256 A.
        let lift = if row % 2 == 0 { 256.0 } else { 1.0 };
        weight.extend(weights.iter().map(|&w| (f64::from(w) * lift * scale) as f32));
        bias.push((f64::from(layer.start[row]) * scale + offset) as f32);
    }
    Dense { rows: layer.rows, cols: layer.cols, weight, bias }
}

impl From<crate::Provenance<'_>> for ProvenanceOwned {
    fn from(provenance: crate::Provenance<'_>) -> Self {
        Self {
            environment: provenance.environment.into(),
            algorithm: provenance.algorithm.into(),
            config_hash: provenance.config_hash.into(),
            commit: provenance.commit.into(),
            train_seed: provenance.train_seed,
            eval_seed: provenance.eval_seed,
            env_steps: provenance.env_steps,
            float_return: provenance.float_return,
            device_return: provenance.device_return,
        }
    }
}

fn read_interface(policy: &Policy<'_>) -> Interface {
    Interface {
        observations: policy
            .observation_signals()
            .map(|signal| ObservationSlot {
                name: signal.name.into(),
                unit: signal.unit.into(),
                lo: signal.lo,
                hi: signal.hi,
            })
            .collect(),
        actions: policy
            .action_signals()
            .map(|signal| ActionSlot {
                name: signal.name.into(),
                unit: signal.unit.into(),
                head: signal.head,
                safe: signal.safe,
            })
            .collect(),
        control_period_us: policy.spec().control_period_us,
    }
}

fn read_head([kind, snap, low, high]: [u8; HEAD_LEN]) -> HeadEncoding {
    match kind {
        ENCODING_TANH => HeadEncoding::Tanh,
        ENCODING_CATEGORICAL => HeadEncoding::Categorical {
            atoms: usize::from(u16::from_le_bytes([low, high])),
            snap: match snap {
                SNAP_EDGES => Snap::Edges,
                SNAP_ANY => Snap::Any,
                _ => Snap::None,
            },
        },
        ENCODING_SWITCH => HeadEncoding::Switch,
        _ => HeadEncoding::Types,
    }
}

fn read_net(image: &Image<'_>, section: Section) -> IntNet {
    let decoder = section == Section::Decoder;
    let layers = image.net(section).layers().enumerate();
    IntNet {
        layers: layers.map(|(index, layer)| read_layer(&layer, decoder && index == 0)).collect(),
        frac_bits: image.net(section).frac_bits as u16,
        scale: if decoder { 1.0 } else { image.logit_scale(section) },
    }
}

/// Unpacks the stream of a layer.
fn read_layer(layer: &Layer<'_>, modulated: bool) -> IntLayer {
    let (rows, cols) = (usize::from(layer.rows), usize::from(layer.cols));
    let padded = cols.next_multiple_of(16);
    let mut out = IntLayer {
        rows,
        cols,
        bits: layer.bits,
        weights: vec![0; rows * cols],
        start: vec![0; rows],
        constants: vec![],
    };
    let mut constants = vec![];
    for (block, bytes) in layer.stream.chunks_exact(crate::kernels::block_len(layer.cols, modulated)).enumerate() {
        let start = |word: usize| i32_at(bytes, word * 4).unwrap_or_default();
        let lane = |pair: usize, col: usize| {
            let at = 16 + (col / 2 * 2 + pair) * 4 + col % 2 * 2;
            i16::from_le_bytes([bytes[at], bytes[at + 1]])
        };
        for offset in 0..(rows - block * 4).min(4) {
            let (row, pair) = (block * 4 + offset, offset / 2);
            let (raw, b) = (start(pair * 2), start(pair * 2 + 1));
            out.start[row] = if offset % 2 == 0 { raw.wrapping_sub(b) } else { b };
            for col in 0..cols {
                let lane = lane(pair, col);
                let low = lane as i8;
                out.weights[row * cols + col] =
                    if offset % 2 == 0 { ((lane - i16::from(low)) / 256) as i8 } else { low };
            }
            if !modulated {
                constants.push(read_constant(&bytes[16 + padded * 4..], offset));
            }
        }
    }
    if !modulated {
        out.constants.push(constants);
    }
    out
}

fn read_constant(bytes: &[u8], row: usize) -> (i32, i32) {
    (i32_at(bytes, row * 4).unwrap_or_default(), i32_at(bytes, row * 4 + 16).unwrap_or_default())
}

/// Multipliers and offsets per latent.
fn read_table(table: &[u8], rows: usize) -> Vec<Vec<(i32, i32)>> {
    let latent = |bytes: &[u8]| (0..rows).map(|row| read_constant(&bytes[row / 4 * 32..], row % 4)).collect();
    table.chunks_exact(rows.next_multiple_of(4) * 8).map(latent).collect()
}
