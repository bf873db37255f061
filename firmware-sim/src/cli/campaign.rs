//! `gadm-sim campaign`.

use std::io::{IsTerminal, Write};
use std::num::NonZero;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use gadm_sim::campaign::{Campaign, FILES, Options, Progress, campaign};
use gadm_sim::scenario::Scenario;
use indicatif::{ProgressBar, ProgressStyle};

use super::{CRITERIA_MISSED, say};

const EXAMPLES: &str = "\
Examples:
  gadm-sim campaign firmware-sim/scenarios/hopper-faults.toml
  gadm-sim campaign faults.toml --jobs 8 --seeds 20 -o out/faults --quiet

The folder then holds results.csv, results.json, junit.xml, heatmap.svg and
report.html. Stopped, the same command goes on where it was (runs.jsonl). A run
in which no fault was injected fails.

Exit codes: 0 ok, 1 error or a run that did not end, 2 usage, 3 criteria
missed, 4 something is missing here (MuJoCo, say), 130 interrupted.";

/// Arguments of `campaign`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Scenario file; every fault in it is run on its own
    scenario: PathBuf,
    /// Runs at a time [default: the cores of this machine]
    #[arg(long, short, value_name = "N")]
    jobs: Option<NonZero<usize>>,
    /// Seeds per fault and intensity [default: what the scenario says]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    seeds: Option<u64>,
    /// Folder for the results [default: campaign-NAME, by the name of the scenario]
    #[arg(long, short, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Print the results as JSON on standard output
    #[arg(long, help_heading = "Output")]
    json: bool,
    /// No progress and no table
    #[arg(long, short, help_heading = "Output")]
    quiet: bool,
}

/// Runs the command.
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let scenario = Scenario::load(&args.scenario)?;
    let out = args.out.clone().unwrap_or_else(|| PathBuf::from(format!("campaign-{}", scenario.name)));
    let jobs = args.jobs.or_else(|| std::thread::available_parallelism().ok()).map_or(1, NonZero::get);
    let seeds = args.seeds.unwrap_or(scenario.seeds);
    let command = format!("gadm-sim campaign {} --seeds {seeds} -o {}", args.scenario.display(), out.display());
    let options = Options { jobs, seeds: Some(seeds), out, command };
    let mut display = Display::new(args.quiet);
    let found = campaign(&scenario, &options, &mut |p| display.show(p));
    display.clear();
    let found = found?;
    if args.json {
        let mut out = std::io::stdout().lock();
        out.write_all(&std::fs::read(options.out.join(FILES[1]))?)?;
    }
    if !args.quiet {
        say(table(&found).trim_end());
        say(&format!("  results in {}: {}", options.out.display(), FILES.join(", ")));
    }
    for record in found.records.iter().filter(|r| !r.passed) {
        let what = record.error.clone().unwrap_or_else(|| record.missed.join("; "));
        say(&format!("missed: {}: {what}", record.name()));
    }
    Ok(match (found.sound(), found.passed()) {
        (false, _) => ExitCode::FAILURE,
        (_, false) => ExitCode::from(CRITERIA_MISSED),
        _ => ExitCode::SUCCESS,
    })
}

fn table(found: &Campaign) -> String {
    use std::fmt::Write as _;
    let mut text = String::new();
    let count = |v: Option<u64>| v.map_or_else(|| "–".to_owned(), |v| v.to_string());
    // Writing to a String cannot fail.
    let _ = writeln!(
        text,
        "  {:<28} {:>9} {:>7} {:>9} {:>7} {:>6} {:>7} {:>10} {:>8}",
        "fault", "intensity", "met", "injected", "detect", "safe", "error", "return", "nominal"
    );
    for t in &found.tallies {
        let _ = writeln!(
            text,
            "  {:<28} {:>9} {:>7} {:>9} {:>7} {:>6} {:>6.1}% {:>10.1} {:>8}",
            t.fault,
            t.intensity,
            format!("{}/{}", t.passed, t.runs),
            t.injected,
            count(t.time_to_detect),
            count(t.time_to_safe),
            t.worst_action_error * 100.0,
            t.mean_return,
            t.return_ratio.map_or_else(|| "–".to_owned(), |r| format!("{:.1} %", r * 100.0)),
        );
    }
    text
}

/// Progress: a bar on a terminal, else a line every ten seconds.
enum Display {
    Quiet,
    Bar(Option<ProgressBar>),
    Lines { started: Instant, last: Instant },
}

impl Display {
    #[expect(clippy::disallowed_methods, reason = "the display shows a rate; no result depends on it")]
    fn new(quiet: bool) -> Self {
        if quiet {
            return Self::Quiet;
        }
        if std::io::stderr().is_terminal() {
            return Self::Bar(None);
        }
        let now = Instant::now();
        Self::Lines { started: now, last: now }
    }

    #[expect(clippy::disallowed_methods, reason = "the display shows a rate; no result depends on it")]
    fn show(&mut self, p: &Progress) {
        match self {
            Self::Quiet => {}
            Self::Bar(bar) => {
                let bar = bar.get_or_insert_with(|| {
                    let template = "{bar:24} run {pos}/{len}  {per_sec}  {msg}  {elapsed} elapsed, {eta} left";
                    let bar = ProgressBar::new(p.total as u64).with_position(p.resumed as u64);
                    bar.reset_eta();
                    match ProgressStyle::with_template(template) {
                        Ok(style) => bar.with_style(style),
                        Err(_) => bar,
                    }
                });
                bar.set_position(p.done as u64);
                bar.set_message(format!("{} missed  {}", p.missed, p.last));
            }
            Self::Lines { started, last } => {
                if last.elapsed() < Duration::from_secs(10) {
                    return;
                }
                *last = Instant::now();
                let (seconds, done) = (started.elapsed().as_secs_f64(), (p.done - p.resumed) as f64);
                let left = match p.done - p.resumed {
                    0 => "?".to_owned(),
                    _ => format!("{:.0} s", seconds / done * (p.total - p.done) as f64),
                };
                let rate = done / seconds;
                say(&format!("run {}/{}  {rate:.2}/s  {} missed  {left} left", p.done, p.total, p.missed));
            }
        }
    }

    fn clear(&self) {
        if let Self::Bar(Some(bar)) = self {
            bar.finish_and_clear();
        }
    }
}
