//! The matrix product of every dense layer: one register tile of 6 x 16, on whatever vector unit the machine has.
//!
//! Safe code on `pulp`, which chooses AVX2 with FMA, NEON or plain code at run time. The right factor comes in panels of 16
//! columns, so that its reads are forward only and one panel stays in the first cache while the rows of the left factor pass
//! by; bias, ReLU or accumulation happen while a tile is still in registers. One thread: see [`super::parallel`].
//! Source of the scheme: Goto & van de Geijn 2008; Van Zee & van de Geijn 2015 (BLIS).

use pulp::{Simd, WithSimd};

use super::pack::{PANEL, TILE, groups_len, pack_panel, panels_len};

/// The left factor, `m x k`.
#[derive(Clone, Copy, Debug)]
pub enum Left<'a> {
    /// Row-major.
    Rows(&'a [f32]),
    /// As [`pack_groups_and_sum`](super::pack::pack_groups_and_sum) leaves it: groups of [`TILE`] rows, column by column.
    Groups(&'a [f32]),
}

/// The right factor, `k x n`.
#[derive(Debug)]
pub enum Right<'a> {
    /// In panels, as [`pack_panels`](super::pack::pack_panels) leaves it: for a factor that several products read.
    Panels(&'a [f32]),
    /// Row-major, with room for one panel (`k x` [`PANEL`]). A panel is packed when its turn comes and read from the first
    /// cache: for a factor that one product reads.
    Rows(&'a [f32], &'a mut [f32]),
}

/// What happens to a finished tile.
#[derive(Clone, Copy, Debug)]
pub enum Epilogue<'a> {
    /// `c = tile`.
    Store,
    /// `c += tile`.
    Add,
    /// `c = tile`, or `c += tile` where `add`, for what lies where `gate` (as `c`) is above zero; the rest of the tile counts as
    /// zero. The gradient of a ReLU whose output is `gate`.
    Gated {
        /// Output of the ReLU.
        gate: &'a [f32],
        /// Whether there is something to add to.
        add: bool,
    },
    /// `c = tile + bias`, one number per column, then ReLU where the flag is set (NaN stays NaN).
    Bias(&'a [f32], bool),
}

/// `c (m x n, row-major) = left (m x k) · right (k x n)`, then the epilogue.
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
    /// Right factor.
    pub right: Right<'a>,
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
    let Product { m, n, k, left, ref right, ref c, end } = product;
    let left_len = match left {
        Left::Rows(x) => (x.len(), m * k),
        Left::Groups(x) => (x.len(), groups_len(m, k)),
    };
    assert!(left_len.0 >= left_len.1, "left {m} x {k} needs {} numbers, the slice has {}", left_len.1, left_len.0);
    let (len, need) = match right {
        Right::Panels(x) => (x.len(), panels_len(k, n)),
        Right::Rows(x, room) => {
            assert!(room.len() >= k * PANEL, "a panel needs {} numbers, the slice has {}", k * PANEL, room.len());
            (x.len(), k * n)
        }
    };
    assert!(len >= need, "right {k} x {n} needs {need} numbers, the slice has {len}");
    assert!(c.len() >= m * n, "c: {m} x {n} needs {} numbers, the slice has {}", m * n, c.len());
    match end {
        Epilogue::Bias(bias, _) => assert!(bias.len() >= n, "bias of {n} numbers, the slice has {}", bias.len()),
        Epilogue::Gated { gate, .. } => {
            assert!(gate.len() >= m * n, "gate: {m} x {n} needs {} numbers, the slice has {}", m * n, gate.len());
        }
        Epilogue::Store | Epilogue::Add => {}
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
        match self.end {
            Epilogue::Store => self.tiles(simd, Store),
            Epilogue::Add => self.tiles(simd, Add),
            Epilogue::Gated { gate, add: false } => self.tiles(simd, Gated(Store, gate)),
            Epilogue::Gated { gate, add: true } => self.tiles(simd, Gated(Add, gate)),
            Epilogue::Bias(bias, false) => self.tiles(simd, Bias::<false>(bias)),
            Epilogue::Bias(bias, true) => self.tiles(simd, Bias::<true>(bias)),
        }
    }
}

impl Product<'_> {
    #[inline(always)]
    fn tiles<S: Simd>(self, simd: S, end: impl End) {
        match self.left {
            Left::Rows(x) => self.tiles_of(simd, end, Rows(x)),
            Left::Groups(x) => self.tiles_of(simd, end, Groups(x)),
        }
    }

    #[inline(always)]
    fn tiles_of<S: Simd, L: Source>(self, simd: S, end: impl End, left: L) {
        let Self { m, n, k, mut right, c, .. } = self;
        let block = match right {
            Right::Panels(_) => BLOCK,
            // So that each panel is packed once.
            Right::Rows(..) => m.max(1),
        };
        for start in (0..m).step_by(block) {
            let stop = (start + block).min(m);
            for p in 0..n.div_ceil(PANEL) {
                let at = Place { column: p * PANEL, columns: (n - p * PANEL).min(PANEL), n };
                let panel = match &mut right {
                    Right::Panels(x) => &x[p * PANEL * k..][..PANEL * k],
                    Right::Rows(x, room) => {
                        let room = &mut room[..PANEL * k];
                        pack_panel(x, n, at.column, room);
                        &*room
                    }
                };
                let mut i = start;
                while i + TILE <= stop {
                    tile::<S, TILE>(simd, i, TILE, left, panel, at, c, end);
                    i += TILE;
                }
                match stop - i {
                    0 => {}
                    rows if L::PADDED => tile::<S, TILE>(simd, i, rows, left, panel, at, c, end),
                    1 => tile::<S, 1>(simd, i, 1, left, panel, at, c, end),
                    2 => tile::<S, 2>(simd, i, 2, left, panel, at, c, end),
                    3 => tile::<S, 3>(simd, i, 3, left, panel, at, c, end),
                    4 => tile::<S, 4>(simd, i, 4, left, panel, at, c, end),
                    rows => tile::<S, 5>(simd, i, rows, left, panel, at, c, end),
                }
            }
        }
    }
}

/// [`Epilogue`] as a type, so that the end of a tile is compiled for each and holds no branch.
trait End: Copy {
    /// What becomes of `sum` where `to` stands, from the number `at` of the result and from that column on.
    fn finish<S: Simd>(self, simd: S, sum: S::f32s, to: S::f32s, at: usize, column: usize) -> S::f32s;
    /// The same for one number.
    fn finish_one(self, sum: f32, to: f32, at: usize, column: usize) -> f32;
}

#[derive(Clone, Copy)]
struct Store;
#[derive(Clone, Copy)]
struct Add;
#[derive(Clone, Copy)]
struct Bias<'a, const RELU: bool>(&'a [f32]);
#[derive(Clone, Copy)]
struct Gated<'a, E>(E, &'a [f32]);

impl End for Store {
    #[inline(always)]
    fn finish<S: Simd>(self, _: S, sum: S::f32s, _: S::f32s, _: usize, _: usize) -> S::f32s {
        sum
    }
    #[inline(always)]
    fn finish_one(self, sum: f32, _: f32, _: usize, _: usize) -> f32 {
        sum
    }
}

impl End for Add {
    #[inline(always)]
    fn finish<S: Simd>(self, simd: S, sum: S::f32s, to: S::f32s, _: usize, _: usize) -> S::f32s {
        simd.add_f32s(to, sum)
    }
    #[inline(always)]
    fn finish_one(self, sum: f32, to: f32, _: usize, _: usize) -> f32 {
        to + sum
    }
}

impl<const RELU: bool> End for Bias<'_, RELU> {
    #[inline(always)]
    fn finish<S: Simd>(self, simd: S, sum: S::f32s, _: S::f32s, _: usize, column: usize) -> S::f32s {
        let bias = S::as_simd_f32s(&self.0[column..][..S::F32_LANES]).0[0];
        let value = simd.add_f32s(sum, bias);
        let zero = simd.splat_f32s(0.0);
        if RELU { simd.select_f32s(simd.less_than_f32s(value, zero), zero, value) } else { value }
    }
    #[inline(always)]
    fn finish_one(self, sum: f32, _: f32, _: usize, column: usize) -> f32 {
        let value = sum + self.0[column];
        if RELU && value < 0.0 { 0.0 } else { value }
    }
}

impl<E: End> End for Gated<'_, E> {
    #[inline(always)]
    fn finish<S: Simd>(self, simd: S, sum: S::f32s, to: S::f32s, at: usize, column: usize) -> S::f32s {
        let gate = S::as_simd_f32s(&self.1[at..][..S::F32_LANES]).0[0];
        let zero = simd.splat_f32s(0.0);
        let sum = simd.select_f32s(simd.less_than_f32s(zero, gate), sum, zero);
        self.0.finish(simd, sum, to, at, column)
    }
    #[inline(always)]
    fn finish_one(self, sum: f32, to: f32, at: usize, column: usize) -> f32 {
        self.0.finish_one(if self.1[at] > 0.0 { sum } else { 0.0 }, to, at, column)
    }
}

/// [`Left`] as a type.
trait Source: Copy {
    /// Whether rows that are not there may be read.
    const PADDED: bool;
    /// Sums of `R` rows from `i` on, for the vectors `part` and `part + 1` of each row of the panel.
    fn sums<S: Simd, const R: usize>(self, simd: S, i: usize, panel: &[S::f32s], part: usize) -> Sums<S, R>;
}

/// Two vectors for each row of a tile.
type Sums<S, const R: usize> = [[<S as Simd>::f32s; 2]; R];

/// Vectors of a row of a panel, and its rows.
#[inline(always)]
fn shape<S: Simd>(panel: &[S::f32s]) -> (usize, usize) {
    let per = PANEL / S::F32_LANES;
    (per, panel.len() / per)
}

/// One step of the inner products.
#[inline(always)]
fn step<S: Simd, const R: usize>(simd: S, sums: &mut Sums<S, R>, a: impl Fn(usize) -> f32, b0: S::f32s, b1: S::f32s) {
    for (r, sums) in sums.iter_mut().enumerate() {
        let a = simd.splat_f32s(a(r));
        sums[0] = simd.mul_add_e_f32s(a, b0, sums[0]);
        sums[1] = simd.mul_add_e_f32s(a, b1, sums[1]);
    }
}

#[derive(Clone, Copy)]
struct Rows<'a>(&'a [f32]);
#[derive(Clone, Copy)]
struct Groups<'a>(&'a [f32]);

impl Source for Rows<'_> {
    const PADDED: bool = false;

    #[inline(always)]
    fn sums<S: Simd, const R: usize>(self, simd: S, i: usize, panel: &[S::f32s], part: usize) -> Sums<S, R> {
        let (per, k) = shape::<S>(panel);
        let mut sums = [[simd.splat_f32s(0.0); 2]; R];
        let x: [_; R] = std::array::from_fn(|r| self.0[(i + r) * k..][..k].as_chunks::<STEPS>());
        let mut blocks = panel.chunks_exact(STEPS * per);
        for (j, b) in (&mut blocks).enumerate().take(k / STEPS) {
            let x: [&[f32; STEPS]; R] = std::array::from_fn(|r| &x[r].0[j]);
            for s in 0..STEPS {
                step::<S, R>(simd, &mut sums, |r| x[r][s], b[s * per + part], b[s * per + part + 1]);
            }
        }
        for (j, b) in blocks.remainder().chunks_exact(per).enumerate().take(k % STEPS) {
            step::<S, R>(simd, &mut sums, |r| x[r].1[j], b[part], b[part + 1]);
        }
        sums
    }
}

impl Source for Groups<'_> {
    const PADDED: bool = true;

    #[inline(always)]
    fn sums<S: Simd, const R: usize>(self, simd: S, i: usize, panel: &[S::f32s], part: usize) -> Sums<S, R> {
        let (per, k) = shape::<S>(panel);
        let mut sums = [[simd.splat_f32s(0.0); 2]; R];
        let group = &self.0[i * k..][..TILE * k];
        for (a, b) in group.as_chunks::<TILE>().0.iter().zip(panel.chunks_exact(per)) {
            step::<S, R>(simd, &mut sums, |r| a[r], b[part], b[part + 1]);
        }
        sums
    }
}

/// Steps between two checks of the bounds of rows.
const STEPS: usize = 8;

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
    left: impl Source,
    panel: &[f32],
    at: Place,
    c: &mut [f32],
    end: impl End,
) {
    let lanes = S::F32_LANES;
    let per = PANEL / lanes;
    let (panel, _) = S::as_simd_f32s(panel);
    // Two vectors at a time: once round with eight lanes, twice with four.
    for part in (0..per).step_by(2) {
        let sums: Sums<S, R> = left.sums(simd, i, panel, part);
        let column = at.column + part * lanes;
        if at.columns == PANEL && rows == R {
            for (r, sums) in sums.iter().enumerate() {
                let first = (i + r) * at.n + column;
                let (to, _) = S::as_mut_simd_f32s(&mut c[first..][..2 * lanes]);
                to[0] = end.finish(simd, sums[0], to[0], first, column);
                to[1] = end.finish(simd, sums[1], to[1], first + lanes, column + lanes);
            }
        } else {
            for (r, sums) in sums.iter().enumerate().take(rows) {
                let mut values = [0.0; PANEL];
                let (to, _) = S::as_mut_simd_f32s(&mut values);
                (to[0], to[1]) = (sums[0], sums[1]);
                let first = (i + r) * at.n + column;
                let width = at.columns.saturating_sub(part * lanes).min(2 * lanes);
                for (j, (to, &sum)) in c[first..][..width].iter_mut().zip(&values).enumerate() {
                    *to = end.finish_one(sum, *to, first + j, column + j);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::nn::pack::{pack_groups_and_sum, pack_panels, pack_panels_transposed};
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
            let mut sums = vec![1.0; m];
            pack_groups_and_sum(&transposed(&a, m, k), m, k, &mut groups, &mut sums);
            for (i, sum) in sums.iter().enumerate() {
                let row: f64 = a[i * k..][..k].iter().map(|&v| f64::from(v)).sum();
                prop_assert!((f64::from(*sum) - row).abs() < 1e-5, "sum of column {i}: {sum}, {row}");
            }
            let mut room = vec![5.0; k * PANEL];
            for (left, packed) in [Left::Rows(&a), Left::Groups(&groups)].into_iter().flat_map(|l| [(l, true), (l, false)]) {
                let gate = &start[..];
                let gated = [false, true].map(|add| Epilogue::Gated { gate, add });
                let biased = [false, true].map(|relu| Epilogue::Bias(&bias, relu));
                for end in [Epilogue::Store, Epilogue::Add].into_iter().chain(gated).chain(biased) {
                    for wide in [true, false] {
                        let mut c = start.clone();
                        let right = if packed { Right::Panels(&panels) } else { Right::Rows(&b, &mut room) };
                        let product = Product { m, n, k, left, right, c: &mut c, end };
                        if wide { dispatch(product) } else { portable(product) }
                        for (i, (&c, &sum)) in c.iter().zip(&expected).enumerate() {
                            let value = match end {
                                Epilogue::Store => sum,
                                Epilogue::Add => sum + f64::from(start[i]),
                                Epilogue::Gated { add, .. } => {
                                    let kept = if start[i] > 0.0 { sum } else { 0.0 };
                                    if add { kept + f64::from(start[i]) } else { kept }
                                }
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
        product(Product { m: 3, n: 16, k: 1, left: Left::Rows(&a), right: Right::Panels(&panels), c: &mut c, end });
        assert!(c.iter().all(|c| c.is_nan()));
    }

    #[test]
    #[should_panic(expected = "c: 2 x 2 needs 4 numbers, the slice has 3")]
    fn a_short_slice_is_refused() {
        let left = Left::Rows(&[0.0; 2]);
        let right = Right::Panels(&[0.0; 16]);
        product(Product { m: 2, n: 2, k: 1, left, right, c: &mut [0.0; 3], end: Epilogue::Store });
    }
}
