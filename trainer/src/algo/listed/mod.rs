//! DQN on a list of actions: hand-made bins, or the centres of an expert's actions (specification 7.2 and 8.7).

mod clusters;
mod config;
mod decoupled;
mod grid;

pub use clusters::{Clusters, cluster};
pub use config::{DqnClusterConfig, DqnManualConfig, HeadLayout};
pub use decoupled::Decoupled;
pub use grid::{Grid, bins, count, product};

use gadm_envs::EnvSpec;
use rand::RngExt as _;

use super::dqn::{Dqn, DqnConfig, masked_argmax};
use super::learner::{Actor, Explorer, Learner, Report};
use crate::action_space::{ActionSpace, ContinuousHead};
use crate::config::EpsilonConfig;
use crate::error::TrainError;
use crate::metrics::keys;
use crate::nn::{Adam, Init, ParamLayout, Params};
use crate::replay::RlBatch;
use crate::runner::agent::MAX_ROWS;
use crate::seed::{Rng, SeedTree};

/// Double DQN whose outputs are the rows of a list of actions.
pub struct Listed {
    space: ActionSpace,
    obs_dim: usize,
    epsilon: EpsilonConfig,
    /// The list, `K x slots`, normalised. Not trained; with the networks, so that a checkpoint holds it.
    actions: Params,
    dqn: Dqn,
    codes: Vec<u32>,
    /// Where the list is to be drawn from before the first step.
    clusters: Option<Clusters>,
}

impl Listed {
    /// A learner on `actions` (`K x slots`), with the networks of `config`; `key` is the dotted key of that.
    ///
    /// # Errors
    /// [`TrainError::Config`] for impossible settings.
    pub fn new(
        actions: &[f32],
        config: &DqnConfig,
        epsilon: EpsilonConfig,
        batch: usize,
        spec: &EnvSpec,
        seeds: SeedTree,
        key: &str,
    ) -> Result<Self, TrainError> {
        let space = ActionSpace::new(spec, ContinuousHead::Tanh, true);
        let k = actions.len() / space.slots();
        let mut layout = ParamLayout::new();
        layout.buffer("actions", &[k, space.slots()], Init::Zero);
        let mut list = Params::init(layout, &mut seeds.stream("init.actions"))?;
        list.with_mut(|to| to.copy_from_slice(actions));
        let rows = batch.max(MAX_ROWS);
        let dqn = Dqn::new(config.clone(), spec.obs_dim(), k, rows, &mut seeds.stream("init.q"))
            .map_err(|e| e.within(key))?;
        Ok(Self { space, obs_dim: spec.obs_dim(), epsilon, actions: list, dqn, codes: Vec::new(), clusters: None })
    }

    /// A learner on `config.clusters` centres of recorded actions, which [`Learner::prepare`] looks for.
    ///
    /// # Errors
    /// [`TrainError::Config`] for impossible settings, or an environment with discrete actions.
    pub fn clusters(config: &DqnClusterConfig, spec: &EnvSpec, seeds: SeedTree) -> Result<Self, TrainError> {
        config.validate()?;
        let space = ActionSpace::new(spec, ContinuousHead::Tanh, true);
        space.all_continuous("dqn-cluster", spec)?;
        let start = vec![0.0; config.clusters * space.slots()];
        let batch = config.schedule.batch;
        let mut listed = Self::new(&start, &config.dqn, config.epsilon, batch, spec, seeds, "dqn_cluster")?;
        listed.clusters = Some(Clusters::new(config, seeds));
        Ok(listed)
    }

    /// The Q-network.
    pub fn dqn(&self) -> &Dqn {
        &self.dqn
    }

    fn greedy(&mut self, obs: &[f32], batch: usize, chosen: &mut Vec<u32>) {
        chosen.clear();
        let (o, k) = (self.obs_dim, self.choices());
        for obs in obs[..batch * o].chunks(MAX_ROWS * o) {
            let scores = self.dqn.advantages(obs, obs.len() / o);
            chosen.extend(scores.chunks_exact(k).map(|row| masked_argmax(row, &[]) as u32));
        }
    }

    fn write(&self, chosen: &[u32], actions: &mut [f32]) {
        let slots = self.space.slots();
        self.actions.with(|list| {
            for (&code, action) in chosen.iter().zip(actions.chunks_exact_mut(slots)) {
                action.copy_from_slice(&list[code as usize * slots..][..slots]);
            }
        });
    }
}

impl Actor for Listed {
    fn space(&self) -> &ActionSpace {
        &self.space
    }

    fn choices(&self) -> usize {
        self.actions.layout().len() / self.space.slots()
    }

    fn act(&mut self, obs: &[f32], batch: usize, chosen: &mut Vec<u32>, actions: &mut [f32]) {
        self.greedy(obs, batch, chosen);
        self.write(chosen, actions);
    }
}

impl Learner for Listed {
    fn prepare(&mut self) -> Result<(), TrainError> {
        if let Some(clusters) = self.clusters.take() {
            let centres = clusters.centres(self.obs_dim, self.space.slots())?;
            self.actions.with_mut(|to| to.copy_from_slice(&centres));
        }
        Ok(())
    }

    fn explore(&mut self, obs: &[f32], batch: usize, by: Explorer, chosen: &mut Vec<u32>, actions: &mut [f32]) {
        self.greedy(obs, batch, chosen);
        let (epsilon, k) = (self.epsilon.at(by.env_steps), self.choices() as u32);
        for code in chosen.iter_mut() {
            if by.choose.random_bool(epsilon) {
                *code = by.choose.random_range(0..k);
            }
        }
        self.write(chosen, actions);
    }

    fn random(&mut self, batch: usize, rng: &mut Rng, chosen: &mut Vec<u32>, actions: &mut [f32]) {
        let k = self.choices() as u32;
        chosen.clear();
        chosen.extend((0..batch).map(|_| rng.random_range(0..k)));
        self.write(chosen, actions);
    }

    fn update(&mut self, batch: &RlBatch, _noise: &mut Rng, report: &mut Report) {
        self.codes.clear();
        self.codes.extend(batch.codes.iter().map(|&code| code as u32));
        let m = self.dqn.update(batch, &self.codes, &[]);
        report.clear();
        report.extend([(keys::Q_LOSS, m.loss), (keys::Q_MEAN, m.q_mean), (keys::GRAD_NORM, m.grad_norm)]);
    }

    fn epsilon(&self, env_steps: u64) -> Option<f64> {
        Some(self.epsilon.at(env_steps))
    }

    fn networks(&mut self) -> Vec<(&'static str, &mut Params)> {
        vec![("actions", &mut self.actions), ("q", &mut self.dqn.params), ("q-target", &mut self.dqn.target)]
    }

    fn optimisers(&mut self) -> Vec<(&'static str, &mut Adam)> {
        vec![("q", &mut self.dqn.adam)]
    }

    fn actor(&mut self) -> &mut dyn Actor {
        self
    }
}

/// DQN on hand-made bins: one list where it is short enough, else one output layer per slot.
///
/// # Errors
/// [`TrainError::Config`] for impossible settings.
pub fn manual(config: &DqnManualConfig, spec: &EnvSpec, seeds: SeedTree) -> Result<Box<dyn Learner>, TrainError> {
    config.validate()?;
    let space = ActionSpace::new(spec, ContinuousHead::Tanh, true);
    let values = bins(config.grid, config.bins);
    let n = count(&space, values.len()).filter(|n| *n <= config.limit);
    let decoupled = match (config.layout, n) {
        (HeadLayout::Auto, n) => n.is_none(),
        (HeadLayout::Flat, Some(_)) => false,
        (HeadLayout::Flat, None) => {
            let expected = format!("\"auto\" or \"decoupled\": {} has more than {} actions", spec.id, config.limit);
            return Err(TrainError::config("dqn_manual.layout", &expected, "\"flat\""));
        }
        (HeadLayout::Decoupled, _) => true,
    };
    if decoupled {
        return Ok(Box::new(Decoupled::new(config, values, spec, seeds)?));
    }
    let list = product(&space, &values);
    let batch = config.schedule.batch;
    Ok(Box::new(Listed::new(&list, &config.dqn, config.epsilon, batch, spec, seeds, "dqn_manual")?))
}

#[cfg(test)]
mod tests;
