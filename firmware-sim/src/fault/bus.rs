//! Faults of the controller and the cable of a participant.

use std::collections::VecDeque;

use gadm_node::{Frame, LinkError};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::spec::Check;

/// What happens to a participant's access to the bus, from the start of the window on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum BusFault {
    /// The node's controller goes bus-off. It comes back when the node restarts it and the recovery time has passed.
    BusOff {
        /// Recovery time after the restart, ticks.
        ticks: u32,
        /// Again after so many ticks; 0 = once.
        #[serde(default)]
        every: u32,
    },
    /// Transmissions of the node fail and are repeated, with the error counter of ISO 11898-1: above 127 the controller
    /// is error-passive, above 255 bus-off.
    ErrorPassive {
        /// Probability that one attempt fails.
        p: f64,
        /// Attempts that fit before the frame is too late and given up.
        #[serde(default = "attempts")]
        attempts: u32,
    },
    /// The cable of the participant is cut: nothing comes in, and what it sends waits in three mailboxes.
    Disconnect {
        /// Duration, ticks.
        ticks: u32,
    },
    /// The node runs at another bit rate: it understands nothing, and every attempt to send fails.
    BitRate {
        /// Duration, ticks.
        ticks: u32,
    },
    /// The node's receive queue is too short: of what comes in one tick, the first frames are kept.
    Overflow {
        /// Frames that it holds.
        capacity: u32,
    },
}

fn attempts() -> u32 {
    8
}

impl BusFault {
    pub(super) fn check(&self, check: &mut Check) {
        match *self {
            Self::BusOff { ticks, every } => {
                check.count("ticks", ticks, 1, 1_000_000);
                check.count("every", every, 0, 1_000_000);
            }
            Self::ErrorPassive { p, attempts } => {
                check.probability("p", p);
                check.count("attempts", attempts, 1, 1000);
            }
            Self::Disconnect { ticks } | Self::BitRate { ticks } => check.count("ticks", ticks, 1, 1_000_000),
            Self::Overflow { capacity } => check.count("capacity", capacity, 0, 4096),
        }
    }
}

/// Above this the controller is error-passive, above twice this and one bus-off. Source: ISO 11898-1, fault confinement.
const PASSIVE: u32 = 127;
const OFF: u32 = 255;
/// What one failed attempt adds to the error counter.
const FAILED: u32 = 8;
/// Frames that wait in the controller of a participant whose cable is cut.
const MAILBOXES: usize = 3;

/// What a bus fault remembers.
#[derive(Debug, Default)]
pub(super) struct BusState {
    /// Transmit error counter.
    errors: u32,
    off: bool,
    recovered_at: Option<u64>,
    mailboxes: VecDeque<Frame>,
    /// Tick of the last frame received, and frames since its start.
    received: (u64, u32),
    /// Ticks in which the controller was error-passive.
    pub(super) passive_tick: Option<u64>,
}

/// What a controller does with a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fate {
    /// It goes on.
    Pass,
    /// It is lost.
    Lost,
    /// The controller does not take it.
    Refused(LinkError),
}

impl BusState {
    /// True where the controller is off the bus at `now`.
    pub(super) fn is_off(&mut self, now: u64) -> bool {
        if self.off && self.recovered_at.is_some_and(|at| at <= now) {
            *self = Self::default();
        }
        self.off
    }

    pub(super) fn go_off(&mut self) {
        self.off = true;
        self.recovered_at = None;
    }

    /// The node asks the controller to come back.
    pub(super) fn restart(&mut self, fault: &BusFault, now: u64) {
        if self.off && self.recovered_at.is_none() {
            let wait = if let BusFault::BusOff { ticks, .. } = *fault { u64::from(ticks) } else { 1 };
            self.recovered_at = Some(now + wait);
        }
    }

    /// Frames that waited for the cable.
    pub(super) fn release(&mut self) -> impl Iterator<Item = Frame> {
        std::mem::take(&mut self.mailboxes).into_iter()
    }

    /// What becomes of a frame that comes in, and how many faults that was.
    pub(super) fn receive(&mut self, fault: &BusFault, now: u64) -> (Fate, u64) {
        match *fault {
            BusFault::BusOff { .. } | BusFault::ErrorPassive { .. } => (Fate::Pass, 0),
            BusFault::Disconnect { .. } | BusFault::BitRate { .. } => (Fate::Lost, 1),
            BusFault::Overflow { capacity } => {
                if self.received.0 != now {
                    self.received = (now, 0);
                }
                self.received.1 += 1;
                if self.received.1 > capacity { (Fate::Lost, 1) } else { (Fate::Pass, 0) }
            }
        }
    }

    /// What becomes of a frame that the node sends.
    pub(super) fn send(&mut self, fault: &BusFault, frame: &Frame, now: u64, rng: &mut ChaCha8Rng) -> (Fate, u64) {
        let (p, attempts) = match *fault {
            BusFault::BusOff { .. } | BusFault::Overflow { .. } => return (Fate::Pass, 0),
            BusFault::Disconnect { .. } => {
                if self.mailboxes.len() < MAILBOXES {
                    self.mailboxes.push_back(*frame);
                    return (Fate::Lost, 1);
                }
                return (Fate::Refused(LinkError::Full), 1);
            }
            BusFault::ErrorPassive { p, attempts } => (p, attempts),
            BusFault::BitRate { .. } => (1.0, MAX_ATTEMPTS),
        };
        let mut failed = 0;
        for _ in 0..attempts {
            if rng.random::<f64>() >= p {
                self.errors = self.errors.saturating_sub(1);
                return (Fate::Pass, failed);
            }
            failed += 1;
            self.errors += FAILED;
            if self.errors > PASSIVE {
                self.passive_tick = Some(now);
            }
            if self.errors > OFF {
                self.go_off();
                return (Fate::Refused(LinkError::BusOff), failed);
            }
        }
        (Fate::Lost, failed)
    }
}

/// Attempts within a period at a wrong bit rate; more than lead to bus-off.
const MAX_ATTEMPTS: u32 = 64;
