//! `gadm-sim flash`.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use gadm_node::protocol::NodeId;
use gadm_sim::bus::{self, Address};
use gadm_sim::install::{InstallOptions, install};
use gadm_sim::sil::read_image;
use gadm_sim::{BitRate, SimError};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;

use super::say;

const EXAMPLES: &str = "\
Examples:
  gadm-sim flash policy.bin --connect serial:/dev/ttyACM0
  gadm-sim flash policy.bin --connect socketcan:can0 --node 3 --stage

The node must have two policy slots and be READY or without a policy. The new
policy goes to the slot that is not in use, is checked there, boots on trial
and is confirmed. A transfer that was cut off goes on where it was. A policy
file's sequence number must not be below that of the one that runs (gadm
export --sequence).

Exit codes: 0 ok, 1 error, 2 usage, 4 something is missing here.";

/// Arguments of `flash`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
#[expect(clippy::struct_excessive_bools, reason = "flags of a command line")]
pub(crate) struct Args {
    /// Policy file
    policy: PathBuf,
    /// The bus: unix:PATH, tcp:HOST:PORT, serial:DEVICE, socketcan:INTERFACE
    #[arg(long, value_name = "BUS")]
    connect: Address,
    /// Node number, 1 to 63
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=63))]
    node: u8,
    /// Only classic frames (8 bytes), for a bus without CAN FD
    #[arg(long)]
    classic: bool,
    /// Transfer and check only; do not boot it
    #[arg(long)]
    stage: bool,
    /// Start over, whatever an earlier transfer left
    #[arg(long)]
    start_over: bool,
    /// Print what was done as JSON on standard output
    #[arg(long, help_heading = "Output")]
    json: bool,
}

/// Runs the command.
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let image = read_image(&args.policy)?;
    let name = args.connect.to_string();
    let mut bus = bus::open(&args.connect, BitRate::default())
        .map_err(|e| SimError::Remote { bus: name.clone(), what: format!("cannot join the bus: {e}") })?;
    let options = InstallOptions {
        node: NodeId::new(args.node).unwrap_or(NodeId::DEFAULT),
        fd: !args.classic,
        anew: args.start_over,
        activate: !args.stage,
    };
    let bar = ProgressBar::new(image.len() as u64); // draws on a terminal only
    if let Ok(style) = ProgressStyle::with_template("{bar:24} {bytes}/{total_bytes}  {elapsed} elapsed, {eta} left") {
        bar.set_style(style);
    }
    let done = install(bus.as_mut(), &name, options, &image, &mut |at| bar.set_position(u64::from(at)));
    bar.finish_and_clear();
    let done = done?;
    let state = if args.stage { "staged" } else { "confirmed" };
    if args.json {
        let result = json!({ "version": 1, "node": args.node, "slot": done.slot, "bytes": done.bytes,
                             "resumed_at": done.resumed_at, "state": state });
        writeln!(std::io::stdout().lock(), "{result:#}")?;
    } else {
        let from =
            if done.resumed_at > 0 { format!(", {} were there already", done.resumed_at) } else { String::new() };
        say(&format!("node {}: {} bytes in slot {}{from}; {state}", args.node, done.bytes, done.slot));
    }
    Ok(ExitCode::SUCCESS)
}
