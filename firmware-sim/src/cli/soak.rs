//! `gadm-sim soak`.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use gadm_sim::campaign::replace;
use gadm_sim::soak::{Options, Soak, soak};

use super::{CRITERIA_MISSED, say};

const EXAMPLES: &str = "\
Examples:
  gadm-sim soak models/inverted-pendulum-v5/policy.bin
  gadm-sim soak policy.bin --steps 50000 --json -o soak.json

Hub, plant, node and a listener are members of one hub in this process, which
speak SLCAN over a unix socket in lockstep, as fast as the machine can.

Exit codes: 0 ok, 1 error, 2 usage, 3 a frame was lost that no fault took, or
memory grew, or an action was too old or out of bounds.";

/// Arguments of `soak`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Policy file
    policy: PathBuf,
    /// Control steps
    #[arg(long, default_value_t = 1_000_000, value_name = "N", value_parser = clap::value_parser!(u64).range(1000..))]
    steps: u64,
    /// Seed of plant and faults
    #[arg(long, default_value_t = 0, value_name = "N")]
    seed: u64,
    /// Write the result as JSON
    #[arg(long, short, value_name = "FILE", help_heading = "Output")]
    out: Option<PathBuf>,
    /// Print the result as JSON on standard output
    #[arg(long, help_heading = "Output")]
    json: bool,
    /// No progress and no table
    #[arg(long, short, help_heading = "Output")]
    quiet: bool,
}

/// Runs the command.
#[expect(clippy::disallowed_methods, reason = "the display shows a rate; no result depends on it")]
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let options = Options { policy: args.policy.clone(), steps: args.steps, seed: args.seed };
    let (started, mut last) = (Instant::now(), Instant::now());
    let found = soak(&options, &mut |steps| {
        if !args.quiet && last.elapsed() > Duration::from_secs(10) {
            last = Instant::now();
            let rate = steps as f64 / started.elapsed().as_secs_f64();
            let left = args.steps.saturating_sub(steps) as f64 / rate;
            say(&format!("step {steps}/{}  {rate:.0} steps/s  {left:.0} s left", args.steps));
        }
    })?;
    let text = format!("{:#}\n", serde_json::to_value(&found)?);
    if let Some(path) = &args.out {
        replace(path, text.as_bytes())?;
    }
    if args.json {
        std::io::stdout().lock().write_all(text.as_bytes())?;
    }
    if !args.quiet {
        table(&found);
    }
    let troubles = found.troubles();
    for trouble in &troubles {
        say(&format!("missed: {trouble}"));
    }
    Ok(if troubles.is_empty() { ExitCode::SUCCESS } else { ExitCode::from(CRITERIA_MISSED) })
}

fn table(found: &Soak) {
    let rate = found.steps as f64 / found.wall_s;
    let injected: u64 = found.faults.iter().map(|f| f.injected).sum();
    say(&format!(
        "  steps       {} in {:.0} s, {rate:.0} a second, {} episodes",
        found.steps, found.wall_s, found.episodes
    ));
    say(&format!("  faults      {injected} injected, {} kinds", found.faults.len()));
    say(&format!("  frames      {} on the wire, {} received by the listener", found.wire.frames, found.heard.frames));
    say(&format!(
        "  jumps       {} ticks, {} action sets, the same at both ends",
        found.wire.tick_jumps, found.wire.set_jumps
    ));
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    let (first, last) = (found.memory.first(), found.memory.last());
    let at = |s: Option<&gadm_sim::soak::Sample>| s.map_or(0.0, |s| mib(s.resident));
    say(&format!(
        "  memory      {:.1} MiB at first, {:.1} MiB at last, grew {:.2} MiB after the first fifth",
        at(first),
        at(last),
        mib(found.growth)
    ));
}
