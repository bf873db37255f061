//! The bus as SLCAN lines on the board's UART.

use gadm_node::service::{OP_BARRIER, OP_START, Reply, Request};
use gadm_node::slcan::{Adapter, Decoder, MAX_LINE, encode};
use gadm_node::{Frame, Link, LinkError, NodeId};

use crate::board;

/// What a host asked for that is not for the node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Asked {
    /// A host opened a channel that was closed: it knows nothing of the node yet.
    Opened,
    /// START of lockstep: a power cycle. With the tag of the request.
    Start(u16),
    /// BARRIER of lockstep: answer when there is nothing left to do. With the tag of the request.
    Barrier(u16),
}

/// One participant, the node, on a bus that a host reaches through the UART. The channel is open from power-on, so that
/// a board that restarted is heard at once; `C` closes it.
#[derive(Debug)]
pub struct UartLink {
    decoder: Decoder,
    adapter: Adapter,
    node: NodeId,
    asked: Option<Asked>,
    received: u32,
    sent: u8,
}

impl UartLink {
    /// An open channel of node `node`.
    #[must_use]
    pub const fn new(node: NodeId) -> Self {
        Self { decoder: Decoder::new(), adapter: Adapter::opened(), node, asked: None, received: 0, sent: 0 }
    }

    /// What a host asked for, once. The node must have come to rest before.
    pub fn take_asked(&mut self) -> Option<Asked> {
        self.asked.take()
    }

    /// Answers START. From here on frames are counted anew.
    pub fn started(&mut self, tag: u16, mode: u8, policy_crc: u32) {
        (self.received, self.sent) = (0, 0);
        self.reply(OP_START, mode, tag, policy_crc);
    }

    /// Answers BARRIER: frames sent since the last one, frames received since START.
    pub fn at_rest(&mut self, tag: u16) {
        let sent = core::mem::take(&mut self.sent);
        self.reply(OP_BARRIER, sent, tag, self.received);
    }

    fn reply(&self, op: u8, page: u8, tag: u16, value: u32) {
        put(&Reply { node: self.node.get(), op, page, tag, value }.frame());
    }
}

fn write(bytes: &[u8]) {
    for &byte in bytes {
        board::uart_write(byte);
    }
}

fn put(frame: &Frame) {
    let mut line = [0; MAX_LINE];
    let len = encode(frame, &mut line);
    write(line.get(..len).unwrap_or(&[]));
}

impl Link for &mut UartLink {
    /// Returns nothing while [`take_asked`](UartLink::take_asked) has something: what came after it waits.
    fn receive(&mut self, frame: &mut Frame) -> Result<bool, LinkError> {
        while self.asked.is_none() {
            let Some(byte) = board::uart_read() else { break };
            let Some(line) = self.decoder.push(byte) else { continue };
            let was_open = self.adapter.is_open();
            let handled = self.adapter.handle(line);
            write(handled.answer);
            if self.adapter.is_open() && !was_open {
                self.asked = Some(Asked::Opened);
            }
            let Some(received) = handled.frame else { continue };
            match Request::parse(&received).filter(|r| r.node == self.node.get()) {
                Some(Request { op: OP_START, tag, .. }) => self.asked = Some(Asked::Start(tag)),
                Some(Request { op: OP_BARRIER, tag, .. }) => self.asked = Some(Asked::Barrier(tag)),
                #[cfg(feature = "hang")]
                Some(Request { op: 0x7F, .. }) => loop {
                    core::hint::spin_loop();
                },
                _ => {
                    self.received = self.received.wrapping_add(1);
                    *frame = received;
                    return Ok(true);
                }
            }
        }
        Ok(false)
    }

    /// While the channel is closed, a frame is lost, as on a bus that nobody listens to.
    fn send(&mut self, frame: &Frame) -> Result<(), LinkError> {
        if self.adapter.is_open() {
            self.sent = self.sent.wrapping_add(1);
            put(frame);
        }
        Ok(())
    }
}
