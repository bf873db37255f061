//! All that a policy computes for one observation, for tools that show why it acts as it does.

use super::float_act::{linear, relu, softmax_terms};
use super::model::{Dense, FloatDecoder, FloatModel};
use crate::Policy;
use crate::decoder::emit;
use crate::error::ActError;
use crate::kernels::layer;
use crate::mask::LatentMask;
use crate::net::{LINEAR_BITS, Layer, Net};
use crate::policy::latent_table;
use crate::schema::{Section, padded};
use crate::scratch::Scratch;
use std::format;
use std::string::String;
use std::vec;
use std::vec::Vec;

/// Outputs of one layer.
#[derive(Clone, Debug, PartialEq)]
pub struct LayerTrace {
    /// `q.0`, `confidence.1`, `decoder.2`, ... The layers of the decoder are those for the chosen latent.
    pub layer: String,
    /// One value per row, after the ReLU of a hidden layer. Of a file hidden layers count in steps of their activations, as those
    /// of [`QuantisedModel::dequantised`](super::QuantisedModel::dequantised) do.
    pub outputs: Vec<f32>,
}

/// What one step computes, whether the decision needs it or not.
#[derive(Clone, Debug, PartialEq)]
pub struct Trace {
    /// The latent that is chosen.
    pub latent: u16,
    /// The latents that the confidence network allows; all of them without such a network.
    pub allowed: LatentMask,
    /// No latent passed the threshold, so the set was made by the empty-mask rule.
    pub fallback: bool,
    /// Q-value of every latent.
    pub q: Vec<f32>,
    /// Confidence of every latent; their sum is 1.
    pub confidence: Option<Vec<f32>>,
    /// Decoded action of every latent, `K x A`, in the units of the interface.
    pub actions: Vec<f32>,
    /// Layers of all networks, in file order.
    pub layers: Vec<LayerTrace>,
}

/// Names the outputs of a network's layers.
fn named(network: &str, outputs: Vec<Vec<f32>>) -> impl Iterator<Item = LayerTrace> {
    outputs.into_iter().enumerate().map(move |(i, outputs)| LayerTrace { layer: format!("{network}.{i}"), outputs })
}

fn probabilities(logits: &[f32]) -> Vec<f32> {
    let (terms, sum) = softmax_terms(logits);
    terms.iter().map(|term| term / sum).collect()
}

/// Outputs of every layer: ReLU layers and a linear last one.
fn dense_outputs(layers: &[Dense], x: &[f32]) -> Vec<Vec<f32>> {
    let mut outputs: Vec<Vec<f32>> = Vec::with_capacity(layers.len());
    for (index, layer) in layers.iter().enumerate() {
        let y = linear(layer, outputs.last().map_or(x, Vec::as_slice));
        outputs.push(if index + 1 < layers.len() { relu(y) } else { y });
    }
    outputs
}

/// The observation of the confidence network: that of the Q-network, or its last hidden layer.
fn trunk_of<'a, T>(shared: bool, outputs: &'a [Vec<T>], x: &'a [T]) -> &'a [T] {
    let hidden = outputs.len().checked_sub(2).filter(|_| shared);
    hidden.map_or(x, |last| &outputs[last])
}

impl FloatModel {
    /// [`act`](Self::act), with all that it computes.
    ///
    /// # Panics
    /// As [`act`](Self::act).
    #[must_use]
    pub fn trace(&self, obs: &[f32]) -> Trace {
        let slots = self.interface.actions.len();
        let decision = self.act(obs, &mut vec![0.0; slots]);
        let x = self.normalise(obs);
        let q = dense_outputs(&self.q, &x);
        let confidence =
            self.confidence.as_ref().map(|layers| dense_outputs(layers, trunk_of(self.shared_trunk, &q, &x)));
        let decoder = match &self.decoder {
            FloatDecoder::Table { .. } => vec![],
            FloatDecoder::Modulated { state, scale, shift, hidden, head } => {
                let latent = usize::from(decision.latent);
                let first = Self::modulate(state, &scale[latent], &shift[latent], &x);
                let layers: Vec<Dense> = hidden.iter().chain([head]).cloned().collect();
                let rest = dense_outputs(&layers, &first);
                [first].into_iter().chain(rest).collect()
            }
        };
        Trace {
            latent: decision.latent,
            allowed: decision.allowed,
            fallback: decision.fallback,
            actions: (0..self.num_latents()).flat_map(|latent| self.decode(&x, latent)).collect(),
            q: q.last().cloned().unwrap_or_default(),
            confidence: confidence.as_ref().and_then(|outputs| outputs.last()).map(|logits| probabilities(logits)),
            layers: named("q", q)
                .chain(named("confidence", confidence.unwrap_or_default()))
                .chain(named("decoder", decoder))
                .collect(),
        }
    }
}

/// Outputs of every layer as the kernels leave them: two activations to a word, or a logit a word, rows padded to 4.
fn words(net: &Net<'_>, modulation: Option<&[u8]>, x: &[u32]) -> Vec<Vec<u32>> {
    let mut modulation = modulation;
    let mut outputs: Vec<Vec<u32>> = Vec::new();
    for Layer { rows, cols, bits, stream } in net.layers() {
        let rows = usize::from(rows);
        // The next layer reads columns padded to 16.
        let (used, len) = match bits {
            LINEAR_BITS => (padded(rows, 4), padded(rows, 4)),
            _ => (padded(rows, 4) / 2, padded(rows, 16) / 2),
        };
        let mut y = vec![0; len];
        let x = outputs.last().map_or(x, Vec::as_slice);
        layer(stream, cols, bits.into(), modulation.take(), x, &mut y[..used]);
        outputs.push(y);
    }
    outputs
}

/// The values of [`words`], logits times `logit`.
fn values(net: &Net<'_>, words: &[Vec<u32>], logit: f32) -> Vec<Vec<f32>> {
    let half = |bits: u32| f32::from(bits as u16 as i16);
    net.layers()
        .zip(words)
        .map(|(layer, words)| {
            let mut values: Vec<f32> = match layer.bits {
                LINEAR_BITS => words.iter().map(|word| word.cast_signed() as f32 * logit).collect(),
                _ => words.iter().flat_map(|&word| [half(word), half(word >> 16)]).collect(),
            };
            values.truncate(layer.rows.into());
            values
        })
        .collect()
}

impl Policy<'_> {
    /// [`act`](Self::act), with all that it computes and more: the decoded action of every latent.
    ///
    /// # Errors
    /// As [`act`](Self::act).
    pub fn trace(&self, obs: &[f32]) -> Result<Trace, ActError> {
        let image = self.image();
        let (latents, slots) = (self.spec().num_latents, usize::from(self.spec().action_dim));
        let mut memory = vec![0; self.spec().scratch_words];
        let decision = self.act(obs, &mut Scratch::new(&mut memory), &mut vec![0.0; slots])?;
        let mut x = vec![0u32; padded(obs.len(), 16) / 2];
        for (index, (&value, quantiser)) in obs.iter().zip(self.input_quantisers()).enumerate() {
            x[index / 2] |= u32::from(quantiser.quantise(value).0.cast_unsigned()) << (index % 2 * 16);
        }
        let log2 = |net: &Net<'_>| std::f32::consts::LN_2 / (1u32 << net.frac_bits) as f32;
        let net = image.net(Section::Q);
        let q_words = words(&net, None, &x);
        let q = values(&net, &q_words, self.q_scale());
        let confidence = image.threshold().map(|_| {
            let net = image.net(Section::Confidence);
            let words = words(&net, None, trunk_of(self.shared_trunk(), &q_words, &x));
            values(&net, &words, log2(&net))
        });
        let from = image.net(Section::Decoder);
        let mut actions = Vec::with_capacity(usize::from(latents) * slots);
        let mut decoder = vec![];
        for latent in 0..latents {
            let mut words = words(&from, Some(latent_table(&from, latent)), &x);
            if latent == decision.latent && !words.is_empty() {
                decoder = values(&from, &words, log2(&from));
            }
            let logits = words.last_mut().map(Vec::as_mut_slice).unwrap_or_default();
            emit(&from, image.actions(), latent, logits, |_, value| actions.push(value));
        }
        Ok(Trace {
            latent: decision.latent,
            allowed: decision.allowed,
            fallback: decision.fallback,
            q: q.last().cloned().unwrap_or_default(),
            confidence: confidence.as_ref().and_then(|outputs| outputs.last()).map(|logits| probabilities(logits)),
            actions,
            layers: named("q", q)
                .chain(named("confidence", confidence.unwrap_or_default()))
                .chain(named("decoder", decoder))
                .collect(),
        })
    }
}
