//! Masked double DQN with n-step targets and an ensemble of dueling heads (specification 4.1 to 4.3; paper eq. 5 and 6).

mod config;
pub mod head;

pub use config::{DqnConfig, TargetUpdate};

use crate::error::TrainError;
use crate::nn::parallel::{PARTS, each, join, part_rows, split};
use crate::nn::{
    Adam, DenseParams, Graph, Init, Packed, ParamLayout, Params, Slot, Weights, Workspace, argmax, declare_dense,
};
use crate::replay::RlBatch;
use crate::seed::Rng;
use head::{Derived, HeadScratch, Heads};

/// The largest of the allowed `scores`; ties go to the lowest latent. `allowed` empty means all.
pub fn masked_argmax(scores: &[f32], allowed: &[bool]) -> usize {
    if allowed.is_empty() {
        return argmax(scores);
    }
    let mut best = None;
    for (k, &s) in scores.iter().enumerate() {
        if allowed[k] && best.is_none_or(|b: usize| s > scores[b]) {
            best = Some(k);
        }
    }
    best.unwrap_or(0)
}

/// What one update reports.
#[derive(Clone, Copy, Debug, Default)]
pub struct DqnMetrics {
    /// `Σ_e mean_B (Q - y)²`.
    pub loss: f32,
    /// Mean of the gathered Q values.
    pub q_mean: f32,
    /// Gradient norm before clipping.
    pub grad_norm: f32,
}

/// Weights of one network as the products read them.
struct Ready {
    packed: Packed,
    heads: Derived,
}

/// Work memory for some rows of a batch.
struct Part {
    ws: Workspace,
    ws_next: Workspace,
    heads: HeadScratch,
    scores: Vec<f32>,
    q: Vec<f32>,
    q_next: Vec<f32>,
    codes_next: Vec<u32>,
    loss: f32,
    q_mean: f32,
}

/// Q-network, target network and optimiser.
pub struct Dqn {
    config: DqnConfig,
    obs_dim: usize,
    latents: usize,
    layers: Vec<DenseParams>,
    heads: Heads,
    /// Online parameters.
    pub params: Params,
    /// Target parameters.
    pub target: Params,
    /// Optimiser state.
    pub adam: Adam,
    graph: Graph,
    obs: Slot,
    advantage: Slot,
    value: Option<Slot>,
    online: Ready,
    delayed: Ready,
    parts: Vec<Part>,
    scores: Vec<f32>,
}

impl Dqn {
    /// A fresh network for `latents` actions; `batch` is the largest number of rows per call.
    ///
    /// # Errors
    /// [`TrainError::Config`] for an empty trunk or layer, no head, or a discount, target share or step size out of range.
    pub fn new(
        config: DqnConfig,
        obs_dim: usize,
        latents: usize,
        batch: usize,
        rng: &mut Rng,
    ) -> Result<Self, TrainError> {
        Self::build(config, obs_dim, latents, batch, rng, true)
    }

    /// A Q-network without streams: the trunk, then the layer of outputs; `config.dueling` counts as false. The textbook
    /// network (Mnih et al. 2015), for comparison with other programs.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn plain(
        config: DqnConfig,
        obs_dim: usize,
        latents: usize,
        batch: usize,
        rng: &mut Rng,
    ) -> Result<Self, TrainError> {
        Self::build(DqnConfig { dueling: false, ..config }, obs_dim, latents, batch, rng, false)
    }

    fn build(
        config: DqnConfig,
        obs_dim: usize,
        latents: usize,
        batch: usize,
        rng: &mut Rng,
        streams: bool,
    ) -> Result<Self, TrainError> {
        config.validate()?;
        let width = config.hidden.last().copied().unwrap_or(obs_dim);
        let mut layout = ParamLayout::new();
        let mut layers = Vec::new();
        let mut inputs = obs_dim;
        for (i, &hidden) in config.hidden.iter().enumerate() {
            layers.push(declare_dense(&mut layout, &format!("trunk{i}"), inputs, hidden, Init::torch(inputs)));
            inputs = hidden;
        }
        let advantage_stream =
            streams.then(|| declare_dense(&mut layout, "advantage.hidden", width, width, Init::torch(width)));
        let value_stream =
            config.dueling.then(|| declare_dense(&mut layout, "value.hidden", width, width, Init::torch(width)));
        let heads = Heads::declare(&mut layout, latents, config.heads, width, config.dueling);
        let params = Params::init(layout, rng)?;
        let target = params.duplicate()?;
        let mut graph = Graph::new();
        let obs = graph.input(obs_dim);
        let trunk = layers.iter().fold(obs, |x, layer| graph.dense(x, layer, true));
        let advantage = advantage_stream.as_ref().map_or(trunk, |a| graph.dense(trunk, a, true));
        let value = value_stream.map(|v| graph.dense(trunk, &v, true));
        layers.extend(advantage_stream);
        let trainable = params.layout().trainable_len();
        let adam = Adam::new(config.adam, trainable);
        let ready = || Ready { packed: graph.packed(), heads: Derived::default() };
        let part = |_| {
            let rows = part_rows(batch);
            Part {
                ws: graph.workspace(rows, trainable),
                ws_next: graph.workspace(rows, 0),
                heads: heads.scratch(rows),
                scores: vec![0.0; rows * latents],
                q: vec![0.0; rows * config.heads],
                q_next: vec![0.0; rows * config.heads],
                codes_next: Vec::with_capacity(rows),
                loss: 0.0,
                q_mean: 0.0,
            }
        };
        let parts = (0..PARTS).map(part).collect();
        let (online, delayed) = (ready(), ready());
        let scores = vec![0.0; batch * latents];
        Ok(Self {
            config,
            obs_dim,
            latents,
            layers,
            heads,
            params,
            target,
            adam,
            graph,
            obs,
            advantage,
            value,
            online,
            delayed,
            parts,
            scores,
        })
    }

    /// Settings.
    pub fn config(&self) -> &DqnConfig {
        &self.config
    }

    /// The plain network a device runs: trunk and advantage stream (ReLU after each), then head-averaged weights `K x width`
    /// and biases. The value stream and the mean over latents do not move the argmax.
    pub fn folded(&self) -> (&[DenseParams], Vec<f32>, Vec<f32>) {
        let mut derived = Derived::default();
        self.heads.refresh(&self.params, &mut derived);
        let (w, b) = Heads::folded(&derived);
        (&self.layers, w, b)
    }

    /// Head-averaged advantages of `batch` observations, `B x K`.
    pub fn advantages(&mut self, obs: &[f32], batch: usize) -> &[f32] {
        let (mut scores, k) = (std::mem::take(&mut self.scores), self.latents);
        self.read_online(obs, batch, &mut scores[..batch * k], |heads, online, stream, rows, out| {
            heads.scores(&online.heads, stream, rows, out);
        });
        self.scores = scores;
        &self.scores[..batch * k]
    }

    /// Width of the last hidden layer of the [`folded`](Self::folded) network.
    pub fn feature_width(&self) -> usize {
        self.layers.last().map_or(0, |layer| layer.outputs)
    }

    /// Last hidden layer of the [`folded`](Self::folded) network for `batch` observations, `B x width`, after its ReLU, by the
    /// online parameters. What is learned on it leaves the Q-network as it is.
    pub fn features(&mut self, obs: &[f32], batch: usize, out: &mut Vec<f32>) {
        out.resize(batch * self.feature_width(), 0.0);
        self.read_online(obs, batch, out, |_, _, stream, _, out| out.copy_from_slice(&stream[..out.len()]));
    }

    /// Runs the online network on `batch` observations and has `read` make rows of `out` from rows of the advantage stream.
    fn read_online(
        &mut self,
        obs: &[f32],
        batch: usize,
        out: &mut [f32],
        read: impl Fn(&Heads, &Ready, &[f32], usize, &mut [f32]) + Sync,
    ) {
        let Self { params, graph, heads, online, parts, obs_dim, .. } = self;
        online.refresh(graph, heads, params, true);
        let (width, rows) = (*obs_dim, split(batch));
        let (first, second) = out.split_at_mut(rows[0].len() * (out.len() / batch.max(1)));
        let [a, b] = &mut parts[..] else { unreachable!("two parts") };
        params.with(|p| {
            let weights = Weights { flat: p, packed: &online.packed };
            each(&mut [(a, first), (b, second)], &rows, |(part, out), rows| {
                let ws = &mut part.ws_next;
                ws.value_mut(self.obs)[..rows.len() * width]
                    .copy_from_slice(&obs[rows.start * width..rows.end * width]);
                graph.forward(weights, ws, rows.len(), false);
                read(heads, online, ws.value(self.advantage), rows.len(), out);
            });
        });
    }

    /// One gradient step. `codes` are the (remapped) latents of the batch's actions; `allowed` the masks of its next
    /// observations (`B x K`), empty for none.
    pub fn update(&mut self, batch: &RlBatch, codes: &[u32], allowed: &[bool]) -> DqnMetrics {
        let Self { params, target, graph, heads, online, delayed, parts, obs_dim, latents, .. } = self;
        let (n, width, k) = (codes.len(), *obs_dim, *latents);
        let rows = split(n);
        join(|| online.refresh(graph, heads, params, true), || delayed.refresh(graph, heads, target, false));
        params.with(|p| {
            target.with(|t| {
                let weights = Weights { flat: p, packed: &online.packed };
                let target_weights = Weights { flat: t, packed: &delayed.packed };
                each(parts, &rows, |part, rows| {
                    let Part { ws, ws_next, heads: scratch, scores, q, q_next, codes_next, loss, q_mean } = part;
                    let m = rows.len();
                    let numbers = rows.start * width..rows.end * width;
                    ws_next.value_mut(self.obs)[..m * width].copy_from_slice(&batch.next_obs[numbers.clone()]);
                    graph.forward(weights, ws_next, m, false);
                    heads.scores(&online.heads, ws_next.value(self.advantage), m, scores);
                    codes_next.clear();
                    for (b, row) in rows.clone().zip(scores.chunks_exact(k)) {
                        let allowed = if allowed.is_empty() { allowed } else { &allowed[b * k..(b + 1) * k] };
                        codes_next.push(masked_argmax(row, allowed) as u32);
                    }
                    graph.forward(target_weights, ws_next, m, false);
                    let ha = ws_next.value(self.advantage);
                    let hv = self.value.map_or(&[][..], |value| ws_next.value(value));
                    heads.gather(t, &delayed.heads, ha, hv, codes_next, scratch, q_next);

                    ws.value_mut(self.obs)[..m * width].copy_from_slice(&batch.obs[numbers]);
                    graph.forward(weights, ws, m, true);
                    let codes = &codes[rows.clone()];
                    let ha = ws.value(self.advantage);
                    let hv = self.value.map_or(&[][..], |value| ws.value(value));
                    heads.gather(p, &online.heads, ha, hv, codes, scratch, q);
                    (*loss, *q_mean) = squared_error(batch, rows, n, q, q_next, self.config.heads);
                    let layer = ws.outer_layer(self.advantage, self.value);
                    heads.backward(p, &online.heads, codes, q, scratch, layer);
                    graph.backward(weights, ws);
                });
            });
        });
        let used = parts.iter_mut().zip(&rows).filter(|(_, rows)| !rows.is_empty()).map(|(part, _)| part);
        let metrics = used.fold(DqnMetrics::default(), |sum, part| DqnMetrics {
            loss: sum.loss + part.loss,
            q_mean: sum.q_mean + part.q_mean,
            grad_norm: 0.0,
        });
        let [a, b] = &mut parts[..] else { unreachable!("two parts") };
        let mut gradients = [a.ws.gradient_mut(), b.ws.gradient_mut()];
        let gradients = if rows[1].is_empty() { &mut gradients[..1] } else { &mut gradients[..] };
        let grad_norm = params.with_mut(|p| self.adam.step(p, gradients));
        self.config.target.apply(target, params, self.adam.steps);
        DqnMetrics { grad_norm, ..metrics }
    }
}

impl Ready {
    fn refresh(&mut self, graph: &Graph, heads: &Heads, params: &Params, train: bool) {
        graph.refresh(params, &mut self.packed, train);
        heads.refresh(params, &mut self.heads);
    }
}

/// Loss and mean Q of some rows of a batch of `n`, as their share of the batch's mean. `q` (`rows x heads`) becomes the
/// gradient `2 (Q - y) / n`.
fn squared_error(
    batch: &RlBatch,
    rows: std::ops::Range<usize>,
    n: usize,
    q: &mut [f32],
    q_next: &[f32],
    heads: usize,
) -> (f32, f32) {
    let (mut loss, mut q_mean) = (0.0, 0.0);
    for (b, (q, q_next)) in rows.zip(q.chunks_exact_mut(heads).zip(q_next.chunks_exact(heads))) {
        let least = q_next.iter().copied().fold(f32::INFINITY, f32::min);
        let y = batch.returns[b] + batch.bootstrap[b] * least;
        for q in q {
            let error = *q - y;
            loss += error * error;
            q_mean += *q;
            *q = 2.0 * error / n as f32;
        }
    }
    (loss / n as f32, q_mean / (n * heads) as f32)
}

#[cfg(test)]
mod tests;
