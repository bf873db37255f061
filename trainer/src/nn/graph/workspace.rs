//! What a pass works on: values and gradients, and the weights as the products read them.

use std::ops::Range;

use candle_core::Var;

use super::super::pack::{PANEL, groups_len, pack_panels, pack_panels_transposed, panels_len};
use super::super::parallel::{halves, join};
use super::super::params::Params;
use super::super::vector::vectorised;
use super::candle::{Traced, done};
use super::{Graph, Op, Slot};

impl Graph {
    /// Work memory for up to `batch` rows; `params` is the length of the gradient that [`backward`](Self::backward) makes
    /// there, 0 for a graph that is only evaluated.
    pub fn workspace(&self, batch: usize, params: usize) -> Workspace {
        let train = params > 0;
        let wide = |w: &usize| vec![0.0; w * batch];
        let mut dense = (0, 0);
        let stats = self.ops.iter().map(|op| match op {
            Op::Standardise { x, .. } => vec![0.0; 4 * self.widths[*x]],
            Op::Dense { x, y, lookup, .. } => {
                let (n, k) = (self.widths[*y], self.widths[*x]);
                dense.0 = dense.0.max(if *lookup { n * k } else { groups_len(n, batch) });
                dense.1 = batch * PANEL;
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
            given: vec![Given::Nothing; self.widths.len()],
            stats,
            codes: vec![0; batch],
            left: vec![0.0; if train { dense.0 } else { 0 }],
            right: vec![0.0; if train { dense.1 } else { 0 }],
            gradient: vec![0.0; params],
            traced: None,
            outside: if train { self.outside(params) } else { Vec::new() },
        }
    }

    /// What is left of `0..params` without the parameters of this graph.
    fn outside(&self, params: usize) -> Vec<Range<usize>> {
        let mut own = Vec::new();
        for op in &self.ops {
            if let Op::Dense { w, b, .. } = op {
                own.extend([w.clone(), b.clone()]);
            }
        }
        own.sort_by_key(|range| range.start);
        let starts = own.iter().map(|range| range.start).chain([params]);
        let ends = [0].into_iter().chain(own.iter().map(|range| range.end));
        ends.zip(starts).map(|(end, next)| end..next).filter(|gap| !gap.is_empty()).collect()
    }

    /// Room for the weights of this graph as the products read them; filled by [`refresh`](Self::refresh).
    pub fn packed(&self) -> Packed {
        let none = || vec![Vec::new(); self.ops.len()];
        Packed { version: None, forward: none(), backward: none(), on_device: None }
    }

    /// Brings `packed` up to date with `params`. `train` packs for [`backward`](Self::backward) too.
    pub fn refresh(&self, params: &Params, packed: &mut Packed, train: bool) {
        if packed.version.is_some_and(|(version, for_training)| version == params.version() && for_training >= train) {
            return;
        }
        packed.version = Some((params.version(), train));
        if let Some(device) = &self.device {
            packed.on_device = Some(done(params.with(|p| Var::from_slice(p, p.len(), device))));
            return;
        }
        let Packed { forward, backward, .. } = packed;
        let layers = || {
            self.ops.iter().enumerate().filter_map(|(i, op)| match op {
                Op::Dense { x, y, w, .. } => Some((i, *x, w.clone(), self.widths[*y], self.widths[*x])),
                _ => None,
            })
        };
        params.with(|p| {
            let mut forward = || {
                for (i, _, w, n, k) in layers() {
                    forward[i].resize(panels_len(k, n), 0.0);
                    pack_panels_transposed(&p[w], k, n, &mut forward[i]);
                }
            };
            let mut backward = || {
                for (i, _, w, n, k) in layers().filter(|(_, x, ..)| train && self.needs_grad[*x]) {
                    backward[i].resize(panels_len(n, k), 0.0);
                    pack_panels(&p[w], n, k, &mut backward[i]);
                }
            };
            if halves(p.len()) < p.len() {
                join(forward, backward);
            } else {
                forward();
                backward();
            }
        });
    }
}

/// The weights of a graph in the panels of [`crate::nn::kernel`], for the forward and for the backward pass; or all of them on
/// the device that candle evaluates the graph on.
#[derive(Clone, Debug)]
pub struct Packed {
    /// Of the parameters they were made from; whether for training.
    pub(super) version: Option<(u64, bool)>,
    pub(super) forward: Vec<Vec<f32>>,
    pub(super) backward: Vec<Vec<f32>>,
    pub(super) on_device: Option<Var>,
}

/// Parameters as a pass reads them.
#[derive(Clone, Copy, Debug)]
pub struct Weights<'a> {
    /// The flat vector.
    pub flat: &'a [f32],
    /// The same as the layers read them.
    pub packed: &'a Packed,
}

/// What the gradient of a value holds so far.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Given {
    /// Nothing; it counts as zero.
    Nothing,
    /// Contributions that are zero where the ReLU of the value cut off.
    Gated,
    /// Others too.
    Plain,
}

/// Values, gradients and statistics of one graph; owned by the caller, reused by every update.
#[derive(Clone, Debug)]
pub struct Workspace {
    pub(super) capacity: usize,
    pub(super) batch: usize,
    pub(super) act: Vec<Vec<f32>>,
    pub(super) grad: Vec<Vec<f32>>,
    pub(super) given: Vec<Given>,
    /// Per standardisation: mean, variance, two sums of the backward pass, one number a column each.
    pub(super) stats: Vec<Vec<f32>>,
    pub(super) codes: Vec<u32>,
    pub(super) left: Vec<f32>,
    pub(super) right: Vec<f32>,
    pub(super) gradient: Vec<f32>,
    /// What candle's forward pass leaves for its backward pass.
    pub(super) traced: Option<Traced>,
    /// Parameters that no layer of the graph has: their gradient is added up outside, the others' is set by the backward pass.
    outside: Vec<Range<usize>>,
}

impl Workspace {
    pub(super) fn begin(&mut self, batch: usize) {
        assert!(batch <= self.capacity, "workspace for {} rows, batch of {batch}", self.capacity);
        self.batch = batch;
        self.given.fill(Given::Nothing);
        self.outside.iter().for_each(|range| self.gradient[range.clone()].fill(0.0));
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
        self.given[grad.0] = Given::Plain;
        (&self.act[value.0], &mut self.grad[grad.0])
    }

    /// What a loss on the code positions needs: codes of the last quantisation, positions, their gradient (marked as given:
    /// the loss sets every number of the batch) and the gradient of the parameters.
    pub fn code_loss(&mut self, positions: Slot) -> (&[u32], &[f32], &mut [f32], &mut [f32]) {
        self.given[positions.0] = Given::Plain;
        let Self { codes, act, grad, gradient, batch, .. } = self;
        (&codes[..*batch], &act[positions.0], &mut grad[positions.0], gradient)
    }

    /// The gradient of an output, set to zero and marked as given; the loss then writes (or adds) into it.
    pub fn grad_mut(&mut self, slot: Slot) -> &mut [f32] {
        if std::mem::replace(&mut self.given[slot.0], Given::Plain) == Given::Nothing {
            self.grad[slot.0].fill(0.0);
        }
        &mut self.grad[slot.0]
    }

    /// The memory of a gradient, for a loss over several outputs of a row: to be taken and put back, whole.
    pub fn grad_vec(&mut self, slot: Slot) -> &mut Vec<f32> {
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

    /// The same, for losses and layers outside the graph to add to; the forward pass has set what is theirs to zero.
    pub fn gradient_mut(&mut self) -> &mut [f32] {
        &mut self.gradient
    }

    /// What a layer outside the graph needs that reads `a` and, where given, `b`: both values, the gradients of both (marked as
    /// given: the layer sets every number of the batch) and the gradient of the parameters. Without `b` its slices are empty.
    ///
    /// # Panics
    /// Where `a` and `b` are the same value.
    pub fn outer_layer(&mut self, a: Slot, b: Option<Slot>) -> OuterLayer<'_> {
        let Self { act, grad, given, gradient, .. } = self;
        given[a.0] = Given::Plain;
        let Some(b) = b else {
            return OuterLayer { a: &act[a.0], b: &[], da: &mut grad[a.0], db: &mut [], gradient };
        };
        given[b.0] = Given::Plain;
        let [da, db] = grad.get_disjoint_mut([a.0, b.0]).expect("two different values");
        OuterLayer { a: &act[a.0], b: &act[b.0], da, db, gradient }
    }

    /// Codes chosen by the last quantisation, one a row.
    pub fn codes(&self) -> &[u32] {
        &self.codes[..self.batch]
    }

    pub(super) fn accumulate(
        &mut self,
        graph: &Graph,
        slot: usize,
        dy: &[f32],
        other: &[f32],
        f: impl Fn(f32, f32) -> f32,
    ) {
        if !graph.needs_grad[slot] {
            return;
        }
        let n = self.batch * graph.widths[slot];
        let add = std::mem::replace(&mut self.given[slot], Given::Plain) != Given::Nothing;
        let to = &mut self.grad[slot][..n];
        vectorised!({
            for ((t, &g), &o) in to.iter_mut().zip(dy).zip(other) {
                let value = f(g, o);
                *t = if add { *t + value } else { value };
            }
        });
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
