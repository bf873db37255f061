//! Hidden layers with 4-bit weights: what rounding does to a shipped policy, and what fine-tuning by distillation with
//! straight-through rounding gives back.
//!
//! The int8 file is taken as a float network (`QuantisedModel::dequantised`); all layers but the first and the last of Q-network,
//! confidence network and decoder are rounded to -7..=7 times a step per row; Q-network and confidence network are then
//! trained to give the teacher's softmax (Rusu et al. 2016, section 3.2) on observations of the teacher's own episodes, with
//! the gradient of a rounded weight taken for that of the weight (Bengio et al. 2013, "straight-through").
//!
//! `cargo run --release -p gadm-trainer --example four_bit models/hopper-v5/policy.bin [UPDATES]`

use std::path::Path;

use anyhow::{Context as _, ensure};
use gadm_envs::EnvOptions;
use gadm_runtime::Policy;
use gadm_runtime::encode::{AlignedImage, Dense, FloatDecoder, FloatModel, QuantisedModel};
use gadm_runtime::space::ActionHead;
use gadm_trainer::nn::{Adam, AdamConfig, DenseParams, Graph, Init, ParamLayout, Params, Slot, Weights, declare_dense};
use gadm_trainer::runner::evaluate::{Evaluation, evaluate_policy};
use gadm_trainer::seed::{Rng, SeedTree};
use rand::RngExt as _;

/// Observations to train on, and fresh ones to compare latents on.
const TRAINED: usize = 20_000;
const COMPARED: usize = 5_000;
/// Share of random actions in the episodes that give them.
const RANDOM: f64 = 0.1;
const BATCH: usize = 256;
const EPISODES: usize = 20;
/// Seed of those episodes.
const SEED: u64 = 1000;
/// Largest magnitude of a 4-bit weight; symmetric, as pairs of rows share lanes.
const LEVELS: f32 = 7.0;

/// Rounds a row to `LEVELS` steps; the step is the one of the least squared error.
fn round_row(row: &[f32], out: &mut [f32]) {
    let max = row.iter().fold(0.0, |m: f32, w| m.max(w.abs()));
    let rounded = |w: f32, step: f32| (w / step).round().clamp(-LEVELS, LEVELS) * step;
    let error = |step: f32| -> f32 { row.iter().map(|&w| (rounded(w, step) - w).powi(2)).sum() };
    let steps = (8..=20).map(|share| max.max(f32::MIN_POSITIVE) / LEVELS * share as f32 / 20.0);
    let step = steps.map(|step| (error(step), step)).fold((f32::INFINITY, 1.0), |a, b| if b.0 < a.0 { b } else { a }).1;
    for (out, &w) in out.iter_mut().zip(row) {
        *out = rounded(w, step);
    }
}

/// Rounds the weights of all layers but the first and the last.
fn round_chain(layers: &mut [Dense]) {
    let last = layers.len().saturating_sub(1);
    for layer in layers.iter_mut().take(last).skip(1) {
        for row in layer.weight.chunks_exact_mut(layer.cols) {
            let full = row.to_vec();
            round_row(&full, row);
        }
    }
}

/// Softens `logits` with temperature `t` into probabilities.
fn soften(logits: &[f32], t: f32, out: &mut [f32]) {
    let top = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let mut sum = 0.0;
    for (out, l) in out.iter_mut().zip(logits) {
        *out = ((l - top) / t).exp();
        sum += *out;
    }
    for p in out {
        *p /= sum;
    }
}

/// A chain of dense layers that is trained with rounded hidden weights.
struct Student {
    layers: Vec<DenseParams>,
    graph: Graph,
    input: Slot,
    output: Slot,
    /// Full weights, which Adam changes, and rounded ones, which compute.
    full: Params,
    rounded: Params,
}

impl Student {
    fn new(layers: &[Dense], rng: &mut Rng) -> anyhow::Result<Self> {
        let mut layout = ParamLayout::new();
        let declared = layers
            .iter()
            .enumerate()
            .map(|(i, l)| declare_dense(&mut layout, &format!("l{i}"), l.cols, l.rows, Init::Zero));
        let declared: Vec<DenseParams> = declared.collect();
        let mut full = Params::init(layout, rng)?;
        full.with_mut(|p| {
            for (to, from) in declared.iter().zip(layers) {
                p[to.w.clone()].copy_from_slice(&from.weight);
                p[to.b.clone()].copy_from_slice(&from.bias);
            }
        });
        let rounded = full.duplicate()?;
        let mut graph = Graph::new();
        let input = graph.input(layers[0].cols);
        let last = layers.len() - 1;
        let output = declared.iter().enumerate().fold(input, |x, (i, l)| graph.dense(x, l, i < last));
        let mut student = Self { layers: declared, graph, input, output, full, rounded };
        student.round();
        Ok(student)
    }

    fn round(&mut self) {
        let Self { layers, full, rounded, .. } = self;
        full.with(|p| {
            rounded.with_mut(|r| {
                r.copy_from_slice(p);
                let last = layers.len() - 1;
                for layer in &layers[1..last.max(1)] {
                    let rows = p[layer.w.clone()].chunks_exact(layer.inputs);
                    for (from, to) in rows.zip(r[layer.w.clone()].chunks_exact_mut(layer.inputs)) {
                        round_row(from, to);
                    }
                }
            });
        });
    }

    /// Trains on the teacher's logits (`N x outputs`) for the rows of `x`; returns mean cross-entropy at start and end.
    fn distil(&mut self, x: &[f32], logits: &[f32], t: f32, updates: u64, rng: &mut Rng) -> (f32, f32) {
        let (width, k) = (self.layers[0].inputs, self.layers.last().map_or(0, |l| l.outputs));
        let trainable = self.full.layout().trainable_len();
        let mut ws = self.graph.workspace(BATCH, trainable);
        let mut packed = self.graph.packed();
        let mut adam = Adam::new(AdamConfig { learning_rate: 2e-4, ..AdamConfig::default() }, trainable);
        let (mut target, mut found) = (vec![0.0; k], vec![0.0; k]);
        let (mut first, mut last) = (0.0, 0.0);
        for update in 0..updates {
            // Down to a tenth over the second half.
            let progress = update as f64 / updates as f64;
            adam.config.learning_rate = 2e-4 * 0.1f64.powf((2.0 * progress - 1.0).max(0.0));
            let rows: Vec<usize> = (0..BATCH).map(|_| rng.random_range(0..x.len() / width)).collect();
            for (to, &row) in ws.value_mut(self.input).chunks_exact_mut(width).zip(&rows) {
                to.copy_from_slice(&x[row * width..(row + 1) * width]);
            }
            self.graph.refresh(&self.rounded, &mut packed, true);
            let mut loss = 0.0;
            self.rounded.with(|p| {
                let weights = Weights { flat: p, packed: &packed };
                self.graph.forward(weights, &mut ws, BATCH, true);
                let (out, grad) = ws.value_and_grad(self.output, self.output);
                for ((out, grad), &row) in out.chunks_exact(k).zip(grad.chunks_exact_mut(k)).zip(&rows) {
                    soften(&logits[row * k..(row + 1) * k], t, &mut target);
                    soften(out, t, &mut found);
                    for ((grad, p), q) in grad.iter_mut().zip(&target).zip(&found) {
                        *grad = (q - p) / t / BATCH as f32;
                        loss -= p * q.max(1e-12).ln() / BATCH as f32;
                    }
                }
                self.graph.backward(weights, &mut ws);
            });
            self.full.with_mut(|p| adam.step(p, &mut [ws.gradient_mut()]));
            self.round();
            if update == 0 {
                first = loss;
            }
            last = loss;
        }
        (first, last)
    }

    fn layers(&self) -> Vec<Dense> {
        let layer = |p: &[f32], l: &DenseParams| Dense {
            rows: l.outputs,
            cols: l.inputs,
            weight: p[l.w.clone()].to_vec(),
            bias: p[l.b.clone()].to_vec(),
        };
        self.rounded.with(|p| self.layers.iter().map(|l| layer(p, l)).collect())
    }
}

fn forward(layers: &[Dense], x: &[f32]) -> Vec<Vec<f32>> {
    let mut values = vec![x.to_vec()];
    for (i, layer) in layers.iter().enumerate() {
        let rows = layer.weight.chunks_exact(layer.cols).zip(&layer.bias);
        let x = &values[i];
        let y = rows.map(|(row, b)| row.iter().zip(x).map(|(w, x)| w * x).sum::<f32>() + b);
        values.push(if i + 1 == layers.len() { y.collect() } else { y.map(|y| y.max(0.0)).collect() });
    }
    values
}

/// Observations in normalised form, `N x width`.
fn normalised(model: &FloatModel, observations: &[f32]) -> Vec<f32> {
    let width = model.obs_mean.len();
    let rows = observations.chunks_exact(width);
    rows.flat_map(|obs| obs.iter().zip(&model.obs_mean).zip(&model.obs_std).map(|((x, m), s)| (x - m) / s)).collect()
}

fn rms(values: impl Iterator<Item = f32> + Clone) -> f32 {
    let n = values.clone().count().max(1) as f32;
    (values.map(|v| v * v).sum::<f32>() / n).sqrt().max(1e-6)
}

/// Scales inputs and activations to a root mean square of 1, which does not change what the model computes: an optimiser
/// wants it.
fn rescale(model: &mut FloatModel, observations: &[f32]) {
    let x = normalised(model, observations);
    let width = model.obs_mean.len();
    let scale: Vec<f32> = (0..width).map(|j| rms(x.iter().skip(j).step_by(width).copied())).collect();
    let mut firsts = vec![&mut model.q[0]];
    if !model.shared_trunk {
        firsts.extend(model.confidence.iter_mut().filter_map(|c| c.first_mut()));
    }
    if let FloatDecoder::Modulated { state, .. } = &mut model.decoder {
        firsts.push(state);
    }
    for layer in firsts {
        for row in layer.weight.chunks_exact_mut(width) {
            row.iter_mut().zip(&scale).for_each(|(w, s)| *w *= s);
        }
    }
    model.obs_std.iter_mut().zip(&scale).for_each(|(std, s)| *std *= s);
    if model.shared_trunk {
        return;
    }
    let x = normalised(model, observations);
    let sample: Vec<&[f32]> = x.chunks_exact(width).step_by(20).collect();
    for layers in [Some(&mut model.q), model.confidence.as_mut()].into_iter().flatten() {
        for index in 0..layers.len() - 1 {
            let outputs: Vec<f32> = sample.iter().flat_map(|x| forward(layers, x).swap_remove(index + 1)).collect();
            let s = rms(outputs.iter().copied());
            let layer = &mut layers[index];
            layer.weight.iter_mut().chain(&mut layer.bias).for_each(|w| *w /= s);
            layers[index + 1].weight.iter_mut().for_each(|w| *w *= s);
        }
    }
}

/// Observations of the teacher's episodes, a share of whose actions is random.
fn explore(teacher: &FloatModel, env: &str, count: usize, seed: u64) -> anyhow::Result<Vec<f32>> {
    let mut env = gadm_envs::make(env)?;
    let spec = env.spec().clone();
    let mut rng = SeedTree::new(seed).stream("four-bit");
    let (mut obs, mut action) = (vec![0.0; spec.obs_dim()], vec![0.0; spec.action_dim()]);
    let mut out = Vec::new();
    let mut episode = 0;
    env.reset(gadm_envs::episode_seed(seed, episode), &mut obs);
    while out.len() < count * obs.len() {
        out.extend_from_slice(&obs);
        teacher.act(&obs, &mut action);
        if rng.random_bool(RANDOM) {
            for (a, slot) in action.iter_mut().zip(&spec.actions) {
                *a = match slot.head {
                    ActionHead::Continuous { lo, hi } => lo + (hi - lo) * rng.random::<f32>(),
                    ActionHead::Discrete { n } => f32::from(rng.random_range(0..n)),
                    ActionHead::Binary => f32::from(rng.random_range(0..2u16)),
                };
            }
        }
        let step = env.step(&action, &mut obs);
        if step.terminated || step.truncated {
            episode += 1;
            env.reset(gadm_envs::episode_seed(seed, episode), &mut obs);
        }
    }
    Ok(out)
}

/// Return of an episode, with the seeds of `evaluate_policy`.
fn episode(model: &FloatModel, env: &str, index: u64) -> anyhow::Result<f64> {
    let mut env = gadm_envs::make(env)?;
    let (mut obs, mut action) = (vec![0.0; model.obs_mean.len()], vec![0.0; model.interface.actions.len()]);
    env.reset(gadm_envs::episode_seed(SEED, index), &mut obs);
    let mut sum = 0.0;
    loop {
        model.act(&obs, &mut action);
        let step = env.step(&action, &mut obs);
        sum += step.reward;
        if step.terminated || step.truncated {
            return Ok(sum);
        }
    }
}

struct Bench<'a> {
    teacher: &'a FloatModel,
    env: &'a str,
    compared: &'a [f32],
}

impl Bench<'_> {
    /// Prints a row: latents and actions against the teacher's, return over the episodes.
    fn row(&self, name: &str, model: &FloatModel) -> anyhow::Result<()> {
        let (width, slots) = (model.obs_mean.len(), model.interface.actions.len());
        let (mut ours, mut theirs) = (vec![0.0; slots], vec![0.0; slots]);
        let (mut same, mut error) = (0, 0.0);
        for obs in self.compared.chunks_exact(width) {
            same += usize::from(model.act(obs, &mut ours).latent == self.teacher.act(obs, &mut theirs).latent);
            for ((a, b), slot) in ours.iter().zip(&theirs).zip(&model.interface.actions) {
                error += f64::from((slot.head.normalise(*a) - slot.head.normalise(*b)).abs()) / 2.0;
            }
        }
        let n = (self.compared.len() / width) as f64;
        let returns = (0..EPISODES).map(|i| episode(model, self.env, i as u64)).collect::<anyhow::Result<_>>()?;
        let result = Evaluation { returns, ..Evaluation::default() };
        println!(
            "| {name} | {:.1} % | {:.2} % | {:.2} ± {:.2} |",
            100.0 * same as f64 / n,
            100.0 * error / n / slots as f64,
            result.mean(),
            result.sd()
        );
        Ok(())
    }
}

/// A chain trained towards the original's softmax at temperature `t` times the spread of its logits.
fn tuned(layers: &[Dense], x: &[f32], t: Option<f32>, updates: u64, name: &str) -> anyhow::Result<Vec<Dense>> {
    let width = layers[0].cols;
    let logits: Vec<f32> = x.chunks_exact(width).flat_map(|x| forward(layers, x).pop().unwrap_or_default()).collect();
    let k = layers.last().map_or(1, |l| l.rows);
    let spread = logits.chunks_exact(k).map(|row| {
        let mean = row.iter().sum::<f32>() / k as f32;
        rms(row.iter().map(|v| v - mean))
    });
    let t = t.map_or(1.0, |share| share * spread.sum::<f32>() / (logits.len() / k) as f32);
    let mut rng = SeedTree::new(7).stream(name);
    let mut student = Student::new(layers, &mut rng)?;
    let (first, last) = student.distil(x, &logits, t, updates, &mut rng);
    eprintln!("{name}: cross-entropy {first:.4} to {last:.4} at temperature {t:.4}");
    Ok(student.layers())
}

fn main() -> anyhow::Result<()> {
    let mut words = std::env::args().skip(1);
    let path = words.next().context("usage: four_bit POLICY.bin [UPDATES]")?;
    let updates: u64 = words.next().map_or(Ok(3000), |w| w.parse()).context("UPDATES must be a whole number")?;
    let bytes = std::fs::read(Path::new(&path)).with_context(|| path.clone())?;
    let image = AlignedImage::new(&bytes);
    let policy = Policy::load(&image).with_context(|| path.clone())?;
    let env = policy.provenance().environment.to_owned();
    let mut teacher = QuantisedModel::read(&policy).dequantised();
    ensure!(!teacher.shared_trunk, "{path}: a shared trunk is not supported here: fine-tuning would move two networks");
    let trained = explore(&teacher, &env, TRAINED, 1)?;
    let compared = explore(&teacher, &env, COMPARED, 2)?;
    rescale(&mut teacher, &trained);
    let bench = Bench { teacher: &teacher, env: &env, compared: &compared };
    println!("{env}, {EPISODES} episodes with seed {SEED}, latents and actions on {COMPARED} observations\n");
    println!("| weights | same latent | mean action error | return |\n| --- | --- | --- | --- |");
    let int8 = evaluate_policy(&bytes, &env, &EnvOptions::default(), EPISODES, SEED)?;
    println!("| int8 file | | | {:.2} ± {:.2} |", int8.mean(), int8.sd());
    bench.row("the same as floats", &teacher)?;
    let mut model = teacher.clone();
    round_chain(&mut model.q);
    bench.row("Q 4 bit, rounded", &model)?;
    if let Some(confidence) = &mut model.confidence {
        round_chain(confidence);
    }
    bench.row("Q, confidence 4 bit, rounded", &model)?;
    let x = normalised(&teacher, &trained);
    model = teacher.clone();
    model.q = tuned(&teacher.q, &x, Some(0.1), updates, "Q-network")?;
    bench.row("Q 4 bit, tuned", &model)?;
    if let Some(confidence) = &teacher.confidence {
        model.confidence = Some(tuned(confidence, &x, None, updates, "confidence network")?);
        bench.row("Q, confidence 4 bit, tuned", &model)?;
    }
    if let FloatDecoder::Modulated { hidden, .. } = &mut model.decoder
        && !hidden.is_empty()
    {
        for layer in hidden {
            for row in layer.weight.chunks_exact_mut(layer.cols) {
                let full = row.to_vec();
                round_row(&full, row);
            }
        }
        bench.row("the same, hidden layers of the decoder 4 bit, rounded", &model)?;
    }
    let hidden: u32 = policy
        .layers()
        .filter(|l| l.cols >= 16 && l.out_bits < 32)
        .map(|l| u32::from(l.rows) * u32::from(l.cols))
        .sum();
    println!(
        "\n{hidden} of {} weights lie in hidden layers behind a first one; 4 bits save {} of {} bytes.",
        policy.spec().macs,
        hidden / 2,
        bytes.len()
    );
    Ok(())
}
