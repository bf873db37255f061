//! The matrix product of every dense layer: one register tile of 6 x 16, on whatever vector unit the machine has.
//!
//! Safe code on `pulp`, which chooses AVX2 with FMA, NEON or plain code at run time. The right factor comes in panels of 16
//! columns, so that its reads are forward only and one panel stays in the first cache while the rows of the left factor pass
//! by; bias, ReLU or accumulation happen while a tile is still in registers. One thread: see [`super::parallel`].
//! Source of the scheme: Goto & van de Geijn 2008; Van Zee & van de Geijn 2015 (BLIS).

use pulp::{Simd, WithSimd};

/// Columns of a panel.
pub const PANEL: usize = 16;
/// Rows of a tile.
pub const TILE: usize = 6;

/// The left factor, `m x k`.
#[derive(Clone, Copy, Debug)]
pub enum Left<'a> {
    /// Row-major.
    Rows(&'a [f32]),
    /// As [`pack_groups`] leaves it: groups of [`TILE`] rows, column by column.
    Groups(&'a [f32]),
}

/// What happens to a finished tile.
#[derive(Clone, Copy, Debug)]
pub enum Epilogue<'a> {
    /// `c = tile`.
    Store,
    /// `c += tile`.
    Add,
    /// `c = tile + bias`, one number per column, then ReLU where the flag is set (NaN stays NaN).
    Bias(&'a [f32], bool),
}

/// Length of a matrix of `rows x cols` in panels.
pub fn panels_len(rows: usize, cols: usize) -> usize {
    cols.div_ceil(PANEL) * PANEL * rows
}

/// Length of the groups of a matrix of `m x k`.
pub fn groups_len(m: usize, k: usize) -> usize {
    m.div_ceil(TILE) * TILE * k
}

/// Writes row-major `x` (`rows x cols`) in panels of its columns; columns that are not there are zero.
pub fn pack_panels(x: &[f32], rows: usize, cols: usize, out: &mut [f32]) {
    for (p, panel) in out.chunks_exact_mut(PANEL * rows).enumerate().take(cols.div_ceil(PANEL)) {
        let at = p * PANEL;
        let width = (cols - at).min(PANEL);
        for (row, to) in x.chunks_exact(cols).zip(panel.chunks_exact_mut(PANEL)) {
            if width == PANEL {
                to.copy_from_slice(&row[at..at + PANEL]);
            } else {
                to[..width].copy_from_slice(&row[at..]);
                to[width..].fill(0.0);
            }
        }
    }
}

/// Writes the transpose of row-major `x` (`cols x rows`) in panels of its columns (rows of `x`).
pub fn pack_panels_transposed(x: &[f32], rows: usize, cols: usize, out: &mut [f32]) {
    for (p, panel) in out.chunks_exact_mut(PANEL * rows).enumerate().take(cols.div_ceil(PANEL)) {
        let at = p * PANEL;
        let width = (cols - at).min(PANEL);
        if width < PANEL {
            panel.fill(0.0);
        }
        // Eight numbers of a row at a time: each line of `x` is read once, and eight lines of the panel stay in the cache.
        for start in (0..rows).step_by(8) {
            let n = (rows - start).min(8);
            let block = &mut panel[start * PANEL..(start + n) * PANEL];
            for j in 0..width {
                let from = &x[(at + j) * rows + start..][..n];
                for (to, &v) in block.chunks_exact_mut(PANEL).zip(from) {
                    to[j] = v;
                }
            }
        }
    }
}

/// Writes the transpose of row-major `x` (`k x m`) in groups of [`TILE`] of its columns; columns that are not there are zero.
pub fn pack_groups(x: &[f32], m: usize, k: usize, out: &mut [f32]) {
    for (g, group) in out.chunks_exact_mut(TILE * k).enumerate().take(m.div_ceil(TILE)) {
        let at = g * TILE;
        let width = (m - at).min(TILE);
        for (row, to) in x.chunks_exact(m).zip(group.chunks_exact_mut(TILE)) {
            if width == TILE {
                to.copy_from_slice(&row[at..at + TILE]);
            } else {
                to[..width].copy_from_slice(&row[at..]);
                to[width..].fill(0.0);
            }
        }
    }
}

/// `c (m x n, row-major) = left (m x k) · right (k x n, in panels)`, then the epilogue.
#[derive(Debug)]
pub struct Product<'a> {
    /// Rows.
    pub m: usize,
    /// Columns.
    pub n: usize,
    /// Length of the sums.
    pub k: usize,
    /// Left factor.
    pub left: Left<'a>,
    /// Right factor in panels.
    pub right: &'a [f32],
    /// Result.
    pub c: &'a mut [f32],
    /// What happens to a finished tile.
    pub end: Epilogue<'a>,
}

/// Computes a product on the best vector unit of the machine.
///
/// # Panics
/// Where a slice is shorter than its matrix.
pub fn product(product: Product) {
    let Product { m, n, k, left, right, ref c, end } = product;
    let left_len = match left {
        Left::Rows(x) => (x.len(), m * k),
        Left::Groups(x) => (x.len(), groups_len(m, k)),
    };
    assert!(left_len.0 >= left_len.1, "left {m} x {k} needs {} numbers, the slice has {}", left_len.1, left_len.0);
    let need = panels_len(k, n);
    assert!(right.len() >= need, "right {k} x {n} needs {need} numbers, the slice has {}", right.len());
    assert!(c.len() >= m * n, "c: {m} x {n} needs {} numbers, the slice has {}", m * n, c.len());
    if let Epilogue::Bias(bias, _) = end {
        assert!(bias.len() >= n, "bias of {n} numbers, the slice has {}", bias.len());
    }
    dispatch(product);
}

/// Runs `op` with the instructions of the best vector unit.
pub fn dispatch<Op: WithSimd>(op: Op) -> Op::Output {
    #[cfg(target_arch = "x86_64")]
    if let Some(simd) = pulp::x86::V3::try_new() {
        return Simd::vectorize(simd, op);
    }
    #[cfg(target_arch = "aarch64")]
    if let Some(simd) = pulp::aarch64::Neon::try_new() {
        return Simd::vectorize(simd, op);
    }
    portable(op)
}

/// Runs `op` on fixed arrays of eight numbers, which the compiler turns into what vectors there are.
pub fn portable<Op: WithSimd>(op: Op) -> Op::Output {
    Simd::vectorize(pulp::Scalar256b, op)
}

impl WithSimd for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { m, n, k, left, right, c, end } = self;
        for start in (0..m).step_by(BLOCK) {
            let stop = (start + BLOCK).min(m);
            for (p, panel) in right.chunks_exact((PANEL * k).max(1)).enumerate().take(n.div_ceil(PANEL)) {
                let at = Place { column: p * PANEL, columns: (n - p * PANEL).min(PANEL), n };
                let mut i = start;
                while i + TILE <= stop {
                    tile::<S, TILE>(simd, i, TILE, k, left, panel, at, c, end);
                    i += TILE;
                }
                match (left, stop - i) {
                    (_, 0) => {}
                    (Left::Groups(_), rows) => tile::<S, TILE>(simd, i, rows, k, left, panel, at, c, end),
                    (_, 1) => tile::<S, 1>(simd, i, 1, k, left, panel, at, c, end),
                    (_, 2) => tile::<S, 2>(simd, i, 2, k, left, panel, at, c, end),
                    (_, 3) => tile::<S, 3>(simd, i, 3, k, left, panel, at, c, end),
                    (_, 4) => tile::<S, 4>(simd, i, 4, k, left, panel, at, c, end),
                    (_, rows) => tile::<S, 5>(simd, i, rows, k, left, panel, at, c, end),
                }
            }
        }
    }
}

/// Rows of the left factor that pass by all panels before the next ones do: they stay in the second cache.
const BLOCK: usize = 24 * TILE;

/// Where a panel's results go.
#[derive(Clone, Copy)]
struct Place {
    column: usize,
    columns: usize,
    n: usize,
}

/// Rows `i .. i + rows` (at most `R`) of one panel.
#[expect(clippy::too_many_arguments, reason = "the innermost function: everything it needs is in registers")]
#[inline(always)]
fn tile<S: Simd, const R: usize>(
    simd: S,
    i: usize,
    rows: usize,
    k: usize,
    left: Left,
    panel: &[f32],
    at: Place,
    c: &mut [f32],
    end: Epilogue,
) {
    let lanes = S::F32_LANES;
    let per = PANEL / lanes;
    let (panel, _) = S::as_simd_f32s(panel);
    // Two vectors at a time: once round with eight lanes, twice with four.
    for part in (0..per).step_by(2) {
        let mut sums = [[simd.splat_f32s(0.0); 2]; R];
        match left {
            Left::Rows(x) => {
                let x: [&[f32]; R] = std::array::from_fn(|r| &x[(i + r) * k..][..k]);
                for (j, b) in panel.chunks_exact(per).take(k).enumerate() {
                    let (b0, b1) = (b[part], b[part + 1]);
                    for r in 0..R {
                        let a = simd.splat_f32s(x[r][j]);
                        sums[r][0] = simd.mul_add_e_f32s(a, b0, sums[r][0]);
                        sums[r][1] = simd.mul_add_e_f32s(a, b1, sums[r][1]);
                    }
                }
            }
            Left::Groups(x) => {
                let group = &x[i * k..][..TILE * k];
                for (a, b) in group.chunks_exact(TILE).zip(panel.chunks_exact(per)) {
                    let (b0, b1) = (b[part], b[part + 1]);
                    for r in 0..R {
                        let a = simd.splat_f32s(a[r]);
                        sums[r][0] = simd.mul_add_e_f32s(a, b0, sums[r][0]);
                        sums[r][1] = simd.mul_add_e_f32s(a, b1, sums[r][1]);
                    }
                }
            }
        }
        for (r, sums) in sums.iter().enumerate().take(rows) {
            let row = &mut c[(i + r) * at.n + at.column..][..at.columns];
            for (h, &sum) in sums.iter().enumerate() {
                let first = (part + h) * lanes;
                if first + lanes <= at.columns {
                    let to = &mut S::as_mut_simd_f32s(&mut row[first..first + lanes]).0[0];
                    *to = match end {
                        Epilogue::Store => sum,
                        Epilogue::Add => simd.add_f32s(*to, sum),
                        Epilogue::Bias(bias, relu) => {
                            let bias = S::as_simd_f32s(&bias[at.column + first..][..lanes]).0[0];
                            let value = simd.add_f32s(sum, bias);
                            let zero = simd.splat_f32s(0.0);
                            if relu { simd.select_f32s(simd.less_than_f32s(value, zero), zero, value) } else { value }
                        }
                    };
                } else {
                    let mut values = [0.0; PANEL];
                    S::as_mut_simd_f32s(&mut values[..lanes]).0[0] = sum;
                    for (j, value) in (first..at.columns).zip(values) {
                        row[j] = match end {
                            Epilogue::Store => value,
                            Epilogue::Add => row[j] + value,
                            Epilogue::Bias(bias, relu) => {
                                let value = value + bias[at.column + j];
                                if relu && value < 0.0 { 0.0 } else { value }
                            }
                        };
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::seed::SeedTree;

    /// The same product in f64, one number at a time.
    fn plain(m: usize, n: usize, k: usize, a: &[f32], b: &[f32]) -> Vec<f64> {
        let at = |i: usize, j: usize| (0..k).map(|r| f64::from(a[i * k + r]) * f64::from(b[r * n + j])).sum();
        (0..m * n).map(|i| at(i / n, i % n)).collect()
    }

    fn transposed(x: &[f32], rows: usize, cols: usize) -> Vec<f32> {
        (0..rows * cols).map(|i| x[i % rows * cols + i / rows]).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]
        #[test]
        fn every_packing_and_epilogue_gives_the_product(m in 1_usize..40, n in 1_usize..50, k in 1_usize..40, seed: u64) {
            let mut rng = SeedTree::new(seed).stream("kernel");
            let mut draw = |len: usize| (0..len).map(|_| rng.random_range(-1.0_f32..1.0)).collect::<Vec<f32>>();
            let (a, b, bias, start) = (draw(m * k), draw(k * n), draw(n), draw(m * n));
            let expected = plain(m, n, k, &a, &b);
            let (mut panels, mut other) = (vec![9.0; panels_len(k, n)], vec![7.0; panels_len(k, n)]);
            pack_panels(&b, k, n, &mut panels);
            pack_panels_transposed(&transposed(&b, k, n), k, n, &mut other);
            prop_assert_eq!(&panels, &other);
            let mut groups = vec![9.0; groups_len(m, k)];
            pack_groups(&transposed(&a, m, k), m, k, &mut groups);
            for left in [Left::Rows(&a), Left::Groups(&groups)] {
                for end in [Epilogue::Store, Epilogue::Add, Epilogue::Bias(&bias, false), Epilogue::Bias(&bias, true)] {
                    for wide in [true, false] {
                        let mut c = start.clone();
                        let product = Product { m, n, k, left, right: &panels, c: &mut c, end };
                        if wide { dispatch(product) } else { portable(product) }
                        for (i, (&c, &sum)) in c.iter().zip(&expected).enumerate() {
                            let value = match end {
                                Epilogue::Store => sum,
                                Epilogue::Add => sum + f64::from(start[i]),
                                Epilogue::Bias(bias, relu) => {
                                    let value = sum + f64::from(bias[i % n]);
                                    if relu { value.max(0.0) } else { value }
                                }
                            };
                            prop_assert!((f64::from(c) - value).abs() < 1e-5, "{left:?} {end:?} at {i}: {c}, {value}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn relu_keeps_what_is_not_a_number() {
        let (a, mut panels) = ([f32::NAN; 3], [0.0; PANEL]);
        pack_panels(&[1.0; 17][..16], 1, 16, &mut panels);
        let mut c = [0.0; 48];
        let end = Epilogue::Bias(&[0.0; 16], true);
        product(Product { m: 3, n: 16, k: 1, left: Left::Rows(&a), right: &panels, c: &mut c, end });
        assert!(c.iter().all(|c| c.is_nan()));
    }

    #[test]
    #[should_panic(expected = "c: 2 x 2 needs 4 numbers, the slice has 3")]
    fn a_short_slice_is_refused() {
        let left = Left::Rows(&[0.0; 2]);
        product(Product { m: 2, n: 2, k: 1, left, right: &[0.0; 16], c: &mut [0.0; 3], end: Epilogue::Store });
    }
}
