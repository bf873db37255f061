//! Checkpoints of baseline runs: the same files, with the networks and optimisers that the learner names.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::trained::write_networks;
use super::{Arrays, LAST, Learned, Trained, VERSION, bad, parse, path, unusable, write};
use crate::algo::Learner;
use crate::config::TrainConfig;
use crate::error::TrainError;
use crate::replay::NStep;
use crate::runner::BaselineRun;
use crate::runner::bookkeeping::{Counters, Streams, Window};
use gadm_envs::VecEnvState;

#[derive(Serialize, Deserialize)]
struct State {
    version: u32,
    config: TrainConfig,
    counters: Counters,
    streams: Streams,
    window: Window,
    envs: VecEnvState,
    nsteps: Vec<NStep>,
    adam_steps: Vec<u64>,
    replay_next: usize,
}

/// Writes the whole state of a run, atomically.
///
/// # Errors
/// [`TrainError::Checkpoint`] with the cause; the old file is then untouched.
pub fn save(run: &mut BaselineRun, dir: &Path) -> Result<(), TrainError> {
    let (replay_next, columns) = run.replay.arrays();
    let mut arrays = Arrays::default();
    arrays.replay(&columns);
    networks(&mut arrays, run.learner.as_mut());
    let mut adam_steps = Vec::new();
    for (name, adam) in run.learner.optimisers() {
        arrays.put(format!("{name}/adam.m"), vec![adam.m.len()], adam.m.clone());
        arrays.put(format!("{name}/adam.v"), vec![adam.v.len()], adam.v.clone());
        adam_steps.push(adam.steps);
    }
    let state = State {
        version: VERSION,
        config: run.config.clone(),
        counters: run.counters.clone(),
        streams: run.streams.clone(),
        window: run.window.clone(),
        envs: run.envs.save(),
        nsteps: run.nsteps.clone(),
        adam_steps,
        replay_next,
    };
    let file = path(dir, LAST);
    let state = serde_json::to_string(&state).map_err(|e| bad(&file)(e.to_string()))?;
    write(&file, &arrays.to_bytes(state).map_err(bad(&file))?)
}

/// Writes the networks alone, atomically.
///
/// # Errors
/// As [`save`].
pub fn save_networks(run: &mut BaselineRun, dir: &Path, name: &str) -> Result<(), TrainError> {
    let mut arrays = Arrays::default();
    networks(&mut arrays, run.learner.as_mut());
    write_networks(&path(dir, name), &arrays, &run.config, &run.counters)
}

fn networks(arrays: &mut Arrays, learner: &mut dyn Learner) {
    for (name, params) in learner.networks() {
        arrays.params(name, params);
    }
}

/// Takes the networks of a learner out of a file.
pub(super) fn load_networks(arrays: &mut Arrays, learner: &mut dyn Learner) -> Result<(), String> {
    learner.networks().into_iter().try_for_each(|(name, params)| arrays.load_params(name, params))
}

/// Continues a run from its arrays and state.
pub(super) fn restore(file: &Path, mut arrays: Arrays, state: &str) -> Result<BaselineRun, TrainError> {
    let bad = unusable(file);
    let state: State = parse(state).map_err(&bad)?;
    let mut run = BaselineRun::new(state.config)?;
    if state.nsteps.len() != run.nsteps.len() || state.adam_steps.len() != run.learner.optimisers().len() {
        return Err(bad("its run state does not fit its configuration".to_owned()));
    }
    run.counters = state.counters;
    run.streams = state.streams;
    run.window = state.window;
    run.nsteps = state.nsteps;
    run.envs.restore(&state.envs).map_err(|e| bad(e.to_string()))?;
    load_networks(&mut arrays, run.learner.as_mut()).map_err(&bad)?;
    for ((name, adam), steps) in run.learner.optimisers().into_iter().zip(state.adam_steps) {
        arrays.load_adam(name, adam, steps).map_err(&bad)?;
    }
    let columns = arrays.take_replay().map_err(&bad)?;
    if !run.replay.restore(state.replay_next, &columns) {
        return Err(bad("the replay arrays do not fit this configuration".to_owned()));
    }
    Ok(run)
}

impl BaselineRun {
    /// What was learned so far.
    pub fn into_trained(self) -> Trained {
        let learned = Learned::Baseline(self.learner);
        Trained { learned, config: self.config, counters: self.counters, calibration: Vec::new() }
    }
}
