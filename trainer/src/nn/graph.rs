//! A fixed graph of fused layers with a hand-written backward pass: the one mechanism behind every network of the trainer.
//!
//! A graph is built once, knows where its parameters lie in a flat vector, and runs on a caller-owned [`Workspace`], so an
//! update allocates nothing. The same list of layers is interpreted by candle in [`super::oracle`], whose autograd checks every
//! gradient here.

use std::ops::Range;

use super::gemm::{matmul_nn, matmul_nt, matmul_tn_add};
use super::params::{Init, ParamLayout};

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

    /// Work memory for up to `batch` rows.
    pub fn workspace(&self, batch: usize) -> Workspace {
        let wide = |w: &usize| vec![0.0; w * batch];
        let stats = self.ops.iter().map(|op| match op {
            Op::Standardise { x, .. } => vec![0.0; 2 * self.widths[*x]],
            _ => Vec::new(),
        });
        Workspace {
            capacity: batch,
            batch: 0,
            act: self.widths.iter().map(wide).collect(),
            grad: self
                .widths
                .iter()
                .zip(&self.needs_grad)
                .map(|(w, &g)| if g { wide(w) } else { Vec::new() })
                .collect(),
            written: vec![false; self.widths.len()],
            stats: stats.collect(),
            codes: vec![0; batch],
        }
    }

    /// Computes every value of the first `batch` rows. `train` chooses batch statistics for standardisation.
    ///
    /// # Panics
    /// Where the workspace is smaller than `batch`.
    pub fn forward(&self, params: &[f32], ws: &mut Workspace, batch: usize, train: bool) {
        assert!(batch <= ws.capacity, "workspace for {} rows, batch of {batch}", ws.capacity);
        ws.batch = batch;
        for (i, op) in self.ops.iter().enumerate() {
            match op {
                Op::Dense { x, y, w, b, relu } => {
                    let mut out = std::mem::take(&mut ws.act[*y]);
                    let (n, k) = (self.widths[*y], self.widths[*x]);
                    matmul_nt(batch, n, k, &ws.act[*x], &params[w.clone()], &mut out);
                    add_bias(&mut out[..batch * n], &params[b.clone()], *relu);
                    ws.act[*y] = out;
                }
                Op::Mul { a, b, y } => {
                    let mut out = std::mem::take(&mut ws.act[*y]);
                    for ((o, &a), &b) in out.iter_mut().zip(&ws.act[*a]).zip(&ws.act[*b]) {
                        *o = a * b;
                    }
                    ws.act[*y] = out;
                }
                Op::Film { x, scale, shift, y, relu } => {
                    let mut out = std::mem::take(&mut ws.act[*y]);
                    let floor = if *relu { 0.0 } else { f32::NEG_INFINITY };
                    let inputs = ws.act[*x].iter().zip(&ws.act[*scale]).zip(&ws.act[*shift]);
                    for (o, ((&x, &s), &t)) in out.iter_mut().zip(inputs) {
                        *o = at_least((1.0 + s) * x + t, floor);
                    }
                    ws.act[*y] = out;
                }
                Op::Standardise { x, y, mean, var, gain, .. } => {
                    let width = self.widths[*x];
                    if train {
                        column_statistics(&ws.act[*x], batch, width, &mut ws.stats[i]);
                    } else {
                        ws.stats[i][..width].copy_from_slice(&params[mean.clone()]);
                        ws.stats[i][width..].copy_from_slice(&params[var.clone()]);
                    }
                    let mut out = std::mem::take(&mut ws.act[*y]);
                    let (mu, variance) = ws.stats[i].split_at(width);
                    for (o, x) in out.chunks_exact_mut(width).zip(ws.act[*x].chunks_exact(width)).take(batch) {
                        for (((o, &x), &m), &v) in o.iter_mut().zip(x).zip(mu).zip(variance) {
                            *o = gain * (x - m) / (v + STANDARDISE_EPS).sqrt();
                        }
                    }
                    ws.act[*y] = out;
                }
                Op::Quantise { x, y, table, one_hot } => {
                    let mut out = std::mem::take(&mut ws.act[*y]);
                    let (width, table) = (self.widths[*x], &params[table.clone()]);
                    let rows = out.chunks_exact_mut(width).zip(ws.act[*x].chunks_exact(width)).take(batch);
                    for ((o, z), code) in rows.zip(&mut ws.codes) {
                        let k = if *one_hot { argmax(&z[..table.len() / width]) } else { nearest(z, table) };
                        o.copy_from_slice(&table[k * width..(k + 1) * width]);
                        *code = k as u32;
                    }
                    ws.act[*y] = out;
                }
            }
        }
    }

    /// Clears the gradients of all values; then [`Workspace::grad_mut`] of the outputs is filled by the loss.
    pub fn zero_grad(&self, ws: &mut Workspace) {
        ws.written.fill(false);
    }

    /// Back-propagates the gradients that the caller put into outputs with [`Workspace::grad_mut`], and **adds** the parameter
    /// gradients to `grads` (as long as the trainable part at least). Values without a gradient count as zero.
    pub fn backward(&self, params: &[f32], ws: &mut Workspace, grads: &mut [f32]) {
        let batch = ws.batch;
        for (i, op) in self.ops.iter().enumerate().rev() {
            match op {
                Op::Dense { x, y, w, b, relu } => {
                    if !ws.written[*y] {
                        continue;
                    }
                    let (n, k) = (self.widths[*y], self.widths[*x]);
                    let mut dy = std::mem::take(&mut ws.grad[*y]);
                    if *relu {
                        mask_by_sign(&mut dy[..batch * n], &ws.act[*y]);
                    }
                    matmul_tn_add(n, k, batch, &dy, &ws.act[*x], &mut grads[w.clone()]);
                    add_column_sums(&dy[..batch * n], &mut grads[b.clone()]);
                    if self.needs_grad[*x] {
                        let accumulate = std::mem::replace(&mut ws.written[*x], true);
                        matmul_nn(batch, k, n, &dy, &params[w.clone()], &mut ws.grad[*x], accumulate);
                    }
                    ws.grad[*y] = dy;
                }
                Op::Mul { a, b, y } => {
                    if !ws.written[*y] {
                        continue;
                    }
                    let dy = std::mem::take(&mut ws.grad[*y]);
                    for (to, other) in [(*a, *b), (*b, *a)] {
                        let other = std::mem::take(&mut ws.act[other]);
                        ws.accumulate(self, to, dy.iter().zip(&other).map(|(g, o)| g * o));
                        ws.act[if to == *a { *b } else { *a }] = other;
                    }
                    ws.grad[*y] = dy;
                }
                Op::Film { x, scale, shift, y, relu } => {
                    if !ws.written[*y] {
                        continue;
                    }
                    let mut dy = std::mem::take(&mut ws.grad[*y]);
                    if *relu {
                        mask_by_sign(&mut dy, &ws.act[*y]);
                    }
                    let (xs, ss) = (std::mem::take(&mut ws.act[*x]), std::mem::take(&mut ws.act[*scale]));
                    ws.accumulate(self, *x, dy.iter().zip(&ss).map(|(g, s)| g * (1.0 + s)));
                    ws.accumulate(self, *scale, dy.iter().zip(&xs).map(|(g, x)| g * x));
                    ws.accumulate(self, *shift, dy.iter().copied());
                    (ws.act[*x], ws.act[*scale]) = (xs, ss);
                    ws.grad[*y] = dy;
                }
                Op::Standardise { x, y, gain, .. } => {
                    if ws.written[*y] && self.needs_grad[*x] {
                        self.standardise_backward(ws, i, *x, *y, *gain);
                    }
                }
                Op::Quantise { x, y, .. } => {
                    if ws.written[*y] {
                        let dy = std::mem::take(&mut ws.grad[*y]);
                        ws.accumulate(self, *x, dy.iter().copied());
                        ws.grad[*y] = dy;
                    }
                }
            }
        }
    }

    /// `dx = gain / σ (dy - mean(dy) - x̂ mean(dy x̂))`. Source: Ioffe & Szegedy 2015, section 3, without affine parameters.
    fn standardise_backward(&self, ws: &mut Workspace, op: usize, x: usize, y: usize, gain: f32) {
        let (width, batch) = (self.widths[x], ws.batch);
        let dy = std::mem::take(&mut ws.grad[y]);
        let out = std::mem::take(&mut ws.act[y]);
        let variance = &ws.stats[op][width..];
        let mut mean_dy = vec![0.0_f32; width];
        let mut mean_dy_hat = vec![0.0_f32; width];
        for (g, o) in dy.chunks_exact(width).zip(out.chunks_exact(width)).take(batch) {
            for (((m, h), &g), &o) in mean_dy.iter_mut().zip(&mut mean_dy_hat).zip(g).zip(o) {
                *m += g / batch as f32;
                *h += g * (o / gain) / batch as f32;
            }
        }
        let inverse: Vec<f32> = variance.iter().map(|v| gain / (v + STANDARDISE_EPS).sqrt()).collect();
        let values = dy.iter().zip(&out).enumerate().map(|(i, (&g, &o))| {
            let c = i % width;
            inverse[c] * (g - mean_dy[c] - (o / gain) * mean_dy_hat[c])
        });
        ws.accumulate(self, x, values.take(batch * width));
        ws.grad[y] = dy;
        ws.act[y] = out;
    }

    /// Moves the running statistics of every standardisation towards those of the last training batch (unbiased variance).
    pub fn update_running_statistics(&self, params: &mut [f32], ws: &Workspace) {
        let unbias = ws.batch as f32 / (ws.batch.max(2) - 1) as f32;
        for (i, op) in self.ops.iter().enumerate() {
            if let Op::Standardise { x, mean, var, momentum, .. } = op {
                let (mu, variance) = ws.stats[i].split_at(self.widths[*x]);
                params[mean.clone()].iter_mut().zip(mu).for_each(|(p, m)| *p += momentum * (m - *p));
                params[var.clone()].iter_mut().zip(variance).for_each(|(p, v)| *p += momentum * (v * unbias - *p));
            }
        }
    }
}

/// Values, gradients and statistics of one graph; owned by the caller, reused by every update.
#[derive(Clone, Debug)]
pub struct Workspace {
    capacity: usize,
    batch: usize,
    act: Vec<Vec<f32>>,
    grad: Vec<Vec<f32>>,
    written: Vec<bool>,
    stats: Vec<Vec<f32>>,
    codes: Vec<u32>,
}

impl Workspace {
    /// A value, row-major; the first `batch * width` numbers count.
    pub fn value(&self, slot: Slot) -> &[f32] {
        &self.act[slot.0]
    }

    /// An input, to be filled.
    pub fn value_mut(&mut self, slot: Slot) -> &mut [f32] {
        &mut self.act[slot.0]
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

    /// Codes chosen by the last quantisation, one a row.
    pub fn codes(&self) -> &[u32] {
        &self.codes[..self.batch]
    }

    fn accumulate(&mut self, graph: &Graph, slot: usize, values: impl Iterator<Item = f32>) {
        if !graph.needs_grad[slot] {
            return;
        }
        let n = self.batch * graph.widths[slot];
        let to = &mut self.grad[slot][..n];
        if std::mem::replace(&mut self.written[slot], true) {
            to.iter_mut().zip(values).for_each(|(t, v)| *t += v);
        } else {
            to.iter_mut().zip(values).for_each(|(t, v)| *t = v);
        }
    }
}

/// `max(value, floor)`, but NaN stays NaN: `f32::max` would turn it into the floor, and a ReLU would hide it from the loss.
fn at_least(value: f32, floor: f32) -> f32 {
    if value < floor { floor } else { value }
}

fn add_bias(out: &mut [f32], bias: &[f32], relu: bool) {
    let floor = if relu { 0.0 } else { f32::NEG_INFINITY };
    for row in out.chunks_exact_mut(bias.len()) {
        for (o, b) in row.iter_mut().zip(bias) {
            *o = at_least(*o + b, floor);
        }
    }
}

fn mask_by_sign(grad: &mut [f32], out: &[f32]) {
    for (g, &o) in grad.iter_mut().zip(out) {
        *g = if o > 0.0 { *g } else { 0.0 };
    }
}

fn add_column_sums(matrix: &[f32], sums: &mut [f32]) {
    for row in matrix.chunks_exact(sums.len()) {
        for (s, v) in sums.iter_mut().zip(row) {
            *s += v;
        }
    }
}

/// Mean and biased variance of each column into `[mean…, var…]`, in two passes.
fn column_statistics(matrix: &[f32], batch: usize, width: usize, stats: &mut [f32]) {
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
