//! Views of networks and decoders in the image.

use crate::fields::{f32_at, slice_of, u16_at, u32_at};

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
#[cfg(any(test, feature = "encode"))]
pub(crate) const SNAP_NONE: u8 = 0;
pub(crate) const SNAP_EDGES: u8 = 1;
pub(crate) const SNAP_ANY: u8 = 2;

/// The threshold of a mask, as a fraction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Threshold {
    pub(crate) num: u32,
    pub(crate) den: u32,
}

/// One dense layer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Layer<'a> {
    pub(crate) rows: u16,
    pub(crate) cols: u16,
    /// Width of an output: 8 or 10 bits after the ReLU, [`LINEAR_BITS`] for logits.
    pub(crate) bits: u16,
    pub(crate) stream: &'a [u8],
}

/// Layers in order; the last one is linear.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Net<'a> {
    pub(crate) file: &'a [u8],
    /// Records of the layers.
    pub(crate) layers: &'a [[u8; LAYER_LEN]],
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

    /// Rows of the first layer.
    pub(crate) fn first_rows(&self) -> u16 {
        self.layers.first().and_then(|record| u16_at(record, 0)).unwrap_or_default()
    }
}

/// The constants of a table decoder for one latent.
pub(crate) fn constants(table: &[u8], latent: u16, slots: usize) -> impl Iterator<Item = f32> + '_ {
    let start = usize::from(latent).wrapping_mul(slots).wrapping_mul(4);
    (0..slots).map(move |slot| f32_at(table, start.wrapping_add(slot.wrapping_mul(4))).unwrap_or_default())
}

/// From latent and observation to head values.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Decoder<'a> {
    /// The first layer takes multipliers and offsets from `modulation`, one table per latent.
    Modulated { net: Net<'a>, modulation: &'a [u8], heads: &'a [[u8; HEAD_LEN]] },
    /// One `f32` per slot and latent.
    Table { actions: &'a [u8] },
}
