//! Checks the shapes of networks and decoders; the sums are proven in `prove.rs`.
#![deny(clippy::arithmetic_side_effects)]

use crate::interface::{ACTION_LEN, action_head};
use crate::kernels::block_len;
use crate::net::{
    DECODER_MODULATED, DECODER_TABLE, ENCODING_CATEGORICAL, ENCODING_SWITCH, ENCODING_TANH, ENCODING_TYPES, HEAD_LEN,
    LAYER_LEN, LINEAR_BITS, NET_HEAD, READS_Q_HIDDEN, SNAP_ANY,
};
use crate::reader::{Reader, short, word};
use crate::schema::{
    MAX_ATOMS, MAX_BETA_DEN, MAX_HEAD_ROWS, MAX_LATENTS, MAX_LAYERS, MAX_LAYERS_ON_TRUNK, MAX_WIDTH, Section,
    WeightKind, padded,
};
use crate::space::ActionHead;

/// Most fraction bits of logits.
pub(crate) const MAX_FRAC_BITS: u16 = 24;

/// The Q-network, whose outputs are the latents, or the confidence network, which has as many.
#[inline(never)]
pub(crate) fn check_net<const PROVE: bool>(reader: &mut Reader<'_, PROVE>, kind: WeightKind, section: Section) {
    reader.enter(section);
    let shared = section == Section::Confidence && reader.image.shared_trunk();
    let count = reader.u16(1, if shared { MAX_LAYERS_ON_TRUNK } else { MAX_LAYERS });
    frac_bits(reader, kind);
    if PROVE {
        // Positive.
        reader.number(f32::from_bits(1), f32::MAX);
    } else {
        reader.take(4);
    }
    let latents = usize::from(reader.image.spec.num_latents);
    let outputs = if section == Section::Q {
        reader.zeros(8);
        (1, MAX_LATENTS)
    } else {
        // Any two numbers give a set; an empty one is made up for.
        if PROVE {
            threshold(reader);
        } else {
            reader.take(8);
        }
        (latents, latents)
    };
    let mut inputs = (usize::from(reader.image.spec.obs_dim), 0);
    if shared {
        // Without a hidden layer there is no trunk: a width of 0 fits no record.
        inputs = (reader.image.trunk().map_or(0, |layer| layer.rows.into()), READS_Q_HIDDEN.into());
    }
    let rows = check_layers(reader, kind, count, inputs, outputs, 0);
    reader.image.spec.num_latents = short(rows);
    reader.swap();
    reader.end();
}

/// A fraction between 0 and 1.
fn threshold<const PROVE: bool>(reader: &mut Reader<'_, PROVE>) {
    let at = reader.at;
    reader.take(4);
    let den = reader.field(4, 2, MAX_BETA_DEN);
    reader.far = reader.at;
    reader.at = at;
    reader.field(4, 1, den.saturating_sub(1));
    reader.swap();
}

/// Fraction bits of logits; a float file has none.
fn frac_bits<const PROVE: bool>(reader: &mut Reader<'_, PROVE>, kind: WeightKind) {
    reader.u16(0, if kind == WeightKind::Int8 { MAX_FRAC_BITS.into() } else { 0 });
}

/// The records of `count` layers and their streams; `inputs` is the width and the code of what the first one reads. The
/// streams follow `between` bytes after the records. Leaves `at` after the records and `far` after the streams; returns the
/// rows of the last layer.
#[inline(never)]
fn check_layers<const PROVE: bool>(
    reader: &mut Reader<'_, PROVE>,
    kind: WeightKind,
    count: usize,
    inputs: (usize, usize),
    outputs: (usize, usize),
    between: usize,
) -> usize {
    let records_end = count.wrapping_mul(LAYER_LEN).wrapping_add(reader.at);
    reader.far = padded(records_end.wrapping_add(between), 16);
    let (mut width, mut reads) = inputs;
    let mut left = count;
    while left > 0 {
        left = left.wrapping_sub(1);
        let (min, max) = if left == 0 { outputs } else { (1, MAX_WIDTH) };
        let rows = reader.u16(min, max);
        reader.u16(width, width);
        if left == 0 || kind == WeightKind::Float32 {
            reader.u16(LINEAR_BITS.into(), LINEAR_BITS.into());
        } else if reader.u16(8, 10) == 9 {
            reader.at = reader.at.wrapping_sub(2);
            reader.u16(10, 10);
        }
        reader.u16(reads, reads);
        reads = 0;
        let len = match kind {
            // Between the records of a decoder and its streams are the heads.
            WeightKind::Int8 => {
                let modulated = between > 0 && left.wrapping_add(1) == count;
                rows.div_ceil(4).wrapping_mul(block_len(short(width), modulated))
            }
            WeightKind::Float32 => width.wrapping_add(1).wrapping_mul(rows).wrapping_mul(4),
        };
        reader.exactly(reader.far);
        reader.exactly(len);
        reader.swap();
        weights(reader, kind, len);
        if left > 0 {
            reader.image.hidden_width = reader.image.hidden_width.max(short(rows));
            reader.pad();
        }
        reader.swap();
        reader.image.spec.macs = reader.image.spec.macs.wrapping_add(word(rows.wrapping_mul(width)));
        width = rows;
    }
    width
}

/// A stream or a table, whose numbers must be finite in a float file.
fn weights<const PROVE: bool>(reader: &mut Reader<'_, PROVE>, kind: WeightKind, len: usize) {
    match kind {
        WeightKind::Int8 => _ = reader.take(len),
        WeightKind::Float32 => reader.numbers(len / 4),
    }
}

/// The decoder; returns the rows of its head layer.
pub(crate) fn check_decoder<const PROVE: bool>(reader: &mut Reader<'_, PROVE>, kind: WeightKind) -> usize {
    reader.enter(Section::Decoder);
    let actions = reader.image.actions();
    let latents = usize::from(reader.image.spec.num_latents);
    if reader.u16(DECODER_MODULATED.into(), DECODER_TABLE.into()) == usize::from(DECODER_TABLE) {
        if PROVE {
            reader.zeros(6);
        } else {
            // Or the step would find layers.
            reader.u16(0, 0);
            reader.take(4);
        }
        reader.exactly(reader.start.wrapping_add(NET_HEAD));
        reader.exactly(latents.wrapping_mul(actions.len()).wrapping_mul(4));
        if PROVE {
            for _ in 0..latents {
                for record in actions {
                    check_constant(reader, record);
                }
            }
        } else {
            reader.numbers(latents.wrapping_mul(actions.len()));
        }
        reader.end();
        return 0;
    }
    let count = reader.u16(2, MAX_LAYERS);
    frac_bits(reader, kind);
    let slots = actions.len();
    reader.u16(slots, slots);
    let table_at = reader.at;
    reader.take(8);
    let heads_len = slots.wrapping_mul(HEAD_LEN);
    let inputs = (usize::from(reader.image.spec.obs_dim), 0);
    let outputs = check_layers(reader, kind, count, inputs, (1, MAX_HEAD_ROWS), heads_len);
    let last = reader.at.wrapping_sub(LAYER_LEN);
    let rows = check_heads(reader, actions);
    reader.pad();
    if rows != outputs {
        reader.at = last;
        reader.u16(rows, rows);
    }
    // The table of the latents follows the streams.
    reader.swap();
    reader.pad();
    let first_rows = usize::from(reader.image.net(Section::Decoder).first_rows());
    let per_row = if kind == WeightKind::Int8 { padded(first_rows, 4) } else { first_rows };
    let len = latents.wrapping_mul(per_row).wrapping_mul(8);
    reader.far = reader.at;
    reader.at = table_at;
    reader.exactly(reader.far);
    reader.exactly(len);
    reader.swap();
    weights(reader, kind, len);
    reader.end();
    outputs
}

/// Head records against the action slots; returns the rows they take.
fn check_heads<const PROVE: bool>(reader: &mut Reader<'_, PROVE>, actions: &[[u8; ACTION_LEN]]) -> usize {
    let mut total = 0usize;
    for record in actions {
        let (low, high, count) = match action_head(record) {
            ActionHead::Continuous { .. } => (ENCODING_TANH, ENCODING_CATEGORICAL, 1),
            ActionHead::Discrete { n } => (ENCODING_TYPES, ENCODING_TYPES, n.into()),
            ActionHead::Binary => (ENCODING_SWITCH, ENCODING_SWITCH, 1),
        };
        let categorical = reader.field(1, low.into(), high.into()) == u32::from(ENCODING_CATEGORICAL);
        let (snap, min, max) = if categorical { (SNAP_ANY, 2, MAX_ATOMS) } else { (0, count, count) };
        reader.field(1, 0, snap.into());
        total = total.wrapping_add(reader.u16(min, max));
    }
    total
}

/// A value of a table decoder.
fn check_constant<const PROVE: bool>(reader: &mut Reader<'_, PROVE>, record: &[u8; ACTION_LEN]) {
    match action_head(record) {
        ActionHead::Continuous { .. } => _ = reader.number(-1.0, 1.0),
        ActionHead::Discrete { n } => reader.index(n.into()),
        ActionHead::Binary => reader.index(2),
    }
}
