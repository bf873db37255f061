//! Where a run was trained: kept in its folder, because the tree and the machine may be others when it is exported.

use std::path::Path;
use std::process::Command;

use serde::{Deserialize, Serialize};

use crate::atomic;
use crate::config::TrainConfig;
use crate::config::builtin::is_builtin;
use crate::error::TrainError;

/// Name of the file in a run folder.
pub const ORIGIN_FILE: &str = "origin.json";

/// How a training run was started.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Origin {
    /// Commit of the source, with `+dirty` where the tree had changes, or `unknown` outside a repository.
    pub commit: String,
    /// Processor, cores, memory, system.
    pub machine: String,
    /// Whether the settings were those that came with the program of that commit, but for seed and steps. They may be others by
    /// the time of the export. False where a run was started before this was recorded.
    #[serde(default)]
    pub built_in: bool,
}

impl Origin {
    /// Of this moment: the repository around the working folder, this machine, and a run of `config`.
    pub fn here(config: &TrainConfig) -> Self {
        Self { commit: source_commit(), machine: machine(), built_in: is_builtin(config) }
    }

    /// Writes it into a run folder.
    ///
    /// # Errors
    /// [`TrainError::Write`].
    pub fn store(&self, dir: &Path) -> Result<(), TrainError> {
        let text = serde_json::to_string_pretty(self).expect("text and a flag serialise");
        Ok(atomic::write(&dir.join(ORIGIN_FILE), format!("{text}\n").as_bytes())?)
    }

    /// Of a run folder.
    ///
    /// # Errors
    /// [`TrainError::Checkpoint`] where the file is missing or damaged.
    pub fn of_run(dir: &Path) -> Result<Self, TrainError> {
        let path = dir.join(ORIGIN_FILE);
        let bad = |reason: String| TrainError::Checkpoint { path: path.clone(), reason };
        let text =
            std::fs::read_to_string(&path).map_err(|e| bad(format!("cannot be read ({e}); is this a run folder?")))?;
        serde_json::from_str(&text).map_err(|e| bad(format!("is damaged ({e})")))
    }
}

fn source_commit() -> String {
    let git = |args: &[&str]| {
        let out = Command::new("git").args(args).output().ok().filter(|o| o.status.success())?;
        Some(String::from_utf8_lossy(&out.stdout).trim().to_owned())
    };
    match git(&["rev-parse", "--short=12", "HEAD"]) {
        Some(commit) if git(&["status", "--porcelain", "--untracked-files=no"]).is_some_and(|s| s.is_empty()) => commit,
        Some(commit) => format!("{commit}+dirty"),
        None => "unknown".to_owned(),
    }
}

/// Processor, cores and memory of this machine, as Linux tells them.
pub fn machine() -> String {
    let read = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
    let field = |text: &str, key: &str| {
        text.lines().find(|l| l.starts_with(key)).and_then(|l| l.split(':').nth(1)).map(|v| v.trim().to_owned())
    };
    let cpu = field(&read("/proc/cpuinfo"), "model name").unwrap_or_else(|| std::env::consts::ARCH.to_owned());
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let memory = field(&read("/proc/meminfo"), "MemTotal")
        .and_then(|v| v.split_whitespace().next()?.parse::<u64>().ok())
        .map_or_else(String::new, |kib| format!(", {} GiB", kib >> 20));
    format!("{cpu}, {cores} cores{memory}, {}", std::env::consts::OS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_origin_is_read_back_and_a_missing_one_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let text = Origin::of_run(dir.path()).unwrap_err().to_string();
        assert!(text.contains(ORIGIN_FILE) && text.contains("run folder"), "{text}");
        let origin = Origin { built_in: true, ..Origin::here(&TrainConfig::default()) };
        origin.store(dir.path()).unwrap();
        assert_eq!(Origin::of_run(dir.path()).unwrap(), origin);
        std::fs::write(dir.path().join(ORIGIN_FILE), r#"{ "commit": "0123abc", "machine": "x" }"#).unwrap();
        assert!(!Origin::of_run(dir.path()).unwrap().built_in, "of an earlier version");
    }
}
