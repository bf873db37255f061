//! TD3: twin critics, smoothed target actions, delayed policy (Fujimoto et al. 2018, algorithm 1; specification 7.1).

mod config;

pub use config::Td3Config;

use gadm_envs::EnvSpec;

use super::learner::{Actor, Explorer, Learner, Report};
use crate::action_space::{ActionSpace, ContinuousHead};
use crate::error::TrainError;
use crate::metrics::keys;
use crate::nn::parallel::{PARTS, each, join, part_rows, split};
use crate::nn::stack::widths;
use crate::nn::{Adam, Graph, Net, Packed, ParamLayout, Params, Slot, Stack, Weights, Workspace, normal};
use crate::replay::RlBatch;
use crate::runner::agent::MAX_ROWS;
use crate::seed::{Rng, SeedTree};

/// Work memory for some rows of a batch.
struct Part {
    actor: Workspace,
    critic: Workspace,
    /// Forward passes of the targets.
    next: (Workspace, Workspace),
    first: Workspace,
    /// Numbers of this part's share of the losses: critics, mean Q, policy.
    sums: [f32; 3],
    targets: Vec<f32>,
}

/// Actor, twin critics, their targets and optimisers.
pub struct Td3 {
    config: Td3Config,
    space: ActionSpace,
    obs_dim: usize,
    actor: Net,
    critic: Net,
    /// The first critic alone, whose gradient with respect to the action trains the actor.
    first: (Graph, Packed),
    obs: Slot,
    /// Output of the actor before its tanh.
    z: Slot,
    /// Input of the critics: observation, then action.
    pair: Slot,
    q: [Slot; 2],
    first_pair: Slot,
    first_q: Slot,
    parts: Vec<Part>,
    noise: Vec<f32>,
}

/// Copies rows `[a | b]`.
fn concat(to: &mut [f32], a: &[f32], a_width: usize, b: &[f32], b_width: usize) {
    let rows = a.chunks_exact(a_width).zip(b.chunks_exact(b_width));
    for (to, (a, b)) in to.chunks_exact_mut(a_width + b_width).zip(rows) {
        to[..a_width].copy_from_slice(a);
        to[a_width..].copy_from_slice(b);
    }
}

impl Td3 {
    /// Fresh networks for an environment.
    ///
    /// # Errors
    /// [`TrainError::Config`] for impossible settings, or an environment with discrete actions.
    pub fn new(config: Td3Config, spec: &EnvSpec, seeds: SeedTree) -> Result<Self, TrainError> {
        config.validate()?;
        let space = ActionSpace::new(spec, ContinuousHead::Tanh, true);
        space.all_continuous("td3", spec)?;
        let (obs_dim, slots) = (spec.obs_dim(), space.slots());
        let mut layout = ParamLayout::new();
        let stack = Stack::declare(&mut layout, "actor", &widths(obs_dim, &config.hidden, slots));
        let mut graph = Graph::new();
        let obs = graph.input(obs_dim);
        let z = stack.build(&mut graph, obs, false);
        let params = Params::init(layout, &mut seeds.stream("init.actor"))?;
        let actor = Net::new(graph, params, config.actor_adam)?;

        let mut layout = ParamLayout::new();
        let all = widths(obs_dim + slots, &config.hidden, 1);
        let stacks = ["q1-", "q2-"].map(|name| Stack::declare(&mut layout, name, &all));
        let (mut graph, mut first) = (Graph::new(), Graph::new());
        let pair = graph.input(obs_dim + slots);
        let q = [0, 1].map(|i| stacks[i].build(&mut graph, pair, false));
        let first_pair = first.input_with_gradient(obs_dim + slots);
        let first_q = stacks[0].build(&mut first, first_pair, false);
        let params = Params::init(layout, &mut seeds.stream("init.critics"))?;
        let critic = Net::new(graph, params, config.critic_adam)?;

        let rows = part_rows(config.schedule.batch.max(MAX_ROWS));
        let part = |_| Part {
            actor: actor.workspace(rows),
            critic: critic.workspace(rows),
            next: (actor.graph.workspace(rows, 0), critic.graph.workspace(rows, 0)),
            first: first.workspace(rows, critic.params.layout().trainable_len()),
            sums: [0.0; 3],
            targets: vec![0.0; rows],
        };
        let parts = (0..PARTS).map(part).collect();
        let packed = first.packed();
        Ok(Self {
            config,
            space,
            obs_dim,
            actor,
            critic,
            first: (first, packed),
            obs,
            z,
            pair,
            q,
            first_pair,
            first_q,
            parts,
            noise: Vec::new(),
        })
    }

    /// Settings.
    pub fn config(&self) -> &Td3Config {
        &self.config
    }

    /// Targets `y` of the last update, `B`.
    pub fn targets(&self, batch: usize) -> Vec<f32> {
        let rows = split(batch);
        self.parts.iter().zip(&rows).flat_map(|(part, rows)| part.targets[..rows.len()].to_vec()).collect()
    }

    /// One update with the given standard normal noise (`B x slots`) on the target actions; see [`Learner::update`].
    pub fn update_with(&mut self, batch: &RlBatch, noise: &[f32], report: &mut Report) {
        let n = batch.returns.len();
        let rows = split(n);
        self.update_critics(batch, noise, &rows);
        let mut sums = [0.0; 3];
        let add = |sums: &mut [f32; 3], parts: &[Part]| {
            for (part, _) in parts.iter().zip(&rows).filter(|(_, rows)| !rows.is_empty()) {
                sums.iter_mut().zip(part.sums).for_each(|(s, p)| *s += p);
            }
        };
        add(&mut sums, &self.parts);
        let norm = step(&mut self.critic, &mut self.parts, rows[1].is_empty(), |part| &mut part.critic);
        report.clear();
        report.extend([(keys::Q_LOSS, sums[0]), (keys::Q_MEAN, sums[1]), (keys::GRAD_NORM, norm)]);
        if self.critic.adam.steps.is_multiple_of(self.config.policy_delay) {
            self.update_actor(batch, &rows);
            sums = [0.0; 3];
            add(&mut sums, &self.parts);
            step(&mut self.actor, &mut self.parts, rows[1].is_empty(), |part| &mut part.actor);
            report.push((keys::POLICY_LOSS, sums[2]));
            for net in [&mut self.actor, &mut self.critic] {
                net.target.approach(&net.params, self.config.tau as f32);
            }
        }
    }

    /// Targets `y = R + γ^m (1 - done) min_i Q̄_i(s', clip(μ̄(s') + clip(ε, ±c), ±1))`, then the gradient of
    /// `Σ_i mean (Q_i(s, a) - y)²`. Source: Fujimoto et al. 2018, eq. 14 and algorithm 1.
    fn update_critics(&mut self, batch: &RlBatch, noise: &[f32], rows: &[std::ops::Range<usize>; PARTS]) {
        let Self { config, actor, critic, parts, obs_dim, .. } = self;
        let (n, o, a) = (batch.returns.len(), *obs_dim, self.space.slots());
        join(|| actor.refresh(true), || critic.refresh(true));
        let (sigma, bound) = (config.target_noise as f32, config.noise_clip as f32);
        let (obs, z, pair, q) = (self.obs, self.z, self.pair, self.q);
        critic.with(|weights, delayed| {
            actor.with(|_, policy| {
                each(parts, rows, |part, rows| {
                    let Part { critic: ws, next: (next_actor, next_critic), sums, targets, .. } = part;
                    let m = rows.len();
                    let of = |values: &'_ [f32], width: usize| -> std::ops::Range<usize> {
                        debug_assert_eq!(values.len(), n * width);
                        rows.start * width..rows.end * width
                    };
                    let next_obs = &batch.next_obs[of(&batch.next_obs, o)];
                    next_actor.value_mut(obs)[..m * o].copy_from_slice(next_obs);
                    actor.graph.forward(policy, next_actor, m, false);
                    let actions = &mut next_actor.value_mut(z)[..m * a];
                    for (action, noise) in actions.iter_mut().zip(&noise[of(noise, a)]) {
                        *action = (action.tanh() + (noise * sigma).clamp(-bound, bound)).clamp(-1.0, 1.0);
                    }
                    concat(next_critic.value_mut(pair), next_obs, o, actions, a);
                    critic.graph.forward(delayed, next_critic, m, false);
                    let [q1, q2] = q.map(|q| next_critic.value(q));
                    for (b, y) in rows.clone().zip(targets.iter_mut()) {
                        let least = at_most(q1[b - rows.start], q2[b - rows.start]);
                        *y = batch.returns[b] + batch.bootstrap[b] * least;
                    }
                    let (s, taken) = (&batch.obs[of(&batch.obs, o)], &batch.actions[of(&batch.actions, a)]);
                    concat(ws.value_mut(pair), s, o, taken, a);
                    critic.graph.forward(weights, ws, m, true);
                    *sums = [0.0; 3];
                    for q in q {
                        let (values, grad) = ws.value_and_grad(q, q);
                        for ((&value, grad), &y) in values[..m].iter().zip(grad).zip(targets.iter()) {
                            let error = value - y;
                            sums[0] += error * error / n as f32;
                            sums[1] += value / (2 * n) as f32;
                            *grad = 2.0 * error / n as f32;
                        }
                    }
                    critic.graph.backward(weights, ws);
                });
            });
        });
    }

    /// Gradient of `-mean Q_1(s, μ(s))` with respect to the actor (Silver et al. 2014, eq. 9).
    fn update_actor(&mut self, batch: &RlBatch, rows: &[std::ops::Range<usize>; PARTS]) {
        let Self { actor, critic, first, parts, obs_dim, .. } = self;
        let (n, o, a) = (batch.returns.len(), *obs_dim, self.space.slots());
        let (first, packed) = (&first.0, &mut first.1);
        actor.refresh(false);
        first.refresh(&critic.params, packed, true);
        let (obs, z, pair, q) = (self.obs, self.z, self.first_pair, self.first_q);
        critic.params.with(|p| {
            actor.with(|policy, _| {
                let weights = Weights { flat: p, packed };
                each(parts, rows, |part, rows| {
                    let Part { actor: ws, first: critic, next, sums, .. } = part;
                    let m = rows.len();
                    let s = &batch.obs[rows.start * o..rows.end * o];
                    ws.value_mut(obs)[..m * o].copy_from_slice(s);
                    actor.graph.forward(policy, ws, m, true);
                    let actions = &mut next.0.value_mut(z)[..m * a];
                    for (action, z) in actions.iter_mut().zip(ws.value(z)) {
                        *action = z.tanh();
                    }
                    concat(critic.value_mut(pair), s, o, actions, a);
                    first.forward(weights, critic, m, true);
                    *sums = [0.0; 3];
                    let (values, grad) = critic.value_and_grad(q, q);
                    for (value, grad) in values[..m].iter().zip(grad) {
                        sums[2] -= value / n as f32;
                        *grad = -1.0 / n as f32;
                    }
                    first.backward_values(weights, critic);
                    let (_, dz) = ws.value_and_grad(z, z);
                    let da = critic.grad(pair).chunks_exact(o + a).map(|row| &row[o..]);
                    for ((dz, action), da) in dz.chunks_exact_mut(a).zip(actions.chunks_exact(a)).zip(da) {
                        for ((dz, action), da) in dz.iter_mut().zip(action).zip(da) {
                            *dz = da * (1.0 - action * action);
                        }
                    }
                    actor.graph.backward(policy, ws);
                });
            });
        });
    }

    /// Actions of the actor for up to [`MAX_ROWS`] observations.
    fn actions(&mut self, obs: &[f32], batch: usize, actions: &mut [f32]) {
        let Self { actor, parts, obs_dim, .. } = self;
        let (o, a, rows) = (*obs_dim, self.space.slots(), split(batch));
        actor.refresh(false);
        let (first, second) = actions.split_at_mut(rows[0].len() * a);
        let [one, two] = &mut parts[..] else { unreachable!("two parts") };
        let (input, z) = (self.obs, self.z);
        actor.with(|policy, _| {
            each(&mut [(one, first), (two, second)], &rows, |(part, out), rows| {
                let ws = &mut part.next.0;
                ws.value_mut(input)[..rows.len() * o].copy_from_slice(&obs[rows.start * o..rows.end * o]);
                actor.graph.forward(policy, ws, rows.len(), false);
                out.iter_mut().zip(ws.value(z)).for_each(|(out, z)| *out = z.tanh());
            });
        });
    }
}

/// The smaller number; NaN of NaN, which `f32::min` would hide.
fn at_most(a: f32, b: f32) -> f32 {
    if b < a || b.is_nan() { b } else { a }
}

/// One optimiser step with the gradients that the parts have in one of their workspaces; returns the norm.
fn step(net: &mut Net, parts: &mut [Part], one: bool, ws: impl Fn(&mut Part) -> &mut Workspace) -> f32 {
    let [a, b] = parts else { unreachable!("two parts") };
    net.step(ws(a), (!one).then(|| ws(b)))
}

impl Actor for Td3 {
    fn space(&self) -> &ActionSpace {
        &self.space
    }

    fn choices(&self) -> usize {
        0
    }

    fn act(&mut self, obs: &[f32], batch: usize, chosen: &mut Vec<u32>, actions: &mut [f32]) {
        chosen.clear();
        let (o, a) = (self.obs_dim, self.space.slots());
        for (obs, actions) in obs[..batch * o].chunks(MAX_ROWS * o).zip(actions.chunks_mut(MAX_ROWS * a)) {
            self.actions(obs, obs.len() / o, actions);
        }
    }
}

impl Learner for Td3 {
    fn explore(&mut self, obs: &[f32], batch: usize, by: Explorer, chosen: &mut Vec<u32>, actions: &mut [f32]) {
        self.act(obs, batch, chosen, actions);
        for action in actions {
            *action = (*action + self.config.explore_noise as f32 * normal(by.noise)).clamp(-1.0, 1.0);
        }
    }

    fn update(&mut self, batch: &RlBatch, noise: &mut Rng, report: &mut Report) {
        let mut drawn = std::mem::take(&mut self.noise);
        drawn.clear();
        drawn.extend((0..batch.actions.len()).map(|_| normal(noise)));
        self.update_with(batch, &drawn, report);
        self.noise = drawn;
    }

    fn networks(&mut self) -> Vec<(&'static str, &mut Params)> {
        let (actor, critic) = (&mut self.actor, &mut self.critic);
        vec![
            ("actor", &mut actor.params),
            ("actor-target", &mut actor.target),
            ("critics", &mut critic.params),
            ("critics-target", &mut critic.target),
        ]
    }

    fn optimisers(&mut self) -> Vec<(&'static str, &mut Adam)> {
        vec![("actor", &mut self.actor.adam), ("critics", &mut self.critic.adam)]
    }

    fn actor(&mut self) -> &mut dyn Actor {
        self
    }
}

#[cfg(test)]
mod tests;
