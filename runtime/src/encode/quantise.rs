//! From float weights to a quantised model: folds the normalisation, calibrates activations, permutes hidden rows.

use super::calibrate::{Samples, input_ranges};
use super::check::{check, equal};
use super::error::EncodeError;
use super::float_act::{linear, relu};
use super::int_model::{IntDecoder, IntNet, LayerReport, QuantiseReport, QuantisedModel};
use super::model::{Dense, FloatDecoder, FloatModel};
use super::rows::{RealLayer, excess, finish_hidden, finish_logits, pair_order, quantise_rows};
use super::threshold::threshold;
use crate::prove::Range;
use crate::quant::input_max;
use std::format;
use std::string::String;
use std::vec;
use std::vec::Vec;

/// What [`quantise`] may be told.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct QuantiseOptions {
    /// Width added on both sides of the calibrated range of each input, as a share of that range.
    pub input_margin: f32,
    /// Most calibration observations used; more are thinned evenly.
    pub max_samples: usize,
}

impl Default for QuantiseOptions {
    fn default() -> Self {
        Self { input_margin: 0.1, max_samples: 2048 }
    }
}

/// Rows that need more than this much smaller weights at 10 bits make the layer below take 8 bits.
const MOST_EXCESS: f64 = 1.5;

/// Quantises a model; `calibration` holds observations, `N x obs_dim`, row-major, as the policy meets them.
///
/// # Errors
/// Shapes that do not fit together, values that are not finite, sizes beyond the limits of the format.
pub fn quantise(
    model: &FloatModel,
    calibration: &[f32],
    options: &QuantiseOptions,
) -> Result<QuantisedModel, EncodeError> {
    check(model)?;
    let obs_dim = model.interface.observations.len();
    let rows = calibration.len() / obs_dim;
    equal("calibration, a multiple of the observations", rows.max(1) * obs_dim, calibration.len())?;
    if let Some(index) = calibration.iter().position(|x| !x.is_finite()) {
        let what = format!("calibration row {}, observation {} must be finite", index / obs_dim, index % obs_dim);
        return Err(EncodeError::Value { what, found: f64::from(calibration[index]) });
    }
    let interface = model.interface.with_finite_bounds(calibration, options.input_margin);
    let stride = rows.div_ceil(options.max_samples.max(1));
    let observations: Vec<&[f32]> = calibration.chunks_exact(obs_dim).step_by(stride).collect();

    let input = Input::choose(model, calibration, options.input_margin);
    let quantised: Vec<Vec<f32>> = observations.iter().map(|obs| input.quantise(obs)).collect();
    let clipped_inputs = input.clipped_shares(calibration);
    let mut report = QuantiseReport { input_bits: input.bits, clipped_inputs, layers: Vec::new() };

    let observed = Source::observation(&input, &quantised);
    let on_trunk = model.confidence.as_ref().filter(|_| model.shared_trunk).and_then(|layers| layers.first());
    let (q, trunk) = chain_net("q", &model.q, &observed, on_trunk, &mut report, Output::Q)?;
    let confidence = match &model.confidence {
        None => None,
        Some(layers) => {
            let source = trunk.filter(|_| model.shared_trunk).unwrap_or(observed);
            let (net, _) = chain_net("confidence", layers, &source, None, &mut report, Output::Log2)?;
            Some((net, threshold(model.beta, model.num_latents() as u16)))
        }
    };
    let decoder = match &model.decoder {
        FloatDecoder::Table { actions } => IntDecoder::Table(actions.clone()),
        FloatDecoder::Modulated { .. } => {
            IntDecoder::Modulated(decoder_net(model, &observations, &input, &quantised, &mut report)?)
        }
    };
    Ok(QuantisedModel {
        interface,
        input: input.records,
        input_bits: input.bits,
        q,
        confidence,
        shared_trunk: model.shared_trunk,
        decoder,
        heads: if matches!(model.decoder, FloatDecoder::Table { .. }) { vec![] } else { model.heads.clone() },
        provenance: model.provenance.clone(),
        report,
    })
}

/// The input quantiser and what folding it into first layers needs.
struct Input {
    bits: u16,
    /// Offset and scale in native units, as stored.
    records: Vec<(f32, f32)>,
    /// Value of one step in normalised units.
    step: Vec<f64>,
    /// Normalised value of integer 0.
    zero: Vec<f64>,
}

impl Input {
    fn choose(model: &FloatModel, calibration: &[f32], margin: f32) -> Self {
        let mut firsts: Vec<&Dense> = model.q.first().into_iter().collect();
        if !model.shared_trunk {
            firsts.extend(model.confidence.iter().filter_map(|layers| layers.first()));
        }
        if let FloatDecoder::Modulated { state, .. } = &model.decoder {
            firsts.push(state);
        }
        let ranges = input_ranges(model, &firsts, calibration, margin);
        // Fewer bits where a first layer has so many inputs that a row's sum could leave its range.
        for (bits, allowed) in [(12, 1.0), (11, 1.0), (10, MOST_EXCESS), (9, MOST_EXCESS)] {
            let input = Self::with_bits(model, &ranges, bits);
            let worst =
                firsts.iter().map(|layer| excess(&input.fold(layer), Range::input(bits), true)).fold(0.0, f64::max);
            if worst <= allowed {
                return input;
            }
        }
        Self::with_bits(model, &ranges, 8)
    }

    fn with_bits(model: &FloatModel, ranges: &[(f64, f64)], bits: u16) -> Self {
        let top = f64::from(input_max(bits));
        let (mut records, mut step, mut zero) = (vec![], vec![], vec![]);
        for ((&(centre, half), mean), std) in ranges.iter().zip(&model.obs_mean).zip(&model.obs_std) {
            let (mean, std) = (f64::from(*mean), f64::from(*std));
            let offset = (mean + centre * std) as f32;
            let scale = ((top / (half * std)) as f32).clamp(f32::MIN_POSITIVE, f32::MAX);
            records.push((offset, scale));
            step.push(1.0 / (f64::from(scale) * std));
            zero.push((f64::from(offset) - mean) / std);
        }
        Self { bits, records, step, zero }
    }

    /// A first layer on quantised instead of normalised observations.
    fn fold(&self, layer: &Dense) -> RealLayer {
        let mut real = RealLayer::new(layer);
        for (row, bias) in real.weight.chunks_exact_mut(layer.cols).zip(&mut real.bias) {
            for ((w, step), zero) in row.iter_mut().zip(&self.step).zip(&self.zero) {
                *bias += *w * zero;
                *w *= step;
            }
        }
        real
    }

    /// Quantised values before rounding, clamped.
    fn quantise(&self, obs: &[f32]) -> Vec<f32> {
        let top = f32::from(input_max(self.bits));
        let values = obs.iter().zip(&self.records);
        values.map(|(x, (offset, scale))| ((x - offset) * scale).clamp(-top - 1.0, top)).collect()
    }

    fn clipped_shares(&self, calibration: &[f32]) -> Vec<f64> {
        let dim = self.records.len();
        let rows = (calibration.len() / dim).max(1) as f64;
        let max = input_max(self.bits);
        (0..dim)
            .map(|j| {
                let column = calibration.iter().skip(j).step_by(dim);
                let (offset, scale) = self.records[j];
                column.filter(|x| crate::quant::quantise_input(**x, offset, scale, max).1).count() as f64 / rows
            })
            .collect()
    }

    /// Normalised observation of quantised values.
    fn normalised(&self, quantised: &[f32]) -> Vec<f32> {
        let values = quantised.iter().zip(&self.step).zip(&self.zero);
        values.map(|((q, step), zero)| (f64::from(*q) * step + zero) as f32).collect()
    }
}

/// What the logits of a network are for.
#[derive(Clone, Copy, PartialEq)]
enum Output {
    /// Only their order counts.
    Q,
    /// Exponentials: log2 units.
    Log2,
}

/// Scale and shift before the ReLU, per latent and row.
type Modulation<'a> = (&'a [Vec<f32>], &'a [Vec<f32>]);

/// One layer of a network that is being quantised.
struct Stage<'a> {
    name: String,
    layer: &'a Dense,
    /// Outputs of the layer over the calibration set after the ReLU; empty for the last layer.
    outputs: Samples,
    /// Per latent, per row: scale and shift before the ReLU.
    modulation: Option<Modulation<'a>>,
}

/// What the first layer of a network reads, over the calibration set.
struct Source<'a> {
    /// The input quantiser, where that is the observation: folded into the layer.
    input: Option<&'a Input>,
    /// Real values, one row per observation.
    samples: Vec<Vec<f32>>,
    range: Range,
    /// Value of one step of the integers.
    scale: f64,
    /// Mean of the integers (observation) or of the real values (activation), per column.
    mean: Vec<f64>,
    /// Order in which the integers lie, where that is not the columns' own.
    order: Option<Vec<usize>>,
}

impl<'a> Source<'a> {
    fn observation(input: &'a Input, quantised: &[Vec<f32>]) -> Self {
        Self {
            input: Some(input),
            samples: quantised.iter().map(|q| input.normalised(q)).collect(),
            range: Range::input(input.bits),
            scale: 1.0,
            mean: Samples::new(input.records.len(), quantised).mean(),
            order: None,
        }
    }
}

/// Quantises ReLU layers and a linear last one. Returns the network and its last hidden layer as a source for another one,
/// whose first layer is `also`: the width of the activations suits both.
fn chain_net<'a>(
    name: &str,
    layers: &[Dense],
    source: &Source<'a>,
    also: Option<&Dense>,
    report: &mut QuantiseReport,
    output: Output,
) -> Result<(IntNet, Option<Source<'a>>), EncodeError> {
    let mut x = source.samples.clone();
    let mut stages = vec![];
    for (index, layer) in layers.iter().enumerate() {
        let mut outputs = Samples::default();
        if index + 1 < layers.len() {
            x = x.iter().map(|x| relu(linear(layer, x))).collect();
            outputs = Samples::new(layer.rows, &x);
        }
        stages.push(Stage { name: format!("{name}.{index}"), layer, outputs, modulation: None });
    }
    let (net, hidden) = quantise_stages(&stages, source, also, report, output)?;
    Ok((net, hidden.map(|hidden| Source { samples: x, ..hidden })))
}

/// The decoder; activations are calibrated with the latent that the float policy takes, and for a part of the
/// observations with every latent that it might take.
fn decoder_net(
    model: &FloatModel,
    observations: &[&[f32]],
    input: &Input,
    quantised: &[Vec<f32>],
    report: &mut QuantiseReport,
) -> Result<IntNet, EncodeError> {
    let FloatDecoder::Modulated { state, scale, shift, hidden, head } = &model.decoder else {
        return Ok(IntNet::default());
    };
    let mut unused = vec![0.0; model.interface.actions.len()];
    let every = observations.len().div_ceil(64);
    let mut x = vec![];
    for (index, (obs, q)) in observations.iter().zip(quantised).enumerate() {
        let decision = model.act(obs, &mut unused);
        let normalised = input.normalised(q);
        for latent in decision.allowed.iter().filter(|&l| l == decision.latent || index % every == 0) {
            let latent = usize::from(latent);
            x.push(FloatModel::modulate(state, &scale[latent], &shift[latent], &normalised));
        }
    }
    let first = Samples::new(state.rows, &x);
    let modulation = Some((scale.as_slice(), shift.as_slice()));
    let mut stages = vec![Stage { name: "decoder.state".into(), layer: state, outputs: first, modulation }];
    for (index, layer) in hidden.iter().enumerate() {
        x = x.iter().map(|x| relu(linear(layer, x))).collect();
        let outputs = Samples::new(layer.rows, &x);
        stages.push(Stage { name: format!("decoder.{}", index + 1), layer, outputs, modulation: None });
    }
    stages.push(Stage { name: "decoder.head".into(), layer: head, outputs: Samples::default(), modulation: None });
    Ok(quantise_stages(&stages, &Source::observation(input, quantised), None, report, Output::Log2)?.0)
}

/// As [`chain_net`], with the layers prepared; the samples of the returned source are empty.
fn quantise_stages<'a>(
    stages: &[Stage<'_>],
    source: &Source<'a>,
    also: Option<&Dense>,
    report: &mut QuantiseReport,
    output: Output,
) -> Result<(IntNet, Option<Source<'a>>), EncodeError> {
    let mut net = IntNet::default();
    let mut hidden: Option<Source<'a>> = None;
    for (index, stage) in stages.iter().enumerate() {
        let x = hidden.as_ref().unwrap_or(source);
        let (range, x_scale) = (x.range, x.scale);
        let mut real = x.input.map_or_else(|| RealLayer::new(stage.layer), |input| input.fold(stage.layer));
        let mut x_mean = x.mean.clone();
        if let Some(order) = &x.order {
            real.permute_columns(order);
            x_mean = order.iter().map(|&column| x.mean[column]).collect();
        }
        let Some(next) = stages.get(index + 1) else {
            let rows = quantise_rows(&real, range, &x_mean);
            let shrunk_rows = rows.shrunk;
            let (layer, frac_bits, scale) =
                finish_logits(&rows, x_scale, range, output == Output::Log2).ok_or_else(|| EncodeError::Value {
                    what: format!("{}: logits too large for 32 bits; largest weight", stage.name),
                    found: real.weight.iter().fold(0.0, |max: f64, w| max.max(w.abs())),
                })?;
            net.layers.push(layer);
            net.frac_bits = frac_bits;
            net.scale = scale as f32;
            report.layers.push(LayerReport {
                layer: stage.name.clone(),
                out_bits: 32,
                shrunk_rows,
                saturated: 0.0,
                order: (0..stage.layer.rows).collect(),
            });
            break;
        };
        let order = pair_order(&real, range);
        real.permute_rows(&order);
        let rows = quantise_rows(&real, range, &x_mean);
        let last = index + 2 == stages.len();
        let readers = core::iter::once(next.layer).chain(also.filter(|_| last));
        let excess_of = |layer| excess(&RealLayer::new(layer), Range::activation(10), !last);
        let ten = readers.map(excess_of).fold(0.0, f64::max) <= MOST_EXCESS;
        let bits: u16 = if ten { 10 } else { 8 };
        let top = f64::from((1u32 << bits) - 1);
        let wanted = stage.outputs.best_top(top) / top;
        let modulation = stage.modulation.map(|(scale, shift)| {
            let reorder = |table: &[Vec<f32>]| -> Vec<Vec<f64>> {
                table.iter().map(|row| order.iter().map(|&r| f64::from(row[r])).collect()).collect()
            };
            (reorder(scale), reorder(shift))
        });
        let (layer, y_scale) =
            finish_hidden(&rows, x_scale, wanted, range, bits, modulation.as_ref()).ok_or_else(|| {
                EncodeError::Value {
                    what: format!("{}: activations too large to be scaled; wanted step", stage.name),
                    found: wanted,
                }
            })?;
        report.layers.push(LayerReport {
            layer: stage.name.clone(),
            out_bits: bits,
            shrunk_rows: rows.shrunk,
            saturated: stage.outputs.share_above(y_scale * top),
            order: order.clone(),
        });
        net.layers.push(layer);
        hidden = Some(Source {
            input: None,
            samples: vec![],
            range: Range::activation(bits),
            scale: y_scale,
            mean: stage.outputs.mean(),
            order: Some(order),
        });
    }
    Ok((net, hidden))
}
