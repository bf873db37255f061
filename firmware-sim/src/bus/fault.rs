//! A link with faults: every frame that a participant receives may be dropped, doubled, damaged, delayed or overtaken.
//!
//! All draws come from one seed, so a faulty run is as repeatable as a clean one, and every fault is counted: a fault
//! test whose count is zero has tested nothing.

use std::cell::Cell;
use std::collections::VecDeque;
use std::rc::Rc;

use gadm_node::protocol::{Function, address};
use gadm_node::{Frame, Link, LinkError};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// Probabilities per received frame, and which frames they are for.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FaultPlan {
    /// The frame is lost.
    pub drop: f64,
    /// The frame comes twice.
    pub duplicate: f64,
    /// One bit of the payload is wrong.
    pub corrupt: f64,
    /// The frame comes [`delay_us`](Self::delay_us) late.
    pub delay: f64,
    /// Length of a delay, microseconds of virtual time.
    pub delay_us: u64,
    /// The next frame overtakes this one.
    pub reorder: f64,
    /// Only frames of these functions; empty = all.
    pub only: Vec<Function>,
}

/// How many faults were put in.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct FaultCounts {
    /// Frames lost.
    pub dropped: u64,
    /// Frames doubled.
    pub duplicated: u64,
    /// Frames with a wrong bit.
    pub corrupted: u64,
    /// Frames delayed.
    pub delayed: u64,
    /// Frames overtaken.
    pub reordered: u64,
}

impl FaultCounts {
    /// All faults together.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.dropped + self.duplicated + self.corrupted + self.delayed + self.reordered
    }
}

/// A link whose received frames suffer the faults of a plan.
#[derive(Debug)]
pub struct FaultyLink<L> {
    inner: L,
    plan: FaultPlan,
    rng: ChaCha8Rng,
    clock: Rc<Cell<u64>>,
    ready: VecDeque<Frame>,
    overtaken: Option<Frame>,
    waiting: Vec<(u64, Frame)>,
    counts: Rc<Cell<FaultCounts>>,
}

impl<L: Link> FaultyLink<L> {
    /// Wraps `inner`. `clock` is the virtual time in microseconds, see
    /// [`Loopback::clock`](crate::bus::loopback::Loopback::clock).
    pub fn new(inner: L, plan: FaultPlan, seed: u64, clock: Rc<Cell<u64>>) -> Self {
        Self {
            inner,
            plan,
            rng: ChaCha8Rng::seed_from_u64(seed),
            clock,
            ready: VecDeque::new(),
            overtaken: None,
            waiting: Vec::new(),
            counts: Rc::default(),
        }
    }

    /// The counters, which stay readable while the link is in use elsewhere.
    pub fn counts(&self) -> Rc<Cell<FaultCounts>> {
        Rc::clone(&self.counts)
    }

    fn draw(&mut self, probability: f64) -> bool {
        // One draw per kind and frame, whatever the plan, so that two plans with one seed see the same numbers.
        self.rng.random::<f64>() < probability
    }

    fn take(&mut self, mut frame: Frame) {
        let concerned = self.plan.only.is_empty()
            || frame.standard_id().and_then(address).is_some_and(|a| self.plan.only.contains(&a.message.function));
        let plan = self.plan.clone();
        let draws = [plan.drop, plan.duplicate, plan.corrupt, plan.delay, plan.reorder].map(|p| self.draw(p));
        let bit = self.rng.random::<u32>() as usize;
        let before = self.overtaken.take();
        let mut counts = self.counts.get();
        if concerned {
            let [drop, duplicate, corrupt, delay, reorder] = draws;
            let bits = frame.payload().len() * 8;
            if drop {
                counts.dropped += 1;
            } else {
                if corrupt && bits > 0 {
                    counts.corrupted += 1;
                    frame.payload_mut()[bit % bits / 8] ^= 1 << (bit % 8);
                }
                if delay {
                    counts.delayed += 1;
                    self.waiting.push((self.clock.get() + plan.delay_us, frame));
                } else if reorder {
                    counts.reordered += 1;
                    self.overtaken = Some(frame);
                } else {
                    self.ready.push_back(frame);
                    if duplicate {
                        counts.duplicated += 1;
                        self.ready.push_back(frame);
                    }
                }
            }
        } else {
            self.ready.push_back(frame);
        }
        self.counts.set(counts);
        self.ready.extend(before);
    }
}

impl<L: Link> Link for FaultyLink<L> {
    fn receive(&mut self, frame: &mut Frame) -> Result<bool, LinkError> {
        let now = self.clock.get();
        let due = self.waiting.iter().take_while(|(at, _)| *at <= now).count();
        self.ready.extend(self.waiting.drain(..due).map(|(_, f)| f));
        let mut next = Frame::empty();
        while self.inner.receive(&mut next)? {
            self.take(next);
        }
        match self.ready.pop_front() {
            Some(f) => {
                *frame = f;
                Ok(true)
            }
            None => Ok(false),
        }
    }

    fn send(&mut self, frame: &Frame) -> Result<(), LinkError> {
        self.inner.send(frame)
    }

    fn restart(&mut self) -> Result<(), LinkError> {
        self.inner.restart()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::load::BitRate;
    use crate::bus::loopback::Loopback;
    use gadm_node::frame::standard;

    fn through(plan: FaultPlan, frames: &[Frame]) -> (Vec<Frame>, FaultCounts) {
        let bus = Loopback::new(BitRate::default(), None);
        let (mut a, b) = (bus.port(), bus.port());
        let mut faulty = FaultyLink::new(b, plan, 7, bus.clock());
        let counts = faulty.counts();
        let mut out = Vec::new();
        for (i, f) in frames.iter().enumerate() {
            bus.set_time(i as u64 * 1000);
            a.send(f).unwrap();
            let mut got = Frame::empty();
            while faulty.receive(&mut got).unwrap() {
                out.push(got);
            }
        }
        (out, counts.get())
    }

    fn frames(n: u16) -> Vec<Frame> {
        (0..n).map(|i| Frame::classic(standard(0x180), &i.to_le_bytes()).unwrap()).collect()
    }

    #[test]
    fn each_fault_does_what_it_says() {
        let sent = frames(100);
        let (got, n) = through(FaultPlan { drop: 0.3, ..FaultPlan::default() }, &sent);
        assert!((10..60).contains(&n.dropped) && got.len() == 100 - n.dropped as usize);
        let (got, n) = through(FaultPlan { duplicate: 1.0, ..FaultPlan::default() }, &sent);
        assert_eq!((n.duplicated, got.len()), (100, 200));
        let (got, n) = through(FaultPlan { corrupt: 1.0, ..FaultPlan::default() }, &sent);
        assert_eq!(n.corrupted, 100);
        for (a, b) in got.iter().zip(&sent) {
            let bits: u32 = a.payload().iter().zip(b.payload()).map(|(x, y)| (x ^ y).count_ones()).sum();
            assert_eq!(bits, 1);
        }
        let (got, n) = through(FaultPlan { delay: 1.0, delay_us: 5000, ..FaultPlan::default() }, &sent);
        assert_eq!((n.delayed, &got[..]), (100, &sent[..95]));
        let (got, n) = through(FaultPlan { reorder: 0.5, ..FaultPlan::default() }, &sent);
        assert!(n.reordered > 20 && got != sent[..got.len()]);
        let (got, n) = through(FaultPlan { drop: 1.0, only: vec![Function::Tick], ..FaultPlan::default() }, &sent);
        assert_eq!((n.total(), got), (0, sent));
    }

    #[test]
    fn same_seed_same_faults() {
        let plan = FaultPlan {
            drop: 0.2,
            duplicate: 0.2,
            corrupt: 0.2,
            delay: 0.2,
            delay_us: 3000,
            reorder: 0.2,
            only: vec![],
        };
        assert_eq!(through(plan.clone(), &frames(200)), through(plan, &frames(200)));
    }
}
