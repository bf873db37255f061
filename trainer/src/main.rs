//! `gadm`: train, evaluate, export and inspect policies.

mod cli;

use std::process::ExitCode;

fn main() -> ExitCode {
    cli::main()
}
