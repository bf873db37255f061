//! A network with what its training needs: target, optimiser, and the weights as the products read them.

use super::{Adam, AdamConfig, Graph, Packed, Params, Weights, Workspace};
use crate::error::TrainError;

/// Graph, parameters, target parameters, optimiser.
pub struct Net {
    /// Layers.
    pub graph: Graph,
    /// Online parameters.
    pub params: Params,
    /// Target parameters.
    pub target: Params,
    /// Optimiser state.
    pub adam: Adam,
    packed: Packed,
    target_packed: Packed,
}

impl Net {
    /// A network whose target starts as its copy.
    ///
    /// # Errors
    /// Where candle cannot copy the parameters.
    pub fn new(graph: Graph, params: Params, adam: AdamConfig) -> Result<Self, TrainError> {
        let target = params.duplicate()?;
        let (packed, target_packed) = (graph.packed(), graph.packed());
        let adam = Adam::new(adam, params.layout().trainable_len());
        Ok(Self { graph, params, target, adam, packed, target_packed })
    }

    /// Brings the packed weights up to date, of the network and where `target` of its target too. Before every use of
    /// [`with`](Self::with).
    pub fn refresh(&mut self, target: bool) {
        self.graph.refresh(&self.params, &mut self.packed, true);
        if target {
            self.graph.refresh(&self.target, &mut self.target_packed, false);
        }
    }

    /// Lends the online and the target weights.
    pub fn with<R>(&self, work: impl FnOnce(Weights, Weights) -> R) -> R {
        self.params.with(|p| {
            self.target.with(|t| {
                let online = Weights { flat: p, packed: &self.packed };
                work(online, Weights { flat: t, packed: &self.target_packed })
            })
        })
    }

    /// Work memory for training on up to `rows` rows.
    pub fn workspace(&self, rows: usize) -> Workspace {
        self.graph.workspace(rows, self.params.layout().trainable_len())
    }

    /// One optimiser step with the gradients of one or two parts of a batch; returns the norm before clipping.
    pub fn step(&mut self, first: &mut Workspace, second: Option<&mut Workspace>) -> f32 {
        let Self { params, adam, .. } = self;
        params.with_mut(|p| match second {
            Some(second) => adam.step(p, &mut [first.gradient_mut(), second.gradient_mut()]),
            None => adam.step(p, &mut [first.gradient_mut()]),
        })
    }
}
