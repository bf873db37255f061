//! Progress of a run for people: a live display on a terminal, one line every ten seconds elsewhere.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::collections::VecDeque;
use std::io::{IsTerminal, Write};
use std::time::Instant;

/// Seconds between two lines where there is no terminal.
const LINE_PERIOD_S: f64 = 10.0;
/// Seconds over which the rates are averaged.
const RATE_WINDOW_S: f64 = 10.0;
/// Least distance in time of every other sample kept for the rates, in seconds.
const RATE_SPACING_S: f64 = 0.25;
/// Seconds between two redraws on a terminal.
const REDRAW_PERIOD_S: f64 = 0.1;

/// How progress is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Style {
    /// A live display that redraws itself.
    Terminal {
        /// Whether colours are used.
        color: bool,
    },
    /// One line every ten seconds, the first at once.
    Lines,
    /// Nothing at all.
    Quiet,
}

impl Style {
    /// The style for standard error: quiet if asked for, lines without a terminal, colours unless the variable
    /// `NO_COLOR` is set and not empty (<https://no-color.org>) or the terminal is `dumb`.
    pub fn detect(quiet: bool) -> Self {
        let no_color = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
        let dumb = std::env::var_os("TERM").is_some_and(|value| value == "dumb");
        Self::choose(quiet, std::io::stderr().is_terminal() && !dumb, no_color)
    }

    fn choose(quiet: bool, terminal: bool, no_color: bool) -> Self {
        match (quiet, terminal) {
            (true, _) => Self::Quiet,
            (false, true) => Self::Terminal { color: !no_color },
            (false, false) => Self::Lines,
        }
    }
}

/// State of the run at one moment. What is not known yet is `None` and shown as `–`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Snapshot {
    /// What the run is doing, such as `warm-up`, `AR`, `LACP`, `RL`; empty if there is nothing to tell apart.
    pub phase: &'static str,
    /// Environment steps so far.
    pub env_steps: u64,
    /// Gradient updates so far.
    pub updates: u64,
    /// Recent return of training episodes.
    pub episode_return: Option<f64>,
    /// Recent loss.
    pub loss: Option<f64>,
    /// Latents in use and latents that there are.
    pub latents: Option<(usize, usize)>,
}

/// Time for the display; results never depend on it.
type Clock = Box<dyn Fn() -> f64 + Send>;

/// The progress display of one run.
pub struct Progress {
    total_steps: u64,
    label: String,
    output: Output,
    clock: Clock,
    /// Time and steps at the first update: a resumed run does not start at zero.
    start: Option<(f64, u64)>,
    /// Time of the last line or redraw.
    last_shown_s: Option<f64>,
    rates: Rates,
}

/// Where the display goes.
enum Output {
    Terminal(ProgressBar),
    Lines(Box<dyn Write + Send>),
    Quiet,
}

impl Progress {
    /// A display on standard error for a run of `total_steps` environment steps.
    #[allow(clippy::disallowed_methods, reason = "the display is for people; no result depends on its clock")]
    pub fn new(total_steps: u64, label: &str, style: Style) -> Self {
        let start = Instant::now();
        let clock = Box::new(move || start.elapsed().as_secs_f64());
        Self::with_clock(total_steps, label, style, Box::new(std::io::stderr()), clock)
    }

    /// [`Self::new`] with a clock of the caller (seconds, not decreasing) and, for [`Style::Lines`], a writer.
    pub fn with_clock(
        total_steps: u64,
        label: &str,
        style: Style,
        writer: Box<dyn Write + Send>,
        clock: Clock,
    ) -> Self {
        let output = match style {
            Style::Terminal { color } => Output::Terminal(bar(total_steps, label, color)),
            Style::Lines => Output::Lines(writer),
            Style::Quiet => Output::Quiet,
        };
        Self {
            total_steps,
            label: label.to_owned(),
            output,
            clock,
            start: None,
            last_shown_s: None,
            rates: Rates::default(),
        }
    }

    /// Shows `snapshot`; cheap enough to be called every step.
    pub fn update(&mut self, snapshot: &Snapshot) {
        if matches!(self.output, Output::Quiet) {
            return;
        }
        let now_s = (self.clock)();
        let start = *self.start.get_or_insert((now_s, snapshot.env_steps));
        self.rates.push(now_s, snapshot.env_steps, snapshot.updates);
        let period_s = if matches!(self.output, Output::Terminal(_)) { REDRAW_PERIOD_S } else { LINE_PERIOD_S };
        if self.last_shown_s.is_some_and(|last_s| now_s - last_s < period_s) {
            return;
        }
        self.last_shown_s = Some(now_s);
        let Fields { speed, quality, eta } = self.fields(snapshot, now_s, start);
        match &mut self.output {
            Output::Terminal(bar) => {
                bar.set_position(snapshot.env_steps);
                bar.set_message(format!("{speed} | {eta}\n  {quality}"));
            }
            Output::Lines(writer) => {
                let done = summary(snapshot.env_steps, self.total_steps);
                // A closed standard error is no reason to stop a run.
                let _ = writeln!(writer, "{}: {done} | {speed} | {quality} | {eta}", self.label);
            }
            Output::Quiet => {}
        }
    }

    /// Ends the display with `message`, which stays on the screen.
    pub fn finish(&mut self, message: &str) {
        match &mut self.output {
            Output::Terminal(bar) => {
                bar.set_style(plain_style("{prefix}: {msg}"));
                bar.abandon_with_message(message.to_owned());
            }
            Output::Lines(writer) => {
                let _ = writeln!(writer, "{}: {message}", self.label);
            }
            Output::Quiet => {}
        }
        self.output = Output::Quiet;
    }

    /// Runs `print`, which writes to the terminal, without tearing the display.
    pub fn suspend<R>(&self, print: impl FnOnce() -> R) -> R {
        match &self.output {
            Output::Terminal(bar) => bar.suspend(print),
            Output::Lines(_) | Output::Quiet => print(),
        }
    }

    fn fields(&self, snapshot: &Snapshot, now_s: f64, start: (f64, u64)) -> Fields {
        let (steps_per_s, updates_per_s) = self.rates.per_s();
        let optional = |value: Option<String>| value.unwrap_or_else(|| "–".to_owned());
        let remaining = self.total_steps.saturating_sub(snapshot.env_steps) as f64;
        // From the whole run so far: phases without environment steps would make a recent rate useless.
        let mean_rate = snapshot.env_steps.saturating_sub(start.1) as f64 / (now_s - start.0);
        let eta = (mean_rate > 0.0 && mean_rate.is_finite()).then(|| duration(remaining / mean_rate));
        let steps = format!("{} env steps/s", optional(steps_per_s.map(count)));
        let updates = format!("{} updates/s", optional(updates_per_s.map(count)));
        let phase = (!snapshot.phase.is_empty()).then(|| snapshot.phase.to_owned());
        let latents = optional(snapshot.latents.map(|(used, all)| format!("{used}/{all}")));
        Fields {
            speed: phase.into_iter().chain([steps, updates]).collect::<Vec<_>>().join(" | "),
            quality: [
                format!("return {}", optional(snapshot.episode_return.map(number))),
                format!("loss {}", optional(snapshot.loss.map(number))),
                format!("latents {latents}"),
            ]
            .join(" | "),
            eta: format!("ETA {}", optional(eta)),
        }
    }
}

/// What both displays show, in parts that fit a line of 80 columns.
struct Fields {
    speed: String,
    quality: String,
    eta: String,
}

impl Drop for Progress {
    /// An aborted run leaves the last state on the screen, below which the error appears.
    fn drop(&mut self) {
        if let Output::Terminal(bar) = &self.output {
            bar.abandon();
        }
    }
}

fn bar(total_steps: u64, label: &str, color: bool) -> ProgressBar {
    let bar = ProgressBar::with_draw_target(Some(total_steps), ProgressDrawTarget::stderr());
    let template = if color {
        "{prefix:.bold} {bar:24.cyan/dim} {percent:>3} % of {human_len} steps\n  {elapsed} | {msg}"
    } else {
        "{prefix} {bar:24} {percent:>3} % of {human_len} steps\n  {elapsed} | {msg}"
    };
    bar.set_style(plain_style(template).progress_chars("━╸─"));
    bar.set_prefix(label.to_owned());
    bar
}

fn plain_style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template).expect("the templates above are literals")
}

/// Recent samples of time, steps and updates.
#[derive(Default)]
struct Rates {
    samples: VecDeque<(f64, u64, u64)>,
}

impl Rates {
    fn push(&mut self, now_s: f64, env_steps: u64, updates: u64) {
        // The newest sample is always the present one; older ones keep their distance.
        if self.samples.len() >= 2 && now_s - self.samples[self.samples.len() - 2].0 < RATE_SPACING_S {
            self.samples.pop_back();
        }
        self.samples.push_back((now_s, env_steps, updates));
        while self.samples.len() > 2 && now_s - self.samples[1].0 >= RATE_WINDOW_S {
            self.samples.pop_front();
        }
    }

    /// Environment steps and updates per second over the window; `None` before there are two moments.
    fn per_s(&self) -> (Option<f64>, Option<f64>) {
        match (self.samples.front(), self.samples.back()) {
            (Some(&(t0, steps0, updates0)), Some(&(t1, steps1, updates1))) if t1 > t0 => {
                let rate = |from: u64, to: u64| Some(to.saturating_sub(from) as f64 / (t1 - t0));
                (rate(steps0, steps1), rate(updates0, updates1))
            }
            _ => (None, None),
        }
    }
}

fn summary(env_steps: u64, total_steps: u64) -> String {
    let percent = if total_steps == 0 { 100.0 } else { 100.0 * env_steps as f64 / total_steps as f64 };
    format!("{percent:.0} % ({} of {} steps)", count(env_steps as f64), count(total_steps as f64))
}

/// A count or rate with three to four significant digits: `12.3`, `960`, `1.25k`, `3.00M`.
pub(crate) fn count(value: f64) -> String {
    match value {
        value if value >= 999_500.0 => format!("{:.2}M", value / 1e6),
        value if value >= 9_995.0 => format!("{:.1}k", value / 1e3),
        value if value >= 100.0 || value.fract() == 0.0 => format!("{value:.0}"),
        value => format!("{value:.1}"),
    }
}

/// A return or loss: four significant digits, scientific where fixed notation would hide them.
fn number(value: f64) -> String {
    let magnitude = value.abs();
    match magnitude {
        0.0 => "0".to_owned(),
        _ if !magnitude.is_finite() => value.to_string(),
        1e-3..1.0 => format!("{value:.4}"),
        1.0..100.0 => format!("{value:.2}"),
        100.0..1e6 => format!("{value:.1}"),
        _ => format!("{value:.2e}"),
    }
}

/// Seconds as `45 s`, `3 min 05 s`, `2 h 07 min`, `4 d 03 h`.
pub fn duration(seconds: f64) -> String {
    let total = seconds.round() as u64;
    let (days, hours, minutes, seconds) = (total / 86_400, total / 3_600 % 24, total / 60 % 60, total % 60);
    match total {
        0..60 => format!("{seconds} s"),
        60..3_600 => format!("{minutes} min {seconds:02} s"),
        3_600..86_400 => format!("{hours} h {minutes:02} min"),
        _ => format!("{days} d {hours:02} h"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::{Arc, Mutex};

    #[derive(Clone, Default)]
    struct Buffer(Arc<Mutex<Vec<u8>>>);

    impl Write for Buffer {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().unwrap().write(bytes)
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    /// A display with a clock that the test sets.
    fn display(style: Style, total: u64) -> (Progress, Buffer, Arc<Mutex<f64>>) {
        let (buffer, time) = (Buffer::default(), Arc::new(Mutex::new(0.0)));
        let clock = Box::new({
            let time = Arc::clone(&time);
            move || *time.lock().unwrap()
        });
        (Progress::with_clock(total, "moving seed 1", style, Box::new(buffer.clone()), clock), buffer, time)
    }

    fn lines(buffer: &Buffer) -> Vec<String> {
        let text = String::from_utf8(buffer.0.lock().unwrap().clone()).unwrap();
        text.lines().map(str::to_owned).collect()
    }

    #[test]
    fn without_a_terminal_a_line_at_once_and_then_every_ten_seconds() {
        let (mut progress, buffer, time) = display(Style::Lines, 100_000);
        for second in 0..=25 {
            *time.lock().unwrap() = f64::from(second);
            let snapshot = Snapshot {
                phase: "RL",
                env_steps: second as u64 * 500,
                updates: second as u64 * 250,
                episode_return: (second > 0).then_some(-1.5),
                loss: (second > 0).then_some(0.0123),
                latents: Some((11, 16)),
            };
            progress.update(&snapshot);
        }
        progress.finish("done, mean return 1.9");
        assert_eq!(
            lines(&buffer),
            [
                "moving seed 1: 0 % (0 of 100.0k steps) | RL | – env steps/s | – updates/s | return – | loss – | latents 11/16 | ETA –",
                "moving seed 1: 5 % (5000 of 100.0k steps) | RL | 500 env steps/s | 250 updates/s | return -1.50 | loss 0.0123 | latents 11/16 | ETA 3 min 10 s",
                "moving seed 1: 10 % (10.0k of 100.0k steps) | RL | 500 env steps/s | 250 updates/s | return -1.50 | loss 0.0123 | latents 11/16 | ETA 3 min 00 s",
                "moving seed 1: done, mean return 1.9",
            ]
        );
    }

    #[test]
    fn a_resumed_run_is_timed_from_where_it_resumed() {
        let (mut progress, buffer, time) = display(Style::Lines, 2000);
        progress.update(&Snapshot { env_steps: 1000, ..Snapshot::default() });
        *time.lock().unwrap() = 10.0;
        progress.update(&Snapshot { env_steps: 1100, ..Snapshot::default() });
        let last = lines(&buffer).pop().unwrap();
        assert!(last.contains("| 10 env steps/s") && last.ends_with("ETA 1 min 30 s"), "{last}");
    }

    #[test]
    fn rates_forget_what_is_older_than_the_window() {
        let mut rates = Rates::default();
        for tenth in 0..=1000 {
            let now_s = f64::from(tenth) / 10.0;
            let steps = if now_s < 50.0 { now_s * 1000.0 } else { 50_000.0 + (now_s - 50.0) * 100.0 };
            rates.push(now_s, steps.round() as u64, 0);
        }
        assert!(rates.samples.len() as f64 <= 2.0 * RATE_WINDOW_S / RATE_SPACING_S + 2.0);
        let (steps_per_s, updates_per_s) = rates.per_s();
        assert!((steps_per_s.unwrap() - 100.0).abs() < 1.0, "{steps_per_s:?}");
        assert_eq!(updates_per_s, Some(0.0));
    }

    #[test]
    fn quiet_says_nothing() {
        let (mut progress, buffer, _) = display(Style::Quiet, 10);
        progress.update(&Snapshot::default());
        progress.finish("done");
        assert!(lines(&buffer).is_empty());
    }

    #[test]
    fn the_terminal_display_holds_the_same_fields() {
        let (mut progress, _, time) = display(Style::Terminal { color: false }, 1000);
        progress.update(&Snapshot::default());
        *time.lock().unwrap() = 1.0;
        progress.update(&Snapshot { env_steps: 250, updates: 100, ..Snapshot::default() });
        let Output::Terminal(bar) = &progress.output else { panic!("no terminal display") };
        let message = "250 env steps/s | 100 updates/s | ETA 3 s\n  return – | loss – | latents –";
        assert_eq!((bar.position(), bar.message().as_str()), (250, message));
        assert_eq!(progress.suspend(|| 5), 5);
        progress.finish("done");
    }

    #[test]
    fn the_style_follows_terminal_and_wishes() {
        assert_eq!(Style::choose(false, true, false), Style::Terminal { color: true });
        assert_eq!(Style::choose(false, true, true), Style::Terminal { color: false });
        assert_eq!(Style::choose(false, false, false), Style::Lines);
        assert_eq!(Style::choose(true, true, false), Style::Quiet);
    }

    #[test]
    fn numbers_are_short_and_honest() {
        assert_eq!([0.0, 12.34, 960.4, 12_345.0, 2.5e6].map(count), ["0", "12.3", "960", "12.3k", "2.50M"]);
        assert_eq!([0.0, 0.0123, -1.5, 998.76, 1.5e-7].map(number), ["0", "0.0123", "-1.50", "998.8", "1.50e-7"]);
        assert_eq!([f64::NAN, f64::INFINITY].map(number), ["NaN", "inf"]);
        assert_eq!([45.2, 185.0, 7620.0, 356_400.0].map(duration), ["45 s", "3 min 05 s", "2 h 07 min", "4 d 03 h"]);
    }
}
