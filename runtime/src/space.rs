//! Action heads: what one slot of an action vector may hold. Shared by the runtime, the environments and the trainer.

use serde::{Deserialize, Serialize};

/// One slot of an action vector.
///
/// An action is a slice with one `f32` per head, in the order of the heads.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum ActionHead {
    /// A real number in `lo..=hi`, in the unit of the signal.
    Continuous {
        /// Lower bound.
        lo: f32,
        /// Upper bound.
        hi: f32,
    },
    /// One of `n` types, written as `0.0, 1.0, …, n - 1`.
    Discrete {
        /// Number of types.
        n: u16,
    },
    /// A switch, written as `0.0` or `1.0`.
    Binary,
}

impl ActionHead {
    /// Maps a normalised value in -1..=1 to the range of a continuous head: `lo + (hi - lo) (a + 1) / 2`, clamped.
    /// The other heads pass `a` through.
    ///
    /// Every part of the system uses this one function, so trainer, runtime and simulation agree to the bit.
    #[must_use]
    pub fn denormalise(self, a: f32) -> f32 {
        match self {
            Self::Continuous { lo, hi } => bounded(lo + (hi - lo) * ((a + 1.0) * 0.5), lo, hi),
            Self::Discrete { .. } | Self::Binary => a,
        }
    }

    /// The inverse of [`denormalise`](Self::denormalise), clamped to -1..=1.
    #[must_use]
    pub fn normalise(self, a: f32) -> f32 {
        match self {
            Self::Continuous { lo, hi } => bounded((a - lo) / (hi - lo) * 2.0 - 1.0, -1.0, 1.0),
            Self::Discrete { .. } | Self::Binary => a,
        }
    }
}

/// `clamp` without its panic on unordered bounds; `lo` of no number.
fn bounded(x: f32, lo: f32, hi: f32) -> f32 {
    if x > hi {
        hi
    } else if x >= lo {
        x
    } else {
        lo
    }
}

#[cfg(test)]
mod tests {
    use super::ActionHead;

    #[test]
    fn denormalise_hits_both_bounds_and_the_middle() {
        let head = ActionHead::Continuous { lo: -3.0, hi: 5.0 };
        assert_eq!(head.denormalise(-1.0), -3.0);
        assert_eq!(head.denormalise(1.0), 5.0);
        assert_eq!(head.denormalise(0.0), 1.0);
        assert_eq!(head.denormalise(7.0), 5.0);
        assert_eq!(head.normalise(5.0), 1.0);
    }
}
