//! Greedy evaluation of the float policy: no ε, no noise, snap rule on (specification 4.6).

use gadm_envs::{Env, EnvOptions, make_with};
use serde::{Deserialize, Serialize};

use super::agent::Agent;
use crate::error::TrainError;

/// Outcome of an evaluation.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Undiscounted return of each episode.
    pub returns: Vec<f64>,
    /// Length of each episode, steps.
    pub lengths: Vec<u64>,
    /// Episodes that ended in the goal, where the environment has one.
    pub successes: Option<usize>,
    /// How often each latent was chosen.
    pub latent_counts: Vec<u64>,
}

impl Evaluation {
    /// Mean return.
    pub fn mean(&self) -> f64 {
        self.returns.iter().sum::<f64>() / self.returns.len() as f64
    }

    /// Sample standard deviation of the returns; 0 for one episode.
    pub fn sd(&self) -> f64 {
        let mean = self.mean();
        let n = self.returns.len();
        if n < 2 {
            return 0.0;
        }
        (self.returns.iter().map(|r| (r - mean) * (r - mean)).sum::<f64>() / (n - 1) as f64).sqrt()
    }
}

/// Runs `episodes` episodes in step, episode `i` from reset seed `episode_seed(seed, i)`. The same seed gives the same episodes to
/// every kind of policy, in every program of the project.
///
/// # Errors
/// Where the environment cannot be made.
pub fn evaluate(
    agent: &mut Agent,
    env: &str,
    options: &EnvOptions,
    episodes: usize,
    seed: u64,
) -> Result<Evaluation, TrainError> {
    let mut envs: Vec<Box<dyn Env>> = (0..episodes).map(|_| make_with(env, options)).collect::<Result<_, _>>()?;
    let spec = envs[0].spec().clone();
    let (obs_dim, slots) = (spec.obs_dim(), spec.action_dim());
    let mut obs = vec![0.0; episodes * obs_dim];
    for (i, (env, obs)) in envs.iter_mut().zip(obs.chunks_exact_mut(obs_dim)).enumerate() {
        env.reset(gadm_envs::episode_seed(seed, i as u64), obs);
    }
    let mut result = Evaluation {
        returns: vec![0.0; episodes],
        lengths: vec![0; episodes],
        successes: spec.goal_terminal.then_some(0),
        latent_counts: vec![0; agent.model.num_latents()],
    };
    let mut running: Vec<usize> = (0..episodes).collect();
    let (mut batch, mut codes, mut native) = (Vec::new(), Vec::new(), vec![0.0; slots]);
    let statistics = agent.mask_statistics;
    while !running.is_empty() {
        batch.clear();
        running.iter().for_each(|&i| batch.extend_from_slice(&obs[i * obs_dim..(i + 1) * obs_dim]));
        agent.greedy(&batch, running.len(), &mut codes);
        let mut actions = vec![0.0; running.len() * slots];
        agent.model.decode(&batch, &codes, &mut actions, true);
        let mut still = Vec::with_capacity(running.len());
        for ((&i, &code), action) in running.iter().zip(&codes).zip(actions.chunks_exact(slots)) {
            agent.model.space().to_native(action, &mut native);
            let step = envs[i].step(&native, &mut obs[i * obs_dim..(i + 1) * obs_dim]);
            result.returns[i] += step.reward;
            result.lengths[i] += 1;
            result.latent_counts[code as usize] += 1;
            if step.terminated || step.truncated {
                if let Some(n) = result.successes.as_mut().filter(|_| step.terminated && step.reward > 0.0) {
                    *n += 1;
                }
            } else {
                still.push(i);
            }
        }
        running = still;
    }
    agent.mask_statistics = statistics;
    Ok(result)
}
