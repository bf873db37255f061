//! HardMove-v0-n: n actuators, each with a switch and a signed distance, all around the agent.
//!
//! Reference: DI-engine's copy of gym-hybrid. The observed step count is the environment's own limit: it terminates.

use std::f64::consts::PI;

use gadm_runtime::space::ActionHead;

use super::field::{FIELDS, Field, observation_signals};
use crate::{
    ActionSignal, ArgumentMask, EnvError, EnvSpec, EnvState,
    render::{self, Scene},
    sampling::EpisodeRng,
    task::{Field as StateField, Outcome, Task, continuous},
};

/// The step after this one ends the episode: at most 26 steps.
const MAX_STEP: u64 = 25;

/// HardMove with n actuators.
pub(crate) struct HardMove {
    spec: EnvSpec,
    /// Unit vector of each actuator.
    directions: Vec<(f64, f64)>,
    at: Field,
}

impl HardMove {
    pub(crate) fn new(id: &str, n: usize) -> Self {
        let switch =
            |i| ActionSignal { name: format!("switch_{i}"), unit: "1".to_owned(), head: ActionHead::Binary, safe: 0.0 };
        let spec = EnvSpec {
            id: id.to_owned(),
            observations: observation_signals(1.0, 1.04),
            actions: (0..n)
                .map(switch)
                .chain((0..n).map(|i| continuous(format!("distance_{i}"), "m", -1.0, 1.0, 0.0)))
                .collect(),
            argument_mask: ArgumentMask::BySwitch,
            control_period_us: 5_000, // Moving's; the reference has no time here
            time_limit: None,
            goal_terminal: true,
        };
        let angle = |i: usize| (i * 2) as f64 * PI / n as f64;
        Self { spec, directions: (0..n).map(|i| (angle(i).cos(), angle(i).sin())).collect(), at: Field::default() }
    }
}

/// `atan(y / x)` as the reference computes it, and 0 where it would be NaN.
fn heading(x: f64, y: f64) -> f64 {
    if x == 0.0 && y == 0.0 { 0.0 } else { (y / x).atan() }
}

impl Task for HardMove {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, rng: &mut EpisodeRng) {
        self.at = Field::draw(rng);
    }

    /// `action` is n switches, then n distances. In the reference's action index, switch 0 is the most significant bit.
    fn apply(&mut self, action: &[f64]) -> Outcome {
        let before = self.at.distance();
        self.at.step = self.at.step.saturating_add(1);
        let (switches, distances) = action.split_at(self.directions.len());
        let (mut dx, mut dy) = (0.0, 0.0);
        for ((switch, distance), (cos, sin)) in switches.iter().zip(distances).zip(&self.directions) {
            dx += switch * distance * cos;
            dy += switch * distance * sin;
        }
        self.at.x += dx;
        self.at.y += dy;
        self.at.theta = heading(self.at.x, self.at.y);
        self.at.judge(before, true, MAX_STEP)
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
        Some(render::field::field(&self.at, 0.0, &self.directions))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn opposite_actuators_cancel_and_switched_off_ones_do_nothing() {
        let mut env = HardMove::new("hard-move-4", 4);
        env.at = Field { target_x: 0.9, ..Field::default() };
        env.apply(&[1.0, 0.0, 1.0, 0.0, 0.3, 0.9, 0.3, 0.9]);
        assert!(env.at.x.abs() < 1e-15 && env.at.y.abs() < 1e-15);
        env.apply(&[0.0, 1.0, 0.0, 0.0, 0.3, 0.5, 0.3, 0.9]);
        assert!((env.at.y - 0.5).abs() < 1e-15);
    }

    #[test]
    fn the_heading_is_never_nan() {
        assert_eq!(heading(0.0, 0.0), 0.0);
        assert_eq!(heading(0.0, 0.5), PI / 2.0);
        assert_eq!(heading(-0.5, 0.5), -PI / 4.0);
    }
}
