//! Many runs at once, each in a process of its own: a run that is killed takes no other with it, and its memory is free again
//! when it ends. The processes are `gadm paper run`, the same command that a cluster's task is.

use std::fs::File;
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::PaperError;
use super::plan::Plan;
use super::state::{State, inspect, last_step};
use crate::runner::progress::{Style, count, duration};

/// Time between two looks at the processes.
const LOOK: Duration = Duration::from_millis(200);
/// Time between two looks at the metrics of the runs, and between two redraws.
const READ: Duration = Duration::from_secs(2);
/// Time between two lines where there is no terminal.
const LINE: Duration = Duration::from_secs(30);

/// How many runs go on at once.
pub struct PoolOptions<'a> {
    /// Processes.
    pub jobs: usize,
    /// Progress display.
    pub style: Style,
    /// Set from a signal handler: the runs then write checkpoints and stop.
    pub stop: &'a AtomicBool,
    /// The command that does the run of an index.
    pub command: &'a dyn Fn(usize) -> Command,
}

/// How it went.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PoolOutcome {
    /// Runs brought to their end.
    pub done: usize,
    /// Runs that failed: name, and the last line of what they said.
    pub failed: Vec<(String, String)>,
    /// Whether it was stopped before the end.
    pub interrupted: bool,
}

struct Running {
    index: usize,
    process: Child,
    log: PathBuf,
}

/// Does the runs of `plan` that are not done.
///
/// # Errors
/// [`PaperError::Train`] where a process cannot be started; the others are stopped then, with checkpoints. A run that fails is no
/// error here.
pub fn run_all(plan: &Plan, options: &PoolOptions<'_>) -> Result<PoolOutcome, PaperError> {
    let mut outcome = PoolOutcome::default();
    let mut waiting: Vec<usize> =
        (0..plan.runs.len()).filter(|&i| inspect(&plan.runs[i]).state != State::Done).collect();
    let mut running: Vec<Running> = Vec::new();
    let mut display = Display::new(plan, options.style);
    let mut told = false;
    let result = loop {
        let stop = options.stop.load(Ordering::Relaxed);
        if stop && !told {
            told = true;
            running.iter().for_each(interrupt);
        }
        let ended = match reap(plan, &mut running, &mut outcome) {
            Ok(ended) => ended,
            Err(error) => break Err(error),
        };
        for text in ended {
            display.say(&text);
        }
        if !stop {
            // What needs an expert waits for it, so that no place is taken by a process that does nothing.
            let expert = plan.expert.filter(|e| waiting.contains(e) || running.iter().any(|r| r.index == *e));
            let ready = |i: &usize| plan.expert_of(&plan.runs[*i]).is_none_or(|e| e == *i || expert != Some(e));
            while running.len() < options.jobs
                && let Some(at) = waiting.iter().position(ready)
            {
                match start(plan, waiting.remove(at), options) {
                    Ok(run) => running.push(run),
                    Err(error) => {
                        running.iter().for_each(interrupt);
                        return Err(error);
                    }
                }
            }
        }
        if running.is_empty() && (stop || waiting.is_empty()) {
            break Ok(());
        }
        display.update(plan, &running, outcome.failed.len());
        std::thread::sleep(LOOK);
    };
    display.finish();
    outcome.interrupted = options.stop.load(Ordering::Relaxed);
    result.map(|()| outcome)
}

/// Asks a run to write a checkpoint and stop, by the shell's `kill`, which every system has. The run may have ended by itself:
/// until it is waited for, its number belongs to nobody else.
fn interrupt(run: &Running) {
    let _ = Command::new("sh").args(["-c", &format!("kill -s TERM {} 2>/dev/null", run.process.id())]).status();
}

fn start(plan: &Plan, index: usize, options: &PoolOptions<'_>) -> Result<Running, PaperError> {
    let run = &plan.runs[index];
    let folder = plan.out.join("logs");
    std::fs::create_dir_all(&folder).map_err(PaperError::io("create", &folder))?;
    let log = folder.join(format!("{}.log", run.name.replace('/', "-")));
    let file = File::options().create(true).append(true).open(&log).map_err(PaperError::io("open", &log))?;
    let mut command = (options.command)(index);
    // A group of its own: Ctrl-C reaches this program alone, which passes it on once.
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(file).process_group(0);
    let process = command.spawn().map_err(PaperError::io("start a process of", command.get_program()))?;
    Ok(Running { index, process, log })
}

/// Takes the processes that have ended out of `running`; a line about each.
fn reap(plan: &Plan, running: &mut Vec<Running>, outcome: &mut PoolOutcome) -> Result<Vec<String>, PaperError> {
    let (mut lines, mut still) = (Vec::new(), Vec::new());
    for mut run in running.drain(..) {
        let name = &plan.runs[run.index].name;
        let Some(status) = run.process.try_wait().map_err(PaperError::io("wait for the process of", name.as_str()))?
        else {
            still.push(run);
            continue;
        };
        if status.success() {
            outcome.done += 1;
            lines.push(format!("{name}: done"));
        } else if status.code() != Some(130) {
            let text = std::fs::read_to_string(&run.log).unwrap_or_default();
            let said = text.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("it said nothing");
            let detail = if status.code().is_some() { said.to_owned() } else { format!("{status}; {said}") };
            lines.push(format!("{name}: FAILED: {detail} (log: {})", run.log.display()));
            outcome.failed.push((name.clone(), detail));
        }
    }
    *running = still;
    Ok(lines)
}

/// Progress over all runs, for people.
struct Display {
    label: &'static str,
    bar: Option<ProgressBar>,
    lines: bool,
    total: u64,
    /// Start of this session, and the steps that were done then.
    start: (Instant, u64),
    read: Option<Instant>,
    line: Option<Instant>,
    steps: Vec<u64>,
}

impl Display {
    #[expect(clippy::disallowed_methods, reason = "the display is for people; no result depends on its clock")]
    fn new(plan: &Plan, style: Style) -> Self {
        let total = plan.runs.iter().map(|run| run.steps).sum();
        let steps: Vec<u64> = plan.runs.iter().map(|run| last_step(&run.dir).min(run.steps)).collect();
        let bar = matches!(style, Style::Terminal { .. }).then(|| {
            let template = "{prefix}: {wide_bar} {percent} %\n  {msg}";
            let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
            ProgressBar::new(total).with_style(style).with_prefix(plan.figure.id)
        });
        let start = (Instant::now(), steps.iter().sum());
        let lines = matches!(style, Style::Lines);
        Self { label: plan.figure.id, bar, lines, total, start, read: None, line: None, steps }
    }

    /// A line that stays.
    fn say(&self, text: &str) {
        let line = || tracing::info!("{}: {text}", self.label);
        match &self.bar {
            Some(bar) => bar.suspend(line),
            None => line(),
        }
    }

    #[expect(clippy::disallowed_methods, reason = "the display is for people; no result depends on its clock")]
    fn update(&mut self, plan: &Plan, running: &[Running], failed: usize) {
        let now = Instant::now();
        let due = |last: Option<Instant>, period| last.is_none_or(|last| now.duration_since(last) >= period);
        if !due(self.read, READ) {
            return;
        }
        self.read = Some(now);
        for run in running {
            self.steps[run.index] = last_step(&plan.runs[run.index].dir).min(plan.runs[run.index].steps);
        }
        let text = self.text(plan, running.len(), failed, now.duration_since(self.start.0).as_secs_f64());
        if let Some(bar) = &self.bar {
            bar.set_position(self.steps.iter().sum());
            bar.set_message(text);
        } else if self.lines && due(self.line, LINE) {
            self.line = Some(now);
            self.say(&text);
        }
    }

    fn text(&self, plan: &Plan, running: usize, failed: usize, elapsed_s: f64) -> String {
        let steps: u64 = self.steps.iter().sum();
        let done = plan.runs.iter().zip(&self.steps).filter(|(run, steps)| **steps >= run.steps).count();
        let rate = steps.saturating_sub(self.start.1) as f64 / elapsed_s.max(1e-9);
        let eta = if rate > 0.0 { duration(self.total.saturating_sub(steps) as f64 / rate) } else { "–".to_owned() };
        let failed = if failed > 0 { format!(", {failed} failed") } else { String::new() };
        format!(
            "{done} of {} runs done, {running} running{failed} | {} of {} steps | {} steps/s | ETA {eta}",
            plan.runs.len(),
            count(steps as f64),
            count(self.total as f64),
            count(rate)
        )
    }

    fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::figure::figure;
    use super::super::plan::Options;
    use super::*;

    fn plan(out: &std::path::Path) -> Plan {
        let options = Options { seeds: Some(2), steps: Some(2_000), out: out.to_owned(), only: None };
        Plan::new(figure("demo").unwrap(), &options).unwrap()
    }

    fn shell(text: &str) -> Command {
        let mut command = Command::new("sh");
        command.args(["-c", text]);
        command
    }

    #[test]
    fn every_run_is_started_once_the_expert_before_those_that_need_it_and_failures_are_named() {
        let out = tempfile::tempdir().unwrap();
        let plan = plan(out.path());
        let list = out.path().join("order");
        let command = |i: usize| {
            let code =
                if plan.runs[i].name == "pendulum/gadm-dqn-small-seed1" { "echo no luck >&2; exit 1" } else { "" };
            shell(&format!("echo {i} >> {}; {code}", list.display()))
        };
        let go = AtomicBool::new(false);
        let options = PoolOptions { jobs: 3, style: Style::Quiet, stop: &go, command: &command };
        let outcome = run_all(&plan, &options).unwrap();
        assert_eq!((outcome.done, outcome.interrupted), (5, false));
        assert_eq!(outcome.failed, [("pendulum/gadm-dqn-small-seed1".to_owned(), "no luck".to_owned())]);
        let order: Vec<usize> =
            std::fs::read_to_string(list).unwrap().lines().map(|line| line.parse().unwrap()).collect();
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert_eq!(sorted, [0, 1, 2, 3, 4, 5]);
        let at = |i: usize| order.iter().position(|&other| other == i).unwrap();
        let expert = plan.expert.unwrap();
        for (i, run) in plan.runs.iter().enumerate().filter(|(_, run)| run.data.is_some()) {
            assert!(at(expert) < at(i), "{} before its expert: {order:?}", run.name);
        }
    }

    /// Processes that end on SIGTERM with 130 as `gadm` does; the stop comes once two of them run.
    #[test]
    fn a_stop_interrupts_what_runs_and_starts_nothing_more() {
        let out = tempfile::tempdir().unwrap();
        let plan = plan(out.path());
        let started = out.path().join("started");
        let command = |i: usize| {
            let wait = "sleep 60 & trap 'kill $!; exit 130' TERM";
            shell(&format!("{wait}; echo {i} >> {}; wait", started.display()))
        };
        let stop = AtomicBool::new(false);
        let options = PoolOptions { jobs: 2, style: Style::Quiet, stop: &stop, command: &command };
        let outcome = std::thread::scope(|scope| {
            scope.spawn(|| {
                while std::fs::read_to_string(&started).unwrap_or_default().lines().count() < 2 {
                    std::thread::yield_now();
                }
                stop.store(true, Ordering::Relaxed);
            });
            run_all(&plan, &options).unwrap()
        });
        assert_eq!(outcome, PoolOutcome { done: 0, failed: Vec::new(), interrupted: true });
        assert_eq!(std::fs::read_to_string(&started).unwrap().lines().count(), 2);
    }

    #[test]
    fn the_display_says_how_much_is_left() {
        let out = tempfile::tempdir().unwrap();
        let plan = plan(out.path());
        let mut display = Display::new(&plan, Style::Quiet);
        assert_eq!(display.total, 5 * 2_000 + 4_000);
        display.steps = vec![2_000, 1_500, 0, 0, 0, 0];
        let text = display.text(&plan, 2, 1, 35.0);
        assert!(text.contains("1 of 6 runs done, 2 running, 1 failed") && text.contains("100 steps/s"), "{text}");
        assert!(text.contains("ETA 1") && text.contains("45"), "10,500 steps at 100 a second: {text}");
    }
}
