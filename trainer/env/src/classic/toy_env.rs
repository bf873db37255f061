//! ToyEnv: four states in a ring, and an action of which only one of two numbers counts.
//!
//! Source: the GADM paper, appendix A.6 and A.7. No reference program exists; what the paper leaves open is an option.

use crate::{
    ArgumentMask, EnvError, EnvSpec, EnvState,
    render::{self, Scene},
    sampling::EpisodeRng,
    task::{Field, Outcome, Task, check_state, continuous, signal},
};

/// `y` above this moves on from the state. Source: A.7, the middles of the dataset's squares.
pub(super) const THRESHOLDS: [f64; 4] = [0.9375, 0.9375, 3.0625, 3.0625];

/// When the reward of 1 is paid and the episode ends.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RewardConvention {
    /// For any action taken in the fourth state; the default, because the paper's dataset has actions there.
    #[default]
    ActingInS4,
    /// For the step that enters the fourth state.
    EnteringS4,
}

/// Where an episode starts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StartState {
    /// In the first state; the default.
    #[default]
    S1,
    /// In any state, all alike; useful to collect data.
    Uniform,
}

/// What the paper leaves open about ToyEnv.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ToyOptions {
    /// When the reward is paid.
    pub reward: RewardConvention,
    /// Where an episode starts.
    pub start: StartState,
}

/// State: 0..4.
pub(crate) struct ToyEnv {
    spec: EnvSpec,
    options: ToyOptions,
    at: usize,
}

impl ToyEnv {
    pub(crate) fn new(id: &str, options: ToyOptions) -> Self {
        let spec = EnvSpec {
            id: id.to_owned(),
            observations: (1..=4).map(|i| signal(format!("in_s{i}"), "1", 0.0, 1.0)).collect(),
            actions: vec![continuous("x", "1", 0.0, 4.0, 0.0), continuous("y", "1", 0.0, 4.0, 0.0)],
            argument_mask: ArgumentMask::All,
            control_period_us: 100_000, // ours: the paper has no time
            time_limit: Some(100),      // ours: the paper has no limit
            goal_terminal: true,
        };
        Self { spec, options, at: 0 }
    }
}

impl Task for ToyEnv {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, rng: &mut EpisodeRng) {
        self.at = match self.options.start {
            StartState::S1 => 0,
            StartState::Uniform => rng.index(4),
        };
    }

    fn apply(&mut self, action: &[f64]) -> Outcome {
        let before = self.at;
        if action[1] > THRESHOLDS[before] {
            self.at = (before + 1) % 4;
        }
        let goal = match self.options.reward {
            RewardConvention::ActingInS4 => before == 3,
            RewardConvention::EnteringS4 => before == 2 && self.at == 3,
        };
        Outcome { reward: f64::from(u8::from(goal)), terminated: goal }
    }

    fn observe(&self, obs: &mut [f64]) {
        obs.fill(0.0);
        obs[self.at] = 1.0;
    }

    fn fields(&self) -> Vec<Field> {
        vec![("s", 1)]
    }

    fn physical(&self) -> Vec<f64> {
        vec![self.at as f64]
    }

    fn place(&mut self, physical: &[f64]) {
        self.at = (physical[0] as usize).min(3);
    }

    fn save(&self) -> EnvState {
        EnvState { reals: vec![], counts: vec![self.at as u64] }
    }

    fn load(&mut self, state: &EnvState) -> Result<(), EnvError> {
        check_state(&self.spec, state, 0, 1)?;
        let at = state.counts[0];
        if at > 3 {
            let message = format!("state number: expected 0 to 3, found {at}");
            return Err(EnvError::StateValue { id: self.spec.id.clone(), message });
        }
        self.at = at as usize;
        Ok(())
    }

    fn scene(&self) -> Option<Scene> {
        Some(render::classic::toy(self.at))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// States visited with `y` just above and just below each threshold.
    fn walk(options: ToyOptions, ys: &[f64]) -> (Vec<usize>, f64, bool) {
        let mut toy = ToyEnv::new("toy-env", options);
        let (mut states, mut total, mut ended) = (vec![], 0.0, false);
        for &y in ys {
            let step = toy.apply(&[0.0, y]);
            states.push(toy.at);
            total += step.reward;
            ended = step.terminated;
        }
        (states, total, ended)
    }

    #[test]
    fn the_threshold_itself_stays_and_above_moves_on() {
        let options = ToyOptions::default();
        assert_eq!(walk(options, &[0.9375, 0.94, 0.93, 0.94, 3.0625, 3.07]), (vec![0, 1, 1, 2, 2, 3], 0.0, false));
        assert_eq!(walk(options, &[1.0, 1.0, 4.0, 0.0]), (vec![1, 2, 3, 3], 1.0, true));
    }

    #[test]
    fn the_other_reward_convention_pays_for_entering() {
        let options = ToyOptions { reward: RewardConvention::EnteringS4, ..ToyOptions::default() };
        assert_eq!(walk(options, &[1.0, 1.0, 4.0]), (vec![1, 2, 3], 1.0, true));
    }

    #[test]
    fn uniform_starts_reach_all_states() {
        let mut toy = ToyEnv::new("toy-env", ToyOptions { start: StartState::Uniform, ..ToyOptions::default() });
        let mut seen = [false; 4];
        for seed in 0..64 {
            toy.reset(&mut EpisodeRng::from_seed(seed));
            seen[toy.at] = true;
        }
        assert_eq!(seen, [true; 4]);
    }
}
