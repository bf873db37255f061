//! The report of a run: was it good, what happened, and how to do it again.

use std::collections::BTreeMap;

use gadm_node::{Flags, State};
use gadm_runtime::{ActionHead, Policy};

use super::chart::{Chart, Series, Span, Style, label};
use super::page::{Cell, Mark, Page, Picture};
use super::recording::{Decisions, Episode};
use crate::SimError;
use crate::result::{EpisodeResult, RunResult};
use crate::scenario::Verdict;
use crate::target::Bin;

/// Episodes that become columns; of more, dots are drawn.
const MOST_COLUMNS: usize = 60;
/// Most rows of the table of episodes.
const MOST_ROWS: usize = 50;

/// What is known about a run besides its result.
#[derive(Clone, Debug, PartialEq)]
pub struct About<'a> {
    /// The first episode as it was watched.
    pub episode: &'a Episode,
    /// What was asked for; `None` where nothing was.
    pub verdict: Option<&'a Verdict>,
    /// Command to repeat the run.
    pub command: String,
    /// Path of the trace, as it was given.
    pub trace: Option<String>,
}

/// The report as a page.
///
/// # Errors
/// [`SimError::Layout`] where the frames cannot be those of this policy.
pub fn run_report(result: &RunResult, policy: &Policy, about: &About) -> Result<Page, SimError> {
    let mut page = Page::new(format!("{} over CAN", result.plant));
    let n = result.returns.n;
    page.lead(format!(
        "{n} episode{}, profile {}, node {}, seed {}; policy with {} latents, CRC-32 {}",
        if n == 1 { "" } else { "s" },
        result.profile,
        result.target,
        result.seed,
        result.policy.num_latents,
        result.policy.crc32
    ));
    verdicts(&mut page, result, about.verdict);
    let decisions = about.episode.decisions(policy)?;
    if let Some(film) = &about.episode.film {
        let end = if film.cut { " (its beginning)" } else { "" };
        let caption = format!("The plant in the first episode{end}, drawn from its state, {}.", film.pace);
        let picture = |media, bytes: &[u8]| Picture {
            media,
            bytes: bytes.to_vec(),
            alt: format!("{} in the first episode", result.plant),
        };
        let still = Some(picture("image/png", &film.png));
        page.section("First episode").picture(picture("image/gif", &film.gif), still, caption);
    } else {
        page.section("First episode");
    }
    first_episode(&mut page, result, policy, about.episode, &decisions);
    returns(&mut page, result);
    latents(&mut page, result);
    timing(&mut page, result);
    faults(&mut page, result);
    bus(&mut page, result);
    page.section("Command to repeat").code(about.command.clone());
    if let Some(trace) = &about.trace {
        page.text(format!("All frames are in {trace}, which candump's tools, python-can and `gadm-sim trace` read."));
    }
    Ok(page)
}

fn verdicts(page: &mut Page, result: &RunResult, verdict: Option<&Verdict>) {
    let r = &result.returns;
    let mean = format!("mean return {} ± {}, n {}", label(r.mean), label(three_digits(r.sd)), r.n);
    match verdict.filter(|v| !v.criteria.is_empty()) {
        None => _ = page.verdict(Mark::Note, format!("No criterion was given; {mean}.")),
        Some(v) => {
            let missed = v.criteria.iter().filter(|c| !c.passed).count();
            let text = match missed {
                0 => format!("All {} criteria hold; {mean}.", v.criteria.len()),
                _ => format!("{missed} of {} criteria missed ({}); {mean}.", v.criteria.len(), v.missed().join("; ")),
            };
            page.verdict(Mark::of(v.passed), text);
        }
    }
    for warning in &result.warnings {
        page.verdict(Mark::Note, warning.clone());
    }
    if let Some(v) = verdict.filter(|v| !v.criteria.is_empty()) {
        let rows = v.criteria.iter().map(|c| {
            let words = [Cell::text(c.name), Cell::text(&c.limit), Cell::text(&c.found)];
            words.into_iter().chain([Cell::mark(Mark::of(c.passed))]).collect()
        });
        page.section("Criteria").table(["criterion", "required", "found", ""], rows);
    }
}

/// A spread needs no more.
fn three_digits(value: f64) -> f64 {
    if value == 0.0 || !value.is_finite() {
        return value;
    }
    let scale = 10_f64.powi(2 - value.abs().log10().floor() as i32);
    (value * scale).round() / scale
}

/// Plots of the first episode over its time.
fn first_episode(page: &mut Page, result: &RunResult, policy: &Policy, episode: &Episode, decisions: &Decisions) {
    let n = episode.rewards.len();
    if n == 0 {
        page.text("Nothing was recorded.");
        return;
    }
    let period_s = f64::from(policy.spec().control_period_us) * 1e-6;
    let end_s = period_s * n as f64;
    let time = |i: usize| period_s * i as f64;
    let chart = |title: &str, y: &str| Chart::new(title, "time (s)", y).between(0.0, end_s);

    let mut total = 0.0;
    let sums = episode.rewards.iter().enumerate().map(|(i, r)| {
        total += r;
        (time(i + 1), total)
    });
    let points = std::iter::once((0.0, 0.0)).chain(sums).collect();
    let series = [Series { name: "return so far".into(), points }];
    page.figure(
        chart("Return of the first episode so far", "return so far").draw(Style::Line, &series),
        format!("Sum of the rewards; the episode's return is {}.", label(episode.rewards.iter().sum())),
    );

    for (slot, signal) in policy.action_signals().enumerate() {
        let value = |(i, a): (usize, &Vec<f32>)| (time(i), a.get(slot).map_or(f64::NAN, |v| f64::from(*v)));
        let points = episode.actions.iter().enumerate().map(value).collect();
        let (style, unit) = match signal.head {
            ActionHead::Continuous { .. } => (Style::Steps, signal.unit),
            ActionHead::Discrete { .. } | ActionHead::Binary => (Style::Dots, "choice"),
        };
        let unit = if unit.is_empty() || unit == "1" { String::new() } else { format!(" ({unit})") };
        let chart = chart("Actions of the first episode", &format!("action {}{unit}", signal.name));
        let chart = Chart { height: 70, x_name: String::new(), ..chart };
        page.figure(chart.draw(style, &[Series { name: signal.name.to_owned(), points }]), "");
    }
    page.text("Actions as the actuators did them, against time in seconds.");

    let told = decisions.latents.iter().enumerate();
    let points: Vec<_> = told.filter_map(|(i, l)| Some((time(i), f64::from((*l)?)))).collect();
    let without = n - points.len();
    let caption = match without {
        0 => "The latent that the node chose in each control period.".to_owned(),
        _ => format!("The latent that the node chose; in {without} of {n} periods it told none."),
    };
    let series = [Series { name: "latent".into(), points }];
    page.figure(chart("Latents of the first episode", "latent").draw(Style::Dots, &series), caption);

    let rows = timeline(result, decisions, period_s);
    let shown = Chart::new("States, flags and faults of the first episode", "time (s)", "").between(0.0, end_s);
    page.figure(shown.timeline(&rows), "State of the node by its heartbeats, flags of its actions, injected faults.");
}

/// Rows of the timeline: state, flags that were ever up, missing answers, faults.
fn timeline(result: &RunResult, decisions: &Decisions, period_s: f64) -> Vec<(String, Vec<Span>)> {
    let spans = |color: usize, tip: &str, on: &dyn Fn(usize) -> bool| -> Vec<Span> {
        let all = 0..decisions.flags.len();
        let span =
            |i: usize| Span { from: period_s * i as f64, to: period_s * (i + 1) as f64, color, tip: tip.to_owned() };
        all.filter(|&i| on(i)).map(span).collect()
    };
    let mut rows = Vec::new();
    let mut states: Vec<State> = Vec::new();
    for state in decisions.states.iter().flatten() {
        if !states.contains(state) {
            states.push(*state);
        }
    }
    for state in states {
        let color = if state == State::Run { 2 } else { 1 };
        rows.push((
            format!("state {}", state.name()),
            spans(color, state.name(), &|i| decisions.states[i] == Some(state)),
        ));
    }
    for (bit, name) in Flags::NAMES.iter().enumerate() {
        let up = spans(4, name, &|i| decisions.flags[i].is_some_and(|f| f.bits() >> bit & 1 == 1));
        if !up.is_empty() {
            rows.push((format!("flag {name}"), up));
        }
    }
    let missing = spans(7, "no action set", &|i| decisions.flags[i].is_none());
    if !missing.is_empty() {
        rows.push(("no action set".to_owned(), missing));
    }
    let mut by_fault: BTreeMap<usize, Vec<Span>> = BTreeMap::new();
    for span in result.episodes.first().into_iter().flat_map(|e| &e.fault_spans) {
        let name = result.faults.get(span.fault).map_or("fault", |f| f.fault.name.as_str());
        by_fault.entry(span.fault).or_default().push(Span {
            from: period_s * span.from as f64,
            to: period_s * (span.to + 1) as f64,
            color: 1,
            tip: name.to_owned(),
        });
    }
    for (fault, spans) in by_fault {
        let name = result.faults.get(fault).map_or("fault", |f| f.fault.name.as_str());
        rows.push((format!("fault {name}"), spans));
    }
    rows
}

fn returns(page: &mut Page, result: &RunResult) {
    let r = &result.returns;
    page.section("Returns");
    let chart =
        Chart::new("Return of each episode", "episode", "return").level(r.mean, format!("mean {}", label(r.mean)));
    let caption = format!("Smallest {}, largest {}.", label(r.min), label(r.max));
    let episodes = &result.episodes;
    if (2..=MOST_COLUMNS).contains(&episodes.len()) {
        let columns: Vec<_> = episodes.iter().map(|e| (e.episode.to_string(), e.ret)).collect();
        page.figure(chart.columns(&columns), caption);
    } else if episodes.len() > MOST_COLUMNS {
        let points = episodes.iter().map(|e| (e.episode as f64, e.ret)).collect();
        page.figure(chart.draw(Style::Dots, &[Series { name: "return".into(), points }]), caption);
    }
    let row = |e: &EpisodeResult| {
        let end = match (e.terminated, e.truncated) {
            (true, _) => "ended by the plant's rules",
            (false, true) => "time limit",
            (false, false) => "stopped",
        };
        let numbers = [e.held, e.safe, e.missing, e.fallback, e.clipped, e.late].map(|n| Cell::number(n.to_string()));
        let first =
            [Cell::number(e.episode.to_string()), Cell::number(label(e.ret)), Cell::number(e.steps.to_string())];
        first.into_iter().chain([Cell::text(end)]).chain(numbers).collect()
    };
    let head = ["episode", "return", "steps", "end", "held", "safe", "missing", "fallback", "clipped", "late"];
    page.table(head, episodes.iter().take(MOST_ROWS).map(row));
    if episodes.len() > MOST_ROWS {
        page.text(format!("The first {MOST_ROWS} of {} episodes; `--json` has all.", episodes.len()));
    }
}

fn latents(page: &mut Page, result: &RunResult) {
    let columns: Vec<_> = result.latent_counts.iter().enumerate().map(|(i, n)| (i.to_string(), *n as f64)).collect();
    page.section("Latents").figure(
        Chart::new("How often each latent was chosen", "latent", "times").columns(&columns),
        format!("{} of {} latents were chosen, over all episodes.", result.latents_used, result.policy.num_latents),
    );
}

/// Measured in real time only.
fn timing(page: &mut Page, result: &RunResult) {
    let Some(t) = &result.timing else { return };
    page.section("Real time").facts([
        ("speed", format!("{} × real time", label(t.factor))),
        ("periods", t.periods.to_string()),
        ("overruns", t.overruns.to_string()),
        ("unanswered", t.unanswered.to_string()),
        ("answers take", format!("{} % of the period", label(t.load_percent))),
    ]);
    for (what, q) in [("latency", &t.latency_us), ("jitter", &t.jitter_us)] {
        let last = q.histogram.len().saturating_sub(1);
        let column = |(i, bin): (usize, &Bin)| {
            let from = label(bin.from.round());
            (if i == last && i > 0 { format!(">{from}") } else { from }, bin.count as f64)
        };
        let columns: Vec<_> = q.histogram.iter().enumerate().map(column).collect();
        let values = [("min", q.min), ("p50", q.p50), ("p90", q.p90), ("p99", q.p99), ("max", q.max)];
        let values = values.map(|(name, us)| format!("{name} {}", label(us.round()))).join(", ");
        let chart = Chart::new(format!("Histogram of the {what}"), format!("{what} (µs)"), "periods");
        let caption = format!("{what} of {} periods, µs: {values}; the last column holds all above p99.", q.n);
        page.figure(chart.columns(&columns), caption);
    }
}

fn faults(page: &mut Page, result: &RunResult) {
    if result.faults.is_empty() {
        return;
    }
    let rows = result.faults.iter().map(|f| {
        let injected = Cell::number(f.injected.to_string());
        let injected = if f.injected == 0 { injected.marked(Mark::Missed) } else { injected };
        vec![Cell::text(&f.fault.name), injected, Cell::text(f.counts)]
    });
    page.section("Faults").table(["fault", "injected", "counted"], rows);
    let rows = result.episodes.iter().filter_map(|e| Some((e, e.faults?))).take(MOST_ROWS).map(|(e, f)| {
        let periods = |n: Option<u64>| Cell::number(n.map_or_else(|| "–".to_owned(), |n| n.to_string()));
        vec![
            Cell::number(e.episode.to_string()),
            periods(f.first_tick),
            periods(f.detected_after),
            periods(f.safe_after),
            Cell::number(format!("{} %", label((f.worst_action_error * 1000.0).round() / 10.0))),
        ]
    });
    page.table(["episode", "first at tick", "detected after", "safe after", "worst action error"], rows);
    page.text("Times in control periods; the action error in per cent of the action's range.");
}

fn bus(page: &mut Page, result: &RunResult) {
    let b = &result.bus;
    let rate = format!("{} kbit/s, data of FD frames {} kbit/s", b.bit_rate.nominal / 1000, b.bit_rate.data / 1000);
    page.section("Bus and node").facts([
        ("bit rate", rate),
        (
            "load, worst case",
            format!("{} % of a control period", label((b.load.total_percent * 100.0).round() / 100.0)),
        ),
        ("load of the frames sent", format!("{} %", label((b.measured_percent * 100.0).round() / 100.0))),
        ("frames", b.frames.to_string()),
        ("frames a period", format!("{} OBS, {} ACT", b.load.observation_frames, b.load.action_frames)),
        ("frames of the node that the plant dropped", b.plant_errors.to_string()),
        ("control periods", format!("{} = {} s of virtual time", result.steps, label(result.virtual_s))),
        ("policy", format!("{} bytes, interface hash {}", result.policy.bytes, result.policy.interface_hash)),
    ]);
    if let Some(node) = &result.node {
        let value = serde_json::to_value(node).unwrap_or_default();
        let counters = value.as_object().into_iter().flatten().map(|(name, n)| (name.replace('_', " "), n.to_string()));
        page.facts(counters);
    }
}

/// A command line as a shell takes it.
#[must_use]
pub fn command_line(words: impl IntoIterator<Item = String>) -> String {
    let plain = |w: &str| !w.is_empty() && w.chars().all(|c| c.is_ascii_alphanumeric() || "-_./:=,+@%".contains(c));
    let quoted = |w: String| if plain(&w) { w } else { format!("'{}'", w.replace('\'', "'\\''")) };
    words.into_iter().map(quoted).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_are_quoted_as_a_shell_wants_them() {
        let words = ["gadm-sim", "run", "my policy.bin", "--seed", "1", "it's", "$HOME", ""];
        let line = command_line(words.map(str::to_owned));
        assert_eq!(line, r"gadm-sim run 'my policy.bin' --seed 1 'it'\''s' '$HOME' ''");
    }
}
