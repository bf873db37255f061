//! The folder of a campaign: whose it is, and a line for each run that ended.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use serde_json::Value;

use super::plan::{Job, Plan};
use super::record::Record;
use super::replace;
use crate::SimError;

pub(super) struct Store {
    path: PathBuf,
    log: File,
    known: Vec<Record>,
}

impl Store {
    /// Opens or makes the folder; refuses one that belongs to another campaign.
    pub(super) fn open(out: &Path, plan: &Plan) -> Result<Self, SimError> {
        let written = |path: &Path| {
            let path = path.to_owned();
            move |source: io::Error| SimError::Write { path, source }
        };
        std::fs::create_dir_all(out).map_err(written(out))?;
        let (whose, path) = (out.join("campaign.json"), out.join("runs.jsonl"));
        match std::fs::read_to_string(&whose) {
            Ok(text) => {
                if serde_json::from_str::<Value>(&text).ok().as_ref() != Some(&plan.identity) {
                    return Err(SimError::Campaign { path: out.to_owned() });
                }
            }
            Err(e) if e.kind() == io::ErrorKind::NotFound => {
                let text = format!("{:#}\n", plan.identity);
                replace(&whose, text.as_bytes()).map_err(written(&whose))?;
            }
            Err(source) => return Err(SimError::Read { path: whose, source }),
        }
        let text = match std::fs::read_to_string(&path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => String::new(),
            Err(source) => return Err(SimError::Read { path, source }),
            Ok(text) => text,
        };
        // A run that failed is tried again; a line that a kill cut short is no record.
        let known: Vec<Record> =
            text.lines().filter_map(|l| serde_json::from_str(l).ok()).filter(|r: &Record| r.error.is_none()).collect();
        let log = OpenOptions::new().create(true).append(true).open(&path).map_err(written(&path))?;
        let mut store = Self { path, log, known };
        if !text.is_empty() && !text.ends_with('\n') {
            store.write(b"\n")?;
        }
        Ok(store)
    }

    /// What an earlier call found for a job.
    pub(super) fn known(&self, job: &Job) -> Option<Record> {
        self.known.iter().rev().find(|r| r.is(job)).cloned()
    }

    /// Adds a record: one write, so that a kill cuts at most this line.
    pub(super) fn append(&mut self, record: &Record) -> Result<(), SimError> {
        let mut line =
            serde_json::to_string(record).map_err(|e| SimError::Write { path: self.path.clone(), source: e.into() })?;
        line.push('\n');
        self.write(line.as_bytes())
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), SimError> {
        self.log.write_all(bytes).map_err(|source| SimError::Write { path: self.path.clone(), source })
    }
}
