//! PDQN and MPDQN: a Q-value for every type, at arguments that a second network proposes (Xiong et al. 2018; Bester et al. 2019;
//! specification 7.3).

mod config;
mod passes;
mod types;

pub use config::{MpdqnConfig, PdqnConfig};
pub use types::Types;

use gadm_envs::EnvSpec;
use rand::RngExt as _;

use super::dqn::head::{Derived, HeadScratch, Heads};
use super::learner::{Actor, Explorer, Learner, Report};
use crate::action_space::{ActionSpace, ContinuousHead};
use crate::error::TrainError;
use crate::metrics::keys;
use crate::nn::parallel::{PARTS, each, part_rows, split};
use crate::nn::{
    Adam, Graph, Init, Net, Packed, ParamLayout, Params, Slot, Stack, Weights, Workspace, declare_dense, normal,
};
use crate::replay::RlBatch;
use crate::runner::agent::MAX_ROWS;
use crate::seed::{Rng, SeedTree};
use passes::{Passes, Scratch};

struct Part {
    q: Workspace,
    next: Workspace,
    encoder: Workspace,
    x: Workspace,
    heads: HeadScratch,
    scratch: Scratch,
    values: Vec<f32>,
    next_values: Vec<f32>,
    best: Vec<u32>,
    targets: Vec<f32>,
    sums: [f32; 3],
}

/// Inputs and outputs of the graphs.
struct Slots {
    obs: Slot,
    arguments: Slot,
    advantage: Slot,
    value: Slot,
    encoder_obs: Slot,
    encoded: Slot,
    x_in: Slot,
    z: Slot,
}

/// Q-network with its encoder, argument network, optimisers.
pub struct Pdqn {
    config: PdqnConfig,
    space: ActionSpace,
    types: Types,
    /// Which arguments a pass sees: those of its type (MPDQN) or all of them (PDQN).
    seen: Vec<bool>,
    absent: f32,
    obs_dim: usize,
    q: Net,
    x: Net,
    /// The encoder alone, on the parameters of the Q-network.
    encoder: (Graph, Packed),
    heads: Heads,
    derived: [Derived; 2],
    passes: Passes,
    slots: Slots,
    parts: Vec<Part>,
    codes: Vec<u32>,
}

/// What a pass sees of the arguments `x` of type `k`.
fn seen_arguments(seen: &[bool], absent: f32, k: usize, x: &[f32], to: &mut [f32]) {
    for ((to, &x), &used) in to.iter_mut().zip(x).zip(&seen[k * x.len()..]) {
        *to = if used { x } else { absent };
    }
}

impl Pdqn {
    /// PDQN for an environment.
    ///
    /// # Errors
    /// [`TrainError::Config`] for impossible settings or an environment without types or arguments.
    pub fn single_pass(config: &PdqnConfig, spec: &EnvSpec, seeds: SeedTree) -> Result<Self, TrainError> {
        config.validate("pdqn")?;
        let types = Types::new(spec, "pdqn", config.limit)?;
        let seen = vec![true; types.uses.len()];
        Self::new(config, types, seen, 0.0, spec, seeds)
    }

    /// MPDQN for an environment.
    ///
    /// # Errors
    /// As [`single_pass`](Self::single_pass).
    pub fn multi_pass(config: &MpdqnConfig, spec: &EnvSpec, seeds: SeedTree) -> Result<Self, TrainError> {
        config.validate()?;
        let types = Types::new(spec, "mpdqn", config.pdqn.limit)?;
        let seen = types.uses.clone();
        Self::new(&config.pdqn, types, seen, config.absent as f32, spec, seeds)
    }

    fn new(
        config: &PdqnConfig,
        types: Types,
        seen: Vec<bool>,
        absent: f32,
        spec: &EnvSpec,
        seeds: SeedTree,
    ) -> Result<Self, TrainError> {
        let space = ActionSpace::new(spec, ContinuousHead::Tanh, true);
        let (obs_dim, arguments) = (spec.obs_dim(), types.arguments());
        let mut layout = ParamLayout::new();
        let stack = Stack::declare(&mut layout, "encoder", &[&[obs_dim], &config.hidden[..]].concat());
        let width = config.hidden.last().copied().unwrap_or(obs_dim);
        let both = width + arguments;
        let stream = |layout: &mut ParamLayout, name| declare_dense(layout, name, both, both, Init::torch(both));
        let (advantage, value) = (stream(&mut layout, "advantage.hidden"), stream(&mut layout, "value.hidden"));
        let heads = Heads::declare(&mut layout, types.len(), 1, both, true);
        let (mut graph, mut alone) = (Graph::new(), Graph::new());
        let (obs, x) = (graph.input(obs_dim), graph.input(arguments));
        let encoded = stack.build(&mut graph, obs, true);
        let pair = graph.concat(encoded, x);
        let (advantage, value) = (graph.dense(pair, &advantage, true), graph.dense(pair, &value, true));
        let encoder_obs = alone.input(obs_dim);
        let encoded = stack.build(&mut alone, encoder_obs, true);
        let q = Net::new(graph, Params::init(layout, &mut seeds.stream("init.q"))?, config.q_adam)?;

        let mut layout = ParamLayout::new();
        let stack = Stack::declare(&mut layout, "x", &[width, width, arguments]);
        let mut graph = Graph::new();
        let x_in = graph.input(width);
        let z = stack.build(&mut graph, x_in, false);
        let x_net = Net::new(graph, Params::init(layout, &mut seeds.stream("init.x"))?, config.x_adam)?;

        let rows = part_rows(config.schedule.batch.max(MAX_ROWS));
        let part = |_| Part {
            q: q.workspace(rows),
            next: q.graph.workspace(rows, 0),
            encoder: alone.workspace(rows, 0),
            x: x_net.workspace(rows),
            heads: heads.scratch(rows),
            scratch: Scratch::default(),
            values: vec![0.0; rows],
            next_values: vec![0.0; rows],
            best: vec![0; rows],
            targets: vec![0.0; rows],
            sums: [0.0; 3],
        };
        let parts = (0..PARTS).map(part).collect();
        let packed = alone.packed();
        Ok(Self {
            config: config.clone(),
            space,
            types,
            seen,
            absent,
            obs_dim,
            q,
            x: x_net,
            encoder: (alone, packed),
            heads,
            derived: Default::default(),
            passes: Passes::default(),
            slots: Slots { obs, arguments: x, advantage, value, encoder_obs, encoded, x_in, z },
            parts,
            codes: Vec::new(),
        })
    }

    /// Types and the arguments that each uses.
    pub fn types(&self) -> &Types {
        &self.types
    }

    /// Targets `y` of the last update of the Q-network, `B`.
    pub fn targets(&self, batch: usize) -> Vec<f32> {
        let rows = split(batch);
        self.parts.iter().zip(&rows).flat_map(|(part, rows)| part.targets[..rows.len()].to_vec()).collect()
    }

    fn refresh(&mut self) {
        self.q.refresh(true);
        self.x.refresh(false);
        let width = self.config.hidden.last().copied().unwrap_or(self.obs_dim);
        self.encoder.0.refresh(&self.q.params, &mut self.encoder.1, false);
        self.passes.refresh(&self.q.params, width, self.types.arguments());
        self.heads.refresh(&self.q.params, &mut self.derived[0]);
        self.heads.refresh(&self.q.target, &mut self.derived[1]);
    }

    /// One update of the Q-network. The target's type is the best of the online network at the arguments `x(s')`:
    /// `y = R + γ^m (1 - done) Q̄(s', x̃_k*)_k*`; loss `mean (Q(s, x̃_k)_k - y)²` at the stored type and arguments.
    pub fn update_q(&mut self, batch: &RlBatch, report: &mut Report) {
        let n = batch.returns.len();
        let rows = split(n);
        self.refresh();
        self.codes.clear();
        self.codes.extend(batch.actions.chunks_exact(self.types.slots).map(|action| self.types.of(action) as u32));
        let Self { types, seen, absent, obs_dim, q, x, encoder, heads, derived, passes, slots, parts, codes, .. } =
            self;
        let (o, a, width) = (*obs_dim, types.arguments(), types.slots);
        q.with(|online, target| {
            x.with(|proposal, _| {
                each(parts, &rows, |part, rows| {
                    let m = rows.len();
                    let numbers = rows.start * o..rows.end * o;
                    let next_obs = &batch.next_obs[numbers.clone()];
                    let alone = Weights { flat: online.flat, packed: &encoder.1 };
                    propose(&encoder.0, alone, x, proposal, slots, part, next_obs, o, false);
                    let Part { next, encoder: enc, x: proposed, heads: scratch, scratch: row, best, .. } = part;
                    next.value_mut(slots.obs)[..m * o].copy_from_slice(next_obs);
                    let e_width = enc.value(slots.encoded).len() / part.targets.len();
                    for (b, best) in best[..m].iter_mut().enumerate() {
                        let e = &enc.value(slots.encoded)[b * e_width..(b + 1) * e_width];
                        let x = &proposed.value(slots.z)[b * a..(b + 1) * a];
                        let mut top = (0, f32::NEG_INFINITY);
                        passes.row(types, seen, *absent, e, x, row, None, |k, q| {
                            if q > top.1 {
                                top = (k, q);
                            }
                        });
                        *best = top.0 as u32;
                        let to = &mut next.value_mut(slots.arguments)[b * a..(b + 1) * a];
                        seen_arguments(seen, *absent, top.0, x, to);
                    }
                    q.graph.forward(target, next, m, false);
                    let (ha, hv) = (next.value(slots.advantage), next.value(slots.value));
                    heads.gather(target.flat, &derived[1], ha, hv, &best[..m], scratch, &mut part.next_values);

                    let ws = &mut part.q;
                    ws.value_mut(slots.obs)[..m * o].copy_from_slice(&batch.obs[numbers]);
                    for (b, i) in rows.clone().enumerate() {
                        let x = &batch.actions[i * width + types.first..(i + 1) * width];
                        let to = &mut ws.value_mut(slots.arguments)[b * a..(b + 1) * a];
                        seen_arguments(seen, *absent, codes[i] as usize, x, to);
                    }
                    q.graph.forward(online, ws, m, true);
                    let codes = &codes[rows.clone()];
                    let (ha, hv) = (ws.value(slots.advantage), ws.value(slots.value));
                    heads.gather(online.flat, &derived[0], ha, hv, codes, scratch, &mut part.values);
                    part.sums = [0.0; 3];
                    for (b, i) in rows.enumerate() {
                        let y = batch.returns[i] + batch.bootstrap[i] * part.next_values[b];
                        let (value, error) = (part.values[b], part.values[b] - y);
                        part.targets[b] = y;
                        part.sums[0] += error * error / n as f32;
                        part.sums[1] += value / n as f32;
                        part.values[b] = 2.0 * error / n as f32;
                    }
                    let layer = ws.outer_layer(slots.advantage, Some(slots.value));
                    heads.backward(online.flat, &derived[0], codes, &part.values, scratch, layer);
                    q.graph.backward(online, ws);
                });
            });
        });
        let [first, second] = &mut parts[..] else { unreachable!("two parts") };
        let one = rows[1].is_empty();
        let sum = |i: usize| first.sums[i] + if one { 0.0 } else { second.sums[i] };
        report.clear();
        report.extend([(keys::Q_LOSS, sum(0)), (keys::Q_MEAN, sum(1))]);
        report.push((keys::GRAD_NORM, q.step(&mut first.q, (!one).then_some(&mut second.q))));
        q.target.approach(&q.params, self.config.tau as f32);
    }

    /// One update of the arguments: loss `-mean_B Σ_k Q(s, x̃_k(s))_k`, whose gradient stops at the encoder.
    pub fn update_x(&mut self, batch: &RlBatch, report: &mut Report) {
        let n = batch.returns.len();
        let rows = split(n);
        self.refresh();
        let Self { types, seen, absent, obs_dim, q, x, encoder, passes, slots, parts, .. } = self;
        let (o, a) = (*obs_dim, types.arguments());
        q.with(|online, _| {
            x.with(|proposal, _| {
                each(parts, &rows, |part, rows| {
                    let m = rows.len();
                    let obs = &batch.obs[rows.start * o..rows.end * o];
                    let alone = Weights { flat: online.flat, packed: &encoder.1 };
                    propose(&encoder.0, alone, x, proposal, slots, part, obs, o, true);
                    let Part { encoder: enc, x: ws, scratch, sums, targets, .. } = part;
                    let e_width = enc.value(slots.encoded).len() / targets.len();
                    *sums = [0.0; 3];
                    let (proposed, dz) = ws.value_and_grad(slots.z, slots.z);
                    for b in 0..m {
                        let e = &enc.value(slots.encoded)[b * e_width..(b + 1) * e_width];
                        let (x, dz) = (&proposed[b * a..(b + 1) * a], &mut dz[b * a..(b + 1) * a]);
                        dz.fill(0.0);
                        let mut total = 0.0;
                        let gradient = Some((&mut *dz, -1.0 / n as f32));
                        passes.row(types, seen, *absent, e, x, scratch, gradient, |_, q| total += q);
                        sums[2] -= total / n as f32;
                        dz.iter_mut().zip(x).for_each(|(dz, x)| *dz *= 1.0 - x * x);
                    }
                    x.graph.backward(proposal, ws);
                });
            });
        });
        let [first, second] = &mut parts[..] else { unreachable!("two parts") };
        let one = rows[1].is_empty();
        let loss = first.sums[2] + if one { 0.0 } else { second.sums[2] };
        x.step(&mut first.x, (!one).then_some(&mut second.x));
        report.clear();
        report.push((keys::POLICY_LOSS, loss));
    }

    /// Best types of up to [`MAX_ROWS`] / 2 observations, with the arguments of each row.
    fn greedy(&mut self, obs: &[f32], chosen: &mut Vec<u32>, arguments: &mut Vec<f32>) {
        self.refresh();
        let Self { types, seen, absent, obs_dim, q, x, encoder, passes, slots, parts, .. } = self;
        let (o, a) = (*obs_dim, types.arguments());
        let part = &mut parts[0];
        q.with(|online, _| {
            x.with(|proposal, _| {
                let alone = Weights { flat: online.flat, packed: &encoder.1 };
                propose(&encoder.0, alone, x, proposal, slots, part, obs, o, false);
            });
        });
        let m = obs.len() / o;
        let e_width = part.encoder.value(slots.encoded).len() / part.targets.len();
        for b in 0..m {
            let e = &part.encoder.value(slots.encoded)[b * e_width..(b + 1) * e_width];
            let x = &part.x.value(slots.z)[b * a..(b + 1) * a];
            let mut top = (0, f32::NEG_INFINITY);
            passes.row(types, seen, *absent, e, x, &mut part.scratch, None, |k, q| {
                if q > top.1 {
                    top = (k, q);
                }
            });
            chosen.push(top.0 as u32);
            arguments.extend_from_slice(x);
        }
    }

    fn decide(&mut self, obs: &[f32], batch: usize, chosen: &mut Vec<u32>) -> Vec<f32> {
        chosen.clear();
        let (o, mut arguments) = (self.obs_dim, Vec::new());
        let rows = self.parts[0].targets.len();
        for obs in obs[..batch * o].chunks(rows * o) {
            self.greedy(obs, chosen, &mut arguments);
        }
        arguments
    }

    fn write(&self, chosen: &[u32], arguments: &[f32], actions: &mut [f32]) {
        let rows = arguments.chunks_exact(self.types.arguments()).zip(actions.chunks_exact_mut(self.types.slots));
        for (&k, (x, action)) in chosen.iter().zip(rows) {
            self.types.write(k as usize, x, action);
        }
    }
}

/// Encodes `obs` and leaves `x(s)`, after its tanh, in place of `z`.
#[expect(clippy::too_many_arguments, reason = "two networks and their memory")]
fn propose(
    encoder: &Graph,
    weights: Weights,
    x: &Net,
    proposal: Weights,
    slots: &Slots,
    part: &mut Part,
    obs: &[f32],
    obs_dim: usize,
    train: bool,
) {
    let m = obs.len() / obs_dim;
    let Part { encoder: ws, x: out, targets, .. } = part;
    ws.value_mut(slots.encoder_obs)[..obs.len()].copy_from_slice(obs);
    encoder.forward(weights, ws, m, false);
    let encoded = ws.value(slots.encoded);
    let width = encoded.len() / targets.len();
    out.value_mut(slots.x_in)[..m * width].copy_from_slice(&encoded[..m * width]);
    x.graph.forward(proposal, out, m, train);
    let z = out.value_mut(slots.z);
    let arguments = z.len() / targets.len();
    z[..m * arguments].iter_mut().for_each(|z| *z = z.tanh());
}

impl Actor for Pdqn {
    fn space(&self) -> &ActionSpace {
        &self.space
    }

    fn choices(&self) -> usize {
        self.types.len()
    }

    fn act(&mut self, obs: &[f32], batch: usize, chosen: &mut Vec<u32>, actions: &mut [f32]) {
        let arguments = self.decide(obs, batch, chosen);
        self.write(chosen, &arguments, actions);
    }
}

impl Learner for Pdqn {
    fn explore(&mut self, obs: &[f32], batch: usize, by: Explorer, chosen: &mut Vec<u32>, actions: &mut [f32]) {
        let mut arguments = self.decide(obs, batch, chosen);
        let (epsilon, k) = (self.config.epsilon.at(by.env_steps), self.types.len() as u32);
        for code in chosen.iter_mut() {
            if by.choose.random_bool(epsilon) {
                *code = by.choose.random_range(0..k);
            }
        }
        for x in &mut arguments {
            *x = (*x + self.config.explore_noise as f32 * normal(by.noise)).clamp(-1.0, 1.0);
        }
        self.write(chosen, &arguments, actions);
    }

    fn update(&mut self, batch: &RlBatch, _noise: &mut Rng, report: &mut Report) {
        let done = self.q.adam.steps + self.x.adam.steps;
        if done % (self.config.q_block + self.config.x_block) < self.config.q_block {
            self.update_q(batch, report);
        } else {
            self.update_x(batch, report);
        }
    }

    fn epsilon(&self, env_steps: u64) -> Option<f64> {
        Some(self.config.epsilon.at(env_steps))
    }

    fn networks(&mut self) -> Vec<(&'static str, &mut Params)> {
        vec![("q", &mut self.q.params), ("q-target", &mut self.q.target), ("x", &mut self.x.params)]
    }

    fn optimisers(&mut self) -> Vec<(&'static str, &mut Adam)> {
        vec![("q", &mut self.q.adam), ("x", &mut self.x.adam)]
    }

    fn actor(&mut self) -> &mut dyn Actor {
        self
    }
}

#[cfg(test)]
mod tests;
