//! The command line. People read standard error, programs standard output; this is the only place that prints.

mod bench;
mod completions;
mod doctor;
mod env;
mod eval;
mod explain;
mod export;
mod image;
mod inspect;
mod man;
mod paper;
mod plot;
mod report;
mod train;

use std::io::Write as _;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::{Parser, Subcommand};
use gadm_envs::EnvError;
use gadm_trainer::TrainError;
use gadm_trainer::runner::checkpoint::Networks;
use serde::Serialize;

/// A criterion was missed.
pub const CRITERIA_MISSED: u8 = 3;
/// Something this needs is not on the machine.
const ENVIRONMENT_LACKING: u8 = 4;

const EXIT_CODES: &str = "Exit codes: 0 ok, 1 error, 2 usage, 3 criteria missed, 4 something is missing here,\n\
                          130 interrupted (the run can be resumed).";

#[derive(Parser)]
#[command(name = "gadm", version, max_term_width = 90, after_help = EXIT_CODES)]
/// Learns control policies with discrete latent actions, and exports them for microcontrollers
struct Cli {
    /// Less on standard error: -q no progress, errors remain
    #[arg(short, long, global = true)]
    quiet: bool,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Train a policy in a run folder, or continue one
    Train(train::Args),
    /// Measure the return of a run or of a policy file
    Eval(eval::Args),
    /// Write a page on why a policy acts as it does
    Explain(explain::Args),
    /// Turn a run into a policy file for the device
    Export(export::Args),
    /// Turn a policy file into a flash image, or read one back
    Image(image::Args),
    /// Show what is in a policy file
    Inspect(inspect::Args),
    /// Make the paper's figures again: run what is missing, draw, tabulate
    Paper(paper::Args),
    /// Draw learning curves
    Plot(plot::Args),
    /// Write the HTML report of a run
    Report(report::Args),
    /// List environments, check them against recordings
    #[command(subcommand)]
    Env(env::Command),
    /// Measure the speed of this program's parts on this machine
    #[command(subcommand)]
    Bench(bench::Command),
    /// Say what this machine can do, and how to get the rest
    Doctor(doctor::Args),
    /// Write a script that completes commands in a shell
    Completions(completions::Args),
    /// Write manual pages
    Man(man::Args),
}

/// Runs the program.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    let level = if cli.quiet { "warn" } else { "info" };
    let filter = tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| level.into());
    tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .with_env_filter(filter)
        .without_time()
        .with_target(false)
        .with_level(false)
        .with_ansi(false)
        .init();
    let done = match cli.command {
        Command::Train(args) => train::main(args, cli.quiet),
        Command::Eval(args) => eval::main(&args),
        Command::Explain(args) => explain::main(&args, cli.quiet),
        Command::Export(args) => export::main(&args),
        Command::Image(args) => image::main(&args),
        Command::Inspect(args) => inspect::main(&args),
        Command::Paper(args) => paper::main(&args, cli.quiet),
        Command::Plot(args) => plot::main(&args),
        Command::Report(args) => report::main(&args),
        Command::Env(command) => env::main(&command),
        Command::Bench(command) => bench::main(&command),
        Command::Doctor(args) => doctor::main(&args),
        Command::Completions(args) => completions::main(&args),
        Command::Man(args) => man::main(&args),
    };
    match done {
        Ok(code) => code,
        Err(error) => {
            // A reader that went away (`gadm inspect … | head`) is no error.
            let gone =
                error.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == std::io::ErrorKind::BrokenPipe);
            if gone {
                return ExitCode::SUCCESS;
            }
            say(&format!("error: {error:#}"));
            let lacking = |e: &EnvError| matches!(e, EnvError::Feature { .. });
            let env = error.downcast_ref::<EnvError>().is_some_and(lacking)
                || matches!(error.downcast_ref(), Some(TrainError::Env(e)) if lacking(e));
            if env { ExitCode::from(ENVIRONMENT_LACKING) } else { ExitCode::FAILURE }
        }
    }
}

/// A flag that Ctrl-C, SIGTERM and SIGHUP set; the second of them ends the program at once.
fn stop_on_interrupt() -> anyhow::Result<&'static AtomicBool> {
    static STOP: AtomicBool = AtomicBool::new(false);
    ctrlc::set_handler(|| {
        if STOP.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
    })?;
    Ok(&STOP)
}

/// Which networks of a run folder the options of a command name.
fn networks(last: bool, snapshot: Option<u64>) -> Networks {
    match snapshot {
        Some(step) => Networks::Snapshot(step),
        None if last => Networks::Last,
        None => Networks::Best,
    }
}

/// One line for people.
fn say(text: &str) {
    // Nobody is left to be told about a closed standard error.
    let _ = writeln!(std::io::stderr(), "{text}");
}

/// Text for programs, or the answer that was asked for.
fn print(text: &str) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{text}")?;
    Ok(())
}

/// JSON for programs.
fn print_json(value: &impl Serialize) -> anyhow::Result<()> {
    print(&serde_json::to_string_pretty(value)?)
}
