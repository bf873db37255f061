//! The page of a flight.

use gadm_envs::ActionSignal;
use gadm_runtime::ActionHead;

use super::regions::POINTS;
use super::{Flight, Region, Shown, Subject, regions};
use crate::error::TrainError;
use crate::plot::{
    LatentPanel, Map, Mark, Paint, Panel, PlotError, PlotOptions, Series, Shape, by_latent, episode, latent_usage, map,
    maps,
};
use crate::report::{Column, Report, ReportError};

/// Columns of a map over time.
const COLUMNS: usize = 100;
/// Action slots that get a map of their own.
const MOST_SLOTS: usize = 8;

/// A page could not be made.
#[derive(Debug, thiserror::Error)]
pub enum PageError {
    /// A figure.
    #[error(transparent)]
    Plot(#[from] PlotError),
    /// A section.
    #[error(transparent)]
    Report(#[from] ReportError),
    /// The policy.
    #[error(transparent)]
    Train(Box<TrainError>),
}

impl From<TrainError> for PageError {
    fn from(error: TrainError) -> Self {
        Self::Train(Box::new(error))
    }
}

/// Name of a slot with its unit.
fn labelled(name: &str, unit: &str) -> String {
    if unit.is_empty() || unit == "1" { name.to_owned() } else { format!("{name} ({unit})") }
}

/// Range of a continuous slot; `None` for others.
fn range(signal: &ActionSignal) -> Option<(f64, f64)> {
    match signal.head {
        ActionHead::Continuous { lo, hi } => Some((lo.into(), hi.into())),
        ActionHead::Discrete { .. } | ActionHead::Binary => None,
    }
}

/// Title-less figure of `height`: the section's heading says what it is.
fn sized(height: u32) -> PlotOptions {
    PlotOptions::new("").with_size(860, height)
}

/// Height of a map with a row per latent.
fn tall(latents: usize) -> u32 {
    (140 + 6 * latents as u32).clamp(240, 620)
}

/// The page about `flight`, with Q-values and confidences at step `at` of its first episode (from 0; the last one if it is shorter).
///
/// # Errors
/// Where a figure cannot be drawn.
pub fn page(subject: &mut Subject, flight: &Flight, at: usize) -> Result<Report, PageError> {
    let at = at.min(flight.shown.len().saturating_sub(1));
    let mut report = Report::new(format!("Why {} acts as it does", subject.name));
    report.facts("Policy and episodes", facts(subject, flight));
    usage(&mut report, flight)?;
    masks(&mut report, subject, flight)?;
    by_latent_table(&mut report, flight)?;
    decoded(&mut report, flight)?;
    if let Some(shown) = flight.shown.get(at) {
        step(&mut report, subject, flight, shown, at)?;
        encoder(&mut report, subject, flight, shown)?;
    }
    quantisation(&mut report, subject, flight)?;
    Ok(report)
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let n = values.len().max(1) as f64;
    values.sum::<f64>() / n
}

fn facts(subject: &Subject, flight: &Flight) -> Vec<(&'static str, String)> {
    let returns: Vec<f64> = flight.episodes.iter().map(|episode| episode.total).collect();
    let average = mean(returns.iter().copied());
    let sd = if returns.len() < 2 {
        0.0
    } else {
        (returns.iter().map(|r| (r - average).powi(2)).sum::<f64>() / (returns.len() - 1) as f64).sqrt()
    };
    let choices: Vec<_> = flight.choices().copied().collect();
    let share = |wanted: &dyn Fn(&super::Choice) -> bool| {
        format!("{:.2} %", 100.0 * mean(choices.iter().map(|choice| f64::from(u8::from(wanted(choice))))))
    };
    let used = flight.chosen().iter().filter(|count| **count > 0).count();
    let allowed = mean(choices.iter().map(|choice| f64::from(choice.allowed)));
    vec![
        ("policy", subject.name.clone()),
        ("environment", subject.env.clone()),
        ("flown by", "the int8 policy in the device runtime".to_owned()),
        ("episodes", format!("{} from seed {}", flight.episodes.len(), flight.seed)),
        ("decisions", choices.len().to_string()),
        ("return", format!("{average:.2} ± {sd:.2}")),
        ("latents in use", format!("{used} of {}", flight.latents)),
        ("latents allowed, mean", format!("{allowed:.2} of {}", flight.latents)),
        ("empty masks (fallback)", share(&|choice| choice.fallback)),
        ("decisions with an observation out of range", share(&|choice| choice.clipped)),
    ]
}

fn usage(report: &mut Report, flight: &Flight) -> Result<(), PageError> {
    let episodes = flight.episodes.len();
    let mut values = vec![0.0; flight.latents * episodes];
    for (column, flown) in flight.episodes.iter().enumerate() {
        for choice in &flown.choices {
            values[usize::from(choice.latent) * episodes + column] += 1.0 / flown.choices.len() as f64;
        }
    }
    let most = (100.0 * values.iter().copied().fold(0.0, f64::max)).ceil();
    // What was never chosen stays empty.
    let values = values.into_iter().map(|share| if share > 0.0 { 100.0 * share } else { f64::NAN }).collect();
    let grid = Map {
        x_name: "episode".to_owned(),
        y_name: "latent".to_owned(),
        x: 0.5..episodes as f64 + 0.5,
        y: -0.5..flight.latents as f64 - 0.5,
        columns: episodes,
        values,
        paint: Paint::Scale { name: "share of decisions (%)".to_owned(), range: 0.0..most },
        marks: Vec::new(),
        lines: Vec::new(),
    };
    report.figure(
        "Latents over episodes",
        map(&grid, &sized(tall(flight.latents)))?,
        "How often each latent was chosen, episode by episode. Empty: never.",
    )?;
    report.figure("Latents of all episodes", latent_usage(&flight.chosen(), &sized(360))?, "")?;
    Ok(())
}

fn masks(report: &mut Report, subject: &Subject, flight: &Flight) -> Result<(), PageError> {
    let choices = &flight.episodes[0].choices;
    let series = |name: &str, of: &dyn Fn(&super::Choice) -> f64| Series {
        name: name.to_owned(),
        values: choices.iter().map(of).collect(),
    };
    let panel = |y_name: &str, series| Panel { y_name: y_name.to_owned(), series: vec![series] };
    let panels = [
        panel("latents", series("allowed", &|choice| f64::from(choice.allowed))),
        panel("latent", series("chosen", &|choice| f64::from(choice.latent))),
        panel("0 or 1", series("empty mask (fallback)", &|choice| f64::from(u8::from(choice.fallback)))),
    ];
    let caption = if subject.float.confidence.is_some() {
        format!(
            "The first episode. A latent is allowed where its confidence is above {:.4}; where none is, the rule for an empty mask \
             makes the set (fallback 1).",
            subject.float.beta
        )
    } else {
        "The first episode. This policy has no confidence network: every latent is always allowed.".to_owned()
    };
    let period_s = f64::from(flight.spec.control_period_us) * 1e-6;
    report.figure("Mask and choice along an episode", episode(&panels, period_s, &sized(190))?, caption)?;
    Ok(())
}

/// One line per latent: how often, and what it does.
fn by_latent_table(report: &mut Report, flight: &Flight) -> Result<(), PageError> {
    let chosen = flight.chosen();
    let decisions = chosen.iter().sum::<u64>().max(1) as f64;
    let slots = flight.spec.actions.len();
    let steps = flight.shown.len().max(1) as f64;
    let mut columns = vec![
        Column::number("latent"),
        Column::number("chosen (%)"),
        Column::number("allowed (%)"),
        Column::number("confidence"),
        Column::number("Q below the best"),
    ];
    let shown_slots = slots.min(MOST_SLOTS);
    columns.extend(flight.spec.actions[..shown_slots].iter().map(|s| Column::text(labelled(&s.name, &s.unit))));
    let rows = (0..flight.latents)
        .map(|latent| {
            let average = |of: &dyn Fn(&Shown) -> f64| flight.shown.iter().map(of).sum::<f64>() / steps;
            let confidence = flight.shown.first().is_some_and(|shown| shown.trace.confidence.is_some());
            let best = |q: &[f32]| q.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            let mut row = vec![
                latent.to_string(),
                format!("{:.2}", 100.0 * chosen[latent] as f64 / decisions),
                format!("{:.2}", 100.0 * flight.allowed[latent] as f64 / decisions),
                if confidence {
                    format!("{:.4}", average(&|s| s.trace.confidence.as_ref().map_or(0.0, |c| f64::from(c[latent]))))
                } else {
                    "–".to_owned()
                },
                format!("{:.3}", average(&|s| f64::from(best(&s.trace.q) - s.trace.q[latent]))),
            ];
            row.extend((0..shown_slots).map(|slot| {
                let values = flight.shown.iter().map(|s| f64::from(s.trace.actions[latent * slots + slot]));
                summary(&flight.spec.actions[slot], values)
            }));
            row
        })
        .collect();
    report.table("Latents one by one", columns, rows)?;
    let beyond =
        if slots > MOST_SLOTS { format!(" The first {MOST_SLOTS} of {slots} action slots.") } else { String::new() };
    report.text(
        "Reading the table",
        format!(
            "Chosen and allowed: of all decisions. Confidence, Q and actions: means over the first episode; of actions mean ± standard \
             deviation, of types and switches the most frequent value and its share.{beyond}"
        ),
    );
    Ok(())
}

/// Mean ± standard deviation of a continuous slot; the most frequent value of another one with its share.
fn summary(signal: &ActionSignal, values: impl Iterator<Item = f64>) -> String {
    let values: Vec<f64> = values.collect();
    if range(signal).is_some() {
        let average = mean(values.iter().copied());
        let sd = mean(values.iter().map(|value| (value - average).powi(2))).sqrt();
        return format!("{average:.3}\u{a0}±\u{a0}{sd:.3}");
    }
    let mut counts = std::collections::BTreeMap::new();
    for value in &values {
        *counts.entry(*value as u64).or_insert(0u64) += 1;
    }
    let (value, count) = counts.into_iter().max_by_key(|(value, count)| (*count, u64::MAX - value)).unwrap_or_default();
    format!("{value}\u{a0}({:.0}\u{a0}%)", 100.0 * count as f64 / values.len().max(1) as f64)
}

/// Maps over time and latent: what each latent would have done.
fn decoded(report: &mut Report, flight: &Flight) -> Result<(), PageError> {
    let steps = flight.shown.len();
    let columns = steps.min(COLUMNS);
    let at = |column: usize| &flight.shown[column * steps / columns];
    let slots = flight.spec.actions.len();
    let end_s = f64::from(flight.spec.control_period_us) * 1e-6 * steps as f64;
    let time = |column: usize| (column as f64 + 0.5) * end_s / columns as f64;
    let grids: Vec<Map> = flight
        .spec
        .actions
        .iter()
        .take(MOST_SLOTS)
        .enumerate()
        .map(|(slot, signal)| Map {
            x_name: "time (s)".to_owned(),
            y_name: "latent".to_owned(),
            x: 0.0..end_s,
            y: -0.5..flight.latents as f64 - 0.5,
            columns,
            values: (0..flight.latents)
                .flat_map(|latent| {
                    (0..columns).map(move |column| f64::from(at(column).trace.actions[latent * slots + slot]))
                })
                .collect(),
            paint: match range(signal) {
                Some((lo, hi)) => Paint::Scale { name: labelled(&signal.name, &signal.unit), range: lo..hi },
                None => Paint::Index { name: signal.name.clone() },
            },
            marks: (0..columns)
                .map(|column| {
                    let at = (time(column), f64::from(at(column).trace.latent));
                    Mark { at, text: String::new(), shape: Shape::Dot }
                })
                .collect(),
            lines: Vec::new(),
        })
        .collect();
    report.figure(
        "What each latent would have done",
        maps(&grids, &sized(tall(flight.latents)))?,
        format!("Decoded action of every latent along the first episode, at {columns} of its {steps} steps. Circles: chosen."),
    )?;
    Ok(())
}

fn step(report: &mut Report, subject: &Subject, flight: &Flight, shown: &Shown, at: usize) -> Result<(), PageError> {
    let trace = &shown.trace;
    let allowed: Vec<bool> = (0..flight.latents).map(|latent| trace.allowed.contains(latent as u16)).collect();
    let wide = |values: &[f32]| values.iter().map(|&value| f64::from(value)).collect();
    let mut panels = vec![LatentPanel { y_name: "Q (advantage)".to_owned(), values: wide(&trace.q), level: None }];
    if let Some(confidence) = &trace.confidence {
        let level = (f64::from(subject.float.beta), "threshold".to_owned());
        panels.push(LatentPanel { y_name: "confidence".to_owned(), values: wide(confidence), level: Some(level) });
    }
    report.figure(
        format!("Step {at}: Q and confidence by latent"),
        by_latent(&panels, &allowed, usize::from(trace.latent), &sized(260))?,
        "Values of the int8 file. Q is the advantage: the value of the state, the same for every latent, is not exported. The \
         chosen latent is the allowed one with the largest Q.",
    )?;
    let row = |name: &str, unit: &str, value: f32| vec![labelled(name, unit), format!("{value:.5}")];
    let observed = flight.spec.observations.iter().zip(&shown.obs).map(|(s, &x)| row(&s.name, &s.unit, x));
    let acted = flight.spec.actions.iter().zip(&shown.action).map(|(s, &a)| row(&s.name, &s.unit, a));
    let columns = || vec![Column::text("signal"), Column::number("value")];
    report.table(format!("Step {at}: observation"), columns(), observed.collect())?;
    report.table(format!("Step {at}: action of latent {}", trace.latent), columns(), acted.collect())?;
    Ok(())
}

fn encoder(report: &mut Report, subject: &mut Subject, flight: &Flight, shown: &Shown) -> Result<(), PageError> {
    const HEADING: &str = "Which actions share a latent";
    let Some(run) = &mut subject.run else {
        report.text(HEADING, "Not shown: a policy file holds no encoder. Give the run folder instead of the file.");
        return Ok(());
    };
    let slices = regions(&mut run.trained.agent()?.model, &flight.spec, shown);
    if slices.is_empty() {
        report.text(HEADING, "Not shown: no action slot of this environment is continuous.");
        return Ok(());
    }
    for region in &slices {
        report.figure(
            format!("{HEADING}: {}", region.name),
            map(&region_map(flight, shown, region), &sized(if region.axes.1.is_some() { 560 } else { 240 }))?,
            "The same state as above: every raw action of the slice, encoded. Circles: decoded actions of the latents that occur in \
             it, with their numbers. Slots that are not axes are those of the action that was taken.",
        )?;
    }
    Ok(())
}

/// The latents of a slice in native units.
fn region_map(flight: &Flight, shown: &Shown, region: &Region) -> Map {
    let (first, second) = region.axes;
    let slots = flight.spec.actions.len();
    let signal = |slot: usize| &flight.spec.actions[slot];
    let bounds = |slot: usize| range(signal(slot)).unwrap_or((-1.0, 1.0));
    let name = |slot: usize| labelled(&signal(slot).name, &signal(slot).unit);
    let ((x_lo, x_hi), (y_lo, y_hi)) = (bounds(first), second.map_or((0.0, 1.0), bounds));
    let mut present = region.codes.clone();
    present.sort_unstable();
    present.dedup();
    let marks = present.iter().map(|&latent| {
        let action = &shown.trace.actions[latent as usize * slots..][..slots];
        let at = (f64::from(action[first]), second.map_or(0.5, |slot| f64::from(action[slot])));
        Mark { at, text: latent.to_string(), shape: Shape::Dot }
    });
    Map {
        x_name: name(first),
        y_name: second.map_or_else(String::new, name),
        x: x_lo..x_hi,
        y: y_lo..y_hi,
        columns: POINTS,
        values: region.codes.iter().map(|&code| f64::from(code)).collect(),
        paint: Paint::Index { name: "latent".to_owned() },
        marks: marks.collect(),
        lines: Vec::new(),
    }
}

fn quantisation(report: &mut Report, subject: &Subject, flight: &Flight) -> Result<(), PageError> {
    let percent = |error: f64| format!("{:.3}", 100.0 * error);
    let mut columns = vec![Column::text("layer"), Column::number("rounded activations (%)")];
    if subject.run.is_some() {
        columns.insert(1, Column::number("rounded weights (%)"));
        columns.push(Column::number("both (%)"));
    }
    let rows = flight.layers.errors().into_iter().map(|error| {
        let activations = percent(error.activations);
        match (error.weights, error.all) {
            (Some(weights), Some(all)) => vec![error.layer, percent(weights), activations, percent(all)],
            _ => vec![error.layer, activations],
        }
    });
    report.table("Quantisation error by layer", columns, rows.collect())?;
    let weights = if subject.run.is_some() {
        "weights: the file's weights as floats against the networks of the run; "
    } else {
        "the rounding of weights needs the run folder, which has the networks before it; "
    };
    report.text(
        "Reading the errors",
        format!(
            "Root-mean-square difference of a layer's outputs over the first episode, as a share of their root mean square; {weights}\
             activations: the integers against the file's weights as floats. Errors of a layer come on top of those of the layers before \
             it. Layers of the decoder are compared where both choose the same latent."
        ),
    );
    Ok(())
}
