//! `gadm bench`.

use std::process::ExitCode;

use clap::Subcommand;
use clap::builder::PossibleValuesParser;
use gadm_trainer::bench::{Timing, env, quantile, replay, train};
use gadm_trainer::runner::origin::machine;
use serde_json::{Value, json};

use super::{print, print_json};

/// What to measure.
#[derive(Subcommand)]
#[command(
    after_help = "Examples:\n  gadm bench train                    every update, one thread\n  gadm bench train --case dqn --threads 2 --seconds 5 --json\n\n\
                  The same work by other programs, side by side: make bench-peers.\nNumbers mean something on a quiet machine only; the processor-time column is steadier."
)]
pub enum Command {
    /// Updates of the networks per second, rounds of the whole algorithm, and the peak of the matrix product
    Train {
        /// Only these cases
        #[arg(long = "case", value_name = "CASE", value_parser = PossibleValuesParser::new(train::CASES.map(|(name, _)| name)))]
        cases: Vec<String>,
        #[command(flatten)]
        common: Common,
    },
    /// Environment steps per second, observation and reward included
    Env {
        /// Environment (`gadm env list`)
        #[arg(long, default_value = "hopper-v5", value_name = "ID")]
        env: String,
        /// Environments stepped side by side; at least one per thread
        #[arg(long, default_value_t = 1, value_name = "N")]
        envs: usize,
        #[command(flatten)]
        common: Common,
    },
    /// Memory of a full replay buffer, and how fast it is sampled
    Replay {
        /// Buffer to fill [default: each in turn; memory that the one before gave back is then counted again]
        #[arg(long, value_parser = replay::SHAPES.map(|s| s.name), value_name = "NAME")]
        case: Option<String>,
        /// Transitions
        #[arg(long, default_value_t = 1_000_000, value_name = "N")]
        transitions: usize,
        #[command(flatten)]
        common: Common,
    },
}

/// Arguments of all kinds.
#[derive(clap::Args)]
pub struct Common {
    /// Threads
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=64), value_name = "N")]
    threads: u16,
    /// Seconds of measurement per case
    #[arg(long, default_value_t = 2.0, value_name = "S")]
    seconds: f64,
    /// Print as JSON: every chunk's rate, by wall clock and by processor time
    #[arg(long)]
    json: bool,
}

impl Common {
    fn check(&self) -> anyhow::Result<()> {
        anyhow::ensure!(
            self.seconds > 0.0 && self.seconds <= 3600.0,
            "--seconds: expected above 0 and at most 3600, found {}",
            self.seconds
        );
        Ok(())
    }
}

fn row(t: &Timing) -> Value {
    let mut value = json!(t);
    value["rate"] = json!(t.rate());
    value
}

fn line(t: &Timing) -> String {
    let products = if t.flop > 0.0 { format!("{:8.1}", t.gflops()) } else { format!("{:>8}", "-") };
    let cpu = if t.cpu_rates.is_empty() { "-".to_owned() } else { format!("{:.1}", quantile(&t.cpu_rates, 0.5)) };
    format!(
        "{:12} {:>10.1} {:>8.1} {:>8.1} {cpu:>10} {products}  {}/s, {}",
        t.case,
        t.rate(),
        quantile(&t.rates, 0.1),
        quantile(&t.rates, 0.9),
        t.unit,
        t.what
    )
}

fn head() -> String {
    format!(
        "{:12} {:>10} {:>8} {:>8} {:>10} {:>8}  {}",
        "case", "median", "10 %", "90 %", "per cpu-s", "GFLOP/s", "unit, work"
    )
}

fn timings(timings: &[Timing], common: &Common) -> anyhow::Result<()> {
    if common.json {
        let rows: Vec<_> = timings.iter().map(row).collect();
        return print_json(&json!({ "version": 1, "machine": machine(), "timings": rows }));
    }
    print(&format!("{}, {} thread(s)\n{}", machine(), common.threads, head()))?;
    timings.iter().try_for_each(|t| print(&line(t)))
}

/// Runs `bench`.
pub fn main(command: &Command) -> anyhow::Result<ExitCode> {
    match command {
        Command::Train { cases, common } => {
            common.check()?;
            let wanted = |name: &str| cases.is_empty() || cases.iter().any(|case| case == name);
            let mut all = Vec::new();
            for (_, case) in train::CASES.iter().filter(|(name, _)| wanted(name)) {
                all.push(train::run(*case, usize::from(common.threads), common.seconds)?);
            }
            timings(&all, common)?;
        }
        Command::Env { env: id, envs, common } => {
            common.check()?;
            let timing = env::step(id, *envs, usize::from(common.threads), common.seconds)?;
            timings(&[timing], common)?;
        }
        Command::Replay { case, transitions, common } => {
            common.check()?;
            let asked = replay::SHAPES.iter().filter(|s| case.as_deref().is_none_or(|case| case == s.name));
            let all: Vec<_> = asked.map(|s| replay::fill(s, *transitions, common.seconds)).collect();
            if common.json {
                print_json(&json!({ "version": 1, "machine": machine(), "replays": all }))?;
            } else {
                print(&format!("{}, {transitions} transitions", machine()))?;
                for m in &all {
                    let resident =
                        m.resident_bytes.map_or("-".to_owned(), |b| format!("{:.0} MB resident", b as f64 / 1e6));
                    print(&format!(
                        "{:12} {:7.1} MB allocated, {resident}, {:.0} transitions/s added, {:.0} batches of 512/s drawn",
                        m.name,
                        m.own_bytes as f64 / 1e6,
                        m.fill_rate,
                        m.sampling.rate()
                    ))?;
                }
            }
        }
    }
    Ok(ExitCode::SUCCESS)
}
