//! The node's side of a bus between processes: what `gadm-sim node` does.

use std::collections::VecDeque;
use std::io;
use std::time::{Duration, Instant};

use gadm_node::service::{Reply, Request};
use gadm_node::{ControlNode, Frame, Link, LinkError, NodeConfig, TimeSource};
use gadm_runtime::Policy;

use crate::SimError;
use crate::bus::{Bus, lockstep};

/// Frames that may wait for a barrier. A set and its neighbours are a few dozen.
const INBOX: usize = 1 << 14;

/// Polls until a node must be at rest, as in process.
const POLLS: u32 = 10_000;

/// Longest time between two polls in real time.
const POLL_EVERY: Duration = Duration::from_millis(1);

/// How a node process is set up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ServeOptions {
    /// The node; its time source is set by `realtime`.
    pub config: NodeConfig,
    /// Virtual seconds in a second of the wall; `None` = lockstep.
    pub realtime: Option<f64>,
}

/// The node's port: what came and was not handled yet, and the way out.
struct Port<'b> {
    bus: &'b mut dyn Bus,
    inbox: VecDeque<Frame>,
    received: u32,
    sent: u8,
    /// The controller said that it is off the bus; for the node to be told.
    off: bool,
}

impl Port<'_> {
    fn put(&mut self, frame: Frame) {
        self.received = self.received.wrapping_add(1);
        // Beyond this nobody asked for an answer for a long time; the oldest frame is the least of use.
        if self.inbox.len() >= INBOX {
            self.inbox.pop_front();
        }
        self.inbox.push_back(frame);
    }

    /// The next frame of the bus itself.
    fn hear(&mut self, frame: &mut Frame) -> io::Result<bool> {
        loop {
            match self.bus.receive(frame) {
                Ok(came) => return Ok(came),
                Err(LinkError::BusOff) => self.off = true,
                Err(error) => return Err(io_error(error)),
            }
        }
    }
}

impl Link for Port<'_> {
    fn receive(&mut self, frame: &mut Frame) -> Result<bool, LinkError> {
        if std::mem::take(&mut self.off) {
            return Err(LinkError::BusOff);
        }
        let next = self.inbox.pop_front();
        if let Some(next) = next {
            *frame = next;
        }
        Ok(next.is_some())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), LinkError> {
        self.bus.send(frame)?;
        self.sent = self.sent.wrapping_add(1);
        Ok(())
    }

    fn restart(&mut self) -> Result<(), LinkError> {
        self.bus.restart()
    }
}

/// Runs a node with the policy in `image` on `bus` until the bus is gone. `tell` hears of each START.
///
/// # Errors
/// [`SimError::Policy`] where the image is none, [`SimError::Remote`] where the bus fails; its end is no error in lockstep.
pub fn serve(
    bus: &mut dyn Bus,
    image: &[u8],
    options: ServeOptions,
    tell: &mut dyn FnMut(u16),
) -> Result<(), SimError> {
    let policy = Policy::load(image).map_err(SimError::Policy)?;
    let crc = policy.header().payload_crc32;
    let mut scratch = vec![0; policy.spec().scratch_words];
    let mut start = None;
    loop {
        let session = match options.realtime {
            None => lockstep_session(bus, image, options, crc, &mut scratch, start),
            Some(factor) => realtime_session(bus, image, options, crc, &mut scratch, start, factor),
        };
        match session {
            Ok(tag) => {
                tell(tag);
                start = Some(tag);
            }
            Err(e) if matches!(e.kind(), io::ErrorKind::ConnectionReset | io::ErrorKind::BrokenPipe) => return Ok(()),
            Err(e) => return Err(SimError::Remote { bus: "the bus".to_owned(), what: e.to_string() }),
        }
    }
}

fn mode(options: ServeOptions) -> u8 {
    lockstep::mode(options.config.profile, options.realtime.is_some())
}

fn started(options: ServeOptions, crc: u32, tag: u16) -> Frame {
    let node = options.config.node.get();
    Reply { node, op: lockstep::OP_START, page: mode(options), tag, value: crc }.frame()
}

fn io_error(error: LinkError) -> io::Error {
    match error {
        LinkError::Other(u16::MAX) => io::Error::new(io::ErrorKind::ConnectionReset, "the bus is gone"),
        LinkError::Other(number) => io::Error::from_raw_os_error(i32::from(number)),
        other => io::Error::other(other.to_string()),
    }
}

/// From one START to the next; returns the tag of that.
fn lockstep_session(
    bus: &mut dyn Bus,
    image: &[u8],
    options: ServeOptions,
    crc: u32,
    scratch: &mut [u32],
    start: Option<u16>,
) -> io::Result<u16> {
    let config = NodeConfig { time: TimeSource::Tick, ..options.config };
    if let Some(tag) = start {
        bus.send(&started(options, crc, tag)).map_err(io_error)?;
        bus.flush()?;
    }
    let port = Port { bus, inbox: VecDeque::new(), received: 0, sent: 0, off: false };
    let mut node = ControlNode::new(config, port, image, scratch);
    let mut frame = Frame::empty();
    loop {
        node.link_mut().bus.wait(Duration::from_hours(1))?;
        while node.link_mut().hear(&mut frame)? {
            match lockstep::parse_request(&frame, config.node) {
                Some(Request { op: lockstep::OP_START, tag, .. }) if Some(tag) != start => return Ok(tag),
                Some(Request { op: lockstep::OP_START, tag, .. }) => {
                    node.link_mut().bus.send(&started(options, crc, tag)).map_err(io_error)?;
                }
                Some(Request { tag, .. }) => {
                    rest(&mut node);
                    let port = node.link_mut();
                    let (node, page, value) = (config.node.get(), std::mem::take(&mut port.sent), port.received);
                    let done = Reply { node, op: lockstep::OP_BARRIER, page, tag, value };
                    port.bus.send(&done.frame()).map_err(io_error)?;
                }
                // Also what belongs to the lockstep of another node: that does not concern this one's control, and what
                // only looks like it must be counted.
                None => node.link_mut().put(frame),
            }
        }
        node.link_mut().bus.flush()?;
    }
}

fn rest(node: &mut ControlNode<'_, Port<'_>>) {
    for _ in 0..POLLS {
        if !node.poll(0).busy {
            return;
        }
    }
}

#[expect(clippy::disallowed_methods, reason = "a node in real time has the wall's time, as a board has its timer's")]
fn now() -> Instant {
    Instant::now()
}

fn realtime_session(
    bus: &mut dyn Bus,
    image: &[u8],
    options: ServeOptions,
    crc: u32,
    scratch: &mut [u32],
    start: Option<u16>,
    factor: f64,
) -> io::Result<u16> {
    let config = NodeConfig { time: TimeSource::Local, ..options.config };
    if let Some(tag) = start {
        bus.send(&started(options, crc, tag)).map_err(io_error)?;
        bus.flush()?;
    }
    let port = Port { bus, inbox: VecDeque::new(), received: 0, sent: 0, off: false };
    let mut node = ControlNode::new(config, port, image, scratch);
    let (zero, mut acted) = (now(), 0);
    let mut frame = Frame::empty();
    loop {
        node.link_mut().bus.wait(POLL_EVERY)?;
        while node.link_mut().hear(&mut frame)? {
            match lockstep::parse_request(&frame, config.node) {
                Some(Request { op: lockstep::OP_START, tag, .. }) if Some(tag) != start => return Ok(tag),
                Some(Request { op: lockstep::OP_START, tag, .. }) => {
                    node.link_mut().bus.send(&started(options, crc, tag)).map_err(io_error)?;
                }
                _ => node.link_mut().put(frame),
            }
        }
        loop {
            let began = now();
            let status = node.poll((began.duration_since(zero).as_secs_f64() * factor * 1e6) as u64);
            if status.counters.acted != acted {
                acted = status.counters.acted;
                node.report_inference_us(u16::try_from(began.elapsed().as_micros()).unwrap_or(u16::MAX));
            }
            if !status.busy {
                break;
            }
        }
        node.link_mut().bus.flush()?;
    }
}
