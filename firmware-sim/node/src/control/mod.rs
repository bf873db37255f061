//! The node: boots a policy, answers each control period with an action, and goes to a safe state when it cannot.

mod boot;
mod frames;
mod report;
mod send;
mod transfer;

use gadm_runtime::{Policy, Scratch};
use serde::Serialize;

use crate::assemble::Assembler;
use crate::codec::{Layout, Profile};
use crate::frame::Frame;
use crate::link::Link;
use crate::protocol::{MAX_OBSERVATIONS, NO_LATENT, NodeId};
use crate::reason::Reason;
use crate::safety::{Fault, State};
use crate::shaper::Shaper;
use crate::store::{Fixed, Store};
use crate::timing::PeriodMonitor;
use crate::watch::{CrcWatch, Restarts};

/// Frames that one [`ControlNode::poll`] handles at most, so that a babbling bus cannot hold it.
const FRAMES_PER_POLL: usize = 512;

/// Where the node's time comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
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
    /// Number of the slot that a single image is reported in; with slots to choose from, the node reports the chosen one.
    pub slot: u8,
    /// The board was restarted by its watchdog or by a fault of the core: said as a warning until the first RUN.
    pub restarted: bool,
    /// The settings that these should come from are damaged: nothing is run, and the heartbeat says why.
    pub damaged: bool,
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
            restarted: false,
            damaged: false,
        }
    }
}

/// What the node counted since it booted. All counters saturate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
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

impl Counters {
    /// Both together, as of a node before and after a boot.
    #[must_use]
    pub const fn plus(self, other: Self) -> Self {
        Self {
            acted: self.acted.saturating_add(other.acted),
            held: self.held.saturating_add(other.held),
            safe: self.safe.saturating_add(other.safe),
            missed: self.missed.saturating_add(other.missed),
            late: self.late.saturating_add(other.late),
            torn: self.torn.saturating_add(other.torn),
            sequence: self.sequence.saturating_add(other.sequence),
            crc_errors: self.crc_errors.saturating_add(other.crc_errors),
            invalid: self.invalid.saturating_add(other.invalid),
            clipped: self.clipped.saturating_add(other.clipped),
            fallback: self.fallback.saturating_add(other.fallback),
            safe_entries: self.safe_entries.saturating_add(other.safe_entries),
            refused: self.refused.saturating_add(other.refused),
            bus_errors: self.bus_errors.saturating_add(other.bus_errors),
        }
    }
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

/// A controller node on a bus. It owns no memory but its own: the policy images and the scratch words are the caller's.
///
/// What it sends depends on the frames and their order only, not on how many of them one [`poll`](Self::poll) finds, so
/// with [`TimeSource::Tick`] a node at the end of a slow line sends the same bytes as one that is linked in.
#[derive(Debug)]
#[expect(clippy::struct_excessive_bools, reason = "independent facts about one tick, not the modes of a state machine")]
pub struct ControlNode<'p, L: Link, S: Store<'p> = Fixed<'p>> {
    config: NodeConfig,
    link: L,
    store: S,
    scratch: Scratch<'p>,
    policy: Option<Policy<'p>>,
    /// Slot of `policy`, whether it is there on trial, and since when.
    slot: u8,
    trial: bool,
    booted_at_us: u64,
    /// The candidates of this boot were begun with; the first of them that was refused, and why.
    booting: bool,
    refused: Option<(Fault, Reason, u8)>,
    warns_of_restart: bool,
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
    /// When silence began to count: the last tick, or the start of RUN.
    quiet_from_us: u64,
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
        Self::with_store(config, link, Fixed::new(image, config.slot), scratch)
    }
}

impl<'p, L: Link, S: Store<'p>> ControlNode<'p, L, S> {
    /// As [`new`](ControlNode::new), with policies in `store`: [`Slots`](crate::slots::Slots), say.
    #[must_use]
    pub fn with_store(config: NodeConfig, link: L, store: S, scratch: &'p mut [u32]) -> Self {
        Self::switched_on(config, link, store, Scratch::new(scratch))
    }

    /// The node after its power was taken away and given back: it keeps its configuration, its bus and its policies, and
    /// boots again.
    #[must_use]
    pub fn power_cycle(self) -> Self {
        let Self { config, link, store, scratch, .. } = self;
        Self::switched_on(config, link, store, scratch)
    }

    fn switched_on(config: NodeConfig, link: L, store: S, scratch: Scratch<'p>) -> Self {
        Self {
            config,
            link,
            store,
            scratch,
            policy: None,
            slot: config.slot,
            trial: false,
            booted_at_us: 0,
            booting: false,
            refused: None,
            warns_of_restart: config.restarted,
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
            quiet_from_us: 0,
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
            if matches!(self.state, State::Boot | State::SelfTest) {
                break; // frames wait until it is known what they mean
            }
            match self.link.receive(&mut frame) {
                Ok(received) => {
                    self.bus_off = false;
                    more = received;
                    if received {
                        self.handle(&frame);
                        self.watch();
                        self.heartbeat(false);
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
        self.heartbeat(true);
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

    /// Where the policies lie.
    pub fn store_mut(&mut self) -> &mut S {
        &mut self.store
    }

    /// Has the next [`poll`](Self::poll) send a heartbeat, for a host that came later.
    pub fn announce(&mut self) {
        self.reported = None;
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
}

fn increment(counter: &mut u32) {
    *counter = counter.saturating_add(1);
}
