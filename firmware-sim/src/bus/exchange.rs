//! What a hub does, without sockets and clocks: members come and go, bytes of each are read as SLCAN, every frame goes to
//! all others in one order, every queue has an end.
//!
//! Every byte is hostile: a member can neither stop the others nor make this grow.

use std::collections::{BTreeMap, VecDeque};

use gadm_node::Frame;
use gadm_node::slcan::{Adapter, Decoder, MAX_LINE, encode, encode_stamped};

/// Number of a member; never used twice.
pub type Id = u64;

/// Bounds of an exchange.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Members at a time.
    pub members: usize,
    /// Frames and answers that may wait for one member.
    pub queue: usize,
}

impl Default for Limits {
    /// 32 members, 8192 frames each.
    fn default() -> Self {
        Self { members: 32, queue: 8192 }
    }
}

/// What a member did and suffered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Frames from it.
    pub sent: u64,
    /// Frames put into its queue.
    pub received: u64,
    /// Frames that it lost because its queue was full.
    pub dropped: u64,
    /// Lines of it that were refused.
    pub refused: u64,
}

#[derive(Clone, Copy, Debug)]
enum Out {
    Frame { frame: Frame, time_us: u64 },
    Answer(&'static [u8]),
}

#[derive(Debug)]
struct Member {
    decoder: Decoder,
    adapter: Adapter,
    queue: VecDeque<Out>,
    counts: Counts,
}

/// The exchange of a hub.
#[derive(Debug, Default)]
pub struct Exchange {
    limits: Limits,
    members: BTreeMap<Id, Member>,
    next: Id,
}

impl Exchange {
    /// Without members.
    #[must_use]
    pub fn new(limits: Limits) -> Self {
        Self { limits, members: BTreeMap::new(), next: 0 }
    }

    /// A new member, `None` where there is no room. Its channel is closed until it opens it, unless `open`.
    pub fn join(&mut self, open: bool) -> Option<Id> {
        if self.members.len() >= self.limits.members {
            return None;
        }
        let adapter = if open { Adapter::opened() } else { Adapter::new() };
        let member = Member { decoder: Decoder::new(), adapter, queue: VecDeque::new(), counts: Counts::default() };
        let id = self.next;
        self.next += 1;
        self.members.insert(id, member);
        Some(id)
    }

    /// The member is gone, and all that waited for it. Returns what it did; `None` where it was not there.
    pub fn leave(&mut self, id: Id) -> Option<Counts> {
        self.members.remove(&id).map(|m| m.counts)
    }

    /// Number of members.
    #[must_use]
    pub fn len(&self) -> usize {
        self.members.len()
    }

    /// No members.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.members.is_empty()
    }

    /// Is it there?
    #[must_use]
    pub fn has(&self, id: Id) -> bool {
        self.members.contains_key(&id)
    }

    /// Bytes from a member at `time_us`. `heard` gets every frame that went onto the bus.
    pub fn receive(&mut self, id: Id, bytes: &[u8], time_us: u64, heard: &mut dyn FnMut(&Frame)) {
        for &byte in bytes {
            let Some(member) = self.members.get_mut(&id) else { return };
            let Some(line) = member.decoder.push(byte) else { continue };
            let was_open = member.adapter.is_open();
            member.counts.refused += u64::from(line.is_err());
            let handled = member.adapter.handle(line);
            if was_open && !member.adapter.is_open() {
                // Who closes the channel does not want to find old frames when it is opened again.
                member.queue.retain(|out| matches!(out, Out::Answer(_)));
            }
            if !handled.answer.is_empty() && member.queue.len() < self.limits.queue {
                member.queue.push_back(Out::Answer(handled.answer));
            }
            if let Some(frame) = handled.frame {
                self.send(id, &frame, time_us);
                heard(&frame);
            }
        }
    }

    /// A frame from a member goes to all others that are open.
    pub fn send(&mut self, from: Id, frame: &Frame, time_us: u64) {
        for (&id, member) in &mut self.members {
            if id == from {
                member.counts.sent += 1;
            } else if !member.adapter.is_open() {
            } else if member.queue.len() < self.limits.queue {
                member.queue.push_back(Out::Frame { frame: *frame, time_us });
                member.counts.received += 1;
            } else {
                member.counts.dropped += 1;
            }
        }
    }

    /// Moves lines for a member to the end of `bytes`, while fewer than `limit` are in it.
    pub fn take(&mut self, id: Id, bytes: &mut Vec<u8>, limit: usize) {
        let Some(member) = self.members.get_mut(&id) else { return };
        let stamped = member.adapter.timestamps();
        let mut line = [0; MAX_LINE];
        while bytes.len() < limit {
            match member.queue.pop_front() {
                Some(Out::Answer(answer)) => bytes.extend_from_slice(answer),
                Some(Out::Frame { frame, time_us }) => {
                    let len = if stamped {
                        encode_stamped(&frame, time_us / 1000, &mut line)
                    } else {
                        encode(&frame, &mut line)
                    };
                    bytes.extend_from_slice(line.get(..len).unwrap_or(&[]));
                }
                None => return,
            }
        }
    }

    /// The next frame for a member that is no stream of bytes.
    pub fn take_frame(&mut self, id: Id) -> Option<Frame> {
        let member = self.members.get_mut(&id)?;
        loop {
            if let Out::Frame { frame, .. } = member.queue.pop_front()? {
                return Some(frame);
            }
        }
    }

    /// How much there is to take for a member.
    #[must_use]
    pub fn queued(&self, id: Id) -> usize {
        self.members.get(&id).map_or(0, |m| m.queue.len())
    }

    /// The member other than `from` that has room for fewer than `frames` more; the one with the least, if there are
    /// several.
    #[must_use]
    pub fn crowded(&self, from: Id, frames: usize) -> Option<Id> {
        self.members
            .iter()
            .filter(|&(&id, m)| id != from && m.adapter.is_open() && m.queue.len() + frames > self.limits.queue)
            .max_by_key(|(_, m)| m.queue.len())
            .map(|(&id, _)| id)
    }

    /// What a member did so far.
    #[must_use]
    pub fn counts(&self, id: Id) -> Option<Counts> {
        self.members.get(&id).map(|m| m.counts)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gadm_node::frame::standard;

    fn text(exchange: &mut Exchange, id: Id) -> String {
        let mut bytes = Vec::new();
        exchange.take(id, &mut bytes, usize::MAX);
        String::from_utf8(bytes).unwrap().replace('\r', "/").replace('\x07', "!")
    }

    #[test]
    fn all_others_hear_a_frame_once_they_are_open_and_the_sender_does_not() {
        let mut hub = Exchange::new(Limits::default());
        let (a, b, c) = (hub.join(true).unwrap(), hub.join(false).unwrap(), hub.join(false).unwrap());
        let mut heard = Vec::new();
        hub.receive(b, b"S6\rO\r", 0, &mut |f| heard.push(*f));
        hub.receive(c, b"Z1\rO\rbad\r", 0, &mut |f| heard.push(*f));
        hub.receive(a, b"t12", 0, &mut |f| heard.push(*f));
        hub.receive(a, b"3102\rt1230\r", 61_234_000, &mut |f| heard.push(*f));
        let frames = [&[2_u8][..], &[]].map(|d| Frame::classic(standard(0x123), d).unwrap());
        assert_eq!(heard, frames);
        assert_eq!(text(&mut hub, a), "//");
        assert_eq!(text(&mut hub, b), "//t123102/t1230/");
        assert_eq!(text(&mut hub, c), "//!t12310204D2/t123004D2/");
        assert_eq!(hub.leave(c), Some(Counts { sent: 0, received: 2, dropped: 0, refused: 1 }));
        assert_eq!((hub.leave(c), hub.has(c), hub.has(a)), (None, false, true));
    }

    #[test]
    fn a_full_queue_costs_its_owner_frames_and_nobody_else() {
        let mut hub = Exchange::new(Limits { members: 3, queue: 4 });
        let (a, slow, quick) = (hub.join(true).unwrap(), hub.join(true).unwrap(), hub.join(true).unwrap());
        assert_eq!(hub.join(true), None);
        for i in 0..10 {
            hub.receive(a, b"t0000\r", i, &mut |_| {});
            assert_eq!(hub.take_frame(quick), Frame::classic(standard(0), &[]));
        }
        assert_eq!(hub.counts(slow).map(|c| (c.received, c.dropped)), Some((4, 6)));
        assert_eq!(hub.counts(quick).map(|c| (c.received, c.dropped)), Some((10, 0)));
        assert_eq!((hub.crowded(a, 1), hub.crowded(slow, 1)), (Some(slow), Some(a))); // a never read its answers
        // Commands of a member whose queue is full have their effect, their answers are lost.
        hub.receive(slow, b"Z1\r", 0, &mut |_| {});
        assert_eq!(hub.queued(slow), 4);
        let mut line = Vec::new();
        hub.take(slow, &mut line, 1);
        assert_eq!(line, b"t00000000\r", "stamped");
        // Closing drops the frames that wait, not the answers, and so makes room for its own.
        hub.receive(slow, b"t0000\r", 0, &mut |_| {});
        assert_eq!(hub.queued(slow), 4);
        hub.receive(slow, b"C\r", 0, &mut |_| {});
        assert_eq!(text(&mut hub, slow), "//");
        hub.receive(a, b"t0000\r", 0, &mut |_| {});
        assert_eq!(hub.counts(slow).map(|c| (c.received, c.dropped)), Some((4, 6)));
    }

    #[test]
    fn a_line_without_end_does_not_grow() {
        let mut hub = Exchange::new(Limits::default());
        let a = hub.join(true).unwrap();
        hub.receive(a, &vec![b't'; 1 << 20], 0, &mut |_| {});
        hub.receive(a, b"\rV\r", 0, &mut |_| {});
        assert_eq!(text(&mut hub, a), "!V1013/");
    }
}
