//! The supervising program as CAN participant: starts and stops the node, sends its sign of life, reads the node's.

use gadm_node::protocol::{HEARTBEAT_PERIOD_US, NodeId};
use gadm_node::service::{Heartbeat, HostHeartbeat, Mode, ModeCommand};
use gadm_node::{Fault, Frame, Link, LinkError, State};

/// Supervises one node.
#[derive(Debug)]
pub struct Host<L> {
    link: L,
    node: NodeId,
    wants_run: bool,
    seq: u8,
    beat_at_us: Option<u64>,
    last: Option<Heartbeat>,
}

impl<L: Link> Host<L> {
    /// A host for `node`.
    pub fn new(link: L, node: NodeId) -> Self {
        Self { link, node, wants_run: false, seq: 0, beat_at_us: None, last: None }
    }

    /// Asks the node to control, and goes on asking with every [`step`](Self::step) while it does not.
    ///
    /// # Errors
    /// Where the bus does not take the frame.
    pub fn run(&mut self) -> Result<(), LinkError> {
        self.wants_run = true;
        self.mode(ModeCommand::Run)
    }

    /// Asks the node to stop.
    ///
    /// # Errors
    /// Where the bus does not take the frame.
    pub fn stop(&mut self) -> Result<(), LinkError> {
        self.wants_run = false;
        self.mode(ModeCommand::Stop)
    }

    /// Asks the node to forget everything and to boot.
    ///
    /// # Errors
    /// Where the bus does not take the frame.
    pub fn reset(&mut self) -> Result<(), LinkError> {
        self.wants_run = false;
        self.mode(ModeCommand::Reset)
    }

    /// Reads what came and sends what is due at `now_us`.
    ///
    /// # Errors
    /// Where the bus fails.
    pub fn step(&mut self, now_us: u64) -> Result<(), LinkError> {
        self.listen()?;
        if self.beat_at_us.is_none_or(|at| now_us.saturating_sub(at) >= HEARTBEAT_PERIOD_US) {
            self.link.send(&HostHeartbeat { seq: self.seq }.frame())?;
            self.seq = self.seq.wrapping_add(1);
            self.beat_at_us = Some(now_us);
        }
        if self.wants_run && matches!(self.state(), Some(State::Ready | State::Safe)) {
            self.mode(ModeCommand::Run)?;
        }
        Ok(())
    }

    /// Reads what came.
    ///
    /// # Errors
    /// Where the bus fails.
    pub fn listen(&mut self) -> Result<(), LinkError> {
        let mut frame = Frame::empty();
        while self.link.receive(&mut frame)? {
            if let Some(beat) = Heartbeat::parse(&frame).filter(|b| b.node == self.node.get()) {
                self.last = Some(beat);
            }
        }
        Ok(())
    }

    /// State of the node by its last heartbeat; `None` before the first.
    pub fn state(&self) -> Option<State> {
        self.last.and_then(|b| State::from_code(b.state))
    }

    /// Fault of the node by its last heartbeat.
    pub fn fault(&self) -> Fault {
        self.last.and_then(|b| Fault::from_code(b.fault)).unwrap_or(Fault::None)
    }

    fn mode(&mut self, command: ModeCommand) -> Result<(), LinkError> {
        self.link.send(&Mode { command, node: self.node.get() }.frame())
    }
}
