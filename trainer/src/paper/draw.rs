//! The results of a figure as files: the drawing, the tables for people, and both forms of them for programs.

use std::path::{Path, PathBuf};

use super::figure::View;
use super::plan::Plan;
use super::state::survey;
use super::table::Results;
use super::{PaperError, flights, landing, toy};
use crate::atomic;
use crate::plot::curve::RETURN;
use crate::plot::{CloudAxes, CurvePanel, PlotError, PlotOptions, RunCurve, clouds, learning_curves};

/// Width and height of a panel, CSS pixels.
const PANEL_PX: (u32, u32) = (420, 400);
/// The same for one of many.
const SMALL_PANEL_PX: (u32, u32) = (310, 310);

/// What was written.
#[derive(Clone, Debug)]
pub struct Written {
    /// The numbers.
    pub results: Results,
    /// The files.
    pub files: Vec<PathBuf>,
}

/// Writes `FIG.svg`, `FIG.md`, `FIG.csv`, a `FIG-TABLE.csv` for every further table, and `FIG.json` into the folder of results; no
/// drawing where there is no run to draw. What is drawn of snapshots flies episodes, once for each.
///
/// # Errors
/// [`PaperError::Plot`] for metrics that cannot be read, [`PaperError::Train`] for networks, [`PaperError::Write`].
pub fn write(plan: &Plan, partial: bool) -> Result<Written, PaperError> {
    let mut results = Results::read(plan, &survey(plan), partial)?;
    std::fs::create_dir_all(&plan.out).map_err(PaperError::io("create", &plan.out))?;
    let svg = drawing(plan, &mut results, partial)?;
    let mut files = Vec::new();
    let mut put = |ending: &str, text: &str| -> Result<(), PaperError> {
        let path: &Path = &plan.out.join(format!("{}{ending}", plan.figure.id));
        atomic::write(path, text.as_bytes())?;
        files.push(path.to_owned());
        Ok(())
    };
    match svg {
        Ok(svg) => put(".svg", &svg)?,
        Err(PlotError::NoData(_)) => {}
        Err(error) => return Err(error.into()),
    }
    put(".md", &results.to_markdown())?;
    if !results.rows.is_empty() {
        put(".csv", &results.to_csv())?;
    }
    for table in &results.tables {
        put(&format!("-{}.csv", table.id), &table.to_csv())?;
    }
    let json = serde_json::to_string_pretty(&results).expect("numbers and strings serialise");
    put(".json", &format!("{json}\n"))?;
    Ok(Written { results, files })
}

/// What the figure shows; puts the tables that belong to it into `results`.
fn drawing(plan: &Plan, results: &mut Results, partial: bool) -> Result<Result<String, PlotError>, PaperError> {
    Ok(match plan.figure.view {
        View::Returns => curves(plan, results, None),
        View::NoOps => {
            let found = flights::gather(plan, partial)?;
            results.tables.push(flights::table(&found));
            curves(plan, results, Some(flights::no_op_curves(&found)))
        }
        View::Paths => {
            let found = flights::gather(plan, partial)?;
            results.tables.push(flights::table(&found));
            let panels = flights::paths(plan, &found);
            clouds(&panels, flights::steps(plan).len(), &flights::classes(), &pad(), &options(plan, SMALL_PANEL_PX))
        }
        View::Landing => match landing::landing(plan, results)? {
            Some(landing) => {
                results.tables.push(landing::table(&landing));
                landing::figure(plan, &landing)
            }
            None => Err(PlotError::NoData("no run is done")),
        },
        View::Toy { state } => {
            // Nothing acts in these runs: their returns mean nothing.
            results.rows.clear();
            let (learned, regions) = toy::learned(plan, state)?;
            results.tables.push(toy::table(state, &learned));
            toy::figure(plan, state, &learned, &regions)
        }
    })
}

/// Around the pad of LunarLander (specification 8.7).
fn pad() -> CloudAxes {
    let name = |text: &str| text.to_owned();
    CloudAxes { x_name: name("position x"), y_name: name("position y"), x: -1.0..1.0, y: 0.0..2.0 }
}

fn options(plan: &Plan, (width, height): (u32, u32)) -> PlotOptions {
    PlotOptions::new(format!("{}: {}", plan.figure.id, plan.figure.title)).with_size(width, height)
}

/// Returns of every environment, and the share of no-ops beside them.
fn curves(plan: &Plan, results: &Results, no_ops: Option<Vec<RunCurve>>) -> Result<String, PlotError> {
    let figure = plan.figure;
    let tasks = figure.tasks.iter().filter(|task| plan.runs.iter().any(|run| run.shown && run.task.env == task.env));
    let panel = |title: &str, y_name, runs| CurvePanel { title: title.to_owned(), y_name, runs };
    let mut panels: Vec<CurvePanel> = tasks.map(|task| panel(task.label, RETURN, results.curves(task.env))).collect();
    panels.extend(no_ops.map(|runs| panel("No engine asked for", "share of steps (%)", runs)));
    let names: Vec<&str> = figure.variants.iter().map(|variant| variant.label).collect();
    learning_curves(&panels, &names, &options(plan, PANEL_PX))
}

#[cfg(test)]
#[path = "draw_tests.rs"]
mod tests;
