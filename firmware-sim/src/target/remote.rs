//! A node in another process or on another machine, over a bus between processes.

use std::time::{Duration, Instant};

use gadm_node::protocol::{Function, NodeId, address};
use gadm_node::service::{Heartbeat, OP_REFUSED, Reply};
use gadm_node::{Frame, Link, LinkError, NodeStatus, Profile, State};

use super::Target;
use super::pace::{Pace, Timing};
use crate::SimError;
use crate::bus::loopback::Loopback;
use crate::bus::stream::{deadline, left};
use crate::bus::{Bus, lockstep};

/// Wall time after which a node that does not answer ends the run. A guard only: no result depends on it.
const GUARD: Duration = Duration::from_secs(10);

/// How often START is repeated while nobody answers.
const REPEAT: Duration = Duration::from_millis(100);

/// What a run expects of a node elsewhere.
#[derive(Clone, Debug, PartialEq)]
pub struct Expected {
    /// Name of the bus for reports and errors.
    pub bus: String,
    /// Node number.
    pub node: NodeId,
    /// CRC-32 of its policy.
    pub policy_crc: u32,
    /// How values travel.
    pub profile: Profile,
    /// Frames of an action set.
    pub action_frames: usize,
    /// How long to wait for the node to appear.
    pub patience: Duration,
}

/// A node on a bus that other processes join.
pub struct Remote<L> {
    link: L,
    local: Loopback,
    bus: Box<dyn Bus>,
    expected: Expected,
    tag: u16,
    start_tag: u16,
    sent: u32,
    pace: Option<Pace>,
    booted: bool,
}

impl<L: std::fmt::Debug> std::fmt::Debug for Remote<L> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Remote").field("expected", &self.expected).field("tag", &self.tag).finish_non_exhaustive()
    }
}

impl<L: Link> Remote<L> {
    /// Starts the node on `bus` afresh and takes its place on the loopback: `link` is its port there, `local` the
    /// loopback itself. With `pace` in real time, else in lockstep.
    ///
    /// # Errors
    /// [`SimError::Remote`] where no node answers, or one with another policy, profile or time.
    pub fn start(
        link: L,
        local: Loopback,
        bus: Box<dyn Bus>,
        expected: Expected,
        pace: Option<Pace>,
    ) -> Result<Self, SimError> {
        // Another number for each run, so that an answer to an earlier run's START is not taken for one to this.
        let tag = std::process::id() as u16;
        let mut remote = Self { link, local, bus, expected, tag, start_tag: tag, sent: 0, pace, booted: false };
        let reply = remote.start_afresh(tag)?;
        let wanted = lockstep::mode(remote.expected.profile, remote.pace.is_some());
        if reply.op == OP_REFUSED {
            return Err(remote.failed("the node knows no lockstep (a board?); use --realtime".to_owned()));
        }
        if reply.value != remote.expected.policy_crc {
            let (found, wanted) = (reply.value, remote.expected.policy_crc);
            return Err(remote.failed(format!(
                "the node has another policy: CRC {found:08x} instead of {wanted:08x}; start it with the same file"
            )));
        }
        if reply.page != wanted {
            return Err(remote.failed(format!(
                "the node runs {} and this side {}; start it with the same --profile and --realtime",
                mode_name(reply.page),
                mode_name(wanted)
            )));
        }
        Ok(remote)
    }

    fn failed(&self, what: String) -> SimError {
        SimError::Remote { bus: self.expected.bus.clone(), what }
    }

    fn io<T>(&self, result: std::io::Result<T>) -> Result<T, SimError> {
        result.map_err(|e| self.failed(e.to_string()))
    }

    fn link_error(&self, error: LinkError) -> SimError {
        self.failed(error.to_string())
    }

    fn transmit(&mut self, frame: &Frame) -> Result<(), SimError> {
        self.bus.send(frame).map_err(|e| self.failed(e.to_string()))
    }

    /// The next frame of the bus. That a controller was off the bus is for the node to handle.
    fn hear(&mut self, frame: &mut Frame) -> Result<bool, SimError> {
        loop {
            match self.bus.receive(frame) {
                Ok(came) => return Ok(came),
                Err(LinkError::BusOff) => {}
                Err(error) => return Err(self.failed(error.to_string())),
            }
        }
    }

    fn start_afresh(&mut self, tag: u16) -> Result<Reply, SimError> {
        let request = lockstep::request(self.expected.node, lockstep::OP_START, tag);
        let end = deadline(self.expected.patience);
        let mut frame = Frame::empty();
        loop {
            self.transmit(&request)?;
            let flushed = self.bus.flush();
            self.io(flushed)?;
            let again = deadline(REPEAT);
            while let Some(time) = left(again) {
                let waited = self.bus.wait(time);
                self.io(waited)?;
                while self.hear(&mut frame)? {
                    let reply = lockstep::parse_reply(&frame, self.expected.node);
                    let ours = |r: &Reply| r.tag == tag && (r.op == lockstep::OP_START || r.op == OP_REFUSED);
                    if let Some(reply) = reply.filter(ours) {
                        return Ok(reply);
                    }
                }
            }
            if left(end).is_none() {
                return Err(self.failed(format!(
                    "no node {} answers; start one there: gadm-sim node POLICY.bin --connect {}",
                    self.expected.node.get(),
                    self.expected.bus
                )));
            }
        }
    }

    /// Passes on what the others sent. True where a control period began.
    fn forward(&mut self) -> Result<bool, SimError> {
        let mut frame = Frame::empty();
        let mut tick = false;
        while self.link.receive(&mut frame).map_err(|e| self.link_error(e))? {
            tick |= function(&frame) == Some(Function::Tick);
            self.transmit(&frame)?;
            self.sent = self.sent.wrapping_add(1);
        }
        Ok(tick)
    }

    fn barrier(&mut self) -> Result<(), SimError> {
        self.tag = self.tag.wrapping_add(1);
        self.transmit(&lockstep::request(self.expected.node, lockstep::OP_BARRIER, self.tag))?;
        let flushed = self.bus.flush();
        self.io(flushed)?;
        let end = deadline(GUARD);
        let mut frame = Frame::empty();
        let mut came: u8 = 0;
        loop {
            while self.hear(&mut frame)? {
                let reply = lockstep::parse_reply(&frame, self.expected.node);
                if let Some(reply) = reply.filter(|r| r.op == lockstep::OP_BARRIER && r.tag == self.tag) {
                    // Others may be on the bus too, so there may be more than expected and never less.
                    let lost = self.sent.wrapping_sub(reply.value);
                    if lost != 0 && lost < 1 << 31 {
                        return Err(self.failed(format!("{lost} frames to the node were lost on the bus")));
                    }
                    let missing = reply.page.wrapping_sub(came);
                    if missing != 0 && missing < 1 << 7 {
                        return Err(self.failed(format!("{missing} frames of the node were lost on the bus")));
                    }
                    return Ok(());
                }
                if !lockstep::is_lockstep(&frame) {
                    came = came.wrapping_add(1);
                    self.link.send(&frame).map_err(|e| self.link_error(e))?;
                }
            }
            let Some(time) = left(end) else {
                return Err(self.failed(format!("the node did not answer within {} s", GUARD.as_secs())));
            };
            let waited = self.bus.wait(time);
            self.io(waited)?;
        }
    }

    /// In real time: passes on what comes until the answer is there or `end`, and returns when the answer came.
    fn collect(&mut self, end: Instant, answered: impl Fn(&Frame) -> bool, count: usize) -> Result<bool, SimError> {
        let mut frame = Frame::empty();
        let mut came = 0;
        loop {
            while self.hear(&mut frame)? {
                if let Some(pace) = &self.pace {
                    self.local.set_time(pace.now_us());
                }
                if !lockstep::is_lockstep(&frame) {
                    self.link.send(&frame).map_err(|e| self.link_error(e))?;
                }
                came += usize::from(answered(&frame));
            }
            if came >= count {
                return Ok(true);
            }
            let Some(time) = left(end) else { return Ok(false) };
            let waited = self.bus.wait(time);
            self.io(waited)?;
        }
    }

    fn settle_in_time(&mut self, now_us: u64) -> Result<(), SimError> {
        if !self.booted {
            self.booted = true;
            let ready = |f: &Frame| {
                let state = Heartbeat::parse(f).and_then(|b| State::from_code(b.state));
                state.is_some_and(|s| !matches!(s, State::Boot | State::SelfTest))
            };
            self.collect(deadline(GUARD), ready, 1)?;
            return Ok(());
        }
        let tick = self.forward()?;
        if tick && let Some(pace) = &mut self.pace {
            pace.begin(now_us);
            self.local.set_time(pace.now_us());
        }
        let flushed = self.bus.flush();
        self.io(flushed)?;
        if tick {
            let end = self.pace.as_ref().map_or_else(|| deadline(GUARD), Pace::end);
            let action = |f: &Frame| function(f) == Some(Function::Action);
            let answered = self.collect(end, action, self.expected.action_frames)?;
            if let Some(pace) = &mut self.pace {
                pace.answered(answered);
            }
        } else {
            // A change of state is reported at once; where there is none, there is nothing to wait for.
            self.collect(deadline(Duration::from_millis(20)), |f| Heartbeat::parse(f).is_some(), 1)?;
        }
        Ok(())
    }
}

impl<L: Link> Target for Remote<L> {
    fn name(&self) -> &str {
        &self.expected.bus
    }

    fn settle(&mut self, now_us: u64) -> Result<(), SimError> {
        if self.pace.is_some() {
            return self.settle_in_time(now_us);
        }
        self.forward()?;
        self.barrier()
    }

    fn power_cycle(&mut self) -> Result<(), SimError> {
        self.start_tag = self.start_tag.wrapping_add(1);
        self.start_afresh(self.start_tag)?;
        (self.sent, self.booted) = (0, false);
        Ok(())
    }

    fn status(&self) -> Option<NodeStatus> {
        None
    }

    fn timing(&self) -> Option<Timing> {
        self.pace.as_ref().map(Pace::timing)
    }
}

fn function(frame: &Frame) -> Option<Function> {
    frame.standard_id().and_then(address).map(|a| a.message.function)
}

fn mode_name(mode: u8) -> String {
    let profile = if mode & lockstep::MODE_CLASSIC == 0 { Profile::FdF32 } else { Profile::ClassicI16 };
    let time = if mode & lockstep::MODE_REALTIME == 0 { "lockstep" } else { "real time" };
    format!("{} in {time}", profile.name())
}
