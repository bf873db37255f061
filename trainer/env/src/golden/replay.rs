//! Stepping our environment along a recording and keeping the largest differences.

use std::path::Path;

use super::{
    Comparison, FlagDifference, GoldenError, GoldenReport, Place, Replay,
    recording::{self, RecordedStep, Trajectory},
};
use crate::{sampling::EpisodeRng, task::Task};

/// Tolerances of one environment. Source: the table in `tests/golden/envs/README.md`.
struct Tolerances {
    obs: f64,
    reward: f64,
    reward_f32_actions: f64,
    state: f64,
    before_contact: f64,
}

fn tolerances(id: &str, mujoco: bool, foreign: bool, replay: Replay) -> Tolerances {
    let all = |t| Tolerances { obs: t, reward: t, reward_f32_actions: t, state: t, before_contact: t };
    match (id, mujoco, replay) {
        ("toy-env", ..) => all(0.0),
        // The reference rounds the observation to f32.
        ("pendulum", ..) => Tolerances { obs: 1e-6, ..all(1e-12) },
        // The engine is Box2D 2.3.1, the reference's 2.3.0 with patches: they differ in the rounding of contacts. Speeds in
        // the state count up to 25 times what they count in the observation, and the reward a hundred times.
        ("lunar-lander" | "lunar-lander-continuous", ..) => Tolerances {
            obs: 1e-4,
            reward: 1e-2,
            reward_f32_actions: 1e-2,
            state: 1e-2,
            before_contact: if foreign { 1e-4 } else { 0.0 },
        },
        (_, false, _) => all(1e-12),
        // With f32 actions the reference computes the cost of control in f32.
        (_, true, Replay::WholeRun) => Tolerances { reward: 1e-10, reward_f32_actions: 1e-6, ..all(0.0) },
        (_, true, Replay::FromEachState) => Tolerances { reward_f32_actions: 1e-6, ..all(1e-9) },
    }
}

pub(super) fn check(path: &Path, how: Option<Replay>) -> Result<GoldenReport, GoldenError> {
    let mut recording = recording::read(path)?;
    let task = &mut *recording.task;
    let mujoco = task.fields().iter().any(|(key, _)| *key == "qpos");
    let replay = match how {
        // A simulation that draws while it runs cannot begin in the middle.
        _ if task.draws().is_some() => Replay::WholeRun,
        Some(how) => how,
        None if recording.foreign_mujoco => Replay::FromEachState,
        None => Replay::WholeRun,
    };
    let limits = tolerances(recording.id, mujoco, recording.foreign, replay);
    let mut tally = Tally::new(&limits, task.spec().obs_dim());
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
    match task.draws() {
        Some(_) => task.reset(&mut EpisodeRng::from_recording(trajectory.draws.clone())),
        None => task.place(&trajectory.state),
    }
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
    before_contact: Comparison,
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
            before_contact: new("before_contact", tolerances.before_contact),
            first_flag: None,
            buffer: vec![0.0; obs_dim],
        }
    }

    /// Compares what a reset would return.
    fn start(&mut self, task: &dyn Task, trajectory: &Trajectory) {
        let place = Place { trajectory: trajectory.name.clone(), step: 0 };
        self.observation_and_state(task, &place, &trajectory.obs, &trajectory.state);
    }

    fn observation_and_state(&mut self, task: &dyn Task, place: &Place, obs: &[f64], state: &[f64]) {
        task.observe(&mut self.buffer);
        let physical = task.physical();
        compare(&mut self.obs, place, &self.buffer, obs);
        compare(&mut self.state, place, &physical, state);
        if task.before_contact() == Some(true) {
            compare(&mut self.before_contact, place, &self.buffer, obs);
            compare(&mut self.before_contact, place, &physical, state);
        }
    }

    /// Takes recorded step `k` and compares everything.
    fn step(&mut self, task: &mut dyn Task, trajectory: &Trajectory, k: usize, recorded: &RecordedStep) {
        let place = Place { trajectory: trajectory.name.clone(), step: k + 1 };
        let outcome = task.apply(&recorded.action);
        self.observation_and_state(task, &place, &recorded.obs, &recorded.state);
        if task.before_contact() == Some(true) {
            compare(&mut self.before_contact, &place, &[outcome.reward], &[recorded.reward]);
        }
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
        let all = [&self.obs, &self.reward, &self.reward_f32_actions, &self.state, &self.before_contact];
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
