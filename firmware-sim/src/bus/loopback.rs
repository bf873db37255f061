//! The bus in process: every frame goes to every other participant at once, in order, and to the trace.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::io;
use std::rc::Rc;

use gadm_node::{Frame, Link, LinkError};

use crate::bus::load::BitRate;

/// Frames that may wait for one participant. In lockstep a set and its answer are the most there is.
const QUEUE: usize = 4096;

/// Takes every frame with the time at which its last bit was on the wire, microseconds.
pub trait Tap {
    /// One frame.
    ///
    /// # Errors
    /// Where it cannot be stored; the run then ends with this error.
    fn frame(&mut self, time_us: u64, frame: &Frame) -> io::Result<()>;
}

struct Inner {
    queues: Vec<VecDeque<Frame>>,
    tap: Option<Box<dyn Tap>>,
    failed: Option<io::Error>,
    rate: BitRate,
    free_at_ns: u64,
    busy_ns: u64,
    frames: u64,
}

/// A bus with any number of participants. Clones are the same bus.
#[derive(Clone)]
pub struct Loopback {
    inner: Rc<RefCell<Inner>>,
    now_us: Rc<Cell<u64>>,
}

impl std::fmt::Debug for Loopback {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Loopback").field("now_us", &self.now_us).finish_non_exhaustive()
    }
}

/// One participant of a [`Loopback`].
#[derive(Debug)]
pub struct Port {
    bus: Loopback,
    index: usize,
}

impl Loopback {
    /// A bus without participants at time 0. `tap` sees every frame.
    #[must_use]
    pub fn new(rate: BitRate, tap: Option<Box<dyn Tap>>) -> Self {
        let inner = Inner { queues: Vec::new(), tap, failed: None, rate, free_at_ns: 0, busy_ns: 0, frames: 0 };
        Self { inner: Rc::new(RefCell::new(inner)), now_us: Rc::default() }
    }

    /// Adds a participant.
    #[must_use]
    pub fn port(&self) -> Port {
        let mut inner = self.inner.borrow_mut();
        inner.queues.push(VecDeque::new());
        Port { bus: self.clone(), index: inner.queues.len() - 1 }
    }

    /// Sets the virtual time, microseconds. Time stamps are this plus the time on the wire.
    pub fn set_time(&self, now_us: u64) {
        self.now_us.set(now_us);
    }

    /// The virtual time, for whoever needs to follow it.
    #[must_use]
    pub fn clock(&self) -> Rc<Cell<u64>> {
        Rc::clone(&self.now_us)
    }

    /// Frames so far, and the worst-case time they took on the wire, seconds.
    #[must_use]
    pub fn traffic(&self) -> (u64, f64) {
        let inner = self.inner.borrow();
        (inner.frames, inner.busy_ns as f64 / 1e9)
    }

    /// The first error of the tap.
    ///
    /// # Errors
    /// That error.
    pub fn check(&self) -> io::Result<()> {
        self.inner.borrow_mut().failed.take().map_or(Ok(()), Err)
    }
}

impl Link for Port {
    fn receive(&mut self, frame: &mut Frame) -> Result<bool, LinkError> {
        let mut inner = self.bus.inner.borrow_mut();
        let next = inner.queues.get_mut(self.index).and_then(VecDeque::pop_front);
        if let Some(next) = next {
            *frame = next;
        }
        Ok(next.is_some())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), LinkError> {
        let inner = &mut *self.bus.inner.borrow_mut();
        if inner.queues.iter().enumerate().any(|(i, q)| i != self.index && q.len() >= QUEUE) {
            return Err(LinkError::Full);
        }
        let wire_ns = inner.rate.time_ns(frame);
        inner.free_at_ns = inner.free_at_ns.max(self.bus.now_us.get() * 1000) + wire_ns;
        inner.busy_ns += wire_ns;
        inner.frames += 1;
        if let (Some(tap), None) = (&mut inner.tap, &inner.failed) {
            inner.failed = tap.frame(inner.free_at_ns / 1000, frame).err();
        }
        for (i, queue) in inner.queues.iter_mut().enumerate() {
            if i != self.index {
                queue.push_back(*frame);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gadm_node::frame::standard;

    #[test]
    fn all_others_hear_a_frame_in_order_and_the_sender_does_not() {
        let bus = Loopback::new(BitRate::default(), None);
        let (mut a, mut b, mut c) = (bus.port(), bus.port(), bus.port());
        let frames: Vec<_> = (0..3).map(|i| Frame::classic(standard(i), &[i as u8]).unwrap()).collect();
        for f in &frames {
            a.send(f).unwrap();
        }
        let mut got = Frame::empty();
        assert_eq!(a.receive(&mut got), Ok(false));
        for port in [&mut b, &mut c] {
            for f in &frames {
                assert_eq!(port.receive(&mut got), Ok(true));
                assert_eq!(got, *f);
            }
            assert_eq!(port.receive(&mut got), Ok(false));
        }
    }

    #[test]
    fn a_queue_that_nobody_reads_is_bounded_and_a_failing_tap_is_reported() {
        struct Full;
        impl Tap for Full {
            fn frame(&mut self, _: u64, _: &Frame) -> io::Result<()> {
                Err(io::Error::from(io::ErrorKind::StorageFull))
            }
        }
        let bus = Loopback::new(BitRate::default(), Some(Box::new(Full)));
        let (mut a, _b) = (bus.port(), bus.port());
        let frame = Frame::classic(standard(1), &[]).unwrap();
        let sent = (0..=QUEUE).filter(|_| a.send(&frame).is_ok()).count();
        assert_eq!(sent, QUEUE);
        assert_eq!(a.send(&frame), Err(LinkError::Full));
        assert_eq!(bus.check().unwrap_err().kind(), io::ErrorKind::StorageFull);
    }
}
