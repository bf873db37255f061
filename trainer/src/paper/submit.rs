//! The runs of a figure as a job array: HyperQueue or Slurm start `gadm paper run FIG INDEX` for every run that is not done.
//!
//! Each task brings its run to the end from wherever it stands, so that a task may be killed and started again, elsewhere too,
//! as long as all machines see the same folder.

use std::ffi::OsStr;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use super::PaperError;
use super::plan::Plan;
use super::state::{State, inspect};
use crate::atomic;

/// Who runs the array.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scheduler {
    /// HyperQueue: `hq submit --array`, or its Python package where there is no `hq`.
    Hq,
    /// Slurm: `sbatch --array`.
    Slurm,
}

/// A job array that is written and not yet submitted.
#[derive(Clone, Debug)]
pub struct Array {
    /// Indices of the runs that are not done.
    pub indices: Vec<usize>,
    /// What a task is: a shell script that takes the index from the scheduler.
    pub script: PathBuf,
    /// Its text.
    pub text: String,
    /// The list of runs: index, state, name, command.
    pub list: PathBuf,
    /// The command that submits it.
    pub command: Vec<String>,
    /// The text of the program that submits it, where that is one of ours.
    pub client: Option<(PathBuf, String)>,
}

/// A word as a shell takes it.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=,:+%@".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', "'\\''"))
    }
}

fn line(words: &[String]) -> String {
    words.iter().map(|word| quoted(word)).collect::<Vec<_>>().join(" ")
}

/// `0-3,7`.
fn ranges(indices: &[usize]) -> String {
    let mut parts: Vec<(usize, usize)> = Vec::new();
    for &index in indices {
        match parts.last_mut() {
            Some((_, last)) if *last + 1 == index => *last = index,
            _ => parts.push((index, index)),
        }
    }
    let text = parts.iter().map(|(a, b)| if a == b { a.to_string() } else { format!("{a}-{b}") });
    text.collect::<Vec<_>>().join(",")
}

/// Whether a program of that name is on the path.
fn on_path(program: &str) -> bool {
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).any(|folder| folder.join(program).is_file())
}

/// HyperQueue's Python package brings server, worker and client, and no `hq`: this is the client's call for an array.
const PYTHON_CLIENT: &str = r#"# Submits the tasks of a figure to a HyperQueue server: python3 submit.py NAME SCRIPT LOGS THREADS INDEX...
# The server's folder is that of HQ_SERVER_DIR, else HyperQueue's own.
import os
import sys
from pathlib import Path

from hyperqueue import Client, Job
from hyperqueue.ffi.protocol import ResourceRequest

name, script, logs, threads, *indices = sys.argv[1:]
server = os.environ.get("HQ_SERVER_DIR")
job = Job(max_fails=None)
for index in indices:
    out = str(Path(logs) / f"task-{index}.log")
    job.program(
        ["sh", script],
        env={"GADM_INDEX": index},
        name=f"{name}-{index}",
        stdout=out,
        stderr=out + ".err",
        resources=ResourceRequest(cpus=int(threads)),
    )
submitted = Client(Path(server) if server else None).submit(job)
print(f"job {submitted.id}: {len(indices)} tasks")
"#;

/// The array of what is not done in `plan`; `run` are the words of the command of a run, its index left out (it is appended).
///
/// # Errors
/// [`PaperError::Submit`] where nothing is left to do.
pub fn array(plan: &Plan, scheduler: Scheduler, run: &[String], threads: usize) -> Result<Array, PaperError> {
    let states: Vec<State> = plan.runs.iter().map(|run| inspect(run).state).collect();
    let left = |i: &usize| !matches!(states[*i], State::Done);
    let indices: Vec<usize> = (0..plan.runs.len()).filter(left).collect();
    let (figure, folder) = (plan.figure.id, plan.out.join("jobs").join(plan.figure.id));
    if indices.is_empty() {
        let reason = format!("every run is done; `gadm paper {figure}` draws the figure");
        return Err(PaperError::Submit { command: format!("gadm paper {figure} --submit"), reason });
    }
    let (name, logs) = (format!("gadm-{figure}"), folder.join("logs").display().to_string());
    let script = folder.join("task.sh");
    let text = match scheduler {
        Scheduler::Hq => hq_script(figure, run),
        Scheduler::Slurm => slurm_script(figure, run, &name, &logs, threads),
    };
    let words = |words: &[&str]| words.iter().map(|word| (*word).to_owned()).collect::<Vec<_>>();
    let file = script.display().to_string();
    let (array, cpus) = (ranges(&indices), threads.to_string());
    let mut client = None;
    let command = match scheduler {
        Scheduler::Slurm => words(&["sbatch", "--array", &array, &file]),
        Scheduler::Hq if on_path("hq") => {
            let out = format!("{logs}/task-%{{TASK_ID}}.log");
            let options = ["hq", "submit", "--array", &array, "--name", &name, "--cpus", &cpus];
            let streams = ["--stdout", &out, "--stderr", &format!("{out}.err"), "--", "sh", &file];
            [words(&options), words(&streams)].concat()
        }
        Scheduler::Hq => {
            let path = folder.join("submit.py");
            let mut command = words(&["python3", &path.display().to_string(), &name, &file, &logs, &cpus]);
            command.extend(indices.iter().map(ToString::to_string));
            client = Some((path, PYTHON_CLIENT.to_owned()));
            command
        }
    };
    Ok(Array { indices, script, text, list: folder.join("runs.tsv"), command, client })
}

fn hq_script(figure: &str, run: &[String]) -> String {
    format!(
        "#!/bin/sh\n# One run of {figure}; HyperQueue gives the index (its Python client under our own name).\n\
         set -eu\nexec {} \"${{HQ_TASK_ID-$GADM_INDEX}}\"\n",
        line(run)
    )
    // Tasks of the Python client have numbers of their own: what it sets comes first.
    .replace("${HQ_TASK_ID-$GADM_INDEX}", "${GADM_INDEX-$HQ_TASK_ID}")
}

/// `--signal` asks for a checkpoint before the time is up, and `--requeue` for another start after a preemption; after the time
/// limit, submitting again continues.
fn slurm_script(figure: &str, run: &[String], name: &str, logs: &str, threads: usize) -> String {
    let mut text = format!("#!/bin/sh\n# One run of {figure}; Slurm gives the index.\n");
    for option in [
        format!("--job-name={name}"),
        "--nodes=1".to_owned(),
        "--ntasks=1".to_owned(),
        format!("--cpus-per-task={threads}"),
        format!("--output={logs}/task-%a.log"),
        "--open-mode=append".to_owned(),
        "--requeue".to_owned(),
        "--signal=B:TERM@300".to_owned(),
    ] {
        // Writing into a `String` cannot fail.
        let _ = writeln!(text, "#SBATCH {option}");
    }
    let _ = write!(text, "set -eu\nexec {} \"$SLURM_ARRAY_TASK_ID\"\n", line(run));
    text
}

impl Array {
    /// Writes list, script and client.
    ///
    /// # Errors
    /// [`PaperError::Train`], [`PaperError::Write`].
    pub fn write(&self, plan: &Plan, run: &[String]) -> Result<(), PaperError> {
        let folder = self.script.parent().unwrap_or(Path::new("."));
        let logs = folder.join("logs");
        std::fs::create_dir_all(&logs).map_err(PaperError::io("create", &logs))?;
        let mut list = "index\trun\tsteps\tcommand\n".to_owned();
        for &index in &self.indices {
            let of = &plan.runs[index];
            let command = [line(run), index.to_string()].join(" ");
            let _ = writeln!(list, "{index}\t{}\t{}\t{command}", of.name, of.steps);
        }
        atomic::write(&self.list, list.as_bytes())?;
        atomic::write(&self.script, self.text.as_bytes())?;
        if let Some((path, text)) = &self.client {
            atomic::write(path, text.as_bytes())?;
        }
        Ok(())
    }

    /// The command as a person would type it.
    pub fn command_line(&self) -> String {
        line(&self.command)
    }

    /// Submits it; what the scheduler said.
    ///
    /// # Errors
    /// [`PaperError::Submit`] where the program is missing or refuses.
    pub fn submit(&self) -> Result<String, PaperError> {
        let failed = |reason: String| PaperError::Submit { command: self.command_line(), reason };
        let program = &self.command[0];
        let out = Command::new(program).args(self.command[1..].iter().map(OsStr::new)).output();
        let out =
            out.map_err(|e| failed(format!("cannot start `{program}` ({e}): is it installed on this machine?")))?;
        let said = |bytes: &[u8]| String::from_utf8_lossy(bytes).trim().to_owned();
        if out.status.success() {
            return Ok(said(&out.stdout));
        }
        let hint = if self.client.is_some() {
            "; there is no `hq` on the path, so HyperQueue's Python package is asked: install either, and start a server and workers"
        } else {
            ""
        };
        Err(failed(format!("{}: {}{hint}", out.status, said(&out.stderr))))
    }
}

#[cfg(test)]
mod tests {
    use super::super::figure::figure;
    use super::super::plan::Options;
    use super::*;

    fn plan(out: &Path) -> Plan {
        let options = Options { seeds: Some(1), steps: Some(2_000), out: out.to_owned(), only: None };
        Plan::new(figure("demo").unwrap(), &options).unwrap()
    }

    #[test]
    fn indices_are_written_as_ranges() {
        assert_eq!(ranges(&[0, 1, 2, 3, 7, 9, 10]), "0-3,7,9-10");
        assert_eq!(ranges(&[4]), "4");
    }

    #[test]
    fn words_are_quoted_for_a_shell() {
        assert_eq!(quoted("runs/a-b_1.toml"), "runs/a-b_1.toml");
        assert_eq!(quoted("it's here"), "'it'\\''s here'");
        assert_eq!(quoted(""), "''");
    }

    #[test]
    fn a_slurm_array_covers_what_is_not_done() {
        let out = tempfile::tempdir().unwrap();
        let plan = plan(out.path());
        let run = ["/opt/my programs/gadm", "paper", "run", "demo", "--seeds", "1"].map(str::to_owned);
        let array = array(&plan, Scheduler::Slurm, &run, 2).unwrap();
        assert_eq!(array.command[..3], ["sbatch", "--array", "0-2"].map(str::to_owned));
        let options: Vec<&str> = array.text.lines().filter_map(|line| line.strip_prefix("#SBATCH ")).collect();
        assert!(options.contains(&"--cpus-per-task=2") && options.contains(&"--signal=B:TERM@300"), "{options:?}");
        assert!(
            array.text.ends_with("exec '/opt/my programs/gadm' paper run demo --seeds 1 \"$SLURM_ARRAY_TASK_ID\"\n"),
            "{}",
            array.text
        );
        array.write(&plan, &run).unwrap();
        let list = std::fs::read_to_string(&array.list).unwrap();
        assert_eq!(list.lines().count(), 4);
        assert!(
            list.contains("1\tpendulum/td3-small-seed0\t4000\t'/opt/my programs/gadm' paper run demo --seeds 1 1"),
            "{list}"
        );
    }

    /// The shell reads the script, and passes the index and words with spaces on as they are.
    #[test]
    fn the_scripts_pass_the_index_on() {
        let out = tempfile::tempdir().unwrap();
        let plan = plan(out.path());
        let run = ["printf", "%s|", "two words", "$HOME"].map(str::to_owned);
        for (scheduler, variable) in
            [(Scheduler::Hq, "HQ_TASK_ID"), (Scheduler::Hq, "GADM_INDEX"), (Scheduler::Slurm, "SLURM_ARRAY_TASK_ID")]
        {
            let array = array(&plan, scheduler, &run, 1).unwrap();
            array.write(&plan, &run).unwrap();
            let done = Command::new("sh").arg(&array.script).env(variable, "5").output().unwrap();
            assert_eq!(String::from_utf8_lossy(&done.stdout), "two words|$HOME|5|", "{variable}");
        }
    }

    #[test]
    fn a_program_that_is_missing_is_said() {
        let mut array = array(&plan(Path::new("out")), Scheduler::Slurm, &["gadm".to_owned()], 1).unwrap();
        array.command[0] = "no-such-scheduler".to_owned();
        let text = array.submit().unwrap_err().to_string();
        assert!(text.contains("no-such-scheduler") && text.contains("is it installed"), "{text}");
    }
}
