//! Measures choices of the action model and prints a Markdown table of each.
//!
//! - `fusions`: how state and action meet: reconstruction and code use on random Moving data, steps to learn
//!   InvertedPendulum-v5, and what the decoder costs on the device.
//! - `momentum`: how fast the running statistics of the standardised encoder output follow: how many latents differ from
//!   those that training assigned, and what that does to the reconstruction.
//!
//! - `assignment`: how often the encoder gives what a latent decodes into to that latent, which decides what remapping learns
//!   for it.
//!
//! `cargo run --release -p gadm-trainer --example choices fusions|momentum|assignment [SEEDS]`

use std::io::Write;
use std::sync::atomic::AtomicBool;

use gadm_trainer::action_space::ActionSpace;
use gadm_trainer::config::builtin::builtin;
use gadm_trainer::config::resolve::resolve;
use gadm_trainer::config::{Layer, TrainConfig};
use gadm_trainer::discretizer::gadm::{ActionModel, ActionModelConfig, Fusion};
use gadm_trainer::export::{ExportOptions, export};
use gadm_trainer::nn::AdamConfig;
use gadm_trainer::plot::curve::read_run;
use gadm_trainer::runner::progress::Style;
use gadm_trainer::runner::{TrainOptions, train};
use gadm_trainer::seed::SeedTree;
use rand::RngExt as _;

const FUSIONS: [(Fusion, &str); 4] = [
    (Fusion::None, "none"),
    (Fusion::Mul, "mul"),
    (Fusion::FilmStateToLatent, "film-state-to-latent"),
    (Fusion::FilmLatentToState, "film-latent-to-state"),
];
/// Transitions and updates of the reconstruction part, as in the specification's section 2.10.
const TRANSITIONS: usize = 20_000;
const UPDATES: usize = 2_000;
const BATCH: usize = 512;

/// States and random actions of an environment, one after the other.
struct Data {
    space: ActionSpace,
    obs_dim: usize,
    obs: Vec<f32>,
    actions: Vec<f32>,
}

impl Data {
    fn random(env: &str, config: &ActionModelConfig, seed: u64) -> anyhow::Result<Self> {
        let mut env = gadm_envs::make(env)?;
        let spec = env.spec().clone();
        let space = ActionSpace::new(&spec, config.head, config.argument_mask);
        let (obs_dim, slots) = (spec.obs_dim(), space.slots());
        let mut rng = SeedTree::new(seed).stream("random actions");
        let (mut obs, mut actions) = (Vec::new(), Vec::new());
        let (mut now, mut action, mut native) = (vec![0.0; obs_dim], vec![0.0; slots], vec![0.0; slots]);
        let mut episode = 0;
        env.reset(gadm_envs::episode_seed(seed, episode), &mut now);
        while actions.len() < TRANSITIONS * slots {
            space.random(&mut rng, &mut action);
            obs.extend_from_slice(&now);
            actions.extend_from_slice(&action);
            space.to_native(&action, &mut native);
            let step = env.step(&native, &mut now);
            if step.terminated || step.truncated {
                episode += 1;
                env.reset(gadm_envs::episode_seed(seed, episode), &mut now);
            }
        }
        Ok(Self { space, obs_dim, obs, actions })
    }

    /// A model trained on it, with observations and actions of the last batch.
    fn trained(&self, config: ActionModelConfig, seed: u64) -> anyhow::Result<(ActionModel, Vec<f32>, Vec<f32>)> {
        let (space, obs_dim, slots) = (self.space.clone(), self.obs_dim, self.space.slots());
        let mut model = ActionModel::new(config, obs_dim, space, BATCH, &mut SeedTree::new(seed).stream("init"))?;
        let mut sample = SeedTree::new(seed).stream("batches");
        let (mut batch_obs, mut batch_actions) = (Vec::new(), Vec::new());
        for _ in 0..UPDATES {
            batch_obs.clear();
            batch_actions.clear();
            for _ in 0..BATCH {
                let i = sample.random_range(0..TRANSITIONS);
                batch_obs.extend_from_slice(&self.obs[i * obs_dim..(i + 1) * obs_dim]);
                batch_actions.extend_from_slice(&self.actions[i * slots..(i + 1) * slots]);
            }
            model.update(&batch_obs, &batch_actions);
        }
        Ok((model, batch_obs, batch_actions))
    }
}

/// After training on random data of Moving, with running statistics: continuous and type error of decode(encode), perplexity of
/// the codes, and the share of the last batch whose latents differ from those that training assigned.
fn reconstruction(config: ActionModelConfig, seed: u64) -> anyhow::Result<[f64; 4]> {
    let data = Data::random("moving", &config, seed)?;
    let (mut model, batch_obs, batch_actions) = data.trained(config, seed)?;
    let Data { space, obs, actions, .. } = &data;
    let slots = space.slots();
    let mut codes = Vec::new();
    model.encode(&batch_obs, &batch_actions, &mut codes);
    let changed = codes.iter().zip(model.training_codes()).filter(|(now, then)| now != then).count();
    model.encode(obs, actions, &mut codes);
    let mut decoded = vec![0.0; actions.len()];
    model.decode(obs, &codes, &mut decoded, false);
    let (mut error, mut counted, mut wrong) = (0.0, 0, 0);
    for (a, b) in actions.chunks_exact(slots).zip(decoded.chunks_exact(slots)) {
        wrong += usize::from(a[0] != b[0]);
        for slot in 1..slots {
            if space.counts(a, slot) {
                error += f64::from((a[slot] - b[slot]).powi(2));
                counted += 1;
            }
        }
    }
    let mut counts = vec![0_u32; model.num_latents()];
    for &code in &codes {
        counts[code as usize] += 1;
    }
    let shares = counts.iter().filter(|c| **c > 0).map(|&c| f64::from(c) / TRANSITIONS as f64);
    let perplexity = shares.map(|p| -p * p.ln()).sum::<f64>().exp();
    Ok([error / f64::from(counted), wrong as f64 / TRANSITIONS as f64, perplexity, changed as f64 / BATCH as f64])
}

/// Share of states in which the encoder gives what a latent decodes into to that latent: for the latent of the state's own
/// action, and for a latent drawn from all.
fn kept(env: &str, seed: u64) -> anyhow::Result<[f64; 2]> {
    let layer = Layer::Toml { origin: env.to_owned(), text: builtin("gadm-dqn", env).unwrap_or_default().to_owned() };
    let config = resolve::<TrainConfig>(&[layer])?.action_model;
    let data = Data::random(env, &config, seed)?;
    let (mut model, ..) = data.trained(config, seed)?;
    let mut own = Vec::new();
    model.encode(&data.obs, &data.actions, &mut own);
    let mut rng = SeedTree::new(seed).stream("latents");
    let any = (0..own.len()).map(|_| rng.random_range(0..model.num_latents() as u32)).collect();
    let mut share = |codes: Vec<u32>| {
        let (mut decoded, mut again) = (vec![0.0; data.actions.len()], Vec::new());
        model.decode(&data.obs, &codes, &mut decoded, false);
        model.encode(&data.obs, &decoded, &mut again);
        codes.iter().zip(&again).filter(|(then, now)| then == now).count() as f64 / codes.len() as f64
    };
    Ok([share(own), share(any)])
}

fn assignment(out: &mut impl Write, seeds: u64) -> anyhow::Result<()> {
    writeln!(out, "| environment | latent of a random action | any latent |\n| --- | --- | --- |")?;
    for env in ["moving", "sliding", "hard-move-10", "lunar-lander-continuous", "hopper-v5", "half-cheetah-v5"] {
        let mut columns: [Vec<f64>; 2] = Default::default();
        for seed in 0..seeds {
            kept(env, seed)?.iter().zip(&mut columns).for_each(|(v, c)| c.push(100.0 * v));
        }
        let [own, any] = columns.map(|c| mean_sd(&c));
        writeln!(out, "| {env} | {:.1} % ± {:.1} | {:.1} % ± {:.1} |", own.0, own.1, any.0, any.1)?;
    }
    Ok(())
}

/// Bytes and multiply-accumulates of a policy.
type Cost = (usize, u32);

/// Environment steps until an evaluation of InvertedPendulum-v5 reaches 950 (None: never), and bytes and multiply-accumulates of
/// the exported policy (None where it does not fold).
fn learning(name: &str, seed: u64) -> anyhow::Result<(Option<f64>, Option<Cost>)> {
    let env = "inverted-pendulum-v5";
    let layers = [
        Layer::Toml { origin: env.to_owned(), text: builtin("gadm-dqn", env).unwrap_or_default().to_owned() },
        Layer::Set(format!("seed={seed}")),
        Layer::Set(format!("action_model.fusion=\"{name}\"")),
    ];
    let config: TrainConfig = resolve(&layers)?;
    let folder = tempfile::tempdir()?;
    let dir = folder.path().join("run");
    let stop = AtomicBool::new(false);
    train(&TrainOptions { config: Some(config), dir: dir.clone(), resume: false, style: Style::Quiet, stop: &stop })?;
    let curve = read_run(&dir, name)?;
    let reached = curve.points.iter().find(|p| p.mean >= 950.0).map(|p| p.env_steps);
    let options = ExportOptions { best: true, episodes: 1, seed: 0, float_weights: false, policy_seq: 1 };
    let device = export(&dir, &options).ok().map(|e| {
        let image = gadm_runtime::encode::AlignedImage::new(&e.bytes);
        let macs = gadm_runtime::Policy::load(&image).map_or(0, |p| p.spec().macs);
        (e.bytes.len(), macs)
    });
    Ok((reached, device))
}

fn mean_sd(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
    (mean, if values.len() > 1 { (squares / (n - 1.0)).sqrt() } else { 0.0 })
}

fn momenta(out: &mut impl Write, seeds: u64) -> anyhow::Result<()> {
    writeln!(
        out,
        "| momentum | learning rate | latents that differ from training's | wrong types | squared error of continuous slots |"
    )?;
    writeln!(out, "| --- | --- | --- | --- | --- |")?;
    for learning_rate in [3e-4, 3e-3] {
        for statistics_momentum in [0.01, 0.05, 0.1, 0.2, 0.5] {
            let adam = AdamConfig { learning_rate, ..AdamConfig::default() };
            let config = ActionModelConfig { latents: 16, statistics_momentum, adam, ..ActionModelConfig::default() };
            let mut columns: [Vec<f64>; 4] = Default::default();
            for seed in 0..seeds {
                reconstruction(config.clone(), seed)?.iter().zip(&mut columns).for_each(|(v, c)| c.push(*v));
            }
            let [error, wrong, _, changed] = columns.map(|c| mean_sd(&c));
            writeln!(
                out,
                "| {statistics_momentum} | {learning_rate} | {:.1} % ± {:.1} | {:.2} % ± {:.2} | {:.4} ± {:.4} |",
                100.0 * changed.0,
                100.0 * changed.1,
                100.0 * wrong.0,
                100.0 * wrong.1,
                error.0,
                error.1
            )?;
        }
    }
    Ok(())
}

fn main() -> anyhow::Result<()> {
    let seeds: u64 = std::env::args().nth(2).map_or(Ok(3), |s| s.parse())?;
    let mut out = std::io::stdout().lock();
    match std::env::args().nth(1).as_deref() {
        Some("fusions") => fusions(&mut out, seeds),
        Some("momentum") => momenta(&mut out, seeds),
        Some("assignment") => assignment(&mut out, seeds),
        other => anyhow::bail!("expected `fusions`, `momentum` or `assignment`, found {other:?}"),
    }
}

fn fusions(out: &mut impl Write, seeds: u64) -> anyhow::Result<()> {
    writeln!(
        out,
        "| fusion | squared error of continuous slots | wrong types | perplexity of 16 | steps to return 950 | policy bytes | multiply-accumulates |"
    )?;
    writeln!(out, "| --- | --- | --- | --- | --- | --- | --- |")?;
    for (fusion, name) in FUSIONS {
        let mut columns: [Vec<f64>; 4] = Default::default();
        let (mut steps, mut device) = (Vec::new(), None);
        for seed in 0..seeds {
            let config = ActionModelConfig { latents: 16, fusion, ..ActionModelConfig::default() };
            reconstruction(config, seed)?.iter().zip(&mut columns).for_each(|(v, c)| c.push(*v));
            let (reached, cost) = learning(name, seed)?;
            steps.extend(reached);
            device = cost;
        }
        let [error, wrong, perplexity, _] = columns.map(|c| mean_sd(&c));
        let steps = match mean_sd(&steps) {
            _ if steps.is_empty() => "not reached".to_owned(),
            (mean, sd) => format!("{mean:.0} ± {sd:.0} ({} of {seeds} seeds)", steps.len()),
        };
        let device =
            device.map_or(("does not fold".to_owned(), "-".to_owned()), |(b, m)| (b.to_string(), m.to_string()));
        writeln!(
            out,
            "| {name} | {:.4} ± {:.4} | {:.2} % ± {:.2} | {:.1} ± {:.1} | {steps} | {} | {} |",
            error.0,
            error.1,
            100.0 * wrong.0,
            100.0 * wrong.1,
            perplexity.0,
            perplexity.1,
            device.0,
            device.1
        )?;
    }
    Ok(())
}
