//! All faults of one run: one clock, one seed, one count.

use std::cell::RefCell;
use std::rc::Rc;

use gadm_envs::{Disturbance, Env, EnvSpec};
use gadm_node::{Flags, Frame, Layout, Link, Profile};
use gadm_runtime::ActionHead;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use super::actuator::ActuatorState;
use super::bus::BusFault;
use super::frame::FrameFault;
use super::link::FaultyLink;
use super::node::NodeFault;
use super::plant::PlantFault;
use super::sensor::SensorState;
use super::spec::{Fault, Kind, Window};
use crate::bus::load::BitRate;
use crate::bus::loopback::{Loopback, Port};
use crate::result::FaultReport;
use crate::sil::RunOptions;
use crate::{SimError, episode_seed};

/// Ticks of one fault in one episode, one after the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Span {
    /// Number of the fault in the scenario.
    pub fault: usize,
    /// First tick of the episode.
    pub from: u64,
    /// Last tick.
    pub to: u64,
    /// Faults injected.
    pub count: u64,
}

/// Spans that are kept of one episode.
const SPANS: usize = 2000;

/// The stream of random numbers of fault `index`.
pub(super) fn stream(seed: u64, index: usize) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(episode_seed(seed ^ 0xFA07, index as u64))
}

/// What all parts of the injector know.
#[derive(Debug, Default)]
pub(super) struct Shared {
    /// Ticks since the start of the run.
    pub(super) now: u64,
    /// Tick of the episode.
    tick: u64,
    running: bool,
    any: bool,
    /// The controller was power-cycled, or an episode begins.
    pub(super) cycled: bool,
    counts: Vec<u64>,
    first_tick: Option<u64>,
    spans: Vec<Span>,
    struck: Vec<Option<u64>>,
    /// The node has no power before this.
    dark_until: u64,
    /// Identifier of a babbling participant, and time that is left on the bus in this tick.
    babble: Option<(u32, u64)>,
    bit_rate: BitRate,
    /// Tick in which the last decision was made, and when it goes out if it is slow.
    decided: Option<u64>,
    slow_until: u64,
    slow: Vec<(usize, Window, u32, f64)>,
    rng: Option<ChaCha8Rng>,
    layout: Option<Layout>,
}

impl Shared {
    /// Nothing to do at the moment.
    pub(super) fn idle(&self) -> bool {
        !self.any || !self.running
    }

    pub(super) fn active(&self, window: Window) -> bool {
        self.running && window.contains(self.tick)
    }

    /// As [`active`](Self::active), for faults with a duration of their own.
    pub(super) fn acts(&self, window: Window, fault: &BusFault) -> bool {
        let lasting = match *fault {
            BusFault::Disconnect { ticks } | BusFault::BitRate { ticks } => u64::from(ticks),
            _ => u64::MAX,
        };
        self.active(window) && self.tick - window.from < lasting
    }

    /// True once in each tick in which an event is due: at the start of the window, and again after `every` ticks.
    pub(super) fn strikes(&mut self, index: usize, window: Window, every: u32) -> bool {
        if !self.active(window) || self.struck.get(index).copied().flatten() == Some(self.now) {
            return false;
        }
        let passed = self.tick - window.from;
        let due = if every == 0 { passed == 0 } else { passed.is_multiple_of(u64::from(every)) };
        if let (true, Some(struck)) = (due, self.struck.get_mut(index)) {
            *struck = Some(self.now);
        }
        due
    }

    /// Counts injected faults.
    pub(super) fn hit(&mut self, index: usize, n: u64) {
        if n == 0 {
            return;
        }
        if let Some(count) = self.counts.get_mut(index) {
            *count += n;
        }
        let tick = self.tick;
        self.first_tick.get_or_insert(tick);
        let room = self.spans.len() < SPANS;
        match self.spans.iter_mut().rev().find(|s| s.fault == index) {
            Some(s) if tick <= s.to + 1 => (s.to, s.count) = (tick, s.count + n),
            _ if room => self.spans.push(Span { fault: index, from: tick, to: tick, count: n }),
            _ => {}
        }
    }

    /// Whether the bus has room for a frame in this tick; takes the room.
    pub(super) fn wire_is_free(&mut self, frame: &Frame) -> bool {
        let Some((id, left)) = &mut self.babble else { return true };
        if frame.raw_id() <= *id {
            return true;
        }
        let needed = self.bit_rate.time_ns(frame);
        let free = needed <= *left;
        if free {
            *left -= needed;
        }
        free
    }

    /// The node has no power.
    pub(super) fn dark(&self) -> bool {
        self.running && self.now < self.dark_until
    }

    /// When an answer that is sent now leaves a slow node; `None` = at once.
    pub(super) fn slow(&mut self, frame: &Frame) -> Option<u64> {
        if self.slow.is_empty() {
            return None;
        }
        let layout = self.layout.as_ref()?;
        let header = match layout.profile() {
            Profile::ClassicI16 => layout.decision(frame).ok().map(|d| d.header),
            Profile::FdF32 => layout.action_part(frame).ok().map(|(header, _)| header),
        };
        // Only what was computed takes its time, not what is repeated or safe.
        let computed = header.is_some_and(|h| !h.flags.contains(Flags::HELD) && !h.flags.contains(Flags::SAFE));
        if computed && self.decided != Some(self.now) {
            self.decided = Some(self.now);
            for (index, window, ticks, p) in self.slow.clone() {
                let late = self.active(window) && self.rng.as_mut().is_some_and(|r| r.random::<f64>() < p);
                if late && self.slow_until <= self.now {
                    self.slow_until = self.now + u64::from(ticks);
                    self.hit(index, 1);
                }
            }
        }
        (self.slow_until > self.now).then_some(self.slow_until)
    }
}

/// Faults of sensors and actuators, with one state per signal.
#[derive(Debug)]
struct Sensor {
    index: usize,
    rng: ChaCha8Rng,
    states: Vec<(usize, SensorState)>,
}

#[derive(Debug)]
struct Actuator {
    index: usize,
    states: Vec<(usize, ActuatorState)>,
}

/// The faults of one run.
#[derive(Debug)]
pub struct Injector {
    faults: Vec<Fault>,
    seed: u64,
    shared: Rc<RefCell<Shared>>,
    sensors: Vec<Sensor>,
    actuators: Vec<Actuator>,
    /// Range of every observation, and of every continuous action.
    observed: Vec<(f32, f32)>,
    driven: Vec<Option<(f32, f32)>>,
    babbler: Option<Port>,
    period_ns: u64,
    /// What the plant was told last, so that it is told only what changed.
    disturbed: Vec<Option<Disturbance>>,
    drift_us: f64,
    rng: ChaCha8Rng,
}

impl Injector {
    /// The faults of a run on `bus`, with a plant of that description.
    ///
    /// # Errors
    /// [`SimError::Fault`] where a fault names a signal or an action that the plant does not have.
    pub fn new(options: &RunOptions, spec: &EnvSpec, layout: &Layout, bus: &Loopback) -> Result<Self, SimError> {
        let (faults, seed, bit_rate) = (&options.faults[..], options.seed, options.bit_rate);
        let (mut sensors, mut actuators, mut slow, mut babbler) = (Vec::new(), Vec::new(), Vec::new(), None);
        let observations: Vec<&str> = spec.observations.iter().map(|s| s.name.as_str()).collect();
        let driven: Vec<_> = spec
            .actions
            .iter()
            .map(|a| if let ActionHead::Continuous { lo, hi } = a.head { Some((lo, hi)) } else { None })
            .collect();
        let actions: Vec<&str> = spec.actions.iter().map(|s| s.name.as_str()).collect();
        for (index, fault) in faults.iter().enumerate() {
            match &fault.kind {
                Kind::Sensor(_) => {
                    let states = chosen(fault, &observations)?.map(|i| (i, SensorState::default())).collect();
                    sensors.push(Sensor { index, rng: stream(seed, index), states });
                }
                Kind::Actuator(_) => {
                    let continuous = |i: &usize| driven.get(*i).is_some_and(Option::is_some);
                    let states: Vec<_> =
                        chosen(fault, &actions)?.filter(continuous).map(|i| (i, ActuatorState::default())).collect();
                    if states.is_empty() {
                        let what = format!("`{}` has no continuous action", spec.id);
                        return Err(SimError::Fault { name: fault.name.clone(), what });
                    }
                    actuators.push(Actuator { index, states });
                }
                Kind::Node(NodeFault::SlowInference { ticks, p }) => slow.push((index, fault.window, *ticks, *p)),
                Kind::Frame(FrameFault::Babble { .. }) => {
                    babbler.get_or_insert_with(|| bus.port());
                }
                _ => {}
            }
        }
        let shared = Shared {
            any: !faults.is_empty(),
            counts: vec![0; faults.len()],
            struck: vec![None; faults.len()],
            bit_rate,
            slow,
            rng: Some(stream(seed, faults.len())),
            layout: Some(layout.clone()),
            ..Shared::default()
        };
        Ok(Self {
            seed,
            shared: Rc::new(RefCell::new(shared)),
            sensors,
            actuators,
            observed: spec.observations.iter().map(|s| (s.lo, s.hi)).collect(),
            driven,
            babbler,
            period_ns: u64::from(spec.control_period_us) * 1000,
            disturbed: vec![None; faults.len()],
            drift_us: 0.0,
            rng: stream(seed, faults.len() + 1),
            faults: faults.to_vec(),
        })
    }

    /// Puts the faults of frames and of the controller between a node and its bus.
    pub fn link<L: Link>(&self, inner: L) -> FaultyLink<L> {
        FaultyLink::new(inner, &self.faults, self.seed, Rc::clone(&self.shared))
    }

    /// True where there are faults at all.
    #[must_use]
    pub fn any(&self) -> bool {
        !self.faults.is_empty()
    }

    /// True where a fault needs a node with its own timer.
    #[must_use]
    pub fn needs_timer(faults: &[Fault]) -> bool {
        faults.iter().any(|f| matches!(f.kind, Kind::Node(NodeFault::ClockDrift { .. })))
    }

    /// Before an episode: nothing acts, and nothing is remembered.
    pub fn begin_episode(&mut self) {
        let mut shared = self.shared.borrow_mut();
        shared.running = false;
        shared.cycled = true;
        shared.first_tick = None;
        shared.spans.clear();
        (shared.slow_until, shared.decided, shared.dark_until) = (0, None, 0);
        for sensor in &mut self.sensors {
            sensor.states.iter_mut().for_each(|(_, s)| *s = SensorState::default());
        }
        for actuator in &mut self.actuators {
            actuator.states.iter_mut().for_each(|(_, s)| *s = ActuatorState::default());
        }
    }

    /// After an episode: nothing acts; returns where it hit first, and all spans.
    ///
    /// # Errors
    /// [`SimError::Plant`] where the plant cannot be set back.
    pub fn end_episode(&mut self, env: &mut dyn Env) -> Result<(Option<u64>, Vec<Span>), SimError> {
        let mut shared = self.shared.borrow_mut();
        shared.running = false;
        shared.babble = None;
        for (fault, told) in self.faults.iter().zip(&mut self.disturbed) {
            if let (Kind::Plant(kind), Some(_)) = (&fault.kind, told.take()) {
                env.disturb(neutral(kind)).map_err(SimError::Plant)?;
            }
        }
        Ok((shared.first_tick, std::mem::take(&mut shared.spans)))
    }

    /// Starts tick `tick` of the episode: disturbs the plant, babbles, and tells whether the node loses its power now.
    ///
    /// # Errors
    /// [`SimError::Plant`] where the plant cannot be disturbed, [`SimError::Bus`] where the bus takes no more.
    pub fn begin_tick(&mut self, tick: u64, now_us: u64, env: &mut dyn Env) -> Result<bool, SimError> {
        if !self.any() {
            return Ok(false);
        }
        let mut babble: Option<(u32, u64)> = None;
        {
            let mut shared = self.shared.borrow_mut();
            (shared.running, shared.tick) = (true, tick);
            shared.now += 1;
        }
        // It boots when the power comes back; what it did in the dark is forgotten.
        let mut cycle = self.shared.borrow().dark_until == self.shared.borrow().now;
        for (index, fault) in self.faults.iter().enumerate() {
            let mut shared = self.shared.borrow_mut();
            let active = shared.active(fault.window);
            match &fault.kind {
                Kind::Node(NodeFault::Reset { ticks, every }) if shared.strikes(index, fault.window, *every) => {
                    shared.hit(index, 1);
                    shared.dark_until = shared.now + u64::from(*ticks);
                    cycle = true;
                }
                Kind::Node(NodeFault::ClockDrift { ppm }) if active => {
                    self.drift_us += ppm * 1e-6 * self.period_ns as f64 / 1000.0;
                    shared.hit(index, 1);
                }
                Kind::Frame(FrameFault::Babble { frames, id }) if active => {
                    shared.hit(index, u64::from(*frames));
                    drop(shared);
                    let Some(port) = &mut self.babbler else { continue };
                    let (mut time_ns, mut ignored) = (0, Frame::empty());
                    let failed = |source| SimError::Bus { participant: "babbler", now_us, source };
                    while port.receive(&mut ignored).map_err(failed)? {}
                    for _ in 0..*frames {
                        let noise: [u8; 8] = self.rng.random();
                        let Some(frame) = Frame::classic(gadm_node::frame::standard(*id), &noise) else { continue };
                        time_ns += self.shared.borrow().bit_rate.time_ns(&frame);
                        port.send(&frame).map_err(failed)?;
                    }
                    let left = babble.map_or(self.period_ns, |(_, left)| left).saturating_sub(time_ns);
                    babble = Some((u32::from(*id), left));
                }
                Kind::Plant(kind) => {
                    let wanted = disturbance(kind, fault.window, tick, active);
                    if wanted.is_some() {
                        shared.hit(index, 1);
                    }
                    if let Some(told) = self.disturbed.get_mut(index).filter(|told| **told != wanted) {
                        env.disturb(wanted.unwrap_or(neutral(kind))).map_err(SimError::Plant)?;
                        *told = wanted;
                    }
                }
                _ => {}
            }
        }
        let mut shared = self.shared.borrow_mut();
        shared.babble = babble;
        shared.cycled |= cycle;
        Ok(cycle)
    }

    /// What the sensors tell instead of `obs`.
    pub fn sense(&mut self, obs: &mut [f32]) {
        let mut shared = self.shared.borrow_mut();
        for sensor in &mut self.sensors {
            let Some(fault) = self.faults.get(sensor.index) else { continue };
            let Kind::Sensor(kind) = &fault.kind else { continue };
            let active = shared.active(fault.window);
            let mut lied = false;
            for (i, state) in &mut sensor.states {
                let (Some(value), Some(range)) = (obs.get_mut(*i), self.observed.get(*i)) else { continue };
                if let Some(told) = state.read(kind, *value, *range, active, &mut sensor.rng) {
                    lied |= told.to_bits() != value.to_bits();
                    *value = told;
                }
            }
            shared.hit(sensor.index, u64::from(lied));
        }
    }

    /// What the actuators do instead of `action`.
    pub fn actuate(&mut self, action: &mut [f32]) {
        let mut shared = self.shared.borrow_mut();
        for actuator in &mut self.actuators {
            let Some(fault) = self.faults.get(actuator.index) else { continue };
            let Kind::Actuator(kind) = &fault.kind else { continue };
            let active = shared.active(fault.window);
            let mut disobeyed = false;
            for (i, state) in &mut actuator.states {
                let (Some(value), Some(Some(range))) = (action.get_mut(*i), self.driven.get(*i)) else { continue };
                if let Some(does) = state.act(kind, *value, *range, active) {
                    disobeyed = true;
                    *value = does;
                }
            }
            shared.hit(actuator.index, u64::from(disobeyed));
        }
    }

    /// Whether the node's program runs in this tick: it neither hangs nor is busy with a slow decision.
    pub fn node_runs(&mut self) -> bool {
        let mut shared = self.shared.borrow_mut();
        if shared.idle() {
            return true;
        }
        let mut hangs = false;
        for (index, fault) in self.faults.iter().enumerate() {
            if let Kind::Node(NodeFault::Hang { ticks }) = fault.kind
                && shared.active(fault.window)
                && shared.tick - fault.window.from < u64::from(ticks)
            {
                shared.hit(index, 1);
                hangs = true;
            }
        }
        !hangs && shared.slow_until <= shared.now
    }

    /// The time of the node's own timer, microseconds.
    #[must_use]
    pub fn node_time_us(&self, now_us: u64) -> u64 {
        (now_us as f64 + self.drift_us).max(0.0) as u64
    }

    /// Faults injected so far, in the order of the scenario.
    #[must_use]
    pub fn report(&self) -> Vec<FaultReport> {
        let shared = self.shared.borrow();
        let reports = self.faults.iter().zip(&shared.counts);
        reports.map(|(f, &injected)| FaultReport { fault: f.clone(), injected, counts: f.row().counts }).collect()
    }

    /// Tick of the episode in which the first fault was injected.
    #[must_use]
    pub fn first_tick(&self) -> Option<u64> {
        self.shared.borrow().first_tick
    }
}

/// Positions of the signals that a fault names; all where it names none.
fn chosen<'a>(fault: &'a Fault, names: &'a [&'a str]) -> Result<impl Iterator<Item = usize> + 'a, SimError> {
    if let Some(unknown) = fault.signals.iter().find(|s| !names.contains(&s.as_str())) {
        let what = format!("the plant has no signal `{unknown}`; it has {}", names.join(", "));
        return Err(SimError::Fault { name: fault.name.clone(), what });
    }
    let all = fault.signals.is_empty();
    Ok((0..names.len()).filter(move |i| all || fault.signals.iter().any(|s| s == names[*i])))
}

/// What the plant suffers at a tick.
fn disturbance(kind: &PlantFault, window: Window, tick: u64, active: bool) -> Option<Disturbance> {
    if !active {
        return None;
    }
    Some(match *kind {
        PlantFault::Mass { factor } => Disturbance::Mass { factor },
        PlantFault::Friction { factor } => Disturbance::Friction { factor },
        PlantFault::Gravity { factor } => Disturbance::Gravity { factor },
        PlantFault::Push { force, ticks, every } => {
            let passed = tick - window.from;
            let passed = if every > 0 { passed % u64::from(every) } else { passed };
            if passed >= u64::from(ticks) {
                return None;
            }
            Disturbance::Push { force_n: [force, 0.0, 0.0] }
        }
    })
}

/// What takes a disturbance back.
fn neutral(kind: &PlantFault) -> Disturbance {
    match kind {
        PlantFault::Mass { .. } => Disturbance::Mass { factor: 1.0 },
        PlantFault::Friction { .. } => Disturbance::Friction { factor: 1.0 },
        PlantFault::Gravity { .. } => Disturbance::Gravity { factor: 1.0 },
        PlantFault::Push { .. } => Disturbance::Push { force_n: [0.0; 3] },
    }
}
