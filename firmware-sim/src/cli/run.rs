//! `gadm-sim run`.

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::ValueEnum;
use gadm_sim::{BitRate, Profile, Progress, RunOptions, run_with_progress};
use indicatif::{ProgressBar, ProgressStyle};

use super::{CRITERIA_MISSED, say};

const EXAMPLES: &str = "\
Examples:
  gadm-sim run models/inverted-pendulum-v5/policy.bin --episodes 5
  gadm-sim run policy.bin --profile classic-i16 --trace hop.log
  gadm-sim run policy.bin --episodes 100 --min-return 950 --json > result.json

The same seed gives the same trace, byte for byte. In fd-f32 the returns are
those of `gadm eval policy.bin` with the same --seed, bit for bit.

Exit codes: 0 ok, 1 error, 2 usage, 3 --min-return missed, 4 something is
missing here (MuJoCo, say).";

/// Arguments of `run`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Policy file
    policy: PathBuf,
    /// Plant, by its environment id [default: what the policy was trained for]
    #[arg(long, value_name = "ENV")]
    plant: Option<String>,
    /// Number of episodes
    #[arg(long, default_value_t = 20, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    episodes: u64,
    /// Seed of the run; every episode has its own, derived from it
    #[arg(long, default_value_t = 0, value_name = "N")]
    seed: u64,
    /// How values travel
    #[arg(long, value_enum, default_value = "fd-f32")]
    profile: ProfileArg,
    /// Write all frames to FILE, as `candump -L` does
    #[arg(long, value_name = "FILE", help_heading = "Output")]
    trace: Option<PathBuf>,
    /// Print the whole result as JSON on standard output
    #[arg(long, help_heading = "Output")]
    json: bool,
    /// No progress and no table
    #[arg(long, short, help_heading = "Output")]
    quiet: bool,
    /// Exit with 3 where the mean return is below X
    #[arg(long, value_name = "X", allow_negative_numbers = true, help_heading = "Criteria")]
    min_return: Option<f64>,
    /// Bit rate of classic frames and of the arbitration of FD frames, bit/s
    #[arg(long, default_value_t = BitRate::default().nominal, value_name = "BPS",
          value_parser = clap::value_parser!(u32).range(10_000..=1_000_000), help_heading = "Bus")]
    bitrate: u32,
    /// Bit rate of the data of FD frames, bit/s
    #[arg(long, default_value_t = BitRate::default().data, value_name = "BPS",
          value_parser = clap::value_parser!(u32).range(10_000..=8_000_000), help_heading = "Bus")]
    data_bitrate: u32,
}

#[derive(Clone, Copy, ValueEnum)]
enum ProfileArg {
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

/// Runs the command.
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let options = RunOptions {
        policy: args.policy.clone(),
        plant: args.plant.clone(),
        episodes: args.episodes,
        seed: args.seed,
        profile: args.profile.into(),
        bit_rate: BitRate { nominal: args.bitrate, data: args.data_bitrate },
        trace: args.trace.clone(),
    };
    let mut display = Display::new(args.episodes, args.quiet);
    let result = run_with_progress(&options, &mut |p| display.show(p));
    display.clear();
    let result = result?;
    if !args.quiet {
        say(result.table().trim_end());
        if let Some(path) = &args.trace {
            say(&format!("  {:<18} {} frames in {}", "trace", result.bus.frames, path.display()));
        }
    }
    if args.json {
        let mut out = std::io::stdout().lock();
        serde_json::to_writer_pretty(&mut out, &result).map_err(std::io::Error::from)?;
        writeln!(out)?;
    }
    if let Some(limit) = args.min_return.filter(|limit| result.returns.mean < *limit) {
        say(&format!("missed: mean return {} is below the required {limit}", result.returns.mean));
        return Ok(ExitCode::from(CRITERIA_MISSED));
    }
    Ok(ExitCode::SUCCESS)
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
