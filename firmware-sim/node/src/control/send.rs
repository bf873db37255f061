//! What the node sends.

use super::{ControlNode, increment};
use crate::codec::{ActionHeader, Decision, Flags};
use crate::frame::Frame;
use crate::link::{Link, LinkError};
use crate::protocol::NO_LATENT;
use crate::safety::{Event, Fault, State};
use crate::store::Store;

impl<'p, L: Link, S: Store<'p>> ControlNode<'p, L, S> {
    pub(super) fn send_held(&mut self, tick: u32) {
        increment(&mut self.counters.held);
        self.answered |= Some(tick) == self.tick;
        self.send_action(tick, self.latent, Flags::HELD);
    }

    pub(super) fn send_safe(&mut self) {
        let Some(tick) = self.tick else { return };
        self.shaper.ramp();
        increment(&mut self.counters.safe);
        self.answered = true;
        self.send_action(tick, NO_LATENT, Flags::SAFE);
    }

    pub(super) fn send_action(&mut self, tick: u32, latent: u16, flags: Flags) {
        let late = core::mem::take(&mut self.late) || self.monitor.jitter() || self.monitor.bias();
        let header = ActionHeader { seq: self.config.profile.seq(tick), latent, flags: flags.when(late, Flags::LATE) };
        self.sent_at_us = self.now_us;
        let Some(layout) = &self.layout else { return };
        let parts = layout.action_parts();
        let decision = Decision { header, inference_us: self.inference_us, allowed: self.allowed };
        if let Some(frame) = layout.decision_frame(decision) {
            self.send(&frame);
        }
        for part in 0..parts {
            let frame = self.layout.as_ref().and_then(|l| l.action_frame(part, header, self.shaper.action()));
            if let Some(frame) = frame {
                self.send(&frame);
            }
        }
    }

    pub(super) fn send(&mut self, frame: &Frame) -> bool {
        let sent = self.link.send(frame);
        if let Err(error) = sent {
            self.link_failed(error);
        }
        sent.is_ok()
    }

    pub(super) fn link_failed(&mut self, error: LinkError) {
        increment(&mut self.counters.bus_errors);
        if error != LinkError::BusOff || self.bus_off {
            return;
        }
        self.bus_off = true;
        self.fire(Event::BusOff, Fault::BusOff);
        if self.state == State::Fault {
            return;
        }
        if self.restarts.allow(self.now_us) {
            if self.link.restart().is_err() {
                increment(&mut self.counters.bus_errors);
            }
        } else {
            self.fire(Event::BusOffRepeated, Fault::BusOffRepeated);
        }
    }
}
