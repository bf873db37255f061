//! The rounding rules: observation to 12 bits, accumulator to activation or logit.

/// Widest quantised observation, in bits, sign included.
pub const INPUT_BITS: u16 = 12;
/// Fraction bits that a hidden layer's `SMMLAR` result carries below one unit of its output.
pub const HIDDEN_SHIFT: u32 = 4;

/// `(a * m + (p << 32) + 2^31) >> 32`, the Armv7E-M instruction `SMMLAR`: the rounded high word of a product, added to
/// `p`. Wraps like the instruction; `load` proves that it never does.
#[inline(always)]
#[must_use]
pub const fn smmlar(a: i32, m: i32, p: i32) -> i32 {
    let product = (a as i64).wrapping_mul(m as i64);
    let sum = product.wrapping_add((p as i64) << 32).wrapping_add(1 << 31);
    (sum >> 32) as i32
}

/// `USAT #bits`: clamps to `0..2^bits`.
#[inline(always)]
#[must_use]
pub fn usat(bits: u32, value: i32) -> i32 {
    let max = 1i32.wrapping_shl(bits).wrapping_sub(1);
    value.max(0).min(max)
}

/// Accumulator to activation: `usat(bits, smmlar(acc, m, p) >> HIDDEN_SHIFT)`, the ReLU included.
#[inline(always)]
#[must_use]
pub fn requantise(bits: u32, acc: i32, m: i32, p: i32) -> i32 {
    usat(bits, smmlar(acc, m, p) >> HIDDEN_SHIFT)
}

/// Largest quantised observation of `bits` bits; the smallest is one below its negative.
#[inline(always)]
#[must_use]
pub const fn input_max(bits: u16) -> i16 {
    1i16.wrapping_shl(bits.wrapping_sub(1) as u32).wrapping_sub(1)
}

/// Quantises one finite observation: `round_half_even((x - offset) * scale)` clamped to `-max - 1..=max`, and whether it
/// was clamped. `max` is at most 2047.
///
/// `offset` is finite and `scale` positive and normal, as `load` checks, so no NaN can arise: the difference may
/// overflow to an infinity, which the clamp takes.
#[inline(always)]
#[must_use]
pub fn quantise_input(x: f32, offset: f32, scale: f32, max: i16) -> (i16, bool) {
    // Adding 1.5 * 2^23 leaves the rounded integer in the low mantissa bits: round-half-even without a library call.
    const MAGIC: f32 = 12_582_912.0;
    let (low, high) = (-f32::from(max) - 1.0, f32::from(max));
    let wanted = (x - offset) * scale;
    // Without early ends, so that the time does not depend on the value.
    let value = if wanted < low { low } else { wanted };
    let value = if value > high { high } else { value };
    // Near the ends the difference is exact.
    let clamped = (wanted - value).abs() > 0.5;
    let inside = (value + MAGIC).to_bits().wrapping_sub(MAGIC.to_bits()).cast_signed();
    #[expect(clippy::cast_possible_truncation, reason = "clamped to the range of an i16 above")]
    let quantised = inside as i16;
    (quantised, clamped)
}

#[cfg(test)]
mod tests {
    use super::{input_max, quantise_input, requantise, smmlar, usat};
    use proptest::prelude::*;

    #[test]
    fn smmlar_rounds_the_high_word() {
        assert_eq!(smmlar(1, 1 << 30, 0), 0);
        assert_eq!(smmlar(2, 1 << 30, 0), 1); // exactly one half rounds up
        assert_eq!(smmlar(-2, 1 << 30, 0), 0); // minus one half rounds up too
        assert_eq!(smmlar(1 << 20, 1 << 20, 7), 256 + 7);
        assert_eq!(smmlar(i32::MIN, i32::MIN, 0), 1 << 30);
    }

    #[test]
    fn usat_clamps_both_ends() {
        assert_eq!(usat(8, -1), 0);
        assert_eq!(usat(8, 255), 255);
        assert_eq!(usat(8, 256), 255);
        assert_eq!(usat(10, 5000), 1023);
    }

    #[test]
    fn inputs_round_to_even_and_clip() {
        assert_eq!(quantise_input(1.5, 0.0, 1.0, 2047), (2, false));
        assert_eq!(quantise_input(2.5, 0.0, 1.0, 2047), (2, false));
        assert_eq!(quantise_input(-0.5, 0.0, 1.0, 2047), (0, false));
        assert_eq!(quantise_input(3.0, 1.0, 10.0, 2047), (20, false));
        assert_eq!(quantise_input(2047.4, 0.0, 1.0, 2047), (2047, false));
        assert_eq!(quantise_input(2048.0, 0.0, 1.0, 2047), (2047, true));
        assert_eq!(quantise_input(-2048.4, 0.0, 1.0, 2047), (-2048, false));
        assert_eq!(quantise_input(-3000.0, 0.0, 1.0, 2047), (-2048, true));
        assert_eq!(input_max(12), 2047);
        assert_eq!(quantise_input(300.0, 0.0, 1.0, input_max(8)), (127, true));
        assert_eq!(quantise_input(-300.0, 0.0, 1.0, input_max(8)), (-128, true));
        assert_eq!(quantise_input(f32::MAX, f32::MIN, 1e30, 2047), (2047, true));
        assert_eq!(quantise_input(f32::MIN, f32::MAX, f32::MIN_POSITIVE, 2047), (-2048, true));
    }

    proptest! {
        #[test]
        fn requantise_is_monotone(a in -(1i32 << 30)..1 << 30, d in 0..1i32 << 20, m in 0i32.., p in -(1i32 << 20)..1 << 20) {
            prop_assert!(requantise(10, a, m, p) <= requantise(10, a + d, m, p));
        }

        /// Half a step of the output plus what the fraction bits lose.
        #[test]
        fn requantise_is_within_half_a_step_of_f64(acc in -(1i32 << 30)..1 << 30, m in any::<i32>(), p in -(1i32 << 20)..1 << 20) {
            let half = 1 << (super::HIDDEN_SHIFT - 1);
            let exact = (f64::from(acc) * f64::from(m) / 4_294_967_296.0 + f64::from(p)) / 16.0;
            let found = f64::from(requantise(10, acc, m, p + half));
            prop_assert!((found - exact.clamp(0.0, 1023.0)).abs() <= 0.5 + 1.0 / 32.0);
        }

        #[test]
        fn smmlar_is_the_64_bit_formula(a in any::<i32>(), m in any::<i32>(), p in -(1i32 << 29)..1 << 29) {
            let exact = (i128::from(a) * i128::from(m) + (i128::from(p) << 32) + (1i128 << 31)) >> 32;
            prop_assume!(i32::try_from(exact).is_ok());
            prop_assert_eq!(i128::from(smmlar(a, m, p)), exact);
        }

        #[test]
        fn inputs_are_within_half_a_step(x in -1e3f32..1e3, offset in -10f32..10.0, scale in 0.01f32..2.0) {
            let (q, clipped) = quantise_input(x, offset, scale, 2047);
            let exact = f64::from((x - offset) * scale);
            prop_assert!(clipped || (f64::from(q) - exact).abs() <= 0.5 + 1e-9 || !(-2048.0..=2047.0).contains(&exact));
        }
    }
}
