//! `gadm explain`.

use std::path::PathBuf;
use std::process::ExitCode;

use gadm_trainer::atomic;
use gadm_trainer::explain::{Subject, fly, page};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;

use super::{networks, print_json, say};

const EXAMPLES: &str = "\
Examples:
  gadm explain models/hopper-v5/policy.bin -o hopper.html
  gadm explain runs/moving-seed0 -o moving.html --episodes 20 --step 12

The page needs nothing but itself. Of a run folder, what it exports as int8 is flown; its encoder
and float networks give two more sections: which actions share a latent, and what the rounding of
weights costs. Exit code 4 where the environment is not in this build.";

/// Arguments of `explain`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// Run folder or int8 policy file
    path: PathBuf,
    /// HTML file to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Environment [default: the one it was trained in]
    #[arg(long, value_name = "ENV")]
    env: Option<String>,
    /// Number of episodes
    #[arg(long, default_value_t = 10, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000))]
    episodes: u32,
    /// Seed of the episodes; the same as in `gadm eval`
    #[arg(long, default_value_t = 0, value_name = "N")]
    seed: u64,
    /// Step of the first episode at which Q, confidence and encoder are shown, from 0 [default: its middle]
    #[arg(long, value_name = "N")]
    step: Option<u32>,
    /// Of a run: the networks kept at this environment step (setting track.snapshots) instead of those of its best evaluation
    #[arg(long, value_name = "STEP")]
    snapshot: Option<u64>,
    /// Print what the page says of usage, masks and layers as JSON
    #[arg(long)]
    json: bool,
}

/// Runs `explain`.
pub fn main(args: &Args, quiet: bool) -> anyhow::Result<ExitCode> {
    let mut subject = Subject::open(&args.path, networks(false, args.snapshot), args.env.as_deref())?;
    let bar = if quiet { ProgressBar::hidden() } else { ProgressBar::new(args.episodes.into()) };
    bar.set_style(ProgressStyle::with_template("{pos} of {len} episodes {bar:30} {per_sec}, ETA {eta}")?);
    let flight = fly(&subject, args.episodes as usize, args.seed, |done| bar.set_position(done as u64))?;
    bar.finish_and_clear();
    let steps = flight.shown.len();
    let at = args.step.map_or(steps / 2, |step| step as usize);
    anyhow::ensure!(at < steps, "--step: expected 0 to {}, found {at}: the first episode has {steps} steps", steps - 1);
    let page = page(&mut subject, &flight, at)?;
    atomic::write(&args.output, page.to_html().as_bytes())?;
    say(&format!("wrote {}", args.output.display()));
    if args.json {
        let choices: Vec<_> = flight.choices().collect();
        let share = |count: usize| count as f64 / choices.len() as f64;
        print_json(&json!({
            "version": 1,
            "path": args.path,
            "env": subject.env,
            "seed": args.seed,
            "returns": flight.episodes.iter().map(|episode| episode.total).collect::<Vec<_>>(),
            "decisions": choices.len(),
            "latent_counts": flight.chosen(),
            "allowed_counts": flight.allowed,
            "mean_allowed": choices.iter().map(|choice| f64::from(choice.allowed)).sum::<f64>() / choices.len() as f64,
            "fallback_rate": share(choices.iter().filter(|choice| choice.fallback).count()),
            "clipped_rate": share(choices.iter().filter(|choice| choice.clipped).count()),
            "layers": flight.layers.errors().iter().map(|error| json!({
                "layer": error.layer,
                "weights": error.weights,
                "activations": error.activations,
                "all": error.all,
            })).collect::<Vec<_>>(),
        }))?;
    }
    Ok(ExitCode::SUCCESS)
}
