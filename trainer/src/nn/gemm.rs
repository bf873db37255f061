//! Matrix products on row-major `f32` slices, through the `gemm` crate. The only unsafe code of the trainer: the crate takes
//! raw pointers, so each wrapper first checks that every slice holds the whole matrix.
//!
//! One thread per call: parallelism over the batch scales better at these sizes, and results must not depend on the thread count.

use gemm::{Parallelism, gemm};

fn check(what: &str, len: usize, rows: usize, cols: usize) {
    assert!(len >= rows * cols, "{what}: {rows} x {cols} needs {} numbers, the slice has {len}", rows * cols);
}

/// `c (m x n) = a (m x k) · bᵀ`, with `b` stored as `n x k`: the forward pass of a dense layer (`b` = weights).
///
/// # Panics
/// Where a slice is shorter than its matrix.
pub fn matmul_nt(m: usize, n: usize, k: usize, a: &[f32], b: &[f32], c: &mut [f32]) {
    check("a", a.len(), m, k);
    check("b", b.len(), n, k);
    check("c", c.len(), m, n);
    // SAFETY: the three slices hold m*k, n*k and m*n numbers (checked above); the strides given (row-major a and c, b read
    // transposed) stay within them; c does not alias a or b, being the only `&mut`.
    #[expect(unsafe_code, reason = "gemm takes raw pointers")]
    unsafe {
        gemm(
            m,
            n,
            k,
            c.as_mut_ptr(),
            1,
            n as isize,
            false,
            a.as_ptr(),
            1,
            k as isize,
            b.as_ptr(),
            k as isize,
            1,
            0.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

/// `c (m x n) = a (m x k) · b (k x n)`, or `c += …` when `accumulate`: the gradient of a dense layer's input.
///
/// # Panics
/// Where a slice is shorter than its matrix.
pub fn matmul_nn(m: usize, n: usize, k: usize, a: &[f32], b: &[f32], c: &mut [f32], accumulate: bool) {
    check("a", a.len(), m, k);
    check("b", b.len(), k, n);
    check("c", c.len(), m, n);
    // SAFETY: as in `matmul_nt`, with b row-major k x n.
    #[expect(unsafe_code, reason = "gemm takes raw pointers")]
    unsafe {
        gemm(
            m,
            n,
            k,
            c.as_mut_ptr(),
            1,
            n as isize,
            accumulate,
            a.as_ptr(),
            1,
            k as isize,
            b.as_ptr(),
            1,
            n as isize,
            1.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

/// `c (m x n) += aᵀ · b`, with `a` stored as `k x m` and `b` as `k x n`: the gradient of a dense layer's weights
/// (`a` = output gradient, `b` = input, k = batch).
///
/// # Panics
/// Where a slice is shorter than its matrix.
pub fn matmul_tn_add(m: usize, n: usize, k: usize, a: &[f32], b: &[f32], c: &mut [f32]) {
    check("a", a.len(), k, m);
    check("b", b.len(), k, n);
    check("c", c.len(), m, n);
    // SAFETY: as in `matmul_nt`, with a read transposed (row stride 1, column stride m).
    #[expect(unsafe_code, reason = "gemm takes raw pointers")]
    unsafe {
        gemm(
            m,
            n,
            k,
            c.as_mut_ptr(),
            1,
            n as isize,
            true,
            a.as_ptr(),
            m as isize,
            1,
            b.as_ptr(),
            1,
            n as isize,
            1.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::{matmul_nn, matmul_nt, matmul_tn_add};

    #[test]
    fn the_three_products_agree_with_hand_computed_ones() {
        let a = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]; // 2 x 3
        let b = [1.0, 0.0, 2.0, -1.0, 1.0, 0.0]; // 2 x 3
        let mut c = [0.0; 4];
        matmul_nt(2, 2, 3, &a, &b, &mut c);
        assert_eq!(c, [7.0, 1.0, 16.0, 1.0]);
        let w = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]; // 3 x 2
        matmul_nn(2, 2, 3, &a, &w, &mut c, false);
        assert_eq!(c, [22.0, 28.0, 49.0, 64.0]);
        matmul_nn(2, 2, 3, &a, &w, &mut c, true);
        assert_eq!(c, [44.0, 56.0, 98.0, 128.0]);
        let mut d = [1.0; 9]; // 3 x 3 = aᵀ (3 x 2) · b (2 x 3) + 1
        matmul_tn_add(3, 3, 2, &a, &b, &mut d);
        assert_eq!(d, [-2.0, 5.0, 3.0, -2.0, 6.0, 5.0, -2.0, 7.0, 7.0]);
    }

    #[test]
    #[should_panic(expected = "c: 2 x 2 needs 4 numbers, the slice has 3")]
    fn a_short_slice_is_refused() {
        matmul_nt(2, 2, 1, &[0.0; 2], &[0.0; 2], &mut [0.0; 3]);
    }
}
