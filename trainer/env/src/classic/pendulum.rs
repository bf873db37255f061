//! Pendulum-v1: swing a pendulum up and hold it there with little torque.
//!
//! Reference: Gymnasium's Pendulum-v1.

use std::f64::consts::PI;

use crate::{
    ArgumentMask, EnvError, EnvSpec, EnvState,
    render::{self, Scene},
    sampling::EpisodeRng,
    task::{Field, Outcome, Task, check_state, continuous, signal},
};

/// Gravity, m/s² (Gymnasium's default).
const GRAVITY: f64 = 10.0;
/// Mass, kg.
const MASS: f64 = 1.0;
/// Length, m.
const LENGTH: f64 = 1.0;
/// Time step, s.
const DT: f64 = 0.05;
/// Largest speed, rad/s.
const MAX_SPEED: f64 = 8.0;
/// Largest torque, N m.
const MAX_TORQUE: f64 = 2.0;

/// State: angle from upright (not wrapped) and angular velocity.
pub(crate) struct Pendulum {
    spec: EnvSpec,
    theta: f64,
    theta_dot: f64,
    single_precision: bool,
}

impl Pendulum {
    pub(crate) fn new(id: &str) -> Self {
        let spec = EnvSpec {
            id: id.to_owned(),
            observations: vec![
                signal("cos_angle", "1", -1.0, 1.0),
                signal("sin_angle", "1", -1.0, 1.0),
                signal("angular_velocity", "rad/s", -8.0, 8.0),
            ],
            actions: vec![continuous("torque", "N m", -2.0, 2.0, 0.0)],
            argument_mask: ArgumentMask::All,
            control_period_us: 50_000,
            time_limit: Some(200),
            goal_terminal: false,
        };
        Self { spec, theta: 0.0, theta_dot: 0.0, single_precision: false }
    }
}

impl Task for Pendulum {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, rng: &mut EpisodeRng) {
        self.theta = rng.uniform(-PI, PI);
        self.theta_dot = rng.uniform(-1.0, 1.0);
    }

    fn apply(&mut self, action: &[f64]) -> Outcome {
        let torque = action[0].clamp(-MAX_TORQUE, MAX_TORQUE);
        let gain = 3.0 / (MASS * LENGTH * LENGTH);
        // With an f32 action the reference keeps the two products of the torque in f32.
        let (drive, cost) = if self.single_precision {
            let u = torque as f32;
            (f64::from(gain as f32 * u), f64::from(0.001_f32 * (u * u)))
        } else {
            (gain * torque, 0.001 * (torque * torque))
        };
        let angle = (self.theta + PI).rem_euclid(2.0 * PI) - PI;
        let reward = -(angle * angle + 0.1 * (self.theta_dot * self.theta_dot) + cost);
        let acceleration = 3.0 * GRAVITY / (2.0 * LENGTH) * self.theta.sin() + drive;
        self.theta_dot = (self.theta_dot + acceleration * DT).clamp(-MAX_SPEED, MAX_SPEED);
        self.theta += self.theta_dot * DT;
        Outcome { reward, terminated: false }
    }

    fn observe(&self, obs: &mut [f64]) {
        obs.copy_from_slice(&[self.theta.cos(), self.theta.sin(), self.theta_dot]);
    }

    fn fields(&self) -> Vec<Field> {
        vec![("theta", 1), ("theta_dot", 1)]
    }

    fn physical(&self) -> Vec<f64> {
        vec![self.theta, self.theta_dot]
    }

    fn place(&mut self, physical: &[f64]) {
        (self.theta, self.theta_dot) = (physical[0], physical[1]);
    }

    fn save(&self) -> EnvState {
        EnvState { reals: self.physical(), counts: vec![] }
    }

    fn load(&mut self, state: &EnvState) -> Result<(), EnvError> {
        check_state(&self.spec, state, 2, 0)?;
        self.place(&state.reals);
        Ok(())
    }

    fn scene(&self) -> Option<Scene> {
        Some(render::classic::pendulum(self.theta))
    }

    fn recorded_in_single_precision(&mut self, single: bool) {
        self.single_precision = single;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_from_the_horizontal_by_hand() {
        let mut pendulum = Pendulum::new("pendulum");
        pendulum.place(&[PI / 2.0, 0.0]);
        let step = pendulum.apply(&[5.0]); // clamped to 2
        assert_eq!(step.reward, -(PI / 2.0 * (PI / 2.0) + 0.004));
        assert_eq!(pendulum.theta_dot, (15.0 + 6.0) * 0.05);
        assert_eq!(pendulum.theta, PI / 2.0 + 0.05 * pendulum.theta_dot);
    }
}
