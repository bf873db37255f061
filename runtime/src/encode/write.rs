//! The file writer.

use super::check::{check, equal};
use super::error::EncodeError;
use super::image::AlignedImage;
use super::int_model::{IntDecoder, IntNet, QuantisedModel};
use super::model::{Dense, FloatDecoder, FloatModel, HeadEncoding, Interface, ProvenanceOwned, Snap};
use super::threshold::threshold;
use crate::crc::crc32;
use crate::interface::{HEAD_BINARY, HEAD_CONTINUOUS, HEAD_DISCRETE, InterfaceView, interface_hash};
use crate::net::{
    DECODER_MODULATED, DECODER_TABLE, ENCODING_CATEGORICAL, ENCODING_SWITCH, ENCODING_TANH, ENCODING_TYPES, NET_HEAD,
    READS_Q_HIDDEN, SNAP_ANY, SNAP_EDGES, SNAP_NONE,
};
use crate::schema::{
    FORMAT_VERSION, HEADER_LEN, MAGIC, MAX_SELF_TESTS, NUMERICS_VERSION, RUNTIME_ABI_SEPARATE,
    RUNTIME_ABI_SHARED_TRUNK, SECTION_ALIGN, TABLE_LEN, WeightKind,
};
use crate::scratch::{scratch_words, scratch_words_float};
use crate::space::ActionHead;
use crate::{Policy, Scratch};
use std::string::String;
use std::vec;
use std::vec::Vec;

/// One optional record of the trailer.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TrailerRecord {
    /// What it is; readers skip what they do not know.
    pub kind: u16,
    /// Content.
    pub data: Vec<u8>,
}

/// What does not come from the model.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FileOptions {
    /// Sequence number of the export.
    pub policy_seq: u32,
    /// Optional records.
    pub trailer: Vec<TrailerRecord>,
}

/// Latent and action of a self-test vector.
type Answer = (u16, Vec<f32>);

/// Writes an int8 file with one self-test vector per row of `self_test` (`n x obs_dim`, row-major), computes the vectors
/// with the runtime itself, and reads the file back.
///
/// # Errors
/// A model that the format cannot hold; no observation or more than 64 for the vectors, or one that is not finite.
pub fn write_int8(model: &QuantisedModel, self_test: &[f32], options: &FileOptions) -> Result<Vec<u8>, EncodeError> {
    let (obs_dim, slots) = (model.interface.observations.len(), model.interface.actions.len());
    let cases = check_cases(self_test, obs_dim)?;
    let draft = int8_image(model, &blank(&cases, slots), options)?;
    let image = AlignedImage::new(&draft);
    let policy = Policy::load(&image)?;
    let mut memory = vec![0; policy.spec().scratch_words];
    let mut answers = vec![];
    for case in &cases {
        let mut action = vec![0.0; slots];
        let decision =
            policy.act(case, &mut Scratch::new(&mut memory), &mut action).map_err(|error| EncodeError::Value {
                what: std::format!("self-test observation: {error}; row"),
                found: answers.len() as f64,
            })?;
        answers.push((decision.latent, action));
    }
    let vectors: Vec<(&[f32], Answer)> = cases.iter().copied().zip(answers).collect();
    let bytes = int8_image(model, &vectors, options)?;
    let image = AlignedImage::new(&bytes);
    Policy::load(&image)?.self_test(&mut Scratch::new(&mut memory)).map_err(EncodeError::SelfTest)?;
    Ok(bytes)
}

/// Writes an `f32` file with one self-test vector per row of `self_test` (`n x obs_dim`, row-major), computed by
/// [`FloatModel::act`]. Infinite observation bounds must have been replaced, see [`Interface::with_finite_bounds`].
///
/// # Errors
/// A model that the format cannot hold; no observation or more than 64 for the vectors, or one that is not finite.
pub fn write_float(model: &FloatModel, self_test: &[f32], options: &FileOptions) -> Result<Vec<u8>, EncodeError> {
    check(model)?;
    let (obs_dim, slots) = (model.interface.observations.len(), model.interface.actions.len());
    let cases = check_cases(self_test, obs_dim)?;
    let mut vectors = vec![];
    for case in cases {
        let mut action = vec![0.0; slots];
        let decision = model.act(case, &mut action);
        vectors.push((case, (decision.latent, action)));
    }
    let bytes = float_image(model, &vectors, options)?;
    let image = AlignedImage::new(&bytes);
    crate::load::load::<true>(&image, WeightKind::Float32)?;
    #[cfg(feature = "float")]
    {
        let policy = crate::FloatPolicy::load(&image)?;
        let mut memory = vec![0; policy.spec().scratch_words];
        policy.self_test(&mut Scratch::new(&mut memory)).map_err(EncodeError::SelfTest)?;
    }
    Ok(bytes)
}

fn check_cases(self_test: &[f32], obs_dim: usize) -> Result<Vec<&[f32]>, EncodeError> {
    let count = (self_test.len() / obs_dim.max(1)).clamp(1, MAX_SELF_TESTS);
    equal("self_test, 1 to 64 rows of the observation's length; values", count * obs_dim, self_test.len())?;
    if let Some(found) = self_test.iter().find(|x| !x.is_finite()) {
        return Err(EncodeError::Value { what: "self_test must be finite".into(), found: f64::from(*found) });
    }
    Ok(self_test.chunks_exact(obs_dim).collect())
}

fn blank<'a>(cases: &[&'a [f32]], slots: usize) -> Vec<(&'a [f32], Answer)> {
    cases.iter().map(|case| (*case, (0, vec![0.0; slots]))).collect()
}

/// Appends little-endian values. A number that its field does not hold is remembered and refuses the file at the end.
#[derive(Default)]
struct Buffer {
    bytes: Vec<u8>,
    too_large: Option<usize>,
}

impl Buffer {
    /// `value` as the type of its field; 0 for one that does not fit.
    fn fit<T: TryFrom<usize> + Default>(&mut self, value: usize) -> T {
        T::try_from(value).unwrap_or_else(|_| {
            self.too_large.get_or_insert(value);
            T::default()
        })
    }

    fn u16(&mut self, value: usize) {
        let value: u16 = self.fit(value);
        self.bytes.extend(value.to_le_bytes());
    }

    fn u32(&mut self, value: usize) {
        let value: u32 = self.fit(value);
        self.bytes.extend(value.to_le_bytes());
    }

    fn put_u32(&mut self, at: usize, value: usize) {
        let value: u32 = self.fit(value);
        self.bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
    }

    fn f32(&mut self, value: f32) {
        self.bytes.extend(value.to_le_bytes());
    }

    fn f32s(&mut self, values: &[f32]) {
        self.bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    }

    fn zeros(&mut self, count: usize) {
        self.bytes.resize(self.bytes.len() + count, 0);
    }

    fn align(&mut self) {
        self.bytes.resize(self.bytes.len().next_multiple_of(SECTION_ALIGN), 0);
    }

    fn append(&mut self, other: &Self) {
        self.bytes.extend(&other.bytes);
        self.too_large = self.too_large.or(other.too_large);
    }
}

/// One layer ready to be placed.
struct PackedLayer {
    rows: usize,
    cols: usize,
    bits: usize,
    stream: Vec<u8>,
}

/// A network ready to be placed.
struct PackedNet {
    layers: Vec<PackedLayer>,
    frac_bits: usize,
    scale: f32,
    /// Per-latent table of a decoder.
    table: Vec<u8>,
}

fn pack_int(net: &IntNet, modulated: bool) -> PackedNet {
    let mut table = vec![];
    let layers = net
        .layers
        .iter()
        .enumerate()
        .map(|(index, layer)| {
            let first = modulated && index == 0;
            let (stream, packed) = layer.pack(first);
            if first {
                table = packed;
            }
            PackedLayer { rows: layer.rows, cols: layer.cols, bits: usize::from(layer.bits), stream }
        })
        .collect();
    PackedNet { layers, frac_bits: usize::from(net.frac_bits), scale: net.scale, table }
}

fn pack_float<'a>(layers: impl Iterator<Item = &'a Dense>) -> PackedNet {
    let layers = layers
        .map(|layer| PackedLayer {
            rows: layer.rows,
            cols: layer.cols,
            bits: 32,
            stream: layer.weight.iter().chain(&layer.bias).flat_map(|value| value.to_le_bytes()).collect(),
        })
        .collect();
    PackedNet { layers, frac_bits: 0, scale: 1.0, table: vec![] }
}

/// What a file is made of, in either weight kind.
struct Parts<'a> {
    kind: WeightKind,
    interface: &'a Interface,
    input: Vec<(f32, f32)>,
    input_bits: u16,
    q: PackedNet,
    confidence: Option<(PackedNet, (u32, u32))>,
    shared_trunk: bool,
    decoder: Option<PackedNet>,
    /// Constants of a table decoder.
    constants: &'a [Vec<f32>],
    heads: &'a [HeadEncoding],
    provenance: &'a ProvenanceOwned,
}

fn int8_image(
    model: &QuantisedModel,
    vectors: &[(&[f32], Answer)],
    options: &FileOptions,
) -> Result<Vec<u8>, EncodeError> {
    let (decoder, constants): (_, &[Vec<f32>]) = match &model.decoder {
        IntDecoder::Modulated(net) => (Some(pack_int(net, true)), &[]),
        IntDecoder::Table(actions) => (None, actions),
    };
    let parts = Parts {
        kind: WeightKind::Int8,
        interface: &model.interface,
        input: model.input.clone(),
        input_bits: model.input_bits,
        q: pack_int(&model.q, false),
        confidence: model.confidence.as_ref().map(|(net, threshold)| (pack_int(net, false), *threshold)),
        shared_trunk: model.shared_trunk,
        decoder,
        constants,
        heads: &model.heads,
        provenance: &model.provenance,
    };
    file(&parts, vectors, options)
}

fn float_image(
    model: &FloatModel,
    vectors: &[(&[f32], Answer)],
    options: &FileOptions,
) -> Result<Vec<u8>, EncodeError> {
    let (decoder, constants): (_, &[Vec<f32>]) = match &model.decoder {
        FloatDecoder::Modulated { state, scale, shift, hidden, head } => {
            let mut net = pack_float(core::iter::once(state).chain(hidden).chain(core::iter::once(head)));
            for (scale, shift) in scale.iter().zip(shift) {
                net.table.extend(scale.iter().chain(shift).flat_map(|value| value.to_le_bytes()));
            }
            (Some(net), &[])
        }
        FloatDecoder::Table { actions } => (None, actions),
    };
    let latents = model.num_latents() as u16;
    let parts = Parts {
        kind: WeightKind::Float32,
        interface: &model.interface,
        input: model.obs_mean.iter().zip(&model.obs_std).map(|(mean, std)| (*mean, 1.0 / std)).collect(),
        input_bits: crate::quant::INPUT_BITS,
        q: pack_float(model.q.iter()),
        confidence: model.confidence.as_ref().map(|layers| (pack_float(layers.iter()), threshold(model.beta, latents))),
        shared_trunk: model.shared_trunk,
        decoder,
        constants,
        heads: &model.heads,
        provenance: &model.provenance,
    };
    file(&parts, vectors, options)
}

fn file(parts: &Parts<'_>, vectors: &[(&[f32], Answer)], options: &FileOptions) -> Result<Vec<u8>, EncodeError> {
    let mut out = Buffer::default();
    out.zeros(HEADER_LEN + TABLE_LEN);
    let mut index = 0;
    let mut section = |out: &mut Buffer, write: &mut dyn FnMut(&mut Buffer)| {
        out.align();
        let start = out.bytes.len();
        write(out);
        let len = out.bytes.len() - start;
        out.put_u32(HEADER_LEN + index * 8, start);
        out.put_u32(HEADER_LEN + index * 8 + 4, len);
        index += 1;
    };
    let mut hash = 0;
    section(&mut out, &mut |out| hash = write_interface(out, parts.interface));
    section(&mut out, &mut |out| {
        out.u16(usize::from(parts.input_bits));
        out.zeros(14);
        for (offset, scale) in &parts.input {
            out.f32(*offset);
            out.f32(*scale);
        }
    });
    section(&mut out, &mut |out| write_net(out, &parts.q, 0, (0, 0)));
    section(&mut out, &mut |out| {
        if let Some((net, threshold)) = &parts.confidence {
            let reads = if parts.shared_trunk { READS_Q_HIDDEN } else { 0 };
            write_net(out, net, reads, *threshold);
        }
    });
    section(&mut out, &mut |out| write_decoder(out, parts));
    section(&mut out, &mut |out| {
        out.u16(vectors.len());
        out.zeros(14);
        for (obs, (latent, action)) in vectors {
            out.f32s(obs);
            out.u16(usize::from(*latent));
            out.u16(0);
            out.f32s(action);
        }
    });
    check_provenance(parts.provenance)?;
    section(&mut out, &mut |out| write_provenance(out, parts.provenance));
    out.align();
    let payload_len = out.bytes.len() - HEADER_LEN;
    for record in &options.trailer {
        out.u16(usize::from(record.kind));
        out.u16(0);
        out.u32(record.data.len());
        out.bytes.extend(crc32(&record.data).to_le_bytes());
        out.u32(0);
        out.bytes.extend(&record.data);
        out.align();
    }
    let total = out.bytes.len();
    let mut header = Buffer { bytes: MAGIC.to_vec(), too_large: out.too_large };
    header.u16(usize::from(FORMAT_VERSION));
    header.u16(usize::from(NUMERICS_VERSION));
    header.u32(total);
    header.u32(payload_len);
    header.u32(0);
    header.bytes.extend(hash.to_le_bytes());
    header.bytes.extend(options.policy_seq.to_le_bytes());
    header.u32(words(parts));
    let runtime_abi = if parts.shared_trunk { RUNTIME_ABI_SHARED_TRUNK } else { RUNTIME_ABI_SEPARATE };
    header.bytes.extend(runtime_abi.to_le_bytes());
    header.u16(usize::from(parts.kind.code()));
    out.bytes[..header.bytes.len()].copy_from_slice(&header.bytes);
    if let Some(found) = header.too_large {
        let what = "a count or length: at most 65535 (4 GiB for bytes); make the model or its names shorter";
        return Err(EncodeError::Value { what: what.into(), found: found as f64 });
    }
    reseal(&mut out.bytes);
    Ok(out.bytes)
}

/// Recomputes the checksums of payload and header, for tests and tools that change bytes on purpose. Does nothing where
/// the lengths in the header do not fit the file.
pub fn reseal(file: &mut [u8]) {
    let Some(payload_len) = crate::fields::u32_at(file, 16) else { return };
    let Some(payload) = file.get(HEADER_LEN..).and_then(|rest| rest.get(..payload_len as usize)) else { return };
    let crc = crc32(payload);
    file[20..24].copy_from_slice(&crc.to_le_bytes());
    let crc = crc32(&file[..60]);
    file[60..64].copy_from_slice(&crc.to_le_bytes());
}

fn words(parts: &Parts<'_>) -> usize {
    let hidden = |net: &PackedNet| net.layers.iter().rev().skip(1).map(|layer| layer.rows).max().unwrap_or(0);
    let nets = [Some(&parts.q), parts.confidence.as_ref().map(|(net, _)| net), parts.decoder.as_ref()];
    let width = nets.into_iter().flatten().map(hidden).max().unwrap_or(0);
    let latents = parts.q.layers.last().map_or(0, |layer| layer.rows);
    let head_rows = parts.decoder.as_ref().and_then(|net| net.layers.last()).map_or(0, |layer| layer.rows);
    let size = if parts.kind == WeightKind::Int8 { scratch_words } else { scratch_words_float };
    size(parts.input.len(), width, latents, parts.confidence.is_some(), head_rows)
}

/// Writes the section and returns the hash of the interface.
fn write_interface(out: &mut Buffer, interface: &Interface) -> u64 {
    let mut text = String::new();
    let (mut observations, mut actions) = (Buffer::default(), Buffer::default());
    let mut texts = |record: &mut Buffer, name: &str, unit: &str| {
        record.u32(text.len());
        record.u16(name.len());
        record.u16(unit.len());
        text.push_str(name);
        text.push_str(unit);
    };
    for slot in &interface.observations {
        texts(&mut observations, &slot.name, &slot.unit);
        observations.f32(slot.lo);
        observations.f32(slot.hi);
    }
    for slot in &interface.actions {
        texts(&mut actions, &slot.name, &slot.unit);
        let (kind, n, lo, hi) = match slot.head {
            ActionHead::Continuous { lo, hi } => (HEAD_CONTINUOUS, 0, lo, hi),
            ActionHead::Discrete { n } => (HEAD_DISCRETE, n, 0.0, 0.0),
            ActionHead::Binary => (HEAD_BINARY, 0, 0.0, 0.0),
        };
        actions.u16(usize::from(kind));
        actions.u16(usize::from(n));
        actions.f32(lo);
        actions.f32(hi);
        actions.f32(slot.safe);
    }
    out.u16(interface.observations.len());
    out.u16(interface.actions.len());
    out.u32(interface.control_period_us as usize);
    out.u32(text.len());
    out.u32(0);
    out.append(&observations);
    out.append(&actions);
    out.bytes.extend(text.as_bytes());
    let view = InterfaceView {
        observations: observations.bytes.as_chunks().0,
        actions: actions.bytes.as_chunks().0,
        text: text.as_bytes(),
    };
    interface_hash(view, interface.control_period_us)
}

/// Records of the layers; returns where the place of each stream is to be written.
fn write_layers(out: &mut Buffer, layers: &[PackedLayer], reads: u16) -> Vec<usize> {
    let mut places = vec![];
    for (index, layer) in layers.iter().enumerate() {
        out.u16(layer.rows);
        out.u16(layer.cols);
        out.u16(layer.bits);
        out.u16(if index == 0 { usize::from(reads) } else { 0 });
        places.push(out.bytes.len());
        out.zeros(8);
    }
    places
}

/// Places bytes at the next aligned offset and notes the place.
fn place(out: &mut Buffer, at: usize, bytes: &[u8]) {
    out.align();
    out.put_u32(at, out.bytes.len());
    out.put_u32(at + 4, bytes.len());
    out.bytes.extend(bytes);
}

fn write_net(out: &mut Buffer, net: &PackedNet, reads: u16, threshold: (u32, u32)) {
    let start = out.bytes.len();
    out.u16(net.layers.len());
    out.u16(net.frac_bits);
    out.f32(net.scale);
    out.bytes.extend(threshold.0.to_le_bytes());
    out.bytes.extend(threshold.1.to_le_bytes());
    debug_assert_eq!(out.bytes.len() - start, NET_HEAD);
    let places = write_layers(out, &net.layers, reads);
    for (layer, at) in net.layers.iter().zip(places) {
        place(out, at, &layer.stream);
    }
}

fn write_decoder(out: &mut Buffer, parts: &Parts<'_>) {
    let start = out.bytes.len();
    let Some(net) = &parts.decoder else {
        out.u16(usize::from(DECODER_TABLE));
        out.zeros(14);
        let bytes: Vec<u8> = parts.constants.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
        place(out, start + 8, &bytes);
        return;
    };
    out.u16(usize::from(DECODER_MODULATED));
    out.u16(net.layers.len());
    out.u16(net.frac_bits);
    out.u16(parts.heads.len());
    out.zeros(8);
    let places = write_layers(out, &net.layers, 0);
    for (encoding, action) in parts.heads.iter().zip(&parts.interface.actions) {
        let (kind, snap) = match encoding {
            HeadEncoding::Tanh => (ENCODING_TANH, 0),
            HeadEncoding::Categorical { snap: Snap::None, .. } => (ENCODING_CATEGORICAL, SNAP_NONE),
            HeadEncoding::Categorical { snap: Snap::Edges, .. } => (ENCODING_CATEGORICAL, SNAP_EDGES),
            HeadEncoding::Categorical { snap: Snap::Any, .. } => (ENCODING_CATEGORICAL, SNAP_ANY),
            HeadEncoding::Types => (ENCODING_TYPES, 0),
            HeadEncoding::Switch => (ENCODING_SWITCH, 0),
        };
        out.bytes.extend([kind, snap]);
        out.u16(encoding.rows(action.head));
    }
    for (layer, at) in net.layers.iter().zip(places) {
        place(out, at, &layer.stream);
    }
    place(out, start + 8, &net.table);
}

fn check_provenance(provenance: &ProvenanceOwned) -> Result<(), EncodeError> {
    for (what, text) in [
        ("environment", &provenance.environment),
        ("algorithm", &provenance.algorithm),
        ("config_hash", &provenance.config_hash),
        ("commit", &provenance.commit),
    ] {
        if text.len() > crate::schema::MAX_TEXT || text.chars().any(char::is_control) {
            let what = std::format!("provenance, {what}: at most 64 bytes without control characters; bytes");
            return Err(EncodeError::Value { what, found: text.len() as f64 });
        }
    }
    Ok(())
}

fn write_provenance(out: &mut Buffer, provenance: &ProvenanceOwned) {
    for value in [provenance.train_seed, provenance.eval_seed, provenance.env_steps] {
        out.bytes.extend(value.to_le_bytes());
    }
    for stats in [provenance.float_return, provenance.device_return] {
        out.f32(stats.mean);
        out.f32(stats.std);
        out.bytes.extend(stats.episodes.to_le_bytes());
    }
    let texts = [&provenance.environment, &provenance.algorithm, &provenance.config_hash, &provenance.commit];
    for text in texts {
        out.u16(text.len());
    }
    for text in texts {
        out.bytes.extend(text.as_bytes());
    }
}

#[cfg(test)]
mod tests {
    use super::Buffer;

    #[test]
    fn what_does_not_fit_its_field_is_remembered() {
        let (mut out, mut other) = (Buffer::default(), Buffer::default());
        out.u16(65_535);
        assert_eq!((&out.bytes[..], out.too_large), (&[255, 255][..], None));
        other.u16(65_536);
        other.u16(70_000);
        out.append(&other);
        assert_eq!((out.bytes.len(), out.too_large), (6, Some(65_536)), "the first");
        if let Ok(large) = usize::try_from(1_u64 << 32) {
            let mut out = Buffer::default();
            out.u32(large);
            assert_eq!((&out.bytes[..], out.too_large), (&[0; 4][..], Some(large)));
        }
    }
}
