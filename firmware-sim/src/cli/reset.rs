//! `gadm-sim reset`.

use std::io::Write;
use std::process::ExitCode;

use gadm_sim::{SimError, episode_seed};
use serde_json::json;

const EXAMPLES: &str = "\
Examples:
  gadm-sim reset hopper-v5 --seed 7 --episodes 3
  gadm-sim reset hopper-v5 | jq '.episodes[0].observation'

For a plant in another language that is to run the episodes of `gadm-sim run`
and `gadm eval`: one JSON object, with for each episode the state that it
starts from and the first observation. For a MuJoCo plant `state` holds qpos,
qvel and qacc_warmstart, in this order.";

/// Arguments of `reset`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Plant, by its environment id
    plant: String,
    /// Number of episodes
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    episodes: u64,
    /// Seed of the run; every episode has its own, derived from it
    #[arg(long, default_value_t = 0, value_name = "N")]
    seed: u64,
}

/// Runs the command.
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let mut env = gadm_envs::make(&args.plant).map_err(SimError::from)?;
    let mut observation = vec![0.0; env.spec().obs_dim()];
    let mut episodes = Vec::new();
    for episode in 0..args.episodes {
        let seed = episode_seed(args.seed, episode);
        env.reset(seed, &mut observation);
        // Single precision as it goes on the bus, in decimals that read back to the same number.
        let shown: Vec<f64> = observation.iter().map(|&x| f64::from(x)).collect();
        let state = env.state();
        episodes.push(json!({
            "episode": episode, "seed": seed, "observation": shown, "state": state.reals, "counts": state.counts
        }));
    }
    let value = json!({
        "version": 1,
        "plant": env.spec().id,
        "seed": args.seed,
        "control_period_us": env.spec().control_period_us,
        "episodes": episodes
    });
    writeln!(std::io::stdout().lock(), "{value}")?;
    Ok(ExitCode::SUCCESS)
}
