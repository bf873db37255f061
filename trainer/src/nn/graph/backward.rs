//! The backward pass.

use std::ops::Range;

use super::super::kernel::{Epilogue, Left, Product, Right, product};
use super::super::pack::pack_groups_and_sum;
use super::super::parallel;
use super::super::vector::vectorised;
use super::lookup::look_up_back;
use super::standardise::add_sums;
use super::workspace::Given;
use super::{Graph, Op, Weights, Workspace};

impl Graph {
    /// Back-propagates the gradients that the caller put into outputs with [`Workspace::grad_mut`] after the last forward pass.
    /// Sets the gradient of the graph's parameters in [`Workspace::gradient`] and leaves that of others there as it is. Values
    /// without a gradient count as zero.
    pub fn backward(&self, weights: Weights, ws: &mut Workspace) {
        let batch = ws.batch;
        self.backward_parts(weights, std::slice::from_mut(ws), &[0..batch, batch..batch]);
    }

    /// [`backward`](Self::backward) for the gradients of values alone: those of the parameters are not computed. For a graph
    /// without standardisation.
    ///
    /// # Panics
    /// Where the graph standardises.
    pub fn backward_values(&self, weights: Weights, ws: &mut Workspace) {
        match &weights.packed.on_device {
            Some(flat) => self.backward_on_device(flat, std::slice::from_mut(ws), true),
            None => self.run_back(weights, ws, 0..self.ops.len(), true),
        }
    }

    /// [`backward`](Self::backward) after [`forward_parts`](Self::forward_parts): every part gets the gradient of its own rows.
    pub fn backward_parts(&self, weights: Weights, parts: &mut [Workspace], rows: &[Range<usize>; parallel::PARTS]) {
        if let Some(flat) = &weights.packed.on_device {
            return self.backward_on_device(flat, parts, false);
        }
        let mut end = self.ops.len();
        for start in self.cuts().rev().skip(1).chain([0]) {
            parallel::each(parts, rows, |ws, _| {
                self.run_back(weights, ws, start + usize::from(self.is_standardise(start))..end, false);
                if self.is_standardise(start) {
                    self.standardise_sums(ws, start);
                }
            });
            if self.is_standardise(start) {
                let batch = parts.iter().zip(rows).map(|(_, r)| r.len()).sum::<usize>();
                add_sums(parts, rows, start);
                parallel::each(parts, rows, |ws, _| self.standardise_backward(ws, start, batch));
            }
            end = start;
        }
    }

    /// `frozen` leaves out the gradients of the parameters.
    fn run_back(&self, weights: Weights, ws: &mut Workspace, ops: Range<usize>, frozen: bool) {
        let batch = ws.batch;
        for i in ops.rev() {
            match &self.ops[i] {
                Op::Dense { x, y, w, b, relu, lookup } => {
                    if ws.given[*y] == Given::Nothing {
                        if !frozen {
                            for part in [w, b] {
                                ws.gradient[part.clone()].fill(0.0);
                            }
                        }
                        continue;
                    }
                    let (n, k) = (self.widths[*y], self.widths[*x]);
                    let mut dy = std::mem::take(&mut ws.grad[*y]);
                    let Workspace { act, grad, given, codes, left, right, gradient, .. } = ws;
                    if *relu && given[*y] == Given::Plain {
                        vectorised!(mask_by_sign(&mut dy[..batch * n], &act[*y]));
                    }
                    if !frozen {
                        let rows = &dy[..batch * n];
                        let [c, bias] =
                            gradient.get_disjoint_mut([w.clone(), b.clone()]).expect("weights and biases lie apart");
                        if *lookup {
                            vectorised!(look_up_back(&codes[..batch], rows, k, left, c, bias));
                        } else {
                            vectorised!(pack_groups_and_sum(rows, n, batch, left, bias));
                            let (left, right) = (Left::Groups(left), Right::Rows(&act[*x][..batch * k], right));
                            product(Product { m: n, n: k, k: batch, left, right, c, end: Epilogue::Store });
                        }
                    }
                    if self.needs_grad[*x] {
                        let add = given[*x] != Given::Nothing;
                        let end = match (self.relu[*x], add) {
                            (true, _) => Epilogue::Gated { gate: &act[*x], add },
                            (false, true) => Epilogue::Add,
                            (false, false) => Epilogue::Store,
                        };
                        if !add {
                            given[*x] = if self.relu[*x] { Given::Gated } else { Given::Plain };
                        }
                        let right = Right::Panels(&weights.packed.backward[i]);
                        product(Product { m: batch, n: k, k: n, left: Left::Rows(&dy), right, c: &mut grad[*x], end });
                    }
                    ws.grad[*y] = dy;
                }
                Op::Mul { a, b, y } => {
                    if ws.given[*y] == Given::Nothing {
                        continue;
                    }
                    let n = batch * self.widths[*y];
                    let [mut fa, mut fb] = [*a, *b].map(|slot| Factor {
                        value: std::mem::take(&mut ws.act[slot]),
                        grad: std::mem::take(&mut ws.grad[slot]),
                        floor: if self.relu[slot] { 0.0 } else { f32::NEG_INFINITY },
                        add: ws.given[slot] != Given::Nothing,
                    });
                    vectorised!(multiply_back(&ws.grad[*y][..n], &mut fa, &mut fb));
                    for (slot, factor) in [(*a, fa), (*b, fb)] {
                        (ws.act[slot], ws.grad[slot]) = (factor.value, factor.grad);
                        if ws.given[slot] == Given::Nothing {
                            ws.given[slot] = Given::Gated;
                        }
                    }
                }
                Op::Concat { a, b, y } => {
                    if ws.given[*y] == Given::Nothing {
                        continue;
                    }
                    let dy = std::mem::take(&mut ws.grad[*y]);
                    let width = self.widths[*y];
                    for (slot, from) in [(*a, 0), (*b, self.widths[*a])] {
                        if !self.needs_grad[slot] {
                            continue;
                        }
                        let add = std::mem::replace(&mut ws.given[slot], Given::Plain) != Given::Nothing;
                        let w = self.widths[slot];
                        for (to, dy) in ws.grad[slot].chunks_exact_mut(w).zip(dy.chunks_exact(width)).take(batch) {
                            for (t, g) in to.iter_mut().zip(&dy[from..from + w]) {
                                *t = if add { *t + g } else { *g };
                            }
                        }
                    }
                    ws.grad[*y] = dy;
                }
                Op::Film { x, scale, shift, y, relu } => {
                    if ws.given[*y] == Given::Nothing {
                        continue;
                    }
                    let mut dy = std::mem::take(&mut ws.grad[*y]);
                    if *relu {
                        let n = batch * self.widths[*y];
                        vectorised!(mask_by_sign(&mut dy[..n], &ws.act[*y]));
                    }
                    let (xs, ss) = (std::mem::take(&mut ws.act[*x]), std::mem::take(&mut ws.act[*scale]));
                    ws.accumulate(self, *x, &dy, &ss, |g, s| g * (1.0 + s));
                    ws.accumulate(self, *scale, &dy, &xs, |g, x| g * x);
                    ws.accumulate(self, *shift, &dy, &dy, |g, _| g);
                    (ws.act[*x], ws.act[*scale]) = (xs, ss);
                    ws.grad[*y] = dy;
                }
                Op::Standardise { .. } => unreachable!("the stretches end before standardisations"),
                Op::Quantise { x, y, .. } => {
                    if ws.given[*y] != Given::Nothing {
                        let dy = std::mem::take(&mut ws.grad[*y]);
                        ws.accumulate(self, *x, &dy, &dy, |g, _| g);
                        ws.grad[*y] = dy;
                    }
                }
            }
        }
    }
}

/// Clears the gradient where a ReLU cut its output `out` off.
#[inline(always)]
fn mask_by_sign(grad: &mut [f32], out: &[f32]) {
    for (g, &o) in grad.iter_mut().zip(out) {
        *g = if o > 0.0 { *g } else { 0.0 };
    }
}

/// One side of an element-wise product in the backward pass.
struct Factor {
    value: Vec<f32>,
    grad: Vec<f32>,
    /// Zero where the value is the output of a ReLU: at and below it there is no gradient.
    floor: f32,
    /// Whether `grad` holds something to add to.
    add: bool,
}

impl Factor {
    /// Takes the gradient of one number: `dy` times the other factor.
    #[inline(always)]
    fn take(grad: &mut f32, value: f32, floor: f32, add: bool, gradient: f32) {
        let gradient = if value > floor { gradient } else { 0.0 };
        *grad = if add { *grad + gradient } else { gradient };
    }
}

/// Gradients of both factors of a product from its own, `dy`, in one pass.
#[inline(always)]
fn multiply_back(dy: &[f32], a: &mut Factor, b: &mut Factor) {
    let (floors, adds) = ((a.floor, b.floor), (a.add, b.add));
    let sides = a.grad.iter_mut().zip(&a.value).zip(b.grad.iter_mut().zip(&b.value));
    for (&g, ((da, &x), (db, &w))) in dy.iter().zip(sides) {
        Factor::take(da, x, floors.0, adds.0, g * w);
        Factor::take(db, w, floors.1, adds.1, g * x);
    }
}
