//! What is there of a run: read from its folder alone, so that a run trained by `gadm train` counts like any other.

use std::path::Path;

use serde::Serialize;

use super::plan::{Plan, PlannedRun};
use crate::config::resolve::resolve;
use crate::config::{Layer, TrainConfig, to_toml};
use crate::metrics::jsonl::{METRICS_FILE, read_jsonl};
use crate::runner::origin::Origin;
use crate::runner::train::{CONFIG_FILE, in_use, trained_s};

/// Steps per second that a cost is reckoned with where nothing has been measured and nothing else is known: about what GADM+DQN does on one core with
/// the built-in configurations of Hopper and Moving (`docs/src/results/shipped.md`).
pub const ASSUMED_STEPS_PER_S: f64 = 500.0;

/// How far a run is.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case", tag = "state", content = "detail")]
pub enum State {
    /// Nothing there.
    Missing,
    /// Started.
    Partial,
    /// All steps done.
    Done,
    /// The folder holds a run with another configuration; what differs.
    Other(String),
}

/// What is there of a run.
#[derive(Clone, Debug, Serialize)]
pub struct Status {
    /// How far it is.
    #[serde(flatten)]
    pub state: State,
    /// Environment steps of its last record.
    pub env_steps: u64,
    /// Wall-clock time of the training, s.
    pub wall_s: f64,
    /// Whether a process trains in its folder now.
    pub running: bool,
    /// Commit that it was started with.
    pub commit: Option<String>,
}

impl Status {
    /// Steps per second so far.
    pub fn steps_per_s(&self) -> Option<f64> {
        (self.wall_s > 0.0 && self.env_steps > 0).then(|| self.env_steps as f64 / self.wall_s)
    }
}

/// Looks into the folder of `run`.
pub fn inspect(run: &PlannedRun) -> Status {
    let dir = &run.dir;
    let mut status = Status { state: State::Missing, env_steps: 0, wall_s: 0.0, running: false, commit: None };
    let Ok(text) = std::fs::read_to_string(dir.join(CONFIG_FILE)) else { return status };
    status.running = in_use(dir);
    status.commit = Origin::of_run(dir).ok().map(|origin| origin.commit);
    (status.env_steps, status.wall_s) = (last_step(dir), trained_s(dir));
    status.state = match stored(&text).map(|stored| difference(&run.config, &stored)) {
        Err(detail) | Ok(Some(detail)) => State::Other(detail),
        Ok(None) if status.env_steps >= run.steps => State::Done,
        Ok(None) => State::Partial,
    };
    status
}

/// The configuration in a run folder, from the text of its file.
///
/// # Errors
/// What is wrong with it.
pub fn stored(text: &str) -> Result<TrainConfig, String> {
    let layer = Layer::Toml { origin: CONFIG_FILE.to_owned(), text: text.to_owned() };
    resolve(&[layer]).map_err(|e| e.to_string())
}

/// The first line in which two configurations differ. The number of steps and the tracking change nothing that is learned, and
/// files of recorded actions are told apart by their names: the folder may have been moved.
fn difference(planned: &TrainConfig, stored: &TrainConfig) -> Option<String> {
    let plain = |config: &TrainConfig| {
        let mut config = config.clone();
        config.steps = planned.steps;
        config.track.checkpoint_every = planned.track.checkpoint_every;
        config.track.log_every = planned.track.log_every;
        config.track.snapshots.clone_from(&planned.track.snapshots);
        let files = [config.warmup.data.as_mut(), config.algo.data_mut()];
        for path in files.into_iter().flatten() {
            *path = path.file_name().map(Into::into).unwrap_or_default();
        }
        config
    };
    let (planned, stored) = (plain(planned), plain(stored));
    if planned == stored {
        return None;
    }
    let (a, b) = (to_toml(&stored).unwrap_or_default(), to_toml(&planned).unwrap_or_default());
    let line = a.lines().zip(b.lines()).find(|(x, y)| x != y);
    Some(line.map_or_else(|| "another set of keys".to_owned(), |(x, y)| format!("there `{x}`, expected `{y}`")))
}

/// Environment steps of the last record; 0 where there is none.
pub fn last_step(dir: &Path) -> u64 {
    read_jsonl(&dir.join(METRICS_FILE)).ok().and_then(|records| Some(records.last()?.0)).unwrap_or(0)
}

/// How fast runs like `run` were, and whether that is measured.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Rate {
    /// Environment steps per second.
    pub steps_per_s: f64,
    /// False where it is the one that the task assumes.
    pub measured: bool,
}

/// The rate of `run`: its own, else the mean of those with its environment and variant, else of its environment and
/// algorithm, else the assumed one.
pub fn rate(run: &PlannedRun, all: &[(&PlannedRun, &Status)]) -> Rate {
    let own = all.iter().find(|(other, _)| other.dir == run.dir).and_then(|(_, status)| status.steps_per_s());
    let of = |same: &dyn Fn(&PlannedRun) -> bool| {
        let rates: Vec<f64> =
            all.iter().filter(|(other, _)| same(other)).filter_map(|(_, status)| status.steps_per_s()).collect();
        super::stats::mean(&rates)
    };
    let env = |other: &PlannedRun| other.task.env == run.task.env;
    let found = own
        .or_else(|| of(&|other| env(other) && other.variant.id == run.variant.id))
        .or_else(|| of(&|other| env(other) && other.variant.algo == run.variant.algo));
    Rate { steps_per_s: found.unwrap_or(run.task.assumed_steps_per_s), measured: found.is_some() }
}

/// What the rest of a figure costs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Cost {
    /// Runs that are done.
    pub done: usize,
    /// Runs that were started.
    pub partial: usize,
    /// Runs that are missing.
    pub missing: usize,
    /// Folders with another configuration.
    pub other: usize,
    /// Environment steps left.
    pub steps_left: u64,
    /// Processor time left, s, with one core a run.
    pub core_s: f64,
    /// The part of it whose rate is assumed, s.
    pub assumed_s: f64,
}

/// The state of all runs of a plan.
pub fn survey(plan: &Plan) -> Vec<Status> {
    plan.runs.iter().map(inspect).collect()
}

/// Sums over `runs`; `all` is where rates are taken from.
pub fn cost<'a>(runs: impl IntoIterator<Item = (&'a PlannedRun, &'a Status)>, all: &[(&PlannedRun, &Status)]) -> Cost {
    let mut cost = Cost::default();
    for (run, status) in runs {
        match status.state {
            State::Done => cost.done += 1,
            State::Partial => cost.partial += 1,
            State::Missing => cost.missing += 1,
            State::Other(_) => cost.other += 1,
        }
        if matches!(status.state, State::Partial | State::Missing) {
            let left = run.steps.saturating_sub(status.env_steps);
            let rate = rate(run, all);
            let seconds = left as f64 / rate.steps_per_s;
            cost.steps_left += left;
            cost.core_s += seconds;
            cost.assumed_s += if rate.measured { 0.0 } else { seconds };
        }
    }
    cost
}

#[cfg(test)]
mod tests {
    use super::super::figure::figure;
    use super::super::plan::Options;
    use super::*;
    use crate::metrics::jsonl::TIMING_FILE;

    fn plan(out: &Path) -> Plan {
        let options = Options { seeds: Some(2), steps: Some(2_000), out: out.to_owned(), only: None };
        Plan::new(figure("demo").unwrap(), &options).unwrap()
    }

    /// A run folder as training leaves it.
    fn folder(run: &PlannedRun, config: &TrainConfig, env_steps: u64, walls: &[f64]) {
        std::fs::create_dir_all(&run.dir).unwrap();
        std::fs::write(run.dir.join(CONFIG_FILE), to_toml(config).unwrap()).unwrap();
        std::fs::write(run.dir.join(METRICS_FILE), format!("{{\"env_steps\":{env_steps},\"q_loss\":1.0}}\n")).unwrap();
        let lines: Vec<String> =
            walls.iter().map(|wall| format!("{{\"env_steps\":{env_steps},\"wall_s\":{wall}}}\n")).collect();
        std::fs::write(run.dir.join(TIMING_FILE), lines.concat()).unwrap();
    }

    #[test]
    fn a_run_is_missing_partial_done_or_another() {
        let out = tempfile::tempdir().unwrap();
        let plan = plan(out.path());
        let run = &plan.runs[0];
        assert_eq!(inspect(run).state, State::Missing);
        folder(run, &run.config, 1_000, &[2.0, 4.0, 1.0]);
        let status = inspect(run);
        assert_eq!((status.state.clone(), status.env_steps, status.wall_s), (State::Partial, 1_000, 5.0));
        assert_eq!(status.steps_per_s(), Some(200.0), "two sessions, of 4 s and 1 s");
        // Trained for longer than asked for.
        folder(run, &TrainConfig { steps: 9_000, ..run.config.clone() }, 9_000, &[1.0]);
        assert_eq!(inspect(run).state, State::Done);
        // Of a program that kept no snapshots.
        let mut kept = run.clone();
        kept.config.track.snapshots = vec![0, 500];
        assert_eq!(inspect(&kept).state, State::Done);
        folder(run, &TrainConfig { seed: 7, ..run.config.clone() }, 9_000, &[1.0]);
        assert_eq!(inspect(run).state, State::Other("there `seed = 7`, expected `seed = 0`".to_owned()));
    }

    #[test]
    fn a_moved_folder_keeps_its_runs() {
        let (out, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let (here, there) = (plan(out.path()), plan(other.path()));
        let at = here.runs.iter().position(|run| run.data.is_some()).unwrap();
        assert_ne!(here.runs[at].config, there.runs[at].config);
        folder(&here.runs[at], &there.runs[at].config, 2_000, &[1.0]);
        assert_eq!(inspect(&here.runs[at]).state, State::Done);
    }

    #[test]
    fn the_cost_is_reckoned_from_the_nearest_measured_rate() {
        let out = tempfile::tempdir().unwrap();
        let plan = plan(out.path());
        let named = |name: &str| plan.runs.iter().find(|run| run.name == name).unwrap();
        let half = named("pendulum/td3-small-seed0");
        folder(half, &half.config, 1_000, &[10.0]);
        let statuses = survey(&plan);
        let all: Vec<_> = plan.runs.iter().zip(&statuses).collect();
        assert_eq!(rate(half, &all), Rate { steps_per_s: 100.0, measured: true });
        assert_eq!(rate(named("pendulum/td3-small-seed1"), &all), Rate { steps_per_s: 100.0, measured: true });
        let gadm = rate(named("pendulum/gadm-dqn-small-seed0"), &all);
        assert_eq!(gadm, Rate { steps_per_s: ASSUMED_STEPS_PER_S, measured: false });
        let cost = cost(all.iter().copied(), &all);
        assert_eq!((cost.done, cost.partial, cost.missing), (0, 1, 5));
        // The expert trains for 4,000 steps, whatever the others do.
        assert_eq!(cost.steps_left, 3_000 + 2_000 + 4 * 2_000);
        assert!((cost.core_s - (50.0 + 16.0)).abs() < 1e-9 && (cost.assumed_s - 16.0).abs() < 1e-9, "{cost:?}");
    }
}
