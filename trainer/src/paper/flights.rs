//! Episodes of the policies that a run had on its way: how often they do nothing, what they burn, and where they fly
//! (specification 8.7, figures 14 and 15).
//!
//! Every snapshot flies the same episodes, which no training saw. What they gave stays in the run's folder, so that drawing again
//! flies nothing.

use std::path::PathBuf;

use gadm_envs::make_with;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::PaperError;
use super::columns::Columns;
use super::plan::{Plan, PlannedRun};
use super::state::{State, inspect};
use super::stats::mean;
use crate::atomic;
use crate::error::TrainError;
use crate::plot::{Class, Cloud, CurvePoint, RunCurve};
use crate::runner::checkpoint::{Networks, load_trained, snapshots};
use crate::runner::evaluate_watched;
use crate::seed::SeedTree;

/// Episodes of a snapshot (the authors' scripts).
pub const EPISODES: usize = 20;
/// Version of the stored form.
const VERSION: u32 = 1;
/// A side engine fires beyond this, either way; the main engine fires above 0.
const SIDE_THRESHOLD: f64 = 0.5;

/// Names of the bands of returns, from below, and which colours of the palette they have.
pub const BANDS: [(&str, usize); 4] =
    [("return below −100", 3), ("−100 to 0", 0), ("0 to 200", 2), ("200 and above", 6)];

/// Which of [`BANDS`] a return is in.
fn band(total: f64) -> usize {
    [-100.0, 0.0, 200.0].iter().filter(|end| total >= **end).count()
}

/// An episode.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Flown {
    /// Its return.
    pub total: f64,
    /// Steps at which no engine is asked for: main throttle below 0, side throttle within ±0.5.
    pub no_ops: u64,
    /// Sum over the steps of the main throttle where it is above 0.
    pub main: f64,
    /// Sum over the steps of the side throttle's amount where that is above 0.5.
    pub side: f64,
    /// The first two observations of every step: position beside and above the pad, in the units of the observation.
    pub path: Vec<[f32; 2]>,
}

impl Flown {
    /// Counts one step: what was seen, and what was done in native units.
    fn add(&mut self, obs: &[f32], action: &[f32]) {
        let (main, side) = (f64::from(action[0]), f64::from(action[1]));
        self.no_ops += u64::from(main < 0.0 && side.abs() < SIDE_THRESHOLD);
        self.main += main.max(0.0);
        self.side += if side.abs() > SIDE_THRESHOLD { side.abs() } else { 0.0 };
        self.path.push([obs[0], obs[1]]);
    }
}

/// The episodes of a policy, as they are stored.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Flights {
    version: u32,
    /// Environment steps that the policy had been trained for.
    pub env_steps: u64,
    /// Seed of the episodes.
    pub seed: u64,
    /// The episodes.
    pub episodes: Vec<Flown>,
}

impl Flights {
    /// Share of the steps at which no engine is asked for.
    pub fn no_op_share(&self) -> f64 {
        let steps: usize = self.episodes.iter().map(|episode| episode.path.len()).sum();
        self.episodes.iter().map(|episode| episode.no_ops).sum::<u64>() as f64 / steps.max(1) as f64
    }

    /// Mean over the episodes.
    fn over(&self, value: impl Fn(&Flown) -> f64) -> f64 {
        mean(&self.episodes.iter().map(value).collect::<Vec<_>>()).unwrap_or(f64::NAN)
    }

    /// Episodes in each of [`BANDS`].
    fn bands(&self) -> [u64; BANDS.len()] {
        let mut counts = [0; BANDS.len()];
        self.episodes.iter().for_each(|episode| counts[band(episode.total)] += 1);
        counts
    }
}

/// The episodes of one run at one step.
#[derive(Clone, Debug)]
pub struct Snapshot<'a> {
    /// The run.
    pub run: &'a PlannedRun,
    /// Environment step as it was asked for; the networks are those of the end of the round that reached it.
    pub step: u64,
    /// Its episodes.
    pub flights: Flights,
}

/// Steps at which the runs of `plan` are looked at: their snapshots, and their end.
pub fn steps(plan: &Plan) -> Vec<u64> {
    let end = plan.runs.iter().filter(|run| run.shown).map(|run| run.steps).min().unwrap_or(0);
    let marks = plan.runs.iter().flat_map(|run| run.config.track.snapshots.iter().copied());
    let mut steps: Vec<u64> = marks.filter(|step| *step < end).chain([end]).collect();
    steps.sort_unstable();
    steps.dedup();
    steps
}

/// Reads or flies the episodes of the runs of `plan` at [`steps`], run by run; of runs that are not done only with `partial`, and
/// only what is there of them.
///
/// # Errors
/// [`PaperError::Train`] for networks that cannot be read, [`PaperError::Write`].
pub fn gather(plan: &Plan, partial: bool) -> Result<Vec<Snapshot<'_>>, PaperError> {
    let mut found = Vec::new();
    for run in plan.runs.iter().filter(|run| run.shown) {
        let status = inspect(run);
        if status.state != State::Done && !(partial && status.state == State::Partial) {
            continue;
        }
        let kept = snapshots(&run.dir);
        for step in steps(plan) {
            let networks = if kept.contains(&step) {
                Networks::Snapshot(step)
            } else if step == run.steps && status.state == State::Done {
                Networks::Last
            } else {
                tracing::warn!("{}: no snapshot of step {step}: it was trained without keeping one", run.name);
                continue;
            };
            if let Some(flights) = of(run, step, networks)? {
                found.push(Snapshot { run, step, flights });
            }
        }
    }
    Ok(found)
}

/// The episodes of `networks`, read or flown; `None` where they are the last ones of a run that went on beyond `step`.
fn of(run: &PlannedRun, step: u64, networks: Networks) -> Result<Option<Flights>, PaperError> {
    // The same for every run: they differ by their policies alone.
    let seed = SeedTree::new(0).number("paper.flights");
    let path = run.dir.join(format!("flights-{step}.json"));
    if let Some(stored) = stored(&path).filter(|flights| flights.seed == seed && flights.episodes.len() == EPISODES) {
        return Ok(Some(stored));
    }
    let mut trained = load_trained(&run.dir, networks)?;
    if networks == Networks::Last && trained.config.steps != step {
        tracing::warn!("{}: no snapshot of step {step}: the run went on beyond it", run.name);
        return Ok(None);
    }
    let env_steps = trained.counters.env_steps;
    tracing::info!("{}: flying {EPISODES} episodes at step {env_steps}", run.name);
    let env = || make_with(&trained.config.env, &trained.config.env_options).map_err(TrainError::from);
    let envs = (0..EPISODES).map(|_| env()).collect::<Result<Vec<_>, _>>()?;
    let heads: Vec<_> = envs[0].spec().actions.iter().map(|slot| slot.head).collect();
    let mut episodes = vec![Flown::default(); EPISODES];
    let evaluation = evaluate_watched(trained.actor(), envs, seed, |episode, obs, action| {
        let native: Vec<f32> = heads.iter().zip(action).map(|(head, &a)| head.denormalise(a)).collect();
        episodes[episode].add(obs, &native);
    });
    for (episode, total) in episodes.iter_mut().zip(&evaluation.returns) {
        episode.total = *total;
    }
    let flights = Flights { version: VERSION, env_steps, seed, episodes };
    let text = serde_json::to_string(&flights).expect("numbers serialise");
    atomic::write(&path, text.as_bytes())?;
    Ok(Some(flights))
}

/// What an earlier call stored; `None` where it cannot be used, and is flown again.
fn stored(path: &PathBuf) -> Option<Flights> {
    let flights: Flights = serde_json::from_slice(&std::fs::read(path).ok()?).ok()?;
    (flights.version == VERSION).then_some(flights)
}

/// Share of no-ops over the steps, a curve for each run.
pub fn no_op_curves(found: &[Snapshot<'_>]) -> Vec<RunCurve> {
    found
        .chunk_by(|a, b| a.run.dir == b.run.dir)
        .map(|of_run| {
            let point = |s: &Snapshot<'_>| CurvePoint {
                env_steps: s.step as f64,
                mean: 100.0 * s.flights.no_op_share(),
                sd: 0.0,
            };
            RunCurve { label: of_run[0].run.variant.label.to_owned(), points: of_run.iter().map(point).collect() }
        })
        .collect()
}

/// Where the episodes of the first seed flew: a panel for each variant and step, variant by variant.
pub fn paths(plan: &Plan, found: &[Snapshot<'_>]) -> Vec<Cloud> {
    let seed = plan.runs.iter().filter(|run| run.shown).map(|run| run.seed).min().unwrap_or(0);
    let shown = |variant: &str| plan.runs.iter().any(|run| run.shown && run.variant.id == variant);
    let mut panels = Vec::new();
    for variant in plan.figure.variants.iter().filter(|variant| shown(variant.id)) {
        for step in steps(plan) {
            let own = |s: &&Snapshot<'_>| s.run.variant.id == variant.id && s.step == step && s.run.seed == seed;
            let mut points = vec![Vec::new(); BANDS.len()];
            for episode in found.iter().filter(own).flat_map(|s| &s.flights.episodes) {
                let places = episode.path.iter().map(|[x, y]| (f64::from(*x), f64::from(*y)));
                points[band(episode.total)].extend(places);
            }
            panels.push(Cloud { title: format!("{}, {} steps", variant.label, in_thousands(step)), points });
        }
    }
    panels
}

/// `100k`.
fn in_thousands(step: u64) -> String {
    if step > 0 && step.is_multiple_of(1000) { format!("{}k", step / 1000) } else { step.to_string() }
}

/// The classes of [`paths`].
pub fn classes() -> Vec<Class> {
    BANDS.iter().map(|(name, color)| Class { name: (*name).to_owned(), color: *color }).collect()
}

/// The numbers, a row for each run and step.
pub fn table(found: &[Snapshot<'_>]) -> Columns {
    let mut names: Vec<String> = [
        "algorithm",
        "seed",
        "steps",
        "return",
        "no-ops (%)",
        "main engine per episode",
        "side engines per episode",
        "steps per episode",
    ]
    .map(str::to_owned)
    .to_vec();
    names.extend(BANDS.iter().map(|(name, _)| format!("episodes: {name}")));
    let row = |s: &Snapshot<'_>| {
        let f = &s.flights;
        let mut cells: Vec<Value> = vec![
            json!(s.run.variant.label.replace(',', "")),
            json!(s.run.seed),
            json!(f.env_steps),
            json!(f.over(|episode| episode.total)),
            json!(100.0 * f.no_op_share()),
            json!(f.over(|episode| episode.main)),
            json!(f.over(|episode| episode.side)),
            json!(f.over(|episode| episode.path.len() as f64)),
        ];
        cells.extend(f.bands().map(|count| json!(count)));
        cells
    };
    Columns {
        id: "flights",
        about: format!(
            "{EPISODES} greedy episodes of each snapshot, the same for all, which no training saw. No-op: a step with the main \
             throttle below 0 and the side throttle within ±0.5, as the policy asks for it. Main engine: sum of the main throttle \
             where it is above 0; side engines: sum of the side throttle's amount where that is above 0.5; both are means over \
             episodes of throttle times steps."
        ),
        names,
        rows: found.iter().map(row).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_without_an_engine_are_no_ops_and_fuel_is_what_fires() {
        let mut flown = Flown::default();
        let steps = [[-0.1, 0.49], [-0.1, -0.5], [0.5, 0.2], [0.25, -0.75], [-1.0, 0.0], [0.0, 0.0]];
        for (i, action) in steps.iter().enumerate() {
            flown.add(&[i as f32, 0.5, 9.0], action);
        }
        assert_eq!((flown.no_ops, flown.main, flown.side), (2, 0.75, 0.75));
        assert_eq!(flown.path[3], [3.0, 0.5]);
        let flights =
            Flights { version: VERSION, env_steps: 7, seed: 1, episodes: vec![flown.clone(), Flown::default()] };
        assert_eq!(flights.no_op_share(), 2.0 / 6.0);
    }

    #[test]
    fn returns_on_the_border_of_two_bands_are_in_the_upper_one() {
        assert_eq!([-100.1, -100.0, -0.1, 0.0, 199.9, 200.0].map(band), [0, 1, 1, 2, 2, 3]);
    }

    #[test]
    fn steps_are_named_in_thousands() {
        assert_eq!([0, 640, 100_000, 1_000_000].map(in_thousands), ["0", "640", "100k", "1000k"]);
    }
}
