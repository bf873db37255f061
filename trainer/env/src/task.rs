//! The inside of an environment in f64, and the one adapter that makes it an [`Env`].
//!
//! Keeping the f64 side apart lets recordings be replayed at the precision they were made with.

use gadm_runtime::space::ActionHead;

use crate::{
    ActionSignal, Disturbance, Env, EnvError, EnvSpec, EnvState, ObservationSignal, Step, render::Scene,
    sampling::EpisodeRng,
};

/// Result of one task step: [`Step`] without the outer limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Outcome {
    pub(crate) reward: f64,
    pub(crate) terminated: bool,
}

/// A named part of the physical state, as recordings name it, and its length.
pub(crate) type Field = (&'static str, usize);

/// Random numbers that an episode uses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Draws {
    pub(crate) at_reset: usize,
    pub(crate) per_step: usize,
}

/// Physics, observation, reward and end of one environment, in f64 and without a time limit.
pub(crate) trait Task: Send {
    /// Everything fixed.
    fn spec(&self) -> &EnvSpec;

    /// Draws the start of an episode.
    fn reset(&mut self, rng: &mut EpisodeRng);

    /// One step with the action as it is: bounds are the task's own business, as in the reference.
    fn apply(&mut self, action: &[f64]) -> Outcome;

    /// The observation after `reset`, `place` or `apply`.
    fn observe(&self, obs: &mut [f64]);

    /// Layout of the physical state.
    fn fields(&self) -> Vec<Field>;

    /// The physical state, in the order of [`fields`](Task::fields).
    fn physical(&self) -> Vec<f64>;

    /// How many numbers a reset and each step draw, for tasks that also draw while they run; a recording of them holds the
    /// draws, and they start from those instead of being [placed](Task::place).
    fn draws(&self) -> Option<Draws> {
        None
    }

    /// Whether nothing has been touched yet, for tasks whose arithmetic is the reference's only until then.
    fn before_contact(&self) -> Option<bool> {
        None
    }

    /// Starts an episode from a physical state. NaN stands for a number that a recording leaves open.
    fn place(&mut self, physical: &[f64]);

    /// Everything needed to go on, bit for bit.
    fn save(&self) -> EnvState;

    /// Goes on from a saved state; leaves the task as it was where that fails.
    fn load(&mut self, state: &EnvState) -> Result<(), EnvError>;

    /// A drawing of the state. Every task of the registry has one (`tests/render.rs`).
    fn scene(&self) -> Option<Scene> {
        None
    }

    /// Changes the plant; `false` where it cannot be changed.
    fn disturb(&mut self, _disturbance: Disturbance) -> Result<bool, EnvError> {
        Ok(false)
    }

    /// Tells the type of the actions in a recording, for tasks whose reference computes differently with f32.
    fn recorded_in_single_precision(&mut self, _single: bool) {}
}

/// Makes a [`Task`] an [`Env`]: clamps f32 actions to the heads, rounds observations to f32.
pub(crate) struct TaskEnv {
    task: Box<dyn Task>,
    action: Vec<f64>,
    obs: Vec<f64>,
}

impl TaskEnv {
    pub(crate) fn new(task: Box<dyn Task>) -> Self {
        let (action, obs) = (vec![0.0; task.spec().action_dim()], vec![0.0; task.spec().obs_dim()]);
        Self { task, action, obs }
    }

    fn observe(&mut self, obs: &mut [f32]) {
        self.task.observe(&mut self.obs);
        for (to, from) in obs.iter_mut().zip(&self.obs) {
            *to = *from as f32;
        }
    }
}

impl Env for TaskEnv {
    fn spec(&self) -> &EnvSpec {
        self.task.spec()
    }

    fn reset(&mut self, seed: u64, obs: &mut [f32]) {
        assert_eq!(obs.len(), self.obs.len(), "observation buffer of `{}`", self.task.spec().id);
        self.task.reset(&mut EpisodeRng::from_seed(seed));
        self.observe(obs);
    }

    fn step(&mut self, action: &[f32], obs: &mut [f32]) -> Step {
        assert_eq!(action.len(), self.action.len(), "action of `{}`", self.task.spec().id);
        assert_eq!(obs.len(), self.obs.len(), "observation buffer of `{}`", self.task.spec().id);
        for ((to, &from), signal) in self.action.iter_mut().zip(action).zip(&self.task.spec().actions) {
            *to = f64::from(legal(signal, from));
        }
        let Outcome { reward, terminated } = self.task.apply(&self.action);
        self.observe(obs);
        Step { reward, terminated, truncated: false }
    }

    fn state(&self) -> EnvState {
        self.task.save()
    }

    fn restore(&mut self, state: &EnvState) -> Result<(), EnvError> {
        self.task.load(state)
    }

    fn scene(&self) -> Option<Scene> {
        self.task.scene()
    }

    fn disturb(&mut self, disturbance: Disturbance) -> Result<(), EnvError> {
        let id = self.task.spec().id.clone();
        let refused = |message: String| Err(EnvError::Disturbance { id: id.clone(), message });
        let (value, least) = match disturbance {
            Disturbance::Mass { factor } => (factor, f64::MIN_POSITIVE),
            Disturbance::Friction { factor } => (factor, 0.0),
            Disturbance::Gravity { factor } => (factor, f64::MIN),
            Disturbance::Push { force_n } => (force_n.iter().sum(), f64::MIN),
        };
        if !value.is_finite() || value < least {
            return refused(format!(
                "expected finite numbers and factors of at least 0 (masses above), found {disturbance:?}"
            ));
        }
        if self.task.disturb(disturbance)? {
            return Ok(());
        }
        refused(format!("{disturbance:?}: only the MuJoCo bodies can be disturbed"))
    }
}

/// The legal value nearest to `a`; the safe one for NaN.
fn legal(signal: &ActionSignal, a: f32) -> f32 {
    if a.is_nan() {
        return signal.safe;
    }
    match signal.head {
        ActionHead::Continuous { lo, hi } => a.clamp(lo, hi),
        ActionHead::Discrete { n } => a.round().clamp(0.0, f32::from(n) - 1.0),
        ActionHead::Binary => a.round().clamp(0.0, 1.0),
    }
}

/// An observation signal.
pub(crate) fn signal(name: impl Into<String>, unit: &str, lo: f32, hi: f32) -> ObservationSignal {
    ObservationSignal { name: name.into(), unit: unit.to_owned(), lo, hi }
}

/// A continuous action slot.
pub(crate) fn continuous(name: impl Into<String>, unit: &str, lo: f32, hi: f32, safe: f32) -> ActionSignal {
    ActionSignal { name: name.into(), unit: unit.to_owned(), head: ActionHead::Continuous { lo, hi }, safe }
}

/// Checks the shape of a saved state, and that its numbers are finite.
pub(crate) fn check_state(spec: &EnvSpec, state: &EnvState, reals: usize, counts: usize) -> Result<(), EnvError> {
    if state.reals.len() != reals || state.counts.len() != counts {
        return Err(EnvError::State {
            id: spec.id.clone(),
            expected: reals + counts,
            found: state.reals.len() + state.counts.len(),
        });
    }
    match state.reals.iter().position(|r| !r.is_finite()) {
        Some(i) => {
            let message = format!("number {i}: expected a finite one, found {}", state.reals[i]);
            Err(EnvError::StateValue { id: spec.id.clone(), message })
        }
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn actions_become_legal() {
        let torque = continuous("torque", "N m", -2.0, 2.0, 0.0);
        assert_eq!([3.0, -9.0, 1.5, f32::NAN, f32::INFINITY].map(|a| legal(&torque, a)), [2.0, -2.0, 1.5, 0.0, 2.0]);
        let kind = ActionSignal { head: ActionHead::Discrete { n: 3 }, safe: 2.0, ..torque.clone() };
        assert_eq!([-1.0, 0.4, 0.6, 7.0, f32::NAN].map(|a| legal(&kind, a)), [0.0, 0.0, 1.0, 2.0, 2.0]);
        let switch = ActionSignal { head: ActionHead::Binary, safe: 0.0, ..torque };
        assert_eq!([-1.0, 0.4, 0.6, 7.0, f32::NAN].map(|a| legal(&switch, a)), [0.0, 0.0, 1.0, 1.0, 0.0]);
    }
}
