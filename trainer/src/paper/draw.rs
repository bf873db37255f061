//! The results of a figure as files: the drawing, the table for people, and both forms of it for programs.

use std::path::{Path, PathBuf};

use super::PaperError;
use super::plan::Plan;
use super::state::survey;
use super::table::Results;
use crate::atomic;
use crate::plot::{CurvePanel, PlotError, PlotOptions, learning_curves};

/// Width and height of a panel, CSS pixels.
const PANEL_PX: (u32, u32) = (420, 400);

/// What was written.
#[derive(Clone, Debug)]
pub struct Written {
    /// The numbers.
    pub results: Results,
    /// The files.
    pub files: Vec<PathBuf>,
}

/// Writes `FIG.svg`, `FIG.md`, `FIG.csv` and `FIG.json` into the folder of results; no drawing where there is no run to draw.
///
/// # Errors
/// [`PaperError::Plot`] for metrics that cannot be read, [`PaperError::Write`].
pub fn write(plan: &Plan, partial: bool) -> Result<Written, PaperError> {
    let results = Results::read(plan, &survey(plan), partial)?;
    std::fs::create_dir_all(&plan.out).map_err(PaperError::io("create", &plan.out))?;
    let json = serde_json::to_string_pretty(&results).expect("numbers and strings serialise");
    let mut files = Vec::new();
    let mut put = |ending: &str, text: &str| -> Result<(), PaperError> {
        let path: &Path = &plan.out.join(format!("{}.{ending}", plan.figure.id));
        atomic::write(path, text.as_bytes())?;
        files.push(path.to_owned());
        Ok(())
    };
    match svg(plan, &results) {
        Ok(svg) => put("svg", &svg)?,
        Err(PlotError::NoData(_)) => {}
        Err(error) => return Err(error.into()),
    }
    put("md", &results.to_markdown())?;
    put("csv", &results.to_csv())?;
    put("json", &format!("{json}\n"))?;
    Ok(Written { results, files })
}

fn svg(plan: &Plan, results: &Results) -> Result<String, PlotError> {
    let figure = plan.figure;
    let tasks = figure.tasks.iter().filter(|task| plan.runs.iter().any(|run| run.shown && run.task.env == task.env));
    let panels: Vec<CurvePanel> =
        tasks.map(|task| CurvePanel { title: task.label.to_owned(), runs: results.curves(task.env) }).collect();
    let names: Vec<&str> = figure.variants.iter().map(|variant| variant.label).collect();
    let title = format!("{}: {}", figure.id, figure.title);
    learning_curves(&panels, &names, &PlotOptions::new(title).with_size(PANEL_PX.0, PANEL_PX.1))
}
