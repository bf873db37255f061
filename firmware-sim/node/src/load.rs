//! Time that frames take on the wire, at worst, and whether a policy fits a bus.
//!
//! Bit counts are those of ISO 11898-1 with every possible stuff bit and the three bits of interframe space. The
//! response time is that of fixed-priority scheduling without preemption (Davis, Burns, Bril, Lukkien 2007): the set
//! itself, one frame of lower urgency that was already on the wire, and everything more urgent that may come between.
//! The arithmetic is here, and not in the simulator, because the exporter asks the same question.

use gadm_runtime::Policy;
use serde::Serialize;

use crate::codec::{Layout, LayoutError, Profile};
use crate::frame::{Frame, Kind};
use crate::protocol::{HEARTBEAT_PERIOD_US, NodeId};

/// Bus load that a policy may put on a bus, per cent: above it, event frames and retries have no room.
pub const LOAD_LIMIT_PERCENT: f64 = 70.0;
/// Share of the control period in which the observation set must have crossed the bus, per cent, and again the action set:
/// what both leave is for the inference.
pub const RESPONSE_LIMIT_PERCENT: f64 = 50.0;
/// Bit rates that are tried for a proposal, slowest first.
pub const USUAL_RATES: [(Profile, BitRate); 8] = [
    (Profile::ClassicI16, BitRate { nominal: 125_000, data: 2_000_000 }),
    (Profile::ClassicI16, BitRate { nominal: 250_000, data: 2_000_000 }),
    (Profile::ClassicI16, BitRate { nominal: 500_000, data: 2_000_000 }),
    (Profile::ClassicI16, BitRate { nominal: 1_000_000, data: 2_000_000 }),
    (Profile::FdF32, BitRate { nominal: 500_000, data: 2_000_000 }),
    (Profile::FdF32, BitRate { nominal: 500_000, data: 5_000_000 }),
    (Profile::FdF32, BitRate { nominal: 1_000_000, data: 5_000_000 }),
    (Profile::FdF32, BitRate { nominal: 1_000_000, data: 8_000_000 }),
];

/// Bit rates of a bus, bit/s.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct BitRate {
    /// Classic frames, and the arbitration phase of FD frames.
    pub nominal: u32,
    /// Data phase of FD frames with bit-rate switch.
    pub data: u32,
}

impl Default for BitRate {
    /// 500 kbit/s, 2 Mbit/s.
    fn default() -> Self {
        Self { nominal: 500_000, data: 2_000_000 }
    }
}

impl BitRate {
    /// Worst-case time of a frame, nanoseconds.
    #[must_use]
    pub fn frame_ns(self, kind: Kind, extended: bool, payload: usize) -> u64 {
        let (nominal, data) = worst_case_bits(kind, extended, payload);
        let time = |bits: u64, rate: u32| bits.saturating_mul(1_000_000_000) / u64::from(rate.max(1));
        time(nominal, self.nominal) + time(data, self.data)
    }

    /// As [`frame_ns`](Self::frame_ns), of a frame.
    #[must_use]
    pub fn time_ns(self, frame: &Frame) -> u64 {
        self.frame_ns(frame.kind(), frame.standard_id().is_none(), frame.payload().len())
    }
}

/// Bits of a frame at the nominal and at the data bit rate.
#[must_use]
pub fn worst_case_bits(kind: Kind, extended: bool, payload: usize) -> (u64, u64) {
    let bytes = payload.min(64) as u64;
    match kind {
        // Start to CRC sequence are stuffed (34 or 54 bits and the data); 13 bits of delimiter, ACK, EOF and space are not.
        Kind::Classic | Kind::Remote => {
            let stuffed = if extended { 54 } else { 34 } + 8 * bytes;
            (stuffed + 13 + (stuffed - 1) / 4, 0)
        }
        Kind::Fd { brs } => {
            // Start, identifier, RRS (SRR, IDE), IDE, FDF, res, BRS.
            let head = if extended { 36 } else { 17 };
            let nominal = head + (head - 1) / 4 + 13;
            // ESI, DLC and data with dynamic stuffing; stuff count, CRC and their fixed stuff bits.
            let body = 5 + 8 * bytes;
            let tail = if bytes <= 16 { 4 + 17 + 6 } else { 4 + 21 + 7 };
            let data = body + body / 4 + tail;
            if brs { (nominal, data) } else { (nominal + data, 0) }
        }
    }
}

/// Load that a policy puts on a bus.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Load {
    /// Observation frames of one control period.
    pub observation_frames: usize,
    /// Action frames of one control period, DECISION included.
    pub action_frames: usize,
    /// Worst-case time of the observation and action sets, per cent of the control period.
    pub sets_percent: f64,
    /// As above with TICK and both heartbeats.
    pub total_percent: f64,
    /// Worst-case time from the start of a control period to the end of the last observation frame, µs.
    pub observation_us: f64,
    /// Worst-case time from the end of the inference to the end of the last action frame, µs.
    pub action_us: f64,
    /// Control period, µs.
    pub period_us: u32,
}

/// Which limit a load is above.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Excess {
    /// The bus is too full.
    Load {
        /// Load, per cent.
        percent: f64,
    },
    /// A set takes too long.
    Response {
        /// Which: `observation` or `action`.
        set: &'static str,
        /// Response time, µs.
        response_us: f64,
        /// Limit, µs.
        limit_us: f64,
    },
}

impl core::fmt::Display for Excess {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Load { percent } => write!(f, "bus load {percent:.0} %, limit {LOAD_LIMIT_PERCENT:.0} %"),
            Self::Response { set, response_us, limit_us } => {
                write!(f, "the {set} set takes {response_us:.0} us, limit {limit_us:.0} us (half a control period)")
            }
        }
    }
}

impl Load {
    /// The first limit that this load is above; `None` where it fits.
    #[must_use]
    pub fn excess(&self) -> Option<Excess> {
        if self.total_percent > LOAD_LIMIT_PERCENT {
            return Some(Excess::Load { percent: self.total_percent });
        }
        let limit_us = f64::from(self.period_us) * RESPONSE_LIMIT_PERCENT / 100.0;
        [("observation", self.observation_us), ("action", self.action_us)]
            .into_iter()
            .find(|(_, response_us)| *response_us > limit_us)
            .map(|(set, response_us)| Excess::Response { set, response_us, limit_us })
    }
}

/// The load of a layout at a control period.
#[must_use]
#[expect(clippy::cast_precision_loss, reason = "times far below 2^53 ns")]
pub fn load(layout: &Layout, period_us: u32, rate: BitRate) -> Load {
    let classic = layout.profile() == Profile::ClassicI16;
    let kind = if classic { Kind::Classic } else { Kind::Fd { brs: true } };
    let per_part = layout.profile().values();
    let set_ns = |dim: usize| -> u64 {
        let full = rate.frame_ns(kind, false, layout.payload_len(per_part)) * (dim / per_part) as u64;
        let rest = dim % per_part;
        full + if rest > 0 { rate.frame_ns(kind, false, layout.payload_len(rest)) } else { 0 }
    };
    let service_ns = |bytes: usize| rate.frame_ns(Kind::Classic, false, bytes);
    let (tick_ns, decision_ns) = (service_ns(8), if classic { service_ns(8) } else { 0 });
    let (observation_ns, action_ns) = (set_ns(layout.obs_dim()), set_ns(layout.action_dim()));
    let sets_ns = observation_ns + action_ns;
    let control_ns = sets_ns + tick_ns + decision_ns;
    // HEARTBEAT and HOST_HEARTBEAT.
    let heartbeats_ns = service_ns(8) + service_ns(1);
    // Before each set: a frame of less urgency that is on the wire, and a MODE and an ESTOP, which are more urgent.
    let before_ns = service_ns(8) + service_ns(2) + service_ns(1);
    let period_ns = f64::from(period_us.max(1)) * 1e3;
    Load {
        observation_frames: layout.observation_parts(),
        action_frames: layout.action_parts() + usize::from(classic),
        sets_percent: sets_ns as f64 / period_ns * 100.0,
        total_percent: (control_ns as f64 / period_ns + heartbeats_ns as f64 / (HEARTBEAT_PERIOD_US as f64 * 1e3))
            * 100.0,
        observation_us: (before_ns + tick_ns + observation_ns) as f64 / 1e3,
        action_us: (before_ns + decision_ns + action_ns) as f64 / 1e3,
        period_us,
    }
}

/// The load of a policy on a bus.
///
/// # Errors
/// Where the profile cannot carry the policy, whatever the bit rate.
pub fn policy_load(policy: &Policy, profile: Profile, rate: BitRate) -> Result<Load, LayoutError> {
    let layout = Layout::of_policy(policy, profile, NodeId::DEFAULT)?;
    Ok(load(&layout, policy.spec().control_period_us, rate))
}

/// The slowest of the [`USUAL_RATES`] on which `profile` carries the policy within the limits; `None` where none does.
#[must_use]
pub fn proposal(policy: &Policy, profile: Profile) -> Option<(BitRate, Load)> {
    USUAL_RATES
        .iter()
        .filter(|(p, _)| *p == profile)
        .filter_map(|&(_, rate)| Some((rate, policy_load(policy, profile, rate).ok()?)))
        .find(|(_, load)| load.excess().is_none())
}

#[cfg(test)]
mod tests {
    use super::*;
    use gadm_runtime::ActionHead;
    use std::string::ToString as _;

    #[test]
    fn bits_of_known_frames() {
        assert_eq!(worst_case_bits(Kind::Classic, false, 8), (135, 0));
        assert_eq!(worst_case_bits(Kind::Classic, false, 0), (47 + 8, 0));
        assert_eq!(worst_case_bits(Kind::Classic, true, 8), (160, 0));
        let us = |nominal, data, n| BitRate { nominal, data }.frame_ns(Kind::Fd { brs: true }, false, n) as f64 / 1e3;
        for (n, slow, fast) in [(64, 407.0, 170.0), (32, 247.0, 106.0), (16, 164.0, 73.0), (8, 124.0, 57.0)] {
            assert!((us(500_000, 2_000_000, n) - slow).abs() <= 1.0, "{n}: {}", us(500_000, 2_000_000, n));
            assert!((us(1_000_000, 5_000_000, n) - fast).abs() <= 1.0, "{n}: {}", us(1_000_000, 5_000_000, n));
        }
    }

    fn of(profile: Profile, obs: usize, act: usize, period_us: u32, nominal: u32, data: u32) -> Load {
        let heads = (0..act).map(|_| ActionHead::Continuous { lo: -1.0, hi: 1.0 });
        let layout = Layout::new(profile, NodeId::DEFAULT, 0, (0..obs).map(|_| (-1.0, 1.0)), heads).unwrap();
        load(&layout, period_us, BitRate { nominal, data })
    }

    #[test]
    fn load_table_of_known_tasks() {
        // Hopper, Walker2d, Ant v5, Humanoid v5, Humanoid v4: classic at 500k, FD f32 at 0.5/2 and 1/5.
        for (obs, act, period, classic, slow, fast) in [
            (11, 3, 8_000, 16.9, 7.4, 3.1),
            (17, 6, 8_000, 27.0, 10.5, 4.5),
            (105, 8, 50_000, 20.5, 7.0, 2.9),
            (348, 17, 15_000, 220.0, 71.8, 29.9),
            (376, 17, 15_000, 238.0, 77.2, 32.2),
        ] {
            let got = [
                of(Profile::ClassicI16, obs, act, period, 500_000, 1),
                of(Profile::FdF32, obs, act, period, 500_000, 2_000_000),
                of(Profile::FdF32, obs, act, period, 1_000_000, 5_000_000),
            ];
            for (got, want) in got.into_iter().map(|l| l.sets_percent).zip([classic, slow, fast]) {
                assert!((got - want).abs() <= 0.06_f64.max(want * 0.005), "{obs}/{act}: {got} instead of {want}");
            }
        }
    }

    #[test]
    fn response_of_hopper_by_hand() {
        // At 500 kbit/s a bit is 2 us. 135 bits each have TICK, 4 OBS, ACT, DECISION and the blocking frame; MODE has 75
        // (47 + 16 and 12 stuff bits), ESTOP 65 (47 + 8 and 10).
        let load = of(Profile::ClassicI16, 11, 3, 8_000, 500_000, 1);
        assert_eq!(load.observation_us, f64::from(2 * (6 * 135 + 75 + 65)));
        assert_eq!(load.action_us, f64::from(2 * (3 * 135 + 75 + 65)));
        assert_eq!(load.excess(), None);
    }

    #[test]
    fn what_does_not_fit_is_told() {
        let full = of(Profile::ClassicI16, 376, 17, 15_000, 500_000, 1);
        assert!(matches!(full.excess(), Some(Excess::Load { percent }) if percent > 238.0), "{full:?}");
        assert!(full.excess().unwrap().to_string().starts_with("bus load 24"));
        // Two thirds of the period for the sets: not too full, but too slow.
        let slow = of(Profile::FdF32, 348, 17, 16_500, 500_000, 2_000_000);
        assert!(slow.total_percent < LOAD_LIMIT_PERCENT, "{slow:?}");
        assert!(
            matches!(slow.excess(), Some(Excess::Response { set: "observation", limit_us: 8_250.0, .. })),
            "{slow:?}"
        );
        assert_eq!(of(Profile::FdF32, 376, 17, 15_000, 1_000_000, 5_000_000).excess(), None);
    }
}
