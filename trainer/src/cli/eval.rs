//! `gadm eval`.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context as _;
use gadm_envs::render::Camera;
use gadm_envs::{Env, make_with};
use gadm_runtime::Policy;
use gadm_runtime::encode::AlignedImage;
use gadm_trainer::TrainError;
use gadm_trainer::atomic;
use gadm_trainer::runner::checkpoint::{load_trained, save_pairs};
use gadm_trainer::runner::evaluate::Pairs;
use gadm_trainer::runner::{Evaluation, evaluate_in, evaluate_policy_in, evaluate_recorded};
use serde::Serialize;

use super::{CRITERIA_MISSED, networks, print_json, say};

const EXAMPLES: &str = "\
Examples:
  gadm eval runs/hopper-v5-seed0 --episodes 100
  gadm eval models/hopper-v5/policy.bin --episodes 20 --seed 7 --json
  gadm eval models/hopper-v5/policy.bin --episodes 1 --render hop.gif
  gadm eval runs/hopper-v5-seed0 --snapshot 100000
  gadm eval runs/td3-hopper-v5-seed0 --episodes 1000 --record expert.safetensors --record-min 3500

A run folder is evaluated with its float networks, a policy file in the device runtime. The
same seed gives both, and `gadm-sim run`, the same episodes.";

/// Arguments of `eval`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// Run folder or policy file
    path: PathBuf,
    /// Number of episodes
    #[arg(long, default_value_t = 20, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    episodes: u32,
    /// Seed of the episodes
    #[arg(long, default_value_t = 0, value_name = "N")]
    seed: u64,
    /// Environment [default: the one it was trained in]
    #[arg(long, value_name = "ENV")]
    env: Option<String>,
    /// Of a run: the last networks instead of those of its best evaluation
    #[arg(long)]
    last: bool,
    /// Of a run: the networks kept at this environment step (setting track.snapshots)
    #[arg(long, value_name = "STEP", conflicts_with = "last")]
    snapshot: Option<u64>,
    /// Exit with 3 where the mean return is below X
    #[arg(long, value_name = "X", allow_negative_numbers = true)]
    min_return: Option<f64>,
    /// Draw the first episode as an animated GIF
    #[arg(long, value_name = "FILE.gif")]
    render: Option<PathBuf>,
    /// Of a run: write observations and normalised actions of the episodes as safetensors (`obs`, `actions`), the form that
    /// warmup.data and dqn_cluster.data take
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// With --record: only episodes with at least this return
    #[arg(long, value_name = "X", allow_negative_numbers = true, requires = "record")]
    record_min: Option<f64>,
    /// Width of the pictures of --render, pixels
    #[arg(long, default_value_t = 480, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(16..=2048))]
    render_width: u32,
    /// Print the result as JSON on standard output
    #[arg(long)]
    json: bool,
}

/// The result, for programs.
#[derive(Serialize)]
struct Output<'a> {
    version: u32,
    path: &'a PathBuf,
    kind: &'static str,
    env: String,
    seed: u64,
    episodes: usize,
    mean: f64,
    sd: f64,
    success_rate: Option<f64>,
    latents_used: usize,
    returns: &'a [f64],
    lengths: &'a [u64],
    latent_counts: &'a [u64],
}

/// Writes the episodes whose return is at least `least`.
fn record(
    path: &Path,
    least: Option<f64>,
    evaluation: &Evaluation,
    pairs: &[Pairs],
    (obs_dim, slots): (usize, usize),
) -> anyhow::Result<()> {
    let kept: Vec<_> = pairs.iter().zip(&evaluation.returns).filter(|(_, r)| least.is_none_or(|x| **r >= x)).collect();
    anyhow::ensure!(!kept.is_empty(), "--record-min: no episode of {} has such a return", pairs.len());
    let obs: Vec<f32> = kept.iter().flat_map(|((obs, _), _)| obs).copied().collect();
    let actions: Vec<f32> = kept.iter().flat_map(|((_, actions), _)| actions).copied().collect();
    save_pairs(path, (&obs, obs_dim), (&actions, slots))?;
    say(&format!("wrote {}: {} pairs of {} episodes", path.display(), obs.len() / obs_dim, kept.len()));
    Ok(())
}

fn run(args: &Args, camera: Option<&Camera>) -> anyhow::Result<(&'static str, String, Evaluation)> {
    let episodes = args.episodes as usize;
    let filmed = |env: Box<dyn Env>| match camera {
        Some(camera) => camera.before(env),
        None => env,
    };
    if args.path.is_dir() {
        let mut trained = load_trained(&args.path, networks(args.last, args.snapshot))?;
        let env = args.env.clone().unwrap_or_else(|| trained.config.env.clone());
        if env != trained.config.env {
            let own = gadm_envs::make(&trained.config.env)?.spec().clone();
            let other = gadm_envs::make(&env)?.spec().clone();
            if own.observations != other.observations || own.actions != other.actions {
                return Err(TrainError::Policy(format!(
                    "{} was trained in `{}`; `{env}` has other observations or actions",
                    args.path.display(),
                    trained.config.env
                ))
                .into());
            }
        }
        let options = trained.config.env_options;
        let mut envs = (0..episodes).map(|_| make_with(&env, &options)).collect::<Result<Vec<_>, _>>()?;
        let first = filmed(envs.remove(0));
        envs.insert(0, first);
        let spec = envs[0].spec().clone();
        let evaluation = if let Some(path) = &args.record {
            let (evaluation, pairs) = evaluate_recorded(trained.actor(), envs, args.seed);
            record(path, args.record_min, &evaluation, &pairs, (spec.obs_dim(), spec.action_dim()))?;
            evaluation
        } else {
            evaluate_in(trained.actor(), envs, args.seed)
        };
        return Ok(("float", env, evaluation));
    }
    anyhow::ensure!(args.record.is_none(), "--record: expected a run folder, found a policy file");
    anyhow::ensure!(args.snapshot.is_none(), "--snapshot: expected a run folder, found a policy file");
    let bytes = std::fs::read(&args.path)
        .with_context(|| format!("cannot read {}: give a run folder or a policy file", args.path.display()))?;
    let image = AlignedImage::new(&bytes);
    let policy = Policy::load(&image).map_err(|e| anyhow::anyhow!("{}: {e}", args.path.display()))?;
    let env = args.env.clone().unwrap_or_else(|| policy.provenance().environment.to_owned());
    let evaluation = evaluate_policy_in(&bytes, filmed(gadm_envs::make(&env)?), episodes, args.seed)?;
    Ok(("policy file", env, evaluation))
}

/// Runs `eval`.
pub fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let camera = args.render.is_some().then(|| Camera::new(args.render_width));
    let (kind, env, evaluation) = run(args, camera.as_ref())?;
    let n = evaluation.returns.len();
    let used = evaluation.latent_counts.iter().filter(|c| **c > 0).count();
    let success_rate = evaluation.successes.map(|s| s as f64 / n as f64);
    let choices = match evaluation.latent_counts.len() {
        0 => String::new(),
        all => format!("; {used} of {all} choices used"),
    };
    say(&format!(
        "{env} ({kind}): return {:.2} ± {:.2} over {n} episodes, seed {}{}{choices}",
        evaluation.mean(),
        evaluation.sd(),
        args.seed,
        success_rate.map_or_else(String::new, |s| format!(", {:.1} % in the goal", 100.0 * s)),
    ));
    if let (Some(path), Some(shot)) = (&args.render, camera.and_then(|camera| camera.finish())) {
        atomic::write(path, &shot.gif)?;
        let part = if shot.cut { "the beginning of the first episode" } else { "the first episode" };
        say(&format!("wrote {}: {part}, {}", path.display(), shot.pace));
    }
    if args.json {
        print_json(&Output {
            version: 1,
            path: &args.path,
            kind,
            env,
            seed: args.seed,
            episodes: n,
            mean: evaluation.mean(),
            sd: evaluation.sd(),
            success_rate,
            latents_used: used,
            returns: &evaluation.returns,
            lengths: &evaluation.lengths,
            latent_counts: &evaluation.latent_counts,
        })?;
    }
    if args.min_return.is_some_and(|least| evaluation.mean() < least) {
        say(&format!("missed: mean return {:.2} is below {}", evaluation.mean(), args.min_return.unwrap_or_default()));
        return Ok(ExitCode::from(CRITERIA_MISSED));
    }
    Ok(ExitCode::SUCCESS)
}
