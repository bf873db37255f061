//! Records of the C interface.

use core::ffi::c_char;
use core::mem::MaybeUninit;

use crate::Status;

/// Words of pointer size in a `gadm_policy`.
pub const POLICY_WORDS: usize = 192;
/// Most action slots that a policy has; an array of this length takes every action.
pub const MAX_ACTIONS: usize = 64;
/// Most observations that a policy has.
pub const MAX_OBSERVATIONS: usize = 512;
/// Words of the set of allowed latents.
pub const MASK_WORDS: usize = 8;

const _: () = {
    assert!(MAX_ACTIONS == gadm_runtime::schema::MAX_ACTIONS);
    assert!(MAX_OBSERVATIONS == gadm_runtime::schema::MAX_OBS);
    assert!(MASK_WORDS * 32 == gadm_runtime::schema::MAX_LATENTS);
};

/// A loaded policy, in memory of the caller. It points into the image, which must stay where it is and as it is. May be
/// copied. The content is no concern of the caller's.
#[repr(C)]
pub struct LoadedPolicy {
    /// Tells a loaded policy from other memory.
    pub check: u64,
    /// Where the policy's bytes are.
    pub image: *const u8,
    /// How many they are.
    pub image_len: usize,
    /// What the library knows of it.
    pub words: [MaybeUninit<usize>; POLICY_WORDS],
}

/// What a policy is and needs.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Spec {
    /// Hash of names, units, ranges and order of the signals and of the control period.
    pub interface_hash: u64,
    /// Bytes of the policy in the image.
    pub image_len: u32,
    /// Sequence number; of two policies on a device the higher one is newer.
    pub policy_seq: u32,
    /// Values of an observation.
    pub obs_dim: u32,
    /// Values of an action.
    pub action_dim: u32,
    /// Number of latents.
    pub num_latents: u32,
    /// Time between two steps in microseconds.
    pub control_period_us: u32,
    /// Scratch memory of a step in words of 32 bits.
    pub scratch_words: u32,
    /// Multiply-accumulate operations of a step.
    pub macs: u32,
}

/// What a step decided.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Decision {
    /// The latent that was chosen.
    pub latent: u16,
    /// No latent passed the threshold; the most confident one, or all, were allowed instead.
    pub fallback: bool,
    /// An observation lay outside of its range and was clamped to it.
    pub clipped: bool,
    /// Q-logit of the chosen latent.
    pub q: i32,
    /// The allowed latents: latent k is bit k % 32 of word k / 32.
    pub allowed: [u32; MASK_WORDS],
}

/// What was wrong, beside the status. The status' comment tells which fields mean something.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct ErrorDetail {
    /// The status that the call returned.
    pub status: Status,
    /// Part of the image: 0 header, 1 payload, 2 interface, 3 input quantiser, 4 Q-network, 5 confidence network, 6 decoder,
    /// 7 self-test, 8 provenance, 9 trailer; -1 none.
    pub section: i32,
    /// Where.
    pub index: u32,
    /// What was expected.
    pub expected: i64,
    /// What was found.
    pub found: i64,
}

/// Text in the image, UTF-8, without a zero at its end.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct TextSlice {
    /// First byte.
    pub data: *const c_char,
    /// Bytes.
    pub len: usize,
}

/// One observation.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct ObservationInfo {
    /// Name.
    pub name: TextSlice,
    /// Unit.
    pub unit: TextSlice,
    /// Lower bound, in the unit.
    pub lo: f32,
    /// Upper bound, in the unit.
    pub hi: f32,
    /// For `gadm_act_q`: value that becomes 0, in the unit.
    pub q_offset: f32,
    /// For `gadm_act_q`: steps per unit; the integer is the nearest to `(x - q_offset) * q_scale`, halves away from zero.
    pub q_scale: f32,
    /// For `gadm_act_q`: largest integer; the smallest is `-q_max - 1`.
    pub q_max: i16,
}

/// What an action slot holds.
#[repr(i32)]
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum ActionKind {
    /// A number from `lo` to `hi`.
    Continuous = 0,
    /// One of `types`, counted from 0.
    Discrete = 1,
    /// 0 or 1.
    Binary = 2,
    /// A kind that this library has no number for.
    Other = 3,
}

/// One action slot.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct ActionInfo {
    /// Name.
    pub name: TextSlice,
    /// Unit.
    pub unit: TextSlice,
    /// What it holds.
    pub kind: ActionKind,
    /// Number of types of a discrete slot, else 0.
    pub types: u32,
    /// Lower bound of a continuous slot, else 0.
    pub lo: f32,
    /// Upper bound of a continuous slot, else 0.
    pub hi: f32,
    /// Value for when there is no decision to act on.
    pub safe: f32,
}
