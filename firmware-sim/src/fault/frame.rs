//! Faults of single frames on their way to or from a participant.

use std::collections::VecDeque;

use gadm_node::Frame;
use gadm_node::frame::{FD_LENGTHS, Kind, standard};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::spec::{Check, one};

/// What happens to frames. Probabilities are per frame; a tick is a control period.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum FrameFault {
    /// The frame is lost.
    Drop {
        /// Probability.
        p: f64,
    },
    /// Every n-th frame is lost.
    DropEvery {
        /// Distance of two lost frames, at least 1.
        n: u32,
    },
    /// Frames are lost in bursts. Source: Gilbert 1960, Elliott 1963 (two-state Markov channel).
    Burst {
        /// Probability that a burst begins at a frame.
        enter: f64,
        /// Probability that it ends at a frame.
        exit: f64,
        /// Probability that a frame of a burst is lost.
        #[serde(default = "one")]
        loss: f64,
    },
    /// The frame comes a fixed time late.
    Delay {
        /// Ticks.
        ticks: u32,
        /// Probability.
        #[serde(default = "one")]
        p: f64,
    },
    /// The frame comes a random time late.
    Jitter {
        /// Largest delay, ticks; all from 0 on are equally likely.
        ticks: u32,
    },
    /// The frame comes twice.
    Duplicate {
        /// Probability.
        p: f64,
    },
    /// Later frames overtake this one.
    Reorder {
        /// Probability.
        p: f64,
        /// Most frames that overtake one; 1 to this are equally likely.
        #[serde(default = "one_frame")]
        within: u32,
    },
    /// A bit of the payload is wrong.
    Corrupt {
        /// Probability.
        p: f64,
    },
    /// A bit of the identifier is wrong.
    CorruptId {
        /// Probability.
        p: f64,
    },
    /// The last bytes of the payload are missing.
    Truncate {
        /// Probability.
        p: f64,
        /// Bytes.
        #[serde(default = "one_frame")]
        bytes: u32,
    },
    /// An old frame comes once more, after the right one.
    Replay {
        /// Probability.
        p: f64,
        /// How many frames ago it was, 1 to 1024.
        #[serde(default = "one_frame")]
        age: u32,
    },
    /// A participant gone mad floods the bus. Frames with a less urgent identifier wait while the bus is full.
    Babble {
        /// Frames per tick.
        frames: u32,
        /// Their identifier.
        #[serde(default = "urgent")]
        id: u16,
    },
    /// The most urgent frames of a tick come last, as from a transmit queue without priorities.
    Inversion {
        /// Probability.
        p: f64,
    },
}

fn one_frame() -> u32 {
    1
}

/// More urgent than all but MODE.
fn urgent() -> u16 {
    1
}

impl FrameFault {
    pub(super) fn check(&self, check: &mut Check) {
        match *self {
            Self::Drop { p } | Self::Duplicate { p } | Self::Corrupt { p } | Self::CorruptId { p } => {
                check.probability("p", p);
            }
            Self::Inversion { p } => check.probability("p", p),
            Self::DropEvery { n } => check.count("n", n, 1, u32::MAX),
            Self::Burst { enter, exit, loss } => {
                check.probability("enter", enter);
                check.probability("exit", exit);
                check.probability("loss", loss);
            }
            Self::Delay { ticks, p } => {
                check.count("ticks", ticks, 1, 10_000);
                check.probability("p", p);
            }
            Self::Jitter { ticks } => check.count("ticks", ticks, 1, 10_000),
            Self::Reorder { p, within } => {
                check.probability("p", p);
                check.count("within", within, 1, 1024);
            }
            Self::Truncate { p, bytes } => {
                check.probability("p", p);
                check.count("bytes", bytes, 1, 64);
            }
            Self::Replay { p, age } => {
                check.probability("p", p);
                check.count("age", age, 1, 1024);
            }
            Self::Babble { frames, id } => {
                check.count("frames", frames, 1, 400);
                check.count("id", u32::from(id), 0, 0x7FF);
            }
        }
    }
}

/// What a frame fault remembers.
#[derive(Debug, Default)]
pub(super) struct FrameState {
    count: u64,
    in_burst: bool,
    /// Frames and the tick from which on they go on.
    waiting: Vec<(u64, Frame)>,
    /// Frames and how many others still overtake them.
    overtaken: Vec<(u32, Frame)>,
    /// Frames that go on when nothing else comes in this tick.
    last: Vec<Frame>,
    /// Frames that went by, newest last.
    past: VecDeque<Frame>,
}

impl FrameState {
    /// Lets one frame suffer: what goes on at once is appended to `out`. Returns how many faults were injected.
    pub(super) fn apply(
        &mut self,
        fault: &FrameFault,
        mut frame: Frame,
        now: u64,
        rng: &mut ChaCha8Rng,
        out: &mut Vec<Frame>,
    ) -> u64 {
        let mut hit = |p: f64| rng.random::<f64>() < p;
        match *fault {
            FrameFault::Drop { p } => {
                if hit(p) {
                    return 1;
                }
                out.push(frame);
                0
            }
            FrameFault::DropEvery { n } => {
                self.count += 1;
                if self.count.is_multiple_of(u64::from(n)) {
                    return 1;
                }
                out.push(frame);
                0
            }
            FrameFault::Burst { enter, exit, loss } => {
                self.in_burst = if self.in_burst { !hit(exit) } else { hit(enter) };
                if self.in_burst && hit(loss) {
                    return 1;
                }
                out.push(frame);
                0
            }
            FrameFault::Delay { ticks, p } => {
                if hit(p) {
                    self.waiting.push((now + u64::from(ticks), frame));
                    return 1;
                }
                out.push(frame);
                0
            }
            FrameFault::Jitter { ticks } => {
                let late = u64::from(rng.random_range(0..=ticks));
                if late > 0 {
                    self.waiting.push((now + late, frame));
                    return 1;
                }
                out.push(frame);
                0
            }
            FrameFault::Duplicate { p } => {
                out.push(frame);
                let doubled = hit(p);
                if doubled {
                    out.push(frame);
                }
                u64::from(doubled)
            }
            FrameFault::Reorder { p, within } => {
                let by = if hit(p) { rng.random_range(1..=within) } else { 0 };
                if by == 0 {
                    out.push(frame);
                }
                for (left, _) in &mut self.overtaken {
                    *left -= 1;
                }
                out.extend(self.overtaken.extract_if(.., |(left, _)| *left == 0).map(|(_, f)| f));
                if by > 0 {
                    self.overtaken.push((by, frame));
                }
                u64::from(by > 0)
            }
            FrameFault::Corrupt { p } => {
                let bits = frame.payload().len() * 8;
                let hit = hit(p) && bits > 0;
                if hit {
                    let bit = rng.random_range(0..bits);
                    frame.payload_mut()[bit / 8] ^= 1 << (bit % 8);
                }
                out.push(frame);
                u64::from(hit)
            }
            FrameFault::CorruptId { p } => {
                let hit = hit(p);
                if let (true, Some(id)) = (hit, frame.standard_id()) {
                    frame = with(&frame, id ^ (1 << rng.random_range(0..11)), frame.payload()).unwrap_or(frame);
                }
                out.push(frame);
                u64::from(hit)
            }
            FrameFault::Truncate { p, bytes } => {
                let left = frame.payload().len().saturating_sub(bytes as usize);
                let hit = hit(p) && left < frame.payload().len();
                if let (true, Some(id)) = (hit, frame.standard_id()) {
                    // FD has no 61 bytes: down to the next length that there is.
                    let left = if left > 8 { FD_LENGTHS.into_iter().rfind(|l| *l <= left).unwrap_or(8) } else { left };
                    frame = with(&frame, id, &frame.payload()[..left]).unwrap_or(frame);
                }
                out.push(frame);
                u64::from(hit)
            }
            FrameFault::Replay { p, age } => {
                out.push(frame);
                let old = self.past.len().checked_sub(age as usize).and_then(|i| self.past.get(i).copied());
                let replayed = old.filter(|_| hit(p));
                out.extend(replayed);
                self.past.push_back(frame);
                if self.past.len() > age as usize {
                    self.past.pop_front();
                }
                u64::from(replayed.is_some())
            }
            FrameFault::Inversion { p } => {
                if hit(p) {
                    self.last.push(frame);
                    return 1;
                }
                out.push(frame);
                0
            }
            FrameFault::Babble { .. } => {
                out.push(frame);
                0
            }
        }
    }

    /// What has waited long enough.
    pub(super) fn due(&mut self, now: u64, out: &mut VecDeque<Frame>) {
        out.extend(self.waiting.extract_if(.., |(at, _)| *at <= now).map(|(_, f)| f));
    }

    /// What was kept for the end of a tick: least urgent first.
    pub(super) fn last(&mut self, out: &mut VecDeque<Frame>) {
        self.last.sort_by_key(|f| std::cmp::Reverse(f.raw_id()));
        out.extend(self.last.drain(..));
    }
}

/// The same kind of frame with another identifier and payload.
fn with(frame: &Frame, id: u16, payload: &[u8]) -> Option<Frame> {
    let id = standard(id);
    match frame.kind() {
        Kind::Classic => Frame::classic(id, payload),
        Kind::Fd { brs } => Frame::fd(id, payload, brs),
        Kind::Remote => Frame::remote(id, frame.remote_dlc().unwrap_or(0)),
    }
}
