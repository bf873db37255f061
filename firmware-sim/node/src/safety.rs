//! States, events and faults of the node: one table, from which the code acts and the documentation is checked.
//!
//! ```text
//! BOOT ─► SELFTEST ─► READY ◄─► RUN ─► SAFE ─► RUN | FAULT
//!              └────► NO_POLICY            (RESET leads back to BOOT from all but the first two)
//! ```

use strum::{FromRepr, IntoStaticStr, VariantArray};

use crate::coded::coded;

/// Control periods without a good observation set after which the node goes to [`State::Safe`].
pub const STALE_LIMIT: u32 = 3;
/// Sets with an invalid value in a row after which the node goes to [`State::Safe`].
pub const INVALID_LIMIT: u32 = 3;
/// Control periods for which an action may be repeated, whatever the mix of missing and invalid sets.
pub const HOLD_LIMIT: u32 = 3;
/// Good sets in a row that must have come before [`State::Safe`] may be left.
pub const GOOD_SETS: u32 = 5;
/// Time without TICK or host heartbeat after which the node goes to [`State::Safe`], microseconds (or
/// [`STALE_LIMIT`] control periods, whichever is longer).
pub const SILENCE_US: u64 = 300_000;
/// Bus-off recoveries that are tried within [`BUS_OFF_WINDOW_US`].
pub const BUS_OFF_LIMIT: usize = 3;
/// Window of [`BUS_OFF_LIMIT`].
pub const BUS_OFF_WINDOW_US: u64 = 60_000_000;
/// Frames with a wrong CRC, in per cent of the policy's frames, above which the node goes to [`State::Safe`].
pub const CRC_LIMIT_PERCENT: u32 = 10;
/// Fewest wrong frames in the window for [`CRC_LIMIT_PERCENT`] to count, so that one frame of a slow plant does not.
pub const CRC_LIMIT_FRAMES: u32 = 3;
/// Window of [`CRC_LIMIT_PERCENT`], microseconds (or ten control periods, whichever is longer).
pub const CRC_WINDOW_US: u64 = 1_000_000;

/// State of the node. The number is the one on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, FromRepr, IntoStaticStr, VariantArray)]
#[repr(u8)]
#[strum(serialize_all = "SCREAMING_SNAKE_CASE")]
pub enum State {
    /// Reads the policy image.
    Boot = 0,
    /// Runs the policy's own vectors.
    #[strum(serialize = "SELFTEST")]
    SelfTest = 1,
    /// There is no policy that may be run.
    NoPolicy = 2,
    /// Waits for RUN; sends no actions.
    Ready = 3,
    /// Controls.
    Run = 4,
    /// Sends the safe action, reached by a ramp.
    Safe = 5,
    /// Sends the safe action; only RESET or power leads out.
    Fault = 6,
}

coded!(State);

/// Why the node is not (or not wholly) well. The number is the one on the wire; from 64 on it is a warning, which does
/// not change the state.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr, IntoStaticStr, VariantArray)]
#[repr(u8)]
#[strum(serialize_all = "SCREAMING_SNAKE_CASE")]
pub enum Fault {
    /// Nothing to report.
    None = 0,
    /// The image is not a policy that can be run.
    PolicyLoad = 1,
    /// The policy failed its own vectors.
    #[strum(serialize = "POLICY_SELFTEST")]
    PolicySelfTest = 2,
    /// The policy does not fit the bus profile.
    PolicyLayout = 3,
    /// No good observation set for too long.
    ObservationLost = 4,
    /// Invalid values for too long.
    ObservationInvalid = 5,
    /// No TICK, or only ticks out of sequence.
    TickLost = 6,
    /// No host heartbeat.
    HostLost = 7,
    /// Too many frames with a wrong CRC, length or interface hash.
    CrcErrors = 8,
    /// The controller left the bus.
    BusOff = 9,
    /// The controller left the bus too often.
    BusOffRepeated = 10,
    /// Emergency stop.
    Estop = 11,
    /// Warning: a control period was off by more than 20 %.
    PeriodJitter = 64,
    /// Warning: the mean control period is off by more than 20 %.
    PeriodBias = 65,
    /// Warning: a policy that should run could not, an older one runs.
    SlotFallback = 66,
    /// Warning: the watchdog or a fault of the core restarted the board.
    Restarted = 67,
}

coded!(Fault);

impl Fault {
    /// What it means, in one line.
    #[must_use]
    pub const fn meaning(self) -> &'static str {
        match self {
            Self::None => "nothing to report",
            Self::PolicyLoad => "the image is not a policy that this node can run",
            Self::PolicySelfTest => "the policy failed its own vectors",
            Self::PolicyLayout => "the policy does not fit the bus profile",
            Self::ObservationLost => "3 control periods without a good observation set",
            Self::ObservationInvalid => "3 observation sets in a row with an invalid value",
            Self::TickLost => "no TICK for 300 ms (or 3 periods, if longer), or 3 ticks in a row out of sequence",
            Self::HostLost => "no host heartbeat for 300 ms (or 3 periods, if longer)",
            Self::CrcErrors => "more than 10 % of the frames of 1 s (or 10 periods, if longer) wrong, and at least 3",
            Self::BusOff => "the CAN controller went bus-off",
            Self::BusOffRepeated => "bus-off for the fourth time within one minute",
            Self::Estop => "emergency stop",
            Self::PeriodJitter => "warning: a control period was off by more than 20 %",
            Self::PeriodBias => "warning: the mean of 64 control periods is off by more than 20 %",
            Self::SlotFallback => {
                "warning: the policy that should run was refused, another one runs; page policy_error"
            }
            Self::Restarted => "warning: the watchdog or a fault of the core restarted the board; until the first RUN",
        }
    }
}

/// What may change the state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// The image was read and is a policy.
    Loaded,
    /// The image is not a policy, or does not fit the profile.
    LoadFailed,
    /// The policy passed its own vectors.
    SelfTestPassed,
    /// The policy failed its own vectors.
    SelfTestFailed,
    /// MODE RUN. In SAFE it counts only after 5 good sets, with the bus up and no emergency stop latched.
    RunRequest,
    /// MODE STOP.
    StopRequest,
    /// MODE RESET.
    ResetRequest,
    /// No good observation set for 3 periods.
    ObservationLost,
    /// 3 sets in a row with an invalid value.
    ObservationInvalid,
    /// No TICK, or only ticks out of sequence.
    TickLost,
    /// No host heartbeat.
    HostLost,
    /// Too many wrong frames.
    CrcErrors,
    /// Bus-off.
    BusOff,
    /// Bus-off for the fourth time within a minute.
    BusOffRepeated,
    /// ESTOP.
    Estop,
}

/// One arrow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Transition {
    /// State before.
    pub from: State,
    /// What happened.
    pub event: Event,
    /// State after.
    pub to: State,
    /// What the node does on the way.
    pub action: &'static str,
}

const fn arrow(from: State, event: Event, to: State, action: &'static str) -> Transition {
    Transition { from, event, to, action }
}

const RAMP: &str = "safe action by a ramp";
const RESTART: &str = "forget everything, read the image again";
const LEAVE: &str = "safe action once; forget everything, read the image again";

/// All arrows. What is not here does not change the state.
pub const TRANSITIONS: &[Transition] = &[
    arrow(State::Boot, Event::Loaded, State::SelfTest, "heartbeat"),
    arrow(State::Boot, Event::LoadFailed, State::NoPolicy, "say why in the heartbeat"),
    arrow(State::SelfTest, Event::SelfTestPassed, State::Ready, "heartbeat"),
    arrow(State::SelfTest, Event::SelfTestFailed, State::NoPolicy, "say why in the heartbeat; refuse RUN"),
    arrow(State::Ready, Event::RunRequest, State::Run, "start with the safe action as last action"),
    arrow(State::Ready, Event::Estop, State::Safe, "safe action at once; latched until RESET"),
    arrow(State::Ready, Event::BusOff, State::Safe, "restart the controller"),
    arrow(State::Run, Event::StopRequest, State::Ready, "safe action once, then silence"),
    arrow(State::Run, Event::ObservationLost, State::Safe, RAMP),
    arrow(State::Run, Event::ObservationInvalid, State::Safe, RAMP),
    arrow(State::Run, Event::TickLost, State::Safe, RAMP),
    arrow(State::Run, Event::HostLost, State::Safe, RAMP),
    arrow(State::Run, Event::CrcErrors, State::Safe, RAMP),
    arrow(State::Run, Event::BusOff, State::Safe, "restart the controller; safe action by a ramp"),
    arrow(State::Run, Event::Estop, State::Safe, "safe action at once; latched until RESET"),
    arrow(State::Safe, Event::RunRequest, State::Run, "control again"),
    arrow(State::Safe, Event::BusOffRepeated, State::Fault, "no further restart of the controller"),
    arrow(State::NoPolicy, Event::ResetRequest, State::Boot, RESTART),
    arrow(State::Ready, Event::ResetRequest, State::Boot, RESTART),
    arrow(State::Run, Event::ResetRequest, State::Boot, LEAVE),
    arrow(State::Safe, Event::ResetRequest, State::Boot, LEAVE),
    arrow(State::Fault, Event::ResetRequest, State::Boot, LEAVE),
];

/// The state after `event`, where the table has such an arrow.
#[must_use]
pub fn next(from: State, event: Event) -> Option<State> {
    TRANSITIONS.iter().find(|t| t.from == from && t.event == event).map(|t| t.to)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_a_function_and_every_state_can_be_reached_and_left() {
        for (i, a) in TRANSITIONS.iter().enumerate() {
            assert!(!TRANSITIONS[..i].iter().any(|b| b.from == a.from && b.event == a.event), "{a:?} is there twice");
            assert_ne!(a.from, a.to);
        }
        let mut reached = std::vec![State::Boot];
        for _ in 0..State::ALL.len() {
            for t in TRANSITIONS {
                if reached.contains(&t.from) && !reached.contains(&t.to) {
                    reached.push(t.to);
                }
            }
        }
        assert_eq!(reached.len(), State::ALL.len());
        for &s in State::ALL {
            assert!(TRANSITIONS.iter().any(|t| t.from == s), "{s:?} has no way out");
        }
    }

    #[test]
    fn only_a_run_request_leads_to_run_and_only_safe_to_fault() {
        for t in TRANSITIONS {
            assert!(t.to != State::Run || t.event == Event::RunRequest, "{t:?}");
            assert!(t.to != State::Fault || t.from == State::Safe, "{t:?}");
            assert!(!(t.from == State::NoPolicy && t.event == Event::RunRequest), "{t:?}");
        }
    }

    #[test]
    fn codes_are_unique_and_come_back() {
        for &s in State::ALL {
            assert_eq!(State::from_code(s.code()), Some(s));
        }
        for &f in Fault::ALL {
            assert_eq!(Fault::from_code(f.code()), Some(f));
        }
        assert_eq!(State::from_code(7), None);
    }
}
