//! A dense layer behind a one-hot code: its product is a row of Wᵀ, and its weight gradient a sum over the rows of a code.
//! The same numbers as the products with the unit vectors, bit for bit, without their zeros.

use super::super::pack::PANEL;
use super::forward::at_least;

/// `out = W[:, code] + bias` for each row, with a floor. `panels` is Wᵀ (`depth x n`) in panels of its columns.
#[inline(always)]
pub(super) fn look_up(codes: &[u32], panels: &[f32], bias: &[f32], depth: usize, floor: f32, out: &mut [f32]) {
    let n = bias.len();
    for (&code, out) in codes.iter().zip(out.chunks_exact_mut(n)) {
        let rows = panels.chunks_exact(PANEL * depth).map(|panel| &panel[code as usize * PANEL..][..PANEL]);
        for ((out, row), bias) in out.chunks_mut(PANEL).zip(rows).zip(bias.chunks(PANEL)) {
            for ((o, w), b) in out.iter_mut().zip(row).zip(bias) {
                *o = at_least(w + b, floor);
            }
        }
    }
}

/// Sets `gradient` (`n x depth`) to `dyᵀ onehot(codes)` and `bias` to the column sums of `dy` (`B x n`); `work` holds
/// `depth x n` numbers.
#[inline(always)]
pub(super) fn look_up_back(
    codes: &[u32],
    dy: &[f32],
    depth: usize,
    work: &mut [f32],
    gradient: &mut [f32],
    bias: &mut [f32],
) {
    let n = bias.len();
    let work = &mut work[..depth * n];
    work.fill(0.0);
    bias.fill(0.0);
    for (&code, dy) in codes.iter().zip(dy.chunks_exact(n)) {
        let sums = work[code as usize * n..][..n].iter_mut().zip(&mut *bias);
        for ((w, b), g) in sums.zip(dy) {
            *w += g;
            *b += g;
        }
    }
    for (k, row) in work.chunks_exact(n).enumerate() {
        for (to, from) in gradient[k..].iter_mut().step_by(depth).zip(row) {
            *to = *from;
        }
    }
}
