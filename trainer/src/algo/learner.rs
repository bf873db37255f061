//! What the training loop and the evaluation need of an algorithm.

use crate::action_space::ActionSpace;
use crate::error::TrainError;
use crate::nn::{Adam, Params};
use crate::replay::RlBatch;
use crate::seed::Rng;

/// A policy as an evaluation sees it.
pub trait Actor {
    /// How actions are written.
    fn space(&self) -> &ActionSpace;

    /// Discrete choices that a decision is one of (latents, listed actions, types); 0 where there are none.
    fn choices(&self) -> usize;

    /// Greedy actions of `batch` observations (`B x O`) into `actions` (`B x slots`), without any noise; `chosen` gets the
    /// choice of each row, and is left empty where there are none.
    fn act(&mut self, obs: &[f32], batch: usize, chosen: &mut Vec<u32>, actions: &mut [f32]);
}

/// Random streams and progress that exploration depends on.
pub struct Explorer<'a> {
    /// Environment steps so far.
    pub env_steps: u64,
    /// Random choices.
    pub choose: &'a mut Rng,
    /// Noise on actions.
    pub noise: &'a mut Rng,
}

/// Metrics of one update: names from [`crate::metrics::keys`] with their values.
pub type Report = Vec<(&'static str, f32)>;

/// A step of one environment, as it turned out.
#[derive(Clone, Copy, Debug)]
pub struct Observed<'a> {
    /// Observation that was acted on.
    pub obs: &'a [f32],
    /// Reward.
    pub reward: f64,
    /// Successor, before any reset.
    pub next_obs: &'a [f32],
    /// Ended by the environment's own rules.
    pub terminated: bool,
    /// Cut by an outer limit.
    pub truncated: bool,
}

/// A baseline: networks that learn from batches of a replay buffer, or from the steps of a round.
pub trait Learner: Actor {
    /// Reads what the algorithm needs besides its configuration; once, before the first step of a run, not when it is resumed.
    ///
    /// # Errors
    /// For a file that is missing or does not fit.
    fn prepare(&mut self) -> Result<(), TrainError> {
        Ok(())
    }

    /// Actions with exploration for `batch` observations, as [`Actor::act`] gives them without. Draws are per row.
    fn explore(&mut self, obs: &[f32], batch: usize, by: Explorer, chosen: &mut Vec<u32>, actions: &mut [f32]);

    /// Uniformly random actions for `batch` rows.
    fn random(&mut self, _batch: usize, rng: &mut Rng, _chosen: &mut Vec<u32>, actions: &mut [f32]) {
        let slots = self.space().slots();
        for action in actions.chunks_exact_mut(slots) {
            self.space().random(rng, action);
        }
    }

    /// One update on a batch; fills `report`.
    fn update(&mut self, batch: &RlBatch, noise: &mut Rng, report: &mut Report);

    /// Whether the algorithm learns from its own steps, round by round, and not from a replay buffer.
    fn on_policy(&self) -> bool {
        false
    }

    /// A step that [`explore`](Self::explore) chose, environment by environment; for algorithms that are on-policy.
    fn observe(&mut self, _step: &Observed) {}

    /// All updates of a round, for algorithms that are on-policy. `updated` gets the report of each, and ends the round with
    /// `false`.
    fn learn(&mut self, _rng: &mut Rng, _updated: &mut dyn FnMut(&Report) -> bool) {}

    /// ε after that many environment steps, where the algorithm has one.
    fn epsilon(&self, _env_steps: u64) -> Option<f64> {
        None
    }

    /// Every network with its name, targets included; always in the same order.
    fn networks(&mut self) -> Vec<(&'static str, &mut Params)>;

    /// Every optimiser with the name of its network; always in the same order.
    fn optimisers(&mut self) -> Vec<(&'static str, &mut Adam)>;

    /// As an [`Actor`].
    fn actor(&mut self) -> &mut dyn Actor;
}
