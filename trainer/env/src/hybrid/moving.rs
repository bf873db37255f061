//! Moving-v0 and Sliding-v0: accelerate, turn or brake, and come to a stop in the target.
//!
//! Reference: gym-hybrid (thomashirtz). The observed step count is the environments' own limit: it terminates.

use std::f64::consts::{FRAC_PI_2, TAU};

use gadm_runtime::space::ActionHead;

use super::field::{FIELDS, Field, observation_signals};
use crate::{
    ActionSignal, ArgumentMask, EnvError, EnvSpec, EnvState,
    render::{self, Scene},
    sampling::EpisodeRng,
    task::{Field as StateField, Outcome, Task, continuous},
};

/// Largest turn in one step, rad.
const MAX_TURN: f64 = FRAC_PI_2;
/// Largest gain of speed in one step, m/s.
const MAX_ACCELERATION: f64 = 0.5;
/// Time step, s.
const DT: f64 = 0.005;
/// Loss of speed by one brake action, m/s.
const BRAKE: f64 = 0.1;
/// The step after this one ends the episode: at most 201 steps.
const MAX_STEP: u64 = 200;
/// Speed that a good controller does not exceed, m/s; the environment has no limit.
const USUAL_MAX_SPEED: f32 = 20.0;

/// How velocity follows the heading.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Motion {
    /// The agent moves where it heads.
    Moving,
    /// Velocity is kept when turning; the direction of motion is not observed.
    Sliding,
}

/// Moving or Sliding.
pub(crate) struct Moving {
    spec: EnvSpec,
    motion: Motion,
    at: Field,
}

impl Moving {
    pub(crate) fn new(id: &str, motion: Motion) -> Self {
        let kind = ActionSignal {
            name: "type".to_owned(),
            unit: "1".to_owned(),
            head: ActionHead::Discrete { n: 3 },
            safe: 2.0,
        };
        let spec = EnvSpec {
            id: id.to_owned(),
            observations: observation_signals(USUAL_MAX_SPEED, 1.005),
            actions: vec![
                kind,
                continuous("acceleration", "1", 0.0, 1.0, 0.0),
                continuous("turn", "1", -1.0, 1.0, 0.0),
            ],
            // accelerate, turn, brake
            argument_mask: ArgumentMask::ByType(vec![vec![true, false], vec![false, true], vec![false, false]]),
            control_period_us: 5_000,
            time_limit: None,
            goal_terminal: true,
        };
        Self { spec, motion, at: Field::default() }
    }

    fn accelerate(&mut self, share: f64) {
        let a = MAX_ACCELERATION * share.clamp(0.0, 1.0);
        let v = self.at.speed;
        match self.motion {
            Motion::Moving => self.at.speed = v + a,
            Motion::Sliding => {
                // Adds the vectors `v` along phi and `a` along theta.
                let (sin, cos) = ((self.at.phi - self.at.theta).sin(), (self.at.phi - self.at.theta).cos());
                self.at.speed = (a * a + v * v + 2.0 * a * v * cos).sqrt();
                self.at.phi = self.at.theta + (v * sin).atan2(a + v * cos);
            }
        }
    }

    fn brake(&mut self) {
        self.at.speed = if self.at.speed < BRAKE { 0.0 } else { self.at.speed - BRAKE };
        if self.at.speed == 0.0 {
            self.at.phi = self.at.theta;
        }
    }
}

impl Task for Moving {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, rng: &mut EpisodeRng) {
        self.at = Field::draw(rng);
    }

    /// `action` is `(type, acceleration, turn)`.
    fn apply(&mut self, action: &[f64]) -> Outcome {
        let before = self.at.distance();
        self.at.step = self.at.step.saturating_add(1);
        match action[0] as u8 {
            0 => self.accelerate(action[1]),
            1 => self.at.theta = (self.at.theta + MAX_TURN * action[2].clamp(-1.0, 1.0)).rem_euclid(TAU),
            _ => self.brake(),
        }
        let direction = match self.motion {
            Motion::Moving => self.at.theta,
            Motion::Sliding => self.at.phi,
        };
        self.at.x += DT * self.at.speed * direction.cos();
        self.at.y += DT * self.at.speed * direction.sin();
        self.at.judge(before, self.at.speed == 0.0, MAX_STEP)
    }

    fn observe(&self, obs: &mut [f64]) {
        self.at.observe(MAX_STEP, obs);
    }

    fn fields(&self) -> Vec<StateField> {
        FIELDS.to_vec()
    }

    fn physical(&self) -> Vec<f64> {
        self.at.physical()
    }

    fn place(&mut self, physical: &[f64]) {
        self.at = Field::from_physical(physical);
    }

    fn save(&self) -> EnvState {
        self.at.save()
    }

    fn load(&mut self, state: &EnvState) -> Result<(), EnvError> {
        self.at = Field::load(&self.spec, state)?;
        Ok(())
    }

    fn scene(&self) -> Option<Scene> {
        let motion = match self.motion {
            Motion::Moving => self.at.theta,
            Motion::Sliding => self.at.phi,
        };
        Some(render::field::field(&self.at, motion, &[]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn braking_to_a_stop_in_the_target_wins() {
        let mut env = Moving::new("moving", Motion::Moving);
        env.at = Field { x: 0.01, ..Field::default() };
        assert!(!env.apply(&[0.0, 1.0, 0.0]).terminated); // v = 0.5
        for _ in 0..4 {
            assert!(!env.apply(&[2.0, 0.0, 0.0]).terminated);
        }
        // 0.5 - 4 * 0.1 leaves a little more or less than 0.1; the next brakes end it.
        let last = (0..2).map(|_| env.apply(&[2.0, 0.0, 0.0])).find(|step| step.terminated);
        assert!(last.is_some_and(|step| step.reward > 0.99));
    }

    #[test]
    fn turning_a_sliding_agent_keeps_its_velocity() {
        let mut env = Moving::new("sliding", Motion::Sliding);
        env.apply(&[0.0, 1.0, 0.0]);
        let x = env.at.x;
        env.apply(&[1.0, 0.0, 1.0]);
        assert_eq!((env.at.theta, env.at.phi, env.at.y), (FRAC_PI_2, 0.0, 0.0));
        assert_eq!(env.at.x, x + 0.005 * 0.5);
        env.apply(&[0.0, 1.0, 0.0]); // the same speed sideways: 45 degrees
        assert!((env.at.phi - FRAC_PI_2 / 2.0).abs() < 1e-15 && (env.at.speed - 0.5_f64.hypot(0.5)).abs() < 1e-15);
    }

    #[test]
    fn the_limit_is_the_201st_step_and_terminates() {
        let mut env = Moving::new("moving", Motion::Moving);
        env.at = Field { target_x: 0.9, ..Field::default() };
        for n in 1..=201 {
            let step = env.apply(&[1.0, 0.0, 0.1]);
            assert_eq!(step.terminated, n == 201, "step {n}");
        }
    }
}
