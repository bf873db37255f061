//! `gadm paper`.

use std::path::PathBuf;
use std::process::{Command as Process, ExitCode};
use std::thread::available_parallelism;

use clap::Subcommand;
use clap::builder::{PossibleValue, PossibleValuesParser};
use gadm_trainer::nn::parallel;
use gadm_trainer::paper::figure::{FIGURES, Figure, figure};
use gadm_trainer::paper::one::{Ended, run_one};
use gadm_trainer::paper::plan::{Options, Plan, PlannedRun};
use gadm_trainer::paper::pool::{PoolOptions, run_all};
use gadm_trainer::paper::state::{Cost, State, Status, cost, survey};
use gadm_trainer::paper::submit::{Scheduler, array};
use gadm_trainer::paper::{PaperError, draw};
use gadm_trainer::runner::progress::{Style, duration};
use serde_json::json;

use super::{ENVIRONMENT_LACKING, print, print_json, say, stop_on_interrupt};

const EXAMPLES: &str = "\
Examples:
  gadm paper demo                          try it: small networks on Pendulum
  gadm paper fig4 --seeds 5 --jobs 2       what is missing of figure 4, then the figure
  gadm paper fig9 --only hopper            its runs on Hopper alone
  gadm paper fig12                         latents of ToyEnv; fig13: in another state
  gadm paper fig4 --draw                   figure and table of what is there
  gadm paper fig4 --submit hq              the same runs as a job array of HyperQueue
  gadm paper status                        what is done, and what the rest would cost

Runs lie in DIR/runs/ENV/VARIANT-seedN and are shared by figures; FIG.svg, FIG.md,
FIG.json and tables as CSV in DIR; what the runs say in DIR/logs. Ctrl-C writes
checkpoints and stops; the same command continues. A run that fails does not stop the
others: exit code 1 at the end then. fig14 and fig15 also fly 20 episodes of every
snapshot, once.";

const STATUS_EXAMPLES: &str = "\
Examples:
  gadm paper status
  gadm paper status fig4 --runs --seeds 5 --json";

const RUN_EXAMPLES: &str = "\
Examples:
  gadm paper run fig4 0
  gadm paper run fig4 7 --seeds 10 --steps 3000000 --out /shared/paper

With the options of the list that the index is from. Where another process is at the run, this
one waits for it; where the run is done, it ends at once.";

/// Arguments of `paper`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES, args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
#[expect(clippy::struct_excessive_bools, reason = "flags of a command line")]
pub struct Args {
    #[command(subcommand)]
    command: Option<Command>,
    /// Which figure
    #[arg(required = true, value_name = "FIG", value_parser = figures())]
    figure: Option<String>,
    #[command(flatten)]
    list: List,
    /// Runs at once, each in a process of its own [default: the number of cores / --threads]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    jobs: Option<u16>,
    /// Threads of a run; results are the same
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=2))]
    threads: u8,
    /// Draw what is there and run nothing
    #[arg(long, conflicts_with_all = ["dry_run", "submit"])]
    draw: bool,
    /// Figure and table of runs that are not done, too, as far as they are
    #[arg(long)]
    partial: bool,
    /// Say what would be done, and do nothing
    #[arg(long)]
    dry_run: bool,
    /// Give the runs to a scheduler as a job array instead of running them here
    #[arg(long, value_name = "SCHEDULER", value_parser = ["hq", "slurm"])]
    submit: Option<String>,
    /// Print the result as JSON on standard output
    #[arg(long)]
    json: bool,
}

#[derive(Subcommand)]
enum Command {
    /// Say what is done of every figure, and what the rest would cost
    #[command(after_help = STATUS_EXAMPLES)]
    Status {
        /// Only these figures [default: all]
        #[arg(value_name = "FIG", value_parser = figures())]
        figures: Vec<String>,
        #[command(flatten)]
        list: List,
        /// Every run, not only sums
        #[arg(long)]
        runs: bool,
        /// Print as JSON on standard output
        #[arg(long)]
        json: bool,
    },
    /// Do one run of a figure's list, as a task of a job array does
    #[command(after_help = RUN_EXAMPLES)]
    Run {
        /// Which figure
        #[arg(value_name = "FIG", value_parser = figures())]
        figure: String,
        /// Which run, from 0 (`gadm paper FIG --dry-run` lists them)
        index: usize,
        #[command(flatten)]
        list: List,
        /// Threads of the run; results are the same
        #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=2))]
        threads: u8,
    },
}

/// What a list of runs depends on.
#[derive(clap::Args)]
struct List {
    /// Seeds 0 to N - 1 [default: the figure's, see `gadm paper status`]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: Option<u64>,
    /// Environment steps of every run [default: the figure's]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    steps: Option<u64>,
    /// Folder of runs and results
    #[arg(long, default_value = "runs/paper", value_name = "DIR")]
    out: PathBuf,
    /// Only runs with TEXT in their name, such as hopper or td3-seed0
    #[arg(long, value_name = "TEXT")]
    only: Option<String>,
}

fn figures() -> PossibleValuesParser {
    PossibleValuesParser::new(FIGURES.iter().map(|figure| PossibleValue::new(figure.id).help(figure.about)))
}

fn known(id: &str) -> &'static Figure {
    figure(id).expect("the parser takes no other names")
}

impl List {
    fn plan(&self, figure: &'static Figure) -> Result<Plan, PaperError> {
        let Self { seeds, steps, out, only } = self;
        Plan::new(figure, &Options { seeds: *seeds, steps: *steps, out: out.clone(), only: only.clone() })
    }

    /// The command of a run of `figure` but for its index.
    fn command_of_a_run(&self, figure: &Figure, threads: u8) -> anyhow::Result<Vec<String>> {
        let program = std::env::current_exe()?.display().to_string();
        let out = std::path::absolute(&self.out)?.display().to_string();
        let mut words = [&program, "paper", "run", figure.id, "--out", &out].map(str::to_owned).to_vec();
        let threads = (threads > 1).then(|| threads.to_string());
        for (name, value) in [
            ("--seeds", self.seeds.map(|n| n.to_string())),
            ("--steps", self.steps.map(|n| n.to_string())),
            ("--only", self.only.clone()),
            ("--threads", threads),
        ] {
            if let Some(value) = value {
                // One word, so that a value that begins with a dash is none of the options.
                words.push(format!("{name}={value}"));
            }
        }
        Ok(words)
    }
}

/// Runs `paper`.
pub fn main(args: &Args, quiet: bool) -> anyhow::Result<ExitCode> {
    let done = match &args.command {
        Some(Command::Status { figures, list, runs, json }) => status(figures, list, *runs, *json),
        Some(Command::Run { figure, index, list, threads }) => run(known(figure), *index, list, *threads, quiet),
        None => make(known(args.figure.as_deref().unwrap_or_default()), args, quiet),
    };
    match done {
        Err(error) if matches!(error.downcast_ref(), Some(PaperError::Environment { .. })) => {
            say(&format!("error: {error}"));
            Ok(ExitCode::from(ENVIRONMENT_LACKING))
        }
        other => other,
    }
}

fn run(figure: &'static Figure, index: usize, list: &List, threads: u8, quiet: bool) -> anyhow::Result<ExitCode> {
    let plan = list.plan(figure)?;
    let run = plan.run(index)?;
    say(&format!("run {index} of {}: {} to {} steps in {}", figure.id, run.name, run.steps, run.dir.display()));
    let stop = stop_on_interrupt()?;
    parallel::start(usize::from(threads));
    Ok(match run_one(&plan, index, Style::detect(quiet), stop)? {
        Ended::Complete => ExitCode::SUCCESS,
        Ended::Interrupted => {
            say("stopped; the same command continues");
            ExitCode::from(130)
        }
    })
}

fn make(figure: &'static Figure, args: &Args, quiet: bool) -> anyhow::Result<ExitCode> {
    let plan = args.list.plan(figure)?;
    let cores = available_parallelism().map_or(1, usize::from);
    let jobs = args.jobs.map_or((cores / usize::from(args.threads)).max(1), usize::from);
    if args.draw {
        return drawn(&plan, args, &[]);
    }
    if args.dry_run && args.submit.is_none() {
        return dry_run(&plan, args.json, jobs);
    }
    plan.check_environments()?;
    let words = args.list.command_of_a_run(figure, args.threads)?;
    if let Some(name) = &args.submit {
        return submit(args, figure, name, &words);
    }
    let stop = stop_on_interrupt()?;
    let statuses = survey(&plan);
    let pairs: Vec<_> = plan.runs.iter().zip(&statuses).collect();
    say(&format!("{}: {}", figure.id, sums(&cost(pairs.iter().copied(), &pairs), jobs)));
    let command = |index: usize| {
        let mut command = Process::new(&words[0]);
        command.args(&words[1..]).arg(index.to_string());
        command
    };
    let outcome = run_all(&plan, &PoolOptions { jobs, style: Style::detect(quiet), stop, command: &command })?;
    if outcome.interrupted {
        say(&format!("{}: stopped; the same command continues", figure.id));
        return Ok(ExitCode::from(130));
    }
    drawn(&plan, args, &outcome.failed)
}

/// Figure and table; the exit code says whether a run failed.
fn drawn(plan: &Plan, args: &Args, failed: &[(String, String)]) -> anyhow::Result<ExitCode> {
    let written = draw::write(plan, args.partial)?;
    for (name, detail) in failed {
        say(&format!("failed: {name}: {detail}"));
    }
    if args.json {
        let files: Vec<String> = written.files.iter().map(|file| file.display().to_string()).collect();
        let failed: Vec<_> = failed.iter().map(|(run, detail)| json!({"run": run, "detail": detail})).collect();
        print_json(&json!({"version": 1, "results": written.results, "files": files, "failed": failed}))?;
    } else {
        print(written.results.to_markdown().trim_end())?;
    }
    for file in &written.files {
        say(&format!("wrote {}", file.display()));
    }
    Ok(if failed.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn submit(args: &Args, figure: &'static Figure, scheduler: &str, words: &[String]) -> anyhow::Result<ExitCode> {
    let scheduler = if scheduler == "hq" { Scheduler::Hq } else { Scheduler::Slurm };
    // The scheduler may start its tasks in another folder.
    let out = std::path::absolute(&args.list.out)?;
    let List { seeds, steps, only, .. } = &args.list;
    let plan = Plan::new(figure, &Options { seeds: *seeds, steps: *steps, out, only: only.clone() })?;
    let array = array(&plan, scheduler, words, usize::from(args.threads))?;
    let mut said = None;
    if !args.dry_run {
        array.write(&plan, words)?;
        said = Some(array.submit()?);
    }
    if args.json {
        print_json(&json!({
            "version": 1,
            "figure": figure.id,
            "submitted": !args.dry_run,
            "indices": array.indices,
            "script": array.script,
            "list": array.list,
            "command": array.command,
            "answer": said,
        }))?;
    } else if let Some(said) = said {
        say(&said);
        say(&format!(
            "{} runs, listed in {}; `gadm paper status` follows them",
            array.indices.len(),
            array.list.display()
        ));
    } else {
        print(&format!("# {}\n{}\n# {}", array.script.display(), array.text, array.command_line()))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn word(status: &Status) -> &'static str {
    match status.state {
        State::Done => "done",
        _ if status.running => "running",
        State::Partial => "partial",
        State::Missing => "missing",
        State::Other(_) => "OTHER CONFIGURATION",
    }
}

/// One line about what is there and what the rest costs.
fn sums(cost: &Cost, jobs: usize) -> String {
    let total = cost.done + cost.partial + cost.missing + cost.other;
    let mut text = format!("{} of {total} runs done, {} partial, {} missing", cost.done, cost.partial, cost.missing);
    if cost.other > 0 {
        text.push_str(&[", ", &cost.other.to_string(), " with another configuration"].concat());
    }
    if cost.steps_left > 0 {
        let assumed = match cost.assumed_s / cost.core_s {
            x if x >= 0.999 => "at an assumed speed".to_owned(),
            x if x > 0.0 => format!("{:.0} % of it at an assumed speed", 100.0 * x),
            _ => "at the measured speed".to_owned(),
        };
        let left = format!(
            "; {} steps left, {} of one core, {assumed}, {} with {jobs} at once",
            cost.steps_left,
            duration(cost.core_s),
            duration(cost.core_s / jobs as f64)
        );
        text.push_str(&left);
    }
    text
}

fn run_line(index: usize, run: &PlannedRun, status: &Status) -> String {
    let shown = if run.shown { "" } else { ", for its actions only" };
    let detail = if let State::Other(detail) = &status.state { format!(" ({detail})") } else { String::new() };
    format!("{index:>4} {:10} {:>9} of {:>9}  {}{shown}{detail}", word(status), status.env_steps, run.steps, run.name)
}

fn run_json(index: usize, run: &PlannedRun, status: &Status) -> serde_json::Value {
    json!({
        "index": index,
        "run": run.name,
        "folder": run.dir,
        "seed": run.seed,
        "steps": run.steps,
        "shown": run.shown,
        "status": status,
    })
}

fn dry_run(plan: &Plan, as_json: bool, jobs: usize) -> anyhow::Result<ExitCode> {
    let statuses = survey(plan);
    let pairs: Vec<_> = plan.runs.iter().zip(&statuses).collect();
    let cost = cost(pairs.iter().copied(), &pairs);
    let environment = plan.check_environments().err().map(|e| e.to_string());
    if as_json {
        let runs: Vec<_> = pairs.iter().enumerate().map(|(i, (run, status))| run_json(i, run, status)).collect();
        print_json(
            &json!({"version": 1, "figure": plan.figure.id, "environment": environment, "cost": cost, "runs": runs}),
        )?;
    } else {
        for (i, (run, status)) in pairs.iter().enumerate() {
            print(&run_line(i, run, status))?;
        }
        print(&sums(&cost, jobs))?;
    }
    if let Some(text) = &environment {
        say(text);
    }
    Ok(if environment.is_some() { ExitCode::from(ENVIRONMENT_LACKING) } else { ExitCode::SUCCESS })
}

fn status(names: &[String], list: &List, each: bool, as_json: bool) -> anyhow::Result<ExitCode> {
    let chosen = FIGURES.iter().filter(|figure| names.is_empty() || names.iter().any(|name| name == figure.id));
    let mut plans = Vec::new();
    for figure in chosen {
        match list.plan(figure) {
            Ok(plan) => plans.push((survey(&plan), plan)),
            // Text that picks runs of one figure need not be in the names of another; nor need steps be enough for all.
            Err(PaperError::NothingPicked { .. } | PaperError::TooShort { .. }) if names.is_empty() => {}
            Err(error) => return Err(error.into()),
        }
    }
    // Speeds are taken from all runs; runs that figures share count once in the sum over them.
    let all: Vec<_> = plans.iter().flat_map(|(statuses, plan)| plan.runs.iter().zip(statuses)).collect();
    let mut once: Vec<(&PlannedRun, &Status)> = Vec::new();
    for (run, status) in &all {
        match once.iter_mut().find(|(other, _)| other.dir == run.dir) {
            Some(same) if same.0.steps < run.steps => *same = (run, status),
            Some(_) => {}
            None => once.push((run, status)),
        }
    }
    let cores = available_parallelism().map_or(1, usize::from);
    let total = cost(once.iter().copied(), &all);
    let mut rows = Vec::new();
    for (statuses, plan) in &plans {
        let figure = plan.figure;
        let own = cost(plan.runs.iter().zip(statuses), &all);
        let lacking = plan.check_environments().err().map(|e| e.to_string());
        if as_json {
            let runs = plan.runs.iter().zip(statuses).enumerate().map(|(i, (run, status))| run_json(i, run, status));
            let runs: Vec<_> = if each { runs.collect() } else { Vec::new() };
            rows.push(json!({
                "figure": figure.id,
                "title": figure.title,
                "about": figure.about,
                "seeds": list.seeds.unwrap_or(figure.seeds),
                "steps": list.steps.unwrap_or(figure.steps),
                "environment": lacking,
                "cost": own,
                "runs": runs,
            }));
            continue;
        }
        let (seeds, steps) = (list.seeds.unwrap_or(figure.seeds), list.steps.unwrap_or(figure.steps));
        print(&format!(
            "{}: {}\n  {}\n  {seeds} seeds, {steps} steps: {}",
            figure.id,
            figure.title,
            figure.about,
            sums(&own, cores)
        ))?;
        if let Some(lacking) = lacking {
            print(&format!("  cannot run here: {lacking}"))?;
        }
        for (i, (run, status)) in plan.runs.iter().zip(statuses).enumerate().filter(|_| each) {
            print(&run_line(i, run, status))?;
        }
    }
    if as_json {
        print_json(&json!({"version": 1, "out": list.out, "figures": rows, "total": total}))?;
    } else {
        print(&format!("all, runs that figures share counted once: {}", sums(&total, cores)))?;
    }
    Ok(ExitCode::SUCCESS)
}
