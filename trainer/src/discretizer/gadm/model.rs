//! Encoder, quantiser and decoder of GADM as one training graph and two inference graphs on the same parameters
//! (paper section 3.2; specification 2.2 to 2.8).

use std::ops::Range;

use super::codetable::{Codetable, bisection};
use super::config::{ActionModelConfig, Fusion};
use super::loss::{Count, Reconstruction, ReconstructionLoss};
use crate::action_space::{ActionSpace, ContinuousHead};
use crate::error::TrainError;
use crate::nn::parallel::{PARTS, each, part_rows, split};
use crate::nn::vector::vectorised;
use crate::nn::{Adam, DenseParams, Graph, Init, Packed, ParamLayout, Params, Slot, Weights, Workspace, declare_dense};
use crate::seed::Rng;

/// Rows a forward pass handles at once outside training.
const CHUNK: usize = 512;

#[derive(Clone, Debug)]
struct Layers {
    action: DenseParams,
    state: Option<DenseParams>,
    encoder_film: Option<(DenseParams, DenseParams)>,
    encoder: Vec<DenseParams>,
    to_code: DenseParams,
    code: DenseParams,
    decoder_film: Option<(DenseParams, DenseParams)>,
    decoder: Vec<DenseParams>,
    head: DenseParams,
    table: Range<usize>,
    running: Option<(Range<usize>, Range<usize>)>,
}

struct Encoding {
    graph: Graph,
    obs: Option<Slot>,
    action: Slot,
    packed: Packed,
    parts: Vec<Workspace>,
}

struct Decoding {
    graph: Graph,
    obs: Option<Slot>,
    code: Slot,
    out: Slot,
    packed: Packed,
    ws: Workspace,
}

struct Training {
    graph: Graph,
    obs: Option<Slot>,
    action: Slot,
    latent: Slot,
    out: Slot,
    packed: Packed,
    parts: Vec<Workspace>,
    losses: Vec<PartLoss>,
    codes: Vec<u32>,
}

/// What one part of a batch adds to the loss.
#[derive(Clone, Copy, Debug, Default)]
struct PartLoss {
    reconstruction: Reconstruction,
    /// Sum of `(z_e - V[k])²`.
    commitment: f32,
}

/// What one update of the action model reports.
#[derive(Clone, Copy, Debug, Default)]
pub struct ActionModelMetrics {
    /// Total loss (paper eq. 2 with the corrected commitment term).
    pub loss: f32,
    /// Its reconstruction part.
    pub reconstruction: Reconstruction,
    /// `mean (z_e - V[k])²`.
    pub commitment: f32,
    /// Gradient norm before clipping.
    pub grad_norm: f32,
}

/// The trained action discretisation.
pub struct ActionModel {
    config: ActionModelConfig,
    space: ActionSpace,
    obs_dim: usize,
    layers: Layers,
    /// Parameters, code table and running statistics.
    pub params: Params,
    /// Optimiser state.
    pub adam: Adam,
    training: Training,
    encoding: Encoding,
    decoding: Decoding,
}

fn declare(config: &ActionModelConfig, obs_dim: usize, space: &ActionSpace, layout: &mut ParamLayout) -> Layers {
    let (h, d, k) = (config.hidden, config.code_dim(), config.latents);
    let conditioned = config.fusion != Fusion::None;
    let mut dense = |name: &str, i: usize, o: usize| declare_dense(layout, name, i, o, Init::torch(i));
    let action = dense("encoder.action", space.input_width(), h);
    let state = conditioned.then(|| dense("state", obs_dim, h));
    let encoder: Vec<_> = (0..config.encoder_layers).map(|i| dense(&format!("encoder.common{i}"), h, h)).collect();
    let to_code = dense("encoder.code", h, d);
    let code = dense("decoder.code", d, h);
    let decoder: Vec<_> = (0..config.decoder_layers).map(|i| dense(&format!("decoder.common{i}"), h, h)).collect();
    let head = dense("decoder.head", h, space.output_width());
    let mut film = |side: &str| {
        match config.fusion {
            Fusion::None | Fusion::Mul => None,
            // Identity at the start: the state cannot drown the action (specification 2.3).
            Fusion::FilmStateToLatent => Some(
                ["scale", "shift"].map(|part| declare_dense(layout, &format!("{side}.film.{part}"), h, h, Init::Zero)),
            ),
            // Zero here would cut the encoder off from every gradient.
            Fusion::FilmLatentToState => Some(
                ["scale", "shift"]
                    .map(|part| declare_dense(layout, &format!("{side}.film.{part}"), h, h, Init::torch(h))),
            ),
        }
        .map(|[a, b]| (a, b))
    };
    let encoder_film = film("encoder");
    let decoder_film = film("decoder");
    let table = match config.codetable {
        Codetable::Learned => layout.param("codetable", &[k, d], Init::Uniform(1.0 / k as f32)),
        Codetable::OneHot => layout.buffer("codetable", &[k, d], Init::OneHot),
        Codetable::Bisection => layout.buffer("codetable", &[k, d], Init::Zero),
    };
    let running = config.standardise.then(|| {
        (
            layout.buffer("encoder.running_mean", &[d], Init::Zero),
            layout.buffer("encoder.running_var", &[d], Init::Constant(1.0)),
        )
    });
    Layers { action, state, encoder_film, encoder, to_code, code, decoder_film, decoder, head, table, running }
}

/// The state branch: `W s + b`, with its ReLU unless the fusion modulates before it.
fn state_branch(graph: &mut Graph, config: &ActionModelConfig, layers: &Layers, obs: Option<Slot>) -> Option<Slot> {
    let (obs, state) = (obs?, layers.state.as_ref()?);
    Some(graph.dense(obs, state, config.fusion != Fusion::FilmLatentToState))
}

fn fuse(
    graph: &mut Graph,
    fusion: Fusion,
    film: Option<&(DenseParams, DenseParams)>,
    embedded: Slot,
    state: Option<Slot>,
) -> Slot {
    match (fusion, film, state) {
        (Fusion::Mul, _, Some(state)) => graph.mul(embedded, state),
        (Fusion::FilmStateToLatent, Some((scale, shift)), Some(state)) => {
            let (scale, shift) = (graph.dense(state, scale, false), graph.dense(state, shift, false));
            graph.film(embedded, scale, shift, false)
        }
        (Fusion::FilmLatentToState, Some((scale, shift)), Some(state)) => {
            let (scale, shift) = (graph.dense(embedded, scale, false), graph.dense(embedded, shift, false));
            graph.film(state, scale, shift, true)
        }
        _ => embedded,
    }
}

/// Adds the encoder; returns the (standardised) code position `z_e`.
fn encode(graph: &mut Graph, config: &ActionModelConfig, layers: &Layers, action: Slot, state: Option<Slot>) -> Slot {
    let embedded = graph.dense(action, &layers.action, true);
    let mut f = fuse(graph, config.fusion, layers.encoder_film.as_ref(), embedded, state);
    for layer in &layers.encoder {
        f = graph.dense(f, layer, true);
    }
    let z = graph.dense(f, &layers.to_code, false);
    match &layers.running {
        // Gain: specification 2.10.
        Some((mean, var)) => graph.standardise(z, mean.clone(), var.clone(), 0.5, config.statistics_momentum as f32),
        None => z,
    }
}

/// Adds the decoder; returns the head outputs.
fn decode(graph: &mut Graph, config: &ActionModelConfig, layers: &Layers, code: Slot, state: Option<Slot>) -> Slot {
    let embedded = graph.dense(code, &layers.code, true);
    let mut g = fuse(graph, config.fusion, layers.decoder_film.as_ref(), embedded, state);
    for layer in &layers.decoder {
        g = graph.dense(g, layer, true);
    }
    graph.dense(g, &layers.head, false)
}

/// Puts rows of observations and actions into the inputs of a graph.
fn enter(ws: &mut Workspace, space: &ActionSpace, obs_slot: Option<Slot>, action: Slot, obs: &[f32], actions: &[f32]) {
    if let Some(slot) = obs_slot {
        ws.value_mut(slot)[..obs.len()].copy_from_slice(obs);
    }
    let rows = actions.chunks_exact(space.slots());
    for (a, x) in rows.zip(ws.value_mut(action).chunks_exact_mut(space.input_width())) {
        space.encode(a, x);
    }
}

/// Sum of `(z_e - V[k])²` over the rows of `ws`; sets the gradient `2 λ (z_e - V[k]) / (batch D)` of the positions, and adds
/// that of a learned table, which lies at `learned`.
#[inline(always)]
fn commit(
    ws: &mut Workspace,
    positions: Slot,
    table: &[f32],
    d: usize,
    lambda: f32,
    batch: usize,
    learned: Option<usize>,
) -> f32 {
    let each = 2.0 / (batch * d) as f32;
    let (codes, z, pull, gradient) = ws.code_loss(positions);
    let mut sum = 0.0;
    for ((&code, z), pull) in codes.iter().zip(z.chunks_exact(d)).zip(pull.chunks_exact_mut(d)) {
        let first = code as usize * d;
        let mut row = 0.0;
        for ((z, v), pull) in z.iter().zip(&table[first..first + d]).zip(pull) {
            let error = z - v;
            row += error * error;
            *pull = lambda * each * error;
        }
        sum += row;
        if let Some(start) = learned {
            let to = &mut gradient[start + first..start + first + d];
            for ((z, v), to) in z.iter().zip(&table[first..first + d]).zip(to) {
                *to -= each * (z - v);
            }
        }
    }
    sum
}

impl ActionModel {
    /// A fresh model for observations of `obs_dim` numbers.
    ///
    /// # Errors
    /// [`TrainError::Config`] for fewer than two latents or atoms, a one-hot table with D < K, or a weight or step size out of
    /// range.
    pub fn new(
        config: ActionModelConfig,
        obs_dim: usize,
        space: ActionSpace,
        batch: usize,
        rng: &mut Rng,
    ) -> Result<Self, TrainError> {
        let (k, d) = (config.latents, config.code_dim());
        if !(2..=256).contains(&k) {
            return Err(TrainError::config("action_model.latents", "2 to 256", k));
        }
        if config.codetable == Codetable::OneHot && d < k {
            return Err(TrainError::config(
                "action_model.code_dim",
                &format!("at least {k} (one-hot needs D >= K), or 0"),
                d,
            ));
        }
        if config.hidden == 0 {
            return Err(TrainError::config("action_model.hidden", "at least 1", 0));
        }
        if let ContinuousHead::Categorical { atoms, .. } = config.head
            && atoms < 2
        {
            return Err(TrainError::config("action_model.head.atoms", "at least 2", atoms));
        }
        for (key, value) in [
            ("action_model.commitment", config.commitment),
            ("action_model.continuous_weight", config.continuous_weight),
            ("action_model.two_hot_weight", config.two_hot_weight),
        ] {
            if !(value.is_finite() && value >= 0.0) {
                return Err(TrainError::config(key, "0 or more", value));
            }
        }
        config.adam.validate("action_model.adam")?;
        let mut layout = ParamLayout::new();
        let layers = declare(&config, obs_dim, &space, &mut layout);
        let mut params = Params::init(layout, rng)?;
        if config.codetable == Codetable::Bisection {
            params.with_mut(|p| p[layers.table.clone()].copy_from_slice(&bisection(k, d)));
        }
        let conditioned = config.fusion != Fusion::None;
        let one_hot = config.codetable == Codetable::OneHot;

        let mut graph = Graph::new();
        let (obs, action) = (conditioned.then(|| graph.input(obs_dim)), graph.input(space.input_width()));
        let state = state_branch(&mut graph, &config, &layers, obs);
        let latent = encode(&mut graph, &config, &layers, action, state);
        let quantised = graph.quantise(latent, layers.table.clone(), one_hot);
        let out = decode(&mut graph, &config, &layers, quantised, state);
        let trainable = params.layout().trainable_len();
        let parts = (0..PARTS).map(|_| graph.workspace(part_rows(batch), trainable)).collect();
        let losses = vec![PartLoss::default(); PARTS];
        let packed = graph.packed();
        let training = Training { graph, obs, action, latent, out, packed, parts, losses, codes: Vec::new() };

        let mut graph = Graph::new();
        let (obs, action) = (conditioned.then(|| graph.input(obs_dim)), graph.input(space.input_width()));
        let state = state_branch(&mut graph, &config, &layers, obs);
        let z = encode(&mut graph, &config, &layers, action, state);
        graph.quantise(z, layers.table.clone(), one_hot);
        let parts = (0..PARTS).map(|_| graph.workspace(part_rows(CHUNK), 0)).collect();
        let encoding = Encoding { packed: graph.packed(), parts, graph, obs, action };

        let mut graph = Graph::new();
        let (obs, code) = (conditioned.then(|| graph.input(obs_dim)), graph.input(d));
        let state = state_branch(&mut graph, &config, &layers, obs);
        let out = decode(&mut graph, &config, &layers, code, state);
        let decoding = Decoding { packed: graph.packed(), ws: graph.workspace(CHUNK, 0), graph, obs, code, out };

        let adam = Adam::new(config.adam, params.layout().trainable_len());
        Ok(Self { config, space, obs_dim, layers, params, adam, training, encoding, decoding })
    }

    /// Settings.
    pub fn config(&self) -> &ActionModelConfig {
        &self.config
    }

    /// The action space.
    pub fn space(&self) -> &ActionSpace {
        &self.space
    }

    /// Latent actions K.
    pub fn num_latents(&self) -> usize {
        self.config.latents
    }

    /// One gradient step on `L_rec + λ L_com` (paper eq. 2 as corrected in specification 2.8), plus the embedding loss of a
    /// learned table. `obs` is `B x obs_dim`, `actions` `B x slots`.
    pub fn update(&mut self, obs: &[f32], actions: &[f32]) -> ActionModelMetrics {
        let Self { config, space, obs_dim, layers, params, adam, training: t, .. } = self;
        let (slots, d) = (space.slots(), config.code_dim());
        let batch = actions.len() / slots;
        let rows = split(batch);
        let loss = ReconstructionLoss {
            regression: config.regression,
            continuous_weight: config.continuous_weight as f32,
            two_hot_weight: config.two_hot_weight as f32,
        };
        let (lambda, count) = (config.commitment as f32, Count::of(space, actions));
        let Training { graph, obs: obs_slot, action, latent, out, packed, parts, losses, codes } = t;
        graph.refresh(params, packed, true);
        params.with(|p| {
            let weights = Weights { flat: p, packed };
            each(parts, &rows, |ws, rows| {
                enter(ws, space, *obs_slot, *action, &obs[rows.start * *obs_dim..rows.end * *obs_dim], {
                    &actions[rows.start * slots..rows.end * slots]
                });
            });
            graph.forward_parts(weights, parts, &rows);
            let table = &p[layers.table.clone()];
            let [ws_a, ws_b] = &mut parts[..] else { unreachable!("two parts") };
            let [loss_a, loss_b] = &mut losses[..] else { unreachable!("two parts") };
            each(&mut [(ws_a, loss_a), (ws_b, loss_b)], &rows, |(ws, sums), rows| {
                let (value, grad) = ws.value_and_grad(*out, *out);
                let actions = &actions[rows.start * slots..rows.end * slots];
                sums.reconstruction = vectorised!(loss.evaluate_part(space, value, actions, grad, count));
                let learned = (config.codetable == Codetable::Learned).then_some(layers.table.start);
                sums.commitment = vectorised!(commit(ws, *latent, table, d, lambda, batch, learned));
            });
            graph.backward_parts(weights, parts, &rows);
        });
        let used = if rows[1].is_empty() { 1 } else { PARTS };
        codes.clear();
        let mut metrics = ActionModelMetrics::default();
        for (ws, sums) in parts.iter().zip(&*losses).take(used) {
            codes.extend_from_slice(ws.codes());
            let (r, part) = (&mut metrics.reconstruction, sums.reconstruction);
            r.continuous += part.continuous;
            r.types += part.types;
            r.two_hot += part.two_hot;
            metrics.commitment += sums.commitment / (batch * d) as f32;
        }
        let r = metrics.reconstruction;
        metrics.loss = loss.continuous_weight * r.continuous
            + r.types
            + loss.two_hot_weight * r.two_hot
            + lambda * metrics.commitment;
        let [a, b] = &mut parts[..] else { unreachable!("two parts") };
        metrics.grad_norm = params.with_mut(|p| {
            let norm = adam.step(p, &mut [a.gradient_mut(), b.gradient_mut()][..used]);
            graph.update_running_statistics(p, a, batch);
            norm
        });
        metrics
    }

    /// Latents assigned in the last [`update`](Self::update).
    pub fn training_codes(&self) -> &[u32] {
        &self.training.codes
    }

    /// Latent of each action (latent action remapping): `argmin_k ‖e(s, a) - V[k]‖`, with running statistics.
    pub fn encode(&mut self, obs: &[f32], actions: &[f32], codes: &mut Vec<u32>) {
        let Self { space, params, encoding: e, obs_dim, .. } = self;
        let slots = space.slots();
        let Encoding { graph, obs: obs_slot, action, packed, parts } = e;
        graph.refresh(params, packed, false);
        codes.resize(actions.len() / slots, 0);
        let chunks = actions.chunks(CHUNK * slots).zip(obs.chunks(CHUNK * *obs_dim));
        for ((actions, obs), codes) in chunks.zip(codes.chunks_mut(CHUNK)) {
            let rows = split(codes.len());
            let (first, second) = codes.split_at_mut(rows[0].len());
            let [a, b] = &mut parts[..] else { unreachable!("two parts") };
            params.with(|p| {
                let weights = Weights { flat: p, packed };
                each(&mut [(a, first), (b, second)], &rows, |(ws, codes), rows| {
                    enter(ws, space, *obs_slot, *action, &obs[rows.start * *obs_dim..rows.end * *obs_dim], {
                        &actions[rows.start * slots..rows.end * slots]
                    });
                    graph.forward(weights, ws, rows.len(), false);
                    codes.copy_from_slice(ws.codes());
                });
            });
        }
    }

    /// Puts the latent `chosen` in the place of the one in `codes` where it decodes at least as near to the action, without
    /// snapping. Decodes only the rows in which the two differ.
    pub fn keep_nearer(&mut self, obs: &[f32], actions: &[f32], chosen: &[u32], codes: &mut [u32]) {
        let (slots, width) = (self.space.slots(), self.obs_dim);
        let differ: Vec<usize> = (0..codes.len()).filter(|&i| codes[i] != chosen[i]).collect();
        let states: Vec<f32> = differ.iter().flat_map(|&i| &obs[i * width..(i + 1) * width]).copied().collect();
        let distances = |model: &mut Self, latents: Vec<u32>| -> Vec<f32> {
            let mut decoded = vec![0.0; latents.len() * slots];
            model.decode(&states, &latents, &mut decoded, false);
            let rows = differ.iter().zip(decoded.chunks_exact(slots));
            rows.map(|(&i, other)| model.space.distance(&actions[i * slots..(i + 1) * slots], other)).collect()
        };
        let near = distances(self, differ.iter().map(|&i| chosen[i]).collect());
        let encoded = distances(self, differ.iter().map(|&i| codes[i]).collect());
        for ((&i, near), encoded) in differ.iter().zip(near).zip(encoded) {
            if near <= encoded {
                codes[i] = chosen[i];
            }
        }
    }

    /// Decodes latents into actions (`B x slots`, normalised). `snap` switches the snap rule on.
    pub fn decode(&mut self, obs: &[f32], codes: &[u32], actions: &mut [f32], snap: bool) {
        let slots = self.space.slots();
        let mut done = 0;
        for (codes, obs) in codes.chunks(CHUNK).zip(obs.chunks(CHUNK * self.obs_dim)) {
            self.decode_outputs(obs, codes);
            let outputs = self.decoding.ws.value(self.decoding.out);
            let rows = outputs.chunks_exact(self.space.output_width()).take(codes.len());
            for (o, a) in rows.zip(actions[done * slots..].chunks_exact_mut(slots)) {
                self.space.decode(o, a, snap);
            }
            done += codes.len();
        }
    }

    fn decode_outputs(&mut self, obs: &[f32], codes: &[u32]) {
        let Self { params, decoding: d, layers, config, .. } = self;
        let width = config.code_dim();
        d.graph.refresh(params, &mut d.packed, false);
        if let Some(slot) = d.obs {
            d.ws.value_mut(slot)[..obs.len()].copy_from_slice(obs);
        }
        params.with(|p| {
            let table = &p[layers.table.clone()];
            for (&code, row) in codes.iter().zip(d.ws.value_mut(d.code).chunks_exact_mut(width)) {
                row.copy_from_slice(&table[code as usize * width..(code as usize + 1) * width]);
            }
            d.graph.forward(Weights { flat: p, packed: &d.packed }, &mut d.ws, codes.len(), false);
        });
    }
}

pub mod fold;

#[cfg(test)]
mod tests;
