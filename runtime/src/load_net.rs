//! Checks the shapes of networks and decoders; the sums are proven in `prove.rs`.
#![deny(clippy::arithmetic_side_effects)]

use crate::error::LoadError;
use crate::fields::f32_at;
use crate::interface::{ACTION_LEN, action_head};
use crate::kernels::block_len;
use crate::load::{Image, is_index, limit};
use crate::net::{
    DECODER_MODULATED, DECODER_TABLE, Decoder, ENCODING_CATEGORICAL, ENCODING_SWITCH, ENCODING_TANH, ENCODING_TYPES,
    HEAD_LEN, LAYER_LEN, LINEAR_BITS, Layer, NET_HEAD, Net, SNAP_ANY, SNAP_NONE,
};
use crate::part::Part;
use crate::prove::{prove_decoder, prove_net};
use crate::schema::{MAX_ATOMS, MAX_BETA_DEN, MAX_HEAD_ROWS, MAX_LATENTS, MAX_LAYERS, MAX_WIDTH, WeightKind};
use crate::space::ActionHead;

/// Most fraction bits of logits.
pub(crate) const MAX_FRAC_BITS: u16 = 24;

/// The threshold of a mask, as a fraction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Threshold {
    pub(crate) num: u32,
    pub(crate) den: u32,
}

/// The networks of a file.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Nets<'a> {
    pub(crate) q: Net<'a>,
    pub(crate) confidence: Option<(Net<'a>, Threshold)>,
    pub(crate) decoder: Decoder<'a>,
}

impl<'a> Nets<'a> {
    pub(crate) fn load(image: &Image<'a>) -> Result<Self, LoadError> {
        let kind = image.header.weights;
        let obs_dim = limit(image.interface.observations.len());
        let (q, _) = check_net(&image.q, kind, obs_dim, None)?;
        let latents = q.outputs();
        let confidence = if image.confidence.bytes.is_empty() {
            None
        } else {
            let (net, threshold) = check_net(&image.confidence, kind, obs_dim, Some(latents))?;
            Some((net, threshold))
        };
        let decoder = check_decoder(&image.decoder, kind, obs_dim, latents, image.interface.actions)?;
        if kind == WeightKind::Int8 {
            prove_net(&image.q, &q, image.input_bits)?;
            if let Some((net, _)) = &confidence {
                prove_net(&image.confidence, net, image.input_bits)?;
            }
            prove_decoder(&image.decoder, &decoder, image.input_bits)?;
        }
        let nets = Self { q, confidence, decoder };
        let words = u32::try_from(nets.scratch_words(usize::from(obs_dim), kind)).unwrap_or(u32::MAX);
        let found = image.header.scratch_words;
        if found == words {
            Ok(nets)
        } else {
            let section = crate::schema::Section::Header;
            Err(LoadError::Field { section, offset: 36, min: words, max: words, found })
        }
    }

    /// Words of scratch memory of a step.
    pub(crate) fn scratch_words(&self, obs_dim: usize, kind: WeightKind) -> usize {
        let head_rows = match &self.decoder {
            Decoder::Modulated { net, .. } => usize::from(net.outputs()),
            Decoder::Table { .. } => 0,
        };
        let hidden = self.hidden_width();
        let latents = usize::from(self.q.outputs());
        match kind {
            WeightKind::Int8 => {
                crate::scratch::scratch_words(obs_dim, hidden, latents, self.confidence.is_some(), head_rows)
            }
            WeightKind::Float32 => {
                crate::scratch::scratch_words_float(obs_dim, hidden, latents, self.confidence.is_some(), head_rows)
            }
        }
    }

    /// Widest hidden layer of all networks.
    pub(crate) fn hidden_width(&self) -> usize {
        let confidence = self.confidence.as_ref().map_or(0, |(net, _)| net.hidden_width());
        let decoder = match &self.decoder {
            Decoder::Modulated { net, .. } => net.hidden_width(),
            Decoder::Table { .. } => 0,
        };
        self.q.hidden_width().max(confidence).max(decoder)
    }

    pub(crate) fn macs(&self) -> u32 {
        let confidence = self.confidence.as_ref().map_or(0, |(net, _)| net.macs());
        self.q.macs().wrapping_add(confidence).wrapping_add(self.decoder.macs())
    }
}

/// Shapes of the layers from `at` on; returns the cursor after the records.
struct Chain<'a> {
    net: Net<'a>,
    records_end: usize,
}

/// Rows, columns and widths of `count` layer records; streams are placed by the caller.
fn check_records<'a>(
    part: &Part<'a>,
    kind: WeightKind,
    count: u16,
    inputs: u16,
    outputs: (u16, u16),
) -> Result<Chain<'a>, LoadError> {
    let mut net = Net { count: usize::from(count), ..Net::default() };
    let mut width = inputs;
    let mut at = NET_HEAD;
    let last = usize::from(count).saturating_sub(1);
    for (index, slot) in net.slots.iter_mut().take(net.count).enumerate() {
        let (min, max) = if index == last { outputs } else { (1, limit(MAX_WIDTH)) };
        let rows = part.u16(at, min, max)?;
        let cols = part.u16(at.saturating_add(2), width, width)?;
        let bits_at = at.saturating_add(4);
        let bits = if index == last || kind == WeightKind::Float32 {
            part.u16(bits_at, LINEAR_BITS, LINEAR_BITS)?
        } else if part.u16(bits_at, 8, 10)? == 9 {
            part.u16(bits_at, 10, 10)?
        } else {
            part.u16(bits_at, 8, 10)?
        };
        part.zeros(at.saturating_add(6), 2)?;
        *slot = Layer { rows, cols, bits, stream: &[] };
        width = rows;
        at = at.saturating_add(LAYER_LEN);
    }
    Ok(Chain { net, records_end: at })
}

/// Bytes of a layer's stream.
fn stream_len(layer: &Layer<'_>, kind: WeightKind, modulated: bool) -> usize {
    let (rows, cols) = (usize::from(layer.rows), usize::from(layer.cols));
    match kind {
        WeightKind::Int8 => rows.div_ceil(4).saturating_mul(block_len(layer.cols, modulated)),
        WeightKind::Float32 => rows.saturating_mul(cols).saturating_add(rows).saturating_mul(4),
    }
}

/// Places the streams of all layers after `cursor`; returns the cursor after them.
fn place_streams<'a>(
    part: &Part<'a>,
    kind: WeightKind,
    net: &mut Net<'a>,
    modulated: bool,
    cursor: usize,
) -> Result<usize, LoadError> {
    let mut cursor = cursor;
    for (index, slot) in net.slots.iter_mut().take(net.count).enumerate() {
        let at = index.saturating_mul(LAYER_LEN).saturating_add(NET_HEAD).saturating_add(8);
        let len = stream_len(slot, kind, modulated && index == 0);
        let (stream, next) = part.placed(at, cursor, len)?;
        slot.stream = stream;
        if kind == WeightKind::Float32 {
            all_finite(part, next.saturating_sub(len), len)?;
        }
        cursor = next;
    }
    Ok(cursor)
}

fn all_finite(part: &Part<'_>, at: usize, len: usize) -> Result<(), LoadError> {
    for index in 0..len / 4 {
        part.number(index.saturating_mul(4).saturating_add(at), |_| true)?;
    }
    Ok(())
}

/// Fraction bits of logits; a float file has none.
fn frac_bits(part: &Part<'_>, at: usize, kind: WeightKind) -> Result<u32, LoadError> {
    let max = if kind == WeightKind::Int8 { MAX_FRAC_BITS } else { 0 };
    part.u16(at, 0, max).map(u32::from)
}

/// A Q-network (`latents` unknown) or a confidence network.
fn check_net<'a>(
    part: &Part<'a>,
    kind: WeightKind,
    obs_dim: u16,
    latents: Option<u16>,
) -> Result<(Net<'a>, Threshold), LoadError> {
    let count = part.u16(0, 1, limit(MAX_LAYERS))?;
    let frac = frac_bits(part, 2, kind)?;
    let scale = part.number(4, |scale| scale > 0.0)?;
    let threshold = if latents.is_some() {
        let den = part.u32(12, 2, MAX_BETA_DEN)?;
        Threshold { num: part.u32(8, 1, den.saturating_sub(1))?, den }
    } else {
        part.zeros(8, 8)?;
        Threshold { num: 0, den: 1 }
    };
    let outputs = latents.map_or((1, limit(MAX_LATENTS)), |latents| (latents, latents));
    let Chain { mut net, records_end } = check_records(part, kind, count, obs_dim, outputs)?;
    net.frac_bits = frac;
    net.scale = scale;
    let end = place_streams(part, kind, &mut net, false, records_end)?;
    part.exactly(end)?;
    Ok((net, threshold))
}

fn check_decoder<'a>(
    part: &Part<'a>,
    kind: WeightKind,
    obs_dim: u16,
    latents: u16,
    actions: &[[u8; ACTION_LEN]],
) -> Result<Decoder<'a>, LoadError> {
    let latents = usize::from(latents);
    if part.u16(0, DECODER_MODULATED, DECODER_TABLE)? == DECODER_TABLE {
        part.zeros(2, 6)?;
        let (table, end) = part.placed(8, NET_HEAD, latents.saturating_mul(actions.len()).saturating_mul(4))?;
        part.exactly(end)?;
        check_constants(part, end.saturating_sub(table.len()), latents, actions)?;
        return Ok(Decoder::Table { actions: table });
    }
    let count = part.u16(2, 2, limit(MAX_LAYERS))?;
    let frac = frac_bits(part, 4, kind)?;
    let slots = limit(actions.len());
    part.u16(6, slots, slots)?;
    let Chain { mut net, records_end } = check_records(part, kind, count, obs_dim, (1, limit(MAX_HEAD_ROWS)))?;
    net.frac_bits = frac;
    net.scale = 1.0;
    let heads_len = actions.len().saturating_mul(HEAD_LEN);
    let heads = part.slice(records_end, heads_len)?.as_chunks().0;
    let rows = check_heads(part, records_end, actions)?;
    if rows != usize::from(net.outputs()) {
        let (expected, last) = (u32::try_from(rows).unwrap_or(u32::MAX), net.count.saturating_sub(1));
        let at = last.saturating_mul(LAYER_LEN).saturating_add(NET_HEAD);
        part.u16(at, u16::try_from(expected).unwrap_or(u16::MAX), u16::try_from(expected).unwrap_or(u16::MAX))?;
    }
    let cursor = records_end.saturating_add(heads_len);
    let cursor = place_streams(part, kind, &mut net, true, cursor)?;
    let state_rows = net.slots.first().map_or(0, |layer| usize::from(layer.rows));
    let per_row = if kind == WeightKind::Int8 { state_rows.next_multiple_of(4) } else { state_rows };
    let len = latents.saturating_mul(per_row).saturating_mul(8);
    let (modulation, end) = part.placed(8, cursor, len)?;
    part.exactly(end)?;
    if kind == WeightKind::Float32 {
        all_finite(part, end.saturating_sub(len), len)?;
    }
    Ok(Decoder::Modulated { net, modulation, heads })
}

/// Head records against the action slots; returns the rows they take.
fn check_heads(part: &Part<'_>, at: usize, actions: &[[u8; ACTION_LEN]]) -> Result<usize, LoadError> {
    let mut total = 0usize;
    for (index, record) in actions.iter().enumerate() {
        let at = index.saturating_mul(HEAD_LEN).saturating_add(at);
        // Kind in the low byte, snap rule in the high byte.
        let code = |kind: u8, snap: u8| u16::from_le_bytes([kind, snap]);
        let rows_at = at.saturating_add(2);
        let rows = match action_head(record) {
            ActionHead::Continuous { .. } => {
                if part.bytes.get(at).copied() == Some(ENCODING_CATEGORICAL) {
                    part.u16(at, code(ENCODING_CATEGORICAL, SNAP_NONE), code(ENCODING_CATEGORICAL, SNAP_ANY))?;
                    part.u16(rows_at, 2, limit(MAX_ATOMS))?
                } else {
                    part.u16(at, code(ENCODING_TANH, 0), code(ENCODING_TANH, 0))?;
                    part.u16(rows_at, 1, 1)?
                }
            }
            ActionHead::Discrete { n } => {
                part.u16(at, code(ENCODING_TYPES, 0), code(ENCODING_TYPES, 0))?;
                part.u16(rows_at, n, n)?
            }
            ActionHead::Binary => {
                part.u16(at, code(ENCODING_SWITCH, 0), code(ENCODING_SWITCH, 0))?;
                part.u16(rows_at, 1, 1)?
            }
        };
        total = total.saturating_add(usize::from(rows));
    }
    Ok(total)
}

/// Values of a table decoder.
fn check_constants(part: &Part<'_>, at: usize, latents: usize, actions: &[[u8; ACTION_LEN]]) -> Result<(), LoadError> {
    let mut at = at;
    for _ in 0..latents {
        for record in actions {
            let head = action_head(record);
            part.number(at, |value| match head {
                ActionHead::Continuous { .. } => (-1.0..=1.0).contains(&value),
                ActionHead::Discrete { n } => is_index(value, n),
                ActionHead::Binary => is_index(value, 2),
            })?;
            at = at.saturating_add(4);
        }
    }
    Ok(())
}

/// The constants of a table decoder for one latent.
pub(crate) fn constants(table: &[u8], latent: u16, slots: usize) -> impl Iterator<Item = f32> + '_ {
    let start = usize::from(latent).wrapping_mul(slots).wrapping_mul(4);
    (0..slots).map(move |slot| f32_at(table, start.wrapping_add(slot.wrapping_mul(4))).unwrap_or_default())
}
