//! Ant v4 and v5: a four-legged robot that is to walk forward.
//!
//! Reference: Gymnasium Ant-v4 (without and with `use_contact_forces`), Ant-v5.

use super::{
    body::{Body, Noise, Rules, Setup, Version, control_cost, motors, survival, write_at},
    plant::{ANT, Plant},
};
use crate::{
    EnvError, ObservationSignal,
    task::{Outcome, signal},
};

const SETUP: Setup =
    Setup { model: ANT, frame_skip: 5, noise: Noise::UniformAndNormal(0.1), control_period_us: 50_000 };
/// Weight of the cost of control.
const CONTROL_COST: f64 = 0.5;
/// Weight of the cost of contact forces.
const CONTACT_COST: f64 = 5e-4;
/// Contact forces count within ± this.
const MAX_CONTACT: f64 = 1.0;
/// Paid per step while healthy.
const HEALTHY_REWARD: f64 = 1.0;
/// Heights of the torso at which the robot counts as upright, m.
const HEIGHT: (f64, f64) = (0.2, 1.0);
/// The torso in the model's list of bodies.
const TORSO: usize = 1;

/// Joints in the order of positions; the motors have another.
const JOINTS: [&str; 8] = ["hip_1", "ankle_1", "hip_2", "ankle_2", "hip_3", "ankle_3", "hip_4", "ankle_4"];
const MOTORS: [&str; 8] = ["hip_4", "ankle_4", "hip_1", "ankle_1", "hip_2", "ankle_2", "hip_3", "ankle_3"];
const BODIES: [&str; 14] = [
    "world", "torso", "leg_1", "thigh_1", "shin_1", "leg_2", "thigh_2", "shin_2", "leg_3", "thigh_3", "shin_3",
    "leg_4", "thigh_4", "shin_4",
];

/// Contact forces in observation and cost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Contact {
    /// Neither observed nor paid for (v4).
    Ignored,
    /// Of all bodies, the world included (v4 with the contact option).
    AllBodies,
    /// Of all bodies but the world, whose row is always zero (v5).
    ButWorld,
}

impl Contact {
    /// First observed body, `None` where contact is ignored.
    fn first_body(self) -> Option<usize> {
        match self {
            Self::Ignored => None,
            Self::AllBodies => Some(0),
            Self::ButWorld => Some(1),
        }
    }
}

pub(crate) struct Ant {
    version: Version,
    contact: Contact,
}

impl Ant {
    pub(crate) fn task(id: &str, version: Version, contact: Contact) -> Result<Body<Self>, EnvError> {
        let mut observations = vec![signal("torso_height", "m", 0.0, 1.5)];
        observations.extend(["w", "x", "y", "z"].map(|q| signal(format!("torso_quaternion_{q}"), "1", -1.1, 1.1)));
        observations.extend(JOINTS.iter().map(|joint| {
            let (lo, hi) = match *joint {
                "ankle_1" | "ankle_4" => (0.3, 1.5),
                "ankle_2" | "ankle_3" => (-1.5, -0.3),
                _ => (-0.8, 0.8),
            };
            signal(format!("{joint}_angle"), "rad", lo, hi)
        }));
        observations.extend(["x", "y", "z"].map(|axis| signal(format!("torso_velocity_{axis}"), "m/s", -10.0, 10.0)));
        observations.extend(["x", "y", "z"].map(|axis| signal(format!("torso_rate_{axis}"), "rad/s", -20.0, 20.0)));
        observations.extend(JOINTS.iter().map(|joint| signal(format!("{joint}_rate"), "rad/s", -20.0, 20.0)));
        if let Some(first) = contact.first_body() {
            observations.extend(BODIES[first..].iter().flat_map(|body| wrench_signals("contact", body, 1.0)));
        }
        Body::new(id, SETUP, observations, motors(&MOTORS, 1.0), Self { version, contact })
    }
}

/// Torque and force on a body, in the order MuJoCo keeps them.
pub(super) fn wrench_signals(kind: &str, body: &str, bound: f32) -> [ObservationSignal; 6] {
    [("tx", "N m"), ("ty", "N m"), ("tz", "N m"), ("fx", "N"), ("fy", "N"), ("fz", "N")]
        .map(|(part, unit)| signal(format!("{kind}_{body}_{part}"), unit, -bound, bound))
}

fn contact_forces(plant: &Plant, first: usize) -> impl Iterator<Item = f64> {
    plant.data.cfrc_ext()[first..].as_flattened().iter().map(|f| f.clamp(-MAX_CONTACT, MAX_CONTACT))
}

impl Rules for Ant {
    fn forward_position(&self, plant: &Plant) -> f64 {
        plant.data.xpos()[TORSO][0]
    }

    fn judge(&self, plant: &Plant, ctrl: &[f64], velocity: f64) -> Outcome {
        let (qpos, qvel) = (plant.data.qpos(), plant.data.qvel());
        let finite = qpos.iter().chain(qvel).all(|v| v.is_finite());
        let healthy = finite && HEIGHT.0 <= qpos[2] && qpos[2] <= HEIGHT.1;
        let contact = match self.contact {
            Contact::Ignored => 0.0,
            Contact::AllBodies | Contact::ButWorld => {
                CONTACT_COST * contact_forces(plant, 0).map(|f| f * f).sum::<f64>()
            }
        };
        let survival = survival(self.version, healthy, HEALTHY_REWARD);
        Outcome { reward: velocity + survival - control_cost(CONTROL_COST, ctrl) - contact, terminated: !healthy }
    }

    fn observe(&self, plant: &Plant, obs: &mut [f64]) {
        let at = write_at(obs, 0, plant.data.qpos()[2..].iter().copied());
        let at = write_at(obs, at, plant.data.qvel().iter().copied());
        if let Some(first) = self.contact.first_body() {
            write_at(obs, at, contact_forces(plant, first));
        }
    }
}
