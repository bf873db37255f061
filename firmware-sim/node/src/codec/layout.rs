//! How the observations and actions of one policy lie in frames.

use gadm_runtime::Policy;
use gadm_runtime::space::ActionHead;
use heapless::Vec;

use super::Profile;
use super::scale::Scale;
use crate::frame::fd_length;
use crate::protocol::{FD_VALUES, MAX_ACTIONS, MAX_OBSERVATIONS, NodeId};

/// Why there is no layout for a policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum LayoutError {
    /// More observation values than the identifiers of OBS hold.
    Observations {
        /// Values of the policy.
        found: usize,
        /// Most values.
        limit: usize,
    },
    /// More action values than the identifiers of ACT hold.
    Actions {
        /// Values of the policy.
        found: usize,
        /// Most values.
        limit: usize,
    },
    /// `classic-i16` needs a finite range `lo < hi`.
    ObservationRange {
        /// Position of the signal.
        index: usize,
    },
    /// `classic-i16` needs a finite range `lo < hi`.
    ActionRange {
        /// Position of the signal.
        index: usize,
    },
}

impl core::fmt::Display for LayoutError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Observations { found, limit } => {
                write!(f, "{found} observation values, the bus has room for {limit}")
            }
            Self::Actions { found, limit } => write!(f, "{found} action values, the bus has room for {limit}"),
            Self::ObservationRange { index } => {
                write!(f, "observation signal {index} has no finite range lo < hi, which classic-i16 needs; use fd-f32")
            }
            Self::ActionRange { index } => {
                write!(f, "action signal {index} has no finite range lo < hi, which classic-i16 needs; use fd-f32")
            }
        }
    }
}

impl core::error::Error for LayoutError {}

/// How the observations and actions of one policy lie in frames.
#[derive(Clone, Debug)]
pub struct Layout {
    pub(super) profile: Profile,
    pub(super) node: NodeId,
    pub(super) hash: [u8; 4],
    pub(super) observations: Vec<Scale, MAX_OBSERVATIONS>,
    pub(super) actions: Vec<Scale, MAX_ACTIONS>,
}

impl Layout {
    /// A layout for the ranges `(lo, hi)` of the observation signals and the heads of the action signals.
    ///
    /// # Errors
    /// Where the protocol has no room, or where `classic-i16` has no range to scale by.
    pub fn new(
        profile: Profile,
        node: NodeId,
        interface_hash: u64,
        observations: impl Iterator<Item = (f32, f32)>,
        heads: impl Iterator<Item = ActionHead>,
    ) -> Result<Self, LayoutError> {
        let [a, b, c, d, ..] = interface_hash.to_le_bytes();
        let mut layout = Self { profile, node, hash: [a, b, c, d], observations: Vec::new(), actions: Vec::new() };
        let classic = profile == Profile::ClassicI16;
        let mut found = 0;
        for (index, (lo, hi)) in observations.enumerate() {
            let scale = match Scale::range(lo, hi) {
                Some(scale) => scale,
                None if classic => return Err(LayoutError::ObservationRange { index }),
                None => Scale::Integer, // fd-f32 does not scale
            };
            found += 1;
            let _full = layout.observations.push(scale);
        }
        if found > MAX_OBSERVATIONS {
            return Err(LayoutError::Observations { found, limit: MAX_OBSERVATIONS });
        }
        let mut found = 0;
        for (index, head) in heads.enumerate() {
            let scale = match head {
                ActionHead::Continuous { lo, hi } => match Scale::range(lo, hi) {
                    Some(scale) => scale,
                    None if classic => return Err(LayoutError::ActionRange { index }),
                    None => Scale::Integer,
                },
                ActionHead::Discrete { .. } | ActionHead::Binary => Scale::Integer,
            };
            found += 1;
            let _full = layout.actions.push(scale);
        }
        if found > MAX_ACTIONS {
            return Err(LayoutError::Actions { found, limit: MAX_ACTIONS });
        }
        Ok(layout)
    }

    /// The layout of a policy.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn of_policy(policy: &Policy, profile: Profile, node: NodeId) -> Result<Self, LayoutError> {
        let ranges = policy.observation_signals().map(|s| (s.lo, s.hi));
        let heads = policy.action_signals().map(|s| s.head);
        Self::new(profile, node, policy.interface_hash(), ranges, heads)
    }

    /// The profile.
    #[must_use]
    pub fn profile(&self) -> Profile {
        self.profile
    }

    /// The node that the action identifiers belong to.
    #[must_use]
    pub fn node(&self) -> NodeId {
        self.node
    }

    /// Values of an observation.
    #[must_use]
    pub fn obs_dim(&self) -> usize {
        self.observations.len()
    }

    /// Values of an action.
    #[must_use]
    pub fn action_dim(&self) -> usize {
        self.actions.len()
    }

    /// Frames of an observation set.
    #[must_use]
    pub fn observation_parts(&self) -> usize {
        self.obs_dim().div_ceil(self.profile.values()).max(1)
    }

    /// Frames of an action set, DECISION not counted.
    #[must_use]
    pub fn action_parts(&self) -> usize {
        self.action_dim().div_ceil(self.profile.values()).max(1)
    }

    /// Payload bytes of a frame that holds `values` values.
    #[must_use]
    pub fn payload_len(&self, values: usize) -> usize {
        match self.profile {
            Profile::ClassicI16 => 8,
            Profile::FdF32 => fd_length(8 + 4 * values.min(FD_VALUES)).unwrap_or(64),
        }
    }
}
