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

use gadm_node::protocol::NodeId;
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

/// Is this frame part of lockstep, and so not of the conversation? Kind, length and node are looked at too: an observation
/// may come with the identifier of a reply where identifiers are damaged on purpose.
#[must_use]
pub fn is_lockstep(frame: &Frame) -> bool {
    let ours = |node: u8, op: u8| NodeId::new(node).is_some() && matches!(op, OP_START | OP_BARRIER);
    if let Some(request) = Request::parse(frame) {
        return ours(request.node, request.op) && request.page == 0 && request.value == 0;
    }
    // A node that knows no lockstep says so.
    let refused = |r: Reply| r.op == OP_REFUSED && u8::try_from(r.value).is_ok_and(|op| ours(r.node, op));
    Reply::parse(frame).is_some_and(|reply| ours(reply.node, reply.op) || refused(reply))
}

#[cfg(test)]
mod tests {
    use gadm_node::frame::standard;

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
            // Parts of observations whose identifier has one wrong bit (0x180 and 0x580).
            (Frame::fd(standard(0x580), &[OP_BARRIER; 64], true).unwrap(), false),
            (Frame::classic(standard(0x580), &[OP_BARRIER; 8]).unwrap(), false),
        ] {
            assert_eq!(is_lockstep(&frame), expected, "{frame:?}");
        }
        assert_eq!(parse_reply(&reply(OP_BARRIER, 99), node).map(|r| r.value), Some(99));
    }
}
