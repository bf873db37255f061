//! Standardisation over a batch in parts: statistics, gradient, running statistics.

use std::ops::Range;

use super::super::parallel;
use super::super::vector::vectorised;
use super::workspace::Given;
use super::{Graph, Op, STANDARDISE_EPS, Workspace};

impl Graph {
    /// Column sums of `dy` and `dy ⊙ x̂` over the rows of one part, behind mean and variance in its statistics.
    pub(super) fn standardise_sums(&self, ws: &mut Workspace, op: usize) {
        let Op::Standardise { x, y, gain, .. } = &self.ops[op] else { return };
        let (width, batch) = (self.widths[*x], ws.batch);
        let Workspace { act, grad, stats, given, .. } = ws;
        let (sum, product) = stats[op][2 * width..].split_at_mut(width);
        sum.fill(0.0);
        product.fill(0.0);
        if given[*y] == Given::Nothing {
            return;
        }
        vectorised!({
            for (g, o) in grad[*y].chunks_exact(width).zip(act[*y].chunks_exact(width)).take(batch) {
                for (((m, h), &g), &o) in sum.iter_mut().zip(&mut *product).zip(g).zip(o) {
                    *m += g;
                    *h += g * o;
                }
            }
            for p in &mut *product {
                *p /= gain;
            }
        });
    }

    /// `dx = gain / σ (dy - mean(dy) - x̂ mean(dy x̂))` with the means over the `batch` rows of all parts.
    /// Source: Ioffe & Szegedy 2015, section 3, without affine parameters.
    pub(super) fn standardise_backward(&self, ws: &mut Workspace, op: usize, batch: usize) {
        let Op::Standardise { x, y, gain, .. } = &self.ops[op] else { return };
        if ws.given[*y] == Given::Nothing || !self.needs_grad[*x] {
            return;
        }
        let (width, rows) = (self.widths[*x], ws.batch);
        let accumulate = std::mem::replace(&mut ws.given[*x], Given::Plain) != Given::Nothing;
        let dy = std::mem::take(&mut ws.grad[*y]);
        let Workspace { act, grad, stats, .. } = ws;
        let (stats, sums) = stats[op][width..].split_at_mut(width);
        let (sum, product) = sums.split_at_mut(width);
        vectorised!({
            let scale = 1.0 / batch as f32;
            for (m, h) in sum.iter_mut().zip(&mut *product) {
                *m *= scale;
                *h *= scale / gain;
            }
            let to = grad[*x].chunks_exact_mut(width).zip(dy.chunks_exact(width)).zip(act[*y].chunks_exact(width));
            for ((to, g), o) in to.take(rows) {
                let columns = stats.iter().zip(&*sum).zip(&*product);
                for (((t, &g), &o), ((&v, &m), &h)) in to.iter_mut().zip(g).zip(o).zip(columns) {
                    let value = gain / (v + STANDARDISE_EPS).sqrt() * (g - m - o * h);
                    *t = if accumulate { *t + value } else { value };
                }
            }
        });
        ws.grad[*y] = dy;
    }

    /// Moves the running statistics of every standardisation towards those of the last training batch, which had `batch` rows
    /// in all parts (unbiased variance). Any part's workspace will do.
    pub fn update_running_statistics(&self, params: &mut [f32], ws: &Workspace, batch: usize) {
        let unbias = batch as f32 / (batch.max(2) - 1) as f32;
        for (i, op) in self.ops.iter().enumerate() {
            if let Op::Standardise { x, mean, var, momentum, .. } = op {
                let width = self.widths[*x];
                let (mu, variance) = ws.stats[i][..2 * width].split_at(width);
                params[mean.clone()].iter_mut().zip(mu).for_each(|(p, m)| *p += momentum * (m - *p));
                params[var.clone()].iter_mut().zip(variance).for_each(|(p, v)| *p += momentum * (v * unbias - *p));
            }
        }
    }
}

/// Mean and biased variance of each column into `[mean…, var…]`, in two passes.
#[inline(always)]
pub(super) fn column_statistics(matrix: &[f32], batch: usize, width: usize, stats: &mut [f32]) {
    let (mean, var) = stats.split_at_mut(width);
    mean.fill(0.0);
    var.fill(0.0);
    let rows = || matrix.chunks_exact(width).take(batch);
    for row in rows() {
        mean.iter_mut().zip(row).for_each(|(m, x)| *m += x);
    }
    for m in mean.iter_mut() {
        *m /= batch as f32;
    }
    for row in rows() {
        for ((v, x), m) in var.iter_mut().zip(row).zip(mean.iter()) {
            *v += (x - m) * (x - m);
        }
    }
    for v in var {
        *v /= batch as f32;
    }
}

/// Gives every part mean and variance of all rows. Source: Chan, Golub & LeVeque 1979, eq. 2.1.
pub(super) fn combine_statistics(
    parts: &mut [Workspace],
    rows: &[Range<usize>; parallel::PARTS],
    op: usize,
    width: usize,
) {
    let (a, b) = (rows[0].len() as f32, rows[1].len() as f32);
    if b == 0.0 {
        return;
    }
    let [first, second] = parts else { unreachable!("as many workspaces as parts") };
    let (share_a, share_b) = (a / (a + b), b / (a + b));
    let (first, second) = (&mut first.stats[op], &mut second.stats[op]);
    for j in 0..width {
        let apart = second[j] - first[j];
        let mean = share_a * first[j] + share_b * second[j];
        let var = share_a * first[width + j] + share_b * second[width + j] + share_a * share_b * apart * apart;
        (first[j], second[j]) = (mean, mean);
        (first[width + j], second[width + j]) = (var, var);
    }
}

/// Gives every part the sums of [`Graph::standardise_sums`] over all rows.
pub(super) fn add_sums(parts: &mut [Workspace], rows: &[Range<usize>; parallel::PARTS], op: usize) {
    if rows[1].is_empty() {
        return;
    }
    let [first, second] = parts else { unreachable!("as many workspaces as parts") };
    let from = first.stats[op].len() / 2;
    for (a, b) in first.stats[op][from..].iter_mut().zip(&mut second.stats[op][from..]) {
        *a += *b;
        *b = *a;
    }
}
