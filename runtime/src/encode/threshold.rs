//! The mask threshold as an exact fraction.

use crate::schema::MAX_BETA_DEN;

/// `beta` as a fraction: 1/K when beta is the `f32` of it, else the fraction with the smallest denominator up to 4096
/// whose `f32` is beta, else the nearest fraction over 2^24.
pub(crate) fn threshold(beta: f32, latents: u16) -> (u32, u32) {
    let latents = u32::from(latents).max(2);
    if 1.0 / latents as f32 == beta {
        return (1, latents);
    }
    for den in 2..=4096u32 {
        let num = (f64::from(beta) * f64::from(den)).round() as u32;
        if num > 0 && num < den && (f64::from(num) / f64::from(den)) as f32 == beta {
            return (num, den);
        }
    }
    let num = (f64::from(beta) * f64::from(MAX_BETA_DEN)).round() as u32;
    (num.clamp(1, MAX_BETA_DEN - 1), MAX_BETA_DEN)
}

#[cfg(test)]
mod tests {
    use super::threshold;

    #[test]
    fn thresholds_of_the_paper_are_exact() {
        assert_eq!(threshold(1.0 / 49.0, 49), (1, 49));
        assert_eq!(threshold(1.0 / 64.0, 64), (1, 64));
        assert_eq!(threshold(1.5 / 64.0, 64), (3, 128));
        assert_eq!(threshold(0.1, 7), (1, 10));
        assert_eq!(threshold(0.375, 4), (3, 8));
    }

    #[test]
    fn any_other_threshold_is_within_half_of_two_to_the_minus_24() {
        let beta = 0.123_456_78f32;
        let (num, den) = threshold(beta, 16);
        assert!((f64::from(num) / f64::from(den) - f64::from(beta)).abs() <= 0.5 / f64::from(1 << 24));
        assert_eq!(threshold(1e-12, 16), (1, 1 << 24));
    }
}
