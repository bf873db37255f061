//! Q-values that are the mean of one group of outputs per action slot: for products of bins that are too many to list
//! (Seyde et al. 2023, eq. 6).

use std::ops::Range;

use gadm_envs::EnvSpec;
use gadm_runtime::space::ActionHead;
use rand::RngExt as _;

use super::config::DqnManualConfig;
use crate::action_space::{ActionSpace, ContinuousHead};
use crate::algo::dqn::TargetUpdate;
use crate::algo::learner::{Actor, Explorer, Learner, Report};
use crate::config::EpsilonConfig;
use crate::error::TrainError;
use crate::metrics::keys;
use crate::nn::parallel::{PARTS, each, part_rows, split};
use crate::nn::stack::widths;
use crate::nn::{Adam, Graph, Net, ParamLayout, Params, Slot, Stack, Workspace, argmax};
use crate::replay::RlBatch;
use crate::runner::agent::MAX_ROWS;
use crate::seed::{Rng, SeedTree};

struct Part {
    ws: Workspace,
    next: Workspace,
    sums: [f32; 2],
    targets: Vec<f32>,
}

/// Double DQN with one group of outputs per slot.
pub struct Decoupled {
    space: ActionSpace,
    obs_dim: usize,
    epsilon: EpsilonConfig,
    update: TargetUpdate,
    /// Bins of the continuous slots.
    values: Vec<f32>,
    /// Outputs of each slot.
    groups: Vec<Range<usize>>,
    pub(super) net: Net,
    obs: Slot,
    q: Slot,
    parts: Vec<Part>,
}

impl Decoupled {
    /// Fresh networks; `values` are the bins.
    ///
    /// # Errors
    /// [`TrainError::Config`] for impossible settings.
    pub fn new(
        config: &DqnManualConfig,
        values: Vec<f32>,
        spec: &EnvSpec,
        seeds: SeedTree,
    ) -> Result<Self, TrainError> {
        config.validate()?;
        let space = ActionSpace::new(spec, ContinuousHead::Tanh, true);
        let obs_dim = spec.obs_dim();
        let groups: Vec<_> = space
            .heads()
            .iter()
            .scan(0, |at, head| {
                let n = match head {
                    ActionHead::Discrete { n } => usize::from(*n),
                    ActionHead::Binary => 2,
                    ActionHead::Continuous { .. } => values.len(),
                };
                *at += n;
                Some(*at - n..*at)
            })
            .collect();
        let outputs = groups.last().map_or(0, |g| g.end);
        let mut layout = ParamLayout::new();
        let stack = Stack::declare(&mut layout, "q", &widths(obs_dim, &config.dqn.hidden, outputs));
        let mut graph = Graph::new();
        let obs = graph.input(obs_dim);
        let q = stack.build(&mut graph, obs, false);
        let net = Net::new(graph, Params::init(layout, &mut seeds.stream("init.q"))?, config.dqn.adam)?;
        let rows = part_rows(config.schedule.batch.max(MAX_ROWS));
        let part = |_| Part {
            ws: net.workspace(rows),
            next: net.graph.workspace(rows, 0),
            sums: [0.0; 2],
            targets: vec![0.0; rows],
        };
        let parts = (0..PARTS).map(part).collect();
        let (epsilon, update) = (config.epsilon, config.dqn.target);
        Ok(Self { space, obs_dim, epsilon, update, values, groups, net, obs, q, parts })
    }

    /// Targets `y` of the last update, `B`.
    pub fn targets(&self, batch: usize) -> Vec<f32> {
        let rows = split(batch);
        self.parts.iter().zip(&rows).flat_map(|(part, rows)| part.targets[..rows.len()].to_vec()).collect()
    }

    /// The action of one choice per slot; arguments without effect are 0.
    fn write(&self, choice: impl Fn(usize) -> usize, action: &mut [f32]) {
        for slot in 0..action.len() {
            action[slot] = match self.space.heads()[slot] {
                ActionHead::Continuous { .. } if self.space.counts(action, slot) => self.values[choice(slot)],
                ActionHead::Continuous { .. } => 0.0,
                _ => choice(slot) as f32,
            };
        }
    }
}

/// The output of `slot` that stands for `value`: the type, the switch, or the nearest bin.
fn output(head: ActionHead, value: f32, values: &[f32]) -> usize {
    if !matches!(head, ActionHead::Continuous { .. }) {
        return value as usize;
    }
    let distance = |v: &f32| (v - value).abs();
    values.iter().enumerate().min_by(|a, b| distance(a.1).total_cmp(&distance(b.1))).map_or(0, |(i, _)| i)
}

impl Actor for Decoupled {
    fn space(&self) -> &ActionSpace {
        &self.space
    }

    fn choices(&self) -> usize {
        0
    }

    fn act(&mut self, obs: &[f32], batch: usize, chosen: &mut Vec<u32>, actions: &mut [f32]) {
        chosen.clear();
        self.net.refresh(false);
        let (o, a, q) = (self.obs_dim, self.space.slots(), self.groups.last().map_or(0, |g| g.end));
        let rows = self.parts[0].targets.len();
        for (obs, actions) in obs[..batch * o].chunks(rows * o).zip(actions.chunks_mut(rows * a)) {
            let Part { next: ws, .. } = &mut self.parts[0];
            ws.value_mut(self.obs)[..obs.len()].copy_from_slice(obs);
            self.net.with(|weights, _| self.net.graph.forward(weights, ws, obs.len() / o, false));
            let values = self.parts[0].next.value(self.q);
            for (row, action) in values.chunks_exact(q).zip(actions.chunks_exact_mut(a)) {
                self.write(|slot| argmax(&row[self.groups[slot].clone()]), action);
            }
        }
    }
}

impl Learner for Decoupled {
    fn explore(&mut self, obs: &[f32], batch: usize, by: Explorer, chosen: &mut Vec<u32>, actions: &mut [f32]) {
        self.act(obs, batch, chosen, actions);
        let epsilon = self.epsilon.at(by.env_steps);
        for action in actions.chunks_exact_mut(self.space.slots()) {
            if by.choose.random_bool(epsilon) {
                let choices: Vec<_> = self.groups.iter().map(|g| by.choose.random_range(0..g.len())).collect();
                self.write(|slot| choices[slot], action);
            }
        }
    }

    fn random(&mut self, _batch: usize, rng: &mut Rng, _chosen: &mut Vec<u32>, actions: &mut [f32]) {
        for action in actions.chunks_exact_mut(self.space.slots()) {
            let choices: Vec<_> = self.groups.iter().map(|g| rng.random_range(0..g.len())).collect();
            self.write(|slot| choices[slot], action);
        }
    }

    /// `Q(s, a) = mean_d Q_d(s, a_d)`; target `y = R + γ^m (1 - done) mean_d Q̄_d(s', argmax Q_d(s', ·))`; loss
    /// `mean (Q(s, a) - y)²`. Source: Seyde et al. 2023, eq. 6 and 7.
    fn update(&mut self, batch: &RlBatch, _noise: &mut Rng, report: &mut Report) {
        let n = batch.returns.len();
        let rows = split(n);
        self.net.refresh(true);
        let Self { net, parts, groups, space, values, obs_dim, obs, q, .. } = self;
        let (o, a, outputs) = (*obs_dim, space.slots(), groups.last().map_or(0, |g| g.end));
        let (input, q, share) = (*obs, *q, 1.0 / a as f32);
        net.with(|online, target| {
            each(parts, &rows, |Part { ws, next, sums, targets }, rows| {
                let m = rows.len();
                let numbers = rows.start * o..rows.end * o;
                next.value_mut(input)[..m * o].copy_from_slice(&batch.next_obs[numbers.clone()]);
                net.graph.forward(online, next, m, false);
                let best: Vec<usize> = (0..m)
                    .flat_map(|b| {
                        let row = &next.value(q)[b * outputs..(b + 1) * outputs];
                        groups.iter().map(|g| g.start + argmax(&row[g.clone()]))
                    })
                    .collect();
                net.graph.forward(target, next, m, false);
                for (b, y) in rows.clone().zip(targets.iter_mut()) {
                    let row = &next.value(q)[(b - rows.start) * outputs..];
                    let value: f32 = best[(b - rows.start) * a..][..a].iter().map(|&i| row[i]).sum();
                    *y = batch.returns[b] + batch.bootstrap[b] * share * value;
                }
                ws.value_mut(input)[..m * o].copy_from_slice(&batch.obs[numbers]);
                net.graph.forward(online, ws, m, true);
                *sums = [0.0; 2];
                let (all, grads) = ws.value_and_grad(q, q);
                let per_row = all.chunks_exact(outputs).zip(grads.chunks_exact_mut(outputs));
                for ((b, (row, grad)), y) in rows.zip(per_row).zip(&*targets) {
                    let action = &batch.actions[b * a..(b + 1) * a];
                    let taken = || {
                        let slots = space.heads().iter().zip(action).zip(groups.iter());
                        slots.map(|((head, &value), g)| g.start + output(*head, value, values))
                    };
                    let value = share * taken().map(|i| row[i]).sum::<f32>();
                    let error = value - y;
                    sums[0] += error * error / n as f32;
                    sums[1] += value / n as f32;
                    grad.fill(0.0);
                    taken().for_each(|i| grad[i] = 2.0 * error * share / n as f32);
                }
                net.graph.backward(online, ws);
            });
        });
        let [first, second] = &mut parts[..] else { unreachable!("two parts") };
        let one = rows[1].is_empty();
        let sum = |i: usize| first.sums[i] + if one { 0.0 } else { second.sums[i] };
        report.clear();
        report.extend([(keys::Q_LOSS, sum(0)), (keys::Q_MEAN, sum(1))]);
        report.push((keys::GRAD_NORM, net.step(&mut first.ws, (!one).then_some(&mut second.ws))));
        self.update.apply(&mut net.target, &net.params, net.adam.steps);
    }

    fn epsilon(&self, env_steps: u64) -> Option<f64> {
        Some(self.epsilon.at(env_steps))
    }

    fn networks(&mut self) -> Vec<(&'static str, &mut Params)> {
        vec![("q", &mut self.net.params), ("q-target", &mut self.net.target)]
    }

    fn optimisers(&mut self) -> Vec<(&'static str, &mut Adam)> {
        vec![("q", &mut self.net.adam)]
    }

    fn actor(&mut self) -> &mut dyn Actor {
        self
    }
}
