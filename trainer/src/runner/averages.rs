//! Running averages of an agent's networks. A network in training steps back and forth around what it learns, and so does the
//! return of one evaluation after the other; the average of its weights does so less.
//! Source: Polyak & Juditsky 1992.

use super::agent::Agent;
use crate::error::TrainError;
use crate::nn::Params;

/// Averages of the parameters of all networks of an agent.
pub struct Averages {
    /// Action model.
    pub model: Params,
    /// Q-network.
    pub q: Params,
    /// Confidence predictor, where there is one.
    pub confidence: Option<Params>,
}

impl Averages {
    /// The networks as they are.
    ///
    /// # Errors
    /// Where candle cannot copy a tensor.
    pub fn of(agent: &Agent) -> Result<Self, TrainError> {
        let confidence = agent.confidence.as_ref().map(|c| c.params.duplicate());
        Ok(Self {
            model: agent.model.params.duplicate()?,
            q: agent.dqn.params.duplicate()?,
            confidence: confidence.transpose()?,
        })
    }

    /// `average += tau (network - average)`.
    pub fn approach(&mut self, agent: &Agent, tau: f32) {
        self.model.approach(&agent.model.params, tau);
        self.q.approach(&agent.dqn.params, tau);
        if let (Some(average), Some(confidence)) = (&mut self.confidence, &agent.confidence) {
            average.approach(&confidence.params, tau);
        }
    }

    /// Puts the averages in the place of the networks; once more puts them back.
    pub fn swap(&mut self, agent: &mut Agent) {
        std::mem::swap(&mut self.model, &mut agent.model.params);
        std::mem::swap(&mut self.q, &mut agent.dqn.params);
        if let (Some(average), Some(confidence)) = (&mut self.confidence, &mut agent.confidence) {
            std::mem::swap(average, &mut confidence.params);
        }
    }
}
