//! The node: boots a policy, answers each control period with an action, and goes to a safe state when it cannot.

use gadm_runtime::{Policy, Scratch};

use crate::assemble::Assembler;
use crate::codec::{ActionHeader, Decision, Flags, FrameError, Layout, Profile};
use crate::frame::Frame;
use crate::link::{Link, LinkError};
use crate::protocol::{Function, HEARTBEAT_PERIOD_US, MAX_ACTIONS, MAX_OBSERVATIONS, NO_LATENT, NodeId, address};
use crate::safety::{Event, Fault, GOOD_SETS, HOLD_LIMIT, INVALID_LIMIT, SILENCE_US, STALE_LIMIT, State, next};
use crate::service::{
    Estop, Heartbeat, HostHeartbeat, Mode, ModeCommand, OP_READ, OP_REFUSED, Page, Reply, Request, Tick, concerns,
};
use crate::shaper::Shaper;
use crate::timing::PeriodMonitor;
use crate::watch::{CrcWatch, Restarts};

/// Frames that one [`ControlNode::poll`] handles at most, so that a babbling bus cannot hold it.
const FRAMES_PER_POLL: usize = 512;

/// Where the node's time comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TimeSource {
    /// The TICK frames (lockstep): the argument of [`ControlNode::poll`] is ignored, so a node that is linked in and one
    /// in an emulator behave alike to the byte. Without ticks no time passes.
    Tick,
    /// The argument of [`ControlNode::poll`], from a timer of the board.
    Local,
}

/// How a node is set up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NodeConfig {
    /// Node number.
    pub node: NodeId,
    /// How values travel.
    pub profile: Profile,
    /// Where time comes from.
    pub time: TimeSource,
    /// Control periods that the way from the last action to the safe one takes.
    pub ramp_ticks: u16,
    /// Largest change of a continuous action in one period, as a fraction of its range; `None` = no limit.
    pub rate_limit: Option<f32>,
    /// Number of the slot that the policy image came from, reported in the heartbeat.
    pub slot: u8,
}

impl Default for NodeConfig {
    /// Node 1, `fd-f32`, lockstep, a ramp of 5 periods, no rate limit.
    fn default() -> Self {
        Self {
            node: NodeId::DEFAULT,
            profile: Profile::FdF32,
            time: TimeSource::Tick,
            ramp_ticks: 5,
            rate_limit: None,
            slot: 0,
        }
    }
}

/// What the node counted since it booted. All counters saturate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Action sets computed by the policy.
    pub acted: u32,
    /// Action sets that repeated the last action.
    pub held: u32,
    /// Action sets with the safe action or a step of the ramp.
    pub safe: u32,
    /// Control periods in RUN without a good observation set.
    pub missed: u32,
    /// Parts that came after their tick had passed.
    pub late: u32,
    /// Observation sets dropped as incomplete.
    pub torn: u32,
    /// Ticks and parts ignored as duplicate or out of sequence.
    pub sequence: u32,
    /// Frames dropped for a wrong CRC, kind, length or header.
    pub crc_errors: u32,
    /// Observation sets with an invalid value.
    pub invalid: u32,
    /// Decisions in which an observation or an action was cut to its limits.
    pub clipped: u32,
    /// Decisions in which the mask left no latent.
    pub fallback: u32,
    /// Entries into SAFE.
    pub safe_entries: u32,
    /// RUN requests that were refused.
    pub refused: u32,
    /// Frames that the bus did not take, and other bus errors.
    pub bus_errors: u32,
}

/// What [`ControlNode::poll`] returns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NodeStatus {
    /// State.
    pub state: State,
    /// Reason of the state, or a warning.
    pub fault: Fault,
    /// Latent of the last decision; [`NO_LATENT`] before the first.
    pub latent: u16,
    /// There is more to do without a new frame: poll again.
    pub busy: bool,
    /// Counters.
    pub counters: Counters,
}

/// A controller node on a bus. It owns no memory but its own: the policy image and the scratch words are the caller's.
#[derive(Debug)]
#[expect(clippy::struct_excessive_bools, reason = "independent facts about one tick, not the modes of a state machine")]
pub struct ControlNode<'p, L: Link> {
    config: NodeConfig,
    link: L,
    image: &'p [u8],
    scratch: Scratch<'p>,
    policy: Option<Policy<'p>>,
    layout: Option<Layout>,
    state: State,
    fault: Fault,
    estop: bool,
    shaper: Shaper,
    set: Assembler<MAX_OBSERVATIONS>,
    monitor: PeriodMonitor,
    crc: CrcWatch,
    restarts: Restarts,
    bus_off: bool,
    now_us: u64,
    /// Last accepted tick, its time field, and when it came.
    tick: Option<u32>,
    tick_time_us: u32,
    tick_at_us: u64,
    /// The set of the current (previous) tick was complete and was looked at.
    judged: bool,
    judged_before: bool,
    /// An action set went out for the current tick.
    answered: bool,
    sent_at_us: u64,
    stale_ticks: u32,
    /// Ticks of the last complete and of the last good set, while in RUN.
    last_fresh: Option<u32>,
    last_good: Option<u32>,
    good_at_us: u64,
    good_row: u32,
    invalid_row: u32,
    late: bool,
    latent: u16,
    allowed: u8,
    inference_us: u16,
    host_at_us: Option<u64>,
    /// What the last heartbeat said, and whether the bus refused a newer one.
    reported: Option<(State, Fault)>,
    unsent: bool,
    heartbeat_at_us: u64,
    heartbeat_seq: u8,
    page: u8,
    counters: Counters,
}

impl<'p, L: Link> ControlNode<'p, L> {
    /// A node that will boot the policy in `image` at its first [`poll`](Self::poll)s.
    ///
    /// `scratch` needs the words that [`gadm_runtime::PolicySpec::scratch_words`] tells; with less, the self-test fails.
    #[must_use]
    pub fn new(config: NodeConfig, link: L, image: &'p [u8], scratch: &'p mut [u32]) -> Self {
        Self {
            config,
            link,
            image,
            scratch: Scratch::new(scratch),
            policy: None,
            layout: None,
            state: State::Boot,
            fault: Fault::None,
            estop: false,
            shaper: Shaper::default(),
            set: Assembler::default(),
            monitor: PeriodMonitor::new(1),
            crc: CrcWatch::new(1),
            restarts: Restarts::default(),
            bus_off: false,
            now_us: 0,
            tick: None,
            tick_time_us: 0,
            tick_at_us: 0,
            judged: false,
            judged_before: false,
            answered: false,
            sent_at_us: 0,
            stale_ticks: 0,
            last_fresh: None,
            last_good: None,
            good_at_us: 0,
            good_row: 0,
            invalid_row: 0,
            late: false,
            latent: NO_LATENT,
            allowed: 0,
            inference_us: 0,
            host_at_us: None,
            reported: None,
            unsent: false,
            heartbeat_at_us: 0,
            heartbeat_seq: 0,
            page: 0,
            counters: Counters::default(),
        }
    }

    /// Handles all received frames and all that is due; never waits. `now_us` is the time of the board's timer in
    /// microseconds, from any start; it is ignored with [`TimeSource::Tick`].
    pub fn poll(&mut self, now_us: u64) -> NodeStatus {
        if self.config.time == TimeSource::Local {
            self.now_us = self.now_us.max(now_us);
        }
        let mut frame = Frame::empty();
        let mut more = true;
        for _ in 0..FRAMES_PER_POLL {
            match self.link.receive(&mut frame) {
                Ok(received) => {
                    self.bus_off = false;
                    more = received;
                    if received {
                        self.handle(&frame);
                    }
                }
                Err(error) => {
                    self.link_failed(error);
                    more = false;
                }
            }
            if !more {
                break;
            }
        }
        self.watch();
        self.heartbeat();
        match self.state {
            State::Boot => self.boot(),
            State::SelfTest => self.self_test(),
            _ => {}
        }
        self.status(more)
    }

    /// What the board measured for the last inference, for DECISION and the heartbeat. Leave it in lockstep, where a
    /// measured time would make traces differ.
    pub fn report_inference_us(&mut self, us: u16) {
        self.inference_us = us;
    }

    /// The bus.
    pub fn link_mut(&mut self) -> &mut L {
        &mut self.link
    }

    /// Length of a control period of the policy, microseconds; 0 without a policy.
    #[must_use]
    pub fn period_us(&self) -> u32 {
        self.policy.as_ref().map_or(0, |p| p.spec().control_period_us)
    }

    fn status(&self, more: bool) -> NodeStatus {
        let mut counters = self.counters;
        counters.torn = self.set.torn();
        let fault = self.reported_fault();
        let news = self.reported != Some((self.state, fault)) && !self.unsent;
        let busy = more || news || matches!(self.state, State::Boot | State::SelfTest);
        NodeStatus { state: self.state, fault, latent: self.latent, busy, counters }
    }

    // --- states ---------------------------------------------------------------------------------------------------

    fn boot(&mut self) {
        let Ok(policy) = Policy::load(self.image) else {
            self.fire(Event::LoadFailed, Fault::PolicyLoad);
            return;
        };
        let (config, period) = (self.config, policy.spec().control_period_us);
        let ranges = policy.observation_signals().map(|s| (s.lo, s.hi));
        let heads = policy.action_signals().map(|s| s.head);
        let Ok(layout) = Layout::new(config.profile, config.node, policy.interface_hash(), ranges, heads) else {
            self.fire(Event::LoadFailed, Fault::PolicyLayout);
            return;
        };
        let slots = policy.action_signals().map(|s| (s.head, s.safe));
        self.shaper = Shaper::new(slots, config.ramp_ticks, config.rate_limit);
        self.monitor = PeriodMonitor::new(period);
        self.crc = CrcWatch::new(period);
        self.layout = Some(layout);
        self.policy = Some(policy);
        self.fire(Event::Loaded, Fault::None);
    }

    fn self_test(&mut self) {
        let passed = self.policy.is_some_and(|policy| policy.self_test(&mut self.scratch).is_ok());
        if passed {
            self.fire(Event::SelfTestPassed, Fault::None);
            if self.estop {
                self.fire(Event::Estop, Fault::Estop);
            }
        } else {
            self.fire(Event::SelfTestFailed, Fault::PolicySelfTest);
        }
    }

    /// Follows the arrow of `event`, if there is one.
    fn fire(&mut self, event: Event, fault: Fault) {
        let (from, Some(to)) = (self.state, next(self.state, event)) else { return };
        self.state = to;
        self.fault = fault;
        match (from, to) {
            (_, State::Boot) => {
                if matches!(from, State::Run | State::Safe | State::Fault) {
                    self.leave_control();
                }
                self.forget();
            }
            (_, State::Safe) => {
                increment(&mut self.counters.safe_entries);
                self.shaper.begin_ramp(event == Event::Estop);
                self.good_row = 0;
            }
            (State::Ready, State::Run) => {
                self.shaper.reset();
                self.latent = NO_LATENT;
                self.start_run();
            }
            (State::Safe, State::Run) => self.start_run(),
            (State::Run, State::Ready) => {
                self.leave_control();
                self.host_at_us = None;
            }
            _ => {}
        }
    }

    /// The safe action, once, as the last word.
    fn leave_control(&mut self) {
        self.shaper.reset();
        if let Some(tick) = self.tick {
            self.send_action(tick, NO_LATENT, Flags::SAFE);
            increment(&mut self.counters.safe);
        }
    }

    fn start_run(&mut self) {
        self.last_fresh = self.tick;
        self.last_good = self.tick;
        self.good_at_us = self.now_us;
        self.tick_at_us = self.now_us;
        self.answered = true; // control begins with the next tick
        self.invalid_row = 0;
        self.stale_ticks = 0;
        self.late = false;
        self.crc.clear();
        self.host_at_us = self.host_at_us.map(|_| self.now_us);
    }

    fn forget(&mut self) {
        self.policy = None;
        self.layout = None;
        self.estop = false;
        self.shaper = Shaper::default();
        self.set = Assembler::default();
        self.restarts = Restarts::default();
        self.tick = None;
        (self.judged, self.judged_before, self.answered) = (false, false, false);
        (self.stale_ticks, self.good_row, self.invalid_row) = (0, 0, 0);
        (self.last_fresh, self.last_good, self.host_at_us) = (None, None, None);
        (self.latent, self.allowed, self.inference_us, self.late) = (NO_LATENT, 0, 0, false);
        self.counters = Counters::default();
    }

    /// To SAFE, with the safe action at once where the current tick has no answer yet.
    fn make_safe(&mut self, event: Event, fault: Fault) {
        let before = self.state;
        self.fire(event, fault);
        if self.state != before && self.state == State::Safe && !self.answered {
            self.send_safe();
        }
    }

    fn request_run(&mut self) {
        let well = !self.estop && !self.bus_off;
        match self.state {
            State::Run => {}
            State::Ready if well => self.fire(Event::RunRequest, Fault::None),
            State::Safe if well && self.good_row >= GOOD_SETS => self.fire(Event::RunRequest, Fault::None),
            _ => increment(&mut self.counters.refused),
        }
    }

    // --- frames ---------------------------------------------------------------------------------------------------

    fn handle(&mut self, frame: &Frame) {
        let Some(to) = frame.standard_id().and_then(address) else { return };
        match to.message.function {
            Function::Mode => {
                let Some(mode) = Mode::parse(frame).filter(|m| concerns(m.node, self.config.node)) else { return };
                match mode.command {
                    ModeCommand::Run => self.request_run(),
                    ModeCommand::Stop => self.fire(Event::StopRequest, Fault::None),
                    ModeCommand::Reset => self.fire(Event::ResetRequest, Fault::None),
                }
            }
            Function::Estop => {
                if Estop::parse(frame).is_some_and(|e| concerns(e.node, self.config.node)) {
                    self.estop = true;
                    if self.state == State::Safe {
                        self.fault = Fault::Estop;
                        self.shaper.begin_ramp(true);
                    }
                    self.make_safe(Event::Estop, Fault::Estop);
                }
            }
            Function::Tick => {
                if let Some(tick) = Tick::parse(frame) {
                    self.on_tick(tick);
                }
            }
            Function::Observation => self.on_observation(frame),
            Function::HostHeartbeat => {
                if HostHeartbeat::parse(frame).is_some() {
                    self.host_at_us = Some(self.now_us);
                }
            }
            Function::Request => {
                if let Some(request) = Request::parse(frame).filter(|r| r.node == self.config.node.get()) {
                    self.reply(request);
                }
            }
            Function::Action | Function::Decision | Function::Reply | Function::Heartbeat => {}
        }
    }

    fn on_tick(&mut self, t: Tick) {
        let mut ahead = self.tick.map_or(1, |last| t.tick.wrapping_sub(last));
        if ahead == 0 || ahead > u32::MAX / 2 {
            increment(&mut self.counters.sequence);
            self.stale_ticks = self.stale_ticks.saturating_add(1);
            if self.state == State::Run && self.stale_ticks >= STALE_LIMIT {
                self.make_safe(Event::TickLost, Fault::TickLost);
            }
            if self.state == State::Run || ahead == 0 {
                return;
            }
            // Not in control: the plant may have started again, follow it.
            self.tick = None;
            self.set.abandon();
            ahead = 1;
        }
        let passed = t.time_us.wrapping_sub(self.tick_time_us);
        let passed = if self.tick.is_none() || passed > u32::MAX / 2 { 0 } else { u64::from(passed) };
        if self.config.time == TimeSource::Tick {
            self.now_us = self.now_us.saturating_add(passed);
        }
        let elapsed = self.now_us.saturating_sub(self.tick_at_us);
        if self.tick.is_some() {
            self.monitor.observe(elapsed, ahead);
        }
        let first = self.tick.is_none();
        let unanswered = self.tick.filter(|_| !self.answered);
        if !self.judged {
            self.good_row = 0;
        }
        self.stale_ticks = 0;
        self.tick_time_us = t.time_us;
        self.tick_at_us = self.now_us;
        self.tick = Some(t.tick);
        self.judged_before = self.judged && ahead == 1;
        (self.judged, self.answered) = (false, false);
        match self.state {
            State::Run => {
                let start = t.tick.wrapping_sub(1);
                let age = |last: Option<u32>| t.tick.wrapping_sub(last.unwrap_or(start));
                let (fresh, good) = (age(self.last_fresh), age(self.last_good));
                (self.last_fresh, self.last_good) =
                    (Some(self.last_fresh.unwrap_or(start)), Some(self.last_good.unwrap_or(start)));
                let lost = if unanswered.is_some() { ahead } else { ahead - 1 };
                self.counters.missed = self.counters.missed.saturating_add(lost);
                if !first && elapsed > self.silence_us() {
                    self.make_safe(Event::TickLost, Fault::TickLost);
                } else if fresh >= STALE_LIMIT || good > HOLD_LIMIT {
                    self.make_safe(Event::ObservationLost, Fault::ObservationLost);
                } else if let Some(previous) = unanswered {
                    self.send_held(previous);
                }
            }
            State::Safe | State::Fault => self.send_safe(),
            _ => {}
        }
        self.judge();
    }

    fn on_observation(&mut self, frame: &Frame) {
        let Some(layout) = &self.layout else { return };
        let part = match layout.observation_part(frame) {
            Err(FrameError::Foreign) => return,
            Err(_) => {
                increment(&mut self.counters.crc_errors);
                self.crc.count(self.now_us, false);
                return;
            }
            Ok(part) => part,
        };
        self.crc.count(self.now_us, true);
        let profile = self.config.profile;
        // A part may overtake the TICK of its own period, but not more.
        match self.tick.map(|tick| profile.ahead(part.seq, profile.seq(tick))) {
            Some(0) if self.judged => increment(&mut self.counters.sequence),
            Some(0 | 1) => {
                let parts = layout.observation_parts();
                if self.set.push(&part, parts) == crate::assemble::Pushed::Duplicate {
                    increment(&mut self.counters.sequence);
                }
                self.judge();
            }
            Some(-1) if !self.judged_before => {
                increment(&mut self.counters.late);
                self.late = true;
            }
            _ => increment(&mut self.counters.sequence),
        }
    }

    /// Looks at the set of the current tick, once, as soon as it is complete.
    fn judge(&mut self) {
        let (Some(tick), Some(layout), Some(policy)) = (self.tick, &self.layout, &self.policy) else { return };
        if self.judged {
            return;
        }
        let Some(values) = self.set.complete(self.config.profile.seq(tick), layout.obs_dim()) else { return };
        self.judged = true;
        self.last_fresh = Some(tick);
        let mut wanted = [0.0; MAX_ACTIONS];
        let wanted = wanted.get_mut(..layout.action_dim()).unwrap_or(&mut []);
        let running = self.state == State::Run && !self.answered;
        let valid = values.iter().all(|v| v.is_finite());
        let decision = if running && valid { policy.act(values, &mut self.scratch, wanted).ok() } else { None };
        if !valid || (running && decision.is_none()) {
            increment(&mut self.counters.invalid);
            self.good_row = 0;
            self.invalid_row = self.invalid_row.saturating_add(1);
            if running {
                increment(&mut self.counters.missed);
                if self.invalid_row >= INVALID_LIMIT {
                    self.make_safe(Event::ObservationInvalid, Fault::ObservationInvalid);
                } else {
                    self.send_held(tick);
                }
            }
            return;
        }
        self.invalid_row = 0;
        self.good_row = self.good_row.saturating_add(1);
        self.last_good = Some(tick);
        self.good_at_us = self.now_us;
        if let Some(decision) = decision {
            let clipped = self.shaper.take(wanted) || decision.clipped;
            self.latent = decision.latent;
            self.allowed = u8::try_from(decision.allowed.len()).unwrap_or(u8::MAX);
            self.counters.clipped = self.counters.clipped.saturating_add(u32::from(clipped));
            self.counters.fallback = self.counters.fallback.saturating_add(u32::from(decision.fallback));
            increment(&mut self.counters.acted);
            let flags = Flags::default().when(decision.fallback, Flags::FALLBACK).when(clipped, Flags::CLIPPED);
            self.answered = true;
            self.send_action(tick, self.latent, flags);
        }
    }

    // --- time -----------------------------------------------------------------------------------------------------

    fn silence_us(&self) -> u64 {
        SILENCE_US.max(u64::from(STALE_LIMIT) * u64::from(self.period_us()))
    }

    fn watch(&mut self) {
        let (now, period) = (self.now_us, u64::from(self.period_us()));
        let local = self.config.time == TimeSource::Local;
        if self.state == State::Run {
            let since_tick = now.saturating_sub(self.tick_at_us);
            if self.host_at_us.is_some_and(|at| now.saturating_sub(at) > self.silence_us()) {
                self.make_safe(Event::HostLost, Fault::HostLost);
            } else if self.crc.too_many() {
                self.make_safe(Event::CrcErrors, Fault::CrcErrors);
            } else if local && since_tick > self.silence_us() {
                self.make_safe(Event::TickLost, Fault::TickLost);
            } else if local && now.saturating_sub(self.good_at_us) > u64::from(HOLD_LIMIT) * period + period / 5 {
                // Ticks count periods; where they do not come, the timer does, with the tolerance of the period.
                self.make_safe(Event::ObservationLost, Fault::ObservationLost);
            }
        }
        let controlling = matches!(self.state, State::Safe | State::Fault);
        if local && controlling && self.tick.is_some() && now.saturating_sub(self.sent_at_us) > period + period / 5 {
            self.send_safe();
        }
    }

    fn heartbeat(&mut self) {
        let now = (self.state, self.reported_fault());
        if self.reported == Some(now) && self.now_us.saturating_sub(self.heartbeat_at_us) < HEARTBEAT_PERIOD_US {
            return;
        }
        let page = Page::from_code(self.page).unwrap_or(Page::InterfaceLow);
        let frame = Heartbeat {
            node: self.config.node.get(),
            state: now.0.code(),
            page: page.code(),
            fault: now.1.code(),
            seq: self.heartbeat_seq,
            value: self.value(page),
        };
        self.unsent = !self.send(&frame.frame());
        if self.unsent {
            return;
        }
        self.reported = Some(now);
        self.heartbeat_at_us = self.now_us;
        self.heartbeat_seq = self.heartbeat_seq.wrapping_add(1);
        self.page = if Page::from_code(self.page + 1).is_some() { self.page + 1 } else { 0 };
    }

    fn reported_fault(&self) -> Fault {
        match self.fault {
            Fault::None if self.state == State::Run && self.monitor.jitter() => Fault::PeriodJitter,
            Fault::None if self.state == State::Run && self.monitor.bias() => Fault::PeriodBias,
            fault => fault,
        }
    }

    fn value(&self, page: Page) -> u32 {
        let hash = self.policy.as_ref().map_or(0, Policy::interface_hash);
        let [a, b, c, d, e, f, g, h] = hash.to_le_bytes();
        match page {
            Page::InterfaceLow => u32::from_le_bytes([a, b, c, d]),
            Page::InterfaceHigh => u32::from_le_bytes([e, f, g, h]),
            Page::PolicyCrc => self.policy.as_ref().map_or(0, |p| p.header().payload_crc32),
            Page::Slot => u32::from(self.config.slot),
            Page::InferenceUs => u32::from(self.inference_us),
            Page::Misses => self.counters.missed,
            Page::Jitter => {
                let report = self.monitor.report();
                let ([j0, j1], [b0, b1]) = (report.jitter_permille.to_le_bytes(), report.bias_permille.to_le_bytes());
                u32::from_le_bytes([j0, j1, b0, b1])
            }
            Page::CrcErrors => self.counters.crc_errors,
            Page::TornSets => self.set.torn(),
            Page::Sequence => self.counters.sequence,
            Page::Invalid => self.counters.invalid,
            Page::SafeEntries => self.counters.safe_entries,
        }
    }

    fn reply(&mut self, request: Request) {
        let node = self.config.node.get();
        let Request { op, page, tag, .. } = request;
        let refused = Reply { node, op: OP_REFUSED, page, tag, value: u32::from(op) };
        let reply = match Page::from_code(page) {
            Some(known) if op == OP_READ => Reply { node, op, page, tag, value: self.value(known) },
            _ => refused,
        };
        self.send(&reply.frame());
    }

    // --- sending --------------------------------------------------------------------------------------------------

    fn send_held(&mut self, tick: u32) {
        increment(&mut self.counters.held);
        self.answered |= Some(tick) == self.tick;
        self.send_action(tick, self.latent, Flags::HELD);
    }

    fn send_safe(&mut self) {
        let Some(tick) = self.tick else { return };
        self.shaper.ramp();
        increment(&mut self.counters.safe);
        self.answered = true;
        self.send_action(tick, NO_LATENT, Flags::SAFE);
    }

    fn send_action(&mut self, tick: u32, latent: u16, flags: Flags) {
        let late = core::mem::take(&mut self.late) || self.monitor.jitter() || self.monitor.bias();
        let header = ActionHeader { seq: self.config.profile.seq(tick), latent, flags: flags.when(late, Flags::LATE) };
        self.sent_at_us = self.now_us;
        let Some(layout) = &self.layout else { return };
        let parts = layout.action_parts();
        let decision = Decision { header, inference_us: self.inference_us, allowed: self.allowed };
        if let Some(frame) = layout.decision_frame(decision) {
            self.send(&frame);
        }
        for part in 0..parts {
            let frame = self.layout.as_ref().and_then(|l| l.action_frame(part, header, self.shaper.action()));
            if let Some(frame) = frame {
                self.send(&frame);
            }
        }
    }

    fn send(&mut self, frame: &Frame) -> bool {
        let sent = self.link.send(frame);
        if let Err(error) = sent {
            self.link_failed(error);
        }
        sent.is_ok()
    }

    fn link_failed(&mut self, error: LinkError) {
        increment(&mut self.counters.bus_errors);
        if error != LinkError::BusOff || self.bus_off {
            return;
        }
        self.bus_off = true;
        self.fire(Event::BusOff, Fault::BusOff);
        if self.state == State::Fault {
            return;
        }
        if self.restarts.allow(self.now_us) {
            if self.link.restart().is_err() {
                increment(&mut self.counters.bus_errors);
            }
        } else {
            self.fire(Event::BusOffRepeated, Fault::BusOffRepeated);
        }
    }
}

fn increment(counter: &mut u32) {
    *counter = counter.saturating_add(1);
}
