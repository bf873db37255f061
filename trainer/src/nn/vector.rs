//! Element-wise passes and the exponential, in plain loops that the compiler turns into the machine's vector instructions.

use pulp::{Simd, WithSimd};

use super::kernel::dispatch;

struct Call<F>(F);

impl<R, F: FnOnce() -> R> WithSimd for Call<F> {
    type Output = R;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) -> R {
        (self.0)()
    }
}

/// See `vectorised!`.
#[inline(always)]
pub fn run_vectorised<R>(work: impl FnOnce() -> R) -> R {
    dispatch(Call(work))
}

/// Computes an expression with the instructions of the best vector unit. The loops in it are compiled for that, and those in
/// functions it calls where these are `#[inline(always)]`. A macro, for the closure must be too: left to itself, the compiler
/// keeps a long one apart, made for the least machine. Products and sums are not fused, so results are the same on every machine.
macro_rules! vectorised {
    ($work:expr) => {
        $crate::nn::vector::run_vectorised(
            #[inline(always)]
            || $work,
        )
    };
}
pub(crate) use vectorised;

/// `e^x` with a relative error below 3e-7; 0 below -87, infinite above 88.7, NaN of NaN.
/// Source: Cephes `expf` (Moshier): reduction by ln 2 in two parts, polynomial of degree 5.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    const ROUND: f32 = 12_582_912.0; // 1.5 · 2^23: adding it leaves the nearest integer in the low bits
    let clamped = x.clamp(-87.3, 88.7);
    let shifted = clamped * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = clamped - n * 0.693_359_4 - n * -2.121_944_4e-4;
    let p = 1.987_569_2e-4_f32;
    let p = p * r + 1.398_199_9e-3;
    let p = p * r + 8.333_452e-3;
    let p = p * r + 4.166_579_6e-2;
    let p = p * r + 1.666_666_5e-1;
    let p = p * r + 0.5;
    let y = p * r * r + r + 1.0;
    // In two steps, for 2^128 is no f32.
    let power = |n: i32| f32::from_bits((n.wrapping_add(127) as u32) << 23);
    let n = shifted.to_bits().wrapping_sub(ROUND.to_bits()) as i32;
    let y = y * power(n >> 1) * power(n.wrapping_sub(n >> 1));
    if x < -87.3 {
        0.0
    } else if x > 88.7 {
        f32::INFINITY
    } else {
        y
    }
}

/// `to += scale · from`.
#[inline(always)]
pub fn add_scaled(to: &mut [f32], from: &[f32], scale: f32) {
    to.iter_mut().zip(from).for_each(|(t, f)| *t += scale * f);
}

/// Inner product in 32 running sums.
#[inline(always)]
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0_f32; 32];
    let (ca, cb) = (a.chunks_exact(32), b.chunks_exact(32));
    let rest: f32 = ca.remainder().iter().zip(cb.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in ca.zip(cb) {
        for ((l, x), y) in lanes.iter_mut().zip(x).zip(y) {
            *l += x * y;
        }
    }
    sum(&lanes) + rest
}

/// Sum of 32 numbers, pairwise.
#[inline(always)]
fn sum(lanes: &[f32; 32]) -> f32 {
    let mut s = [0.0; 8];
    for (i, s) in s.iter_mut().enumerate() {
        *s = (lanes[i] + lanes[i + 8]) + (lanes[i + 16] + lanes[i + 24]);
    }
    ((s[0] + s[4]) + (s[2] + s[6])) + ((s[1] + s[5]) + (s[3] + s[7]))
}

/// Largest of `values`, in eight running maxima; minus infinity of none. NaN is passed over.
#[inline(always)]
pub fn max(values: &[f32]) -> f32 {
    let larger = |a: f32, b: f32| if b > a { b } else { a };
    let (chunks, rest) = values.as_chunks::<8>();
    let rest = rest.iter().fold(f32::NEG_INFINITY, |m, &v| larger(m, v));
    let mut lanes = [f32::NEG_INFINITY; 8];
    for chunk in chunks {
        lanes.iter_mut().zip(chunk).for_each(|(l, &v)| *l = larger(*l, v));
    }
    lanes.iter().fold(rest, |m, &v| larger(m, v))
}

/// Replaces every value by `e^(value - top)`; returns the sum, taken in eight running sums.
#[inline(always)]
pub fn exp_sum(values: &mut [f32], top: f32) -> f32 {
    // Two loops: the compiler turns the first into vectors of exponentials, but not one that also adds up.
    for v in &mut *values {
        *v = exp(*v - top);
    }
    let (chunks, rest) = values.as_chunks::<8>();
    let mut lanes = [0.0_f32; 8];
    for chunk in chunks {
        lanes.iter_mut().zip(chunk).for_each(|(l, v)| *l += v);
    }
    let rest = rest.iter().fold(0.0, |sum, v| sum + v);
    ((lanes[0] + lanes[4]) + (lanes[2] + lanes[6])) + ((lanes[1] + lanes[5]) + (lanes[3] + lanes[7])) + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_is_within_its_error() {
        let mut worst = 0.0_f64;
        for i in -870_000..887_000 {
            let x = i as f32 * 1e-4;
            let exact = f64::from(x).exp();
            worst = worst.max((f64::from(exp(x)) / exact - 1.0).abs());
        }
        assert!(worst < 3e-7, "{worst}");
        assert_eq!((exp(0.0), exp(-1000.0), exp(f32::NEG_INFINITY)), (1.0, 0.0, 0.0));
        assert_eq!((exp(1000.0), exp(f32::INFINITY)), (f32::INFINITY, f32::INFINITY));
        assert!(exp(f32::NAN).is_nan());
    }

    #[test]
    fn sums_cover_every_number() {
        for n in [0, 1, 7, 8, 33, 100] {
            let v: Vec<f32> = (0..n).map(|i| i as f32).collect();
            assert_eq!(dot(&v, &v), v.iter().map(|x| x * x).sum::<f32>(), "{n}");
            assert_eq!(max(&v), if n == 0 { f32::NEG_INFINITY } else { n as f32 - 1.0 });
            let mut e = v.clone();
            let s = exp_sum(&mut e, 100.0);
            assert!((s - e.iter().sum::<f32>()).abs() <= 1e-6 * s);
        }
    }
}
