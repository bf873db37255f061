//! The command line. People read standard error, programs standard output.

mod bus;
mod campaign;
mod completions;
mod dbc;
mod doctor;
mod flash;
mod hub;
mod load;
mod man;
mod monitor;
mod node;
mod replay;
mod report;
mod reset;
mod run;
mod soak;
mod trace;

use std::io::Write;
use std::process::ExitCode;

use clap::{Parser, Subcommand};
use gadm_sim::SimError;

/// A criterion was missed.
const CRITERIA_MISSED: u8 = 3;

const EXIT_CODES: &str = "Exit codes: 0 ok, 1 error, 2 usage, 3 criteria missed, 4 something is missing here.";

#[derive(Parser)]
#[command(name = "gadm-sim", version, max_term_width = 80, after_help = EXIT_CODES)]
/// Runs a policy on a simulated plant over a CAN bus, and reads traces
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Drive a plant with a policy over the bus, in virtual time
    Run(run::Args),
    /// Run a policy node as a process of its own, on a bus
    Node(node::Args),
    /// Run plant and host on a bus where a node is already
    Plant(run::PlantArgs),
    /// Connect programs to one bus; how much of a bus a policy needs
    Bus(bus::Args),
    /// Run every fault of a scenario at every intensity, on all cores
    Campaign(campaign::Args),
    /// Run a million steps over a hub with random faults, and account for every frame
    Soak(soak::Args),
    /// Write the messages of a policy as a CAN database (DBC)
    Dbc(dbc::Args),
    /// Put a trace through a policy again: the same actions, or where they differ
    Replay(replay::Args),
    /// Print the states from which the episodes of a plant start
    Reset(reset::Args),
    /// Bring a new policy to a node over its bus: transfer, trial, confirmation
    Flash(flash::Args),
    /// Read a candump trace as named signals
    Trace(trace::Args),
    /// Say what this machine can do, and how to get the rest
    Doctor(doctor::Args),
    /// Write a script that completes commands in a shell
    Completions(completions::Args),
    /// Write manual pages
    Man(man::Args),
}

/// Runs the program.
pub(crate) fn main() -> ExitCode {
    let done = match Cli::parse().command {
        Command::Run(args) => run::main(&args),
        Command::Node(args) => node::main(&args),
        Command::Plant(args) => run::plant(&args),
        Command::Bus(args) => bus::main(&args),
        Command::Campaign(args) => campaign::main(&args),
        Command::Soak(args) => soak::main(&args),
        Command::Dbc(args) => dbc::main(&args),
        Command::Replay(args) => replay::main(&args),
        Command::Reset(args) => reset::main(&args),
        Command::Flash(args) => flash::main(&args),
        Command::Trace(args) => trace::main(&args),
        Command::Doctor(args) => doctor::main(&args),
        Command::Completions(args) => completions::main(&args),
        Command::Man(args) => man::main(&args),
    };
    match done {
        Ok(code) => code,
        Err(error) => {
            // A reader that went away (`gadm-sim trace … | head`) is no error.
            let gone =
                error.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == std::io::ErrorKind::BrokenPipe);
            if gone {
                return ExitCode::SUCCESS;
            }
            say(&format!("error: {}", causes(&error)));
            ExitCode::from(error.downcast_ref::<SimError>().map_or(1, SimError::exit_code))
        }
    }
}

/// An error with its causes, less those that the words before them tell already.
fn causes(error: &anyhow::Error) -> String {
    let all = error.chain().map(ToString::to_string);
    let joined = all.reduce(|said, cause| if said.contains(&cause) { said } else { format!("{said}: {cause}") });
    joined.unwrap_or_default()
}

/// One line for people.
fn say(text: &str) {
    // Nobody is left to be told about a closed standard error.
    let _ = writeln!(std::io::stderr(), "{text}");
}
