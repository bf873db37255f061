//! `gadm-sim replay`.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use gadm_node::NodeId;
use gadm_sim::bus::trace;
use gadm_sim::replay::{ActionSet, ReplayOptions, replay};
use gadm_sim::sil::read_image;

use super::run::ProfileArg;
use super::{CRITERIA_MISSED, say};

const EXAMPLES: &str = "\
Examples:
  gadm-sim replay run.log --policy policy.bin
  gadm-sim replay candump-2026-11-22.log --policy policy.bin --interface can0 --json

The node of this program gets what was sent to the recorded one; latent, flags
and every action value must be equal, bit for bit. Not compared: inference
times and the flag `late`, which belong to the board. TRACE is what
`candump -l` and `candump -L`, python-can's .log writer and `gadm-sim run
--trace` write.

Exit codes: 0 the same actions, 1 error, 2 usage, 3 a tick differs.";

/// Arguments of `replay`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Trace in the text form of candump logs
    trace: PathBuf,
    /// Policy file
    #[arg(long, value_name = "FILE")]
    policy: PathBuf,
    /// Number of the recorded node, 1 to 63
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u8).range(1..64))]
    node: u8,
    /// How values travel [default: what the trace holds]
    #[arg(long, value_enum)]
    profile: Option<ProfileArg>,
    /// Bus in the trace [default: the only one]
    #[arg(long, value_name = "NAME")]
    interface: Option<String>,
    /// Print the result as JSON on standard output
    #[arg(long, help_heading = "Output")]
    json: bool,
}

/// Runs the command.
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let image = read_image(&args.policy)?;
    let records = trace::read(&args.trace)?;
    let options = ReplayOptions {
        node: NodeId::new(args.node),
        profile: args.profile.map(Into::into),
        interface: args.interface.clone(),
    };
    let result = replay(&image, &records, &options)?;
    if args.json {
        let mut out = std::io::stdout().lock();
        serde_json::to_writer_pretty(&mut out, &result).map_err(std::io::Error::from)?;
        writeln!(out)?;
    }
    if result.assumed_run {
        say("the trace begins in the middle of an episode: the node was started before its first tick");
    }
    if result.damaged > 0 {
        say(&format!(
            "{} frames of node {} could not be read (damaged, or of another policy)",
            result.damaged, result.node
        ));
    }
    let Some(first) = &result.first else {
        say(&format!(
            "the same actions: {} action sets in {} ticks, profile {}, node {}",
            result.compared, result.ticks, result.profile, result.node
        ));
        return Ok(ExitCode::SUCCESS);
    };
    say(&format!(
        "{} of {} action sets differ; the first at tick {}: {}",
        result.differing, result.compared, first.tick, first.what
    ));
    show("trace", first.recorded.as_ref());
    show("replay", first.replayed.as_ref());
    Ok(ExitCode::from(CRITERIA_MISSED))
}

fn show(side: &str, set: Option<&ActionSet>) {
    let Some(set) = set else {
        say(&format!("  {side:<7} nothing"));
        return;
    };
    let latent = set.latent.map_or_else(|| "none".to_owned(), |l| l.to_string());
    let action: Vec<_> = set.action.iter().map(|(name, value)| format!("{name}={value}")).collect();
    say(&format!(
        "  {side:<7} {:.6} s  latent {latent}  flags [{}]  {}",
        set.time_us as f64 / 1e6,
        set.flags.join(" "),
        action.join(" ")
    ));
}
