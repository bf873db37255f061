//! `2^-x` in fixed point, for the mask and the heads.

use crate::quant::smmlar;

/// 1.0 in the format of [`exp2_neg`], Q30.
pub const ONE: u32 = 1 << 30;

/// Minimax coefficients of `2^-f` on 0..=1 (relative error 9.4e-8), exact at both ends; coefficient `i` is stored times
/// `2^(30 + i)`, because every Horner step multiplies by half of `f`.
pub(super) const C: [i32; 6] = [1 << 30, -1_488_514_207, 1_031_553_340, -474_919_629, 157_948_181, -32_286_449];

/// `2^-(x / 2^frac_bits)` as Q30, for `frac_bits` up to 24. Non-increasing in `x`; 0 from `x = 31` on.
#[inline]
#[must_use]
pub fn exp2_neg(x: u32, frac_bits: u32) -> u32 {
    // The polynomial is at most 2^30, so a shift by 31 gives the 0 of everything smaller.
    let whole = x.wrapping_shr(frac_bits).min(31);
    // The fraction as Q31: the integer bits fall off at the top.
    let f = (x.wrapping_shl(31u32.wrapping_sub(frac_bits)) & 0x7FFF_FFFF).cast_signed();
    let [c0, c1, c2, c3, c4, c5] = C;
    let r = smmlar(c5, f, c4);
    let r = smmlar(r, f, c3);
    let r = smmlar(r, f, c2);
    let r = smmlar(r, f, c1);
    let r = smmlar(r, f, c0);
    r.cast_unsigned().wrapping_shr(whole)
}

#[cfg(test)]
#[expect(clippy::float_arithmetic, reason = "the oracle is exp2 in f64")]
mod tests {
    use super::{ONE, exp2_neg};
    use proptest::prelude::*;

    #[test]
    fn powers_of_two_are_exact() {
        assert_eq!(exp2_neg(0, 16), ONE);
        assert_eq!(exp2_neg(1 << 16, 16), ONE / 2);
        assert_eq!(exp2_neg(30 << 16, 16), 1);
        assert_eq!(exp2_neg(31 << 16, 16), 0);
        assert_eq!(exp2_neg(u32::MAX, 0), 0);
        assert_eq!(exp2_neg(3, 0), ONE / 8);
    }

    proptest! {
        #[test]
        fn relative_error_is_below_one_in_ten_million(x in 0u32..4 << 20) {
            let exact = (-f64::from(x) / f64::from(1 << 20)).exp2() * f64::from(ONE);
            prop_assert!((f64::from(exp2_neg(x, 20)) - exact).abs() <= exact * 1e-7 + 1.0);
        }

        #[test]
        fn it_never_rises(x in 0u32..1 << 27, frac_bits in 0u32..=24) {
            prop_assert!(exp2_neg(x, frac_bits) >= exp2_neg(x + 1, frac_bits));
        }
    }
}
