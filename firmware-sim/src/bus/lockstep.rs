//! Lockstep between processes: how the side that owns the time knows that the node has handled everything.
//!
//! Two requests that never are in a trace, since in process nothing like them is needed:
//!
//! | frame | bytes | meaning |
//! | --- | --- | --- |
//! | REQUEST 0x600 + n, op 0x10 | op, 0, tag u16 | START: power cycle; the node forgets everything and waits for the first BARRIER |
//! | REPLY 0x580 + n, op 0x10 | op, mode, tag, CRC-32 of its policy | the node is new; mode bit 0: `classic-i16`, bit 7: real time |
//! | REQUEST, op 0x11 | op, 0, tag u16 | BARRIER: handle all that came before this frame, until nothing is left to do |
//! | REPLY, op 0x11 | op, frames sent since the last BARRIER modulo 256, tag, frames received since START | the node is at rest |
//!
//! Between barriers the node only collects, so that it never acts on half a set, and its frames come in the order of a
//! node in process. The two counts make a lost frame an error instead of a difference.

use gadm_node::protocol::{Function, NodeId, address};
use gadm_node::service::{OP_REFUSED, Reply, Request};
use gadm_node::{Frame, Profile};

/// START.
pub const OP_START: u8 = 0x10;
/// BARRIER.
pub const OP_BARRIER: u8 = 0x11;

/// Bit of the mode: values travel as `classic-i16`.
pub const MODE_CLASSIC: u8 = 0x01;
/// Bit of the mode: the node's time is the wall's.
pub const MODE_REALTIME: u8 = 0x80;

/// The mode that a node reports.
#[must_use]
pub fn mode(profile: Profile, realtime: bool) -> u8 {
    let classic = if profile == Profile::ClassicI16 { MODE_CLASSIC } else { 0 };
    classic | if realtime { MODE_REALTIME } else { 0 }
}

/// A request of lockstep for node `node`.
#[must_use]
pub fn request(node: NodeId, op: u8, tag: u16) -> Frame {
    Request { node: node.get(), op, page: 0, tag, value: 0 }.frame()
}

/// The request for node `node` in `frame`, if it is one of lockstep.
#[must_use]
pub fn parse_request(frame: &Frame, node: NodeId) -> Option<Request> {
    Request::parse(frame).filter(|r| r.node == node.get() && matches!(r.op, OP_START | OP_BARRIER))
}

/// The reply of node `node` in `frame`, whatever it answers.
#[must_use]
pub fn parse_reply(frame: &Frame, node: NodeId) -> Option<Reply> {
    Reply::parse(frame).filter(|r| r.node == node.get())
}

/// Is this frame part of lockstep, and so not of the conversation?
#[must_use]
pub fn is_lockstep(frame: &Frame) -> bool {
    let Some(to) = frame.standard_id().and_then(address) else { return false };
    match (to.message.function, frame.payload()) {
        (Function::Request | Function::Reply, [OP_START | OP_BARRIER, ..]) => true,
        // A node that knows no lockstep says so.
        (Function::Reply, [OP_REFUSED, _, _, _, op, 0, 0, 0]) => matches!(*op, OP_START | OP_BARRIER),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lockstep_frames_are_told_from_the_conversation() {
        let node = NodeId::DEFAULT;
        let start = request(node, OP_START, 7);
        assert_eq!(parse_request(&start, node).map(|r| (r.op, r.tag)), Some((OP_START, 7)));
        assert_eq!(parse_request(&start, NodeId::new(2).unwrap()), None);
        let reply = |op, value| Reply { node: node.get(), op, page: 0, tag: 7, value }.frame();
        for (frame, expected) in [
            (start, true),
            (request(node, OP_BARRIER, 0), true),
            (request(node, 1, 0), false),
            (reply(OP_BARRIER, 99), true),
            (reply(1, 99), false),
            (reply(OP_REFUSED, u32::from(OP_START)), true),
            (reply(OP_REFUSED, 5), false),
            (Frame::empty(), false),
        ] {
            assert_eq!(is_lockstep(&frame), expected, "{frame:?}");
        }
        assert_eq!(parse_reply(&reply(OP_BARRIER, 99), node).map(|r| r.value), Some(99));
    }
}
