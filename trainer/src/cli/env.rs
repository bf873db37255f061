//! `gadm env`.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Subcommand;
use gadm_envs::golden;
use gadm_trainer::config::AlgorithmName;
use gadm_trainer::config::builtin::builtin;
use serde_json::json;

use super::{CRITERIA_MISSED, print, print_json, say};

/// What to do with environments.
#[derive(Subcommand)]
pub enum Command {
    /// List environments with their sizes
    List {
        /// Print as JSON
        #[arg(long)]
        json: bool,
    },
    /// Replay recorded trajectories; exit code 3 beyond the tolerance
    Check {
        /// Recordings (.json.gz)
        #[arg(required = true)]
        files: Vec<PathBuf>,
        /// Print as JSON
        #[arg(long)]
        json: bool,
    },
}

/// Runs `env`.
pub fn main(command: &Command) -> anyhow::Result<ExitCode> {
    match command {
        Command::List { json } => list(*json),
        Command::Check { files, json } => check(files, *json),
    }
}

fn list(as_json: bool) -> anyhow::Result<ExitCode> {
    let mut rows = Vec::new();
    let mut text = vec![format!(
        "{:22} {:>6} {:>7} {:>11} {:>10}  {}",
        "environment", "inputs", "actions", "period (µs)", "time limit", "built-in configuration"
    )];
    for id in gadm_envs::ids() {
        match gadm_envs::make(id) {
            Ok(env) => {
                let spec = env.spec();
                let limit = spec.time_limit.map_or_else(|| "own".to_owned(), |l| l.to_string());
                let config = if builtin(AlgorithmName::default().id(), id).is_some() { "yes" } else { "-" };
                text.push(format!(
                    "{id:22} {:>6} {:>7} {:>11} {limit:>10}  {config}",
                    spec.obs_dim(),
                    spec.action_dim(),
                    spec.control_period_us
                ));
                rows.push(json!({
                    "id": id, "obs_dim": spec.obs_dim(), "action_dim": spec.action_dim(),
                    "control_period_us": spec.control_period_us, "time_limit": spec.time_limit,
                    "builtin_config": builtin(AlgorithmName::default().id(), id).is_some(),
                }));
            }
            Err(error) => {
                text.push(format!("{id:22} not available: {error}"));
                rows.push(json!({ "id": id, "error": error.to_string() }));
            }
        }
    }
    if as_json {
        print_json(&rows)?;
    } else {
        print(&text.join("\n"))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn check(files: &[PathBuf], as_json: bool) -> anyhow::Result<ExitCode> {
    let mut reports = Vec::new();
    let mut passed = true;
    for file in files {
        let report = golden::check(file)?;
        let name = file.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
        let differences: Vec<String> = report
            .comparisons
            .iter()
            .map(|c| format!("{} {:.1e} (limit {:.0e})", c.quantity, c.largest, c.tolerance))
            .collect();
        let flag = report.first_flag.as_ref().map_or_else(
            || "flags equal".to_owned(),
            |f| format!("`{}` differs first in {} step {}", f.flag, f.at.trajectory, f.at.step),
        );
        say(&format!(
            "{} {name}: {} trajectories, {} steps; largest differences: {}; {flag}",
            if report.passed() { "ok  " } else { "FAIL" },
            report.trajectories,
            report.steps,
            differences.join(", ")
        ));
        passed &= report.passed();
        let mut value = serde_json::to_value(&report)?;
        value["passed"] = json!(report.passed());
        reports.push(value);
    }
    if as_json {
        print_json(&json!({ "version": 1, "passed": passed, "reports": reports }))?;
    }
    Ok(if passed { ExitCode::SUCCESS } else { ExitCode::from(CRITERIA_MISSED) })
}
