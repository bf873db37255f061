//! Checkpoints: one safetensors file with every array of a run, and the rest of its state as JSON in the header.
//!
//! A file is written beside the old one and renamed, so that a full disk or a kill leaves the old one. `last.safetensors` holds
//! everything a run needs to go on as if never stopped; `best.safetensors` and `step-N.safetensors` hold the networks of the best
//! evaluation and of a snapshot, with a sample of observations for the export's calibration.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

use crc::{CRC_32_ISO_HDLC, Crc, Table};
use safetensors::tensor::{Dtype, SafeTensors, View};
use serde::{Deserialize, Serialize};

use super::agent::Agent;
use super::any::AnyRun;
use super::averages::Averages;
use super::bookkeeping::{Counters, NotFinite, Streams, Window};
use super::run::Run;
use crate::atomic;
use crate::config::{AlgorithmName, TrainConfig};
use crate::error::TrainError;
use crate::nn::{Adam, Params};
use crate::replay::{NStep, RL_COLUMNS};
use gadm_envs::VecEnvState;

pub mod baseline;
mod trained;

pub use trained::{Learned, Networks, Trained, load_trained, save_networks, snapshot, snapshots};

/// Folder of the checkpoints in a run folder.
pub const FOLDER: &str = "checkpoints";
/// File of the newest whole state.
pub const LAST: &str = "last.safetensors";
/// File of the networks with the best evaluation.
pub const BEST: &str = "best.safetensors";
/// Version of the layout below.
const VERSION: u32 = 1;
/// Observations stored for the export's calibration, at most.
const CALIBRATION_ROWS: usize = 8192;

/// Over the run state and every array, so that a damaged file is refused and not trained on.
const CRC_32: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC_32_ISO_HDLC);

/// Named arrays with their shapes. Replay buffers are borrowed: a copy of them may not fit into memory.
#[derive(Default)]
struct Arrays<'a>(BTreeMap<String, Array<'a>>);

#[derive(Clone)]
struct Array<'a> {
    shape: Vec<usize>,
    values: Cow<'a, [f32]>,
}

impl View for &Array<'_> {
    fn dtype(&self) -> Dtype {
        Dtype::F32
    }

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Owned(self.values.iter().flat_map(|x| x.to_le_bytes()).collect())
    }

    fn data_len(&self) -> usize {
        4 * self.values.len()
    }
}

impl<'a> Arrays<'a> {
    fn put(&mut self, name: impl Into<String>, shape: Vec<usize>, values: impl Into<Cow<'a, [f32]>>) {
        self.0.insert(name.into(), Array { shape, values: values.into() });
    }

    fn flat(&mut self, name: impl Into<String>, values: &'a [f32]) {
        self.put(name, vec![values.len()], values);
    }

    fn params(&mut self, prefix: &str, params: &Params) {
        for (name, (shape, values)) in params.export() {
            self.put(format!("{prefix}/{name}"), shape, values);
        }
    }

    fn adam(&mut self, prefix: &str, adam: &'a Adam) {
        self.flat(format!("{prefix}/adam.m"), &adam.m);
        self.flat(format!("{prefix}/adam.v"), &adam.v);
    }

    fn replay(&mut self, columns: &'a [Vec<f32>; 6]) {
        for (name, values) in RL_COLUMNS.iter().zip(columns) {
            self.flat(format!("d_rl/{name}"), values);
        }
    }

    fn take_replay(&mut self) -> Result<[Vec<f32>; 6], String> {
        let mut columns: [Vec<f32>; 6] = Default::default();
        for (name, column) in RL_COLUMNS.iter().zip(&mut columns) {
            *column = self.take(&format!("d_rl/{name}"))?;
        }
        Ok(columns)
    }

    fn take(&mut self, name: &str) -> Result<Vec<f32>, String> {
        self.0.remove(name).map(|a| a.values.into_owned()).ok_or_else(|| format!("`{name}` is missing"))
    }

    fn load_params(&mut self, prefix: &str, params: &mut Params) -> Result<(), String> {
        let start = format!("{prefix}/");
        let own = self.0.iter().filter_map(|(name, a)| {
            Some((name.strip_prefix(&start)?.to_owned(), (a.shape.clone(), a.values.to_vec())))
        });
        let own = own.collect();
        params.import(&own).map_err(|e| format!("{prefix}: {e}"))
    }

    fn load_adam(&mut self, prefix: &str, adam: &mut Adam, steps: u64) -> Result<(), String> {
        for (name, to) in [("m", &mut adam.m), ("v", &mut adam.v)] {
            let values = self.take(&format!("{prefix}/adam.{name}"))?;
            if values.len() != to.len() {
                return Err(format!("`{prefix}/adam.{name}` has {} numbers, expected {}", values.len(), to.len()));
            }
            *to = values;
        }
        adam.steps = steps;
        Ok(())
    }

    fn networks(&mut self, agent: &Agent) {
        agent.networks().into_iter().for_each(|(name, params)| self.params(name, params));
    }

    fn load_networks(&mut self, agent: &mut Agent) -> Result<(), String> {
        agent.networks_mut().into_iter().try_for_each(|(name, params)| self.load_params(name, params))
    }

    /// Serialises with `state` in the header.
    fn to_bytes(&self, state: String) -> Result<Vec<u8>, String> {
        let crc = self.checksum(&state).to_string();
        let header = HashMap::from([("gadm".to_owned(), state), ("crc32".to_owned(), crc)]);
        safetensors::serialize(&self.0, Some(header)).map_err(|e| e.to_string())
    }

    fn checksum(&self, state: &str) -> u32 {
        let mut digest = CRC_32.digest();
        digest.update(state.as_bytes());
        for (name, array) in &self.0 {
            digest.update(name.as_bytes());
            // In pieces: the whole would be another copy.
            for piece in array.values.chunks(1 << 16) {
                digest.update(&piece.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>());
            }
        }
        digest.finalize()
    }

    fn from_bytes(bytes: &[u8]) -> Result<(Arrays<'static>, String), String> {
        let arrays = Arrays::read(bytes)?;
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| e.to_string())?;
        let entry = |key: &str| header.metadata().as_ref().and_then(|m| m.get(key));
        let state = entry("gadm").ok_or("a safetensors file, but not a checkpoint of this program")?.clone();
        // Files written before there was a checksum have none.
        if let Some(stored) = entry("crc32")
            && *stored != arrays.checksum(&state).to_string()
        {
            return Err("its checksum is wrong, so the file is damaged".to_owned());
        }
        Ok((arrays, state))
    }

    fn read(bytes: &[u8]) -> Result<Arrays<'static>, String> {
        let tensors = SafeTensors::deserialize(bytes)
            .map_err(|e| format!("damaged, cut short, or not a safetensors file ({e})"))?;
        let mut arrays = Arrays::default();
        for (name, view) in tensors.tensors() {
            if view.dtype() != Dtype::F32 {
                return Err(format!("`{name}` is {:?}, expected F32", view.dtype()));
            }
            let chunks = view.data().chunks_exact(4);
            let values: Vec<f32> = chunks.map(|c| f32::from_le_bytes([c[0], c[1], c[2], c[3]])).collect();
            arrays.put(name, view.shape().to_vec(), values);
        }
        Ok(arrays)
    }
}

#[derive(Serialize, Deserialize)]
struct RunState {
    version: u32,
    config: TrainConfig,
    counters: Counters,
    streams: Streams,
    window: Window,
    mask_statistics: (u64, u64, u64),
    envs: VecEnvState,
    nsteps: Vec<NStep>,
    adam_steps: [u64; 3],
    ar_next: usize,
    rl_next: usize,
    calibration_rows: usize,
}

/// Path of a checkpoint in a run folder.
pub fn path(dir: &Path, name: &str) -> PathBuf {
    dir.join(FOLDER).join(name)
}

fn bad(path: &Path) -> impl Fn(String) -> TrainError {
    let path = path.to_path_buf();
    move |reason| TrainError::Checkpoint { path: path.clone(), reason }
}

/// For a file that cannot be read back: what is wrong, and what to do.
fn unusable(path: &Path) -> impl Fn(String) -> TrainError {
    let bad = bad(path);
    move |reason| bad(format!("{reason}; put a copy of it in its place, or start a new run in another folder"))
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), TrainError> {
    atomic::write(path, bytes).map_err(|e| bad(path)(e.to_string()))
}

/// Writes the whole state of a run, atomically.
///
/// # Errors
/// [`TrainError::Checkpoint`] with the cause; the old file is then untouched.
pub fn save(run: &Run, dir: &Path) -> Result<(), TrainError> {
    let (rl_next, columns) = run.d_rl.arrays();
    let mut arrays = Arrays::default();
    let agent = &run.agent;
    arrays.networks(agent);
    arrays.params("target", &agent.dqn.target);
    arrays.adam("action-model", &agent.model.adam);
    arrays.adam("q", &agent.dqn.adam);
    if let Some(confidence) = &agent.confidence {
        arrays.adam("confidence", &confidence.adam);
    }
    for (name, average) in run.averages.iter().flat_map(|averages| &averages.0) {
        arrays.params(&format!("average/{name}"), average);
    }
    let (ar_next, obs, actions) = run.d_ar.arrays();
    arrays.flat("d_ar/obs", obs);
    arrays.flat("d_ar/actions", actions);
    arrays.replay(&columns);
    let state = RunState {
        version: VERSION,
        config: run.config.clone(),
        counters: run.counters.clone(),
        streams: run.streams.clone(),
        window: run.window.clone(),
        mask_statistics: agent.mask_statistics,
        envs: run.envs.save(),
        nsteps: run.nsteps.clone(),
        adam_steps: [
            agent.model.adam.steps,
            agent.dqn.adam.steps,
            agent.confidence.as_ref().map_or(0, |c| c.adam.steps),
        ],
        ar_next,
        rl_next,
        calibration_rows: CALIBRATION_ROWS,
    };
    let file = path(dir, LAST);
    let state = serde_json::to_string(&state).map_err(|e| bad(&file)(e.to_string()))?;
    write(&file, &arrays.to_bytes(state).map_err(bad(&file))?)
}

/// Continues a run from its folder.
///
/// # Errors
/// [`TrainError::NothingToResume`] without a checkpoint, [`TrainError::Checkpoint`] for a damaged or foreign one, with what
/// to do then.
pub fn load(dir: &Path) -> Result<Run, TrainError> {
    let file = path(dir, LAST);
    let (arrays, state) = read(dir, LAST)?;
    restore(&file, arrays, &state)
}

/// Continues a run of any algorithm from its folder.
///
/// # Errors
/// As [`load`].
pub fn load_any(dir: &Path) -> Result<Box<dyn AnyRun>, TrainError> {
    let file = path(dir, LAST);
    let (arrays, state) = read(dir, LAST)?;
    Ok(match algorithm(&state).map_err(unusable(&file))? {
        AlgorithmName::GadmDqn => Box::new(restore(&file, arrays, &state)?),
        _ => Box::new(baseline::restore(&file, arrays, &state)?),
    })
}

/// Arrays and run state of a file in a run folder.
fn read(dir: &Path, name: &str) -> Result<(Arrays<'static>, String), TrainError> {
    let file = path(dir, name);
    if !file.exists() {
        return Err(TrainError::NothingToResume { path: dir.to_path_buf() });
    }
    let bytes = std::fs::read(&file).map_err(TrainError::io("read", &file))?;
    Arrays::from_bytes(&bytes).map_err(unusable(&file))
}

/// Which algorithm a run state is of.
fn algorithm(state: &str) -> Result<AlgorithmName, String> {
    #[derive(Deserialize)]
    struct Stored {
        config: Named,
    }
    #[derive(Deserialize)]
    struct Named {
        algo: AlgorithmName,
    }
    let stored: Stored = parse(state)?;
    Ok(stored.config.algo)
}

fn restore(file: &Path, mut arrays: Arrays, state: &str) -> Result<Run, TrainError> {
    let bad = unusable(file);
    let state: RunState = parse(state).map_err(&bad)?;
    if state.nsteps.len() != state.config.collect.envs
        || state.window.code_counts.len() != state.config.action_model.latents
    {
        return Err(bad("its run state does not fit its configuration".to_owned()));
    }
    let mut run = Run::new(state.config)?;
    run.counters = state.counters;
    run.streams = state.streams;
    run.window = state.window;
    run.nsteps = state.nsteps;
    run.envs.restore(&state.envs).map_err(|e| bad(e.to_string()))?;
    let agent = &mut run.agent;
    agent.confidence_updates = run.counters.confidence_updates;
    agent.mask_statistics = state.mask_statistics;
    arrays.load_networks(agent).map_err(&bad)?;
    arrays.load_params("target", &mut agent.dqn.target).map_err(&bad)?;
    arrays.load_adam("action-model", &mut agent.model.adam, state.adam_steps[0]).map_err(&bad)?;
    arrays.load_adam("q", &mut agent.dqn.adam, state.adam_steps[1]).map_err(&bad)?;
    if let Some(confidence) = &mut agent.confidence {
        arrays.load_adam("confidence", &mut confidence.adam, state.adam_steps[2]).map_err(&bad)?;
    }
    if arrays.0.keys().any(|name| name.starts_with("average/")) {
        let mut averages = Averages::of(agent)?;
        for (name, average) in &mut averages.0 {
            arrays.load_params(&format!("average/{name}"), average).map_err(&bad)?;
        }
        run.averages = Some(averages);
    }
    let obs = arrays.take("d_ar/obs").map_err(&bad)?;
    let actions = arrays.take("d_ar/actions").map_err(&bad)?;
    let columns = arrays.take_replay().map_err(&bad)?;
    if !run.d_ar.restore(state.ar_next, obs, actions) || !run.d_rl.restore(state.rl_next, &columns) {
        return Err(bad("the replay arrays do not fit this configuration".to_owned()));
    }
    Ok(run)
}

fn parse<T: serde::de::DeserializeOwned>(state: &str) -> Result<T, String> {
    #[derive(Deserialize)]
    struct Version {
        version: u32,
    }
    let found: Version = serde_json::from_str(state).map_err(|e| format!("its run state is damaged ({e})"))?;
    if found.version != VERSION {
        return Err(format!(
            "it has layout version {}, this program reads {VERSION}: use the program that wrote it",
            found.version
        ));
    }
    serde_json::from_str(state).map_err(|e| format!("its run state is damaged ({e})"))
}

/// Saves the batch behind a number that is not finite: every array by name, rows x width.
///
/// # Errors
/// Where the file cannot be written.
pub fn save_batch(path: &Path, found: &NotFinite) -> Result<(), TrainError> {
    let mut arrays = Arrays::default();
    for (name, width, values) in &found.arrays {
        arrays.put(*name, vec![values.len() / width, *width], values);
    }
    write(path, &arrays.to_bytes(found.what.to_owned()).map_err(bad(path))?)
}

/// Writes state-action pairs as [`load_pairs`] reads them.
///
/// # Errors
/// Where the file cannot be written.
pub fn save_pairs(
    path: &Path,
    (obs, obs_dim): (&[f32], usize),
    (actions, slots): (&[f32], usize),
) -> Result<(), TrainError> {
    let mut arrays = Arrays::default();
    arrays.put("obs", vec![obs.len() / obs_dim, obs_dim], obs);
    arrays.put("actions", vec![actions.len() / slots, slots], actions);
    let bytes = arrays.to_bytes("state-action pairs".to_owned());
    let bytes = bytes.map_err(|reason| TrainError::Data { path: path.to_path_buf(), reason })?;
    Ok(atomic::write(path, &bytes)?)
}

/// Reads state-action pairs for the warm-up: `obs` (N x `obs_dim`) and `actions` (N x `slots`) from a safetensors file. `push`
/// takes a pair or says what is wrong with it.
///
/// # Errors
/// [`TrainError::Data`] with what is missing, has the wrong shape or an impossible value.
pub fn load_pairs(
    path: &Path,
    obs_dim: usize,
    slots: usize,
    mut push: impl FnMut(&[f32], &[f32]) -> Result<(), String>,
) -> Result<(), TrainError> {
    let bytes = std::fs::read(path).map_err(TrainError::io("read", path))?;
    let bad = |reason: String| TrainError::Data { path: path.to_path_buf(), reason };
    let arrays = Arrays::read(&bytes).map_err(bad)?;
    let get = |name: &str, width: usize| match arrays.0.get(name) {
        Some(Array { shape, values }) if shape.len() == 2 && shape[1] == width => Ok((shape[0], &values[..])),
        Some(Array { shape, .. }) => Err(bad(format!("`{name}` has shape {shape:?}, expected N x {width}"))),
        None => {
            Err(bad(format!("`{name}` is missing; the file needs `obs` (N x {obs_dim}) and `actions` (N x {slots})")))
        }
    };
    let ((n, obs), (m, actions)) = (get("obs", obs_dim)?, get("actions", slots)?);
    if n != m || n == 0 {
        return Err(bad(format!("{n} observations but {m} actions; expected as many, at least one")));
    }
    for (name, values, width) in [("obs", obs, obs_dim), ("actions", actions, slots)] {
        if let Some(at) = values.iter().position(|v| !v.is_finite()) {
            let row = at / width;
            return Err(bad(format!("`{name}`, row {row}: expected finite numbers, found {}", values[at])));
        }
    }
    for (row, (o, a)) in obs.chunks_exact(obs_dim).zip(actions.chunks_exact(slots)).enumerate() {
        push(o, a).map_err(|reason| bad(format!("row {row}: {reason}")))?;
    }
    Ok(())
}
