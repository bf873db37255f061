//! Environments around environments: a step limit, and action numbers without effect.

use delegate::delegate;

use crate::{ArgumentMask, Disturbance, Env, EnvError, EnvSpec, EnvState, Step, render::Scene, task::continuous};

/// Truncates an episode after a number of steps; the observation does not show it.
pub struct TimeLimit {
    inner: Box<dyn Env>,
    spec: EnvSpec,
    limit: u32,
    taken: u64,
}

impl TimeLimit {
    /// Wraps `inner`; its spec then tells `limit` steps.
    pub fn new(inner: Box<dyn Env>, limit: u32) -> Self {
        let mut spec = inner.spec().clone();
        spec.time_limit = Some(limit);
        Self { inner, spec, limit, taken: 0 }
    }
}

impl Env for TimeLimit {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64, obs: &mut [f32]) {
        self.taken = 0;
        self.inner.reset(seed, obs);
    }

    fn step(&mut self, action: &[f32], obs: &mut [f32]) -> Step {
        let mut step = self.inner.step(action, obs);
        self.taken = self.taken.saturating_add(1);
        step.truncated |= self.taken >= u64::from(self.limit);
        step
    }

    fn state(&self) -> EnvState {
        let mut state = self.inner.state();
        state.counts.push(self.taken);
        state
    }

    fn restore(&mut self, state: &EnvState) -> Result<(), EnvError> {
        let mut inner = state.clone();
        let Some(taken) = inner.counts.pop() else {
            let expected = self.state();
            return Err(EnvError::State {
                id: self.spec.id.clone(),
                expected: expected.reals.len() + expected.counts.len(),
                found: state.reals.len(),
            });
        };
        self.inner.restore(&inner)?;
        self.taken = taken;
        Ok(())
    }

    delegate! {
        to self.inner {
            fn scene(&self) -> Option<Scene>;
            fn disturb(&mut self, disturbance: Disturbance) -> Result<(), EnvError>;
        }
    }
}

/// Appends action numbers in -1..=1 that change nothing: neither the motion nor the cost of control.
///
/// This stands for the "redundant dimensions" of the paper's Figure 9, whose number and kind it leaves open.
pub struct ExtraDims {
    inner: Box<dyn Env>,
    spec: EnvSpec,
}

impl ExtraDims {
    /// Appends `extra` action slots `redundant_0`, `redundant_1`, ….
    ///
    /// # Errors
    /// [`EnvError::Option`] where a discrete choice switches arguments: the mask there has no row for such a slot.
    pub fn new(inner: Box<dyn Env>, extra: usize) -> Result<Self, EnvError> {
        let mut spec = inner.spec().clone();
        if spec.argument_mask != ArgumentMask::All {
            return Err(EnvError::Option {
                id: spec.id,
                option: "extra_dims",
                message: format!("only for environments with continuous actions alone, found {extra}"),
            });
        }
        spec.actions.extend((0..extra).map(|i| continuous(format!("redundant_{i}"), "1", -1.0, 1.0, 0.0)));
        Ok(Self { inner, spec })
    }
}

impl Env for ExtraDims {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64, obs: &mut [f32]) {
        self.inner.reset(seed, obs);
    }

    fn step(&mut self, action: &[f32], obs: &mut [f32]) -> Step {
        assert_eq!(action.len(), self.spec.action_dim(), "action of `{}`", self.spec.id);
        let real = self.inner.spec().action_dim();
        self.inner.step(&action[..real], obs)
    }

    delegate! {
        to self.inner {
            fn state(&self) -> EnvState;
            fn restore(&mut self, state: &EnvState) -> Result<(), EnvError>;
            fn scene(&self) -> Option<Scene>;
            fn disturb(&mut self, disturbance: Disturbance) -> Result<(), EnvError>;
        }
    }
}
