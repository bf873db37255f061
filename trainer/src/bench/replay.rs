//! Memory of a full replay buffer, and how fast it is filled and sampled.

use serde::Serialize;

use super::{Clock, Label, Timing, repeat};
use crate::replay::{NStep, RlBatch, RlBuffer};
use crate::seed::SeedTree;

/// Sizes of the transitions to be held.
#[derive(Clone, Debug)]
pub struct Shape {
    /// Name.
    pub name: &'static str,
    /// Numbers of an observation.
    pub obs: usize,
    /// Slots of an action.
    pub slots: usize,
    /// Steps of an episode; each end costs one observation more.
    pub episode: usize,
}

/// The two shapes of the table. Episodes are as short as those of a random policy: the worst case for a buffer that holds
/// an observation once.
pub const SHAPES: [Shape; 2] = [
    Shape { name: "hopper-v5", obs: 11, slots: 3, episode: 22 },
    Shape { name: "humanoid-v4", obs: 376, slots: 17, episode: 22 },
];

/// What a full buffer takes.
#[derive(Clone, Debug, Serialize)]
pub struct Memory {
    /// Name of the shape.
    pub name: &'static str,
    /// Transitions held.
    pub transitions: usize,
    /// Growth of the program's resident memory while it was filled, bytes; `None` where the system does not tell.
    pub resident_bytes: Option<u64>,
    /// What the buffer says it allocated, bytes.
    pub own_bytes: u64,
    /// Transitions added per second.
    pub fill_rate: f64,
    /// Batches of 512 drawn per second.
    pub sampling: Timing,
}

/// Resident memory of this program, bytes.
fn resident() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmRSS:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<u64>().ok()? * 1024)
}

/// Fills a buffer of `capacity` transitions, goes round once more by a tenth, and samples it.
pub fn fill(shape: &Shape, capacity: usize, seconds: f64) -> Memory {
    let (envs, n_step) = (8, 3);
    let before = resident();
    let mut buffer = RlBuffer::new(capacity, shape.obs, shape.slots);
    let mut nsteps = vec![NStep::new(n_step, 0.99); envs];
    let mut obs = vec![vec![0.0_f32; shape.obs]; envs];
    let (mut next, action) = (vec![0.0_f32; shape.obs], vec![0.5_f32; shape.slots]);
    let clock = Clock::start();
    let (mut pushed, mut step) = (0_usize, 0_usize);
    while pushed < capacity + capacity / 10 {
        for env in 0..envs {
            // Distinct numbers in every observation, as a plant gives them.
            next.iter_mut().enumerate().for_each(|(i, v)| *v = (step * envs + env) as f32 + i as f32 * 1e-3);
            let end = (step + env) % shape.episode == 0;
            nsteps[env].push(&obs[env], &action, 0, 1.0, &next, end, false, |t| {
                buffer.push(&t);
                pushed += 1;
            });
            obs[env].copy_from_slice(&next);
            if end {
                obs[env][0] += 0.5;
            }
        }
        step += 1;
    }
    let fill_rate = pushed as f64 / clock.wall_s();
    let resident_bytes = resident().zip(before).map(|(now, then)| now.saturating_sub(then));
    let label = Label { case: "replay", what: format!("{}, batches of 512", shape.name), unit: "batches", flop: 0.0 };
    let (mut rng, mut batch) = (SeedTree::new(1).stream("bench"), RlBatch::default());
    let sampling = repeat(&label, 1, seconds, || {
        buffer.sample(512, &mut rng, &mut batch);
        1
    });
    let own_bytes = buffer.bytes() as u64;
    Memory { name: shape.name, transitions: buffer.len(), resident_bytes, own_bytes, fill_rate, sampling }
}
