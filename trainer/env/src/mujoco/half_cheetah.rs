//! HalfCheetah v4 and v5: a planar two-legged runner that cannot fail.
//!
//! Reference: Gymnasium HalfCheetah-v4, HalfCheetah-v5; with default options the two pay the same.

use super::{
    body::{Body, Noise, Rules, Setup, control_cost, motors, write_at},
    plant::{HALF_CHEETAH, Plant},
};
use crate::{
    EnvError,
    task::{Outcome, signal},
};

const SETUP: Setup =
    Setup { model: HALF_CHEETAH, frame_skip: 5, noise: Noise::UniformAndNormal(0.1), control_period_us: 50_000 };
/// Weight of the cost of control.
const CONTROL_COST: f64 = 0.1;
/// Joint and the bounds of its angle, rad (the joint's limit and some give).
const JOINTS: [(&str, f32, f32); 6] = [
    ("back_thigh", -0.8, 1.3),
    ("back_shin", -1.0, 1.0),
    ("back_foot", -0.7, 1.0),
    ("front_thigh", -1.3, 1.0),
    ("front_shin", -1.5, 1.2),
    ("front_foot", -0.8, 0.8),
];

pub(crate) struct HalfCheetah;

impl HalfCheetah {
    pub(crate) fn task(id: &str) -> Result<Body<Self>, EnvError> {
        let mut observations = vec![
            signal("torso_height", "m", -0.8, 1.0), // above the initial pose
            signal("torso_angle", "rad", -6.3, 6.3),
        ];
        observations.extend(JOINTS.iter().map(|(joint, lo, hi)| signal(format!("{joint}_angle"), "rad", *lo, *hi)));
        observations.push(signal("velocity_x", "m/s", -20.0, 20.0));
        observations.push(signal("velocity_z", "m/s", -10.0, 10.0));
        observations.push(signal("torso_rate", "rad/s", -20.0, 20.0));
        observations.extend(JOINTS.iter().map(|(joint, ..)| signal(format!("{joint}_rate"), "rad/s", -40.0, 40.0)));
        Body::new(id, SETUP, observations, motors(&JOINTS.map(|(joint, ..)| joint), 1.0), Self)
    }
}

impl Rules for HalfCheetah {
    fn forward_position(&self, plant: &Plant) -> f64 {
        plant.data.qpos()[0]
    }

    fn judge(&self, _plant: &Plant, ctrl: &[f64], velocity: f64) -> Outcome {
        Outcome { reward: velocity - control_cost(CONTROL_COST, ctrl), terminated: false }
    }

    fn observe(&self, plant: &Plant, obs: &mut [f64]) {
        let at = write_at(obs, 0, plant.data.qpos()[1..].iter().copied());
        write_at(obs, at, plant.data.qvel().iter().copied());
    }
}
