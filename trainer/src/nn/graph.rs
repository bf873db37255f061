//! A fixed graph of fused layers with a hand-written backward pass: the one mechanism behind every network of the trainer.
//!
//! A graph is built once, knows where its parameters lie in a flat vector, and runs on a caller-owned [`Workspace`], so an
//! update allocates nothing. The same list of layers is interpreted by candle in [`super::oracle`], whose autograd checks every
//! gradient here.

use std::ops::Range;

use super::kernel::{
    Epilogue, Left, Product, groups_len, pack_groups, pack_panels, pack_panels_transposed, panels_len, product,
};
use super::parallel;
use super::params::{Init, ParamLayout, Params};
use super::vector::vectorised;

/// A value of the graph: a matrix `batch x width`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Slot(pub(super) usize);

/// Stability constant of the standardisation, as in PyTorch's batch normalisation.
pub const STANDARDISE_EPS: f32 = 1e-5;

#[derive(Clone, Debug)]
pub(super) enum Op {
    /// `y = x Wᵀ + b`, then ReLU where `relu`.
    Dense { x: usize, y: usize, w: Range<usize>, b: Range<usize>, relu: bool },
    /// `y = a ⊙ b`.
    Mul { a: usize, b: usize, y: usize },
    /// `y = (1 + scale) ⊙ x + shift`, then ReLU where `relu`.
    Film { x: usize, scale: usize, shift: usize, y: usize, relu: bool },
    /// `y = gain (x - mean) / sqrt(var + eps)` per column, over the batch in training and with running statistics else.
    Standardise { x: usize, y: usize, mean: Range<usize>, var: Range<usize>, gain: f32, momentum: f32 },
    /// `y = V[k]`, `k = argmin ‖x - V[k]‖` (ties: lowest); the gradient passes straight through.
    Quantise { x: usize, y: usize, table: Range<usize>, one_hot: bool },
}

/// The layers of a model, in order of computation.
#[derive(Clone, Debug, Default)]
pub struct Graph {
    pub(super) widths: Vec<usize>,
    pub(super) needs_grad: Vec<bool>,
    pub(super) ops: Vec<Op>,
}

/// Names of the parts a dense layer adds to a layout: `<name>.weight` (out x in) and `<name>.bias` (out).
pub fn declare_dense(layout: &mut ParamLayout, name: &str, inputs: usize, outputs: usize, init: Init) -> DenseParams {
    let w = layout.param(&format!("{name}.weight"), &[outputs, inputs], init);
    let b = layout.param(&format!("{name}.bias"), &[outputs], init);
    DenseParams { inputs, outputs, w, b }
}

/// Where a dense layer's parameters lie.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DenseParams {
    /// Input width.
    pub inputs: usize,
    /// Output width.
    pub outputs: usize,
    /// Weights, `outputs x inputs` row-major.
    pub w: Range<usize>,
    /// Biases.
    pub b: Range<usize>,
}

impl Graph {
    /// An empty graph.
    pub fn new() -> Self {
        Self::default()
    }

    fn slot(&mut self, width: usize, needs_grad: bool) -> Slot {
        self.widths.push(width);
        self.needs_grad.push(needs_grad);
        Slot(self.widths.len() - 1)
    }

    /// An input of that width; no gradient is computed for it.
    pub fn input(&mut self, width: usize) -> Slot {
        self.slot(width, false)
    }

    /// An input whose gradient is computed too, for a loss that another network carries on (actor and critic).
    pub fn input_with_gradient(&mut self, width: usize) -> Slot {
        self.slot(width, true)
    }

    /// A dense layer, with ReLU where `relu`.
    ///
    /// # Panics
    /// Where the width of `x` is not the layer's input width.
    pub fn dense(&mut self, x: Slot, layer: &DenseParams, relu: bool) -> Slot {
        assert_eq!(self.widths[x.0], layer.inputs, "dense layer: input width");
        let y = self.slot(layer.outputs, true);
        self.ops.push(Op::Dense { x: x.0, y: y.0, w: layer.w.clone(), b: layer.b.clone(), relu });
        y
    }

    /// Element-wise product.
    ///
    /// # Panics
    /// Where the widths differ.
    pub fn mul(&mut self, a: Slot, b: Slot) -> Slot {
        assert_eq!(self.widths[a.0], self.widths[b.0], "product: widths");
        let y = self.slot(self.widths[a.0], true);
        self.ops.push(Op::Mul { a: a.0, b: b.0, y: y.0 });
        y
    }

    /// Feature-wise linear modulation `(1 + scale) ⊙ x + shift`, with ReLU where `relu`.
    /// Source: Perez et al. 2018, eq. 2, with the scale written around one.
    ///
    /// # Panics
    /// Where the widths differ.
    pub fn film(&mut self, x: Slot, scale: Slot, shift: Slot, relu: bool) -> Slot {
        assert!(
            self.widths[x.0] == self.widths[scale.0] && self.widths[x.0] == self.widths[shift.0],
            "modulation: widths"
        );
        let y = self.slot(self.widths[x.0], true);
        self.ops.push(Op::Film { x: x.0, scale: scale.0, shift: shift.0, y: y.0, relu });
        y
    }

    /// Standardisation per column, with running statistics at `mean` and `var`.
    pub fn standardise(&mut self, x: Slot, mean: Range<usize>, var: Range<usize>, gain: f32, momentum: f32) -> Slot {
        let y = self.slot(self.widths[x.0], true);
        self.ops.push(Op::Standardise { x: x.0, y: y.0, mean, var, gain, momentum });
        y
    }

    /// Nearest row of the table (`codes x width of x`, row-major) with a straight-through gradient.
    /// `one_hot` promises that row `k` is the `k`-th unit vector: the search is then an argmax of the first coordinates.
    pub fn quantise(&mut self, x: Slot, table: Range<usize>, one_hot: bool) -> Slot {
        let y = self.slot(self.widths[x.0], true);
        self.ops.push(Op::Quantise { x: x.0, y: y.0, table, one_hot });
        y
    }

    /// Work memory for up to `batch` rows; `params` is the length of the gradient that [`backward`](Self::backward) makes
    /// there, 0 for a graph that is only evaluated.
    pub fn workspace(&self, batch: usize, params: usize) -> Workspace {
        let train = params > 0;
        let wide = |w: &usize| vec![0.0; w * batch];
        let mut dense = (0, 0);
        let stats = self.ops.iter().map(|op| match op {
            Op::Standardise { x, .. } => vec![0.0; 4 * self.widths[*x]],
            Op::Dense { x, y, .. } => {
                dense.0 = dense.0.max(groups_len(self.widths[*y], batch));
                dense.1 = dense.1.max(panels_len(batch, self.widths[*x]));
                Vec::new()
            }
            _ => Vec::new(),
        });
        let stats = stats.collect();
        Workspace {
            capacity: batch,
            batch: 0,
            act: self.widths.iter().map(wide).collect(),
            grad: self
                .widths
                .iter()
                .zip(&self.needs_grad)
                .map(|(w, &g)| if g && train { wide(w) } else { Vec::new() })
                .collect(),
            written: vec![false; self.widths.len()],
            stats,
            codes: vec![0; batch],
            left: vec![0.0; if train { dense.0 } else { 0 }],
            right: vec![0.0; if train { dense.1 } else { 0 }],
            gradient: vec![0.0; params],
        }
    }

    /// Room for the weights of this graph as the products read them; filled by [`refresh`](Self::refresh).
    pub fn packed(&self) -> Packed {
        Packed { version: None, ops: vec![(Vec::new(), Vec::new()); self.ops.len()] }
    }

    /// Brings `packed` up to date with `params`. `train` packs for [`backward`](Self::backward) too.
    pub fn refresh(&self, params: &Params, packed: &mut Packed, train: bool) {
        if packed.version.is_some_and(|(version, for_training)| version == params.version() && for_training >= train) {
            return;
        }
        packed.version = Some((params.version(), train));
        params.with(|p| {
            for (op, (forward, backward)) in self.ops.iter().zip(&mut packed.ops) {
                if let Op::Dense { x, y, w, .. } = op {
                    let (n, k) = (self.widths[*y], self.widths[*x]);
                    forward.resize(panels_len(k, n), 0.0);
                    pack_panels_transposed(&p[w.clone()], k, n, forward);
                    if train && self.needs_grad[*x] {
                        backward.resize(panels_len(n, k), 0.0);
                        pack_panels(&p[w.clone()], n, k, backward);
                    }
                }
            }
        });
    }

    /// Computes every value of the first `batch` rows. `train` chooses batch statistics for standardisation.
    ///
    /// # Panics
    /// Where the workspace is smaller than `batch`.
    pub fn forward(&self, weights: Weights, ws: &mut Workspace, batch: usize, train: bool) {
        if train {
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
                    vectorised(column_statistics, (&act[*x], batch, width, &mut stats[end][..2 * width]));
                }
            });
            if let Some(Op::Standardise { x, .. }) = self.ops.get(end) {
                combine_statistics(parts, rows, end, self.widths[*x]);
            }
            start = end;
        }
    }

    /// Ends of the stretches between standardisations: every part must reach a cut before any goes on.
    fn cuts(&self) -> impl DoubleEndedIterator<Item = usize> {
        let is_cut = |i: &usize| self.ops.get(*i).is_none_or(|op| matches!(op, Op::Standardise { .. }));
        (0..=self.ops.len()).filter(is_cut)
    }

    fn run(&self, weights: Weights, ws: &mut Workspace, ops: Range<usize>, train: bool) {
        let params = weights.flat;
        let batch = ws.batch;
        for i in ops {
            match &self.ops[i] {
                Op::Dense { x, y, b, relu, .. } => {
                    let mut out = std::mem::take(&mut ws.act[*y]);
                    product(Product {
                        m: batch,
                        n: self.widths[*y],
                        k: self.widths[*x],
                        left: Left::Rows(&ws.act[*x]),
                        right: &weights.packed.ops[i].0,
                        c: &mut out,
                        end: Epilogue::Bias(&params[b.clone()], *relu),
                    });
                    ws.act[*y] = out;
                }
                Op::Mul { a, b, y } => {
                    let mut out = std::mem::take(&mut ws.act[*y]);
                    let n = batch * self.widths[*y];
                    let (a, b) = (&ws.act[*a][..n], &ws.act[*b][..n]);
                    vectorised(|()| out[..n].iter_mut().zip(a).zip(b).for_each(|((o, a), b)| *o = a * b), ());
                    ws.act[*y] = out;
                }
                Op::Film { x, scale, shift, y, relu } => {
                    let mut out = std::mem::take(&mut ws.act[*y]);
                    let floor = if *relu { 0.0 } else { f32::NEG_INFINITY };
                    let n = batch * self.widths[*y];
                    let (x, scale, shift) = (&ws.act[*x][..n], &ws.act[*scale][..n], &ws.act[*shift][..n]);
                    vectorised(
                        |()| {
                            for (o, ((&x, &s), &t)) in out[..n].iter_mut().zip(x.iter().zip(scale).zip(shift)) {
                                *o = at_least((1.0 + s) * x + t, floor);
                            }
                        },
                        (),
                    );
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
                    vectorised(
                        |()| {
                            for (f, v) in factor.iter_mut().zip(&*variance) {
                                *f = gain / (v + STANDARDISE_EPS).sqrt();
                            }
                            for (o, x) in out.chunks_exact_mut(width).zip(ws.act[*x].chunks_exact(width)).take(batch) {
                                for (((o, &x), &m), &f) in o.iter_mut().zip(x).zip(&*mu).zip(&*factor) {
                                    *o = (x - m) * f;
                                }
                            }
                        },
                        (),
                    );
                    ws.act[*y] = out;
                }
                Op::Quantise { x, y, table, one_hot } => {
                    let mut out = std::mem::take(&mut ws.act[*y]);
                    let (width, table) = (self.widths[*x], &params[table.clone()]);
                    let rows = out.chunks_exact_mut(width).zip(ws.act[*x].chunks_exact(width)).take(batch);
                    let codes = &mut ws.codes;
                    for ((o, z), code) in rows.zip(codes) {
                        let k = match one_hot {
                            true => vectorised(argmax_fast, &z[..table.len() / width]),
                            false => vectorised(nearest, (z, table)),
                        };
                        o.copy_from_slice(&table[k * width..(k + 1) * width]);
                        *code = k as u32;
                    }
                    ws.act[*y] = out;
                }
            }
        }
    }

    /// Back-propagates the gradients that the caller put into outputs with [`Workspace::grad_mut`] after the last forward pass.
    /// The parameter gradients are **added** to [`Workspace::gradient`], which the forward pass had set to zero. Values without
    /// a gradient count as zero.
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
        self.run_back(weights, ws, 0..self.ops.len(), true);
    }

    /// [`backward`](Self::backward) after [`forward_parts`](Self::forward_parts): every part gets the gradient of its own rows.
    pub fn backward_parts(&self, weights: Weights, parts: &mut [Workspace], rows: &[Range<usize>; parallel::PARTS]) {
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

    fn is_standardise(&self, op: usize) -> bool {
        matches!(self.ops.get(op), Some(Op::Standardise { .. }))
    }

    /// `frozen` leaves out the gradients of the parameters.
    fn run_back(&self, weights: Weights, ws: &mut Workspace, ops: Range<usize>, frozen: bool) {
        let batch = ws.batch;
        for i in ops.rev() {
            match &self.ops[i] {
                Op::Dense { x, y, w, b, relu } => {
                    if !ws.written[*y] {
                        continue;
                    }
                    let (n, k) = (self.widths[*y], self.widths[*x]);
                    let mut dy = std::mem::take(&mut ws.grad[*y]);
                    let Workspace { act, grad, written, left, right, gradient, .. } = ws;
                    if frozen {
                        if *relu {
                            vectorised(|()| mask_by_sign(&mut dy[..batch * n], &act[*y]), ());
                        }
                    } else {
                        let bias = &mut gradient[b.clone()];
                        vectorised(mask_and_sum, (&mut dy[..batch * n], relu.then(|| act[*y].as_slice()), bias));
                        pack_groups(&dy[..batch * n], n, batch, left);
                        pack_panels(&act[*x][..batch * k], batch, k, right);
                        let c = &mut gradient[w.clone()];
                        let left = Left::Groups(left);
                        product(Product { m: n, n: k, k: batch, left, right, c, end: Epilogue::Add });
                    }
                    if self.needs_grad[*x] {
                        let accumulate = std::mem::replace(&mut written[*x], true);
                        product(Product {
                            m: batch,
                            n: k,
                            k: n,
                            left: Left::Rows(&dy),
                            right: &weights.packed.ops[i].1,
                            c: &mut grad[*x],
                            end: if accumulate { Epilogue::Add } else { Epilogue::Store },
                        });
                    }
                    ws.grad[*y] = dy;
                }
                Op::Mul { a, b, y } => {
                    if !ws.written[*y] {
                        continue;
                    }
                    let dy = std::mem::take(&mut ws.grad[*y]);
                    for (to, other) in [(*a, *b), (*b, *a)] {
                        let values = std::mem::take(&mut ws.act[other]);
                        ws.accumulate(self, to, &dy, &values, |g, o| g * o);
                        ws.act[other] = values;
                    }
                    ws.grad[*y] = dy;
                }
                Op::Film { x, scale, shift, y, relu } => {
                    if !ws.written[*y] {
                        continue;
                    }
                    let mut dy = std::mem::take(&mut ws.grad[*y]);
                    if *relu {
                        let n = batch * self.widths[*y];
                        vectorised(|()| mask_by_sign(&mut dy[..n], &ws.act[*y]), ());
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
                    if ws.written[*y] {
                        let dy = std::mem::take(&mut ws.grad[*y]);
                        ws.accumulate(self, *x, &dy, &dy, |g, _| g);
                        ws.grad[*y] = dy;
                    }
                }
            }
        }
    }

    /// Column sums of `dy` and `dy ⊙ x̂` over the rows of one part, behind mean and variance in its statistics.
    fn standardise_sums(&self, ws: &mut Workspace, op: usize) {
        let Op::Standardise { x, y, gain, .. } = &self.ops[op] else { return };
        let (width, batch) = (self.widths[*x], ws.batch);
        let Workspace { act, grad, stats, written, .. } = ws;
        let (sum, product) = stats[op][2 * width..].split_at_mut(width);
        sum.fill(0.0);
        product.fill(0.0);
        if !written[*y] {
            return;
        }
        vectorised(
            |()| {
                for (g, o) in grad[*y].chunks_exact(width).zip(act[*y].chunks_exact(width)).take(batch) {
                    for (((m, h), &g), &o) in sum.iter_mut().zip(&mut *product).zip(g).zip(o) {
                        *m += g;
                        *h += g * o;
                    }
                }
                for p in &mut *product {
                    *p /= gain;
                }
            },
            (),
        );
    }

    /// `dx = gain / σ (dy - mean(dy) - x̂ mean(dy x̂))` with the means over the `batch` rows of all parts.
    /// Source: Ioffe & Szegedy 2015, section 3, without affine parameters.
    fn standardise_backward(&self, ws: &mut Workspace, op: usize, batch: usize) {
        let Op::Standardise { x, y, gain, .. } = &self.ops[op] else { return };
        if !ws.written[*y] || !self.needs_grad[*x] {
            return;
        }
        let (width, rows) = (self.widths[*x], ws.batch);
        let accumulate = std::mem::replace(&mut ws.written[*x], true);
        let dy = std::mem::take(&mut ws.grad[*y]);
        let Workspace { act, grad, stats, .. } = ws;
        let (stats, sums) = stats[op][width..].split_at_mut(width);
        let (sum, product) = sums.split_at_mut(width);
        vectorised(
            |()| {
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
            },
            (),
        );
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

/// The weights of a graph in the panels of [`super::kernel`], one pair (forward, backward) per layer.
#[derive(Clone, Debug)]
pub struct Packed {
    /// Of the parameters they were made from; whether for training.
    version: Option<(u64, bool)>,
    ops: Vec<(Vec<f32>, Vec<f32>)>,
}

/// Parameters as a pass reads them.
#[derive(Clone, Copy, Debug)]
pub struct Weights<'a> {
    /// The flat vector.
    pub flat: &'a [f32],
    /// The same in panels.
    pub packed: &'a Packed,
}

/// Values, gradients and statistics of one graph; owned by the caller, reused by every update.
#[derive(Clone, Debug)]
pub struct Workspace {
    capacity: usize,
    batch: usize,
    act: Vec<Vec<f32>>,
    grad: Vec<Vec<f32>>,
    written: Vec<bool>,
    /// Per standardisation: mean, variance, two sums of the backward pass, one number a column each.
    stats: Vec<Vec<f32>>,
    codes: Vec<u32>,
    left: Vec<f32>,
    right: Vec<f32>,
    gradient: Vec<f32>,
}

impl Workspace {
    fn begin(&mut self, batch: usize) {
        assert!(batch <= self.capacity, "workspace for {} rows, batch of {batch}", self.capacity);
        self.batch = batch;
        self.written.fill(false);
        self.gradient.fill(0.0);
    }

    /// Rows of the last pass.
    pub fn rows(&self) -> usize {
        self.batch
    }

    /// A value, row-major; the first `batch * width` numbers count.
    pub fn value(&self, slot: Slot) -> &[f32] {
        &self.act[slot.0]
    }

    /// An input, to be filled.
    pub fn value_mut(&mut self, slot: Slot) -> &mut [f32] {
        &mut self.act[slot.0]
    }

    /// A value with the gradient of the same or another value, marked as given: the loss sets every number of the batch.
    pub fn value_and_grad(&mut self, value: Slot, grad: Slot) -> (&[f32], &mut [f32]) {
        self.written[grad.0] = true;
        (&self.act[value.0], &mut self.grad[grad.0])
    }

    /// What a loss on the code positions needs: codes of the last quantisation, positions, their gradient (marked as given:
    /// the loss sets every number of the batch) and the gradient of the parameters.
    pub fn code_loss(&mut self, positions: Slot) -> (&[u32], &[f32], &mut [f32], &mut [f32]) {
        self.written[positions.0] = true;
        let Self { codes, act, grad, gradient, batch, .. } = self;
        (&codes[..*batch], &act[positions.0], &mut grad[positions.0], gradient)
    }

    /// The gradient of an output, set to zero and marked as given; the loss then writes (or adds) into it.
    pub fn grad_mut(&mut self, slot: Slot) -> &mut [f32] {
        if !std::mem::replace(&mut self.written[slot.0], true) {
            self.grad[slot.0].fill(0.0);
        }
        &mut self.grad[slot.0]
    }

    /// Gradient of a value after [`Graph::backward`].
    pub fn grad(&self, slot: Slot) -> &[f32] {
        &self.grad[slot.0]
    }

    /// Gradient of the parameters, of this workspace's rows.
    pub fn gradient(&self) -> &[f32] {
        &self.gradient
    }

    /// The same, for losses and layers outside the graph to add to.
    pub fn gradient_mut(&mut self) -> &mut [f32] {
        &mut self.gradient
    }

    /// What a layer outside the graph needs that reads `a` and, where given, `b`: both values, the gradients of both (marked as
    /// given: the layer sets every number of the batch) and the gradient of the parameters. Without `b` its slices are empty.
    ///
    /// # Panics
    /// Where `a` and `b` are the same value.
    pub fn outer_layer(&mut self, a: Slot, b: Option<Slot>) -> OuterLayer<'_> {
        let Self { act, grad, written, gradient, .. } = self;
        written[a.0] = true;
        let Some(b) = b else {
            return OuterLayer { a: &act[a.0], b: &[], da: &mut grad[a.0], db: &mut [], gradient };
        };
        written[b.0] = true;
        let [da, db] = grad.get_disjoint_mut([a.0, b.0]).expect("two different values");
        OuterLayer { a: &act[a.0], b: &act[b.0], da, db, gradient }
    }

    /// Codes chosen by the last quantisation, one a row.
    pub fn codes(&self) -> &[u32] {
        &self.codes[..self.batch]
    }

    fn accumulate(&mut self, graph: &Graph, slot: usize, dy: &[f32], other: &[f32], f: impl Fn(f32, f32) -> f32) {
        if !graph.needs_grad[slot] {
            return;
        }
        let n = self.batch * graph.widths[slot];
        let add = std::mem::replace(&mut self.written[slot], true);
        let to = &mut self.grad[slot][..n];
        vectorised(
            |()| {
                for ((t, &g), &o) in to.iter_mut().zip(dy).zip(other) {
                    let value = f(g, o);
                    *t = if add { *t + value } else { value };
                }
            },
            (),
        );
    }
}

/// See [`Workspace::outer_layer`].
#[derive(Debug)]
pub struct OuterLayer<'a> {
    /// First value.
    pub a: &'a [f32],
    /// Second value.
    pub b: &'a [f32],
    /// Gradient of the first.
    pub da: &'a mut [f32],
    /// Gradient of the second.
    pub db: &'a mut [f32],
    /// Gradient of the parameters.
    pub gradient: &'a mut [f32],
}

/// `max(value, floor)`, but NaN stays NaN: `f32::max` would turn it into the floor, and a ReLU would hide it from the loss.
#[inline(always)]
fn at_least(value: f32, floor: f32) -> f32 {
    if value < floor { floor } else { value }
}

#[inline(always)]
fn mask_by_sign(grad: &mut [f32], out: &[f32]) {
    for (g, &o) in grad.iter_mut().zip(out) {
        *g = if o > 0.0 { *g } else { 0.0 };
    }
}

/// Clears the gradient where a ReLU cut its output `out` off, and adds its column sums to `sums`.
#[inline(always)]
fn mask_and_sum((grad, out, sums): (&mut [f32], Option<&[f32]>, &mut [f32])) {
    let width = sums.len();
    match out {
        Some(out) => {
            for (g, o) in grad.chunks_exact_mut(width).zip(out.chunks_exact(width)) {
                for ((g, &o), s) in g.iter_mut().zip(o).zip(&mut *sums) {
                    *g = if o > 0.0 { *g } else { 0.0 };
                    *s += *g;
                }
            }
        }
        None => {
            for row in grad.chunks_exact(width) {
                sums.iter_mut().zip(row).for_each(|(s, v)| *s += v);
            }
        }
    }
}

/// Mean and biased variance of each column into `[mean…, var…]`, in two passes.
#[inline(always)]
fn column_statistics((matrix, batch, width, stats): (&[f32], usize, usize, &mut [f32])) {
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
fn combine_statistics(parts: &mut [Workspace], rows: &[Range<usize>; parallel::PARTS], op: usize, width: usize) {
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
fn add_sums(parts: &mut [Workspace], rows: &[Range<usize>; parallel::PARTS], op: usize) {
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

/// Index of the largest value; ties go to the lowest index.
pub fn argmax(values: &[f32]) -> usize {
    let mut best = 0;
    for (i, v) in values.iter().enumerate() {
        if *v > values[best] {
            best = i;
        }
    }
    best
}

/// [`argmax`] in two passes without a branch per number.
#[inline(always)]
fn argmax_fast(values: &[f32]) -> usize {
    let top = super::vector::max(values);
    values.iter().position(|&v| v == top).unwrap_or(0)
}

#[inline(always)]
fn nearest((z, table): (&[f32], &[f32])) -> usize {
    let mut best = (0, f32::INFINITY);
    for (k, row) in table.chunks_exact(z.len()).enumerate() {
        let distance: f32 = row.iter().zip(z).map(|(a, b)| (a - b) * (a - b)).sum();
        if distance < best.1 {
            best = (k, distance);
        }
    }
    best.0
}
