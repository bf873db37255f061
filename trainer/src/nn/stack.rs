//! What the baselines' networks are made of: stacks of dense layers over one parameter vector.

use rand::RngExt as _;
use rand_distr::StandardNormal;

use super::{DenseParams, Graph, Init, ParamLayout, Slot, declare_dense};
use crate::error::TrainError;
use crate::seed::Rng;

/// Dense layers in a row.
#[derive(Clone, Debug)]
pub struct Stack(Vec<DenseParams>);

impl Stack {
    /// Declares `<name>0`, `<name>1`, ... between neighbouring `widths`, with PyTorch's start values.
    pub fn declare(layout: &mut ParamLayout, name: &str, widths: &[usize]) -> Self {
        let layer =
            |(i, w): (usize, &[usize])| declare_dense(layout, &format!("{name}{i}"), w[0], w[1], Init::torch(w[0]));
        Self(widths.windows(2).enumerate().map(layer).collect())
    }

    /// Adds the layers to a graph, ReLU after each, after the last one only where `relu_last`.
    pub fn build(&self, graph: &mut Graph, input: Slot, relu_last: bool) -> Slot {
        let last = self.0.len().wrapping_sub(1);
        self.0.iter().enumerate().fold(input, |x, (i, layer)| graph.dense(x, layer, i != last || relu_last))
    }

    /// The layers.
    pub fn layers(&self) -> &[DenseParams] {
        &self.0
    }
}

/// `inputs`, `hidden...`, `outputs` as one list of widths.
pub fn widths(inputs: usize, hidden: &[usize], outputs: usize) -> Vec<usize> {
    [&[inputs], hidden, &[outputs]].concat()
}

/// Checks the widths of hidden layers; `key` is their dotted key.
///
/// # Errors
/// [`TrainError::Config`] without a layer or for an empty one.
pub fn check_hidden(key: &str, hidden: &[usize]) -> Result<(), TrainError> {
    if hidden.is_empty() || hidden.contains(&0) {
        return Err(TrainError::config(key, "one width or more, each at least 1", format!("{hidden:?}")));
    }
    Ok(())
}

/// A number drawn from the standard normal distribution.
pub fn normal(rng: &mut Rng) -> f32 {
    rng.sample(StandardNormal)
}
