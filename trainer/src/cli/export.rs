//! `gadm export`.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use gadm_node::Profile;
use gadm_node::load::{BitRate, policy_load, proposal};
use gadm_runtime::Policy;
use gadm_runtime::encode::AlignedImage;
use gadm_trainer::atomic;
use gadm_trainer::card::ReturnStats;
use gadm_trainer::config::TrainConfig;
use gadm_trainer::config::builtin::is_builtin;
use gadm_trainer::export::{ExportOptions, Exported, Limits, export, make_card, parts_of};
use gadm_trainer::metrics::{keys, read_jsonl};
use gadm_trainer::runner::origin::Origin;

use super::{CRITERIA_MISSED, print_json, say};

const EXAMPLES: &str = "\
Examples:
  gadm export runs/hopper-v5-seed0 -o policy.bin
  gadm export runs/hopper-v5-seed0 -o policy.bin --episodes 100 --sil sil.json
  gadm export runs/hopper-v5-seed0 -o policy-f32.bin --float

Writes the policy file, and card.toml and card.md beside it. Exit code 3, and nothing
written, where the file is too far from the float networks; the limits can be changed.";

/// Arguments of `export`.
#[derive(clap::Args)]
#[expect(clippy::struct_excessive_bools, reason = "each is a flag of the command line")]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// Run folder
    run: PathBuf,
    /// Policy file to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Episodes of the comparison float against file
    #[arg(long, default_value_t = 20, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    episodes: u32,
    /// Seed of the comparison's episodes
    #[arg(long, default_value_t = 0, value_name = "N")]
    seed: u64,
    /// The last networks instead of those of the best evaluation
    #[arg(long)]
    last: bool,
    /// f32 weights, for targets with a floating-point unit
    #[arg(long)]
    float: bool,
    /// Sequence number; of two policies on a device the higher one is newer
    #[arg(long, default_value_t = 1, value_name = "N")]
    sequence: u32,
    /// Result of `gadm-sim run --json` with this policy, for the card
    #[arg(long, value_name = "FILE")]
    sil: Option<PathBuf>,
    /// Least share of observations on which both choose the same latent
    #[arg(long, default_value_t = Limits::default().agreement, value_name = "SHARE", help_heading = "Limits")]
    min_agreement: f64,
    /// Largest mean action error, as a share of the range
    #[arg(long, default_value_t = Limits::default().action_error, value_name = "SHARE", help_heading = "Limits")]
    max_action_error: f64,
    /// Largest loss of mean return, as a share of the float return
    #[arg(long, default_value_t = Limits::default().return_loss, value_name = "SHARE", help_heading = "Limits")]
    max_return_loss: f64,
    /// Bus profile that the policy must fit: `fd-f32` or `classic-i16`
    #[arg(long, default_value = "fd-f32", value_name = "PROFILE", help_heading = "Bus",
          value_parser = ["fd-f32", "classic-i16"])]
    profile: String,
    /// Bit rate of classic frames and of the arbitration of FD frames, bit/s
    #[arg(long, default_value_t = BitRate::default().nominal, value_name = "BPS", help_heading = "Bus",
          value_parser = clap::value_parser!(u32).range(10_000..=1_000_000))]
    bitrate: u32,
    /// Bit rate of the data of FD frames, bit/s
    #[arg(long, default_value_t = BitRate::default().data, value_name = "BPS", help_heading = "Bus",
          value_parser = clap::value_parser!(u32).range(10_000..=8_000_000))]
    data_bitrate: u32,
    /// Write even where a limit is missed
    #[arg(long, help_heading = "Limits")]
    force: bool,
    /// Print the comparison as JSON on standard output
    #[arg(long)]
    json: bool,
}

/// The command that makes this run again, with the program of the commit in `origin` too: short where the built-in configuration
/// and the seed explain it, there and here.
fn command(config: &TrainConfig, origin: &Origin) -> String {
    let TrainConfig { env, seed, steps, .. } = config;
    if origin.built_in && is_builtin(config) {
        format!("gadm train --env {env} --seed {seed} --steps {steps}")
    } else {
        format!("gadm train --config config.toml --seed {seed} (configuration below)")
    }
}

/// Seconds the run trained until the exported networks were stored.
fn wall_time_s(run: &Path, env_steps: u64) -> f64 {
    let records = read_jsonl(&run.join("timing.jsonl")).unwrap_or_default();
    let until = records.iter().filter(|(step, _)| *step <= env_steps);
    until.filter_map(|(_, values)| values.get(keys::WALL_S)).fold(0.0, |m, &v| f64::max(m, v))
}

fn sil_stats(path: &Path) -> anyhow::Result<ReturnStats> {
    let text = std::fs::read_to_string(path).map_err(|e| anyhow::anyhow!("cannot read {}: {e}", path.display()))?;
    let (returns, seed) = super::report::sil_returns(&text)
        .ok_or_else(|| anyhow::anyhow!("{} is no result of `gadm-sim run --json`", path.display()))?;
    ReturnStats::of(&returns, seed).ok_or_else(|| anyhow::anyhow!("{} holds no episode", path.display()))
}

fn table(exported: &Exported) -> anyhow::Result<()> {
    let image = AlignedImage::new(&exported.bytes);
    let policy = Policy::load(&image).map_err(|e| anyhow::anyhow!("{e}"))?;
    let (float, device) = (&exported.float, &exported.device);
    say(&format!(
        "float networks   return {:10.2} ± {:.2}  ({} episodes)",
        float.mean(),
        float.sd(),
        float.returns.len()
    ));
    say(&format!("policy file      return {:10.2} ± {:.2}  (same episodes)", device.mean(), device.sd()));
    let p = exported.parity;
    say(&format!(
        "same latent on {:.2} % of {} observations; action error where they agree: mean {:.5}, largest {:.5} of the range",
        100.0 * p.argmax_agreement,
        p.samples,
        p.action_error_mean,
        p.action_error_max
    ));
    say("bytes by part:");
    for (name, bytes) in parts_of(&policy.section_sizes()).into_iter().filter(|(_, b)| *b > 0) {
        say(&format!("  {name:22} {bytes:>9}"));
    }
    say(&format!("  {:22} {:>9}", "total", exported.bytes.len()));
    let used = device.latent_counts.iter().filter(|c| **c > 0).count();
    say(&format!(
        "{} multiply-accumulates a step, {} bytes of scratch memory, {used} of {} latents used",
        policy.spec().macs,
        4 * policy.spec().scratch_words,
        policy.spec().num_latents
    ));
    Ok(())
}

/// Load of the policy on a bus, a line for each profile. Returns why the chosen profile does not fit, and what does.
fn bus_load(args: &Args, policy: &Policy) -> Option<String> {
    let rate = BitRate { nominal: args.bitrate, data: args.data_bitrate };
    let kbit = |rate: BitRate| format!("{}/{} kbit/s", rate.nominal / 1000, rate.data / 1000);
    let mut refused = None;
    for profile in Profile::ALL {
        let reason = match policy_load(policy, profile, rate) {
            Ok(load) => {
                let excess = load.excess().map(|e| e.to_string());
                let verdict = excess.as_ref().map_or_else(|| "fits".to_owned(), |e| format!("does not fit: {e}"));
                say(&format!(
                    "bus load {:12} {:6.1} % at {}, worst case: {verdict}",
                    profile.name(),
                    load.total_percent,
                    kbit(rate)
                ));
                excess
            }
            Err(error) => Some(error.to_string()),
        };
        if profile.name() == args.profile {
            refused = reason;
        }
    }
    refused.map(|reason| {
        let fits: Vec<_> = Profile::ALL
            .iter()
            .filter_map(|&p| {
                proposal(policy, p).map(|(r, l)| format!("{} at {} ({:.0} %)", p.name(), kbit(r), l.total_percent))
            })
            .collect();
        let fits = if fits.is_empty() { "nothing at usual bit rates".to_owned() } else { fits.join("; ") };
        format!("profile {} at {} does not fit: {reason}; what fits: {fits}", args.profile, kbit(rate))
    })
}

/// Runs `export`.
pub fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let sil = args.sil.as_deref().map(sil_stats).transpose()?;
    let exported = export(
        &args.run,
        &ExportOptions {
            best: !args.last,
            episodes: args.episodes as usize,
            seed: args.seed,
            float_weights: args.float,
            policy_seq: args.sequence,
        },
    )?;
    table(&exported)?;
    let limits = Limits {
        agreement: args.min_agreement,
        action_error: args.max_action_error,
        return_loss: args.max_return_loss,
    };
    let mut missed = limits.missed(&exported);
    let image = AlignedImage::new(&exported.bytes);
    let policy = Policy::load(&image).map_err(|e| anyhow::anyhow!("{e}"))?;
    missed.extend(bus_load(args, &policy));
    if args.json {
        print_json(&serde_json::json!({
            "version": 1,
            "policy": args.output,
            "bytes": exported.bytes.len(),
            "float": { "mean": exported.float.mean(), "sd": exported.float.sd(), "returns": exported.float.returns },
            "device": { "mean": exported.device.mean(), "sd": exported.device.sd(), "returns": exported.device.returns },
            "parity": exported.parity,
            "missed": missed,
        }))?;
    }
    for m in &missed {
        say(&format!("missed: {m}"));
    }
    if !missed.is_empty() && !args.force {
        say("nothing written: train longer, change the limits, or write it all the same with --force");
        return Ok(ExitCode::from(CRITERIA_MISSED));
    }
    let name = args.output.file_name().map_or_else(|| "policy.bin".into(), |n| n.to_string_lossy());
    let wall = wall_time_s(&args.run, exported.env_steps);
    let origin = Origin::of_run(&args.run)?;
    let card = make_card(&exported, &name, &command(&exported.config, &origin), wall, &origin, args.seed, sil)?;
    atomic::write(&args.output, &exported.bytes)?;
    atomic::write(&args.output.with_file_name("card.toml"), card.to_toml()?.as_bytes())?;
    atomic::write(&args.output.with_file_name("card.md"), card.to_markdown().as_bytes())?;
    say(&format!("wrote {}, card.toml and card.md beside it", args.output.display()));
    say(&format!("next: gadm-sim run {}", args.output.display()));
    Ok(ExitCode::SUCCESS)
}
