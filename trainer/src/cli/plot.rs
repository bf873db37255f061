//! `gadm plot`.

use std::path::PathBuf;
use std::process::ExitCode;

use gadm_trainer::atomic;
use gadm_trainer::config::{Layer, TrainConfig, resolve::resolve};
use gadm_trainer::plot::PlotOptions;
use gadm_trainer::plot::curve::{RunCurve, learning_curve, read_run};
use gadm_trainer::runner::train::CONFIG_FILE;

use super::say;

/// Arguments of `plot`.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  gadm plot runs/hopper-v5-seed* -o hopper.svg\n\nRuns of the same environment and algorithm are drawn as one curve: mean, shaded standard\ndeviation over seeds, each seed thin."
)]
pub struct Args {
    /// Run folders
    #[arg(required = true)]
    runs: Vec<PathBuf>,
    /// SVG file to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Title of the figure
    #[arg(long, default_value = "Learning curve", value_name = "TEXT")]
    title: String,
    /// One curve per run, named after its folder
    #[arg(long)]
    separate: bool,
}

/// The curve of a run, labelled with its environment.
pub fn curve(run: &std::path::Path, separate: bool) -> anyhow::Result<RunCurve> {
    let config = std::fs::read_to_string(run.join(CONFIG_FILE))
        .map_err(|e| anyhow::anyhow!("{} is no run folder: cannot read its {CONFIG_FILE} ({e})", run.display()))?;
    let config: TrainConfig =
        resolve(&[Layer::Toml { origin: run.join(CONFIG_FILE).display().to_string(), text: config }])?;
    let label = if separate { run.display().to_string() } else { format!("{}, GADM+DQN", config.env) };
    Ok(read_run(run, label)?)
}

/// Runs `plot`.
pub fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let curves = args.runs.iter().map(|run| curve(run, args.separate)).collect::<Result<Vec<_>, _>>()?;
    let svg = learning_curve(&curves, &PlotOptions::new(args.title.clone()))?;
    atomic::write(&args.output, svg.as_bytes())?;
    say(&format!("wrote {}", args.output.display()));
    Ok(ExitCode::SUCCESS)
}
