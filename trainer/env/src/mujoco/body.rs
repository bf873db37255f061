//! What all MuJoCo tasks share: noise at reset, forward velocity, cost of control, saving and restoring.
//!
//! Source: Gymnasium's `mujoco` environments, v4 and v5 (both with their default options).

use super::{
    figure::figure,
    plant::{ModelFile, Plant},
};
use crate::{
    ActionSignal, ArgumentMask, Disturbance, EnvError, EnvSpec, EnvState, ObservationSignal,
    render::{self, Scene},
    sampling::EpisodeRng,
    task::{Field, Outcome, Task, check_state, continuous},
};

/// Generation of the reference.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Version {
    /// Pays the healthy reward on every step, also on the one that ends the episode.
    V4,
    /// Pays it only while healthy.
    V5,
}

/// How a reset spreads positions and velocities around their initial values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Noise {
    /// Uniform in ± this, both.
    Uniform(f64),
    /// Positions uniform in ± this, velocities this times a standard normal.
    UniformAndNormal(f64),
}

/// The fixed numbers of a body.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Setup {
    pub(crate) model: ModelFile,
    pub(crate) frame_skip: usize,
    pub(crate) noise: Noise,
    pub(crate) control_period_us: u32,
}

/// What makes one body's task.
pub(crate) trait Rules: Send {
    /// Position whose change over a control period is the forward velocity, m.
    fn forward_position(&self, plant: &Plant) -> f64;

    /// Reward and end after a step at this forward velocity (m/s).
    fn judge(&self, plant: &Plant, ctrl: &[f64], velocity: f64) -> Outcome;

    /// Writes the observation.
    fn observe(&self, plant: &Plant, obs: &mut [f64]);
}

/// A MuJoCo body with its rules.
pub(crate) struct Body<R> {
    spec: EnvSpec,
    plant: Plant,
    rules: R,
    noise: Noise,
    /// Forward position before the next step. It cannot be recomputed from a restored state: for Ant and Humanoid it
    /// lags by one internal step.
    position: f64,
}

impl<R: Rules> Body<R> {
    pub(crate) fn new(
        id: &str,
        setup: Setup,
        observations: Vec<ObservationSignal>,
        actions: Vec<ActionSignal>,
        rules: R,
    ) -> Result<Self, EnvError> {
        let spec = EnvSpec {
            id: id.to_owned(),
            observations,
            actions,
            argument_mask: ArgumentMask::All,
            control_period_us: setup.control_period_us,
            time_limit: Some(1000),
            goal_terminal: false,
        };
        let plant = Plant::new(id, setup.model, setup.frame_skip)?;
        Ok(Self { spec, plant, rules, noise: setup.noise, position: 0.0 })
    }
}

impl<R: Rules> Task for Body<R> {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, rng: &mut EpisodeRng) {
        let (Noise::Uniform(b) | Noise::UniformAndNormal(b)) = self.noise;
        let qpos: Vec<f64> = self.plant.initial_qpos().iter().map(|q| q + rng.uniform(-b, b)).collect();
        let qvel: Vec<f64> = (0..self.plant.nv())
            .map(|_| match self.noise {
                Noise::Uniform(b) => rng.uniform(-b, b),
                Noise::UniformAndNormal(b) => b * rng.normal(),
            })
            .collect();
        self.plant.place(&qpos, &qvel, &vec![0.0; qvel.len()]);
        self.position = self.rules.forward_position(&self.plant);
    }

    /// `action` goes to the engine as it is; the engine clamps it, the cost of control does not.
    fn apply(&mut self, action: &[f64]) -> Outcome {
        self.plant.step(action);
        let before = std::mem::replace(&mut self.position, self.rules.forward_position(&self.plant));
        self.rules.judge(&self.plant, action, (self.position - before) / self.plant.dt())
    }

    fn observe(&self, obs: &mut [f64]) {
        self.rules.observe(&self.plant, obs);
    }

    fn fields(&self) -> Vec<Field> {
        vec![("qpos", self.plant.nq()), ("qvel", self.plant.nv()), ("qacc_warmstart", self.plant.nv())]
    }

    fn physical(&self) -> Vec<f64> {
        let mut state = Vec::with_capacity(self.plant.state_len());
        self.plant.save_state(&mut state);
        state.pop(); // the clock
        state
    }

    fn place(&mut self, physical: &[f64]) {
        let (qpos, rest) = physical.split_at(self.plant.nq());
        let (qvel, warm) = rest.split_at(self.plant.nv());
        self.plant.place(qpos, qvel, warm);
        self.position = self.rules.forward_position(&self.plant);
    }

    fn save(&self) -> EnvState {
        let mut reals = Vec::with_capacity(self.plant.state_len() + 1);
        self.plant.save_state(&mut reals);
        reals.push(self.position);
        EnvState { reals, counts: vec![] }
    }

    fn load(&mut self, state: &EnvState) -> Result<(), EnvError> {
        let len = self.plant.state_len();
        check_state(&self.spec, state, len + 1, 0)?;
        self.plant.load_state(&state.reals[..len]);
        self.position = state.reals[len];
        Ok(())
    }

    fn scene(&self) -> Option<Scene> {
        Some(render::body::body(&figure(&self.plant)))
    }

    fn disturb(&mut self, disturbance: Disturbance) -> Result<bool, EnvError> {
        self.plant.disturb(&self.spec.id, disturbance)?;
        Ok(true)
    }
}

/// `weight` times the sum of squares of the controls. Source: `control_cost` of the reference.
pub(crate) fn control_cost(weight: f64, ctrl: &[f64]) -> f64 {
    weight * ctrl.iter().map(|u| u * u).sum::<f64>()
}

/// Reward for being healthy and the end for not being so.
pub(crate) fn survival(version: Version, healthy: bool, reward: f64) -> f64 {
    match version {
        Version::V5 if !healthy => 0.0,
        Version::V4 | Version::V5 => reward,
    }
}

/// Copies slices one after another, and says where the next would begin.
pub(crate) fn write_at(obs: &mut [f64], at: usize, values: impl IntoIterator<Item = f64>) -> usize {
    let mut next = at;
    for value in values {
        obs[next] = value;
        next += 1;
    }
    next
}

/// Control signals in -`bound`..=`bound`, in units of each motor's gear; the safe value is no torque.
pub(crate) fn motors(names: &[&str], bound: f32) -> Vec<ActionSignal> {
    names.iter().map(|name| continuous(*name, "1", -bound, bound, 0.0)).collect()
}
