//! `gadm-sim`: runs policies on simulated plants over a CAN bus, and reads traces.

mod cli;

use std::process::ExitCode;

fn main() -> ExitCode {
    cli::main()
}
