//! `gadm-sim bus load`.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use gadm_runtime::Policy;
use gadm_sim::bus::load::{BitRate, Row, Survey};
use gadm_sim::sil::read_image;
use gadm_sim::{Profile, SimError};

use super::run::ProfileArg;
use super::{CRITERIA_MISSED, say};

const EXAMPLES: &str = "\
Examples:
  gadm-sim bus load models/hopper-v5/policy.bin --bitrate 500000
  gadm-sim bus load policy.bin --profile classic-i16 --bitrate 250000 --json

Worst case: every possible stuff bit, TICK and heartbeats included. A profile
fits when the load is at most 70 %, and the observation set and the action set
each cross the bus within half a control period, behind one less urgent frame,
a MODE and an ESTOP.

Exit codes: 0 a profile fits, 1 error, 2 usage, 3 none fits.";

/// Arguments of `bus load`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Policy file
    policy: PathBuf,
    /// Look at one profile only [default: both]
    #[arg(long, value_enum)]
    profile: Option<ProfileArg>,
    /// Bit rate of classic frames and of the arbitration of FD frames, bit/s
    #[arg(long, default_value_t = BitRate::default().nominal, value_name = "BPS",
          value_parser = clap::value_parser!(u32).range(10_000..=1_000_000))]
    bitrate: u32,
    /// Bit rate of the data of FD frames, bit/s
    #[arg(long, default_value_t = BitRate::default().data, value_name = "BPS",
          value_parser = clap::value_parser!(u32).range(10_000..=8_000_000))]
    data_bitrate: u32,
    /// Print the answer as JSON on standard output
    #[arg(long, help_heading = "Output")]
    json: bool,
}

/// Runs the command.
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let image = read_image(&args.policy)?;
    let policy = Policy::load(&image).map_err(SimError::Policy)?;
    let rate = BitRate { nominal: args.bitrate, data: args.data_bitrate };
    let profiles = args.profile.map_or_else(|| Profile::ALL.to_vec(), |p| vec![p.into()]);
    let survey = Survey::new(&policy, &profiles, rate);
    let name = if survey.environment.is_empty() { "policy" } else { &survey.environment };
    say(&format!(
        "{name}: {} observations, {} actions every {} us",
        survey.observations, survey.actions, survey.control_period_us
    ));
    say(&format!(
        "{:<12} {:>10} {:>11} {:>7} {:>7} {:>7} {:>7}",
        "profile", "kbit/s", "frames", "sets %", "load %", "OBS us", "ACT us"
    ));
    for row in &survey.profiles {
        line(row);
    }
    if args.json {
        let mut out = std::io::stdout().lock();
        serde_json::to_writer_pretty(&mut out, &survey).map_err(std::io::Error::from)?;
        writeln!(out)?;
    }
    if survey.fits() {
        return Ok(ExitCode::SUCCESS);
    }
    say(&format!("does not fit; {}", survey.advice()));
    Ok(ExitCode::from(CRITERIA_MISSED))
}

fn line(row: &Row) {
    let verdict = row.reason.as_deref().map_or_else(|| "fits".to_owned(), |r| format!("does not fit: {r}"));
    let Some(load) = &row.load else {
        say(&format!("{:<12} {:>10} {verdict}", row.profile, row.rate()));
        return;
    };
    say(&format!(
        "{:<12} {:>10} {:>7} + {} {:>7.1} {:>7.1} {:>7.0} {:>7.0}  {verdict}",
        row.profile,
        row.rate(),
        load.observation_frames,
        load.action_frames,
        load.sets_percent,
        load.total_percent,
        load.observation_us,
        load.action_us
    ));
}
