//! Campaigns: every fault of a scenario on its own, at each of its intensities, with several seeds, on all cores.
//!
//! A campaign is a function of scenario, policy and seeds; the number of threads changes only how long it takes. Every
//! run that ends is one line in `runs.jsonl`, so a campaign that was stopped goes on where it was.

mod atomic;
mod heat;
mod junit;
mod page;
mod plan;
mod record;
mod store;
mod table;

pub use atomic::replace;
pub use plan::{Job, Plan};
pub use record::{NOMINAL, Record, Tally};

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError, mpsc};

use crate::SimError;
use crate::scenario::Scenario;
use crate::sil::run_with_progress;

/// How a campaign is run.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Runs at a time, at least 1.
    pub jobs: usize,
    /// Seeds per fault and intensity; `None` = as the scenario says.
    pub seeds: Option<u64>,
    /// Folder for everything.
    pub out: PathBuf,
    /// The command that repeats this, for the report.
    pub command: String,
}

/// How far a campaign is.
#[derive(Clone, Debug, PartialEq)]
pub struct Progress {
    /// Runs that ended, those of an earlier call included.
    pub done: usize,
    /// Of these, those of an earlier call.
    pub resumed: usize,
    /// Runs of the campaign.
    pub total: usize,
    /// Runs that missed a criterion or failed.
    pub missed: usize,
    /// Name of the run that ended last.
    pub last: String,
}

/// What a campaign found.
#[derive(Clone, Debug, PartialEq)]
pub struct Campaign {
    /// Name of the scenario.
    pub name: String,
    /// All runs, in the order of the plan.
    pub records: Vec<Record>,
    /// Fault by intensity, in the order of the scenario.
    pub tallies: Vec<Tally>,
}

impl Campaign {
    /// No run missed a criterion and none failed.
    #[must_use]
    pub fn passed(&self) -> bool {
        self.records.iter().all(|r| r.passed)
    }

    /// No run ended with an error.
    #[must_use]
    pub fn sound(&self) -> bool {
        self.records.iter().all(|r| r.error.is_none())
    }
}

/// Files that a campaign leaves in its folder, beside `campaign.json` and `runs.jsonl`.
pub const FILES: [&str; 5] = ["results.csv", "results.json", "junit.xml", "heatmap.svg", "report.html"];

/// Runs a campaign, or goes on with one, and writes its results.
///
/// # Errors
/// [`SimError::Read`] and [`SimError::Write`]; [`SimError::Campaign`] where the folder holds another campaign. A run that
/// fails does not end the campaign: its record says why.
pub fn campaign(
    scenario: &Scenario,
    options: &Options,
    progress: &mut dyn FnMut(&Progress),
) -> Result<Campaign, SimError> {
    let plan = Plan::new(scenario, options.seeds.unwrap_or(scenario.seeds))?;
    let mut store = store::Store::open(&options.out, &plan)?;
    let mut records: Vec<Option<Record>> = plan.jobs.iter().map(|job| store.known(job)).collect();
    let resumed = records.iter().flatten().count();
    let mut state = Progress {
        done: resumed,
        resumed,
        total: plan.jobs.len(),
        missed: records.iter().flatten().filter(|r| !r.passed).count(),
        last: String::new(),
    };
    progress(&state);
    // What is compared with comes first.
    for nominal in [true, false] {
        let due: VecDeque<usize> = (0..plan.jobs.len())
            .filter(|i| records[*i].is_none() && plan.jobs[*i].fault.is_none() == nominal)
            .collect();
        let clean = |seed| {
            let same = |r: &&Record| r.fault == NOMINAL && r.seed == seed;
            records.iter().flatten().find(same).filter(|r| r.error.is_none()).map(|r| r.mean_return)
        };
        let work: Vec<(usize, Job, Option<f64>)> =
            due.into_iter().map(|i| (i, plan.jobs[i].clone(), clean(plan.jobs[i].seed))).collect();
        parallel(scenario, options.jobs, work, &mut |i, record| {
            store.append(&record)?;
            state.done += 1;
            state.missed += usize::from(!record.passed);
            state.last = record.name();
            records[i] = Some(record);
            progress(&state);
            Ok(())
        })?;
    }
    let records: Vec<Record> = records.into_iter().flatten().collect();
    let found = Campaign { name: scenario.name.clone(), tallies: record::tally(&records), records };
    write(&found, scenario, options)?;
    Ok(found)
}

/// Runs jobs on several threads and hands each record to `take`, on this one, as it comes.
fn parallel(
    scenario: &Scenario,
    jobs: usize,
    work: Vec<(usize, Job, Option<f64>)>,
    take: &mut dyn FnMut(usize, Record) -> Result<(), SimError>,
) -> Result<(), SimError> {
    let threads = jobs.clamp(1, work.len().max(1));
    let queue = Mutex::new(VecDeque::from(work));
    let (sender, receiver) = mpsc::channel();
    std::thread::scope(|scope| {
        for _ in 0..threads {
            let (sender, queue) = (sender.clone(), &queue);
            scope.spawn(move || {
                loop {
                    // A poisoned queue still holds whole jobs.
                    let next = queue.lock().unwrap_or_else(PoisonError::into_inner).pop_front();
                    let Some((i, job, nominal)) = next else { break };
                    if sender.send((i, run_job(scenario, &job, nominal))).is_err() {
                        break;
                    }
                }
            });
        }
        drop(sender);
        let mut result = Ok(());
        for (i, record) in &receiver {
            result = take(i, record);
            if result.is_err() {
                break; // dropping the receiver ends the threads after their current run
            }
        }
        drop(receiver);
        result
    })
}

fn run_job(scenario: &Scenario, job: &Job, nominal: Option<f64>) -> Record {
    let mut options = scenario.run_options();
    options.seed = job.seed;
    options.faults = job.fault.iter().cloned().collect();
    match run_with_progress(&options, &mut |_| {}) {
        Ok(result) => Record::of(job, &result, nominal, &job.criteria.judge(&result, nominal)),
        Err(error) => Record::failed(job, &error.to_string()),
    }
}

fn write(found: &Campaign, scenario: &Scenario, options: &Options) -> Result<(), SimError> {
    let texts = [
        table::csv(&found.records),
        table::json(found),
        junit::xml(found),
        heat::svg(found),
        page::html(found, scenario, options),
    ];
    for (name, text) in FILES.into_iter().zip(texts) {
        let path: &Path = &options.out.join(name);
        replace(path, text.as_bytes()).map_err(|source| SimError::Write { path: path.to_owned(), source })?;
    }
    Ok(())
}
