//! Networks without the rest of a run: those of the best evaluation and of the snapshots, and how any networks of a run folder
//! come back as a policy.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{
    Arrays, BEST, CALIBRATION_ROWS, FOLDER, LAST, VERSION, algorithm, bad, baseline, parse, path, read, restore,
};
use super::{unusable, write};
use crate::algo::{Actor, Learner};
use crate::config::{Algorithm, AlgorithmName, TrainConfig};
use crate::error::TrainError;
use crate::runner::agent::Agent;
use crate::runner::any::AnyRun as _;
use crate::runner::bookkeeping::Counters;
use crate::runner::run::Run;

/// Networks of a run folder.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Networks {
    /// Those of the best evaluation; the last ones before there is any.
    #[default]
    Best,
    /// Those of the newest checkpoint.
    Last,
    /// Those kept at this environment step (`track.snapshots`).
    Snapshot(u64),
}

/// Name of the file with the networks kept at an environment step.
pub fn snapshot(step: u64) -> String {
    format!("step-{step}.safetensors")
}

/// Environment steps whose networks are kept in a run folder, in order.
pub fn snapshots(dir: &Path) -> Vec<u64> {
    let files = std::fs::read_dir(dir.join(FOLDER)).into_iter().flatten().flatten();
    let mut steps: Vec<u64> = files
        .filter_map(|file| {
            let name = file.file_name().into_string().ok()?;
            name.strip_prefix("step-")?.strip_suffix(".safetensors")?.parse().ok()
        })
        .collect();
    steps.sort_unstable();
    steps
}

#[derive(Serialize, Deserialize)]
struct NetworksState {
    version: u32,
    config: TrainConfig,
    counters: Counters,
}

/// Writes the networks of a run and its calibration observations, atomically.
///
/// # Errors
/// As [`save`](super::save).
pub fn save_networks(run: &Run, dir: &Path, name: &str) -> Result<(), TrainError> {
    let mut arrays = Arrays::default();
    arrays.networks(&run.agent);
    let observations = calibration(run);
    arrays.flat("calibration/obs", &observations);
    write_networks(&path(dir, name), &arrays, &run.config, &run.counters)
}

pub(super) fn write_networks(
    file: &Path,
    arrays: &Arrays,
    config: &TrainConfig,
    counters: &Counters,
) -> Result<(), TrainError> {
    let state = NetworksState { version: VERSION, config: config.clone(), counters: counters.clone() };
    let state = serde_json::to_string(&state).map_err(|e| bad(file)(e.to_string()))?;
    write(file, &arrays.to_bytes(state).map_err(bad(file))?)
}

/// Up to 8,192 observations, evenly spread over the newest half of D_RL (or D_AR before there is any).
fn calibration(run: &Run) -> Vec<f32> {
    let (ar_next, pairs, _) = run.d_ar.arrays();
    let (width, filled) = (run.envs.spec().obs_dim(), !run.d_rl.is_empty());
    let (next, rows) = if filled { (run.d_rl.next(), run.d_rl.len()) } else { (ar_next, pairs.len() / width) };
    let obs = |row: usize| if filled { run.d_rl.obs(row) } else { &pairs[row * width..(row + 1) * width] };
    let newest = rows - rows / 2;
    let take = newest.min(CALIBRATION_ROWS);
    (0..take)
        .flat_map(|i| {
            // A full buffer's oldest row is the one that is overwritten next.
            let row = (next + rows - newest + i * newest / take) % rows;
            obs(row).iter().copied()
        })
        .collect()
}

/// What a run learned.
pub enum Learned {
    /// Action model, confidence predictor and Q-network.
    GadmDqn(Box<Agent>),
    /// The networks of a baseline.
    Baseline(Box<dyn Learner>),
}

/// A trained policy with what the export needs.
pub struct Trained {
    /// Networks.
    pub learned: Learned,
    /// Settings of the run.
    pub config: TrainConfig,
    /// Counters when it was stored.
    pub counters: Counters,
    /// Observations for calibration, `N x obs_dim`.
    pub calibration: Vec<f32>,
}

impl Trained {
    /// The policy as an evaluation sees it.
    pub fn actor(&mut self) -> &mut dyn Actor {
        match &mut self.learned {
            Learned::GadmDqn(agent) => agent.as_mut(),
            Learned::Baseline(learner) => learner.actor(),
        }
    }

    /// The agent of GADM + DQN, the algorithm whose policies run on a device.
    ///
    /// # Errors
    /// [`TrainError::Export`] for another algorithm.
    pub fn agent(&mut self) -> Result<&mut Agent, TrainError> {
        match &mut self.learned {
            Learned::GadmDqn(agent) => Ok(agent),
            Learned::Baseline(_) => Err(TrainError::Export(format!(
                "this run was trained with `{}`, and policy files hold those of gadm-dqn; evaluate it with gadm eval",
                self.config.algo.name().id()
            ))),
        }
    }
}

/// Loads networks of a run.
///
/// # Errors
/// As [`load`](super::load); for a snapshot that is not there, with those that are.
pub fn load_trained(dir: &Path, networks: Networks) -> Result<Trained, TrainError> {
    let name = match networks {
        Networks::Best => BEST.to_owned(),
        Networks::Last => LAST.to_owned(),
        Networks::Snapshot(step) => snapshot(step),
    };
    let file = path(dir, &name);
    if let Networks::Snapshot(step) = networks
        && !file.exists()
    {
        let kept: Vec<String> = snapshots(dir).iter().map(u64::to_string).collect();
        let kept = if kept.is_empty() { "none".to_owned() } else { kept.join(", ") };
        return Err(bad(&file)(format!("no snapshot of step {step}; kept are: {kept} (setting track.snapshots)")));
    }
    if name == LAST || !file.exists() {
        let file = path(dir, LAST);
        let (arrays, state) = read(dir, LAST)?;
        if algorithm(&state).map_err(unusable(&file))? != AlgorithmName::GadmDqn {
            return Ok(baseline::restore(&file, arrays, &state)?.into_trained());
        }
        let mut run = restore(&file, arrays, &state)?;
        run.swap_averages();
        let calibration = calibration(&run);
        let learned = Learned::GadmDqn(Box::new(run.agent));
        return Ok(Trained { calibration, config: run.config, counters: run.counters, learned });
    }
    let bad = unusable(&file);
    let (mut arrays, state) = read(dir, &name)?;
    let state: NetworksState = parse(&state).map_err(&bad)?;
    let spec = gadm_envs::make_with(&state.config.env, &state.config.env_options)?.spec().clone();
    if state.config.algo != Algorithm::GadmDqn {
        let mut learner = crate::runner::baseline::learner(&state.config, &spec)?;
        baseline::load_networks(&mut arrays, learner.as_mut()).map_err(&bad)?;
        let learned = Learned::Baseline(learner);
        return Ok(Trained { learned, config: state.config, counters: state.counters, calibration: Vec::new() });
    }
    let mut agent = Agent::new(&state.config, &spec)?;
    arrays.load_networks(&mut agent).map_err(&bad)?;
    agent.confidence_updates = state.counters.confidence_updates;
    let calibration = arrays.take("calibration/obs").map_err(&bad)?;
    let learned = Learned::GadmDqn(Box::new(agent));
    Ok(Trained { learned, config: state.config, counters: state.counters, calibration })
}
