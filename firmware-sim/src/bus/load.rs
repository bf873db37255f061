//! Time that frames take on the wire, at worst, and the load that a policy puts on a bus.
//!
//! Bit counts are those of ISO 11898-1 with every possible stuff bit and the three bits of interframe space.

use gadm_node::codec::{Layout, Profile};
use gadm_node::frame::{Frame, Kind};
use serde::Serialize;

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
        nominal * 1_000_000_000 / u64::from(self.nominal) + data * 1_000_000_000 / u64::from(self.data)
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
    let bytes = payload as u64;
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
}

/// The load of a layout at a control period.
#[must_use]
pub fn load(layout: &Layout, period_us: u32, rate: BitRate) -> Load {
    let kind = match layout.profile() {
        Profile::FdF32 => Kind::Fd { brs: true },
        Profile::ClassicI16 => Kind::Classic,
    };
    let per_part = layout.profile().values();
    let set_ns = |dim: usize| -> u64 {
        let full = rate.frame_ns(kind, false, layout.payload_len(per_part)) * (dim / per_part) as u64;
        let rest = dim % per_part;
        full + if rest > 0 { rate.frame_ns(kind, false, layout.payload_len(rest)) } else { 0 }
    };
    let classic8 = rate.frame_ns(Kind::Classic, false, 8);
    let decision = usize::from(layout.profile() == Profile::ClassicI16);
    let sets_ns = set_ns(layout.obs_dim()) + set_ns(layout.action_dim());
    let period_ns = f64::from(period_us) * 1e3;
    let heartbeats_percent = (classic8 + rate.frame_ns(Kind::Classic, false, 1)) as f64 / 1e8 * 100.0;
    Load {
        observation_frames: layout.observation_parts(),
        action_frames: layout.action_parts() + decision,
        sets_percent: sets_ns as f64 / period_ns * 100.0,
        total_percent: (sets_ns + classic8 * (1 + decision as u64)) as f64 / period_ns * 100.0 + heartbeats_percent,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gadm_node::NodeId;
    use gadm_runtime::ActionHead;

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

    fn percent(profile: Profile, obs: usize, act: usize, period_us: u32, nominal: u32, data: u32) -> f64 {
        let heads = (0..act).map(|_| ActionHead::Continuous { lo: -1.0, hi: 1.0 });
        let layout = Layout::new(profile, NodeId::DEFAULT, 0, (0..obs).map(|_| (-1.0, 1.0)), heads).unwrap();
        load(&layout, period_us, BitRate { nominal, data }).sets_percent
    }

    #[test]
    fn load_table_of_known_tasks() {
        // Hopper, Walker2d, Ant v5, Humanoid v5: classic at 500k, FD f32 at 0.5/2 and 1/5.
        for (obs, act, period, classic, slow, fast) in [
            (11, 3, 8_000, 16.9, 7.4, 3.1),
            (17, 6, 8_000, 27.0, 10.5, 4.5),
            (105, 8, 50_000, 20.5, 7.0, 2.9),
            (348, 17, 15_000, 220.0, 71.8, 29.9),
        ] {
            let got = [
                percent(Profile::ClassicI16, obs, act, period, 500_000, 1),
                percent(Profile::FdF32, obs, act, period, 500_000, 2_000_000),
                percent(Profile::FdF32, obs, act, period, 1_000_000, 5_000_000),
            ];
            for (got, want) in got.into_iter().zip([classic, slow, fast]) {
                assert!((got - want).abs() <= 0.06_f64.max(want * 0.005), "{obs}/{act}: {got} instead of {want}");
            }
        }
    }
}
