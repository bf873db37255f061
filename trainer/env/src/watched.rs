//! Looks on while something drives an environment, for films and reports.

use delegate::delegate;

use crate::render::Scene;
use crate::{Disturbance, Env, EnvError, EnvSpec, EnvState, Step};

/// Is told of the first episode of an environment.
pub trait Watcher: Send {
    /// The environment was reset.
    fn begin(&mut self, env: &dyn Env) {
        let _ = env;
    }

    /// It made a step; `env` is as it is afterwards.
    fn step(&mut self, env: &dyn Env, action: &[f32], step: &Step);

    /// The episode ended, or was cut off by another reset.
    fn end(&mut self) {}
}

/// An environment with a [`Watcher`] before it, which changes nothing. It watches from the first reset to the end of that
/// episode.
pub struct Watched<W> {
    inner: Box<dyn Env>,
    watcher: W,
    episode: Progress,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Progress {
    ToCome,
    Running,
    Over,
}

impl<W: Watcher> Watched<W> {
    /// Puts `watcher` before `inner`.
    pub fn new(inner: Box<dyn Env>, watcher: W) -> Self {
        Self { inner, watcher, episode: Progress::ToCome }
    }

    fn end(&mut self) {
        if self.episode == Progress::Running {
            self.watcher.end();
        }
        self.episode = Progress::Over;
    }
}

impl<W: Watcher> Env for Watched<W> {
    fn spec(&self) -> &EnvSpec {
        self.inner.spec()
    }

    fn reset(&mut self, seed: u64, obs: &mut [f32]) {
        self.inner.reset(seed, obs);
        if self.episode == Progress::ToCome {
            self.episode = Progress::Running;
            self.watcher.begin(self.inner.as_ref());
        } else {
            self.end();
        }
    }

    fn step(&mut self, action: &[f32], obs: &mut [f32]) -> Step {
        let step = self.inner.step(action, obs);
        if self.episode == Progress::Running {
            self.watcher.step(self.inner.as_ref(), action, &step);
            if step.terminated || step.truncated {
                self.end();
            }
        }
        step
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

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may fail loudly")]
mod tests {
    use std::sync::mpsc::{Sender, channel};

    use super::*;

    struct Teller(Sender<&'static str>);

    impl Watcher for Teller {
        fn begin(&mut self, _: &dyn Env) {
            self.0.send("begin").unwrap();
        }

        fn step(&mut self, _: &dyn Env, _: &[f32], _: &Step) {
            self.0.send("step").unwrap();
        }

        fn end(&mut self) {
            self.0.send("end").unwrap();
        }
    }

    #[test]
    fn only_the_first_episode_is_told_of_even_where_it_is_cut_off() {
        let (sender, told) = channel();
        let mut env = Watched::new(crate::make("pendulum").unwrap(), Teller(sender));
        let (mut obs, action) = ([0.0; 3], [0.0]);
        env.step(&action, &mut obs);
        for _ in 0..3 {
            env.reset(1, &mut obs);
            env.step(&action, &mut obs);
        }
        assert_eq!(told.try_iter().collect::<Vec<_>>(), ["begin", "step", "end"]);
    }
}
