//! What the node says of itself, and what it notices without a frame.

use gadm_runtime::Policy;

use super::{ControlNode, TimeSource};
use crate::link::Link;
use crate::protocol::HEARTBEAT_PERIOD_US;
use crate::safety::{Event, Fault, HOLD_LIMIT, SILENCE_US, STALE_LIMIT, State};
use crate::service::{Heartbeat, Page};
use crate::slots::TRIAL_US;
use crate::store::Store;

impl<'p, L: Link, S: Store<'p>> ControlNode<'p, L, S> {
    pub(super) fn silence_us(&self) -> u64 {
        SILENCE_US.max(u64::from(STALE_LIMIT) * u64::from(self.period_us()))
    }

    pub(super) fn watch(&mut self) {
        let (now, period) = (self.now_us, u64::from(self.period_us()));
        let local = self.config.time == TimeSource::Local;
        if self.state == State::Run {
            let since_tick = now.saturating_sub(self.quiet_from_us);
            if self.host_at_us.is_some_and(|at| now.saturating_sub(at) > self.silence_us()) {
                self.make_safe(Event::HostLost, Fault::HostLost);
            } else if self.crc.too_many() {
                self.make_safe(Event::CrcErrors, Fault::CrcErrors);
            } else if local && since_tick > self.silence_us() {
                self.make_safe(Event::TickLost, Fault::TickLost);
            } else if now.saturating_sub(self.good_at_us) > u64::from(HOLD_LIMIT) * period + period / 5 {
                // Ticks count periods; where they do not come, or come slower than agreed, the time does, with the
                // tolerance of the period.
                self.make_safe(Event::ObservationLost, Fault::ObservationLost);
            }
        }
        if self.trial && self.policy_runs() && now.saturating_sub(self.booted_at_us) > TRIAL_US {
            self.end_trial();
        }
        let controlling = matches!(self.state, State::Safe | State::Fault);
        if local && controlling && self.tick.is_some() && now.saturating_sub(self.sent_at_us) > period + period / 5 {
            self.send_safe();
        }
    }

    /// The policy was tested and is the one that runs or waits to run.
    fn policy_runs(&self) -> bool {
        matches!(self.state, State::Ready | State::Run | State::Safe | State::Fault)
    }

    /// Sends the heartbeat where there is news or where it is due. Time that comes with the ticks stands still between
    /// them; there the action goes first.
    pub(super) fn heartbeat(&mut self, last: bool) {
        let now = (self.state, self.reported_fault());
        let acting = self.state == State::Run && !self.answered;
        let lockstep = self.config.time == TimeSource::Tick;
        let due = self.now_us.saturating_sub(self.heartbeat_at_us) >= HEARTBEAT_PERIOD_US
            && if lockstep { !acting } else { last };
        if self.reported == Some(now) && !due {
            return;
        }
        let page = match self.state {
            State::NoPolicy => Page::PolicyError,
            _ => Page::from_code(self.page).unwrap_or(Page::InterfaceLow),
        };
        let frame = Heartbeat {
            node: self.config.node.get(),
            state: now.0.code(),
            page: page.code(),
            fault: now.1.code(),
            seq: self.heartbeat_seq,
            value: self.value(page),
        };
        self.unsent = !self.send(&frame.frame());
        if self.unsent {
            return;
        }
        self.reported = Some(now);
        self.heartbeat_at_us = self.now_us;
        self.heartbeat_seq = self.heartbeat_seq.wrapping_add(1);
        self.page = if Page::from_code(self.page + 1).is_some() { self.page + 1 } else { 0 };
    }

    pub(super) fn reported_fault(&self) -> Fault {
        match self.fault {
            Fault::None if self.state == State::Run && self.monitor.jitter() => Fault::PeriodJitter,
            Fault::None if self.state == State::Run && self.monitor.bias() => Fault::PeriodBias,
            Fault::None if self.policy_runs() && self.warns_of_restart => Fault::Restarted,
            Fault::None if self.policy_runs() && self.refused.is_some() => Fault::SlotFallback,
            fault => fault,
        }
    }

    pub(super) fn value(&self, page: Page) -> u32 {
        let hash = self.policy.as_ref().map_or(0, Policy::interface_hash);
        let [a, b, c, d, e, f, g, h] = hash.to_le_bytes();
        match page {
            Page::InterfaceLow => u32::from_le_bytes([a, b, c, d]),
            Page::InterfaceHigh => u32::from_le_bytes([e, f, g, h]),
            Page::PolicyCrc => self.policy.as_ref().map_or(0, |p| p.header().payload_crc32),
            Page::Slot => u32::from(self.slot),
            Page::InferenceUs => u32::from(self.inference_us),
            Page::Misses => self.counters.missed,
            Page::Jitter => {
                let report = self.monitor.report();
                let ([j0, j1], [b0, b1]) = (report.jitter_permille.to_le_bytes(), report.bias_permille.to_le_bytes());
                u32::from_le_bytes([j0, j1, b0, b1])
            }
            Page::CrcErrors => self.counters.crc_errors,
            Page::TornSets => self.set.torn(),
            Page::Sequence => self.counters.sequence,
            Page::Invalid => self.counters.invalid,
            Page::SafeEntries => self.counters.safe_entries,
            Page::PolicyError => {
                self.refused.map_or(0, |(_, reason, slot)| u32::from_le_bytes([reason.code(), slot, 0, 0]))
            }
            Page::Slots => {
                let [a, b] = self.store.states().map(crate::slots::SlotState::code);
                u32::from_le_bytes([a, b, self.slot, u8::from(self.trial)])
            }
        }
    }
}
