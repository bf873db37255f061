//! `gadm-sim bus`: what has to do with buses themselves.

use std::process::ExitCode;

use clap::Subcommand;

use super::{hub, load, monitor};

/// Arguments of `bus`.
#[derive(clap::Args)]
pub(crate) struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Connect programs to one bus: unix socket, TCP, pseudo-terminal, SocketCAN
    Hub(hub::Args),
    /// Watch a bus or a trace: signals, rates, load, gaps, latents, nodes
    Monitor(monitor::Args),
    /// Does a policy fit a bus: worst-case load and response time
    Load(load::Args),
}

/// Runs the command.
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    match &args.command {
        Command::Hub(args) => hub::main(args),
        Command::Monitor(args) => monitor::main(args),
        Command::Load(args) => load::main(args),
    }
}
