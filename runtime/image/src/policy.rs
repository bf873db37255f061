//! A policy that the runtime accepts; nothing else is packed.

use gadm_runtime::encode::AlignedImage;
use gadm_runtime::{FloatPolicy, Header, LoadError, Policy, PolicySpec, Provenance, Scratch, WeightKind};

use crate::ImageError;

/// What people want to see of a policy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Summary {
    /// Environment it was made for.
    pub environment: String,
    /// Length of the file in bytes.
    pub total_len: u32,
    /// CRC-32/ISO-HDLC of the payload.
    pub payload_crc32: u32,
    /// Hash of the interface.
    pub interface_hash: u64,
    /// Sequence number.
    pub policy_seq: u32,
    /// How the weights are stored.
    pub weights: WeightKind,
    /// Observations.
    pub obs_dim: u16,
    /// Action slots.
    pub action_dim: u16,
    /// Control period in microseconds.
    pub control_period_us: u32,
    /// Scratch memory in words of 32 bits.
    pub scratch_words: usize,
}

/// The bytes of a policy that loads and passes its self-test, without what may follow them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PolicyImage {
    bytes: Vec<u8>,
    summary: Summary,
}

impl PolicyImage {
    /// Loads the policy at the start of `bytes` with the runtime and runs its self-test. What follows it, such as the
    /// rest of a flash slot, is dropped.
    ///
    /// # Errors
    /// [`ImageError::Load`] and [`ImageError::SelfTest`] with the reason of the runtime.
    pub fn check(bytes: &[u8]) -> Result<Self, ImageError> {
        let image = AlignedImage::new(bytes);
        let summary = match Policy::load(&image) {
            Ok(policy) => {
                let mut memory = vec![0; policy.spec().scratch_words];
                policy.self_test(&mut Scratch::new(&mut memory)).map_err(ImageError::SelfTest)?;
                summarise(&policy.header(), policy.spec(), &policy.provenance())
            }
            Err(LoadError::WeightKind { .. }) => {
                let policy = FloatPolicy::load(&image).map_err(ImageError::Load)?;
                let mut memory = vec![0; policy.spec().scratch_words];
                policy.self_test(&mut Scratch::new(&mut memory)).map_err(ImageError::SelfTest)?;
                summarise(&policy.header(), policy.spec(), &policy.provenance())
            }
            Err(error) => return Err(ImageError::Load(error)),
        };
        Ok(Self { bytes: bytes[..summary.total_len as usize].to_vec(), summary })
    }

    /// The file's bytes.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// What people want to see of it.
    #[must_use]
    pub fn summary(&self) -> &Summary {
        &self.summary
    }
}

fn summarise(header: &Header, spec: &PolicySpec, provenance: &Provenance<'_>) -> Summary {
    Summary {
        environment: provenance.environment.to_owned(),
        total_len: header.total_len,
        payload_crc32: header.payload_crc32,
        interface_hash: header.interface_hash,
        policy_seq: header.policy_seq,
        weights: header.weights,
        obs_dim: spec.obs_dim,
        action_dim: spec.action_dim,
        control_period_us: spec.control_period_us,
        scratch_words: spec.scratch_words,
    }
}
