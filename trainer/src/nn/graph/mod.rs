//! A fixed graph of fused layers with a hand-written backward pass: the one mechanism behind every network of the trainer.
//!
//! A graph is built once, knows where its parameters lie in a flat vector, and runs on a caller-owned [`Workspace`], so an
//! update allocates nothing. The same list of layers is interpreted by candle in `candle.rs`: on a device of its own where one
//! was chosen ([`Engine`](super::device::Engine)), and in the tests, where its autograd checks every gradient here.

use std::ops::Range;

use candle_core::Device;

use super::device;
use super::params::{Init, ParamLayout};

mod backward;
mod candle;
mod forward;
mod lookup;
mod standardise;
mod workspace;

pub use forward::argmax;
pub use workspace::{OuterLayer, Packed, Weights, Workspace};

/// A value of the graph: a matrix `batch x width`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Slot(pub(super) usize);

/// Stability constant of the standardisation, as in PyTorch's batch normalisation.
pub const STANDARDISE_EPS: f32 = 1e-5;

#[derive(Clone, Debug)]
pub(super) enum Op {
    /// `y = x Wᵀ + b`, then ReLU where `relu`. With `lookup`, `x` holds the unit vectors of the codes that a quantisation chose.
    Dense { x: usize, y: usize, w: Range<usize>, b: Range<usize>, relu: bool, lookup: bool },
    /// `y = a ⊙ b`.
    Mul { a: usize, b: usize, y: usize },
    /// `y = [a | b]`, row by row.
    Concat { a: usize, b: usize, y: usize },
    /// `y = (1 + scale) ⊙ x + shift`, then ReLU where `relu`.
    Film { x: usize, scale: usize, shift: usize, y: usize, relu: bool },
    /// `y = gain (x - mean) / sqrt(var + eps)` per column, over the batch in training and with running statistics else.
    Standardise { x: usize, y: usize, mean: Range<usize>, var: Range<usize>, gain: f32, momentum: f32 },
    /// `y = V[k]`, `k = argmin ‖x - V[k]‖` (ties: lowest); the gradient passes straight through.
    Quantise { x: usize, y: usize, table: Range<usize>, one_hot: bool },
}

impl Op {
    fn output(&self) -> usize {
        match self {
            Self::Dense { y, .. }
            | Self::Mul { y, .. }
            | Self::Concat { y, .. }
            | Self::Film { y, .. }
            | Self::Standardise { y, .. }
            | Self::Quantise { y, .. } => *y,
        }
    }

    fn reads(&self, slot: usize) -> bool {
        match self {
            Self::Dense { x, .. } | Self::Standardise { x, .. } | Self::Quantise { x, .. } => *x == slot,
            Self::Mul { a, b, .. } | Self::Concat { a, b, .. } => *a == slot || *b == slot,
            Self::Film { x, scale, shift, .. } => [x, scale, shift].contains(&&slot),
        }
    }
}

/// The layers of a model, in order of computation.
#[derive(Clone, Debug, Default)]
pub struct Graph {
    pub(super) widths: Vec<usize>,
    pub(super) needs_grad: Vec<bool>,
    /// Whether a value is the output of a ReLU.
    pub(super) relu: Vec<bool>,
    pub(super) ops: Vec<Op>,
    /// Where candle evaluates the graph; none for the fused layers.
    device: Option<Device>,
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
    /// An empty graph, for the [`Engine`](super::device::Engine) that this thread has started.
    pub fn new() -> Self {
        Self { device: device::current(), ..Self::default() }
    }

    fn slot(&mut self, width: usize, needs_grad: bool) -> Slot {
        self.widths.push(width);
        self.needs_grad.push(needs_grad);
        self.relu.push(false);
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
    /// Where the width of `x` is not the layer's input width, or the graph has the layer already.
    pub fn dense(&mut self, x: Slot, layer: &DenseParams, relu: bool) -> Slot {
        assert_eq!(self.widths[x.0], layer.inputs, "dense layer: input width");
        let there = self.ops.iter().any(|op| matches!(op, Op::Dense { w, .. } if *w == layer.w));
        assert!(!there, "dense layer: its gradient is set, not added, so a graph has it once");
        let y = self.slot(layer.outputs, true);
        self.relu[y.0] = relu;
        let lookup = self.ops.iter().any(|op| matches!(op, Op::Quantise { y, one_hot: true, .. } if *y == x.0));
        self.ops.push(Op::Dense { x: x.0, y: y.0, w: layer.w.clone(), b: layer.b.clone(), relu, lookup });
        y
    }

    /// Element-wise product of two computed values.
    ///
    /// # Panics
    /// Where the widths differ, both are the same value, or one is an input.
    pub fn mul(&mut self, a: Slot, b: Slot) -> Slot {
        assert_eq!(self.widths[a.0], self.widths[b.0], "product: widths");
        assert!(a != b && self.needs_grad[a.0] && self.needs_grad[b.0], "product of two computed values");
        let y = self.slot(self.widths[a.0], true);
        self.ops.push(Op::Mul { a: a.0, b: b.0, y: y.0 });
        y
    }

    /// Both values side by side: `[a | b]`.
    pub fn concat(&mut self, a: Slot, b: Slot) -> Slot {
        let y = self.slot(self.widths[a.0] + self.widths[b.0], self.needs_grad[a.0] || self.needs_grad[b.0]);
        self.ops.push(Op::Concat { a: a.0, b: b.0, y: y.0 });
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
        self.relu[y.0] = relu;
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

    fn is_standardise(&self, op: usize) -> bool {
        matches!(self.ops.get(op), Some(Op::Standardise { .. }))
    }

    /// Ends of the stretches between standardisations: every part must reach a cut before any goes on.
    fn cuts(&self) -> impl DoubleEndedIterator<Item = usize> {
        let is_cut = |i: &usize| self.ops.get(*i).is_none_or(|op| matches!(op, Op::Standardise { .. }));
        (0..=self.ops.len()).filter(is_cut)
    }
}
