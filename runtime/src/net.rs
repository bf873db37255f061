//! Views of networks and decoders in the image.

use crate::fields::{slice_of, u16_at, u32_at};

/// Bytes of the fixed part of a network or decoder section.
pub(crate) const NET_HEAD: usize = 16;
/// Bytes of a layer record.
pub(crate) const LAYER_LEN: usize = 16;
/// Bytes of a head record.
pub(crate) const HEAD_LEN: usize = 4;
/// `out_bits` of a linear layer.
pub(crate) const LINEAR_BITS: u16 = 32;

/// What the first layer of a network reads, in the last field of its record: this, or 0 for the observation.
pub(crate) const READS_Q_HIDDEN: u16 = 1;

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
#[derive(Clone, Copy, Debug)]
pub(crate) struct Layer<'a> {
    pub(crate) rows: u16,
    pub(crate) cols: u16,
    /// Width of an output: 8 or 10 bits after the ReLU, [`LINEAR_BITS`] for logits.
    pub(crate) bits: u16,
    pub(crate) stream: &'a [u8],
}

/// A network or a decoder: layers in order, of which the last one is linear.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Net<'a> {
    pub(crate) file: &'a [u8],
    /// Records of the layers.
    pub(crate) layers: &'a [[u8; LAYER_LEN]],
    /// Records of the heads of a decoder with layers.
    pub(crate) heads: &'a [[u8; HEAD_LEN]],
    /// Of a decoder: multipliers and offsets of the first layer for each latent, or without layers one `f32` per slot and
    /// latent.
    pub(crate) table: &'a [u8],
    /// Fraction bits of the logits, in log2 units.
    pub(crate) frac_bits: u32,
    /// Numerator and denominator of the mask's threshold, of a confidence network.
    pub(crate) threshold: [u32; 2],
}

impl<'a> Layer<'a> {
    #[inline(always)]
    fn of(file: &'a [u8], record: &[u8; LAYER_LEN]) -> Self {
        let half = |at| u16_at(record, at).unwrap_or_default();
        let word = |at| u32_at(record, at).unwrap_or_default();
        Self { rows: half(0), cols: half(2), bits: half(4), stream: slice_of(file, word(8), word(12)) }
    }
}

impl<'a> Net<'a> {
    /// A layer, from 0.
    #[inline(never)]
    pub(crate) fn layer(&self, index: usize) -> Option<Layer<'a>> {
        self.layers.get(index).map(|record| Layer::of(self.file, record))
    }

    pub(crate) fn layers(self) -> impl Iterator<Item = Layer<'a>> + use<'a> {
        self.layers.iter().map(move |record| Layer::of(self.file, record))
    }

    /// Rows of the last layer.
    #[cfg(feature = "float")]
    pub(crate) fn outputs(&self) -> u16 {
        self.layers.last().and_then(|record| u16_at(record, 0)).unwrap_or_default()
    }

    /// One record a slot, of a head or of a table decoder's constant.
    pub(crate) fn slots(&self, latent: u16, slots: usize) -> &'a [[u8; HEAD_LEN]] {
        if !self.layers.is_empty() {
            return self.heads;
        }
        let at = usize::from(latent).wrapping_mul(slots);
        self.table.as_chunks().0.get(at..at.wrapping_add(slots)).unwrap_or_default()
    }

    /// Rows of the first layer.
    pub(crate) fn first_rows(&self) -> u16 {
        self.layers.first().and_then(|record| u16_at(record, 0)).unwrap_or_default()
    }
}
