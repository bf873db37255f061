//! LunarLander and LunarLanderContinuous: come to rest on the legs, with little fuel.
//!
//! Reference: Gymnasium's LunarLander-v3 without wind. Particles are only drawn there, and left out.

use std::{f32::consts::PI, sync::Arc};

use gadm_runtime::space::ActionHead;

use super::{
    flight::{DRAWS, Reading, Thrust},
    flights::{self, Start},
    plant::{Pose, STEPS_PER_S},
};
use crate::{
    ActionSignal, ArgumentMask, EnvError, EnvSpec, EnvState,
    render::{self, Scene},
    sampling::EpisodeRng,
    task::{Draws, Field, Outcome, Task, check_state, continuous, signal},
};

/// Steps for which room is made at a reset: the usual limit.
const USUAL_STEPS: usize = 1000;

/// How an action works the engines.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Engines {
    /// `(main, side)`, each in -1..=1: the main engine runs above 0, with half to full power; a side engine above 0.5 in
    /// size, at that power.
    Continuous,
    /// One of nothing, the side engine that pushes towards -x, the main engine, the other side engine; at full power.
    OneAtATime,
}

impl Engines {
    fn thrust(self, action: &[f64]) -> Thrust {
        match self {
            Self::Continuous => {
                let [main, side] = [action[0], action[1]].map(|a| a.clamp(-1.0, 1.0));
                Thrust {
                    main: if main > 0.0 { (main + 1.0) * 0.5 } else { 0.0 },
                    side: if side.abs() > 0.5 { side } else { 0.0 },
                }
            }
            Self::OneAtATime => match action[0] as u8 {
                1 => Thrust { side: -1.0, ..Thrust::default() },
                2 => Thrust { main: 1.0, ..Thrust::default() },
                3 => Thrust { side: 1.0, ..Thrust::default() },
                _ => Thrust::default(),
            },
        }
    }

    fn actions(self) -> (Vec<ActionSignal>, ArgumentMask) {
        match self {
            Self::Continuous => {
                let slots = ["main_engine", "side_engine"].map(|name| continuous(name, "1", -1.0, 1.0, 0.0));
                (slots.to_vec(), ArgumentMask::All)
            }
            Self::OneAtATime => {
                let head = ActionHead::Discrete { n: 4 };
                let slot = ActionSignal { name: "engine".to_owned(), unit: "1".to_owned(), head, safe: 0.0 };
                (vec![slot], ArgumentMask::ByType(vec![vec![]; 4]))
            }
        }
    }
}

/// The task. It holds the episode as its start and what the engines did since; see [`flights`] for the simulation.
pub(crate) struct LunarLander {
    spec: EnvSpec,
    engines: Engines,
    start: Start,
    thrusts: Vec<Thrust>,
    reading: Reading,
}

impl LunarLander {
    pub(crate) fn new(id: &str, engines: Engines) -> Self {
        let (actions, argument_mask) = engines.actions();
        let spec = EnvSpec {
            id: id.to_owned(),
            // Scaled as the reference scales them: by half of the view, and by that per control period.
            observations: vec![
                signal("x", "10 m", -1.5, 1.5),
                signal("y", "6.67 m", -1.5, 1.5),
                signal("velocity_x", "5 m/s", -5.0, 5.0),
                signal("velocity_y", "7.5 m/s", -5.0, 5.0),
                signal("angle", "rad", -PI, PI),
                signal("angular_velocity", "2.5 rad/s", -5.0, 5.0),
                signal("right_leg_contact", "1", 0.0, 1.0),
                signal("left_leg_contact", "1", 0.0, 1.0),
            ],
            actions,
            argument_mask,
            control_period_us: (1e6 / STEPS_PER_S) as u32,
            time_limit: Some(1000),
            goal_terminal: true,
        };
        let start = Arc::new(EpisodeRng::from_seed(0));
        let (reading, _) = flights::advance(&start, &[]);
        Self { spec, engines, start, thrusts: Vec::with_capacity(USUAL_STEPS), reading }
    }

    fn begin(&mut self, rng: EpisodeRng, thrusts: &[Thrust]) {
        flights::forget(&self.start);
        self.start = Arc::new(rng);
        self.thrusts.clear();
        self.thrusts.extend_from_slice(thrusts);
        (self.reading, _) = flights::advance(&self.start, &self.thrusts);
    }

    fn refused(&self, message: String) -> EnvError {
        EnvError::StateValue { id: self.spec.id.clone(), message }
    }
}

impl Drop for LunarLander {
    fn drop(&mut self) {
        flights::forget(&self.start);
    }
}

impl Task for LunarLander {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, rng: &mut EpisodeRng) {
        self.begin(rng.clone(), &[]);
    }

    fn apply(&mut self, action: &[f64]) -> Outcome {
        self.thrusts.push(self.engines.thrust(action));
        let (reading, outcome) = flights::advance(&self.start, &self.thrusts);
        self.reading = reading;
        outcome
    }

    fn observe(&self, obs: &mut [f64]) {
        // The reference's observation is f32.
        obs.copy_from_slice(&self.reading.observation().map(|o| f64::from(o as f32)));
    }

    fn fields(&self) -> Vec<Field> {
        let bodies = ["lander", "leg0", "leg1"].map(|body| (body, 9));
        let numbers = ["contact0", "contact1", "prev_shaping", "game_over"].map(|number| (number, 1));
        [bodies.as_slice(), numbers.as_slice()].concat()
    }

    fn physical(&self) -> Vec<f64> {
        let flag = |on: bool| f64::from(u8::from(on));
        let Reading { lander, legs, touch, shaping, .. } = self.reading;
        let bodies = [lander, legs[0], legs[1]].into_iter().flat_map(|pose| {
            let Pose { position: [x, y], angle, velocity: [vx, vy], angular_velocity, center: [cx, cy], awake } = pose;
            let numbers = [x, y, angle, vx, vy, angular_velocity, cx, cy].map(f64::from);
            numbers.into_iter().chain([flag(awake)])
        });
        bodies.chain([flag(touch.legs[0]), flag(touch.legs[1]), shaping, flag(touch.hull)]).collect()
    }

    fn draws(&self) -> Option<Draws> {
        Some(DRAWS)
    }

    fn before_contact(&self) -> Option<bool> {
        Some(!self.reading.touch.any)
    }

    fn place(&mut self, _physical: &[f64]) {
        unreachable!("a task that draws while it runs starts from recorded draws, see `Task::draws`");
    }

    /// Counts: seed and number of steps. Reals: the engines' powers in each step.
    fn save(&self) -> EnvState {
        EnvState {
            reals: self.thrusts.iter().flat_map(|t| [t.main, t.side]).collect(),
            counts: vec![self.start.seed(), self.thrusts.len() as u64],
        }
    }

    fn load(&mut self, state: &EnvState) -> Result<(), EnvError> {
        let steps = state.counts.get(1).and_then(|n| usize::try_from(*n).ok()).unwrap_or(0);
        check_state(&self.spec, state, steps.saturating_mul(2), 2)?;
        let thrusts: Vec<_> =
            state.reals.as_chunks().0.iter().map(|[main, side]| Thrust { main: *main, side: *side }).collect();
        let power = |p: f64| p == 0.0 || (0.5..=1.0).contains(&p);
        if let Some(k) = thrusts.iter().position(|t| !power(t.main) || !power(t.side.abs())) {
            let Thrust { main, side } = thrusts[k];
            let found = format!("found {main} and {side}");
            return Err(self.refused(format!("step {k}: expected powers of engines of 0 or 0.5 to 1, {found}")));
        }
        self.begin(EpisodeRng::from_seed(state.counts[0]), &thrusts);
        Ok(())
    }

    fn scene(&self) -> Option<Scene> {
        Some(render::lunar::lander(&self.reading))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn continuous_actions_by_hand() {
        let thrust = |main: f64, side: f64| {
            let t = Engines::Continuous.thrust(&[main, side]);
            (t.main, t.side)
        };
        assert_eq!(thrust(0.0, 0.0), (0.0, 0.0));
        assert_eq!(thrust(-1.0, 0.5), (0.0, 0.0));
        assert_eq!(thrust(0.2, -0.5), (0.6, 0.0));
        assert_eq!(thrust(1.0, 0.75), (1.0, 0.75));
        assert_eq!(thrust(7.0, -7.0), (1.0, -1.0));
    }

    #[test]
    fn discrete_actions_by_hand() {
        let all = [0.0, 1.0, 2.0, 3.0].map(|a| {
            let t = Engines::OneAtATime.thrust(&[a]);
            (t.main, t.side)
        });
        assert_eq!(all, [(0.0, 0.0), (0.0, -1.0), (1.0, 0.0), (0.0, 1.0)]);
    }

    #[test]
    fn a_state_is_the_seed_and_what_the_engines_did() {
        let mut task = LunarLander::new("lunar-lander-continuous", Engines::Continuous);
        task.reset(&mut EpisodeRng::from_seed(7));
        task.apply(&[1.0, -0.75]);
        task.apply(&[0.0, 0.0]);
        let state = task.save();
        assert_eq!(state, EnvState { reals: vec![1.0, -0.75, 0.0, 0.0], counts: vec![7, 2] });
        for (at, wrong) in [(0, 0.25), (1, -1.5), (2, -1.0)] {
            let mut bad = state.clone();
            bad.reals[at] = wrong;
            let error = task.load(&bad).expect_err("no such power").to_string();
            assert!(error.contains(&format!("step {}: expected powers", at / 2)), "{error}");
        }
        assert_eq!(task.save(), state, "a refused state changes nothing");
    }
}
