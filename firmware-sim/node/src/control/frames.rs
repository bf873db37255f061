//! What the node does with a frame.

use super::{ControlNode, TimeSource, increment};
use crate::codec::{Flags, FrameError};
use crate::frame::Frame;
use crate::link::Link;
use crate::protocol::{Function, MAX_ACTIONS, address};
use crate::safety::{Event, Fault, HOLD_LIMIT, INVALID_LIMIT, STALE_LIMIT, State};
use crate::service::{Estop, HostHeartbeat, Mode, ModeCommand, Request, Tick, TransferData, concerns};
use crate::store::Store;

impl<'p, L: Link, S: Store<'p>> ControlNode<'p, L, S> {
    pub(super) fn handle(&mut self, frame: &Frame) {
        let Some(to) = frame.standard_id().and_then(address) else { return };
        match to.message.function {
            Function::Mode => {
                let Some(mode) = Mode::parse(frame).filter(|m| concerns(m.node, self.config.node)) else { return };
                match mode.command {
                    ModeCommand::Run => self.request_run(),
                    ModeCommand::Stop => self.fire(Event::StopRequest, Fault::None),
                    ModeCommand::Reset => self.fire(Event::ResetRequest, Fault::None),
                }
            }
            Function::Estop => {
                if Estop::parse(frame).is_some_and(|e| concerns(e.node, self.config.node)) {
                    self.estop = true;
                    if self.state == State::Safe {
                        self.fault = Fault::Estop;
                        self.shaper.begin_ramp(true);
                    }
                    self.make_safe(Event::Estop, Fault::Estop);
                }
            }
            Function::Tick => {
                if let Some(tick) = Tick::parse(frame) {
                    self.on_tick(tick);
                } else {
                    self.drop_damaged();
                }
            }
            Function::Observation => self.on_observation(frame),
            Function::HostHeartbeat => {
                if HostHeartbeat::parse(frame).is_some() {
                    self.host_at_us = Some(self.now_us);
                }
            }
            Function::Request => {
                if let Some(request) = Request::parse(frame).filter(|r| r.node == self.config.node.get()) {
                    self.answer(request);
                }
            }
            Function::Transfer => {
                if let Some(data) = TransferData::parse(frame).filter(|d| d.node == self.config.node.get()) {
                    self.store.data(data.index, data.bytes());
                }
            }
            Function::Action | Function::Decision | Function::Reply | Function::Heartbeat => {}
        }
    }

    pub(super) fn on_tick(&mut self, t: Tick) {
        let mut ahead = self.tick.map_or(1, |last| t.tick.wrapping_sub(last));
        if ahead == 0 || ahead > u32::MAX / 2 || self.is_wild(ahead, t.time_us) {
            increment(&mut self.counters.sequence);
            self.stale_ticks = self.stale_ticks.saturating_add(1);
            if self.state == State::Run && self.stale_ticks >= STALE_LIMIT {
                self.make_safe(Event::TickLost, Fault::TickLost);
            }
            if self.state == State::Run || ahead == 0 {
                return;
            }
            // Not in control: the plant may have started again, follow it.
            self.tick = None;
            self.set.abandon();
            ahead = 1;
        }
        let passed = t.time_us.wrapping_sub(self.tick_time_us);
        let passed = if self.tick.is_none() || passed > u32::MAX / 2 { 0 } else { u64::from(passed) };
        if self.config.time == TimeSource::Tick {
            self.now_us = self.now_us.saturating_add(passed);
        }
        let elapsed = self.now_us.saturating_sub(self.tick_at_us);
        if self.tick.is_some() {
            self.monitor.observe(elapsed, ahead);
        }
        let quiet = self.now_us.saturating_sub(self.quiet_from_us);
        let first = self.tick.is_none();
        let unanswered = self.tick.filter(|_| !self.answered);
        if !self.judged {
            self.good_row = 0;
        }
        self.stale_ticks = 0;
        self.tick_time_us = t.time_us;
        (self.tick_at_us, self.quiet_from_us) = (self.now_us, self.now_us);
        self.tick = Some(t.tick);
        self.judged_before = self.judged && ahead == 1;
        (self.judged, self.answered) = (false, false);
        match self.state {
            State::Run => {
                let start = t.tick.wrapping_sub(1);
                let age = |last: Option<u32>| t.tick.wrapping_sub(last.unwrap_or(start));
                let (fresh, good) = (age(self.last_fresh), age(self.last_good));
                (self.last_fresh, self.last_good) =
                    (Some(self.last_fresh.unwrap_or(start)), Some(self.last_good.unwrap_or(start)));
                let lost = if unanswered.is_some() { ahead } else { ahead - 1 };
                self.counters.missed = self.counters.missed.saturating_add(lost);
                if !first && quiet > self.silence_us() {
                    self.make_safe(Event::TickLost, Fault::TickLost);
                } else if fresh >= STALE_LIMIT || good > HOLD_LIMIT {
                    self.make_safe(Event::ObservationLost, Fault::ObservationLost);
                } else if let Some(previous) = unanswered {
                    self.send_held(previous);
                }
            }
            State::Safe | State::Fault => self.send_safe(),
            _ => {}
        }
        self.judge();
    }

    /// In control, a tick that leaps ahead to a time that is not its own. A TICK has no CRC: an observation whose identifier
    /// was damaged can look like one.
    fn is_wild(&self, ahead: u32, time_us: u32) -> bool {
        let due = u64::from(ahead) * u64::from(self.period_us());
        let passed = u64::from(time_us.wrapping_sub(self.tick_time_us));
        self.state == State::Run && ahead > STALE_LIMIT && passed.abs_diff(due) > due / 2
    }

    /// Counts a frame that cannot be what its identifier says.
    fn drop_damaged(&mut self) {
        increment(&mut self.counters.crc_errors);
        self.crc.count(self.now_us, false);
    }

    pub(super) fn on_observation(&mut self, frame: &Frame) {
        let Some(layout) = &self.layout else { return };
        let part = match layout.observation_part(frame) {
            Err(FrameError::Foreign) => return,
            Err(_) => return self.drop_damaged(),
            Ok(part) => part,
        };
        self.crc.count(self.now_us, true);
        let profile = self.config.profile;
        // A part may overtake the TICK of its own period, but not more.
        match self.tick.map(|tick| profile.ahead(part.seq, profile.seq(tick))) {
            Some(0) if self.judged => increment(&mut self.counters.sequence),
            Some(0 | 1) => {
                let parts = layout.observation_parts();
                if self.set.push(&part, parts) == crate::assemble::Pushed::Duplicate {
                    increment(&mut self.counters.sequence);
                }
                self.judge();
            }
            Some(-1) if !self.judged_before => {
                increment(&mut self.counters.late);
                self.late = true;
            }
            _ => increment(&mut self.counters.sequence),
        }
    }

    /// Looks at the set of the current tick, once, as soon as it is complete.
    pub(super) fn judge(&mut self) {
        let (Some(tick), Some(layout), Some(policy)) = (self.tick, &self.layout, &self.policy) else { return };
        if self.judged {
            return;
        }
        let Some(values) = self.set.complete(self.config.profile.seq(tick), layout.obs_dim()) else { return };
        self.judged = true;
        self.last_fresh = Some(tick);
        let mut wanted = [0.0; MAX_ACTIONS];
        let wanted = wanted.get_mut(..layout.action_dim()).unwrap_or(&mut []);
        let running = self.state == State::Run && !self.answered;
        let valid = values.iter().all(|v| v.is_finite());
        let decision = if running && valid { policy.act(values, &mut self.scratch, wanted).ok() } else { None };
        if !valid || (running && decision.is_none()) {
            increment(&mut self.counters.invalid);
            self.good_row = 0;
            self.invalid_row = self.invalid_row.saturating_add(1);
            if running {
                increment(&mut self.counters.missed);
                if self.invalid_row >= INVALID_LIMIT {
                    self.make_safe(Event::ObservationInvalid, Fault::ObservationInvalid);
                } else {
                    self.send_held(tick);
                }
            }
            return;
        }
        self.invalid_row = 0;
        self.good_row = self.good_row.saturating_add(1);
        self.last_good = Some(tick);
        self.good_at_us = self.now_us;
        if let Some(decision) = decision {
            let clipped = self.shaper.take(wanted) || decision.clipped;
            self.latent = decision.latent;
            self.allowed = u8::try_from(decision.allowed.len()).unwrap_or(u8::MAX);
            self.counters.clipped = self.counters.clipped.saturating_add(u32::from(clipped));
            self.counters.fallback = self.counters.fallback.saturating_add(u32::from(decision.fallback));
            increment(&mut self.counters.acted);
            let flags = Flags::default().when(decision.fallback, Flags::FALLBACK).when(clipped, Flags::CLIPPED);
            self.answered = true;
            self.send_action(tick, self.latent, flags);
        }
    }
}
