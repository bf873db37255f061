//! The latents of ToyEnv: what an action model and confidence predictors learn of a fixed set of actions (specification 8.6 and 8.7,
//! figures 12 and 13).
//!
//! The runs are those of GADM+DQN whose warm-up is the training: the set fills D_AR, its phases train the action model and then the
//! confidence predictor, and nothing is learned after them. All exponents of a seed have the same set and the same action model.

use std::path::Path;

use gadm_envs::{toy_dataset, toy_square};
use serde::Serialize;
use serde_json::{Value, json};

use super::PaperError;
use super::columns::Columns;
use super::plan::{Plan, PlannedRun};
use super::state::{State, inspect};
use crate::error::TrainError;
use crate::explain::{Grid, plane};
use crate::plot::{GroupedBars, Map, Mark, Paint, PlotError, PlotOptions, Shape, grouped_bars, map, sheet};
use crate::runner::checkpoint::{Networks, load_trained, save_pairs};
use crate::runner::progress::duration;

/// Cells of the map along each axis.
const CELLS: usize = 160;
/// States of ToyEnv.
const STATES: usize = 4;
/// What the window around a square shows beyond it at each side, normalised.
const MARGIN: f64 = 0.0625;

/// Latents of the action plane in a state, `CELLS x CELLS`, row by row from below.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Regions {
    whole: Vec<u32>,
    /// Of the window around the state's square.
    near: Vec<u32>,
}

/// Writes the set of actions that a run starts from.
///
/// # Errors
/// Where the file cannot be written.
pub fn record(path: &Path, per_state: usize, seed: u64) -> Result<(), PaperError> {
    let folder = path.parent().unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder).map_err(PaperError::io("create", folder))?;
    let (obs, actions) = toy_dataset(per_state, seed);
    Ok(save_pairs(path, (&obs, STATES), (&actions, 2))?)
}

/// What one run knows of one state.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Learned {
    /// Seed of the run and of its set.
    pub seed: u64,
    /// Focal exponent γ_f.
    pub focal_gamma: f64,
    /// Share of the state's actions that each latent has.
    pub shares: Vec<f64>,
    /// Confidence of each latent.
    pub confidence: Vec<f64>,
    /// Where confidence would end: the fixed point of the focal loss for these shares.
    pub fixed_point: Vec<f64>,
    /// Action that each latent decodes to, native units.
    pub decoded: Vec<[f64; 2]>,
    /// Wall-clock time of the training, s.
    pub wall_s: f64,
    /// Commit that it was started with.
    pub commit: Option<String>,
}

/// State `state` (0 to 3) as each run of `plan` that is done sees it, and the latents of the action plane as the first of them has
/// them.
///
/// # Errors
/// [`PaperError::Train`] for networks or a set that cannot be read.
pub fn learned(plan: &Plan, state: usize) -> Result<(Vec<Learned>, Regions), PaperError> {
    let (mut all, mut regions) = (Vec::new(), Regions::default());
    for run in plan.runs.iter().filter(|run| run.shown) {
        let status = inspect(run);
        if status.state != State::Done {
            continue;
        }
        let (own, codes) = of_run(run, state)?;
        if all.is_empty() {
            regions = codes;
        }
        all.push(Learned { wall_s: status.wall_s, commit: status.commit, ..own });
    }
    Ok((all, regions))
}

fn of_run(run: &PlannedRun, state: usize) -> Result<(Learned, Regions), PaperError> {
    let mut trained = load_trained(&run.dir, Networks::Last)?;
    let focal_gamma = trained.config.confidence.focal_gamma;
    let agent = trained.agent()?;
    let k = agent.model.num_latents();
    let mut obs = [0.0; STATES];
    obs[state] = 1.0;
    // The set by its recipe and not by its file: a run's folder can be moved.
    let (_, actions) = toy_dataset(PER_STATE, run.seed);
    let own = &actions[2 * PER_STATE * state..2 * PER_STATE * (state + 1)];
    let mut codes = Vec::new();
    agent.model.encode(&obs.repeat(PER_STATE), own, &mut codes);
    let share = |latent| codes.iter().filter(|code| **code == latent).count() as f64 / PER_STATE as f64;
    let shares: Vec<f64> = (0..k as u32).map(share).collect();
    let latents: Vec<u32> = (0..k as u32).collect();
    let mut decoded = vec![0.0; 2 * k];
    agent.model.decode(&obs.repeat(k), &latents, &mut decoded, true);
    let mut scores = Vec::new();
    let predictor = agent.confidence.as_mut().ok_or_else(|| TrainError::config("confidence.enabled", "true", false))?;
    predictor.scores(&obs, 1, &mut scores);
    let learned = Learned {
        seed: run.seed,
        focal_gamma,
        fixed_point: fixed_point(&shares, focal_gamma),
        shares,
        confidence: scores.iter().map(|&score| f64::from(score)).collect(),
        decoded: decoded.chunks_exact(2).map(|a| [native(a[0].into()), native(a[1].into())]).collect(),
        wall_s: 0.0,
        commit: None,
    };
    let mut codes_of = |ends: [[f64; 2]; 2]| {
        let grid = Grid { points: CELLS, ends: ends.map(|axis| axis.map(|end| end as f32)) };
        plane(&mut agent.model, &obs, &[0.0; 2], (0, Some(1)), &grid)
    };
    Ok((learned, Regions { whole: codes_of([[-1.0, 1.0]; 2]), near: codes_of(around(state)) }))
}

/// Ends of the window around a state's square, along x and y, normalised.
fn around(state: usize) -> [[f64; 2]; 2] {
    toy_square(state).map(|[low, high]| [low - MARGIN, high + MARGIN])
}

/// Actions of a state in the set (appendix A.7).
pub const PER_STATE: usize = 5000;

/// ToyEnv's units: 0 to 4.
fn native(normalised: f64) -> f64 {
    2.0 * (normalised + 1.0)
}

/// The stationary point of the focal loss for shares `q` of the latents: `p_k = q_k (1 - p_k)^γ / Σ_j q_j (1 - p_j)^γ`
/// (specification 3.2), by damped iteration on the logarithms.
fn fixed_point(q: &[f64], gamma: f64) -> Vec<f64> {
    let mut p = q.to_vec();
    let step = 0.5 / (1.0 + gamma);
    for _ in 0..20_000 {
        // 1 where one latent has everything: its own factor would be 0 then.
        let weights: Vec<f64> = p.iter().zip(q).map(|(p, q)| q * (1.0 - p).max(1e-12).powf(gamma)).collect();
        let sum: f64 = weights.iter().sum();
        if sum <= 0.0 {
            break;
        }
        let moved: Vec<f64> = p.iter().zip(&weights).map(|(p, w)| p.powf(1.0 - step) * (w / sum).powf(step)).collect();
        let total: f64 = moved.iter().sum();
        p = moved.into_iter().map(|p| p / total).collect();
    }
    p
}

/// The figure, of the runs' first seed: the action plane, the window around the square of the data, and confidence by exponent.
///
/// # Errors
/// [`PlotError::NoData`] without a run.
pub fn figure(plan: &Plan, state: usize, all: &[Learned], regions: &Regions) -> Result<String, PlotError> {
    let Some(first) = all.first() else { return Err(PlotError::NoData("no run is done")) };
    let [[left, right], [low, high]] = toy_square(state).map(|ends| ends.map(native));
    let plane = |codes: &[u32], ends: [[f64; 2]; 2], named: bool| Map {
        x_name: "x".to_owned(),
        y_name: "y".to_owned(),
        x: native(ends[0][0])..native(ends[0][1]),
        y: native(ends[1][0])..native(ends[1][1]),
        columns: CELLS,
        values: codes.iter().map(|&code| f64::from(code)).collect(),
        paint: Paint::Index { name: "latent".to_owned() },
        marks: (first.decoded.iter().enumerate())
            .filter(|(_, at)| at.iter().zip(ends).all(|(at, [low, high])| (native(low)..=native(high)).contains(at)))
            .map(|(k, &[x, y])| Mark {
                at: (x, y),
                text: if named { k.to_string() } else { String::new() },
                shape: if named { Shape::Star } else { Shape::Dot },
            })
            .collect(),
        lines: vec![vec![(left, low), (right, low), (right, high), (left, high), (left, low)]],
    };
    let id = plan.figure.id;
    let heading = format!("{id}: state {}, latent of every action", state + 1);
    let whole = plane(&regions.whole, [[-1.0, 1.0]; 2], false);
    let whole = map(&whole, &PlotOptions::new(heading).with_size(440, 500))?;
    let near = plane(&regions.near, around(state), true);
    let near = map(&near, &PlotOptions::new("Around the data").with_size(440, 500))?;
    let of_seed: Vec<&Learned> = all.iter().filter(|learned| learned.seed == first.seed).collect();
    let series = of_seed.iter().map(|own| (format!("γ_f = {}", own.focal_gamma), own.confidence.clone())).collect();
    let highest = of_seed.iter().flat_map(|own| &own.confidence).chain(&first.shares).copied().fold(0.0, f64::max);
    let bars = GroupedBars {
        y_name: "confidence".to_owned(),
        y: 0.0..(1.08 * highest).min(1.05),
        series,
        reference: ("share of the data".to_owned(), first.shares.clone()),
        level: ("1/K".to_owned(), 1.0 / first.shares.len() as f64),
    };
    let right_part = grouped_bars(&bars, &PlotOptions::new("Confidence in each latent").with_size(560, 500))?;
    sheet(&[whole, near, right_part], 3, &format!("{id}: {}", plan.figure.title))
}

/// The numbers, a row for each run.
pub fn table(state: usize, all: &[Learned]) -> Columns {
    let latents = all.first().map_or(0, |first| first.shares.len());
    let by_latent = |what: &str| (0..latents).map(|k| format!("{what} {k}")).collect::<Vec<_>>();
    let mut names = vec!["seed".to_owned(), "γ_f".to_owned()];
    names.extend(by_latent("share"));
    names.extend(by_latent("confidence"));
    names.extend(["from the shares", "from the fixed point", "wall time", "commit"].map(str::to_owned));
    let apart = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    let rows = all.iter().map(|own| {
        let mut cells: Vec<Value> = vec![json!(own.seed), json!(own.focal_gamma)];
        cells.extend(own.shares.iter().chain(&own.confidence).map(|value| json!(value)));
        cells.push(json!(apart(&own.confidence, &own.shares)));
        cells.push(json!(apart(&own.confidence, &own.fixed_point)));
        cells.push(json!(duration(own.wall_s)));
        cells.push(json!(own.commit));
        cells
    });
    Columns {
        id: "confidence",
        about: format!(
            "State {}: share of each latent among the state's {PER_STATE} actions, as the trained encoder assigns them, and the \
             trained predictor's confidence in it. The last but two columns: the largest difference between confidence and share, and \
             between confidence and the fixed point of the focal loss for these shares.",
            state + 1
        ),
        names,
        rows: rows.collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Specification 3.2, the table of exact fixed points.
    #[test]
    fn fixed_points_are_those_of_the_specification() {
        let cases: [(&[f64], f64, &[f64]); 5] = [
            (&[0.7, 0.2, 0.1, 0.0], 0.0, &[0.7, 0.2, 0.1, 0.0]),
            (&[0.7, 0.2, 0.1, 0.0], 1.0, &[0.568, 0.273, 0.158, 0.0]),
            (&[0.7, 0.2, 0.1, 0.0], 5.0, &[0.433, 0.316, 0.250, 0.0]),
            (&[0.97, 0.01, 0.01, 0.01], 2.0, &[0.734, 0.089, 0.089, 0.089]),
            (&[0.4, 0.3, 0.3, 0.0], 5.0, &[0.351, 0.324, 0.324, 0.0]),
        ];
        for (q, gamma, expected) in cases {
            let p = fixed_point(q, gamma);
            assert!(p.iter().zip(expected).all(|(p, e)| (p - e).abs() < 6e-4), "{q:?} {gamma}: {p:?}");
        }
        let alone = fixed_point(&[1.0, 0.0], 2.0);
        assert_eq!(alone, [1.0, 0.0]);
    }
}
