//! Stepping our environment along a recording and keeping the largest differences.

use std::path::Path;

use super::{
    Comparison, FlagDifference, GoldenError, GoldenReport, Place, Replay,
    recording::{self, RecordedStep, Trajectory},
};
use crate::task::Task;

/// Tolerances of one environment. Source: the table in `tests/golden/envs/README.md`.
struct Tolerances {
    obs: f64,
    reward: f64,
    reward_f32_actions: f64,
    state: f64,
}

fn tolerances(id: &str, mujoco: bool, replay: Replay) -> Tolerances {
    match (id, mujoco, replay) {
        ("toy-env", ..) => Tolerances { obs: 0.0, reward: 0.0, reward_f32_actions: 0.0, state: 0.0 },
        // The reference rounds the observation to f32.
        ("pendulum", ..) => Tolerances { obs: 1e-6, reward: 1e-12, reward_f32_actions: 1e-12, state: 1e-12 },
        (_, false, _) => Tolerances { obs: 1e-12, reward: 1e-12, reward_f32_actions: 1e-12, state: 1e-12 },
        // With f32 actions the reference computes the cost of control in f32.
        (_, true, Replay::WholeRun) => Tolerances { obs: 0.0, reward: 1e-10, reward_f32_actions: 1e-6, state: 0.0 },
        (_, true, Replay::FromEachState) => {
            Tolerances { obs: 1e-9, reward: 1e-9, reward_f32_actions: 1e-6, state: 1e-9 }
        }
    }
}

pub(super) fn check(path: &Path, how: Option<Replay>) -> Result<GoldenReport, GoldenError> {
    let mut recording = recording::read(path)?;
    let task = &mut *recording.task;
    let mujoco = task.fields().iter().any(|(key, _)| *key == "qpos");
    let replay = how.unwrap_or(if recording.foreign_mujoco { Replay::FromEachState } else { Replay::WholeRun });
    let mut tally = Tally::new(&tolerances(recording.id, mujoco, replay), task.spec().obs_dim());
    for trajectory in &recording.trajectories {
        task.recorded_in_single_precision(trajectory.single_precision);
        match replay {
            Replay::WholeRun => whole_run(task, trajectory, &mut tally),
            Replay::FromEachState => from_each_state(task, trajectory, &mut tally),
        }
    }
    Ok(GoldenReport {
        path: path.to_owned(),
        id: recording.id.to_owned(),
        reference: recording.reference,
        replay,
        trajectories: recording.trajectories.len(),
        steps: recording.trajectories.iter().map(|t| t.steps.len()).sum(),
        comparisons: tally.finish(),
        first_flag: tally.first_flag,
    })
}

fn whole_run(task: &mut dyn Task, trajectory: &Trajectory, tally: &mut Tally) {
    task.place(&trajectory.state);
    tally.start(task, trajectory);
    for (k, recorded) in trajectory.steps.iter().enumerate() {
        tally.step(task, trajectory, k, recorded);
    }
}

/// Two steps, because the forward velocity of Ant and Humanoid uses positions that lag by one internal step.
fn from_each_state(task: &mut dyn Task, trajectory: &Trajectory, tally: &mut Tally) {
    task.place(&trajectory.state);
    tally.start(task, trajectory);
    if let Some(first) = trajectory.steps.first() {
        tally.step(task, trajectory, 0, first);
    }
    let states = std::iter::once(&trajectory.state).chain(trajectory.steps.iter().map(|step| &step.state));
    for (k, (state, pair)) in states.zip(trajectory.steps.windows(2)).enumerate() {
        task.place(state);
        task.apply(&pair[0].action);
        tally.step(task, trajectory, k + 1, &pair[1]);
    }
}

/// Running maxima.
struct Tally {
    obs: Comparison,
    reward: Comparison,
    reward_f32_actions: Comparison,
    state: Comparison,
    first_flag: Option<FlagDifference>,
    buffer: Vec<f64>,
}

impl Tally {
    fn new(tolerances: &Tolerances, obs_dim: usize) -> Self {
        let new =
            |quantity, tolerance| Comparison { quantity, compared: 0, unequal: 0, largest: 0.0, at: None, tolerance };
        Self {
            obs: new("observation", tolerances.obs),
            reward: new("reward", tolerances.reward),
            reward_f32_actions: new("reward_f32_actions", tolerances.reward_f32_actions),
            state: new("state", tolerances.state),
            first_flag: None,
            buffer: vec![0.0; obs_dim],
        }
    }

    /// Compares what a reset would return.
    fn start(&mut self, task: &dyn Task, trajectory: &Trajectory) {
        let place = Place { trajectory: trajectory.name.clone(), step: 0 };
        task.observe(&mut self.buffer);
        compare(&mut self.obs, &place, &self.buffer, &trajectory.obs);
        compare(&mut self.state, &place, &task.physical(), &trajectory.state);
    }

    /// Takes recorded step `k` and compares everything.
    fn step(&mut self, task: &mut dyn Task, trajectory: &Trajectory, k: usize, recorded: &RecordedStep) {
        let place = Place { trajectory: trajectory.name.clone(), step: k + 1 };
        let outcome = task.apply(&recorded.action);
        task.observe(&mut self.buffer);
        compare(&mut self.obs, &place, &self.buffer, &recorded.obs);
        compare(&mut self.state, &place, &task.physical(), &recorded.state);
        let reward = if trajectory.single_precision { &mut self.reward_f32_actions } else { &mut self.reward };
        compare(reward, &place, &[outcome.reward], &[recorded.reward]);
        let truncated = trajectory.time_limit.is_some_and(|limit| k as u64 + 1 >= limit);
        let flags =
            [("terminated", outcome.terminated, recorded.terminated), ("truncated", truncated, recorded.truncated)];
        for (flag, ours, recorded) in flags {
            if ours != recorded && self.first_flag.is_none() {
                self.first_flag = Some(FlagDifference { at: place.clone(), flag, recorded });
            }
        }
    }

    fn finish(&self) -> Vec<Comparison> {
        let all = [&self.obs, &self.reward, &self.reward_f32_actions, &self.state];
        all.into_iter().filter(|c| c.compared > 0).cloned().collect()
    }
}

/// Compares number by number; a recorded NaN stands for an open one.
fn compare(comparison: &mut Comparison, place: &Place, ours: &[f64], recorded: &[f64]) {
    for (a, b) in ours.iter().zip(recorded).filter(|(_, b)| !b.is_nan()) {
        comparison.compared += 1;
        if a.to_bits() == b.to_bits() {
            continue;
        }
        comparison.unequal += 1;
        let difference = (a - b).abs();
        let difference = if difference.is_nan() { f64::INFINITY } else { difference };
        if difference > comparison.largest || comparison.at.is_none() {
            comparison.largest = difference.max(comparison.largest);
            comparison.at = Some(place.clone());
        }
    }
}
