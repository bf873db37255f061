//! A row of environments that are stepped together and reset themselves.

use std::{
    sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel},
    thread::JoinHandle,
};

use serde::{Deserialize, Serialize};

use crate::{Env, EnvError, EnvOptions, EnvSpec, EnvState, make_with};

/// Seed of an episode: environment `env` of a row, its episode number `episode` (from 0), in a run with this seed.
///
/// `splitmix(splitmix(splitmix(run_seed) ^ env) ^ episode)` with the finaliser of SplitMix64 (Steele, Lea, Flood 2014).
/// Each step is a bijection, so two episodes of one environment never share a seed.
pub fn reset_seed(run_seed: u64, env: u64, episode: u64) -> u64 {
    fn splitmix(x: u64) -> u64 {
        let x = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^ (x >> 31)
    }
    splitmix(splitmix(splitmix(run_seed) ^ env) ^ episode)
}

/// An episode that the last step ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EpisodeEnd {
    /// Environment in the row.
    pub env: usize,
    /// Undiscounted sum of rewards.
    pub total_reward: f64,
    /// Steps.
    pub length: u64,
    /// Ended by the environment's own rules.
    pub terminated: bool,
    /// Ended in the goal; always false where the environment has none.
    pub goal: bool,
}

/// What a step of N environments gave. Rows are environments; O is the observation length.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepBatch {
    /// N×O: the true successors, before any reset; what a transition stores.
    pub next_obs: Vec<f32>,
    /// N×O: what to act on next; differs from `next_obs` where an episode ended.
    pub obs: Vec<f32>,
    /// N rewards.
    pub rewards: Vec<f64>,
    /// N flags: ended by the environment's own rules.
    pub terminated: Vec<bool>,
    /// N flags: cut by an outer limit.
    pub truncated: Vec<bool>,
    /// Episodes that ended in this step, in the order of the row.
    pub ended: Vec<EpisodeEnd>,
}

/// Everything a row needs to go on, bit for bit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VecEnvState {
    /// Seed of the run.
    pub run_seed: u64,
    /// One per environment.
    pub envs: Vec<SlotState>,
}

/// One environment of a saved row.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SlotState {
    /// State of the running episode.
    pub state: EnvState,
    /// Its latest observation.
    pub obs: Vec<f32>,
    /// Number of the running episode.
    pub episode: u64,
    /// Sum of its rewards so far.
    pub total_reward: f64,
    /// Steps so far.
    pub length: u64,
}

struct Slot {
    env: Box<dyn Env>,
    index: usize,
    episode: u64,
    total_reward: f64,
    length: u64,
}

impl Slot {
    fn reset(&mut self, run_seed: u64, obs: &mut [f32]) {
        self.env.reset(reset_seed(run_seed, self.index as u64, self.episode), obs);
        (self.total_reward, self.length) = (0.0, 0);
    }
}

/// Neighbouring environments that one thread steps, with their buffers. It travels to the thread and back.
struct Chunk {
    run_seed: u64,
    slots: Vec<Slot>,
    actions: Vec<f32>,
    out: StepBatch,
}

impl Chunk {
    fn step(&mut self) {
        let Self { run_seed, slots, actions, out } = self;
        let n = slots.len();
        let (act_dim, obs_dim) = (actions.len() / n, out.obs.len() / n);
        out.ended.clear();
        for (i, slot) in slots.iter_mut().enumerate() {
            let next_obs = &mut out.next_obs[i * obs_dim..][..obs_dim];
            let obs = &mut out.obs[i * obs_dim..][..obs_dim];
            let step = slot.env.step(&actions[i * act_dim..][..act_dim], next_obs);
            slot.total_reward += step.reward;
            slot.length = slot.length.saturating_add(1);
            (out.rewards[i], out.terminated[i], out.truncated[i]) = (step.reward, step.terminated, step.truncated);
            if step.terminated || step.truncated {
                let goal = step.terminated && step.reward > 0.0 && slot.env.spec().goal_terminal;
                let Slot { index, total_reward, length, .. } = *slot;
                out.ended.push(EpisodeEnd { env: index, total_reward, length, terminated: step.terminated, goal });
                slot.episode = slot.episode.wrapping_add(1);
                slot.reset(*run_seed, obs);
            } else {
                obs.copy_from_slice(next_obs);
            }
        }
    }
}

struct Worker {
    to: Option<SyncSender<Box<Chunk>>>,
    from: Receiver<Box<Chunk>>,
    thread: Option<JoinHandle<()>>,
}

impl Worker {
    fn start(number: usize) -> Result<Self, EnvError> {
        let (to, jobs) = sync_channel::<Box<Chunk>>(1);
        let (results, from) = sync_channel(1);
        let work = move || {
            while let Some(mut chunk) = receive(&jobs) {
                chunk.step();
                if results.send(chunk).is_err() {
                    break;
                }
            }
        };
        let thread = std::thread::Builder::new().name(format!("env-worker-{number}")).spawn(work);
        Ok(Self { to: Some(to), from, thread: Some(thread.map_err(|_| EnvError::Worker)?) })
    }
}

/// Waits for the next value; `None` where the other side is gone. Looks for it a short while before it sleeps: rows of
/// environments that are stepped one after the other pass the work on within microseconds, and waking a thread takes tens.
fn receive<T>(from: &Receiver<T>) -> Option<T> {
    /// About 20 µs.
    const LOOKS: u32 = 2000;
    for _ in 0..LOOKS {
        match from.try_recv() {
            Ok(value) => return Some(value),
            Err(TryRecvError::Empty) => std::hint::spin_loop(),
            Err(TryRecvError::Disconnected) => return None,
        }
    }
    from.recv().ok()
}

impl Drop for Worker {
    fn drop(&mut self) {
        self.to = None; // ends the thread's loop
        if let Some(thread) = self.thread.take() {
            // A panic there was reported as `EnvError::Worker`.
            let _ = thread.join();
        }
    }
}

/// N environments of one kind that are stepped together; an ended episode is followed by the next at once.
///
/// Results do not depend on the number of threads.
///
/// ```
/// # fn main() -> Result<(), gadm_envs::EnvError> {
/// use gadm_envs::{EnvOptions, VecEnv};
/// let mut row = VecEnv::new("pendulum", 4, 7, &EnvOptions::default())?;
/// let batch = row.step(&[0.5; 4])?;
/// assert_eq!(batch.next_obs.len(), 4 * 3);
/// # Ok(())
/// # }
/// ```
pub struct VecEnv {
    spec: EnvSpec,
    run_seed: u64,
    len: usize,
    /// The first is stepped by the calling thread, the others by the workers. `None` only while it travels.
    chunks: Vec<Option<Box<Chunk>>>,
    workers: Vec<Worker>,
    batch: StepBatch,
}

const AT_HOME: &str = "chunks are back between calls, or the row reported its lost worker";

impl VecEnv {
    /// Makes `n` environments of that id and starts episode 0 in each.
    ///
    /// # Errors
    /// As [`make_with`], and [`EnvError::Batch`] for `n` = 0.
    pub fn new(id: &str, n: usize, run_seed: u64, options: &EnvOptions) -> Result<Self, EnvError> {
        let envs = (0..n).map(|_| make_with(id, options)).collect::<Result<Vec<_>, _>>()?;
        Self::from_envs(envs, run_seed, 1)
    }

    /// Takes environments of one kind and starts episode 0 in each. With `threads` > 1 that many threads step them, at
    /// most one per environment.
    ///
    /// # Errors
    /// [`EnvError::Batch`] for an empty row or differing specs; [`EnvError::Worker`] where a thread cannot start.
    pub fn from_envs(envs: Vec<Box<dyn Env>>, run_seed: u64, threads: usize) -> Result<Self, EnvError> {
        let Some(spec) = envs.first().map(|env| env.spec().clone()) else {
            return Err(EnvError::Batch { what: "environments in the row", expected: 1, found: 0 });
        };
        let same = envs.iter().filter(|env| *env.spec() == spec).count();
        if same != envs.len() {
            return Err(EnvError::Batch { what: "environments of one kind", expected: envs.len(), found: same });
        }
        let len = envs.len();
        let threads = threads.clamp(1, len);
        let mut rest = envs.into_iter().enumerate();
        let chunks = (0..threads)
            .map(|k| {
                let n = len / threads + usize::from(k < len % threads);
                let slots: Vec<_> = rest
                    .by_ref()
                    .take(n)
                    .map(|(index, env)| Slot { env, index, episode: 0, total_reward: 0.0, length: 0 })
                    .collect();
                let (actions, out) = (vec![0.0; n * spec.action_dim()], empty_batch(n, spec.obs_dim()));
                Some(Box::new(Chunk { run_seed, slots, actions, out }))
            })
            .collect();
        let workers = (1..threads).map(Worker::start).collect::<Result<_, _>>()?;
        let batch = empty_batch(len, spec.obs_dim());
        let mut row = Self { spec, run_seed, len, chunks, workers, batch };
        row.start_episodes();
        Ok(row)
    }

    /// The spec that all share.
    pub fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    /// Number of environments, N.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Never true: a row has at least one environment.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// N×O observations to act on.
    pub fn obs(&self) -> &[f32] {
        &self.batch.obs
    }

    /// What the last step gave; before the first one, its `obs` are the first observations and the rest is zero.
    pub fn last(&self) -> &StepBatch {
        &self.batch
    }

    /// Abandons the running episodes and starts the next one in each environment.
    ///
    /// # Errors
    /// [`EnvError::Worker`] after a lost worker.
    pub fn reset(&mut self) -> Result<&[f32], EnvError> {
        if self.chunks.iter().any(Option::is_none) {
            return Err(EnvError::Worker);
        }
        for chunk in self.chunks.iter_mut().flatten() {
            for slot in &mut chunk.slots {
                slot.episode = slot.episode.wrapping_add(1);
            }
        }
        self.start_episodes();
        Ok(&self.batch.obs)
    }

    fn start_episodes(&mut self) {
        let obs_dim = self.spec.obs_dim();
        for chunk in self.chunks.iter_mut().flatten() {
            let Chunk { run_seed, slots, out, .. } = &mut **chunk;
            for (slot, obs) in slots.iter_mut().zip(out.obs.chunks_exact_mut(obs_dim)) {
                slot.reset(*run_seed, obs);
            }
        }
        self.gather();
    }

    /// Steps all environments with N×A actions in native units, one row each.
    ///
    /// # Errors
    /// [`EnvError::Batch`] for another number of actions; [`EnvError::Worker`] where a worker was lost.
    pub fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        let expected = self.len * self.spec.action_dim();
        if actions.len() != expected {
            return Err(EnvError::Batch { what: "numbers of a batch of actions", expected, found: actions.len() });
        }
        if self.chunks.iter().any(Option::is_none) {
            return Err(EnvError::Worker);
        }
        let mut rest = actions;
        for chunk in self.chunks.iter_mut().flatten() {
            let (mine, others) = rest.split_at(chunk.actions.len());
            chunk.actions.copy_from_slice(mine);
            rest = others;
        }
        for (chunk, worker) in self.chunks[1..].iter_mut().zip(&self.workers) {
            let to = worker.to.as_ref().ok_or(EnvError::Worker)?;
            to.send(chunk.take().expect(AT_HOME)).map_err(|_| EnvError::Worker)?;
        }
        self.chunks[0].as_mut().expect(AT_HOME).step();
        for (chunk, worker) in self.chunks[1..].iter_mut().zip(&self.workers) {
            *chunk = Some(receive(&worker.from).ok_or(EnvError::Worker)?);
        }
        self.gather();
        Ok(&self.batch)
    }

    /// Copies the chunks' results into the batch, in the order of the row.
    fn gather(&mut self) {
        let obs_dim = self.spec.obs_dim();
        let batch = &mut self.batch;
        batch.ended.clear();
        let mut at = 0;
        for chunk in self.chunks.iter().flatten() {
            let (out, n) = (&chunk.out, chunk.slots.len());
            batch.next_obs[at * obs_dim..][..n * obs_dim].copy_from_slice(&out.next_obs);
            batch.obs[at * obs_dim..][..n * obs_dim].copy_from_slice(&out.obs);
            batch.rewards[at..at + n].copy_from_slice(&out.rewards);
            batch.terminated[at..at + n].copy_from_slice(&out.terminated);
            batch.truncated[at..at + n].copy_from_slice(&out.truncated);
            batch.ended.extend_from_slice(&out.ended);
            at += n;
        }
    }

    /// Everything needed to go on.
    pub fn save(&self) -> VecEnvState {
        let obs_dim = self.spec.obs_dim();
        let slots = self.chunks.iter().flatten().flat_map(|chunk| &chunk.slots);
        let envs = slots
            .zip(self.batch.obs.chunks_exact(obs_dim))
            .map(|(slot, obs)| SlotState {
                state: slot.env.state(),
                obs: obs.to_vec(),
                episode: slot.episode,
                total_reward: slot.total_reward,
                length: slot.length,
            })
            .collect();
        VecEnvState { run_seed: self.run_seed, envs }
    }

    /// Goes on from a saved row; its run seed replaces this one's.
    ///
    /// # Errors
    /// [`EnvError::Batch`] for another number of environments or observation length, [`EnvError::State`] for a state of
    /// another environment; the row may then be partly restored. [`EnvError::Worker`] after a lost worker.
    pub fn restore(&mut self, saved: &VecEnvState) -> Result<(), EnvError> {
        if saved.envs.len() != self.len {
            let what = "environments in the saved row";
            return Err(EnvError::Batch { what, expected: self.len, found: saved.envs.len() });
        }
        if self.chunks.iter().any(Option::is_none) {
            return Err(EnvError::Worker);
        }
        let obs_dim = self.spec.obs_dim();
        let mut rest = saved.envs.iter();
        self.run_seed = saved.run_seed;
        for chunk in self.chunks.iter_mut().flatten() {
            chunk.run_seed = saved.run_seed;
            let Chunk { slots, out, .. } = &mut **chunk;
            out.ended.clear();
            for ((slot, obs), from) in slots.iter_mut().zip(out.obs.chunks_exact_mut(obs_dim)).zip(&mut rest) {
                if from.obs.len() != obs_dim {
                    let what = "length of a saved observation";
                    return Err(EnvError::Batch { what, expected: obs_dim, found: from.obs.len() });
                }
                slot.env.restore(&from.state)?;
                obs.copy_from_slice(&from.obs);
                (slot.episode, slot.total_reward, slot.length) = (from.episode, from.total_reward, from.length);
            }
        }
        self.gather();
        Ok(())
    }
}

fn empty_batch(n: usize, obs_dim: usize) -> StepBatch {
    StepBatch {
        next_obs: vec![0.0; n * obs_dim],
        obs: vec![0.0; n * obs_dim],
        rewards: vec![0.0; n],
        terminated: vec![false; n],
        truncated: vec![false; n],
        ended: Vec::with_capacity(n),
    }
}
