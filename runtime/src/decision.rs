//! What a step decided.

use crate::mask::LatentMask;

/// What a step decided.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Decision {
    /// The latent that was chosen.
    pub latent: u16,
    /// The latents that the confidence network allowed; all of them without such a network.
    pub allowed: LatentMask,
    /// No latent passed the threshold, so the set was made by the empty-mask rule.
    pub fallback: bool,
    /// At least one observation lay outside of the range of the input quantiser and was clamped to it.
    pub clipped: bool,
    /// Q-logit of the chosen latent, in the units of the network's last layer; see [`Policy::q_scale`](crate::Policy::q_scale).
    pub q: i32,
}

/// What a float step decided.
#[cfg(any(feature = "encode", feature = "float"))]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FloatDecision {
    /// The latent that was chosen.
    pub latent: u16,
    /// The latents that the confidence network allowed.
    pub allowed: LatentMask,
    /// The set was made by the empty-mask rule.
    pub fallback: bool,
    /// Q-value of the chosen latent.
    pub q: f32,
}
