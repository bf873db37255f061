//! Walker2d v4 and v5: a two-legged robot in a plane that is to walk forward without falling.
//!
//! Reference: Gymnasium Walker2d-v4, Walker2d-v5. The two models differ in the friction of the right foot.

use super::{
    body::{Body, Noise, Rules, Setup, Version, control_cost, motors, survival},
    hopper::observe_planar,
    plant::{Plant, WALKER2D_V4, WALKER2D_V5},
};
use crate::{
    EnvError,
    task::{Outcome, signal},
};

/// Weight of the cost of control.
const CONTROL_COST: f64 = 1e-3;
/// Paid per step while healthy.
const HEALTHY_REWARD: f64 = 1.0;
/// Height of the torso in which the robot walks, m.
const HEIGHT: (f64, f64) = (0.8, 2.0);
/// Largest lean of the torso, rad.
const MAX_LEAN: f64 = 1.0;
const JOINTS: [&str; 6] = ["right_thigh", "right_leg", "right_foot", "left_thigh", "left_leg", "left_foot"];

pub(crate) struct Walker2d {
    version: Version,
}

impl Walker2d {
    pub(crate) fn task(id: &str, version: Version) -> Result<Body<Self>, EnvError> {
        let model = match version {
            Version::V4 => WALKER2D_V4,
            Version::V5 => WALKER2D_V5,
        };
        let setup = Setup { model, frame_skip: 4, noise: Noise::Uniform(5e-3), control_period_us: 8_000 };
        let mut observations = vec![signal("torso_height", "m", 0.0, 2.5), signal("torso_angle", "rad", -1.5, 1.5)];
        observations.extend(JOINTS.iter().map(|joint| {
            let (lo, hi) = if joint.ends_with("foot") { (-0.9, 0.9) } else { (-2.7, 0.2) };
            signal(format!("{joint}_angle"), "rad", lo, hi)
        }));
        observations.push(signal("velocity_x", "m/s", -10.0, 10.0));
        observations.push(signal("velocity_z", "m/s", -10.0, 10.0));
        observations.push(signal("torso_rate", "rad/s", -10.0, 10.0));
        observations.extend(JOINTS.iter().map(|joint| signal(format!("{joint}_rate"), "rad/s", -10.0, 10.0)));
        Body::new(id, setup, observations, motors(&JOINTS, 1.0), Self { version })
    }
}

impl Rules for Walker2d {
    fn forward_position(&self, plant: &Plant) -> f64 {
        plant.data.qpos()[0]
    }

    fn judge(&self, plant: &Plant, ctrl: &[f64], velocity: f64) -> Outcome {
        let qpos = plant.data.qpos();
        let healthy = HEIGHT.0 < qpos[1] && qpos[1] < HEIGHT.1 && qpos[2].abs() < MAX_LEAN;
        let reward = velocity + survival(self.version, healthy, HEALTHY_REWARD) - control_cost(CONTROL_COST, ctrl);
        Outcome { reward, terminated: !healthy }
    }

    fn observe(&self, plant: &Plant, obs: &mut [f64]) {
        observe_planar(plant, obs);
    }
}
