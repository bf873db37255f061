//! The random draws of a reset.
//!
//! The generator is named here, because episodes must be the same on every machine: `ChaCha8` from a 64-bit seed.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
#[cfg(feature = "mujoco")]
use rand_distr::StandardNormal;

/// The source of one episode's randomness.
#[derive(Clone)]
pub(crate) struct EpisodeRng {
    #[cfg(feature = "box2d")]
    seed: u64,
    rng: ChaCha8Rng,
    /// Draws to play back instead, from a recording.
    recorded: Option<std::vec::IntoIter<f64>>,
}

impl EpisodeRng {
    pub(crate) fn from_seed(seed: u64) -> Self {
        Self {
            #[cfg(feature = "box2d")]
            seed,
            rng: ChaCha8Rng::seed_from_u64(seed),
            recorded: None,
        }
    }

    /// Plays recorded uniform draws back, whatever range is asked for.
    pub(crate) fn from_recording(draws: Vec<f64>) -> Self {
        Self { recorded: Some(draws.into_iter()), ..Self::from_seed(0) }
    }

    /// The seed it was made from; 0 for a recording.
    #[cfg(feature = "box2d")]
    pub(crate) fn seed(&self) -> u64 {
        self.seed
    }

    /// Uniform in `lo..hi`, with 53 random bits.
    pub(crate) fn uniform(&mut self, lo: f64, hi: f64) -> f64 {
        match &mut self.recorded {
            Some(draws) => draws.next().expect("a recording holds every draw: checked when it was read"),
            None => lo + (hi - lo) * self.rng.random::<f64>(),
        }
    }

    /// Standard normal.
    #[cfg(feature = "mujoco")]
    pub(crate) fn normal(&mut self) -> f64 {
        self.rng.sample(StandardNormal)
    }

    /// One of `0..n`.
    pub(crate) fn index(&mut self, n: usize) -> usize {
        ((self.rng.random::<f64>() * n as f64) as usize).min(n - 1)
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

    #[test]
    fn recorded_draws_come_back_in_their_order() {
        let mut rng = EpisodeRng::from_recording(vec![0.25, -7.0]);
        assert_eq!((rng.uniform(-1.0, 1.0), rng.uniform(0.0, 1.0)), (0.25, -7.0));
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
