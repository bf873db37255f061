//! Boot and the states of the node.

use gadm_runtime::Policy;

use super::{ControlNode, Counters, NodeConfig, increment};
use crate::assemble::Assembler;
use crate::codec::{Flags, Layout};
use crate::link::Link;
use crate::protocol::NO_LATENT;
use crate::reason::Reason;
use crate::safety::{Event, Fault, GOOD_SETS, State, next};
use crate::shaper::Shaper;
use crate::store::Store;
use crate::timing::PeriodMonitor;
use crate::watch::{CrcWatch, Restarts};

/// A policy that can be run here, and its frames.
///
/// # Errors
/// Why it cannot.
pub(super) fn load<'p>(image: &'p [u8], config: &NodeConfig) -> Result<(Policy<'p>, Layout), (Fault, Reason)> {
    let policy = crate::policy::load(image).map_err(|error| (Fault::PolicyLoad, Reason::from(error)))?;
    let ranges = policy.observation_signals().map(|s| (s.lo, s.hi));
    let heads = policy.action_signals().map(|s| s.head);
    let layout = Layout::new(config.profile, config.node, policy.interface_hash(), ranges, heads)
        .map_err(|_| (Fault::PolicyLayout, Reason::Layout))?;
    Ok((policy, layout))
}

impl<'p, L: Link, S: Store<'p>> ControlNode<'p, L, S> {
    pub(super) fn boot(&mut self) {
        if !core::mem::replace(&mut self.booting, true) {
            self.refused = self.config.damaged.then_some((Fault::PolicyLoad, Reason::Settings, self.config.slot));
            self.store.begin_boot();
        }
        if self.next_policy() {
            self.fire(Event::Loaded, Fault::None);
        } else {
            let fault = self.refused.map_or(Fault::PolicyLoad, |(fault, ..)| fault);
            self.fire(Event::LoadFailed, fault);
        }
    }

    pub(super) fn self_test(&mut self) {
        let passed = self.policy.is_some_and(|policy| policy.self_test(&mut self.scratch).is_ok());
        if passed {
            self.booting = false;
            self.booted_at_us = self.now_us;
            self.store.running(Some(self.slot));
            self.fire(Event::SelfTestPassed, Fault::None);
            if self.estop {
                self.fire(Event::Estop, Fault::Estop);
            }
            return;
        }
        let too_big = self.policy.is_some_and(|policy| policy.spec().scratch_words > self.scratch.words());
        let reason = if too_big { Reason::Scratch } else { Reason::SelfTest };
        self.refuse(self.slot, Fault::PolicySelfTest, reason);
        // Another slot may hold a policy that passes; then it is the one under test.
        if !self.next_policy() {
            let fault = self.refused.map_or(Fault::PolicySelfTest, |(fault, ..)| fault);
            self.fire(Event::SelfTestFailed, fault);
        }
    }

    /// Loads the first of the remaining candidates that can be loaded.
    fn next_policy(&mut self) -> bool {
        (self.policy, self.layout) = (None, None);
        if self.config.damaged {
            return false;
        }
        while let Some(candidate) = self.store.next_candidate() {
            match load(candidate.image, &self.config) {
                Ok((policy, layout)) => {
                    let period = policy.spec().control_period_us;
                    let slots = policy.action_signals().map(|s| (s.head, s.safe));
                    self.shaper = Shaper::new(slots, self.config.ramp_ticks, self.config.rate_limit);
                    self.monitor = PeriodMonitor::new(period);
                    self.crc = CrcWatch::new(period);
                    self.layout = Some(layout);
                    self.policy = Some(policy);
                    (self.slot, self.trial) = (candidate.slot, candidate.trial);
                    return true;
                }
                Err((fault, reason)) => self.refuse(candidate.slot, fault, reason),
            }
        }
        false
    }

    fn refuse(&mut self, slot: u8, fault: Fault, reason: Reason) {
        self.store.reject(slot);
        // The first refusal counts, but that a slot is empty is no reason where something else was refused.
        if matches!(self.refused, None | Some((_, Reason::Erased, _))) {
            self.refused = Some((fault, reason, slot));
        }
    }

    /// The policy on trial was not confirmed in time: the one before runs again.
    pub(super) fn end_trial(&mut self) {
        self.trial = false;
        self.store.reject(self.slot);
        let slot = self.slot;
        self.fire(Event::ResetRequest, Fault::None);
        self.begin_boot_after((Fault::PolicyLoad, Reason::NotConfirmed, slot));
    }

    fn begin_boot_after(&mut self, refused: (Fault, Reason, u8)) {
        self.booting = true;
        self.refused = Some(refused);
        self.store.begin_boot();
    }

    /// Follows the arrow of `event`, if there is one.
    pub(super) fn fire(&mut self, event: Event, fault: Fault) {
        let (from, Some(to)) = (self.state, next(self.state, event)) else { return };
        self.state = to;
        self.fault = fault;
        match (from, to) {
            (_, State::Boot) => {
                if matches!(from, State::Run | State::Safe | State::Fault) {
                    self.leave_control();
                }
                self.forget();
            }
            (_, State::Safe) => {
                increment(&mut self.counters.safe_entries);
                self.shaper.begin_ramp(event == Event::Estop);
                self.good_row = 0;
            }
            (State::Ready, State::Run) => {
                self.warns_of_restart = false;
                self.shaper.reset();
                self.latent = NO_LATENT;
                self.start_run();
            }
            (State::Safe, State::Run) => self.start_run(),
            (State::Run, State::Ready) => {
                self.leave_control();
                self.host_at_us = None;
            }
            _ => {}
        }
    }

    /// The safe action, once, as the last word.
    pub(super) fn leave_control(&mut self) {
        self.shaper.reset();
        if let Some(tick) = self.tick {
            self.send_action(tick, NO_LATENT, Flags::SAFE);
            increment(&mut self.counters.safe);
        }
    }

    pub(super) fn start_run(&mut self) {
        self.last_fresh = self.tick;
        self.last_good = self.tick;
        self.good_at_us = self.now_us;
        self.quiet_from_us = self.now_us;
        self.answered = true; // control begins with the next tick
        self.invalid_row = 0;
        self.stale_ticks = 0;
        self.late = false;
        self.crc.clear();
        self.host_at_us = self.host_at_us.map(|_| self.now_us);
    }

    pub(super) fn forget(&mut self) {
        self.store.running(None);
        (self.booting, self.trial) = (false, false);
        self.policy = None;
        self.layout = None;
        self.estop = false;
        self.shaper = Shaper::default();
        self.set = Assembler::default();
        self.restarts = Restarts::default();
        self.tick = None;
        (self.judged, self.judged_before, self.answered) = (false, false, false);
        (self.stale_ticks, self.good_row, self.invalid_row) = (0, 0, 0);
        (self.last_fresh, self.last_good, self.host_at_us) = (None, None, None);
        (self.latent, self.allowed, self.inference_us, self.late) = (NO_LATENT, 0, 0, false);
        self.counters = Counters::default();
    }

    /// To SAFE, with the safe action at once where the current tick has no answer yet.
    pub(super) fn make_safe(&mut self, event: Event, fault: Fault) {
        let before = self.state;
        self.fire(event, fault);
        if self.state != before && self.state == State::Safe && !self.answered {
            self.send_safe();
        }
    }

    pub(super) fn request_run(&mut self) {
        let well = !self.estop && !self.bus_off;
        match self.state {
            State::Run => {}
            State::Ready if well => self.fire(Event::RunRequest, Fault::None),
            State::Safe if well && self.good_row >= GOOD_SETS => self.fire(Event::RunRequest, Fault::None),
            _ => increment(&mut self.counters.refused),
        }
    }
}
