//! The node's way to the bus, with the faults of frames and of the controller.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;

use gadm_node::protocol::{Role, address};
use gadm_node::{Frame, Link, LinkError};
use rand_chacha::ChaCha8Rng;

use super::bus::{BusFault, BusState, Fate};
use super::frame::{FrameFault, FrameState};
use super::inject::{Shared, stream};
use super::spec::{Fault, Kind, Participant};

/// Direction as the node sees it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Way {
    In,
    Out,
}

/// One fault of frames on one way.
#[derive(Debug)]
struct Step {
    index: usize,
    fault: Fault,
    rng: ChaCha8Rng,
    state: FrameState,
}

/// One fault of the controller or the cable.
#[derive(Debug)]
struct Controller {
    index: usize,
    fault: Fault,
    rng: ChaCha8Rng,
    state: BusState,
}

/// All frames that go one way.
#[derive(Debug, Default)]
struct Lane {
    steps: Vec<Step>,
    ready: VecDeque<Frame>,
    /// Wait for a free bus.
    starved: VecDeque<Frame>,
    /// Answers of a slow node, and when they go out.
    slow: VecDeque<(u64, Frame)>,
}

/// A link between a node and its bus that suffers the faults of a scenario. Without faults it changes nothing.
#[derive(Debug)]
pub struct FaultyLink<L> {
    inner: L,
    shared: Rc<RefCell<Shared>>,
    incoming: Lane,
    outgoing: Lane,
    controllers: Vec<Controller>,
}

impl<L: Link> FaultyLink<L> {
    pub(super) fn new(inner: L, faults: &[Fault], seed: u64, shared: Rc<RefCell<Shared>>) -> Self {
        let (mut incoming, mut outgoing, mut controllers) = (Lane::default(), Lane::default(), Vec::new());
        for (index, fault) in faults.iter().enumerate() {
            let (fault, rng) = (fault.clone(), stream(seed, index));
            match &fault.kind {
                Kind::Frame(_) => {
                    let lane = if fault.target == Participant::Node { &mut incoming } else { &mut outgoing };
                    lane.steps.push(Step { index, fault, rng, state: FrameState::default() });
                }
                Kind::Bus(_) => controllers.push(Controller { index, fault, rng, state: BusState::default() }),
                _ => {}
            }
        }
        Self { inner, shared, incoming, outgoing, controllers }
    }

    /// Lets a frame suffer everything that lies on its way.
    fn suffer(&mut self, way: Way, frame: Frame) {
        let mut shared = self.shared.borrow_mut();
        let lane = if way == Way::In { &mut self.incoming } else { &mut self.outgoing };
        let mut batch = vec![frame];
        for step in &mut lane.steps {
            let Kind::Frame(kind) = &step.fault.kind else { continue };
            if !shared.active(step.fault.window) {
                continue;
            }
            let mut out = Vec::with_capacity(batch.len());
            for frame in batch {
                if concerned(&step.fault, &frame) {
                    let n = step.state.apply(kind, frame, shared.now, &mut step.rng, &mut out);
                    shared.hit(step.index, n);
                } else {
                    out.push(frame);
                }
            }
            batch = out;
        }
        for frame in batch {
            if shared.wire_is_free(&frame) { lane.ready.push_back(frame) } else { lane.starved.push_back(frame) }
        }
    }

    /// What waited for the bus or for a slow node and may go on now.
    fn wake(&mut self) {
        let mut shared = self.shared.borrow_mut();
        let now = shared.now;
        for lane in [&mut self.incoming, &mut self.outgoing] {
            while lane.starved.front().is_some_and(|f| shared.wire_is_free(f)) {
                lane.ready.extend(lane.starved.pop_front());
            }
            while lane.slow.front().is_some_and(|(at, _)| *at <= now) {
                lane.ready.extend(lane.slow.pop_front().map(|(_, f)| f));
            }
        }
    }

    /// Off the bus at the moment?
    fn off(&mut self) -> bool {
        let mut shared = self.shared.borrow_mut();
        let mut off = false;
        for c in &mut self.controllers {
            let Kind::Bus(kind) = &c.fault.kind else { continue };
            if let BusFault::BusOff { every, .. } = *kind
                && shared.strikes(c.index, c.fault.window, every)
            {
                c.state.go_off();
                shared.hit(c.index, 1);
            }
            off |= c.state.is_off(shared.now);
        }
        off
    }

    /// Brings what is ready on its way out to the bus.
    fn flush(&mut self) -> Result<(), LinkError> {
        while let Some(frame) = self.outgoing.ready.pop_front() {
            self.transmit(frame)?;
        }
        Ok(())
    }

    fn transmit(&mut self, frame: Frame) -> Result<(), LinkError> {
        let mut shared = self.shared.borrow_mut();
        for c in &mut self.controllers {
            let Kind::Bus(kind) = &c.fault.kind else { continue };
            let concerned = c.fault.target == Participant::Node || goes_to(&frame, c.fault.target);
            if !concerned || !shared.acts(c.fault.window, kind) {
                continue;
            }
            let (fate, n) = c.state.send(kind, &frame, shared.now, &mut c.rng);
            shared.hit(c.index, n);
            match fate {
                Fate::Pass => {}
                Fate::Lost => return Ok(()),
                Fate::Refused(error) => return Err(error),
            }
        }
        drop(shared);
        self.inner.send(&frame)
    }

    /// Takes what the bus has, through the controller.
    fn take(&mut self) -> Result<(), LinkError> {
        let mut frame = Frame::empty();
        while self.inner.receive(&mut frame)? {
            let mut lost = false;
            let mut shared = self.shared.borrow_mut();
            for c in &mut self.controllers {
                let Kind::Bus(kind) = &c.fault.kind else { continue };
                let concerned = c.fault.target == Participant::Node || comes_from(&frame, c.fault.target);
                if concerned && shared.acts(c.fault.window, kind) && !lost {
                    let (fate, n) = c.state.receive(kind, shared.now);
                    shared.hit(c.index, n);
                    lost = fate != Fate::Pass;
                }
            }
            drop(shared);
            if !lost {
                self.suffer(Way::In, frame);
            }
        }
        for step in &mut self.incoming.steps {
            step.state.last(&mut self.incoming.ready);
        }
        Ok(())
    }

    /// Frames that waited for a cable that is whole again.
    fn reconnect(&mut self) {
        let shared = self.shared.borrow();
        for c in &mut self.controllers {
            let Kind::Bus(kind) = &c.fault.kind else { continue };
            if !shared.acts(c.fault.window, kind) {
                self.outgoing.ready.extend(c.state.release());
            }
        }
    }

    /// Power cycle of the controller.
    fn forget(&mut self) {
        if std::mem::take(&mut self.shared.borrow_mut().cycled) {
            for c in &mut self.controllers {
                c.state = BusState::default();
            }
            for lane in [&mut self.incoming, &mut self.outgoing] {
                lane.ready.clear();
                lane.starved.clear();
                lane.slow.clear();
                for step in &mut lane.steps {
                    step.state = FrameState::default();
                }
            }
        }
    }
}

impl<L: Link> Link for FaultyLink<L> {
    fn receive(&mut self, frame: &mut Frame) -> Result<bool, LinkError> {
        if self.shared.borrow().idle() {
            return self.inner.receive(frame);
        }
        self.forget();
        if self.shared.borrow().dark() {
            let mut lost = Frame::empty();
            while self.inner.receive(&mut lost)? {}
            return Ok(false);
        }
        if self.off() {
            let mut lost = Frame::empty();
            while self.inner.receive(&mut lost)? {}
            return Err(LinkError::BusOff);
        }
        self.wake();
        self.reconnect();
        for step in &mut self.outgoing.steps {
            step.state.last(&mut self.outgoing.ready);
        }
        self.flush()?;
        self.take()?;
        // A delayed frame comes as late in its tick as it was sent: after the TICK.
        let now = self.shared.borrow().now;
        for lane in [&mut self.incoming, &mut self.outgoing] {
            for step in &mut lane.steps {
                step.state.due(now, &mut lane.ready);
            }
        }
        self.flush()?;
        let next = self.incoming.ready.pop_front();
        if let Some(next) = next {
            *frame = next;
        }
        Ok(next.is_some())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), LinkError> {
        if self.shared.borrow().idle() {
            return self.inner.send(frame);
        }
        if self.shared.borrow().dark() {
            return Ok(());
        }
        if self.off() {
            return Err(LinkError::BusOff);
        }
        let slow = if goes_to(frame, Participant::Plant) { self.shared.borrow_mut().slow(frame) } else { None };
        if let Some(at) = slow {
            self.outgoing.slow.push_back((at, *frame));
            return Ok(());
        }
        self.suffer(Way::Out, *frame);
        self.flush()
    }

    fn restart(&mut self) -> Result<(), LinkError> {
        let now = self.shared.borrow().now;
        for c in &mut self.controllers {
            if let Kind::Bus(kind) = &c.fault.kind {
                c.state.restart(kind, now);
            }
        }
        self.inner.restart()
    }
}

/// Whether a fault is for this frame.
fn concerned(fault: &Fault, frame: &Frame) -> bool {
    if let Kind::Frame(FrameFault::Babble { .. }) = fault.kind {
        return false;
    }
    if !fault.only.is_empty() {
        let function = frame.standard_id().and_then(address).map(|a| a.message.function);
        return function.is_some_and(|f| fault.only.contains(&f));
    }
    fault.target == Participant::Node || goes_to(frame, fault.target)
}

/// Frames of the node that a participant reads.
fn goes_to(frame: &Frame, who: Participant) -> bool {
    let to = frame.standard_id().and_then(address).map(|a| a.message.to);
    match who {
        Participant::Node => false,
        Participant::Plant => to == Some(Role::Plant),
        Participant::Host => matches!(to, Some(Role::Host | Role::Any)),
    }
}

/// Frames that a participant sends.
fn comes_from(frame: &Frame, who: Participant) -> bool {
    let from = frame.standard_id().and_then(address).map(|a| a.message.from);
    match who {
        Participant::Node => false,
        Participant::Plant => from == Some(Role::Plant),
        Participant::Host => from == Some(Role::Host),
    }
}
