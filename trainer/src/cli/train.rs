//! `gadm train`.

use std::path::PathBuf;
use std::process::ExitCode;
use std::thread::available_parallelism;

use anyhow::Context as _;
use clap::builder::{PossibleValue, PossibleValuesParser};
use gadm_trainer::config::builtin::builtin;
use gadm_trainer::config::resolve::resolve;
use gadm_trainer::config::{ALGORITHMS, Algorithm, AlgorithmName, Layer, TrainConfig, to_toml};
use gadm_trainer::nn::{Engine, parallel};
use gadm_trainer::runner::progress::Style;
use gadm_trainer::runner::train::CONFIG_FILE;
use gadm_trainer::runner::{TrainOptions, train};

use super::{print, print_json, say, stop_on_interrupt};

const EXAMPLES: &str = "\
Examples:
  gadm train --env inverted-pendulum-v5
  gadm train --env hopper-v5 --seed 1 --set round.q_updates=25
  gadm train --env pendulum --algo td3 --set td3.gamma=0.98
  gadm train --config my.toml --out runs/mine
  gadm train --out runs/mine --resume --steps 2000000

Without --config, an environment's built-in configuration is used where there is one.
--print-config shows the resolved one. Ctrl-C writes a checkpoint and stops; --resume goes
on as if never stopped. The run folder holds config.toml, metrics.jsonl, timing.jsonl,
TensorBoard events and checkpoints/.";

/// Arguments of `train`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// Environment id (see `gadm env list`)
    #[arg(long, value_name = "ENV")]
    env: Option<String>,
    /// What learns; a baseline has its settings in a table of its own (see --print-config) [default: gadm-dqn]
    #[arg(long, value_name = "ALGO", value_parser = PossibleValuesParser::new(ALGORITHMS.iter().map(|(id, about)| PossibleValue::new(*id).help(*about))))]
    algo: Option<String>,
    /// Configuration file (TOML)
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// One setting, e.g. dqn.gamma=0.98; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// Seed of every random stream
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Environment steps, warm-up included
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    /// Run folder [default: runs/ENV-seedN, of a baseline runs/ALGO-ENV-seedN]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Continue the run in --out
    #[arg(long)]
    resume: bool,
    /// Threads that share the work of an update, 1 or 2; results are the same [default: as many as there are cores]
    #[arg(long, value_parser = clap::value_parser!(u8).range(1..=2), value_name = "N")]
    threads: Option<u8>,
    /// What evaluates the networks: cpu (fused layers), candle (the reference, on the processor), cuda or cuda:N (a GPU through
    /// candle; builds with feature `cuda`). Results agree up to rounding, so seeds give other runs
    #[arg(long, default_value_t, value_name = "DEVICE")]
    device: Engine,
    /// Print the resolved configuration and stop
    #[arg(long)]
    print_config: bool,
    /// Print the outcome as JSON on standard output
    #[arg(long)]
    json: bool,
}

fn read(path: &PathBuf) -> anyhow::Result<Layer> {
    let text = std::fs::read_to_string(path)
        .with_context(|| format!("cannot read configuration {}: check the path", path.display()))?;
    Ok(Layer::Toml { origin: path.display().to_string(), text })
}

fn config(args: &Args) -> anyhow::Result<TrainConfig> {
    let mut layers = Vec::new();
    let algo = args.algo.as_deref().unwrap_or(AlgorithmName::default().id());
    if args.resume {
        let out = args.out.as_ref().context("--resume needs --out DIR, the run folder to continue")?;
        layers.push(read(&out.join(CONFIG_FILE))?);
    }
    if let Some(path) = &args.config {
        layers.push(read(path)?);
    } else if let Some(text) = args.env.as_deref().and_then(|env| builtin(algo, env)).filter(|_| !args.resume) {
        let env = args.env.as_deref().unwrap_or_default();
        layers
            .push(Layer::Toml { origin: format!("built-in configuration of {algo} on {env}"), text: text.to_owned() });
    } else if args.env.is_none() && !args.resume {
        anyhow::bail!("nothing to train: name an environment with --env, or a configuration with --config");
    }
    if !args.resume {
        layers.extend(args.algo.iter().map(|algo| Layer::Set(format!("algo={algo}"))));
    }
    layers.extend(args.env.iter().map(|env| Layer::Set(format!("env={env}"))));
    layers.extend(args.seed.iter().map(|seed| Layer::Set(format!("seed={seed}"))));
    layers.extend(args.steps.iter().map(|steps| Layer::Set(format!("steps={steps}"))));
    layers.extend(args.sets.iter().cloned().map(Layer::Set));
    Ok(resolve(&layers)?)
}

/// `runs/ENV-seedN`, or `runs/ALGO-ENV-seedN` for a baseline.
fn default_folder(config: &TrainConfig) -> PathBuf {
    let name = format!("{}-seed{}", config.env, config.seed);
    let gadm = config.algo == Algorithm::GadmDqn;
    PathBuf::from("runs").join(if gadm { name } else { format!("{}-{name}", config.algo.name().id()) })
}

/// Runs `train`.
pub fn main(args: Args, quiet: bool) -> anyhow::Result<ExitCode> {
    let config = config(&args)?;
    if args.print_config {
        print(to_toml(&config)?.trim_end())?;
        return Ok(ExitCode::SUCCESS);
    }
    args.device.start()?;
    let dir = args.out.unwrap_or_else(|| default_folder(&config));
    let stop = stop_on_interrupt()?;
    say(&format!("{} {} in {}", if args.resume { "continuing" } else { "training" }, config.env, dir.display()));
    let gadm = config.algo == Algorithm::GadmDqn;
    let style = Style::detect(quiet);
    parallel::start(args.threads.map_or_else(|| available_parallelism().map_or(1, usize::from), usize::from));
    let outcome = train(&TrainOptions { config: Some(config), dir: dir.clone(), resume: args.resume, style, stop })?;
    if let Some(best) = outcome.best_return {
        say(&format!("best evaluation: mean return {best:.2}"));
    }
    if args.json {
        print_json(&serde_json::json!({
            "version": 1,
            "run": dir,
            "env_steps": outcome.env_steps,
            "interrupted": outcome.interrupted,
            "best_return": outcome.best_return,
            "last_return": outcome.last.as_ref().map(gadm_trainer::runner::Evaluation::mean),
            "wall_s": outcome.wall_s,
        }))?;
    }
    if outcome.interrupted {
        say(&format!("continue with: gadm train --out {} --resume", dir.display()));
        return Ok(ExitCode::from(130));
    }
    say(&if gadm {
        format!("next: gadm export {} -o policy.bin", dir.display())
    } else {
        format!("next: gadm eval {}", dir.display())
    });
    Ok(ExitCode::SUCCESS)
}
