//! Faults of the plant: the body is not the one that the policy was trained on.

use serde::{Deserialize, Serialize};

use super::spec::Check;

/// What happens to the body. Only plants that allow it; the others say so.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum PlantFault {
    /// All masses and inertias.
    Mass {
        /// Factor.
        factor: f64,
    },
    /// All contact friction.
    Friction {
        /// Factor.
        factor: f64,
    },
    /// Gravity.
    Gravity {
        /// Factor.
        factor: f64,
    },
    /// A force on the trunk, forward where positive.
    Push {
        /// Force, N.
        force: f64,
        /// How long it lasts, ticks.
        #[serde(default = "one_tick")]
        ticks: u32,
        /// Again after so many ticks; 0 = once.
        #[serde(default)]
        every: u32,
    },
}

fn one_tick() -> u32 {
    1
}

impl PlantFault {
    pub(super) fn check(&self, check: &mut Check) {
        match *self {
            Self::Mass { factor } => check.range("factor", factor, 0.01, 100.0),
            Self::Friction { factor } | Self::Gravity { factor } => check.range("factor", factor, 0.0, 100.0),
            Self::Push { force, ticks, every } => {
                check.range("force", force, -1e6, 1e6);
                check.count("ticks", ticks, 1, 1_000_000);
                check.count("every", every, 0, 1_000_000);
            }
        }
    }
}
