//! `gadm-sim dbc`.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use gadm_node::NodeId;
use gadm_runtime::Policy;
use gadm_sim::SimError;
use gadm_sim::dbc::Database;
use gadm_sim::sil::read_image;
use serde_json::json;

use super::run::ProfileArg;
use super::say;

const EXAMPLES: &str = "\
Examples:
  gadm-sim dbc models/hopper-v5/policy.bin -o hopper.dbc
  gadm-sim dbc policy.bin --profile classic-i16 | cantools list /dev/stdin

The database holds all messages of one node with its plant and host: names,
units, limits, scales, cycle times, node states, faults and pages, CAN FD and
float marks, and the interface hash as attribute GadmInterfaceHash.";

/// Arguments of `dbc`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Policy file
    policy: PathBuf,
    /// How values travel
    #[arg(long, value_enum, default_value = "fd-f32")]
    profile: ProfileArg,
    /// Number of the node, 1 to 63
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u8).range(1..64))]
    node: u8,
    /// Write to FILE [default: standard output]
    #[arg(long, short, value_name = "FILE", help_heading = "Output")]
    output: Option<PathBuf>,
    /// With -o: tell on standard output what was written, as JSON
    #[arg(long, requires = "output", help_heading = "Output")]
    json: bool,
}

/// Runs the command.
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let image = read_image(&args.policy)?;
    let policy = Policy::load(&image).map_err(SimError::Policy)?;
    let node = NodeId::new(args.node).unwrap_or(NodeId::DEFAULT);
    let database = Database::new(&policy, args.profile.into(), node)?;
    let text = database.text();
    let mut out = std::io::stdout().lock();
    let Some(path) = &args.output else {
        out.write_all(text.as_bytes())?;
        return Ok(ExitCode::SUCCESS);
    };
    std::fs::write(path, text).map_err(|source| SimError::Write { path: path.clone(), source })?;
    let signals: usize = database.messages.iter().map(|m| m.signals.len()).sum();
    say(&format!(
        "{}: {} messages, {signals} signals, profile {}, node {}, interface {:016x}",
        path.display(),
        database.messages.len(),
        database.profile.name(),
        database.node,
        database.interface_hash
    ));
    if args.json {
        let value = json!({
            "version": 1,
            "file": path,
            "profile": database.profile.name(),
            "node": database.node,
            "interface_hash": format!("{:016x}", database.interface_hash),
            "messages": database.messages.len(),
            "signals": signals,
        });
        writeln!(out, "{value}")?;
    }
    Ok(ExitCode::SUCCESS)
}
