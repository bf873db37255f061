//! Seeds of episodes.

/// Seed of episode `episode` of a run with seed `seed`, as `gadm eval` derives it: one step of SplitMix64 (Steele, Lea
/// and Flood 2014) from `seed · 0x9E3779B97F4A7C15 xor episode`, in wrapping arithmetic.
#[must_use]
pub fn episode_seed(seed: u64, episode: u64) -> u64 {
    let mut z = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ episode;
    z = z.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::episode_seed;

    #[test]
    fn first_episode_of_seed_zero_is_the_first_number_of_splitmix64() {
        assert_eq!(episode_seed(0, 0), 0xE220_A839_7B1D_CDAF);
    }

    #[test]
    fn episodes_and_seeds_differ() {
        let mut all: Vec<u64> = (0..50).flat_map(|s| (0..50).map(move |e| episode_seed(s, e))).collect();
        all.sort_unstable();
        all.dedup();
        assert_eq!(all.len(), 2500);
    }
}
