//! Humanoid v4 and v5: a human-like robot that is to walk forward without falling.
//!
//! Reference: Gymnasium Humanoid-v4, Humanoid-v5.

use super::{
    ant::wrench_signals,
    body::{Body, Noise, Rules, Setup, Version, control_cost, motors, survival, write_at},
    plant::{HUMANOID, Plant},
};
use crate::{
    EnvError, ObservationSignal,
    task::{Outcome, signal},
};

const SETUP: Setup = Setup { model: HUMANOID, frame_skip: 5, noise: Noise::Uniform(0.01), control_period_us: 15_000 };
/// Weight of the forward velocity.
const FORWARD_WEIGHT: f64 = 1.25;
/// Weight of the cost of control.
const CONTROL_COST: f64 = 0.1;
/// Weight of the cost of contact forces (v5).
const CONTACT_COST: f64 = 5e-7;
/// Largest cost of contact forces (v5).
const MAX_CONTACT_COST: f64 = 10.0;
/// Paid per step while healthy.
const HEALTHY_REWARD: f64 = 5.0;
/// Heights of the torso at which the robot stands, m.
const HEIGHT: (f64, f64) = (1.0, 2.0);
/// Largest control; the motors' gears are 25 to 300 N m.
const MAX_CONTROL: f32 = 0.4;
/// Degrees of freedom of the free torso: their actuator forces are always zero.
const FREE: usize = 6;

/// Joints in the order of positions, with the bounds of their angles, rad (the joint's limit and some give).
const JOINTS: [(&str, f32, f32); 17] = [
    ("abdomen_z", -1.0, 1.0),
    ("abdomen_y", -1.5, 0.7),
    ("abdomen_x", -0.8, 0.8),
    ("right_hip_x", -0.6, 0.3),
    ("right_hip_z", -1.3, 0.8),
    ("right_hip_y", -2.1, 0.6),
    ("right_knee", -3.0, 0.2),
    ("left_hip_x", -0.6, 0.3),
    ("left_hip_z", -1.3, 0.8),
    ("left_hip_y", -2.1, 0.6),
    ("left_knee", -3.0, 0.2),
    ("right_shoulder1", -1.7, 1.3),
    ("right_shoulder2", -1.7, 1.3),
    ("right_elbow", -1.8, 1.1),
    ("left_shoulder1", -1.3, 1.7),
    ("left_shoulder2", -1.3, 1.7),
    ("left_elbow", -1.8, 1.1),
];
/// Motors have another order than joints in the abdomen.
const MOTORS: [&str; 17] = [
    "abdomen_y",
    "abdomen_z",
    "abdomen_x",
    "right_hip_x",
    "right_hip_z",
    "right_hip_y",
    "right_knee",
    "left_hip_x",
    "left_hip_z",
    "left_hip_y",
    "left_knee",
    "right_shoulder1",
    "right_shoulder2",
    "right_elbow",
    "left_shoulder1",
    "left_shoulder2",
    "left_elbow",
];
const BODIES: [&str; 14] = [
    "world",
    "torso",
    "lwaist",
    "pelvis",
    "right_thigh",
    "right_shin",
    "right_foot",
    "left_thigh",
    "left_shin",
    "left_foot",
    "right_upper_arm",
    "right_lower_arm",
    "left_upper_arm",
    "left_lower_arm",
];

pub(crate) struct Humanoid {
    version: Version,
}

/// First body and first actuator force that a version observes.
fn first_observed(version: Version) -> (usize, usize) {
    match version {
        Version::V4 => (0, 0),
        Version::V5 => (1, FREE),
    }
}

impl Humanoid {
    pub(crate) fn task(id: &str, version: Version) -> Result<Body<Self>, EnvError> {
        Body::new(id, SETUP, observations(version), motors(&MOTORS, MAX_CONTROL), Self { version })
    }
}

fn observations(version: Version) -> Vec<ObservationSignal> {
    let (first_body, first_force) = first_observed(version);
    let mut out = vec![signal("torso_height", "m", 0.0, 2.5)];
    out.extend(["w", "x", "y", "z"].map(|q| signal(format!("torso_quaternion_{q}"), "1", -1.1, 1.1)));
    out.extend(JOINTS.iter().map(|(joint, lo, hi)| signal(format!("{joint}_angle"), "rad", *lo, *hi)));
    out.extend(["x", "y", "z"].map(|axis| signal(format!("torso_velocity_{axis}"), "m/s", -10.0, 10.0)));
    out.extend(["x", "y", "z"].map(|axis| signal(format!("torso_rate_{axis}"), "rad/s", -20.0, 20.0)));
    out.extend(JOINTS.iter().map(|(joint, ..)| signal(format!("{joint}_rate"), "rad/s", -40.0, 40.0)));
    // Inertia about the centre of mass of the whole body: six moments, mass times offset, mass.
    let parts = [
        ("ixx", "kg m2", 10.0),
        ("iyy", "kg m2", 10.0),
        ("izz", "kg m2", 10.0),
        ("ixy", "kg m2", 5.0),
        ("ixz", "kg m2", 5.0),
        ("iyz", "kg m2", 5.0),
        ("mx", "kg m", 10.0),
        ("my", "kg m", 10.0),
        ("mz", "kg m", 10.0),
    ];
    for body in &BODIES[first_body..] {
        out.extend(parts.map(|(part, unit, hi)| signal(format!("inertia_{body}_{part}"), unit, -hi, hi)));
        out.push(signal(format!("mass_{body}"), "kg", 0.0, 10.0));
    }
    let motion = [
        ("wx", "rad/s", 40.0),
        ("wy", "rad/s", 40.0),
        ("wz", "rad/s", 40.0),
        ("vx", "m/s", 20.0),
        ("vy", "m/s", 20.0),
        ("vz", "m/s", 20.0),
    ];
    for body in &BODIES[first_body..] {
        out.extend(motion.map(|(part, unit, hi)| signal(format!("motion_{body}_{part}"), unit, -hi, hi)));
    }
    let free = ["x_force", "y_force", "z_force", "x_torque", "y_torque", "z_torque"].map(|part| {
        signal(format!("drive_torso_{part}"), if part.ends_with("force") { "N" } else { "N m" }, -1.0, 1.0)
    });
    let drives = JOINTS.iter().map(|(joint, ..)| signal(format!("drive_{joint}"), "N m", -120.0, 120.0));
    out.extend(free.into_iter().chain(drives).skip(first_force));
    out.extend(BODIES[first_body..].iter().flat_map(|body| wrench_signals("contact", body, 2000.0)));
    out
}

fn contact_cost(plant: &Plant) -> f64 {
    let sum = plant.data.cfrc_ext().as_flattened().iter().map(|f| f * f).sum::<f64>();
    (CONTACT_COST * sum).min(MAX_CONTACT_COST)
}

impl Rules for Humanoid {
    /// The x coordinate of the centre of mass.
    fn forward_position(&self, plant: &Plant) -> f64 {
        let mass = plant.data.model().body_mass();
        let moment: f64 = mass.iter().zip(plant.data.xipos()).map(|(m, p)| m * p[0]).sum();
        moment / mass.iter().sum::<f64>()
    }

    fn judge(&self, plant: &Plant, ctrl: &[f64], velocity: f64) -> Outcome {
        let z = plant.data.qpos()[2];
        let healthy = HEIGHT.0 < z && z < HEIGHT.1;
        let contact = match self.version {
            Version::V4 => 0.0,
            Version::V5 => contact_cost(plant),
        };
        let survival = survival(self.version, healthy, HEALTHY_REWARD);
        let reward = FORWARD_WEIGHT * velocity + survival - control_cost(CONTROL_COST, ctrl) - contact;
        Outcome { reward, terminated: !healthy }
    }

    fn observe(&self, plant: &Plant, obs: &mut [f64]) {
        let (body, force) = first_observed(self.version);
        let data = &plant.data;
        let at = write_at(obs, 0, data.qpos()[2..].iter().copied());
        let at = write_at(obs, at, data.qvel().iter().copied());
        let at = write_at(obs, at, data.cinert()[body..].as_flattened().iter().copied());
        let at = write_at(obs, at, data.cvel()[body..].as_flattened().iter().copied());
        let at = write_at(obs, at, data.qfrc_actuator()[force..].iter().copied());
        write_at(obs, at, data.cfrc_ext()[body..].as_flattened().iter().copied());
    }
}
