//! The square field with a target that Moving, Sliding and HardMove share.
//!
//! Reference: gym-hybrid (thomashirtz) and DI-engine's copy of it, which adds HardMove.

use std::f64::consts::TAU;

use crate::{
    EnvError, EnvSpec, EnvState, ObservationSignal,
    sampling::EpisodeRng,
    task::{Outcome, check_state, signal},
};

/// Radius of the target, in half-widths of the field.
pub(crate) const TARGET_RADIUS: f64 = 0.1;
/// Subtracted from every reward but the one for failing.
const PENALTY: f64 = 0.001;
/// Names and lengths of the recorded state.
pub(crate) const FIELDS: [(&str, usize); 8] =
    [("x", 1), ("y", 1), ("speed", 1), ("theta", 1), ("phi", 1), ("target_x", 1), ("target_y", 1), ("step", 1)];

/// Agent and target. Positions in half-widths of the field, angles in rad.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Field {
    pub(crate) x: f64,
    pub(crate) y: f64,
    pub(crate) speed: f64,
    /// Heading.
    pub(crate) theta: f64,
    /// Direction of motion (Sliding).
    pub(crate) phi: f64,
    pub(crate) target_x: f64,
    pub(crate) target_y: f64,
    /// Steps taken.
    pub(crate) step: u64,
}

impl Field {
    /// Target, agent and heading at random; standing still.
    pub(crate) fn draw(rng: &mut EpisodeRng) -> Self {
        let (target_x, target_y) = (rng.uniform(-0.9, 0.9), rng.uniform(-0.9, 0.9));
        let (x, y, theta) = (rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 1.0), rng.uniform(0.0, TAU));
        Self { x, y, speed: 0.0, theta, phi: theta, target_x, target_y, step: 0 }
    }

    /// Distance from agent to target.
    pub(crate) fn distance(&self) -> f64 {
        let (dx, dy) = (self.x - self.target_x, self.y - self.target_y);
        (dx * dx + dy * dy).sqrt()
    }

    /// Reward and end after a move that began at `distance_before`; `stopped` is what the goal asks besides closeness.
    pub(crate) fn judge(&self, distance_before: f64, stopped: bool, max_step: u64) -> Outcome {
        let distance = self.distance();
        let progress = distance_before - distance - PENALTY;
        if distance < TARGET_RADIUS && stopped {
            Outcome { reward: progress + 1.0, terminated: true }
        } else if self.x.abs() > 1.0 || self.y.abs() > 1.0 || self.step > max_step {
            Outcome { reward: -1.0, terminated: true }
        } else {
            Outcome { reward: progress, terminated: false }
        }
    }

    pub(crate) fn observe(&self, max_step: u64, obs: &mut [f64]) {
        let distance = self.distance();
        obs.copy_from_slice(&[
            self.x,
            self.y,
            self.speed,
            self.theta.cos(),
            self.theta.sin(),
            self.target_x,
            self.target_y,
            distance,
            f64::from(u8::from(distance <= TARGET_RADIUS)),
            self.step as f64 / max_step as f64,
        ]);
    }

    pub(crate) fn physical(&self) -> Vec<f64> {
        let Self { x, y, speed, theta, phi, target_x, target_y, step } = *self;
        vec![x, y, speed, theta, phi, target_x, target_y, step as f64]
    }

    /// From [`physical`](Self::physical); an open `phi` becomes the heading.
    pub(crate) fn from_physical(p: &[f64]) -> Self {
        let phi = if p[4].is_nan() { p[3] } else { p[4] };
        Self { x: p[0], y: p[1], speed: p[2], theta: p[3], phi, target_x: p[5], target_y: p[6], step: p[7] as u64 }
    }

    pub(crate) fn save(&self) -> EnvState {
        let mut reals = self.physical();
        reals.pop();
        EnvState { reals, counts: vec![self.step] }
    }

    pub(crate) fn load(spec: &EnvSpec, state: &EnvState) -> Result<Self, EnvError> {
        check_state(spec, state, 7, 1)?;
        let r = &state.reals;
        let step = state.counts[0];
        Ok(Self { x: r[0], y: r[1], speed: r[2], theta: r[3], phi: r[4], target_x: r[5], target_y: r[6], step })
    }
}

/// The ten signals; `max_speed` is 0 where the agent has none.
pub(crate) fn observation_signals(max_speed: f32, last_step_fraction: f32) -> Vec<ObservationSignal> {
    vec![
        signal("x", "m", -1.0, 1.0),
        signal("y", "m", -1.0, 1.0),
        signal("speed", "m/s", 0.0, max_speed),
        signal("cos_heading", "1", -1.0, 1.0),
        signal("sin_heading", "1", -1.0, 1.0),
        signal("target_x", "m", -1.0, 1.0),
        signal("target_y", "m", -1.0, 1.0),
        signal("target_distance", "m", 0.0, 3.0),
        signal("in_target", "1", 0.0, 1.0),
        signal("step_fraction", "1", 0.0, last_step_fraction),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_goal_is_tested_before_the_wall_and_the_limit() {
        let near = Field { x: 1.01, target_x: 0.95, step: 500, ..Field::default() };
        let goal = near.judge(0.06, true, 200);
        assert!(goal.terminated && (goal.reward - 0.999).abs() < 1e-12);
        assert_eq!(near.judge(0.06, false, 200), Outcome { reward: -1.0, terminated: true });
        let inside = Field { x: 0.5, step: 200, ..Field::default() };
        assert_eq!(inside.judge(0.6, true, 200), Outcome { reward: 0.6 - 0.5 - 0.001, terminated: false });
        assert!(Field { step: 201, ..inside }.judge(0.6, true, 200).terminated);
    }
}
