//! `gadm-sim run`.

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use clap::ValueEnum;
use gadm_sim::bus::Address;
use gadm_sim::report::{FILM_WIDTH, Recording};
use gadm_sim::rung::{Place, Rung, run_on};
use gadm_sim::scenario::{Criteria, Scenario, Verdict};
use gadm_sim::target::qemu::{Board, Machine};
use gadm_sim::{BitRate, Profile, Progress, RunOptions, RunResult, SimError};
use indicatif::{ProgressBar, ProgressStyle};

#[cfg(feature = "mcap")]
use super::trace::write_mcap;
use super::{CRITERIA_MISSED, report, say};

const EXAMPLES: &str = "\
Examples:
  gadm-sim run models/inverted-pendulum-v5/policy.bin --episodes 5
  gadm-sim run firmware-sim/scenarios/hopper-bad-bus.toml --bus hub
  gadm-sim run policy.bin --profile classic-i16 --trace hop.log
  gadm-sim run policy.bin --bus socketcan:vcan0 --trace hop.log
  gadm-sim run policy.bin --target qemu:mps2-an386 --trace hop.log
  gadm-sim run policy.bin --episodes 100 --min-return 950 --json > result.json

The same seed gives the same trace, byte for byte, on every bus. In fd-f32 the
returns are those of `gadm eval policy.bin` with the same --seed, bit for bit.
With --realtime the wall decides, and nothing is repeatable.

A scenario (.toml) says what to run, what goes wrong and what must hold;
options given here come before it.

Exit codes: 0 ok, 1 error, 2 usage, 3 criteria missed, 4 something is missing
here (MuJoCo, say).";

const PLANT_EXAMPLES: &str = "\
Examples:
  gadm-sim plant policy.bin --connect unix:can.sock --episodes 5
  gadm-sim plant policy.bin --connect socketcan:vcan0 --trace hop.log

The other end is `gadm-sim node policy.bin --connect BUS`, which must be there
within 10 s. This is `gadm-sim run --bus BUS --external-node`.";

/// Arguments of `run`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    #[command(flatten)]
    what: What,
    /// Run the node in a process of its own, on this bus: `hub` (made for the run), unix:PATH, tcp:HOST:PORT,
    /// serial:DEVICE, socketcan:INTERFACE [default: node and bus in this process]
    #[arg(long, value_name = "BUS", help_heading = "Bus")]
    bus: Option<BusArg>,
    /// A node is on the bus already (`gadm-sim node`, or a board): start none
    #[arg(long, requires = "bus", help_heading = "Bus")]
    external_node: bool,
    /// Run the node as firmware on a board that QEMU emulates: qemu:mps2-an386 (Cortex-M4F), qemu:mps2-an500 (Cortex-M7),
    /// qemu:netduinoplus2 (STM32F405)
    #[arg(long, value_name = "TARGET", conflicts_with = "bus", help_heading = "Bus")]
    target: Option<Machine>,
    /// Firmware of that board [default: target/firmware/BOARD.elf, from firmware-sim/firmware/build.sh]
    #[arg(long, value_name = "ELF", requires = "target", help_heading = "Bus")]
    firmware: Option<PathBuf>,
}

/// Arguments of `plant`.
#[derive(clap::Args)]
#[command(after_help = PLANT_EXAMPLES)]
pub(crate) struct PlantArgs {
    #[command(flatten)]
    what: What,
    /// The bus: unix:PATH, tcp:HOST:PORT, serial:DEVICE, socketcan:INTERFACE
    #[arg(long, value_name = "BUS", help_heading = "Bus")]
    connect: Address,
}

/// What is run, wherever.
#[derive(clap::Args)]
struct What {
    /// Policy file, or scenario file (.toml)
    #[arg(value_name = "POLICY|SCENARIO.toml")]
    file: PathBuf,
    /// Plant, by its environment id [default: what the policy was trained for]
    #[arg(long, value_name = "ENV")]
    plant: Option<String>,
    /// Number of episodes [default: 20]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    episodes: Option<u64>,
    /// Seed of the run; every episode has its own, derived from it [default: 0]
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// How values travel [default: fd-f32]
    #[arg(long, value_enum)]
    profile: Option<ProfileArg>,
    /// Write all frames to FILE, as `candump -L` does
    #[arg(long, value_name = "FILE", help_heading = "Output")]
    trace: Option<PathBuf>,
    /// Write signals and events to FILE for Foxglove, from the trace
    #[cfg(feature = "mcap")]
    #[arg(long, value_name = "FILE", requires = "trace", help_heading = "Output")]
    mcap: Option<PathBuf>,
    /// Write a report for people: one HTML file with verdict, film, plots and the command to repeat
    #[arg(long, value_name = "FILE.html", help_heading = "Output")]
    report: Option<PathBuf>,
    /// Write a film of the first episode, an animated GIF
    #[arg(long, value_name = "FILE.gif", help_heading = "Output")]
    film: Option<PathBuf>,
    /// Width of the film, here and in the report, pixels
    #[arg(long, value_name = "N", default_value_t = FILM_WIDTH, value_parser = clap::value_parser!(u32).range(40..=2048),
          help_heading = "Output")]
    film_width: u32,
    /// Print the whole result as JSON on standard output
    #[arg(long, help_heading = "Output")]
    json: bool,
    /// No progress and no table
    #[arg(long, short, help_heading = "Output")]
    quiet: bool,
    /// Exit with 3 where the mean return is below X
    #[arg(long, value_name = "X", allow_negative_numbers = true, help_heading = "Criteria")]
    min_return: Option<f64>,
    /// Run although the policy does not fit the bus (see `gadm-sim bus load`)
    #[arg(long, help_heading = "Bus")]
    allow_overload: bool,
    /// Bit rate of classic frames and of the arbitration of FD frames, bit/s [default: 500000]
    #[arg(long, value_name = "BPS", value_parser = clap::value_parser!(u32).range(10_000..=1_000_000),
          help_heading = "Bus")]
    bitrate: Option<u32>,
    /// Bit rate of the data of FD frames, bit/s [default: 2000000]
    #[arg(long, value_name = "BPS", value_parser = clap::value_parser!(u32).range(10_000..=8_000_000),
          help_heading = "Bus")]
    data_bitrate: Option<u32>,
    /// Go by the wall's time, FACTOR times as fast, and measure latency and jitter; lockstep without this
    #[arg(long, value_name = "FACTOR", num_args = 0..=1, default_missing_value = "1", value_parser = factor,
          help_heading = "Bus")]
    realtime: Option<f64>,
}

/// Where the bus is.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum BusArg {
    /// Made for the run.
    Hub,
    /// There already.
    At(Address),
}

impl std::str::FromStr for BusArg {
    type Err = gadm_sim::bus::address::AddressError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if text == "hub" { Ok(Self::Hub) } else { text.parse().map(Self::At) }
    }
}

/// A factor of time.
pub(crate) fn factor(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(factor) if (0.001..=1000.0).contains(&factor) => Ok(factor),
        _ => Err("expected a number from 0.001 to 1000, such as 1 or 0.5".to_owned()),
    }
}

#[derive(Clone, Copy, ValueEnum)]
pub(crate) enum ProfileArg {
    /// CAN FD, exact single precision
    FdF32,
    /// Classic CAN, 16-bit integers scaled by the signal's range
    ClassicI16,
}

impl From<ProfileArg> for Profile {
    fn from(arg: ProfileArg) -> Self {
        match arg {
            ProfileArg::FdF32 => Self::FdF32,
            ProfileArg::ClassicI16 => Self::ClassicI16,
        }
    }
}

/// Runs `run`.
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let program = std::env::current_exe;
    let board = args.target.map(|machine| {
        let board = Board::new(machine);
        Board { firmware: args.firmware.clone().unwrap_or(board.firmware), ..board }
    });
    let place = match &args.bus {
        None => board.map_or(Place::InProcess, Place::Board),
        Some(BusArg::Hub) => Place::Hub { program: program()? },
        Some(BusArg::At(address)) => {
            let program = if args.external_node { None } else { Some(program()?) };
            Place::Bus { address: address.clone(), program }
        }
    };
    drive(&args.what, place)
}

/// Runs `plant`.
pub(crate) fn plant(args: &PlantArgs) -> anyhow::Result<ExitCode> {
    drive(&args.what, Place::Bus { address: args.connect.clone(), program: None })
}

/// What a scenario says, or the defaults, with what the command line says before it.
fn plan(args: &What) -> Result<(RunOptions, Option<Scenario>), SimError> {
    let is_scenario = args.file.extension().is_some_and(|e| e.eq_ignore_ascii_case("toml"));
    let scenario = if is_scenario { Some(Scenario::load(&args.file)?) } else { None };
    let base = scenario.as_ref().map_or_else(|| RunOptions::new(&args.file), Scenario::run_options);
    let options = RunOptions {
        plant: args.plant.clone().or(base.plant),
        episodes: args.episodes.unwrap_or(base.episodes),
        seed: args.seed.unwrap_or(base.seed),
        profile: args.profile.map_or(base.profile, Profile::from),
        bit_rate: BitRate {
            nominal: args.bitrate.unwrap_or(base.bit_rate.nominal),
            data: args.data_bitrate.unwrap_or(base.bit_rate.data),
        },
        allow_overload: args.allow_overload,
        trace: args.trace.clone(),
        record: (args.report.is_some() || args.film.is_some()).then(|| Recording::new(args.film_width)),
        ..base
    };
    Ok((options, scenario))
}

/// What was asked for and what was found; `None` where nothing was.
fn judge(
    args: &What,
    options: &RunOptions,
    scenario: Option<Scenario>,
    result: &RunResult,
) -> Result<Option<Verdict>, SimError> {
    let Some(mut scenario) = scenario else {
        let asked = args.min_return.map(|limit| Criteria { min_return: Some(limit), ..Criteria::default() });
        return Ok(asked.map(|criteria| criteria.judge(result, None)));
    };
    scenario.criteria.min_return = args.min_return.or(scenario.criteria.min_return);
    // In lockstep the run without faults is the same on every bus.
    let nominal = if scenario.needs_nominal() {
        let clean = RunOptions { faults: Vec::new(), trace: None, record: None, ..options.clone() };
        Some(gadm_sim::run(&clean)?)
    } else {
        None
    };
    Ok(Some(scenario.judge(result, nominal.as_ref())))
}

fn drive(args: &What, place: Place) -> anyhow::Result<ExitCode> {
    let (options, scenario) = plan(args)?;
    let rung = Rung { place, realtime: args.realtime };
    let mut display = Display::new(options.episodes, args.quiet);
    let result = run_on(&options, &rung, &mut |p| display.show(p));
    display.clear();
    let result = result?;
    let verdict = judge(args, &options, scenario, &result)?;
    #[cfg(feature = "mcap")]
    if let (Some(path), Some(trace)) = (&args.mcap, &args.trace) {
        write_mcap(&options.policy, trace, path)?;
    }
    if let Some(episode) = options.record.as_ref().map(Recording::finish) {
        if let Some(path) = &args.report {
            report::write(path, &options, &episode, &result, verdict.as_ref())?;
        }
        if let Some(path) = &args.film {
            let film = episode.film.as_ref().with_context(|| format!("{} does not draw itself", result.plant))?;
            std::fs::write(path, &film.gif).map_err(|source| SimError::Write { path: path.clone(), source })?;
        }
    }
    if !args.quiet {
        say(result.table().trim_end());
        if let Some(path) = &args.trace {
            say(&format!("  {:<18} {} frames in {}", "trace", result.bus.frames, path.display()));
        }
        #[cfg(feature = "mcap")]
        if let Some(path) = &args.mcap {
            say(&format!("  {:<18} {}", "mcap", path.display()));
        }
        for (name, path) in [("report", &args.report), ("film", &args.film)] {
            if let Some(path) = path {
                say(&format!("  {name:<18} {}", path.display()));
            }
        }
        if let Some(verdict) = verdict.as_ref().filter(|v| v.passed && !v.criteria.is_empty()) {
            say(&format!("  {:<18} all {} hold", "criteria", verdict.criteria.len()));
        }
    }
    if args.json {
        let mut value = serde_json::to_value(&result)?;
        if let (Some(fields), Some(verdict)) = (value.as_object_mut(), &verdict) {
            fields.insert("verdict".to_owned(), serde_json::to_value(verdict)?);
        }
        let mut out = std::io::stdout().lock();
        serde_json::to_writer_pretty(&mut out, &value).map_err(std::io::Error::from)?;
        writeln!(out)?;
    }
    let Some(verdict) = verdict.filter(|v| !v.passed) else { return Ok(ExitCode::SUCCESS) };
    for line in verdict.missed() {
        say(&format!("missed: {line}"));
    }
    Ok(ExitCode::from(CRITERIA_MISSED))
}

/// Progress: a bar on a terminal, else a line every ten seconds.
enum Display {
    Quiet,
    Bar(ProgressBar),
    Lines { started: Instant, last: Instant, episodes: u64 },
}

impl Display {
    #[expect(clippy::disallowed_methods, reason = "the display shows a rate; no result depends on it")]
    fn new(episodes: u64, quiet: bool) -> Self {
        if quiet {
            return Self::Quiet;
        }
        if std::io::stderr().is_terminal() {
            let bar = ProgressBar::new(episodes);
            if let Ok(style) =
                ProgressStyle::with_template("{bar:24} episode {pos}/{len}  {msg}  {elapsed} elapsed, {eta} left")
            {
                bar.set_style(style);
            }
            return Self::Bar(bar);
        }
        let now = Instant::now();
        Self::Lines { started: now, last: now, episodes }
    }

    #[expect(clippy::disallowed_methods, reason = "the display shows a rate; no result depends on it")]
    fn show(&mut self, p: Progress) {
        match self {
            Self::Quiet => {}
            Self::Bar(bar) => {
                bar.set_position(p.episodes);
                let rate = p.steps as f64 / bar.elapsed().as_secs_f64().max(1e-3);
                bar.set_message(format!("{rate:.0} steps/s  mean return {:.1}", p.mean_return));
            }
            Self::Lines { started, last, episodes } => {
                if last.elapsed() < Duration::from_secs(10) {
                    return;
                }
                *last = Instant::now();
                let seconds = started.elapsed().as_secs_f64();
                let rate = p.steps as f64 / seconds;
                let left = match p.episodes {
                    0 => "?".to_owned(),
                    done => format!("{:.0} s", seconds / done as f64 * (*episodes - done) as f64),
                };
                say(&format!(
                    "episode {}/{episodes}  {rate:.0} steps/s  mean return {:.1}  {left} left",
                    p.episodes, p.mean_return
                ));
            }
        }
    }

    fn clear(&self) {
        if let Self::Bar(bar) = self {
            bar.finish_and_clear();
        }
    }
}
