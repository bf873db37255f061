//! Greedy evaluation of the float policy: no ε, no noise, snap rule on (specification 4.6).

use gadm_envs::{Env, EnvOptions, EnvSpec, make_with};
use gadm_runtime::encode::AlignedImage;
use gadm_runtime::{FloatPolicy, Policy, Scratch, WeightKind};
use serde::{Deserialize, Serialize};

use crate::algo::Actor;
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
    /// How often each latent (or other discrete choice) was chosen; empty where an algorithm has none.
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
    actor: &mut dyn Actor,
    env: &str,
    options: &EnvOptions,
    episodes: usize,
    seed: u64,
) -> Result<Evaluation, TrainError> {
    let envs = (0..episodes).map(|_| make_with(env, options)).collect::<Result<_, _>>()?;
    Ok(evaluate_in(actor, envs, seed))
}

/// As [`evaluate`], in these environments: one for each episode, all alike, at least one.
pub fn evaluate_in(actor: &mut dyn Actor, envs: Vec<Box<dyn Env>>, seed: u64) -> Evaluation {
    evaluate_watched(actor, envs, seed, |_, _, _| {})
}

/// Observations and actions (normalised) of an episode, flat.
pub type Pairs = (Vec<f32>, Vec<f32>);

/// As [`evaluate_in`], and what was seen and done in each episode.
pub fn evaluate_recorded(actor: &mut dyn Actor, envs: Vec<Box<dyn Env>>, seed: u64) -> (Evaluation, Vec<Pairs>) {
    let mut pairs = vec![Pairs::default(); envs.len()];
    let evaluation = evaluate_watched(actor, envs, seed, |episode, obs, action| {
        pairs[episode].0.extend_from_slice(obs);
        pairs[episode].1.extend_from_slice(action);
    });
    (evaluation, pairs)
}

/// As [`evaluate_in`]; `watch` sees every decision: episode, observation, action (normalised).
pub fn evaluate_watched(
    actor: &mut dyn Actor,
    mut envs: Vec<Box<dyn Env>>,
    seed: u64,
    mut watch: impl FnMut(usize, &[f32], &[f32]),
) -> Evaluation {
    let episodes = envs.len();
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
        latent_counts: vec![0; actor.choices()],
    };
    let mut running: Vec<usize> = (0..episodes).collect();
    let (mut batch, mut chosen, mut native) = (Vec::new(), Vec::new(), vec![0.0; slots]);
    while !running.is_empty() {
        batch.clear();
        for &i in &running {
            batch.extend_from_slice(&obs[i * obs_dim..(i + 1) * obs_dim]);
        }
        let mut actions = vec![0.0; running.len() * slots];
        actor.act(&batch, running.len(), &mut chosen, &mut actions);
        for &choice in &chosen {
            result.latent_counts[choice as usize] += 1;
        }
        let mut still = Vec::with_capacity(running.len());
        for (&i, action) in running.iter().zip(actions.chunks_exact(slots)) {
            watch(i, &obs[i * obs_dim..(i + 1) * obs_dim], action);
            actor.space().to_native(action, &mut native);
            let step = envs[i].step(&native, &mut obs[i * obs_dim..(i + 1) * obs_dim]);
            result.returns[i] += step.reward;
            result.lengths[i] += 1;
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
    result
}

/// Runs `episodes` episodes of a policy file in the runtime, one after the other; episode seeds and sums as in [`evaluate`], so
/// that a simulated bus gives the same returns to the last bit.
///
/// # Errors
/// [`TrainError::Policy`] for a file that does not load or does not fit the environment.
pub fn evaluate_policy(
    bytes: &[u8],
    env: &str,
    options: &EnvOptions,
    episodes: usize,
    seed: u64,
) -> Result<Evaluation, TrainError> {
    evaluate_policy_in(bytes, make_with(env, options)?, episodes, seed)
}

/// As [`evaluate_policy`], in this environment.
///
/// # Errors
/// As [`evaluate_policy`].
pub fn evaluate_policy_in(
    bytes: &[u8],
    mut env: Box<dyn Env>,
    episodes: usize,
    seed: u64,
) -> Result<Evaluation, TrainError> {
    let image = AlignedImage::new(bytes);
    let policy = Policy::load(&image).map_err(|e| TrainError::Policy(e.to_string()))?;
    let float = if policy.spec().weights == WeightKind::Float32 {
        Some(FloatPolicy::load(&image).map_err(|e| TrainError::Policy(e.to_string()))?)
    } else {
        None
    };
    check_fit(&policy, env.spec())?;
    let spec = env.spec().clone();
    let mut result = Evaluation {
        successes: spec.goal_terminal.then_some(0),
        latent_counts: vec![0; usize::from(policy.spec().num_latents)],
        ..Evaluation::default()
    };
    let mut memory = vec![0; policy.spec().scratch_words];
    let mut scratch = Scratch::new(&mut memory);
    let (mut obs, mut action) = (vec![0.0; spec.obs_dim()], vec![0.0; spec.action_dim()]);
    for episode in 0..episodes {
        env.reset(gadm_envs::episode_seed(seed, episode as u64), &mut obs);
        let (mut total, mut length) = (0.0, 0);
        loop {
            let latent = match &float {
                Some(policy) => policy.act(&obs, &mut scratch, &mut action).map(|d| d.latent),
                None => policy.act(&obs, &mut scratch, &mut action).map(|d| d.latent),
            }
            .map_err(|e| TrainError::Policy(e.to_string()))?;
            result.latent_counts[usize::from(latent)] += 1;
            let step = env.step(&action, &mut obs);
            total += step.reward;
            length += 1;
            if step.terminated || step.truncated {
                if let Some(n) = result.successes.as_mut().filter(|_| step.terminated && step.reward > 0.0) {
                    *n += 1;
                }
                break;
            }
        }
        result.returns.push(total);
        result.lengths.push(length);
    }
    Ok(result)
}

/// Checks that a policy's interface is the environment's: same signals in the same order, same period.
///
/// # Errors
/// [`TrainError::Policy`] with the first difference.
pub fn check_fit(policy: &Policy, spec: &EnvSpec) -> Result<(), TrainError> {
    let refuse = |what: &str, expected: String, found: String| {
        Err(TrainError::Policy(format!(
            "this policy was made for `{}` and does not fit environment `{}`: {what}: expected {expected}, found {found}; \
             evaluate it in its own environment",
            policy.provenance().environment,
            spec.id
        )))
    };
    let (obs, actions) = (usize::from(policy.spec().obs_dim), usize::from(policy.spec().action_dim));
    if obs != spec.obs_dim() {
        return refuse("observation length", spec.obs_dim().to_string(), obs.to_string());
    }
    if actions != spec.action_dim() {
        return refuse("action slots", spec.action_dim().to_string(), actions.to_string());
    }
    for (i, (a, b)) in policy.observation_signals().zip(&spec.observations).enumerate() {
        if a.name != b.name || a.unit != b.unit {
            let text = |name: &str, unit: &str| format!("{name} [{unit}]");
            return refuse(&format!("observation {i}"), text(&b.name, &b.unit), text(a.name, a.unit));
        }
    }
    for (i, (a, b)) in policy.action_signals().zip(&spec.actions).enumerate() {
        if a.name != b.name || a.head != b.head {
            return refuse(
                &format!("action slot {i}"),
                format!("{} {:?}", b.name, b.head),
                format!("{} {:?}", a.name, a.head),
            );
        }
    }
    if policy.spec().control_period_us != spec.control_period_us {
        let us = |p: u32| format!("{p} µs");
        return refuse("control period", us(spec.control_period_us), us(policy.spec().control_period_us));
    }
    Ok(())
}
