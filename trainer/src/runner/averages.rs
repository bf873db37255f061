//! Running averages of an agent's networks. A network in training steps back and forth around what it learns, and so does the
//! return of one evaluation after the other; the average of its weights does so less.
//! Source: Polyak & Juditsky 1992.

use super::agent::Agent;
use crate::error::TrainError;
use crate::nn::Params;

/// Averages of the parameters of all networks of an agent, by name as [`Agent::networks`] has them.
pub struct Averages(pub Vec<(&'static str, Params)>);

impl Averages {
    /// The networks as they are.
    ///
    /// # Errors
    /// Where candle cannot copy a tensor.
    pub fn of(agent: &Agent) -> Result<Self, TrainError> {
        let copies = agent.networks().into_iter().map(|(name, params)| Ok((name, params.duplicate()?)));
        Ok(Self(copies.collect::<Result<_, TrainError>>()?))
    }

    /// `average += tau (network - average)`.
    pub fn approach(&mut self, agent: &Agent, tau: f32) {
        for ((_, average), (_, params)) in self.0.iter_mut().zip(agent.networks()) {
            average.approach(params, tau);
        }
    }

    /// Puts the averages in the place of the networks; once more puts them back.
    pub fn swap(&mut self, agent: &mut Agent) {
        for ((_, average), (_, params)) in self.0.iter_mut().zip(agent.networks_mut()) {
            std::mem::swap(average, params);
        }
    }
}
