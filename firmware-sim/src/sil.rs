//! The loop in virtual time: the plant starts a period, the node answers, the plant applies the answer.
//!
//! A run is a function of policy, plant, options and seed. Nothing here reads a clock.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::rc::Rc;

use gadm_envs::Env;
use gadm_node::codec::{Layout, Profile};
use gadm_node::{Counters, Flags, Frame, Link, LinkError, NodeConfig, NodeId, State, TimeSource};
use gadm_runtime::Policy;
use gadm_runtime::encode::AlignedImage;

use crate::bus::load::{self, BitRate};
use crate::bus::loopback::{Loopback, Port, Tap};
use crate::bus::trace::TraceWriter;
use crate::fault::{Fault, FaultyLink, Injector, Signs, Watch};
use crate::host::Host;
use crate::plant_node::PlantNode;
use crate::report::Recording;
use crate::result::{BusSummary, EpisodeResult, PolicySummary, RESULT_VERSION, ReturnSummary, RunResult};
use crate::target::{InProcess, Target};
use crate::{SimError, episode_seed, interface};

/// How often the host asks a node that is READY to run; more than once only where the bus loses frames.
const RUN_REQUESTS: u32 = 10;

/// What to run.
#[derive(Clone, Debug, PartialEq)]
pub struct RunOptions {
    /// The policy file.
    pub policy: PathBuf,
    /// Registry id of the plant; `None`: the environment that the policy names.
    pub plant: Option<String>,
    /// Episodes.
    pub episodes: u64,
    /// Seed of the run; episode `i` starts from [`episode_seed`]`(seed, i)`.
    pub seed: u64,
    /// How values travel.
    pub profile: Profile,
    /// Bit rates, for the load and the time stamps.
    pub bit_rate: BitRate,
    /// Run although the policy does not fit the bus: this bus has no bit time and loses nothing, a real one would.
    pub allow_overload: bool,
    /// Where to write the trace.
    pub trace: Option<PathBuf>,
    /// What goes wrong.
    pub faults: Vec<Fault>,
    /// Watches the first episode for a report.
    pub record: Option<Recording>,
}

impl RunOptions {
    /// 20 episodes with seed 0 in `fd-f32` on the policy's own environment, without a trace.
    pub fn new(policy: impl Into<PathBuf>) -> Self {
        Self {
            policy: policy.into(),
            plant: None,
            episodes: 20,
            seed: 0,
            profile: Profile::FdF32,
            bit_rate: BitRate::default(),
            allow_overload: false,
            trace: None,
            faults: Vec::new(),
            record: None,
        }
    }
}

/// How far a run is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Episodes that ended.
    pub episodes: u64,
    /// Control periods so far.
    pub steps: u64,
    /// Mean return of the episodes that ended; 0 before the first.
    pub mean_return: f64,
}

/// Reads a policy file into memory aligned as the runtime wants it.
///
/// # Errors
/// [`SimError::Read`].
pub fn read_image(path: &Path) -> Result<AlignedImage, SimError> {
    let bytes = std::fs::read(path).map_err(|source| SimError::Read { path: path.to_owned(), source })?;
    Ok(AlignedImage::new(&bytes))
}

/// Runs a policy file on a plant of the registry.
///
/// # Errors
/// Everything in [`SimError`]; the trace then holds what was sent until there.
pub fn run(options: &RunOptions) -> Result<RunResult, SimError> {
    run_with_progress(options, &mut |_| {})
}

/// As [`run`], and tells how far it is: at every episode's end and every 256 steps.
///
/// # Errors
/// As [`run`].
pub fn run_with_progress(options: &RunOptions, progress: &mut dyn FnMut(Progress)) -> Result<RunResult, SimError> {
    run_with(options, progress, |image, env, tap, progress| simulate(options, image, env, tap, progress))
}

/// Reads the policy of `options`, makes the plant and opens the trace, and lets `drive` do the rest: it gets the image, the
/// plant and the tap.
///
/// # Errors
/// As [`run`], and those of `drive`.
pub fn run_with(
    options: &RunOptions,
    progress: &mut dyn FnMut(Progress),
    drive: impl FnOnce(&[u8], Box<dyn Env>, Option<Box<dyn Tap>>, &mut dyn FnMut(Progress)) -> Result<RunResult, SimError>,
) -> Result<RunResult, SimError> {
    let image = read_image(&options.policy)?;
    let policy = Policy::load(&image).map_err(SimError::Policy)?;
    let id = match &options.plant {
        Some(id) => id.clone(),
        None if policy.provenance().environment.is_empty() => return Err(SimError::NoPlant),
        None => policy.provenance().environment.to_owned(),
    };
    let mut env = gadm_envs::make(&id)?;
    if let Some(recording) = &options.record {
        env = recording.watch_env(env);
    }
    let watched = |tap| match &options.record {
        Some(recording) => Some(recording.watch_bus(tap)),
        None => tap,
    };
    let Some(path) = &options.trace else {
        return drive(&image, env, watched(None), progress);
    };
    let failed = |source| SimError::Write { path: path.clone(), source };
    let file = SharedFile(Rc::new(std::cell::RefCell::new(BufWriter::new(File::create(path).map_err(failed)?))));
    let tap: Box<dyn Tap> = Box::new(TraceWriter::new(file.clone()));
    let result = drive(&image, env, watched(Some(tap)), progress);
    file.0.borrow_mut().flush().map_err(failed)?;
    result
}

/// A file that the bus writes and the caller flushes, so that a full disk is noticed.
#[derive(Clone)]
struct SharedFile(Rc<std::cell::RefCell<BufWriter<File>>>);

impl Write for SharedFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.borrow_mut().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.borrow_mut().flush()
    }
}

/// Runs the policy in `image` on any plant, in this process. `tap` sees every frame; the paths in `options` are only
/// named in errors.
///
/// # Errors
/// Everything in [`SimError`].
pub fn simulate(
    options: &RunOptions,
    image: &[u8],
    env: Box<dyn Env>,
    tap: Option<Box<dyn Tap>>,
    progress: &mut dyn FnMut(Progress),
) -> Result<RunResult, SimError> {
    simulate_with_link(options, image, env, tap, progress, |port, _| port)
}

/// As [`simulate`], with a link of the caller's between the bus and the node. `wrap` gets the node's port, with the faults
/// of the options on it, and the bus.
///
/// # Errors
/// Everything in [`SimError`].
pub fn simulate_with_link<L: Link>(
    options: &RunOptions,
    image: &[u8],
    env: Box<dyn Env>,
    tap: Option<Box<dyn Tap>>,
    progress: &mut dyn FnMut(Progress),
    wrap: impl FnOnce(FaultyLink<Port>, &Loopback) -> L,
) -> Result<RunResult, SimError> {
    let policy = Policy::load(image).map_err(SimError::Policy)?;
    let config = node_config(options);
    let mut scratch = vec![0; policy.spec().scratch_words];
    simulate_on(options, image, env, tap, progress, |port, bus| {
        Ok(InProcess::new(config, wrap(port, bus), image, &mut scratch))
    })
}

/// As [`simulate`], with the node wherever the caller has it. `make` gets the node's port and the bus, and may put a link
/// of its own between the port and the [`Target`].
///
/// # Errors
/// Everything in [`SimError`].
pub fn simulate_on<T: Target>(
    options: &RunOptions,
    image: &[u8],
    env: Box<dyn Env>,
    tap: Option<Box<dyn Tap>>,
    progress: &mut dyn FnMut(Progress),
    make: impl FnOnce(FaultyLink<Port>, &Loopback) -> Result<T, SimError>,
) -> Result<RunResult, SimError> {
    let policy = Policy::load(image).map_err(SimError::Policy)?;
    interface::check(&policy, env.spec())?;
    if !options.allow_overload {
        load::check(&policy, options.profile, options.bit_rate)?;
    }
    let bus = Loopback::new(options.bit_rate, tap);
    let layout = policy_layout(&policy, options.profile)?;
    let injector = Injector::new(options, env.spec(), &layout, &bus)?;
    let target = make(injector.link(bus.port()), &bus)?;
    Run::new(options, &policy, env, bus, target, layout, injector).finish(progress)
}

/// How a run sets up its node.
#[must_use]
pub fn node_config(options: &RunOptions) -> NodeConfig {
    // A timer that is off can only be seen by a node that has one.
    let time = if Injector::needs_timer(&options.faults) { TimeSource::Local } else { TimeSource::Tick };
    NodeConfig { profile: options.profile, time, ..NodeConfig::default() }
}

struct Run<'o, 'p, T> {
    options: &'o RunOptions,
    policy: &'o Policy<'p>,
    bus: Loopback,
    host: Host<Port>,
    plant: PlantNode<Port>,
    target: T,
    layout: Layout,
    plant_id: String,
    period_us: u32,
    latent_counts: Vec<u64>,
    steps: u64,
    injector: Injector,
    watch: Watch<'p>,
    /// What the node counted before its last power cycle.
    counted: Counters,
}

impl<'o, 'p, T: Target> Run<'o, 'p, T> {
    fn new(
        options: &'o RunOptions,
        policy: &'o Policy<'p>,
        env: Box<dyn Env>,
        bus: Loopback,
        target: T,
        layout: Layout,
        injector: Injector,
    ) -> Self {
        let spec = env.spec();
        Self {
            options,
            policy,
            host: Host::new(bus.port(), NodeId::DEFAULT),
            plant_id: spec.id.clone(),
            period_us: spec.control_period_us,
            plant: PlantNode::new(env, bus.port(), layout.clone()),
            bus,
            target,
            layout,
            latent_counts: vec![0; usize::from(policy.spec().num_latents)],
            steps: 0,
            watch: Watch::new(*policy, injector.any()),
            injector,
            counted: Counters::default(),
        }
    }

    fn finish(mut self, progress: &mut dyn FnMut(Progress)) -> Result<RunResult, SimError> {
        self.settle()?;
        self.expect(State::Ready)?;
        let mut episodes = Vec::new();
        let mut total = 0.0;
        for episode in 0..self.options.episodes {
            let mean_return = if episode > 0 { total / episode as f64 } else { 0.0 };
            let done =
                self.episode(episode, &mut |steps| progress(Progress { episodes: episode, steps, mean_return }))?;
            total += done.ret;
            episodes.push(done);
            let mean_return = total / (episode + 1) as f64;
            progress(Progress { episodes: episode + 1, steps: self.steps, mean_return });
        }
        Ok(self.result(episodes))
    }

    fn episode(&mut self, episode: u64, progress: &mut dyn FnMut(u64)) -> Result<EpisodeResult, SimError> {
        let seed = episode_seed(self.options.seed, episode);
        let mut e = EpisodeResult {
            episode,
            seed,
            ret: 0.0,
            steps: 0,
            terminated: false,
            truncated: false,
            held: 0,
            safe: 0,
            missing: 0,
            fallback: 0,
            clipped: 0,
            late: 0,
            max_action_age: 0,
            out_of_bounds: 0,
            faults: None,
            fault_spans: Vec::new(),
        };
        self.plant.reset(seed);
        self.bus.set_time(self.plant.now_us());
        self.injector.begin_episode();
        self.recover()?;
        self.watch.begin_episode(self.node_counted());
        for _ in 0..RUN_REQUESTS {
            self.sent("host", |s| s.host.run())?;
            self.settle()?;
            if self.host.state() != Some(State::Ready) {
                break;
            }
        }
        if self.host.state() != Some(State::Safe) {
            self.expect(State::Run)?; // from SAFE the node needs good sets first; the host goes on asking
        }
        while !(e.terminated || e.truncated) {
            let now_us = self.plant.now_us();
            self.bus.set_time(now_us);
            if self.injector.begin_tick(e.steps, now_us, self.plant.env_mut())? {
                self.power_cycle()?;
            }
            self.sent("host", |s| s.host.step(now_us))?;
            self.sent("plant", |s| s.plant.sense(|obs| s.injector.sense(obs)))?;
            self.settle()?;
            self.watch.decide(self.plant.observation());
            let (step, applied) = self.sent("plant", |s| s.plant.drive(|action| s.injector.actuate(action)))?;
            let signs = Signs { applied, fault: self.host.fault(), counted: self.node_counted() };
            self.watch.observe(e.steps, self.injector.first_tick(), &signs, self.plant.applied());
            e.max_action_age = e.max_action_age.max(applied.age);
            e.out_of_bounds += u64::from(!applied.legal);
            e.ret += step.reward;
            e.steps += 1;
            (e.terminated, e.truncated) = (step.terminated, step.truncated);
            let has = |flag| u64::from(applied.flags.contains(flag));
            e.held += has(Flags::HELD);
            e.safe += has(Flags::SAFE);
            e.fallback += has(Flags::FALLBACK);
            e.clipped += has(Flags::CLIPPED);
            e.late += has(Flags::LATE);
            e.missing += u64::from(!applied.fresh);
            let decided = applied.fresh && !applied.flags.contains(Flags::HELD);
            if let (true, Some(count)) = (decided, self.latent_counts.get_mut(usize::from(applied.latent))) {
                *count += 1;
            }
            self.steps += 1;
            if self.steps.is_multiple_of(256) {
                progress(self.steps);
            }
            if self.host.state() == Some(State::Fault) && !self.injector.any() {
                self.expect(State::Run)?;
            }
        }
        let (first_tick, spans) = self.injector.end_episode(self.plant.env_mut())?;
        e.faults = self.injector.any().then(|| self.watch.end_episode(first_tick));
        e.fault_spans = spans;
        self.bus.set_time(self.plant.now_us());
        self.sent("host", |s| s.host.stop())?;
        self.settle()?;
        Ok(e)
    }

    /// Lets the node and the host handle everything that is on the bus.
    fn settle(&mut self) -> Result<(), SimError> {
        if self.injector.node_runs() {
            self.target.settle(self.injector.node_time_us(self.plant.now_us()))?;
        }
        self.sent("host", |s| s.host.listen())?;
        let failed = |source| SimError::Write { path: self.options.trace.clone().unwrap_or_default(), source };
        self.bus.check().map_err(failed)
    }

    /// After an episode with faults: a node that did not find its way back is started again, so that every episode begins
    /// alike. Without faults this is left to the host, and an emergency stop always is.
    fn recover(&mut self) -> Result<(), SimError> {
        let lost = self.host.state() != Some(State::Ready) && self.host.fault() != gadm_node::Fault::Estop;
        if !self.injector.any() || !lost {
            return Ok(());
        }
        self.counted = self.node_counted().unwrap_or_default();
        self.sent("host", |s| s.host.reset())?;
        self.settle()?;
        self.expect(State::Ready)
    }

    fn power_cycle(&mut self) -> Result<(), SimError> {
        self.counted = self.node_counted().unwrap_or_default();
        self.target.power_cycle()
    }

    /// What the node counted in the whole run, power cycles included.
    fn node_counted(&self) -> Option<Counters> {
        self.target.status().map(|s| self.counted.plus(s.counters))
    }

    fn sent<R>(
        &mut self,
        participant: &'static str,
        f: impl FnOnce(&mut Self) -> Result<R, LinkError>,
    ) -> Result<R, SimError> {
        f(self).map_err(|source| SimError::Bus { participant, now_us: self.plant.now_us(), source })
    }

    fn expect(&self, expected: State) -> Result<(), SimError> {
        let found = self.host.state();
        if found == Some(expected) {
            return Ok(());
        }
        let fault = self.host.fault();
        let next = match found {
            Some(State::NoPolicy) => "export the policy again with this version of the programs",
            Some(State::Fault) => "look at the trace (--trace FILE), then reset the node",
            _ => "look at the trace (--trace FILE)",
        };
        Err(SimError::Node {
            expected: expected.name(),
            state: found.map_or("no heartbeat", State::name).to_owned(),
            fault: fault.name(),
            meaning: fault.meaning(),
            next,
        })
    }

    fn result(self, episodes: Vec<EpisodeResult>) -> RunResult {
        let (frames, busy_s) = self.bus.traffic();
        let virtual_s = self.plant.now_us() as f64 / 1e6;
        let load = load::load(&self.layout, self.period_us, self.options.bit_rate);
        let provenance = self.policy.provenance();
        let mut warnings = Vec::new();
        if let Some(excess) = load.excess() {
            warnings.push(format!("does not fit a real bus: {excess}; `gadm-sim bus load` says what does"));
        }
        if !provenance.environment.is_empty() && !provenance.environment.eq_ignore_ascii_case(&self.plant_id) {
            warnings.push(format!("trained for `{}`, run on `{}`", provenance.environment, self.plant_id));
        }
        let returns: Vec<f64> = episodes.iter().map(|e| e.ret).collect();
        let node = self.node_counted();
        RunResult {
            version: RESULT_VERSION,
            policy: PolicySummary {
                environment: provenance.environment.to_owned(),
                interface_hash: format!("{:016x}", self.policy.interface_hash()),
                crc32: format!("{:08x}", self.policy.header().payload_crc32),
                num_latents: self.policy.spec().num_latents,
                bytes: self.policy.header().total_len as usize,
            },
            plant: self.plant_id,
            target: self.target.name().to_owned(),
            profile: self.options.profile.name(),
            seed: self.options.seed,
            returns: ReturnSummary::of(&returns),
            episodes,
            latents_used: self.latent_counts.iter().filter(|&&n| n > 0).count(),
            latent_counts: self.latent_counts,
            steps: self.steps,
            virtual_s,
            node,
            faults: self.injector.report(),
            timing: self.target.timing(),
            bus: BusSummary {
                bit_rate: self.options.bit_rate,
                load,
                measured_percent: if virtual_s > 0.0 { busy_s / virtual_s * 100.0 } else { 0.0 },
                frames,
                plant_errors: self.plant.errors(),
            },
            warnings,
        }
    }
}

/// The frames of a policy for node 1.
///
/// # Errors
/// [`SimError::Layout`] where the profile cannot carry it.
pub fn policy_layout(policy: &Policy, profile: Profile) -> Result<Layout, SimError> {
    Layout::of_policy(policy, profile, NodeId::DEFAULT)
        .map_err(|source| SimError::Layout { profile: profile.name(), source })
}

/// A tap that keeps every frame in memory, for tests and for programs that look at a run at once.
#[derive(Clone, Debug, Default)]
pub struct Recorder(Rc<std::cell::RefCell<Vec<(u64, Frame)>>>);

impl Recorder {
    /// What was recorded so far: time stamp in microseconds, frame.
    #[must_use]
    pub fn frames(&self) -> Vec<(u64, Frame)> {
        self.0.borrow().clone()
    }
}

impl Tap for Recorder {
    fn frame(&mut self, time_us: u64, frame: &Frame) -> io::Result<()> {
        self.0.borrow_mut().push((time_us, *frame));
        Ok(())
    }
}
