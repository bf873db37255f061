//! InvertedPendulum v4 and v5: balance a pole on a cart.
//!
//! Reference: Gymnasium InvertedPendulum-v4, InvertedPendulum-v5.

use super::{
    body::{Body, Noise, Rules, Setup, Version, motors, survival, write_at},
    plant::{INVERTED_PENDULUM, Plant},
};
use crate::{
    EnvError,
    task::{Outcome, signal},
};

const SETUP: Setup =
    Setup { model: INVERTED_PENDULUM, frame_skip: 2, noise: Noise::Uniform(0.01), control_period_us: 40_000 };
/// Largest lean of the pole, rad.
const MAX_LEAN: f64 = 0.2;
/// Largest control; the motor's gear makes 100 N of 1.
const MAX_CONTROL: f32 = 3.0;

pub(crate) struct InvertedPendulum {
    version: Version,
}

impl InvertedPendulum {
    pub(crate) fn task(id: &str, version: Version) -> Result<Body<Self>, EnvError> {
        let observations = vec![
            signal("cart_position", "m", -1.0, 1.0),
            signal("pole_angle", "rad", -0.5, 0.5),
            signal("cart_velocity", "m/s", -10.0, 10.0),
            signal("pole_rate", "rad/s", -10.0, 10.0),
        ];
        Body::new(id, SETUP, observations, motors(&["cart_force"], MAX_CONTROL), Self { version })
    }
}

impl Rules for InvertedPendulum {
    fn forward_position(&self, plant: &Plant) -> f64 {
        plant.data.qpos()[0]
    }

    fn judge(&self, plant: &Plant, _ctrl: &[f64], _velocity: f64) -> Outcome {
        let (qpos, qvel) = (plant.data.qpos(), plant.data.qvel());
        let finite = qpos.iter().chain(qvel).all(|v| v.is_finite());
        let healthy = finite && qpos[1].abs() <= MAX_LEAN;
        Outcome { reward: survival(self.version, healthy, 1.0), terminated: !healthy }
    }

    fn observe(&self, plant: &Plant, obs: &mut [f64]) {
        let at = write_at(obs, 0, plant.data.qpos().iter().copied());
        write_at(obs, at, plant.data.qvel().iter().copied());
    }
}
