//! Hopper v4 and v5: a one-legged robot in a plane that is to hop forward without falling.
//!
//! Reference: Gymnasium Hopper-v4, Hopper-v5.

use super::{
    body::{Body, Noise, Rules, Setup, Version, control_cost, motors, survival, write_at},
    plant::{HOPPER, Plant},
};
use crate::{
    EnvError,
    task::{Outcome, signal},
};

const SETUP: Setup = Setup { model: HOPPER, frame_skip: 4, noise: Noise::Uniform(5e-3), control_period_us: 8_000 };
/// Weight of the cost of control.
const CONTROL_COST: f64 = 1e-3;
/// Paid per step while healthy.
const HEALTHY_REWARD: f64 = 1.0;
/// Height of the torso above which the robot stands, m.
const MIN_HEIGHT: f64 = 0.7;
/// Largest lean of the torso, rad.
const MAX_LEAN: f64 = 0.2;
/// Bound of every other coordinate and velocity.
const MAX_STATE: f64 = 100.0;
/// Velocities are observed within ± this.
pub(super) const OBSERVED_SPEED: f64 = 10.0;

pub(crate) struct Hopper {
    version: Version,
}

impl Hopper {
    pub(crate) fn task(id: &str, version: Version) -> Result<Body<Self>, EnvError> {
        let observations = vec![
            signal("torso_height", "m", 0.0, 2.0),
            signal("torso_angle", "rad", -1.0, 1.0),
            signal("thigh_angle", "rad", -2.7, 0.2),
            signal("leg_angle", "rad", -2.7, 0.2),
            signal("foot_angle", "rad", -0.9, 0.9),
            signal("velocity_x", "m/s", -10.0, 10.0),
            signal("velocity_z", "m/s", -10.0, 10.0),
            signal("torso_rate", "rad/s", -10.0, 10.0),
            signal("thigh_rate", "rad/s", -10.0, 10.0),
            signal("leg_rate", "rad/s", -10.0, 10.0),
            signal("foot_rate", "rad/s", -10.0, 10.0),
        ];
        Body::new(id, SETUP, observations, motors(&["thigh", "leg", "foot"], 1.0), Self { version })
    }
}

fn healthy(plant: &Plant) -> bool {
    let (qpos, qvel) = (plant.data.qpos(), plant.data.qvel());
    let moderate = qpos[2..].iter().chain(qvel).all(|v| -MAX_STATE < *v && *v < MAX_STATE);
    moderate && qpos[1] > MIN_HEIGHT && qpos[2].abs() < MAX_LEAN
}

impl Rules for Hopper {
    fn forward_position(&self, plant: &Plant) -> f64 {
        plant.data.qpos()[0]
    }

    fn judge(&self, plant: &Plant, ctrl: &[f64], velocity: f64) -> Outcome {
        let healthy = healthy(plant);
        let reward = velocity + survival(self.version, healthy, HEALTHY_REWARD) - control_cost(CONTROL_COST, ctrl);
        Outcome { reward, terminated: !healthy }
    }

    fn observe(&self, plant: &Plant, obs: &mut [f64]) {
        observe_planar(plant, obs);
    }
}

/// Positions but the first, then velocities within ±10: the observation of Hopper and Walker2d.
pub(super) fn observe_planar(plant: &Plant, obs: &mut [f64]) {
    let at = write_at(obs, 0, plant.data.qpos()[1..].iter().copied());
    write_at(obs, at, plant.data.qvel().iter().map(|v| v.clamp(-OBSERVED_SPEED, OBSERVED_SPEED)));
}
