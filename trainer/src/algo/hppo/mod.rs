//! HPPO: proximal policy optimisation with a type and its arguments, each with its own clipped ratio (Fan et al. 2019; Schulman et
//! al. 2017; specification 7.4).

mod config;
pub mod loss;
pub mod rollout;

pub use config::HppoConfig;

use gadm_envs::EnvSpec;
use rand::RngExt as _;

use super::learner::{Actor, Explorer, Learner, Observed, Report};
use super::pdqn::Types;
use crate::action_space::{ActionSpace, ContinuousHead};
use crate::error::TrainError;
use crate::metrics::keys;
use crate::nn::parallel::{PARTS, each, part_rows, split};
use crate::nn::{Adam, Graph, Init, Net, ParamLayout, Params, Slot, Stack, Workspace, argmax, normal};
use crate::replay::RlBatch;
use crate::runner::agent::MAX_ROWS;
use crate::seed::{Rng, SeedTree};
use loss::{Old, log_density, log_softmax};
use rollout::{Rollout, Running};

struct Part {
    ws: Workspace,
    sums: loss::Parts,
}

/// Encoder with heads for types, arguments and value.
pub struct Hppo {
    config: HppoConfig,
    space: ActionSpace,
    types: Types,
    obs_dim: usize,
    net: Net,
    /// Mean, variance and count of the returns; with the networks, so that a checkpoint holds them.
    scale: Params,
    obs: Slot,
    logits: Slot,
    z: Slot,
    value: Slot,
    parts: Vec<Part>,
    rows: usize,
    /// Steps of the running round.
    pub rollout: Rollout,
}

/// Targets of one pass over a rollout.
#[derive(Clone, Debug, Default)]
pub struct Pass {
    /// Advantages, `N`.
    pub advantages: Vec<f32>,
    /// Returns in units of the running deviation, `N`.
    pub returns: Vec<f32>,
    /// Values at the start of the pass, in the same units, `N`.
    pub values: Vec<f32>,
}

impl Hppo {
    /// Fresh networks for an environment.
    ///
    /// # Errors
    /// [`TrainError::Config`] for impossible settings or an environment without types or arguments.
    pub fn new(config: &HppoConfig, spec: &EnvSpec, seeds: SeedTree) -> Result<Self, TrainError> {
        config.validate()?;
        let types = Types::new(spec, "hppo", config.limit)?;
        let space = ActionSpace::new(spec, ContinuousHead::Tanh, true);
        let obs_dim = spec.obs_dim();
        let width = config.hidden.last().copied().unwrap_or(obs_dim);
        let mut layout = ParamLayout::new();
        let encoder = Stack::declare(&mut layout, "encoder", &[&[obs_dim], &config.hidden[..]].concat());
        let heads = [("types", types.len()), ("arguments", types.arguments()), ("value", 1)]
            .map(|(name, outputs)| Stack::declare(&mut layout, name, &[width, width, outputs]));
        let mut graph = Graph::new();
        let obs = graph.input(obs_dim);
        let encoded = encoder.build(&mut graph, obs, true);
        let [logits, z, value] = heads.map(|head| head.build(&mut graph, encoded, false));
        let net = Net::new(graph, Params::init(layout, &mut seeds.stream("init.policy"))?, config.adam)?;
        let mut layout = ParamLayout::new();
        layout.buffer("returns", &[3], Init::Zero);
        let mut scale = Params::init(layout, &mut seeds.stream("init.scale"))?;
        let Running { mean, variance, count } = Running::START;
        scale.with_mut(|s| s.copy_from_slice(&[mean, variance, count]));
        let rows = part_rows(config.batch.max(MAX_ROWS));
        let parts = (0..PARTS).map(|_| Part { ws: net.workspace(rows), sums: [0.0; 3] }).collect();
        let rollout = Rollout { envs: config.envs, ..Rollout::default() };
        Ok(Self {
            config: config.clone(),
            space,
            types,
            obs_dim,
            net,
            scale,
            obs,
            logits,
            z,
            value,
            parts,
            rows,
            rollout,
        })
    }

    /// Types and the arguments that each uses.
    pub fn types(&self) -> &Types {
        &self.types
    }

    fn running(&self) -> Running {
        self.scale.with(|s| Running { mean: s[0], variance: s[1], count: s[2] })
    }

    /// Log-probabilities of all types, means of the arguments and values of any number of observations.
    fn outputs(&mut self, obs: &[f32]) -> [Vec<f32>; 3] {
        self.net.refresh(false);
        let Self { net, parts, obs_dim, types, rows, .. } = self;
        let (o, k, a, ws) = (*obs_dim, types.len(), types.arguments(), &mut parts[0].ws);
        let mut out = [Vec::new(), Vec::new(), Vec::new()];
        for obs in obs.chunks(*rows * o) {
            let m = obs.len() / o;
            ws.value_mut(self.obs)[..obs.len()].copy_from_slice(obs);
            net.with(|weights, _| net.graph.forward(weights, ws, m, false));
            for (out, (slot, width)) in out.iter_mut().zip([(self.logits, k), (self.z, a), (self.value, 1)]) {
                out.extend_from_slice(&ws.value(slot)[..m * width]);
            }
        }
        out[0].chunks_exact_mut(k).for_each(log_softmax);
        out[1].iter_mut().for_each(|z| *z = z.tanh());
        out
    }

    /// Advantages and returns of the rollout with the present values; then the returns join the running statistics.
    pub fn pass(&mut self) -> Pass {
        let obs = std::mem::take(&mut self.rollout.obs);
        let [_, _, values] = self.outputs(&obs);
        self.rollout.obs = obs;
        let next_obs = std::mem::take(&mut self.rollout.next_obs);
        let [_, _, next] = self.outputs(&next_obs);
        self.rollout.next_obs = next_obs;
        let mut running = self.running();
        let deviation = running.deviation();
        let scaled = |v: &[f32]| v.iter().map(|v| v * deviation).collect::<Vec<_>>();
        let (gamma, lambda) = (self.config.gamma as f32, self.config.gae_lambda as f32);
        let whole = scaled(&values);
        let advantages = self.rollout.advantages(&whole, &scaled(&next), gamma, lambda);
        let returns: Vec<f32> = whole.iter().zip(&advantages).map(|(v, a)| v + a).collect();
        running.add(&returns);
        self.scale.with_mut(|s| s.copy_from_slice(&[running.mean, running.variance, running.count]));
        Pass { advantages, returns: returns.iter().map(|r| r / deviation).collect(), values }
    }

    /// One update on the rows `index` of the rollout.
    pub fn update_on(&mut self, pass: &Pass, index: &[usize], report: &mut Report) {
        let n = index.len();
        let mean = index.iter().map(|&i| pass.advantages[i]).sum::<f32>() / n as f32;
        let square = index.iter().map(|&i| (pass.advantages[i] - mean).powi(2)).sum::<f32>();
        let deviation = (square / (n - 1) as f32).sqrt() + 1e-8;
        self.net.refresh(false);
        let rows = split(n);
        let Self { config, net, parts, obs_dim, types, rollout, .. } = self;
        let (o, k, a) = (*obs_dim, types.len(), types.arguments());
        let (input, slots) = (self.obs, [self.logits, self.z, self.value]);
        net.with(|weights, _| {
            each(parts, &rows, |Part { ws, sums }, rows| {
                let index = &index[rows];
                for (to, &i) in ws.value_mut(input).chunks_exact_mut(o).zip(index) {
                    to.copy_from_slice(&rollout.obs[i * o..(i + 1) * o]);
                }
                net.graph.forward(weights, ws, index.len(), true);
                for (slot, width) in slots.into_iter().zip([k, a, 1]) {
                    let (values, grad) = ws.value_and_grad(slot, slot);
                    let numbers = index.len() * width;
                    grad[..numbers].copy_from_slice(&values[..numbers]);
                }
                *sums = [0.0; 3];
                let [mut logits, mut z, mut value] = slots.map(|slot| std::mem::take(ws.grad_vec(slot)));
                for (b, &i) in index.iter().enumerate() {
                    let old = Old {
                        kind: rollout.kinds[i] as usize,
                        x: &rollout.x[i * a..(i + 1) * a],
                        log: rollout.log[i],
                        advantage: (pass.advantages[i] - mean) / deviation,
                        ret: pass.returns[i],
                        value: pass.values[i],
                    };
                    let (logits, z) = (&mut logits[b * k..(b + 1) * k], &mut z[b * a..(b + 1) * a]);
                    let row = loss::row(config, &old, 1.0 / n as f32, logits, z, &mut value[b]);
                    sums.iter_mut().zip(row).for_each(|(s, r)| *s += r);
                }
                for (slot, grad) in slots.into_iter().zip([logits, z, value]) {
                    *ws.grad_vec(slot) = grad;
                }
                net.graph.backward(weights, ws);
            });
        });
        let [first, second] = &mut parts[..] else { unreachable!("two parts") };
        let one = rows[1].is_empty();
        let sum = |i: usize| first.sums[i] + if one { 0.0 } else { second.sums[i] };
        report.clear();
        report.extend([
            (keys::POLICY_LOSS, sum(0)),
            (keys::VALUE_LOSS, sum(1)),
            (keys::POLICY_ENTROPY, sum(2)),
            (keys::GRAD_NORM, 0.0),
        ]);
        report[3].1 = net.step(&mut first.ws, (!one).then_some(&mut second.ws));
    }
}

impl Actor for Hppo {
    fn space(&self) -> &ActionSpace {
        &self.space
    }

    fn choices(&self) -> usize {
        self.types.len()
    }

    /// The most probable type, with the means of the arguments.
    fn act(&mut self, obs: &[f32], batch: usize, chosen: &mut Vec<u32>, actions: &mut [f32]) {
        let [types, means, _] = self.outputs(&obs[..batch * self.obs_dim]);
        chosen.clear();
        chosen.extend(types.chunks_exact(self.types.len()).map(|row| argmax(row) as u32));
        let rows = means.chunks_exact(self.types.arguments()).zip(actions.chunks_exact_mut(self.types.slots));
        for (&k, (x, action)) in chosen.iter().zip(rows) {
            self.types.write(k as usize, x, action);
        }
    }
}

impl Learner for Hppo {
    /// A type and arguments from the policy; what was drawn is kept for the update, what is executed is cut to -1..1.
    fn explore(&mut self, obs: &[f32], batch: usize, by: Explorer, chosen: &mut Vec<u32>, actions: &mut [f32]) {
        let [types, means, _] = self.outputs(&obs[..batch * self.obs_dim]);
        let (k, a, sigma) = (self.types.len(), self.types.arguments(), self.config.sigma as f32);
        chosen.clear();
        let rows = types.chunks_exact(k).zip(means.chunks_exact(a)).zip(actions.chunks_exact_mut(self.types.slots));
        for ((logs, mean), action) in rows {
            let mut left: f32 = by.choose.random_range(0.0..1.0);
            let drawn = logs.iter().position(|log| {
                left -= log.exp();
                left < 0.0
            });
            // Rounding may leave a remainder behind the last type.
            let kind = drawn.unwrap_or_else(|| argmax(logs));
            let x: Vec<f32> = mean.iter().map(|mu| mu + sigma * normal(by.noise)).collect();
            self.rollout.log.push([logs[kind], log_density(&x, mean, sigma)]);
            self.rollout.kinds.push(kind as u32);
            let bounded: Vec<f32> = x.iter().map(|x| x.clamp(-1.0, 1.0)).collect();
            self.types.write(kind, &bounded, action);
            self.rollout.x.extend(x);
            chosen.push(kind as u32);
        }
    }

    fn on_policy(&self) -> bool {
        true
    }

    fn observe(&mut self, step: &Observed) {
        let Rollout { obs, next_obs, rewards, goes_on, ends, .. } = &mut self.rollout;
        obs.extend_from_slice(step.obs);
        next_obs.extend_from_slice(step.next_obs);
        rewards.push(step.reward as f32);
        goes_on.push(!step.terminated);
        ends.push(step.terminated || step.truncated);
    }

    /// `epochs` passes over the round in random order, advantages anew in each.
    fn learn(&mut self, rng: &mut Rng, updated: &mut dyn FnMut(&Report) -> bool) {
        let mut order: Vec<usize> = (0..self.rollout.len()).collect();
        let mut report = Report::new();
        'passes: for _ in 0..self.config.epochs {
            let pass = self.pass();
            // Source: Fisher & Yates, as Durstenfeld 1964 wrote it.
            for i in (1..order.len()).rev() {
                order.swap(i, rng.random_range(0..=i));
            }
            for index in order.chunks_exact(self.config.batch) {
                self.update_on(&pass, index, &mut report);
                if !updated(&report) {
                    break 'passes;
                }
            }
        }
        self.rollout.clear();
    }

    /// Never called: an algorithm that learns from its own steps has no batches of a replay buffer.
    fn update(&mut self, _batch: &RlBatch, _noise: &mut Rng, report: &mut Report) {
        report.clear();
    }

    fn networks(&mut self) -> Vec<(&'static str, &mut Params)> {
        vec![("policy", &mut self.net.params), ("scale", &mut self.scale)]
    }

    fn optimisers(&mut self) -> Vec<(&'static str, &mut Adam)> {
        vec![("policy", &mut self.net.adam)]
    }

    fn actor(&mut self) -> &mut dyn Actor {
        self
    }
}

#[cfg(test)]
mod tests;
