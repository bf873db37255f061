//! Masked double DQN with n-step targets and an ensemble of dueling heads (specification 4.1 to 4.3; paper eq. 5 and 6).

mod config;
mod head;

pub use config::{DqnConfig, TargetUpdate};

use crate::error::TrainError;
use crate::nn::{Adam, DenseParams, Graph, Init, ParamLayout, Params, Slot, Workspace, declare_dense};
use crate::replay::RlBatch;
use crate::seed::Rng;
use head::{Averages, Heads};

/// The largest of the allowed `scores`; ties go to the lowest latent. `allowed` empty means all.
pub fn masked_argmax(scores: &[f32], allowed: &[bool]) -> usize {
    let mut best = None;
    for (k, &s) in scores.iter().enumerate() {
        if (allowed.is_empty() || allowed[k]) && best.is_none_or(|b: usize| s > scores[b]) {
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

/// Q-network, target network and optimiser.
pub struct Dqn {
    config: DqnConfig,
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
    value: Slot,
    ws: Workspace,
    ws_next: Workspace,
    averages: Averages,
    averages_target: Averages,
    averages_fresh: bool,
    grads: Vec<f32>,
    scores: Vec<f32>,
    q: Vec<f32>,
    q_next: Vec<f32>,
    codes_next: Vec<u32>,
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
        let Some(&width) = config.hidden.last().filter(|_| !config.hidden.contains(&0)) else {
            let found = format!("{:?}", config.hidden);
            return Err(TrainError::config("dqn.hidden", "one width or more, each at least 1", found));
        };
        config.adam.validate("dqn.adam")?;
        if let TargetUpdate::Soft { tau } = config.target
            && !(tau > 0.0 && tau <= 1.0)
        {
            return Err(TrainError::config("dqn.target.tau", "above 0 and at most 1", tau));
        }
        if config.heads == 0 {
            return Err(TrainError::config("dqn.heads", "at least 1", 0));
        }
        if !(0.0..=1.0).contains(&config.gamma) {
            return Err(TrainError::config("dqn.gamma", "0 to 1", config.gamma));
        }
        if config.n_step == 0 {
            return Err(TrainError::config("dqn.n_step", "at least 1", 0));
        }
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
        let value = value_stream.map_or(advantage, |v| graph.dense(trunk, &v, true));
        layers.extend(advantage_stream);
        let adam = Adam::new(config.adam, params.layout().trainable_len());
        let (ws, ws_next) = (graph.workspace(batch), graph.workspace(batch));
        let grads = vec![0.0; params.layout().trainable_len()];
        Ok(Self {
            config,
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
            ws,
            ws_next,
            averages: Averages::default(),
            averages_target: Averages::default(),
            averages_fresh: false,
            grads,
            scores: Vec::new(),
            q: Vec::new(),
            q_next: Vec::new(),
            codes_next: Vec::new(),
        })
    }

    /// Settings.
    pub fn config(&self) -> &DqnConfig {
        &self.config
    }

    /// The plain network a device runs: trunk and advantage stream (ReLU after each), then head-averaged weights `K x width`
    /// and biases. The value stream and the mean over latents do not move the argmax.
    pub fn folded(&self) -> (&[DenseParams], Vec<f32>, Vec<f32>) {
        let mut averages = Averages::default();
        self.params.with(|p| self.heads.average(p, &mut averages));
        let (w, b) = Heads::folded(&averages);
        (&self.layers, w, b)
    }

    /// Call after changing parameters from outside (checkpoint).
    pub fn invalidate(&mut self) {
        self.averages_fresh = false;
    }

    /// Head-averaged advantages of `batch` observations, `B x K`.
    pub fn advantages(&mut self, obs: &[f32], batch: usize) -> &[f32] {
        let Self { params, graph, heads, ws_next: ws, averages, averages_fresh, scores, .. } = self;
        ws.value_mut(self.obs)[..obs.len()].copy_from_slice(obs);
        params.with(|p| {
            if !std::mem::replace(averages_fresh, true) {
                heads.average(p, averages);
            }
            graph.forward(p, ws, batch, false);
            heads.scores(averages, ws.value(self.advantage), batch, scores);
        });
        &scores[..batch * self.latents]
    }

    /// One gradient step. `codes` are the (remapped) latents of the batch's actions; `allowed` the masks of its next
    /// observations (`B x K`), empty for none.
    pub fn update(&mut self, batch: &RlBatch, codes: &[u32], allowed: &[bool]) -> DqnMetrics {
        let n = codes.len();
        let (k, e) = (self.latents, self.config.heads);
        self.advantages(&batch.next_obs, n);
        let Self {
            params, target, graph, heads, ws, ws_next, averages, averages_target, grads, scores, q, q_next, ..
        } = self;
        self.codes_next.clear();
        for (b, row) in scores.chunks_exact(k).enumerate() {
            let allowed = if allowed.is_empty() { allowed } else { &allowed[b * k..(b + 1) * k] };
            self.codes_next.push(masked_argmax(row, allowed) as u32);
        }
        target.with(|p| {
            heads.average(p, averages_target);
            graph.forward(p, ws_next, n, false);
            let (ha, hv) = (ws_next.value(self.advantage), ws_next.value(self.value));
            heads.gather(p, averages_target, ha, hv, &self.codes_next, q_next);
        });
        ws.value_mut(self.obs)[..batch.obs.len()].copy_from_slice(&batch.obs);
        grads.fill(0.0);
        let (loss, q_mean) = params.with(|p| {
            graph.forward(p, ws, n, true);
            graph.zero_grad(ws);
            heads.gather(p, averages, ws.value(self.advantage), ws.value(self.value), codes, q);
            let (mut loss, mut q_mean) = (0.0, 0.0);
            // q becomes the gradient 2 (Q - y) / B, in place.
            for (b, (q, q_next)) in q.chunks_exact_mut(e).zip(q_next.chunks_exact(e)).enumerate() {
                let least = q_next.iter().copied().fold(f32::INFINITY, f32::min);
                let y = batch.returns[b] + batch.bootstrap[b] * least;
                for q in q {
                    let error = *q - y;
                    loss += error * error / n as f32;
                    q_mean += *q / (n * e) as f32;
                    *q = 2.0 * error / n as f32;
                }
            }
            let width = ws.value(self.advantage).len();
            let (mut dha, mut dhv) = (vec![0.0; width], vec![0.0; width]);
            let (ha, hv) = (ws.value(self.advantage), ws.value(self.value));
            heads.backward(p, averages, ha, hv, codes, q, grads, &mut dha, &mut dhv);
            ws.grad_mut(self.advantage).copy_from_slice(&dha);
            if self.config.dueling {
                ws.grad_mut(self.value).copy_from_slice(&dhv);
            }
            graph.backward(p, ws, grads);
            (loss, q_mean)
        });
        let grad_norm = params.with_mut(|p| self.adam.step(p, grads));
        self.averages_fresh = false;
        match self.config.target {
            TargetUpdate::Hard { every } if self.adam.steps.is_multiple_of(every.max(1)) => target.copy_from(params),
            TargetUpdate::Hard { .. } => {}
            TargetUpdate::Soft { tau } => target.approach(params, tau as f32),
        }
        DqnMetrics { loss, q_mean, grad_norm }
    }
}

#[cfg(test)]
mod tests;
