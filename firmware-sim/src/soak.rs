//! A long run at full speed over a hub, with random faults: does memory stay flat, and is every frame accounted for?
//!
//! One process holds the hub, the plant with its host, the node in a thread of its own and a listener; all of them are
//! members of the hub and speak SLCAN over a unix socket. Frames are compared where they enter the hub's wire (behind the
//! faults, which are injected on purpose) and where the listener receives them: number, order and content by a running
//! hash, and the sequence numbers that they carry. Lockstep adds a count of its own at every barrier.

use std::cell::RefCell;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use gadm_envs::{Disturbance, Env, EnvError, EnvSpec, EnvState, Step};
use gadm_node::protocol::{Function, NodeId, address};
use gadm_node::service::Tick;
use gadm_node::{Frame, Link, LinkError};
use gadm_runtime::Policy;
use serde::Serialize;

use crate::bus::hub::{Hub, Options as HubOptions, Slow};
use crate::bus::stream::SlcanStream;
use crate::bus::{Address, Bus, lockstep};
use crate::fault::{Fault, parse};
use crate::result::FaultReport;
use crate::sil::{node_config, policy_layout, read_image, simulate_on};
use crate::target::{Expected, Remote, ServeOptions, serve};
use crate::{RunOptions, SimError, episode_seed};

/// Memory is looked at so often in a soak.
const SAMPLES: u64 = 50;

/// Memory may grow by this after the first fifth of the steps, bytes.
pub const GROWTH_LIMIT: u64 = 4 << 20;

/// What to soak.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// The policy file.
    pub policy: PathBuf,
    /// Control steps.
    pub steps: u64,
    /// Seed of plant and faults.
    pub seed: u64,
}

/// Memory at a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Sample {
    /// Control step.
    pub step: u64,
    /// Resident memory of the whole process, bytes.
    pub resident: u64,
}

/// Frames at one place.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Flow {
    /// Frames.
    pub frames: u64,
    /// Hash over all of them, in order.
    pub hash: u64,
    /// Ticks whose number did not follow that of the tick before.
    pub tick_jumps: u64,
    /// Action sets whose sequence number did not.
    pub set_jumps: u64,
    #[serde(skip)]
    tick: Option<u32>,
    #[serde(skip)]
    set: Option<u8>,
}

/// What a soak found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Soak {
    /// Control steps.
    pub steps: u64,
    /// Episodes that the plant began.
    pub episodes: u64,
    /// Wall time, s.
    pub wall_s: f64,
    /// Faults.
    pub faults: Vec<FaultReport>,
    /// All frames as the run put them on the wire or took them from it.
    pub wire: Flow,
    /// All frames as the listener received them.
    pub heard: Flow,
    /// Periods in which an action was older than three periods, or beyond its bounds.
    pub violations: u64,
    /// Memory over time.
    pub memory: Vec<Sample>,
    /// Growth of memory after the first fifth of the steps, bytes.
    pub growth: u64,
}

impl Soak {
    /// No frame was lost, doubled, altered or overtaken on the hub.
    #[must_use]
    pub fn whole(&self) -> bool {
        self.wire == self.heard && self.wire.frames > 0
    }

    /// What is wrong; empty where all is well.
    #[must_use]
    pub fn troubles(&self) -> Vec<String> {
        let mut troubles = Vec::new();
        if !self.whole() {
            troubles
                .push(format!("frames differ between the run, {:?}, and the listener, {:?}", self.wire, self.heard));
        }
        if self.growth > GROWTH_LIMIT {
            troubles.push(format!("memory grew by {} KiB, allowed are {}", self.growth >> 10, GROWTH_LIMIT >> 10));
        }
        if self.violations > 0 {
            troubles.push(format!("{} periods with an action that was too old or out of bounds", self.violations));
        }
        for f in self.faults.iter().filter(|f| f.injected == 0) {
            troubles.push(format!("fault `{}` was never injected", f.fault.name));
        }
        troubles
    }
}

/// The faults of a soak: all kinds that do not need a node in this process, each now and then.
fn faults() -> Vec<Fault> {
    [
        "layer='frame'; kind='drop'; p=0.002",
        "layer='frame'; kind='burst'; enter=0.001; exit=0.3; name='bursts to the plant'; target='plant'",
        "layer='frame'; kind='delay'; ticks=1; p=0.001",
        "layer='frame'; kind='duplicate'; p=0.002",
        "layer='frame'; kind='reorder'; p=0.001; within=3",
        "layer='frame'; kind='corrupt'; p=0.002",
        "layer='frame'; kind='corrupt-id'; p=0.001",
        "layer='frame'; kind='truncate'; p=0.001",
        "layer='frame'; kind='replay'; p=0.001; age=20",
        "layer='frame'; kind='inversion'; p=0.01",
        "layer='frame'; kind='drop'; p=0.002; name='losses to the host'; target='host'",
        "layer='sensor'; kind='noise'; sd=0.0005",
        "layer='sensor'; kind='intermittent'; enter=0.0005; exit=0.5",
        "layer='sensor'; kind='garbage'; p=0.0005",
        "layer='actuator'; kind='lag'; ticks=0.2",
        "layer='node'; kind='slow-inference'; ticks=1; p=0.0005",
    ]
    .into_iter()
    .filter_map(|text| {
        // The list is fixed; the catalogue's tests read every kind.
        text.replace("; ", "\n").parse().ok().and_then(|table| parse(table).ok())
    })
    .collect()
}

/// Runs a soak. `progress` hears of the steps.
///
/// # Errors
/// Everything in [`SimError`].
#[expect(clippy::disallowed_methods, reason = "the wall time of the soak is one of its results")]
pub fn soak(options: &Options, progress: &mut dyn FnMut(u64)) -> Result<Soak, SimError> {
    let started = Instant::now();
    let image = read_image(&options.policy)?;
    let policy = Policy::load(&image).map_err(SimError::Policy)?;
    let run = RunOptions { episodes: 1, seed: options.seed, faults: faults(), ..RunOptions::new(&options.policy) };
    let env = gadm_envs::make(policy.provenance().environment)?;
    let episodes = Arc::new(AtomicU64::new(0));
    let env = Endless { inner: env, left: options.steps, episodes: Arc::clone(&episodes), seed: options.seed };

    let path = std::env::temp_dir().join(format!("gadm-soak-{}.sock", std::process::id()));
    let failed =
        |e: &dyn std::fmt::Display| SimError::Remote { bus: format!("unix:{}", path.display()), what: e.to_string() };
    // Nobody may be faster than the slowest: then a frame that is missing was lost.
    let hub_options = HubOptions { slow: Slow::Wait(Duration::from_mins(1)), ..HubOptions::default() };
    let mut hub = Hub::new(hub_options, None, |_| {});
    hub.listen_unix(&path).map_err(|e| failed(&e))?;
    let open = || SlcanStream::open(&Address::Unix(path.clone()), run.bit_rate).map_err(|e| failed(&e));

    let listened: Arc<Mutex<Flow>> = Arc::default();
    let done = Arc::new(AtomicBool::new(false));
    let (mut ears, mut node_bus, plant_bus) = (open()?, open()?, open()?);
    let config = node_config(&run);
    let expected = Expected {
        bus: format!("unix:{}", path.display()),
        node: NodeId::DEFAULT,
        policy_crc: policy.header().payload_crc32,
        profile: run.profile,
        action_frames: policy_layout(&policy, run.profile)?.action_parts(),
        patience: Duration::from_secs(30),
    };
    let wired = Rc::new(RefCell::new(Flow::default()));
    let mut memory = Vec::new();
    let result = std::thread::scope(|scope| {
        let (heard, stop) = (Arc::clone(&listened), Arc::clone(&done));
        let listener = scope.spawn(move || listen(&mut ears, &heard, &stop));
        let image = &image;
        scope.spawn(move || {
            // Its end is the end of the hub; what goes wrong before shows as a node that does not answer.
            serve(&mut node_bus, image, ServeOptions { config, realtime: None }, &mut |_| {})
        });
        let every = (options.steps / SAMPLES).max(1);
        let mut watch = |steps: u64| {
            progress(steps);
            if memory.last().is_none_or(|s: &Sample| steps >= s.step + every) {
                memory.push(Sample { step: steps, resident: resident() });
            }
        };
        let result = simulate_on(&run, image, Box::new(env), None, &mut |p| watch(p.steps), |port, bus| {
            let counted = Counted { inner: port, flow: Rc::clone(&wired) };
            Remote::start(counted, bus.clone(), Box::new(plant_bus), expected, None)
        });
        // What is on its way is given time to arrive; frames that never come are told by the comparison.
        let wanted = wired.borrow().frames;
        for _ in 0..600 {
            if lock(&listened).frames >= wanted || result.is_err() {
                break;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        done.store(true, Ordering::Relaxed);
        drop(hub);
        let _ = listener.join();
        result
    })?;
    let (wire, heard) = (*wired.borrow(), *lock(&listened));
    let settled = memory.iter().find(|s| s.step >= options.steps / 5).map_or(0, |s| s.resident);
    let most = memory.iter().filter(|s| s.step >= options.steps / 5).map(|s| s.resident).max().unwrap_or(0);
    let episode = result.episodes.first();
    let violations = episode.map_or(0, |e| e.out_of_bounds + u64::from(e.max_action_age > 3));
    Ok(Soak {
        steps: result.steps,
        episodes: episodes.load(Ordering::Relaxed),
        wall_s: started.elapsed().as_secs_f64(),
        faults: result.faults,
        wire,
        heard,
        violations,
        memory,
        growth: most.saturating_sub(settled),
    })
}

fn lock(flow: &Mutex<Flow>) -> std::sync::MutexGuard<'_, Flow> {
    // A poisoned lock still holds whole numbers.
    flow.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Flow {
    fn count(&mut self, frame: &Frame) {
        self.frames += 1;
        let mut mix = |word: u64| self.hash = episode_seed(self.hash, word);
        mix(u64::from(frame.raw_id()) << 8 | frame.payload().len() as u64);
        for chunk in frame.payload().chunks(8) {
            mix(chunk.iter().fold(0, |word, byte| word << 8 | u64::from(*byte)));
        }
        if let Some(tick) = Tick::parse(frame) {
            self.tick_jumps += u64::from(self.tick.is_some_and(|last| tick.tick != last.wrapping_add(1)));
            self.tick = Some(tick.tick);
        } else if let (Some(Function::Action), Some(&seq)) = (function(frame), frame.payload().first()) {
            self.set_jumps += u64::from(self.set.is_some_and(|last| seq != last.wrapping_add(1)));
            self.set = Some(seq);
        }
    }
}

fn function(frame: &Frame) -> Option<Function> {
    frame.standard_id().and_then(address).map(|a| a.message.function)
}

/// Counts what passes between the faults and the wire.
struct Counted<L> {
    inner: L,
    flow: Rc<RefCell<Flow>>,
}

impl<L: Link> Link for Counted<L> {
    fn receive(&mut self, frame: &mut Frame) -> Result<bool, LinkError> {
        let came = self.inner.receive(frame)?;
        if came {
            self.flow.borrow_mut().count(frame);
        }
        Ok(came)
    }

    fn send(&mut self, frame: &Frame) -> Result<(), LinkError> {
        self.flow.borrow_mut().count(frame);
        self.inner.send(frame)
    }

    fn restart(&mut self) -> Result<(), LinkError> {
        self.inner.restart()
    }
}

/// Receives everything that is on the hub.
fn listen(bus: &mut SlcanStream, heard: &Mutex<Flow>, stop: &AtomicBool) -> io::Result<()> {
    let mut frame = Frame::empty();
    while !stop.load(Ordering::Relaxed) {
        bus.wait(Duration::from_millis(100))?;
        let mut heard = lock(heard);
        while bus.receive(&mut frame).map_err(|e| io::Error::other(e.to_string()))? {
            if !lockstep::is_lockstep(&frame) {
                heard.count(&frame);
            }
        }
    }
    Ok(())
}

/// An environment whose episodes follow each other until the steps are done: one long episode from outside.
struct Endless {
    inner: Box<dyn Env>,
    left: u64,
    episodes: Arc<AtomicU64>,
    seed: u64,
}

impl Env for Endless {
    fn spec(&self) -> &EnvSpec {
        self.inner.spec()
    }

    fn reset(&mut self, seed: u64, obs: &mut [f32]) {
        self.episodes.fetch_add(1, Ordering::Relaxed);
        self.inner.reset(seed, obs);
    }

    fn step(&mut self, action: &[f32], obs: &mut [f32]) -> Step {
        let mut step = self.inner.step(action, obs);
        self.left = self.left.saturating_sub(1);
        if step.terminated || step.truncated {
            let episode = self.episodes.load(Ordering::Relaxed);
            self.reset(episode_seed(self.seed, episode), obs);
        }
        (step.terminated, step.truncated) = (false, self.left == 0);
        step
    }

    fn state(&self) -> EnvState {
        self.inner.state()
    }

    fn restore(&mut self, state: &EnvState) -> Result<(), EnvError> {
        self.inner.restore(state)
    }

    fn disturb(&mut self, disturbance: Disturbance) -> Result<(), EnvError> {
        self.inner.disturb(disturbance)
    }
}

/// Resident memory of this process, bytes; 0 where the system does not tell.
fn resident() -> u64 {
    let text = fs::read_to_string(Path::new("/proc/self/status")).unwrap_or_default();
    let line = text.lines().find_map(|l| l.strip_prefix("VmRSS:"));
    let kib = line.and_then(|l| l.trim().strip_suffix("kB")).and_then(|n| n.trim().parse::<u64>().ok());
    kib.unwrap_or(0) << 10
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_faults_of_the_list_are_known() {
        assert_eq!(faults().len(), 16);
        assert!(resident() > 1 << 20, "this system tells");
    }

    #[test]
    fn a_flow_tells_lost_and_swapped_frames() {
        let frames: Vec<Frame> = (0..5).map(|tick| Tick { tick, time_us: 0 }.frame()).collect();
        let flow = |order: &[usize]| {
            let mut flow = Flow::default();
            for i in order {
                flow.count(&frames[*i]);
            }
            flow
        };
        assert_eq!(flow(&[0, 1, 2, 3, 4]).tick_jumps, 0);
        assert_eq!(flow(&[0, 1, 3, 4]).tick_jumps, 1);
        let swapped = flow(&[0, 2, 1, 3, 4]);
        assert!(swapped.tick_jumps == 3 && swapped.hash != flow(&[0, 1, 2, 3, 4]).hash);
    }
}
