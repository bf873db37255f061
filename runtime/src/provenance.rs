//! Where a policy comes from.

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
