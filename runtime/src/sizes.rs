//! Bytes by part and layer shapes, for inspection.

use crate::image::Image;
use crate::schema::{HEADER_LEN, Section, TABLE_LEN};

/// Bytes of each part of a file; `total` is their sum plus `padding`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SectionSizes {
    /// Header.
    pub header: usize,
    /// Section table.
    pub table: usize,
    /// Names, units and ranges.
    pub interface: usize,
    /// Input quantiser.
    pub input: usize,
    /// Q-network.
    pub q: usize,
    /// Confidence network.
    pub confidence: usize,
    /// Decoder without its per-latent table.
    pub decoder: usize,
    /// Per-latent multipliers and offsets, or the constants of a table decoder.
    pub latent_table: usize,
    /// Self-test vectors.
    pub self_test: usize,
    /// Provenance.
    pub provenance: usize,
    /// Trailer.
    pub trailer: usize,
    /// Zeros between sections.
    pub padding: usize,
    /// The whole file.
    pub total: usize,
}

impl SectionSizes {
    pub(crate) fn of(image: &Image<'_>) -> Self {
        let len = |section| image.section(section).len();
        let latent_table = image.net(Section::Decoder).table.len();
        let mut sizes = Self {
            header: HEADER_LEN,
            table: TABLE_LEN,
            interface: len(Section::Interface),
            input: len(Section::Input),
            q: len(Section::Q),
            confidence: len(Section::Confidence),
            decoder: len(Section::Decoder).wrapping_sub(latent_table),
            latent_table,
            self_test: len(Section::SelfTest),
            provenance: len(Section::Provenance),
            trailer: image.trailer().len(),
            padding: 0,
            total: image.file.len(),
        };
        sizes.padding = [
            sizes.header,
            sizes.table,
            sizes.interface,
            sizes.input,
            sizes.q,
            sizes.confidence,
            sizes.decoder,
            sizes.latent_table,
            sizes.self_test,
            sizes.provenance,
            sizes.trailer,
        ]
        .iter()
        .fold(sizes.total, |rest, part| rest.wrapping_sub(*part));
        sizes
    }
}

/// Shape and place of one layer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LayerShape {
    /// The network it belongs to: Q, confidence or decoder.
    pub network: Section,
    /// Outputs.
    pub rows: u16,
    /// Inputs.
    pub cols: u16,
    /// Bits of an output: 8 or 10 after a ReLU, 32 for a linear layer and for every layer of a float file.
    pub out_bits: u16,
    /// Bytes of its weights, biases and multipliers, without a decoder's per-latent table.
    pub bytes: usize,
}

/// Layers of all networks, in file order.
pub(crate) fn layer_shapes<'a>(image: &Image<'a>) -> impl Iterator<Item = LayerShape> + use<'a> {
    let image = *image;
    [Section::Q, Section::Confidence, Section::Decoder].into_iter().flat_map(move |network| {
        image.net(network).layers().map(move |layer| LayerShape {
            network,
            rows: layer.rows,
            cols: layer.cols,
            out_bits: layer.bits,
            bytes: layer.stream.len(),
        })
    })
}
