//! Reading a recording: unpacking, parsing, and every check of its shape. What comes out can be replayed without one.

use std::{
    collections::BTreeMap,
    fs::File,
    io::{BufReader, Read},
    path::Path,
};

use flate2::read::MultiGzDecoder;
use serde::Deserialize;

use super::GoldenError;
use crate::{
    ArgumentMask, EnvSpec, RewardConvention, ToyOptions,
    task::{Draws, Task},
};

/// Unpacked size that no recording reaches, bytes.
const MAX_BYTES: u64 = 256 << 20;
/// Larger numbers make MuJoCo reset itself (`mjMAXVAL`); no recording has them.
const MAX_NUMBER: f64 = 1e10;

#[derive(Deserialize)]
struct Head {
    format: u64,
    env: String,
}

#[derive(Deserialize)]
struct Document {
    #[serde(default)]
    versions: Versions,
    #[serde(default)]
    meta: Meta,
    trajectories: Vec<RawTrajectory>,
}

#[derive(Default, Deserialize)]
struct Versions {
    machine: Option<String>,
    mujoco: Option<String>,
}

#[derive(Default, Deserialize)]
struct Meta {
    #[serde(default)]
    kwargs: serde_json::Map<String, serde_json::Value>,
    reward_convention: Option<RewardConvention>,
}

#[derive(Deserialize)]
struct RawTrajectory {
    name: String,
    action_dtype: Option<String>,
    time_limit: Option<u64>,
    init: RawInit,
    actions: Vec<RawAction>,
    obs: Vec<Vec<f64>>,
    rewards: Vec<f64>,
    terminated: Vec<bool>,
    truncated: Vec<bool>,
    states: BTreeMap<String, Vec<Numbers>>,
    #[serde(default)]
    info: RawInfo,
    terrain_heights: Option<Vec<f64>>,
    initial_force: Option<Vec<f64>>,
    reset_dispersion: Option<Vec<f64>>,
}

/// Draws of each step, where the reference draws while it runs.
#[derive(Default, Deserialize)]
struct RawInfo {
    dispersion: Option<Vec<Vec<f64>>>,
}

#[derive(Deserialize)]
struct RawInit {
    state: BTreeMap<String, Numbers>,
    obs: Vec<f64>,
}

/// One state entry: an array, a number, a flag, or null for a number that the reference does not have.
#[derive(Deserialize)]
#[serde(untagged)]
enum Numbers {
    Many(Vec<f64>),
    One(f64),
    Flag(bool),
    Open(()),
}

#[derive(Deserialize)]
#[serde(untagged)]
enum RawAction {
    Flat(Vec<f64>),
    Hybrid(u64, Vec<f64>),
}

/// One step of a recording. `state` is in the order of [`Task::fields`], with NaN for an open number.
pub(super) struct RecordedStep {
    pub(super) action: Vec<f64>,
    pub(super) obs: Vec<f64>,
    pub(super) reward: f64,
    pub(super) terminated: bool,
    pub(super) truncated: bool,
    pub(super) state: Vec<f64>,
}

/// One trajectory.
pub(super) struct Trajectory {
    pub(super) name: String,
    pub(super) single_precision: bool,
    pub(super) time_limit: Option<u64>,
    pub(super) state: Vec<f64>,
    pub(super) obs: Vec<f64>,
    /// Random draws in the order of their use; none where the task draws only at a reset.
    pub(super) draws: Vec<f64>,
    pub(super) steps: Vec<RecordedStep>,
}

/// A recording whose shapes fit its environment.
pub(super) struct Recording {
    pub(super) reference: String,
    pub(super) id: &'static str,
    pub(super) task: Box<dyn Task>,
    /// Whether the reference ran on another processor family than this program does.
    pub(super) foreign: bool,
    /// Whether MuJoCo did.
    pub(super) foreign_mujoco: bool,
    pub(super) trajectories: Vec<Trajectory>,
}

/// Reads and checks a file.
pub(super) fn read(path: &Path) -> Result<Recording, GoldenError> {
    let text = unpack(path)?;
    let json = |source| GoldenError::Json { path: path.to_owned(), source };
    let head: Head = serde_json::from_slice(&text).map_err(json)?;
    if head.format != 1 {
        return Err(GoldenError::Format { path: path.to_owned(), found: head.format });
    }
    // Names first: a recording of another environment may have another shape.
    if let Some(reason) = not_offered(&head.env) {
        return Err(GoldenError::NotOffered { path: path.to_owned(), name: head.env, reason: reason.to_owned() });
    }
    let document: Document = serde_json::from_slice(&text).map_err(json)?;
    let not_here = |reason: String| GoldenError::NotOffered { path: path.to_owned(), name: head.env.clone(), reason };
    let id = registry_id(&head.env, &document.meta).map_err(not_here)?;
    let toy = ToyOptions { reward: document.meta.reward_convention.unwrap_or_default(), ..ToyOptions::default() };
    let task = crate::registry::task(id, toy).map_err(|source| GoldenError::Env { path: path.to_owned(), source })?;
    let Versions { machine, mujoco } = document.versions;
    let foreign = machine.is_some_and(|m| m != std::env::consts::ARCH);
    let foreign_mujoco = foreign && mujoco.is_some();
    let content = |(place, message)| GoldenError::Content { path: path.to_owned(), place, message };
    if document.trajectories.is_empty() {
        return Err(content(("trajectories".to_owned(), "expected at least one, found none".to_owned())));
    }
    let trajectories = document.trajectories.into_iter().enumerate().map(|(i, raw)| {
        let name = format!("trajectory {i} `{}`", raw.name);
        trajectory(&*task, raw).map_err(|(place, message)| content((format!("{name}: {place}"), message)))
    });
    let trajectories = trajectories.collect::<Result<_, _>>()?;
    Ok(Recording { reference: head.env, id, task, foreign, foreign_mujoco, trajectories })
}

fn unpack(path: &Path) -> Result<Vec<u8>, GoldenError> {
    let read = |source| GoldenError::Read { path: path.to_owned(), source };
    let file = File::open(path).map_err(read)?;
    let mut text = Vec::new();
    MultiGzDecoder::new(BufReader::new(file)).take(MAX_BYTES + 1).read_to_end(&mut text).map_err(read)?;
    if text.len() as u64 > MAX_BYTES {
        return Err(GoldenError::TooLarge { path: path.to_owned(), limit: MAX_BYTES });
    }
    Ok(text)
}

/// Reason why a known reference environment is not here.
fn not_offered(name: &str) -> Option<&'static str> {
    if name.starts_with("GoBigger") {
        Some("which is out of this crate's scope")
    } else if name.starts_with("HyAR") {
        Some("HyAR's own Hard Move, which is out of this crate's scope; the paper's is `hard-move-4` to `hard-move-10`")
    } else {
        None
    }
}

/// Our id of a reference environment, or why there is none.
fn registry_id(name: &str, meta: &Meta) -> Result<&'static str, String> {
    let wanted = match name {
        "ToyEnv" => "toy-env".to_owned(),
        "Moving-v0" => "moving".to_owned(),
        "Sliding-v0" => "sliding".to_owned(),
        "Pendulum-v1" => "pendulum".to_owned(),
        "LunarLander-v3" => "lunar-lander".to_owned(),
        "LunarLanderContinuous-v3" => "lunar-lander-continuous".to_owned(),
        _ => match name.strip_prefix("HardMove-v0 n=") {
            Some(n) => format!("hard-move-{n}"),
            // HalfCheetah-v4 -> half-cheetah-v4
            None => name.char_indices().fold(String::new(), |mut id, (i, c)| {
                if c.is_uppercase() && i > 0 {
                    id.push('-');
                }
                id.extend(c.to_lowercase());
                id
            }),
        },
    };
    let contact = meta.kwargs.get("use_contact_forces").is_some_and(|v| v == true);
    let wanted = if contact { format!("{wanted}-contact") } else { wanted };
    if meta.kwargs.len() > usize::from(contact) {
        let options: Vec<_> = meta.kwargs.keys().cloned().collect();
        return Err(format!("with options that are not offered here: {}", options.join(", ")));
    }
    crate::registry::ids().find(|id| *id == wanted).ok_or_else(|| {
        format!("and there is no environment `{wanted}`; known: {}", crate::ids().collect::<Vec<_>>().join(", "))
    })
}

type Misfit = (String, String);

fn misfit(place: impl Into<String>, message: impl Into<String>) -> Misfit {
    (place.into(), message.into())
}

fn trajectory(task: &dyn Task, raw: RawTrajectory) -> Result<Trajectory, Misfit> {
    let spec = task.spec();
    let single_precision = match raw.action_dtype.as_deref() {
        None | Some("float64") => false,
        Some("float32") => true,
        Some(other) => return Err(misfit("action_dtype", format!("expected float32 or float64, found `{other}`"))),
    };
    let t = raw.actions.len();
    let lengths = [
        ("obs", raw.obs.len()),
        ("rewards", raw.rewards.len()),
        ("terminated", raw.terminated.len()),
        ("truncated", raw.truncated.len()),
    ];
    for (key, found) in lengths.into_iter().chain(raw.states.iter().map(|(key, list)| (key.as_str(), list.len()))) {
        if found != t {
            return Err(misfit(key, format!("expected {t} entries, one per action, found {found}")));
        }
    }
    let state = state(task, "init", |key| raw.init.state.get(key))?;
    if state.iter().enumerate().any(|(i, v)| v.is_nan() && !may_be_open(task, i)) {
        return Err(misfit("init", "a number of the state is null"));
    }
    let obs = numbers("init obs", raw.init.obs, spec.obs_dim())?;
    let draws = match task.draws() {
        Some(needed) => {
            let at_reset = [raw.terrain_heights, raw.initial_force, raw.reset_dispersion];
            recorded_draws(needed, t, at_reset, raw.info.dispersion)?
        }
        None => vec![],
    };
    let mut steps = Vec::with_capacity(t);
    let given = raw.actions.into_iter().zip(raw.obs).zip(raw.rewards).zip(raw.terminated).zip(raw.truncated);
    for (k, ((((action, obs), reward), terminated), truncated)) in given.enumerate() {
        let place = format!("step {}", k + 1);
        let action = action_vector(spec, action).map_err(|message| misfit(format!("{place} action"), message))?;
        let obs = numbers(&format!("{place} obs"), obs, spec.obs_dim())?;
        let state = self::state(task, &place, |key| raw.states.get(key).map(|list| &list[k]))?;
        steps.push(RecordedStep { action, obs, reward, terminated, truncated, state });
    }
    Ok(Trajectory { name: raw.name, single_precision, time_limit: raw.time_limit, state, obs, draws, steps })
}

fn numbers(place: &str, values: Vec<f64>, expected: usize) -> Result<Vec<f64>, Misfit> {
    if values.len() == expected {
        Ok(values)
    } else {
        Err(misfit(place, format!("expected {expected} numbers, found {}", values.len())))
    }
}

/// The draws in the order of their use.
fn recorded_draws(
    needed: Draws,
    steps: usize,
    at_reset: [Option<Vec<f64>>; 3],
    per_step: Option<Vec<Vec<f64>>>,
) -> Result<Vec<f64>, Misfit> {
    let place = "terrain_heights, initial_force, reset_dispersion";
    let mut draws = numbers(place, at_reset.into_iter().flatten().flatten().collect(), needed.at_reset)?;
    let per_step = per_step.unwrap_or_default();
    if per_step.len() != steps {
        return Err(misfit("info dispersion", format!("expected {steps} entries, found {}", per_step.len())));
    }
    for (k, of_step) in per_step.into_iter().enumerate() {
        draws.extend(numbers(&format!("step {} info dispersion", k + 1), of_step, needed.per_step)?);
    }
    match draws.iter().find(|v| v.abs() > MAX_NUMBER) {
        Some(large) => Err(misfit("draws", format!("expected numbers within ±{MAX_NUMBER:e}, found {large:e}"))),
        None => Ok(draws),
    }
}

/// Only the direction of motion is open in recordings, of Moving, which has none.
fn may_be_open(task: &dyn Task, index: usize) -> bool {
    let mut at = 0;
    task.fields().iter().any(|(key, len)| {
        at += len;
        *key == "phi" && at == index + 1
    })
}

fn state<'a>(task: &dyn Task, place: &str, find: impl Fn(&str) -> Option<&'a Numbers>) -> Result<Vec<f64>, Misfit> {
    let mut out = Vec::new();
    for (key, len) in task.fields() {
        let place = || format!("{place} state `{key}`");
        let values: &[f64] = match find(key) {
            None => return Err(misfit(place(), "missing")),
            Some(Numbers::Many(values)) => values,
            Some(Numbers::One(value)) => std::slice::from_ref(value),
            Some(Numbers::Flag(flag)) => &[f64::from(u8::from(*flag))],
            Some(Numbers::Open(())) => &[f64::NAN],
        };
        if values.len() != len {
            return Err(misfit(place(), format!("expected {len} numbers, found {}", values.len())));
        }
        if let Some(large) = values.iter().find(|v| v.abs() > MAX_NUMBER) {
            return Err(misfit(place(), format!("expected numbers within ±{MAX_NUMBER:e}, found {large:e}")));
        }
        out.extend_from_slice(values);
    }
    Ok(out)
}

/// The action as our task takes it: one number per slot.
fn action_vector(spec: &EnvSpec, action: RawAction) -> Result<Vec<f64>, String> {
    let vector = match (&spec.argument_mask, action) {
        (ArgumentMask::All, RawAction::Flat(values)) => values,
        (ArgumentMask::ByType(mask), RawAction::Hybrid(kind, given)) => by_type(mask, kind, given)?,
        (ArgumentMask::BySwitch, RawAction::Hybrid(index, distances)) => by_switch(spec, index, distances)?,
        (ArgumentMask::All, RawAction::Hybrid(..)) => return Err("expected a list of numbers, found a type".to_owned()),
        (_, RawAction::Flat(_)) => return Err("expected `[type, [parameters]]`, found a list of numbers".to_owned()),
    };
    if vector.len() != spec.action_dim() {
        return Err(format!("expected {} numbers, found {}", spec.action_dim(), vector.len()));
    }
    match vector.iter().find(|v| v.abs() > MAX_NUMBER) {
        Some(large) => Err(format!("expected numbers within ±{MAX_NUMBER:e}, found {large:e}")),
        None => Ok(vector),
    }
}

/// A type with all parameters, or only with those it uses.
fn by_type(mask: &[Vec<bool>], kind: u64, given: Vec<f64>) -> Result<Vec<f64>, String> {
    let Some(row) = usize::try_from(kind).ok().and_then(|k| mask.get(k)) else {
        return Err(format!("expected a type below {}, found {kind}", mask.len()));
    };
    let parameters = if given.len() == row.len() {
        given
    } else {
        let used = row.iter().filter(|used| **used).count();
        if given.len() != used {
            return Err(format!("type {kind}: expected {used} or {} parameters, found {}", row.len(), given.len()));
        }
        let mut given = given.into_iter();
        row.iter().map(|used| if *used { given.next().unwrap_or(0.0) } else { 0.0 }).collect()
    };
    Ok(std::iter::once(kind as f64).chain(parameters).collect())
}

/// An index whose most significant bit is the first switch, and all distances.
fn by_switch(spec: &EnvSpec, index: u64, distances: Vec<f64>) -> Result<Vec<f64>, String> {
    let n = spec.action_dim() / 2;
    if index >> n != 0 {
        return Err(format!("expected an index below 2^{n}, found {index}"));
    }
    let switches = (0..n).rev().map(|bit| ((index >> bit) & 1) as f64);
    Ok(switches.chain(distances).collect())
}
