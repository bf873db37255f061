//! `--report` of the commands that run policies.

use std::path::Path;

use gadm_runtime::Policy;
use gadm_sim::report::run::command_line;
use gadm_sim::report::{About, Episode, run_report};
use gadm_sim::scenario::Verdict;
use gadm_sim::sil::read_image;
use gadm_sim::{RunOptions, RunResult, SimError};

/// Writes the report of a run whose first episode was watched.
pub(super) fn write(
    path: &Path,
    options: &RunOptions,
    episode: &Episode,
    result: &RunResult,
    verdict: Option<&Verdict>,
) -> anyhow::Result<()> {
    let image = read_image(&options.policy)?;
    let policy = Policy::load(&image).map_err(SimError::Policy)?;
    let about = About {
        episode,
        verdict,
        command: command_line(std::iter::once("gadm-sim".to_owned()).chain(std::env::args().skip(1))),
        trace: options.trace.as_ref().map(|trace| trace.display().to_string()),
    };
    let html = run_report(result, &policy, &about)?.to_html();
    std::fs::write(path, html).map_err(|source| SimError::Write { path: path.to_owned(), source })?;
    Ok(())
}
