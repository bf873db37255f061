//! The latents of LunarLander shortly before it lands (specification 8.7, figure 16).

use gadm_envs::render::{Paint as ScenePaint, Scene};
use gadm_envs::{episode_seed, make_with};
use serde::Serialize;
use serde_json::json;

use super::PaperError;
use super::columns::Columns;
use super::plan::{Plan, PlannedRun};
use super::table::Results;
use crate::algo::Actor as _;
use crate::error::TrainError;
use crate::explain::{Grid, plane};
use crate::plot::{Map, Mark, Paint, PlotError, PlotOptions, Shape, map, picture, sheet};
use crate::runner::agent::Agent;
use crate::runner::checkpoint::{Networks, load_trained};
use crate::seed::SeedTree;

/// Episodes to choose the landing from.
const EPISODES: u64 = 20;
/// Steps (at 50 a second) between the state that is shown and the first leg on the ground.
const BEFORE: usize = 20;
/// Cells of the map along each axis.
const CELLS: usize = 160;
/// Width of the frame, CSS pixels.
const FRAME_PX: u32 = 450;

/// One state of the best episode of the best run.
#[derive(Clone, Debug)]
pub struct Landing {
    /// The run.
    pub run: String,
    /// Return of the episode.
    pub total: f64,
    /// Step of the episode, from 0, and steps that it has.
    pub step: (usize, usize),
    /// What was seen.
    pub obs: Vec<f32>,
    /// The state as a drawing.
    pub scene: Option<Scene>,
    /// Latent of every action, `CELLS x CELLS`, row by row from below.
    pub regions: Vec<u32>,
    /// Latents one by one.
    pub latents: Vec<Latent>,
}

/// A latent in that state.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Latent {
    /// Its action: main throttle, side throttle.
    pub action: [f32; 2],
    /// Share of the action plane that the encoder gives it.
    pub area: f64,
    /// Whether the policy chooses it.
    pub chosen: bool,
}

/// A step of an episode as it was before it was taken.
struct Seen {
    obs: Vec<f32>,
    scene: Option<Scene>,
}

/// Flies episodes of the run of `plan` with the highest evaluation, and looks at the one with the highest return; `None` without a
/// run.
///
/// # Errors
/// [`PaperError::Train`] for networks that cannot be read.
pub fn landing(plan: &Plan, results: &Results) -> Result<Option<Landing>, PaperError> {
    let seeds = results.rows.iter().flat_map(|row| &row.seeds);
    let Some(best) = seeds.max_by(|a, b| a.best_return.total_cmp(&b.best_return)) else { return Ok(None) };
    let run = plan.runs.iter().find(|run| run.name == best.run);
    run.map(of_run).transpose()
}

fn of_run(run: &PlannedRun) -> Result<Landing, PaperError> {
    let mut trained = load_trained(&run.dir, Networks::Best)?;
    let config = trained.config.clone();
    let agent = trained.agent()?;
    let mut env = make_with(&config.env, &config.env_options).map_err(TrainError::from)?;
    let seed = SeedTree::new(0).number("paper.landing");
    let mut best: Option<(f64, Vec<Seen>)> = None;
    for episode in 0..EPISODES {
        let (mut obs, mut native) = (vec![0.0; env.spec().obs_dim()], vec![0.0; env.spec().action_dim()]);
        let (mut chosen, mut action) = (Vec::new(), native.clone());
        env.reset(episode_seed(seed, episode), &mut obs);
        let (mut total, mut seen) = (0.0, Vec::new());
        loop {
            seen.push(Seen { obs: obs.clone(), scene: env.scene() });
            agent.act(&obs, 1, &mut chosen, &mut action);
            agent.space().to_native(&action, &mut native);
            let step = env.step(&native, &mut obs);
            total += step.reward;
            if step.terminated || step.truncated {
                break;
            }
        }
        if best.as_ref().is_none_or(|(highest, _)| total > *highest) {
            best = Some((total, seen));
        }
    }
    let (total, mut seen) = best.expect("there is an episode, and it has a step");
    let at = shortly_before(seen.iter().map(|seen| &seen.obs[..]));
    let (steps, Seen { obs, scene }) = (seen.len(), seen.swap_remove(at));
    let (regions, latents) = latents(agent, &obs);
    Ok(Landing { run: run.name.clone(), total, step: (at, steps), obs, scene, regions, latents })
}

/// The step [`BEFORE`] the first at which a leg is on the ground (observations 6 and 7), or before the end where none ever is.
fn shortly_before<'a>(obs: impl ExactSizeIterator<Item = &'a [f32]>) -> usize {
    let steps = obs.len();
    let touched = obs.into_iter().position(|obs| obs.iter().skip(6).any(|&leg| leg > 0.5));
    touched.unwrap_or(steps - 1).saturating_sub(BEFORE)
}

fn latents(agent: &mut Agent, obs: &[f32]) -> (Vec<u32>, Vec<Latent>) {
    let k = agent.model.num_latents();
    let regions = plane(&mut agent.model, obs, &[0.0; 2], (0, Some(1)), &Grid::whole(CELLS));
    let (mut actions, all) = (vec![0.0; 2 * k], (0..k as u32).collect::<Vec<_>>());
    agent.model.decode(&obs.repeat(k), &all, &mut actions, true);
    let mut chosen = Vec::new();
    agent.greedy(obs, 1, &mut chosen);
    let area = |code| regions.iter().filter(|found| **found == code).count() as f64 / regions.len() as f64;
    let latents = all.iter().map(|&code| Latent {
        action: [actions[2 * code as usize], actions[2 * code as usize + 1]],
        area: area(code),
        chosen: chosen.contains(&code),
    });
    let latents = latents.collect();
    (regions, latents)
}

/// The frame at the left, the action plane at the right.
///
/// # Errors
/// Those of drawing.
pub fn figure(plan: &Plan, landing: &Landing) -> Result<String, PlotError> {
    let across = |y: f64| vec![(-1.0, y), (1.0, y)];
    let marks = landing.latents.iter().enumerate().map(|(k, latent)| Mark {
        at: (latent.action[0].into(), latent.action[1].into()),
        text: if latent.chosen { format!("{k} (chosen)") } else { k.to_string() },
        shape: Shape::Dot,
    });
    let plane = Map {
        x_name: "main throttle".to_owned(),
        y_name: "side throttle".to_owned(),
        x: -1.0..1.0,
        y: -1.0..1.0,
        columns: CELLS,
        values: landing.regions.iter().map(|&code| f64::from(code)).collect(),
        paint: Paint::Index { name: "latent".to_owned() },
        marks: marks.collect(),
        lines: vec![vec![(0.0, -1.0), (0.0, 1.0)], across(-0.5), across(0.5)],
    };
    let id = plan.figure.id;
    let lines = lines(landing);
    let height = 600.max(420 + 21 * lines.len() as u32);
    let plane = map(&plane, &PlotOptions::new("Latent of every action in that state").with_size(540, height))?;
    let Some(scene) = &landing.scene else { return Ok(plane) };
    let heading = format!("{id}: step {} of {}", landing.step.0, landing.step.1);
    let frame = picture(&framed(scene), &lines, &PlotOptions::new(heading).with_size(FRAME_PX + 40, height))?;
    sheet(&[frame, plane], 2, &format!("{id}: {}", plan.figure.title))
}

/// What the latents do, for below the frame.
fn lines(landing: &Landing) -> Vec<String> {
    let what = |(k, latent): (usize, &Latent)| {
        let [main, side] = latent.action;
        let chosen = if latent.chosen { ", chosen" } else { "" };
        format!("latent {k}: main {main:.2}, side {side:.2}: {}{chosen}", engines(main, side)).replace('-', "−")
    };
    let run = format!("an episode that returns {:.1}; engines that each latent fires:", landing.total);
    std::iter::once(run).chain(landing.latents.iter().enumerate().map(what)).collect()
}

/// The scene on its ground.
fn framed(scene: &Scene) -> String {
    let mut whole = Scene::new(scene.view.x, scene.view.y);
    whole.rectangle(scene.view.x, scene.view.y, ScenePaint::Ground);
    whole.shapes.extend(scene.shapes.iter().cloned());
    whole.to_svg(FRAME_PX)
}

/// What each latent does in that state.
pub fn table(landing: &Landing) -> Columns {
    let names = ["latent", "main throttle", "side throttle", "engines", "share of the plane (%)", "chosen"];
    let rows = landing.latents.iter().enumerate().map(|(k, latent)| {
        let [main, side] = latent.action;
        vec![
            json!(k),
            json!(main),
            json!(side),
            json!(engines(main, side)),
            json!(100.0 * latent.area),
            json!(if latent.chosen { "yes" } else { "" }),
        ]
    });
    Columns {
        id: "latents",
        about: format!(
            "{}, the best of {EPISODES} episodes (return {:.1}): step {} of {}, {BEFORE} steps before the first leg touches the ground \
             (or the end). Observation: {}. Decoded actions with the engines that they fire.",
            landing.run,
            landing.total,
            landing.step.0,
            landing.step.1,
            landing.obs.iter().map(|value| format!("{value:.3}")).collect::<Vec<_>>().join(", "),
        ),
        names: names.map(str::to_owned).to_vec(),
        rows: rows.collect(),
    }
}

/// Which engines an action fires.
fn engines(main: f32, side: f32) -> &'static str {
    match (main > 0.0, side.abs() > 0.5) {
        (true, true) => "main and side",
        (true, false) => "main",
        (false, true) => "side",
        (false, false) => "none",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_state_is_shortly_before_the_first_contact_or_the_end() {
        let step = |leg: f32| [0.0, 0.5, 0.0, 0.0, 0.0, 0.0, leg, 0.0];
        let flight = |contact: usize| (0..100).map(|i| step(f32::from(u8::from(i >= contact)))).collect::<Vec<_>>();
        let at = |contact: usize| shortly_before(flight(contact).iter().map(|obs| &obs[..]));
        assert_eq!([at(70), at(5), at(1000)], [50, 0, 79]);
    }

    #[test]
    fn an_action_fires_what_exceeds_the_dead_zones() {
        let cases = [(-0.1, 0.5, "none"), (0.1, 0.0, "main"), (0.0, -0.6, "side"), (1.0, 1.0, "main and side")];
        for (main, side, expected) in cases {
            assert_eq!(engines(main, side), expected);
        }
    }
}
