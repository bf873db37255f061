//! The policy: a validated view of the image, and one control step.

use crate::error::{ActError, LoadError, SelfTestError};
use crate::interface::{ActionSignal, ObservationSignal};
use crate::mask::LatentMask;
use crate::provenance::Provenance;
use crate::schema::{Header, PolicySpec};
use crate::scratch::Scratch;

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
    /// Q-logit of the chosen latent, in the units of the network's last layer.
    pub q: i32,
}

/// A validated policy. Weights stay where they are, in the image.
#[derive(Clone, Copy, Debug)]
pub struct Policy<'a> {
    image: &'a [u8],
    header: Header,
    spec: PolicySpec,
}

impl<'a> Policy<'a> {
    /// Validates an image.
    ///
    /// # Errors
    /// [`LoadError`] says what is wrong.
    pub fn load(image: &'a [u8]) -> Result<Self, LoadError> {
        Err(LoadError::Truncated { expected: 64, found: image.len() })
    }

    /// Dimensions and needs.
    #[must_use]
    pub fn spec(&self) -> &PolicySpec {
        &self.spec
    }

    /// The header of the file.
    #[must_use]
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// Hash of the interface record.
    #[must_use]
    pub fn interface_hash(&self) -> u64 {
        self.header.interface_hash
    }

    /// Observation signals, in order.
    pub fn observation_signals(&self) -> impl Iterator<Item = ObservationSignal<'a>> + use<'a> {
        core::iter::empty()
    }

    /// Action slots, in order.
    pub fn action_signals(&self) -> impl Iterator<Item = ActionSignal<'a>> + use<'a> {
        core::iter::empty()
    }

    /// Where the policy comes from.
    #[must_use]
    pub fn provenance(&self) -> Provenance<'a> {
        Provenance::default()
    }

    /// One control step: observation in the units of the interface, action in the units of the interface.
    ///
    /// # Errors
    /// A non-finite or wrong-length observation, or a buffer that is too short.
    pub fn act(&self, obs: &[f32], scratch: &mut Scratch, action: &mut [f32]) -> Result<Decision, ActError> {
        let _ = (self.image, scratch, action);
        Err(ActError::ObservationLength { expected: 0, found: obs.len() })
    }

    /// As [`act`](Self::act), with an observation that is already quantised.
    ///
    /// # Errors
    /// A wrong-length observation, or a buffer that is too short.
    pub fn act_q(&self, obs: &[i16], scratch: &mut Scratch, action: &mut [f32]) -> Result<Decision, ActError> {
        let _ = (self.image, scratch, action);
        Err(ActError::ObservationLength { expected: 0, found: obs.len() })
    }

    /// Runs the vectors of the file; a policy that fails must not be run.
    ///
    /// # Errors
    /// The first vector that differs.
    pub fn self_test(&self, scratch: &mut Scratch) -> Result<(), SelfTestError> {
        Err(SelfTestError::Act(ActError::ScratchLength { expected: 0, found: scratch.words() }))
    }
}
