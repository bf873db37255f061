//! The forward pass.

use std::ops::Range;

use super::super::kernel::{Epilogue, Left, Product, Right, product};
use super::super::parallel;
use super::super::vector::{max, vectorised};
use super::lookup::look_up;
use super::standardise::{column_statistics, combine_statistics};
use super::{Graph, Op, STANDARDISE_EPS, Weights, Workspace};

impl Graph {
    /// Computes every value of the first `batch` rows. `train` chooses batch statistics for standardisation.
    ///
    /// # Panics
    /// Where the workspace is smaller than `batch`.
    pub fn forward(&self, weights: Weights, ws: &mut Workspace, batch: usize, train: bool) {
        if let Some(flat) = &weights.packed.on_device {
            self.forward_on_device(flat, std::slice::from_mut(ws), &[0..batch, batch..batch], train);
        } else if train {
            self.forward_parts(weights, std::slice::from_mut(ws), &[0..batch, batch..batch]);
        } else {
            ws.begin(batch);
            self.run(weights, ws, 0..self.ops.len(), false);
        }
    }

    /// The training pass over a batch in parts, each with its own workspace, with batch statistics of the whole.
    ///
    /// # Panics
    /// Where a workspace is smaller than its part.
    pub fn forward_parts(&self, weights: Weights, parts: &mut [Workspace], rows: &[Range<usize>; parallel::PARTS]) {
        if let Some(flat) = &weights.packed.on_device {
            return self.forward_on_device(flat, parts, rows, true);
        }
        let mut start = 0;
        for end in self.cuts() {
            parallel::each(parts, rows, |ws, rows| {
                if start == 0 {
                    ws.begin(rows.len());
                }
                self.run(weights, ws, start..end, true);
                if let Some(Op::Standardise { x, .. }) = self.ops.get(end) {
                    let (width, batch) = (self.widths[*x], ws.batch);
                    let Workspace { act, stats, .. } = ws;
                    vectorised!(column_statistics(&act[*x], batch, width, &mut stats[end][..2 * width]));
                }
            });
            if let Some(Op::Standardise { x, .. }) = self.ops.get(end) {
                combine_statistics(parts, rows, end, self.widths[*x]);
            }
            start = end;
        }
    }

    fn run(&self, weights: Weights, ws: &mut Workspace, ops: Range<usize>, train: bool) {
        let params = weights.flat;
        let batch = ws.batch;
        for i in ops {
            match &self.ops[i] {
                Op::Dense { x, y, b, relu, lookup: true, .. } => {
                    let floor = if *relu { 0.0 } else { f32::NEG_INFINITY };
                    let (bias, panels) = (&params[b.clone()], weights.packed.forward[i].as_slice());
                    let Workspace { act, codes, .. } = ws;
                    let (codes, depth, out) = (&codes[..batch], self.widths[*x], &mut act[*y]);
                    vectorised!(look_up(codes, panels, bias, depth, floor, out));
                }
                Op::Dense { x, y, b, relu, .. } => {
                    let mut out = std::mem::take(&mut ws.act[*y]);
                    product(Product {
                        m: batch,
                        n: self.widths[*y],
                        k: self.widths[*x],
                        left: Left::Rows(&ws.act[*x]),
                        right: Right::Panels(&weights.packed.forward[i]),
                        c: &mut out,
                        end: Epilogue::Bias(&params[b.clone()], *relu),
                    });
                    ws.act[*y] = out;
                }
                Op::Mul { a, b, y } => {
                    let mut out = std::mem::take(&mut ws.act[*y]);
                    let n = batch * self.widths[*y];
                    let (a, b) = (&ws.act[*a][..n], &ws.act[*b][..n]);
                    vectorised!(out[..n].iter_mut().zip(a).zip(b).for_each(|((o, a), b)| *o = a * b));
                    ws.act[*y] = out;
                }
                Op::Concat { a, b, y } => {
                    let mut out = std::mem::take(&mut ws.act[*y]);
                    let (wa, wb) = (self.widths[*a], self.widths[*b]);
                    let sources = ws.act[*a].chunks_exact(wa).zip(ws.act[*b].chunks_exact(wb));
                    for (to, (a, b)) in out.chunks_exact_mut(wa + wb).zip(sources).take(batch) {
                        to[..wa].copy_from_slice(a);
                        to[wa..].copy_from_slice(b);
                    }
                    ws.act[*y] = out;
                }
                Op::Film { x, scale, shift, y, relu } => {
                    let mut out = std::mem::take(&mut ws.act[*y]);
                    let floor = if *relu { 0.0 } else { f32::NEG_INFINITY };
                    let n = batch * self.widths[*y];
                    let (x, scale, shift) = (&ws.act[*x][..n], &ws.act[*scale][..n], &ws.act[*shift][..n]);
                    vectorised!({
                        for (o, ((&x, &s), &t)) in out[..n].iter_mut().zip(x.iter().zip(scale).zip(shift)) {
                            *o = at_least((1.0 + s) * x + t, floor);
                        }
                    });
                    ws.act[*y] = out;
                }
                Op::Standardise { x, y, mean, var, gain, .. } => {
                    let width = self.widths[*x];
                    if !train {
                        ws.stats[i][..width].copy_from_slice(&params[mean.clone()]);
                        ws.stats[i][width..2 * width].copy_from_slice(&params[var.clone()]);
                    }
                    let mut out = std::mem::take(&mut ws.act[*y]);
                    let (mu, rest) = ws.stats[i].split_at_mut(width);
                    let (variance, factor) = rest.split_at_mut(width);
                    vectorised!({
                        for (f, v) in factor.iter_mut().zip(&*variance) {
                            *f = gain / (v + STANDARDISE_EPS).sqrt();
                        }
                        for (o, x) in out.chunks_exact_mut(width).zip(ws.act[*x].chunks_exact(width)).take(batch) {
                            for (((o, &x), &m), &f) in o.iter_mut().zip(x).zip(&*mu).zip(&*factor) {
                                *o = (x - m) * f;
                            }
                        }
                    });
                    ws.act[*y] = out;
                }
                Op::Quantise { x, y, table, one_hot } => {
                    let mut out = std::mem::take(&mut ws.act[*y]);
                    let (width, table) = (self.widths[*x], &params[table.clone()]);
                    let rows = out.chunks_exact_mut(width).zip(ws.act[*x].chunks_exact(width)).take(batch);
                    let codes = &mut ws.codes;
                    for ((o, z), code) in rows.zip(codes) {
                        let k = match one_hot {
                            true => argmax(&z[..table.len() / width]),
                            false => vectorised!(nearest(z, table)),
                        };
                        o.copy_from_slice(&table[k * width..(k + 1) * width]);
                        *code = k as u32;
                    }
                    ws.act[*y] = out;
                }
            }
        }
    }
}

/// `max(value, floor)`, but NaN stays NaN: `f32::max` would turn it into the floor, and a ReLU would hide it from the loss.
#[inline(always)]
pub(super) fn at_least(value: f32, floor: f32) -> f32 {
    if value < floor { floor } else { value }
}

/// Index of the largest value; ties go to the lowest index, and NaN is passed over. Two passes without a branch per number.
pub fn argmax(values: &[f32]) -> usize {
    vectorised!({
        let top = max(values);
        values.iter().position(|&v| v == top).unwrap_or(0)
    })
}

#[inline(always)]
fn nearest(z: &[f32], table: &[f32]) -> usize {
    let mut best = (0, f32::INFINITY);
    for (k, row) in table.chunks_exact(z.len()).enumerate() {
        let distance: f32 = row.iter().zip(z).map(|(a, b)| (a - b) * (a - b)).sum();
        if distance < best.1 {
            best = (k, distance);
        }
    }
    best.0
}
