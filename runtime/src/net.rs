//! Views of networks and decoders in the image.

use crate::schema::MAX_LAYERS;

/// Bytes of the fixed part of a network or decoder section.
pub(crate) const NET_HEAD: usize = 16;
/// Bytes of a layer record.
pub(crate) const LAYER_LEN: usize = 16;
/// Bytes of a head record.
pub(crate) const HEAD_LEN: usize = 4;
/// `out_bits` of a linear layer.
pub(crate) const LINEAR_BITS: u16 = 32;

/// Codes of the decoder kinds.
pub(crate) const DECODER_MODULATED: u16 = 0;
pub(crate) const DECODER_TABLE: u16 = 1;

/// Codes of the head kinds in a head record.
pub(crate) const ENCODING_TANH: u8 = 0;
pub(crate) const ENCODING_CATEGORICAL: u8 = 1;
pub(crate) const ENCODING_TYPES: u8 = 2;
pub(crate) const ENCODING_SWITCH: u8 = 3;

/// Codes of the snap rules in a head record.
pub(crate) const SNAP_NONE: u8 = 0;
pub(crate) const SNAP_EDGES: u8 = 1;
pub(crate) const SNAP_ANY: u8 = 2;

/// One dense layer.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Layer<'a> {
    pub(crate) rows: u16,
    pub(crate) cols: u16,
    /// Width of an output: 8 or 10 bits after the ReLU, [`LINEAR_BITS`] for logits.
    pub(crate) bits: u16,
    pub(crate) stream: &'a [u8],
}

impl Layer<'_> {
    /// Multiply-accumulate operations, without padding.
    pub(crate) fn macs(&self) -> u32 {
        u32::from(self.rows).wrapping_mul(u32::from(self.cols))
    }
}

/// Layers in order; the last one is linear.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Net<'a> {
    pub(crate) slots: [Layer<'a>; MAX_LAYERS],
    pub(crate) count: usize,
    /// Fraction bits of the logits, in log2 units.
    pub(crate) frac_bits: u32,
    /// Value of one unit of the logits.
    pub(crate) scale: f32,
}

impl<'a> Net<'a> {
    pub(crate) fn layers(&self) -> impl DoubleEndedIterator<Item = &Layer<'a>> + Clone {
        self.slots.iter().take(self.count)
    }

    /// Rows of the last layer.
    pub(crate) fn outputs(&self) -> u16 {
        self.layers().next_back().map_or(0, |layer| layer.rows)
    }

    /// Widest hidden layer.
    pub(crate) fn hidden_width(&self) -> usize {
        let hidden = self.count.saturating_sub(1);
        self.layers().take(hidden).map(|layer| usize::from(layer.rows)).max().unwrap_or(0)
    }

    pub(crate) fn macs(&self) -> u32 {
        self.layers().fold(0, |sum: u32, layer| sum.wrapping_add(layer.macs()))
    }
}

/// From latent and observation to head values.
#[allow(clippy::large_enum_variant, reason = "no heap to box into; only large on 64-bit targets")]
#[derive(Clone, Copy, Debug)]
pub(crate) enum Decoder<'a> {
    /// The first layer takes multipliers and offsets from `modulation`, one table per latent.
    Modulated { net: Net<'a>, modulation: &'a [u8], heads: &'a [[u8; HEAD_LEN]] },
    /// One `f32` per slot and latent.
    Table { actions: &'a [u8] },
}

impl Decoder<'_> {
    pub(crate) fn macs(&self) -> u32 {
        match self {
            Self::Modulated { net, .. } => net.macs(),
            Self::Table { .. } => 0,
        }
    }
}
