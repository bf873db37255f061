//! Drives a run in its folder: rounds, metrics, evaluation, checkpoints, interruption.

use std::fs::{File, TryLockError};
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use super::any::{AnyRun, new_run};
use super::bookkeeping::NotFinite;
use super::checkpoint;
use super::evaluate::{Evaluation, evaluate};
use super::progress::{Progress, Snapshot, Style};
use crate::atomic;
use crate::config::{TrainConfig, to_toml};
use crate::error::TrainError;
use crate::metrics::jsonl::TIMING_FILE;
use crate::metrics::{JsonlSink, MetricsError, Record, TensorBoardSink, keys, read_jsonl};
use crate::seed::SeedTree;

/// Name of the stored configuration in a run folder.
pub const CONFIG_FILE: &str = "config.toml";
/// Name of the file whose lock marks a run folder as in use.
pub const LOCK_FILE: &str = "lock";

/// How to run.
pub struct TrainOptions<'a> {
    /// Settings of a new run. When resuming, `None` takes the stored ones; `Some` must equal them but for `steps`, and
    /// may have further `track.snapshots` and another `track.average`.
    pub config: Option<TrainConfig>,
    /// Run folder.
    pub dir: PathBuf,
    /// Continue the run in `dir`.
    pub resume: bool,
    /// Progress display.
    pub style: Style,
    /// Set from a signal handler: the run then writes a checkpoint and stops.
    pub stop: &'a AtomicBool,
}

/// How a run ended.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// Environment steps done.
    pub env_steps: u64,
    /// Stopped from outside before the end.
    pub interrupted: bool,
    /// Mean return of the best evaluation.
    pub best_return: Option<f64>,
    /// The last evaluation of this session.
    pub last: Option<Evaluation>,
    /// Wall-clock time of this session, s.
    pub wall_s: f64,
}

/// Seed of the evaluations during training; no training episode uses it.
pub fn evaluation_seed(config: &TrainConfig) -> u64 {
    SeedTree::new(config.seed).number("evaluation")
}

struct Sinks {
    jsonl: JsonlSink,
    tensorboard: TensorBoardSink,
}

fn metrics_error(error: MetricsError) -> TrainError {
    TrainError::Metrics(error)
}

#[expect(clippy::disallowed_methods, reason = "the time stamps of TensorBoard's events")]
fn unix_time() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
}

impl Sinks {
    fn write(&mut self, record: &Record) -> Result<(), TrainError> {
        self.jsonl.write(record).map_err(metrics_error)?;
        self.tensorboard.write(record, unix_time()).map_err(metrics_error)
    }
}

/// Keeps a second process out of the folder for as long as the value lives; the operating system frees it with the
/// process, however that ends.
fn lock(dir: &Path) -> Result<File, TrainError> {
    let path = dir.join(LOCK_FILE);
    let file = File::create(&path).map_err(TrainError::io("create", &path))?;
    // A program that this process starts holds a copy of the lock for the moment until it runs: wait a little.
    for _ in 0..20 {
        match file.try_lock() {
            Ok(()) => return Ok(file),
            Err(TryLockError::WouldBlock) => std::thread::sleep(Duration::from_millis(50)),
            Err(TryLockError::Error(source)) => return Err(TrainError::io("lock", &path)(source)),
        }
    }
    Err(TrainError::RunLocked { path: dir.to_owned() })
}

/// Whether a process trains in the run folder `dir` now.
pub fn in_use(dir: &Path) -> bool {
    File::open(dir.join(LOCK_FILE)).is_ok_and(|file| matches!(file.try_lock(), Err(TryLockError::WouldBlock)))
}

/// Wall-clock time of the training in `dir` so far, s. A session that did not take over the clock of the one before it, as earlier
/// versions of this program, starts where the clock goes back.
pub fn trained_s(dir: &Path) -> f64 {
    let records = read_jsonl(&dir.join(TIMING_FILE)).unwrap_or_default();
    let times = records.iter().filter_map(|(_, values)| values.get(keys::WALL_S).copied());
    let (earlier, last) =
        times.fold((0.0, 0.0), |(earlier, last), t| if t < last { (earlier + last, t) } else { (earlier, t) });
    earlier + last
}

/// Starts or resumes. The file is the lock on the folder.
fn open(options: &TrainOptions) -> Result<(Box<dyn AnyRun>, Sinks, File), TrainError> {
    let dir = &options.dir;
    if options.resume {
        let mut run = checkpoint::load_any(dir)?;
        let lock = lock(dir)?;
        if let Some(config) = &options.config {
            let mut same = TrainConfig { steps: run.config().steps, ..config.clone() };
            same.track.snapshots.clone_from(&run.config().track.snapshots);
            same.track.average = run.config().track.average;
            if same != *run.config() {
                return Err(TrainError::ConfigChanged {
                    path: dir.clone(),
                    detail: first_difference(run.config(), &same),
                });
            }
            let mut track = same.track;
            track.average = config.track.average;
            let stored = &run.config().track.snapshots;
            track.snapshots.extend(config.track.snapshots.iter().filter(|step| !stored.contains(step)));
            if config.steps != run.config().steps || track != run.config().track {
                run.extend(config.steps, track);
                let text = to_toml(run.config()).map_err(TrainError::ConfigFile)?;
                atomic::write(&dir.join(CONFIG_FILE), text.as_bytes()).map_err(TrainError::Write)?;
            }
        }
        for folder in [dir.clone(), dir.join(checkpoint::FOLDER)] {
            atomic::remove_leftovers(&folder).map_err(TrainError::io("clean up", folder))?;
        }
        let step = run.counters().env_steps;
        let sinks = Sinks {
            jsonl: JsonlSink::resume(dir, step).map_err(metrics_error)?,
            tensorboard: TensorBoardSink::resume(dir, step, unix_time()).map_err(metrics_error)?,
        };
        return Ok((run, sinks, lock));
    }
    let config = options.config.clone().unwrap_or_default();
    let mut run = new_run(config)?;
    if dir.exists() && std::fs::read_dir(dir).map_err(TrainError::io("read", dir))?.next().is_some() {
        return Err(TrainError::RunExists { path: dir.clone() });
    }
    // Everything that can be refused is refused before the folder exists, so that the command can be repeated.
    run.prepare()?;
    let text = to_toml(run.config()).map_err(TrainError::ConfigFile)?;
    std::fs::create_dir_all(dir.join(checkpoint::FOLDER)).map_err(TrainError::io("create", dir))?;
    let lock = lock(dir)?;
    atomic::write(&dir.join(CONFIG_FILE), text.as_bytes()).map_err(TrainError::Write)?;
    super::origin::Origin::here(run.config()).store(dir)?;
    let sinks = Sinks {
        jsonl: JsonlSink::create(dir).map_err(metrics_error)?,
        tensorboard: TensorBoardSink::create(dir, unix_time()).map_err(metrics_error)?,
    };
    // A run killed before its first regular checkpoint can be resumed too, and a folder that takes none is noticed now.
    run.save(dir)?;
    Ok((run, sinks, lock))
}

fn first_difference(stored: &TrainConfig, given: &TrainConfig) -> String {
    let (a, b) = (to_toml(stored).unwrap_or_default(), to_toml(given).unwrap_or_default());
    let line = a.lines().zip(b.lines()).find(|(x, y)| x != y);
    line.map_or_else(|| "another set of keys".to_owned(), |(x, y)| format!("stored `{x}`, given `{y}`"))
}

/// Trains until the configured steps are done, the target return is reached, or `stop` is set.
///
/// # Errors
/// Any [`TrainError`]; a usable checkpoint then remains as of the last one written.
#[expect(clippy::disallowed_methods, reason = "timing metrics")]
pub fn train(options: &TrainOptions) -> Result<Outcome, TrainError> {
    let (mut run, mut sinks, _lock) = open(options)?;
    let before_s = if options.resume { trained_s(&options.dir) } else { 0.0 };
    let start = Instant::now();
    let mut progress = Progress::new(run.config().steps, &run.config().env, options.style);
    let mut outcome = Outcome { env_steps: 0, interrupted: false, best_return: None, last: None, wall_s: 0.0 };
    let mut clock = (Instant::now(), run.counters().env_steps, run.counters().updates());
    let target = run.config().track.stop_at_return;
    let mut reached = target.is_some_and(|target| run.counters().last_return.is_some_and(|last| last >= target));
    let mut recent = (None, None);
    if run.counters().env_steps == 0 {
        keep_snapshots(run.as_mut(), &options.dir, 0..=0)?;
    }
    while !run.finished() && !reached {
        if options.stop.load(Ordering::Relaxed) {
            outcome.interrupted = true;
            break;
        }
        let before = run.counters().env_steps;
        if let Err(bad) = run.round()? {
            return Err(stopped(run.as_ref(), &options.dir, &bad)?);
        }
        let now = run.counters().env_steps;
        let crossed = |every: u64| every > 0 && before / every != now / every;
        recent.0 = run.window().mean(keys::EPISODE_RETURN).or(recent.0);
        recent.1 = run.window().mean(keys::Q_LOSS).or_else(|| run.window().mean(keys::AE_LOSS)).or(recent.1);
        progress.update(&Snapshot {
            phase: run.phase(),
            env_steps: now,
            updates: run.counters().updates(),
            episode_return: recent.0,
            loss: recent.1,
            latents: (run.window().code_use().0 > 0)
                .then(|| (run.window().code_use().0, run.config().action_model.latents)),
        });
        let evaluates = run.counters().warm && (crossed(run.config().track.eval_every) || run.finished());
        if crossed(run.config().track.log_every) || evaluates {
            let mut record = run.record();
            let elapsed = clock.0.elapsed().as_secs_f64().max(1e-9);
            let rates = ((now - clock.1) as f64 / elapsed, (run.counters().updates() - clock.2) as f64 / elapsed);
            clock = (Instant::now(), now, run.counters().updates());
            if evaluates {
                run.swap_averages();
                let evaluation = evaluate_run(run.as_mut(), &mut record)?;
                reached = target.is_some_and(|target| evaluation.mean() >= target);
                // A return that is not a number is better than nothing and worse than any other.
                if run.counters().best_return.is_none_or(|best| evaluation.mean() > best || best.is_nan()) {
                    run.counters_mut().best_return = Some(evaluation.mean());
                    run.save_networks(&options.dir, checkpoint::BEST)?;
                }
                run.swap_averages();
                record.push(keys::EVAL_RETURN_BEST, run.counters().best_return.unwrap_or(f64::NAN));
                progress.suspend(|| {
                    tracing::info!(
                        "step {now}: return {:.1} ± {:.1} over {} episodes (best {:.1})",
                        evaluation.mean(),
                        evaluation.sd(),
                        evaluation.returns.len(),
                        run.counters().best_return.unwrap_or(f64::NAN)
                    );
                });
                outcome.last = Some(evaluation);
            }
            record.push(keys::WALL_S, before_s + start.elapsed().as_secs_f64());
            record.push(keys::ENV_STEPS_PER_S, rates.0);
            record.push(keys::UPDATES_PER_S, rates.1);
            sinks.write(&record)?;
        }
        // Before the checkpoint: a run that is killed in between goes on from an older one and comes by here again.
        keep_snapshots(run.as_mut(), &options.dir, before + 1..=now)?;
        if crossed(run.config().track.checkpoint_every) {
            sinks.jsonl.sync().map_err(metrics_error)?;
            run.save(&options.dir)?;
        }
    }
    sinks.jsonl.sync().map_err(metrics_error)?;
    run.save(&options.dir)?;
    outcome.env_steps = run.counters().env_steps;
    outcome.best_return = run.counters().best_return;
    outcome.wall_s = start.elapsed().as_secs_f64();
    progress.finish(&if outcome.interrupted {
        format!("interrupted at step {}; checkpoint written, continue with --resume", outcome.env_steps)
    } else {
        format!("done: {} steps in {:.0} s", outcome.env_steps, outcome.wall_s)
    });
    Ok(outcome)
}

/// Writes the networks for every snapshot whose step is in `steps`.
fn keep_snapshots(run: &mut dyn AnyRun, dir: &Path, steps: RangeInclusive<u64>) -> Result<(), TrainError> {
    let due: Vec<u64> = run.config().track.snapshots.iter().copied().filter(|step| steps.contains(step)).collect();
    run.swap_averages();
    due.into_iter().try_for_each(|step| run.save_networks(dir, &checkpoint::snapshot(step)))?;
    run.swap_averages();
    Ok(())
}

fn evaluate_run(run: &mut dyn AnyRun, record: &mut Record) -> Result<Evaluation, TrainError> {
    let config = run.config().clone();
    let evaluation =
        evaluate(run.actor(), &config.env, &config.env_options, config.track.eval_episodes, evaluation_seed(&config))?;
    run.counters_mut().last_return = Some(evaluation.mean());
    let (low, high) =
        evaluation.returns.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), &r| (l.min(r), h.max(r)));
    let n = evaluation.returns.len() as f64;
    record.push(keys::EVAL_RETURN_MEAN, evaluation.mean());
    record.push(keys::EVAL_RETURN_SD, evaluation.sd());
    record.push(keys::EVAL_RETURN_MIN, low);
    record.push(keys::EVAL_RETURN_MAX, high);
    record.push(keys::EVAL_LENGTH_MEAN, evaluation.lengths.iter().sum::<u64>() as f64 / n);
    record.push(keys::EVAL_EPISODES, n);
    if let Some(successes) = evaluation.successes {
        record.push(keys::EVAL_SUCCESS_RATE, successes as f64 / n);
    }
    Ok(evaluation)
}

fn stopped(run: &dyn AnyRun, dir: &Path, bad: &NotFinite) -> Result<TrainError, TrainError> {
    let batch = dir.join("not-finite.safetensors");
    checkpoint::save_batch(&batch, bad)?;
    Ok(TrainError::NotFinite {
        what: bad.what.to_owned(),
        env_step: run.counters().env_steps,
        update: run.counters().updates(),
        batch,
    })
}
