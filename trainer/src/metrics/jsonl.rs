//! Metrics as JSON lines: one object per record, the environment step first.

use super::{MetricsError, Record, check, keys};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs::{File, OpenOptions};
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Name of the reproducible file inside a run folder.
pub const METRICS_FILE: &str = "metrics.jsonl";
/// Name of the file with rates and wall-clock times inside a run folder.
pub const TIMING_FILE: &str = "timing.jsonl";

/// Appends records to `metrics.jsonl` and their clock-dependent values to `timing.jsonl`.
///
/// A number is written with the fewest digits that read back to the same `f64`; one that is not finite as `null`. Every
/// record is one write of one whole line, so that a killed run leaves at most one torn line.
///
/// # Resuming
/// [`Self::resume`] cuts both files after the last whole record whose step is at most the checkpoint's. A checkpoint of
/// step *s* must therefore be written after every record of step *s*, and after [`Self::sync`]; then an interrupted and
/// resumed run leaves the same bytes in `metrics.jsonl` as an uninterrupted one.
#[derive(Debug)]
pub struct JsonlSink {
    metrics: LineFile,
    timing: LineFile,
    last_step: u64,
}

/// A file that only grows by whole lines.
#[derive(Debug)]
struct LineFile {
    path: PathBuf,
    file: File,
}

impl JsonlSink {
    /// Starts both files in `run_dir`, which must exist.
    ///
    /// # Errors
    /// [`MetricsError::Exists`] if one of them is there already, [`MetricsError::Io`] otherwise.
    pub fn create(run_dir: &Path) -> Result<Self, MetricsError> {
        let start = |name: &str| {
            let path = run_dir.join(name);
            match OpenOptions::new().write(true).create_new(true).open(&path) {
                Ok(file) => Ok(LineFile { path, file }),
                Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => Err(MetricsError::Exists { path }),
                Err(error) => Err(MetricsError::io("create", &path)(error)),
            }
        };
        Ok(Self { metrics: start(METRICS_FILE)?, timing: start(TIMING_FILE)?, last_step: 0 })
    }

    /// Opens both files in `run_dir` and drops what was written after the checkpoint of `step`.
    ///
    /// # Errors
    /// [`MetricsError::BadLine`] if a line before the cut is damaged, [`MetricsError::Io`] otherwise. A missing
    /// `timing.jsonl` is started anew; a missing `metrics.jsonl` is an error unless `step` is 0.
    pub fn resume(run_dir: &Path, step: u64) -> Result<Self, MetricsError> {
        let open = |name: &str, may_be_missing: bool| {
            let path = run_dir.join(name);
            let mut file = OpenOptions::new()
                .read(true)
                .write(true)
                .create(may_be_missing)
                .truncate(false)
                .open(&path)
                .map_err(MetricsError::io("open", &path))?;
            let text = std::fs::read(&path).map_err(MetricsError::io("read", &path))?;
            let (keep, last_step) = cut(&path, &text, step)?;
            file.set_len(keep as u64).map_err(MetricsError::io("truncate", &path))?;
            file.seek(SeekFrom::End(0)).map_err(MetricsError::io("seek in", &path))?;
            Ok((LineFile { path, file }, last_step))
        };
        let (metrics, last_step) = open(METRICS_FILE, step == 0)?;
        let (timing, _) = open(TIMING_FILE, true)?;
        Ok(Self { metrics, timing, last_step })
    }

    /// Appends `record`; a file for which it holds no value gets no line.
    ///
    /// # Errors
    /// An unknown or repeated name, a step before the last record's, or a refusal of the file system.
    pub fn write(&mut self, record: &Record) -> Result<(), MetricsError> {
        check(record)?;
        if record.step < self.last_step {
            return Err(MetricsError::StepWentBack { last: self.last_step, found: record.step });
        }
        self.last_step = record.step;
        let (timing, metrics): (Vec<_>, Vec<_>) = record.values.iter().partition(|(key, _)| keys::is_timing(key));
        self.metrics.append(record.step, &metrics)?;
        self.timing.append(record.step, &timing)
    }

    /// Brings both files to the disk; to be called before a checkpoint is written.
    ///
    /// # Errors
    /// A refusal of the file system.
    pub fn sync(&mut self) -> Result<(), MetricsError> {
        for line_file in [&self.metrics, &self.timing] {
            line_file.file.sync_data().map_err(MetricsError::io("bring to the disk", &line_file.path))?;
        }
        Ok(())
    }
}

impl LineFile {
    fn append(&mut self, step: u64, values: &[(&str, f64)]) -> Result<(), MetricsError> {
        if values.is_empty() {
            return Ok(());
        }
        let line = format_line(step, values);
        self.file.write_all(line.as_bytes()).map_err(MetricsError::io("write", &self.path))
    }
}

/// One record as a JSON line. Names need no escaping: they are from [`keys`].
fn format_line(step: u64, values: &[(&str, f64)]) -> String {
    let mut line = format!("{{\"{}\":{step}", keys::ENV_STEPS);
    for (key, value) in values {
        let number = if value.is_finite() { serde_json::Value::from(*value) } else { serde_json::Value::Null };
        // Writing into a `String` cannot fail.
        let _ = write!(line, ",\"{key}\":{number}");
    }
    line.push_str("}\n");
    line
}

/// Number of bytes to keep for a checkpoint of `step`, and the step of the last kept record.
fn cut(path: &Path, text: &[u8], step: u64) -> Result<(usize, u64), MetricsError> {
    let (mut keep, mut last_step, mut end) = (0, 0, 0);
    let mut damaged: Option<MetricsError> = None;
    for (i, line) in text.split_inclusive(|&byte| byte == b'\n').enumerate() {
        end += line.len();
        if !line.ends_with(b"\n") {
            break;
        }
        match parse_line(path, i + 1, line) {
            Ok((found, _)) if found > step => break,
            Ok((found, _)) => {
                // A damaged tail is dropped; damage in what must be kept is not.
                if let Some(error) = damaged {
                    return Err(error);
                }
                (keep, last_step) = (end, found);
            }
            Err(error) => damaged = damaged.or(Some(error)),
        }
    }
    Ok((keep, last_step))
}

/// A record read back: environment step and values by name; `null` is NaN.
pub type ReadRecord = (u64, BTreeMap<String, f64>);

/// Reads `metrics.jsonl` or `timing.jsonl`. A torn last line, as a running or killed run leaves it, is passed over.
///
/// # Errors
/// [`MetricsError::Io`] or, for a whole line that is no record, [`MetricsError::BadLine`].
pub fn read_jsonl(path: &Path) -> Result<Vec<ReadRecord>, MetricsError> {
    let text = std::fs::read(path).map_err(MetricsError::io("read", path))?;
    text.split_inclusive(|&byte| byte == b'\n')
        .enumerate()
        .filter(|(_, line)| line.ends_with(b"\n"))
        .map(|(i, line)| parse_line(path, i + 1, line))
        .collect()
}

fn parse_line(path: &Path, line_number: usize, line: &[u8]) -> Result<ReadRecord, MetricsError> {
    let bad = |reason: String| MetricsError::BadLine { path: path.to_path_buf(), line: line_number, reason };
    let mut object: serde_json::Map<String, serde_json::Value> =
        serde_json::from_slice(line).map_err(|error| bad(error.to_string()))?;
    let step = object
        .shift_remove(keys::ENV_STEPS)
        .and_then(|value| value.as_u64())
        .ok_or_else(|| bad(format!("`{}` is missing or not a whole number", keys::ENV_STEPS)))?;
    let values = object
        .into_iter()
        .map(|(key, value)| match value {
            serde_json::Value::Null => Ok((key, f64::NAN)),
            serde_json::Value::Number(number) => Ok((key, number.as_f64().unwrap_or(f64::NAN))),
            other => Err(bad(format!("`{key}` must be a number, found {other}"))),
        })
        .collect::<Result<_, _>>()?;
    Ok((step, values))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(step: u64) -> Record {
        let loss = 1.0 / (step as f64 + 3.0);
        Record::new(step).with(keys::Q_LOSS, loss).with(keys::ENV_STEPS_PER_S, 5.0).with(keys::CODES_USED, 7.0)
    }

    fn metrics(folder: &Path) -> String {
        std::fs::read_to_string(folder.join(METRICS_FILE)).unwrap()
    }

    #[test]
    fn lines_are_literal_and_time_goes_to_its_own_file() {
        let folder = tempfile::tempdir().unwrap();
        let mut sink = JsonlSink::create(folder.path()).unwrap();
        sink.write(
            &Record::new(10)
                .with(keys::Q_LOSS, 0.1)
                .with(keys::WALL_S, 2.5)
                .with(keys::CODES_USED, 16.0)
                .with(keys::EVAL_RETURN_SD, f64::NAN),
        )
        .unwrap();
        sink.write(&Record::new(10).with(keys::WALL_S, 1e-7)).unwrap();
        let expected = "{\"env_steps\":10,\"q_loss\":0.1,\"codes_used\":16.0,\"eval_return_sd\":null}\n";
        assert_eq!(metrics(folder.path()), expected);
        let timing = std::fs::read_to_string(folder.path().join(TIMING_FILE)).unwrap();
        assert_eq!(timing, "{\"env_steps\":10,\"wall_s\":2.5}\n{\"env_steps\":10,\"wall_s\":1e-7}\n");
    }

    #[test]
    fn numbers_read_back_bit_for_bit() {
        let folder = tempfile::tempdir().unwrap();
        let mut sink = JsonlSink::create(folder.path()).unwrap();
        let values = [1.0 / 3.0, f64::MIN_POSITIVE, 5e-324, -0.0, f64::MAX, 0.1f32 as f64, 123456789.125];
        for (step, value) in values.iter().enumerate() {
            sink.write(&Record::new(step as u64).with(keys::Q_MEAN, *value)).unwrap();
        }
        let read = read_jsonl(&folder.path().join(METRICS_FILE)).unwrap();
        let bits: Vec<u64> = read.iter().map(|(_, values)| values[keys::Q_MEAN].to_bits()).collect();
        assert_eq!(bits, values.map(f64::to_bits));
    }

    #[test]
    fn interrupted_and_resumed_leaves_the_bytes_of_an_uninterrupted_run() {
        let (whole, parts) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let mut sink = JsonlSink::create(whole.path()).unwrap();
        (0..10).for_each(|i| sink.write(&record(i * 100)).unwrap());

        // Killed while writing the record of step 800; the last checkpoint is of step 500.
        let mut sink = JsonlSink::create(parts.path()).unwrap();
        (0..8).for_each(|i| sink.write(&record(i * 100)).unwrap());
        drop(sink);
        let mut file = OpenOptions::new().append(true).open(parts.path().join(METRICS_FILE)).unwrap();
        file.write_all(b"{\"env_steps\":800,\"q_lo").unwrap();
        drop(file);
        let mut sink = JsonlSink::resume(parts.path(), 500).unwrap();
        (6..10).for_each(|i| sink.write(&record(i * 100)).unwrap());

        assert_eq!(metrics(parts.path()), metrics(whole.path()));
    }

    #[test]
    fn resuming_keeps_every_record_of_the_checkpoints_own_step() {
        let folder = tempfile::tempdir().unwrap();
        let mut sink = JsonlSink::create(folder.path()).unwrap();
        for step in [100, 200, 200, 300] {
            sink.write(&record(step)).unwrap();
        }
        drop(sink);
        let before = metrics(folder.path());
        JsonlSink::resume(folder.path(), 200).unwrap();
        let expected: String = before.split_inclusive('\n').take(3).collect();
        assert_eq!(metrics(folder.path()), expected);
    }

    #[test]
    fn a_damaged_line_is_dropped_in_the_tail_and_refused_before_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(METRICS_FILE);
        let (first, second) = ("{\"env_steps\":1,\"q_loss\":1.0}\n", "{\"env_steps\":2,\"q_loss\":1.0}\n");
        std::fs::write(&path, format!("{first}\0\0\0\n{second}")).unwrap();
        JsonlSink::resume(folder.path(), 1).unwrap();
        assert_eq!(metrics(folder.path()), first);
        std::fs::write(&path, format!("{first}\0\0\0\n{second}")).unwrap();
        let error = JsonlSink::resume(folder.path(), 2).unwrap_err();
        assert!(matches!(error, MetricsError::BadLine { line: 2, .. }), "{error}");
    }

    #[test]
    fn refuses_an_existing_run_a_missing_run_and_bad_records() {
        let folder = tempfile::tempdir().unwrap();
        let error = JsonlSink::resume(folder.path(), 5).unwrap_err();
        assert!(error.to_string().contains(METRICS_FILE), "{error}");
        let mut sink = JsonlSink::create(folder.path()).unwrap();
        assert!(matches!(JsonlSink::create(folder.path()), Err(MetricsError::Exists { .. })));
        let unknown = sink.write(&Record::new(1).with("q_los", 0.0));
        assert!(matches!(unknown, Err(MetricsError::UnknownKey { key: "q_los", .. })));
        let twice = sink.write(&Record::new(1).with(keys::Q_LOSS, 0.0).with(keys::Q_LOSS, 0.0));
        assert!(matches!(twice, Err(MetricsError::DuplicateKey { .. })));
        sink.write(&record(7)).unwrap();
        assert!(matches!(sink.write(&record(6)), Err(MetricsError::StepWentBack { last: 7, found: 6 })));
    }
}
