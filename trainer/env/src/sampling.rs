//! The random draws of a reset.
//!
//! The generator is named here, because episodes must be the same on every machine: `ChaCha8` from a 64-bit seed.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
#[cfg(feature = "mujoco")]
use rand_distr::StandardNormal;

/// The source of one episode's randomness.
pub(crate) struct EpisodeRng(ChaCha8Rng);

impl EpisodeRng {
    pub(crate) fn from_seed(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    /// Uniform in `lo..hi`, with 53 random bits.
    pub(crate) fn uniform(&mut self, lo: f64, hi: f64) -> f64 {
        lo + (hi - lo) * self.0.random::<f64>()
    }

    /// Standard normal.
    #[cfg(feature = "mujoco")]
    pub(crate) fn normal(&mut self) -> f64 {
        self.0.sample(StandardNormal)
    }

    /// One of `0..n`.
    pub(crate) fn index(&mut self, n: usize) -> usize {
        ((self.0.random::<f64>() * n as f64) as usize).min(n - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::EpisodeRng;

    #[test]
    fn draws_stay_in_their_ranges_and_follow_the_seed() {
        let (mut a, mut b, mut c) = (EpisodeRng::from_seed(1), EpisodeRng::from_seed(1), EpisodeRng::from_seed(2));
        let mut differs = false;
        for _ in 0..1000 {
            let u = a.uniform(-0.9, 0.9);
            assert!((-0.9..0.9).contains(&u));
            assert_eq!(u, b.uniform(-0.9, 0.9));
            differs |= u != c.uniform(-0.9, 0.9);
            assert!(a.index(4) < 4);
            b.index(4);
            c.index(4);
        }
        assert!(differs);
    }

    #[cfg(feature = "mujoco")]
    #[test]
    fn normal_draws_have_mean_zero_and_variance_one() {
        let mut rng = EpisodeRng::from_seed(1);
        let draws: Vec<f64> = (0..10_000).map(|_| rng.normal()).collect();
        let mean = draws.iter().sum::<f64>() / 1e4;
        let variance = draws.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / 1e4;
        assert!(mean.abs() < 0.05 && (variance - 1.0).abs() < 0.05, "{mean} {variance}");
    }
}
