//! Where a policy comes from.

use crate::fields::{f32_at, text_at, u16_at, u32_at, u64_at};

/// Bytes of the fixed part of the section.
pub(crate) const PROVENANCE_HEAD: usize = 56;

/// Returns measured over a number of episodes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ReturnStats {
    /// Mean return.
    pub mean: f32,
    /// Standard deviation over episodes.
    pub std: f32,
    /// Number of episodes; 0 means that nothing was measured.
    pub episodes: u32,
}

/// Where a policy comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Provenance<'a> {
    /// Environment id, such as `Hopper-v5`.
    pub environment: &'a str,
    /// Learner, such as `dqn`.
    pub algorithm: &'a str,
    /// Hash of the resolved configuration, in hexadecimal.
    pub config_hash: &'a str,
    /// Commit of the program that exported the file.
    pub commit: &'a str,
    /// Seed of the training run.
    pub train_seed: u64,
    /// Seed of the evaluation episodes.
    pub eval_seed: u64,
    /// Environment steps of the training run.
    pub env_steps: u64,
    /// Return of the float policy.
    pub float_return: ReturnStats,
    /// Return of the policy in this file, on the same seeds.
    pub device_return: ReturnStats,
}

impl<'a> Provenance<'a> {
    /// Decodes the section, which `load` has checked.
    pub(crate) fn decode(bytes: &'a [u8]) -> Self {
        let mut at = PROVENANCE_HEAD;
        let [environment, algorithm, config_hash, commit] = [48, 50, 52, 54].map(|field| {
            let len = usize::from(u16_at(bytes, field).unwrap_or_default());
            let text = text_at(bytes, at, len);
            at = at.wrapping_add(len);
            text
        });
        let stats = |at: usize| ReturnStats {
            mean: f32_at(bytes, at).unwrap_or_default(),
            std: f32_at(bytes, at.wrapping_add(4)).unwrap_or_default(),
            episodes: u32_at(bytes, at.wrapping_add(8)).unwrap_or_default(),
        };
        Self {
            environment,
            algorithm,
            config_hash,
            commit,
            train_seed: u64_at(bytes, 0).unwrap_or_default(),
            eval_seed: u64_at(bytes, 8).unwrap_or_default(),
            env_steps: u64_at(bytes, 16).unwrap_or_default(),
            float_return: stats(24),
            device_return: stats(36),
        }
    }
}
