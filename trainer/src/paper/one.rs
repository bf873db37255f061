//! One run of a figure, from wherever it stands to its end.
//!
//! Whoever is told to do a run may be told again, at the same time, elsewhere: by a second command, or by a cluster that lost a
//! worker and not its process. The lock of the run folder decides; the others wait for it and look again.

use std::fs::{File, TryLockError};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::PaperError;
use super::figure::{Expert, Source};
use super::plan::{Plan, PlannedRun};
use super::state::{State, inspect, stored};
use super::toy;
use crate::config::TrainConfig;
use crate::error::TrainError;
use crate::metrics::jsonl::{METRICS_FILE, TIMING_FILE};
use crate::runner::checkpoint::{self, Networks, load_trained, save_pairs};
use crate::runner::origin::ORIGIN_FILE;
use crate::runner::progress::Style;
use crate::runner::train::{CONFIG_FILE, LOCK_FILE, in_use};
use crate::runner::{TrainOptions, evaluate_recorded, train};
use crate::seed::SeedTree;

/// Time between two looks at a folder that another process uses.
const LOOK_AGAIN: Duration = Duration::from_millis(500);

/// How the names begin of what a run has in its folder before its first checkpoint.
const OF_A_RUN: [&str; 8] =
    [CONFIG_FILE, LOCK_FILE, ORIGIN_FILE, METRICS_FILE, TIMING_FILE, checkpoint::FOLDER, "events.", ".gadm-"];

/// How it went.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// All its steps are done, now or before.
    Complete,
    /// It was stopped; a checkpoint is written.
    Interrupted,
}

/// Brings the run of that index to its end, after the expert that it needs.
///
/// # Errors
/// [`PaperError::NoSuchRun`], [`PaperError::OtherConfiguration`], and those of training.
pub fn run_one(plan: &Plan, index: usize, style: Style, stop: &AtomicBool) -> Result<Ended, PaperError> {
    let run = plan.run(index)?;
    if let (Some(path), Some(source)) = (&run.data, &plan.figure.data)
        && inspect(run).state != State::Done
        && !path.exists()
    {
        match (source, plan.expert_of(run)) {
            (Source::Expert(by), Some(at)) => {
                let expert = plan.run(at)?;
                if train_to_end(expert, style, stop)? == Ended::Interrupted
                    || record(expert, by, path, stop)? == Ended::Interrupted
                {
                    return Ok(Ended::Interrupted);
                }
            }
            (Source::Toy { per_state }, _) => toy::record(path, *per_state, run.seed)?,
            (Source::Expert(_), None) => {}
        }
    }
    train_to_end(run, style, stop)
}

fn train_to_end(run: &PlannedRun, style: Style, stop: &AtomicBool) -> Result<Ended, PaperError> {
    let mut waiting = false;
    while !stop.load(Ordering::Relaxed) {
        match inspect(run).state {
            State::Done => return Ok(Ended::Complete),
            State::Other(detail) => return Err(PaperError::OtherConfiguration { path: run.dir.clone(), detail }),
            State::Missing | State::Partial => {}
        }
        let resume = checkpoint::path(&run.dir, checkpoint::LAST).exists();
        let config = if resume { continued(run)? } else { run.config.clone() };
        if !resume {
            clear_unstarted(&run.dir)?;
        }
        match train(&TrainOptions { config: Some(config), dir: run.dir.clone(), resume, style, stop }) {
            Ok(outcome) if outcome.interrupted => break,
            Ok(_) => return Ok(Ended::Complete),
            Err(TrainError::RunLocked { .. } | TrainError::RunExists { .. }) => {
                if !waiting {
                    tracing::info!("{}: another process is at it, waiting", run.name);
                }
                waiting = true;
                std::thread::sleep(LOOK_AGAIN);
            }
            Err(error) => return Err(error.into()),
        }
    }
    Ok(Ended::Interrupted)
}

/// The stored configuration of a run with the steps and snapshots that are wanted now.
fn continued(run: &PlannedRun) -> Result<TrainConfig, PaperError> {
    let path = run.dir.join(CONFIG_FILE);
    let text = std::fs::read_to_string(&path).map_err(PaperError::io("read", &path))?;
    let config = stored(&text).map_err(|detail| PaperError::OtherConfiguration { path: run.dir.clone(), detail })?;
    let mut config = TrainConfig { steps: run.steps, ..config };
    config.track.snapshots.clone_from(&run.config.track.snapshots);
    config.track.average = run.config.track.average;
    Ok(config)
}

/// Removes what a process left that was killed between making the folder and its first checkpoint: nothing was learned in it.
fn clear_unstarted(dir: &Path) -> Result<(), PaperError> {
    if !dir.exists() || in_use(dir) {
        return Ok(());
    }
    // Another process may be that far at this moment: give it the time to take the lock or to write the checkpoint.
    std::thread::sleep(LOOK_AGAIN);
    if in_use(dir) || checkpoint::path(dir, checkpoint::LAST).exists() {
        return Ok(());
    }
    for entry in std::fs::read_dir(dir).map_err(PaperError::io("read", dir))? {
        let name = entry.map_err(PaperError::io("read", dir))?.file_name().to_string_lossy().into_owned();
        if !OF_A_RUN.iter().any(|start| name.starts_with(start)) {
            let detail = format!("`{name}` is no part of a run");
            return Err(PaperError::OtherConfiguration { path: dir.to_owned(), detail });
        }
    }
    std::fs::remove_dir_all(dir).map_err(PaperError::io("remove the beginning of a run in", dir))
}

/// Lets the expert's best policy play and writes what it did in its best episodes to `path`.
fn record(run: &PlannedRun, by: &Expert, path: &Path, stop: &AtomicBool) -> Result<Ended, PaperError> {
    let folder = path.parent().unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder).map_err(PaperError::io("create", folder))?;
    let lock_path = path.with_extension("lock");
    let lock = File::create(&lock_path).map_err(PaperError::io("create", &lock_path))?;
    loop {
        match lock.try_lock() {
            Ok(()) => break,
            Err(TryLockError::WouldBlock) if stop.load(Ordering::Relaxed) => return Ok(Ended::Interrupted),
            Err(TryLockError::WouldBlock) => std::thread::sleep(LOOK_AGAIN),
            Err(TryLockError::Error(source)) => return Err(PaperError::io("lock", &lock_path)(source)),
        }
    }
    if path.exists() {
        return Ok(Ended::Complete);
    }
    let mut expert = load_trained(&run.dir, Networks::Best)?;
    let env = || gadm_envs::make_with(&run.config.env, &run.config.env_options).map_err(TrainError::from);
    let envs = (0..by.episodes).map(|_| env()).collect::<Result<Vec<_>, _>>()?;
    let spec = envs[0].spec().clone();
    // Episodes that neither training nor evaluation has seen.
    let seed = SeedTree::new(run.seed).number("paper.expert");
    let (evaluation, pairs) = evaluate_recorded(expert.actor(), envs, seed);
    let best = best_episodes(&evaluation.returns, by.keep);
    let obs: Vec<f32> = best.iter().flat_map(|&i| &pairs[i].0).copied().collect();
    let actions: Vec<f32> = best.iter().flat_map(|&i| &pairs[i].1).copied().collect();
    save_pairs(path, (&obs, spec.obs_dim()), (&actions, spec.action_dim()))?;
    tracing::info!(
        "{}: wrote {}, {} pairs of {} episodes that return {:.1} or more",
        run.name,
        path.display(),
        obs.len() / spec.obs_dim(),
        best.len(),
        best.iter().map(|&i| evaluation.returns[i]).fold(f64::INFINITY, f64::min)
    );
    Ok(Ended::Complete)
}

/// Indices of the `keep` highest returns, in order of the episodes.
fn best_episodes(returns: &[f64], keep: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..returns.len()).collect();
    order.sort_by(|&a, &b| returns[b].total_cmp(&returns[a]));
    order.truncate(keep);
    order.sort_unstable();
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_episodes_are_kept_in_their_order() {
        assert_eq!(best_episodes(&[3.0, 9.0, 1.0, 9.0, 5.0], 3), [1, 3, 4]);
        assert_eq!(best_episodes(&[2.0], 5), [0]);
    }

    #[test]
    fn the_beginning_of_a_run_is_cleared_and_a_run_is_not() {
        let out = tempfile::tempdir().unwrap();
        let (begun, kept, mine) = (out.path().join("begun"), out.path().join("kept"), out.path().join("mine"));
        for dir in [&begun, &kept, &mine] {
            std::fs::create_dir_all(dir.join(checkpoint::FOLDER)).unwrap();
            std::fs::write(dir.join(CONFIG_FILE), "").unwrap();
        }
        std::fs::write(checkpoint::path(&kept, checkpoint::LAST), "").unwrap();
        std::fs::write(mine.join("thesis.txt"), "").unwrap();
        assert!(clear_unstarted(&mine).unwrap_err().to_string().contains("`thesis.txt`"));
        clear_unstarted(&begun).unwrap();
        clear_unstarted(&kept).unwrap();
        clear_unstarted(&out.path().join("absent")).unwrap();
        assert!(!begun.exists() && kept.exists() && mine.join("thesis.txt").exists());
    }
}
