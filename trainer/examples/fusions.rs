//! Compares the fusions of state and action: reconstruction and code use on random Moving data, steps to learn
//! InvertedPendulum-v5, and what the decoder costs on the device. Prints a Markdown table.
//!
//! `cargo run --release -p gadm-trainer --example fusions [SEEDS]`

use std::io::Write as _;
use std::sync::atomic::AtomicBool;

use gadm_trainer::action_space::ActionSpace;
use gadm_trainer::config::builtin::builtin;
use gadm_trainer::config::resolve::resolve;
use gadm_trainer::config::{Layer, TrainConfig};
use gadm_trainer::discretizer::gadm::{ActionModel, ActionModelConfig, Fusion};
use gadm_trainer::export::{ExportOptions, export};
use gadm_trainer::plot::curve::read_run;
use gadm_trainer::runner::progress::Style;
use gadm_trainer::runner::{TrainOptions, train};
use gadm_trainer::seed::SeedTree;

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

/// Continuous and type error of decode(encode), and perplexity of the codes, with running statistics.
fn reconstruction(fusion: Fusion, seed: u64) -> anyhow::Result<[f64; 3]> {
    let mut env = gadm_envs::make("moving")?;
    let spec = env.spec().clone();
    let config = ActionModelConfig { latents: 16, fusion, ..ActionModelConfig::default() };
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
    let mut model = ActionModel::new(config, obs_dim, space.clone(), BATCH, &mut SeedTree::new(seed).stream("init"))?;
    let mut sample = SeedTree::new(seed).stream("batches");
    let (mut batch_obs, mut batch_actions) = (Vec::new(), Vec::new());
    for _ in 0..UPDATES {
        batch_obs.clear();
        batch_actions.clear();
        for _ in 0..BATCH {
            let i = rand::RngExt::random_range(&mut sample, 0..TRANSITIONS);
            batch_obs.extend_from_slice(&obs[i * obs_dim..(i + 1) * obs_dim]);
            batch_actions.extend_from_slice(&actions[i * slots..(i + 1) * slots]);
        }
        model.update(&batch_obs, &batch_actions);
    }
    let mut codes = Vec::new();
    model.encode(&obs, &actions, &mut codes);
    let mut decoded = vec![0.0; actions.len()];
    model.decode(&obs, &codes, &mut decoded, false);
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
    Ok([error / f64::from(counted), wrong as f64 / TRANSITIONS as f64, perplexity])
}

/// Bytes and multiply-accumulates of a policy.
type Cost = (usize, u32);

/// Environment steps until an evaluation of InvertedPendulum-v5 reaches 950 (None: never), and bytes and multiply-accumulates of
/// the exported policy (None where it does not fold).
fn learning(name: &str, seed: u64) -> anyhow::Result<(Option<f64>, Option<Cost>)> {
    let env = "inverted-pendulum-v5";
    let layers = [
        Layer::Toml { origin: env.to_owned(), text: builtin(env).unwrap_or_default().to_owned() },
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

fn main() -> anyhow::Result<()> {
    let seeds: u64 = std::env::args().nth(1).map_or(Ok(3), |s| s.parse())?;
    let mut out = std::io::stdout().lock();
    writeln!(
        out,
        "| fusion | squared error of continuous slots | wrong types | perplexity of 16 | steps to return 950 | policy bytes | multiply-accumulates |"
    )?;
    writeln!(out, "| --- | --- | --- | --- | --- | --- | --- |")?;
    for (fusion, name) in FUSIONS {
        let mut columns: [Vec<f64>; 3] = Default::default();
        let (mut steps, mut device) = (Vec::new(), None);
        for seed in 0..seeds {
            reconstruction(fusion, seed)?.iter().zip(&mut columns).for_each(|(v, c)| c.push(*v));
            let (reached, cost) = learning(name, seed)?;
            steps.extend(reached);
            device = cost;
        }
        let [error, wrong, perplexity] = columns.map(|c| mean_sd(&c));
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
