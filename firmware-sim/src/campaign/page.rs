//! The report of a campaign.

use super::{Campaign, Options, Tally, heat};
use crate::report::{Cell, Mark, Page};
use crate::scenario::Scenario;

pub(super) fn html(found: &Campaign, scenario: &Scenario, options: &Options) -> String {
    let mut page = Page::new(format!("Campaign {}", found.name));
    let missed = found.records.iter().filter(|r| !r.passed).count();
    let runs = found.records.len();
    page.lead(format!(
        "{} faults of `{}`, each on its own, {} runs of {} episodes",
        scenario.faults.len(),
        scenario.policy.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned()),
        runs,
        scenario.episodes
    ));
    let words = format!("{} of {runs} runs met their criteria", runs - missed);
    page.verdict(Mark::of(missed == 0), words);
    let injected: u64 = found.records.iter().map(|r| r.injected).sum();
    page.verdict(Mark::Note, format!("{injected} faults injected; a run without any fails"));
    let wrong: Vec<_> = found.records.iter().filter(|r| !r.passed).collect();
    if !wrong.is_empty() {
        page.section("Missed").table(
            ["run", "what"],
            wrong.iter().map(|r| {
                let what = r.error.clone().unwrap_or_else(|| r.missed.join("; "));
                vec![Cell::text(r.name()), Cell::text(what).marked(Mark::Missed)]
            }),
        );
    }
    if !scenario.description.is_empty() {
        page.section("What it is about").text(scenario.description.clone());
    }
    let rows = heat::rows(found);
    let columns = rows.iter().map(|(_, cells)| cells.len()).max().unwrap_or(0);
    let names = std::iter::once("fault".to_owned()).chain((1..=columns).map(|i| format!("intensity {i}")));
    page.section("Return against nominal").table(
        names,
        rows.iter().map(|(fault, cells)| {
            std::iter::once(Cell::text(*fault)).chain(cells.iter().map(|t| heat_cell(t))).collect()
        }),
    );
    page.text("The share of the nominal return that is left, and the intensity in brackets; the stronger the colour, the more is lost. \
         ✗: a criterion was missed.");
    page.section("Faults").table(
        [
            "fault",
            "intensity",
            "runs met",
            "injected",
            "noticed",
            "after periods",
            "made safe",
            "after periods",
            "worst action error",
            "oldest action",
            "return",
            "of nominal",
        ],
        found.tallies.iter().map(row),
    );
    page.text(
        "The share of the episodes with a fault in which it was noticed, or led to the safe action, and how long that took. An \
         episode may end before. Times are the longest of all episodes, in control periods from the first injected fault on. The action error is the \
         largest distance of an applied action from the policy's decision on the true observation, as a share of its range. \
         The oldest action is the longest row of periods with neither a new decision nor a safe action.",
    );
    page.section("Command to repeat").code(options.command.clone());
    page.to_html()
}

fn heat_cell(t: &Tally) -> Cell {
    let left = t.return_ratio.map_or_else(|| "–".to_owned(), |r| format!("{:.0} %", r * 100.0));
    let missed = if t.passed < t.runs { " ✗" } else { "" };
    Cell::number(format!("{left} ({}){missed}", t.intensity)).shaded(lost(t))
}

/// The part of the nominal return that is lost; not a number where there is none to compare with.
fn lost(t: &Tally) -> f64 {
    1.0 - t.return_ratio.unwrap_or(f64::NAN)
}

fn row(t: &Tally) -> Vec<Cell> {
    let count = |v: Option<u64>| Cell::number(v.map_or_else(|| "–".to_owned(), |v| v.to_string()));
    let share = |v: Option<f64>| Cell::number(v.map_or_else(|| "–".to_owned(), |v| format!("{:.0} %", v * 100.0)));
    vec![
        Cell::text(t.fault.clone()),
        Cell::text(t.intensity.clone()),
        Cell::number(format!("{}/{}", t.passed, t.runs)).marked(Mark::of(t.passed == t.runs)),
        Cell::number(t.injected.to_string()),
        share(t.detected),
        count(t.time_to_detect),
        share(t.made_safe),
        count(t.time_to_safe),
        Cell::number(format!("{:.1} %", t.worst_action_error * 100.0)),
        Cell::number(t.max_action_age.to_string()),
        Cell::number(format!("{:.1}", t.mean_return)),
        share(t.return_ratio).shaded(lost(t)),
    ]
}
