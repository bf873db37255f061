//! The contract between an environment and everything that drives it: trainer, evaluation and the simulated bus.

use gadm_runtime::space::ActionHead;

/// One number of an observation.
#[derive(Clone, Debug, PartialEq)]
pub struct ObservationSignal {
    /// Short unique name, `snake_case`, with the unit in it where that helps a reader, e.g. `pole_angle`.
    pub name: String,
    /// SI unit, e.g. `rad/s`; `1` for a pure number.
    pub unit: String,
    /// Smallest value expected in normal operation; used to scale integers on the bus, never to clip.
    pub lo: f32,
    /// Largest value expected in normal operation.
    pub hi: f32,
}

/// One slot of an action.
#[derive(Clone, Debug, PartialEq)]
pub struct ActionSignal {
    /// Short unique name.
    pub name: String,
    /// SI unit; `1` for a pure number.
    pub unit: String,
    /// What the slot may hold.
    pub head: ActionHead,
    /// Value that is applied when the controller cannot be trusted; must be legal for `head`.
    pub safe: f32,
}

/// Which continuous slots a discrete choice uses; the others are ignored by the environment.
#[derive(Clone, Debug, PartialEq)]
pub enum ArgumentMask {
    /// Every continuous slot always counts.
    All,
    /// Row `t` tells, for each continuous slot in order, whether type `t` of the only discrete head uses it.
    ByType(Vec<Vec<bool>>),
    /// Continuous slot `i` counts when binary slot `i` is on.
    BySwitch,
}

/// Everything that is fixed about an environment.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvSpec {
    /// Registry id, e.g. `hopper-v5`.
    pub id: String,
    /// Observation signals, in order.
    pub observations: Vec<ObservationSignal>,
    /// Action slots, in order; discrete and binary heads before continuous ones.
    pub actions: Vec<ActionSignal>,
    /// Which continuous slots count for which discrete choice.
    pub argument_mask: ArgumentMask,
    /// Time between two actions, microseconds.
    pub control_period_us: u32,
    /// Step limit that the registry's wrapper adds and the observation does not show: reaching it truncates.
    /// `None` where the environment has its own, observed limit (which terminates).
    pub time_limit: Option<u32>,
    /// True where a terminal step with positive reward means success (Moving, Sliding, HardMove).
    pub goal_terminal: bool,
}

impl EnvSpec {
    /// Length of an observation.
    pub fn obs_dim(&self) -> usize {
        self.observations.len()
    }

    /// Length of an action (slots).
    pub fn action_dim(&self) -> usize {
        self.actions.len()
    }
}

/// Result of one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// Reward of this step.
    pub reward: f64,
    /// The environment ended by its own rules: the value of the next state is zero.
    pub terminated: bool,
    /// An outer limit cut the episode: a value target still bootstraps.
    pub truncated: bool,
}

/// Everything needed to continue an episode bit for bit; opaque outside the environment.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct EnvState {
    /// Real-valued part (positions, velocities, solver warm start, …).
    pub reals: Vec<f64>,
    /// Counters and flags.
    pub counts: Vec<u64>,
}

/// A change of the plant that the policy does not know of. Each kind holds until it is taken back, also through a reset.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Disturbance {
    /// Masses and inertias of all bodies, times this (above 0); 1 takes it back.
    Mass {
        /// Factor.
        factor: f64,
    },
    /// Friction of all contacts, times this (at least 0); 1 takes it back.
    Friction {
        /// Factor.
        factor: f64,
    },
    /// Gravity, times this; 1 takes it back.
    Gravity {
        /// Factor.
        factor: f64,
    },
    /// A force on the first body of the model, at its centre of mass, in world coordinates; zero takes it back.
    Push {
        /// Force, N.
        force_n: [f64; 3],
    },
}

/// A simulated task.
///
/// An episode is a function of the reset seed and the actions: there is no other source of randomness.
pub trait Env: Send {
    /// Spaces, period and limits.
    fn spec(&self) -> &EnvSpec;

    /// Starts an episode. `obs` has [`EnvSpec::obs_dim`] entries.
    fn reset(&mut self, seed: u64, obs: &mut [f32]);

    /// Applies `action` (one entry per slot, in native units) for one control period.
    /// Continuous entries are clamped to the head's bounds; discrete ones are rounded and clamped.
    fn step(&mut self, action: &[f32], obs: &mut [f32]) -> Step;

    /// The state of the running episode.
    fn state(&self) -> EnvState;

    /// Continues from a state that [`state`](Env::state) gave.
    ///
    /// # Errors
    /// Where the lengths do not fit this environment.
    fn restore(&mut self, state: &EnvState) -> Result<(), crate::EnvError>;

    /// A drawing of the state. Every environment of the registry has one; the default is none.
    fn scene(&self) -> Option<crate::render::Scene> {
        None
    }

    /// Changes the plant from the next step on. The state goes on unchanged, and [`state`](Env::state) does not hold the
    /// disturbance.
    ///
    /// # Errors
    /// [`EnvError::Disturbance`](crate::EnvError::Disturbance) where this plant cannot be changed in this way, or by
    /// this much. The default is a plant that cannot be changed at all.
    fn disturb(&mut self, disturbance: Disturbance) -> Result<(), crate::EnvError> {
        let message = format!("{disturbance:?}: only the MuJoCo bodies can be disturbed");
        Err(crate::EnvError::Disturbance { id: self.spec().id.clone(), message })
    }
}
