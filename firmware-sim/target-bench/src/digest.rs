//! One number for a sequence of decisions and actions, so that host and target can be compared.

use gadm_runtime::Decision;

/// FNV-1a over all that a step tells.
pub struct Digest(u64);

impl Default for Digest {
    fn default() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }
}

impl Digest {
    fn word(&mut self, word: u32) {
        for byte in word.to_le_bytes() {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3);
        }
    }

    /// Adds one step: latent, set of allowed latents, flags, logit, and every bit of the action.
    pub fn step(&mut self, decision: &Decision, action: &[f32]) {
        self.word(u32::from(decision.latent));
        for latent in decision.allowed.iter() {
            self.word(u32::from(latent));
        }
        self.word(u32::from(decision.fallback) | u32::from(decision.clipped) << 1);
        self.word(decision.q.cast_unsigned());
        for value in action {
            self.word(value.to_bits());
        }
    }

    /// The digest of what was added.
    pub fn value(&self) -> u64 {
        self.0
    }
}
