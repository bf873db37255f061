//! Faults of the node itself.

use serde::{Deserialize, Serialize};

use super::spec::{Check, one};

/// What happens to the node. A power cut while a policy is written is no fault of a run: the tests of the slots cut
/// after every byte.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum NodeFault {
    /// The power fails at the start of the window; then the node boots.
    Reset {
        /// Ticks without power.
        #[serde(default = "one_tick")]
        ticks: u32,
        /// Again after so many ticks; 0 = once.
        #[serde(default)]
        every: u32,
    },
    /// The program stands still from the start of the window on; frames wait.
    Hang {
        /// Duration, ticks.
        ticks: u32,
    },
    /// The node runs on its own timer, which is off.
    ClockDrift {
        /// Deviation, parts per million; positive is fast.
        ppm: f64,
    },
    /// A decision takes longer than a period: the answer comes late, and meanwhile the node does nothing else.
    SlowInference {
        /// By how many ticks the answer is late.
        ticks: u32,
        /// Probability per decision.
        #[serde(default = "one")]
        p: f64,
    },
}

fn one_tick() -> u32 {
    1
}

impl NodeFault {
    pub(super) fn check(&self, check: &mut Check) {
        match *self {
            Self::Reset { ticks, every } => {
                check.count("ticks", ticks, 1, 1_000_000);
                check.count("every", every, 0, 1_000_000);
            }
            Self::Hang { ticks } => check.count("ticks", ticks, 1, 1_000_000),
            Self::ClockDrift { ppm } => check.range("ppm", ppm, -900_000.0, 10_000_000.0),
            Self::SlowInference { ticks, p } => {
                check.count("ticks", ticks, 1, 1000);
                check.probability("p", p);
            }
        }
    }
}
