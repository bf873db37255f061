//! GADM + DQN online (paper, algorithm 1; specification 4.5): the state of a run and one round of it.

use std::path::Path;

use gadm_envs::{VecEnv, make_with};
use gadm_runtime::space::ActionHead;
use rand::RngExt as _;

use super::agent::Agent;
use super::any::{AnyRun, any_run_fields};
use super::averages::Averages;
use super::bookkeeping::{Counters, NotFinite, Streams, Window, finite, push_means, step_environments};
use super::checkpoint;
use crate::algo::Actor;
use crate::config::{Algorithm, Assignment, EpsilonConfig, RandomChoice, TrainConfig};
use crate::error::TrainError;
use crate::metrics::{Record, keys};
use crate::replay::{ActionBuffer, NStep, RlBatch, RlBuffer};
use crate::seed::SeedTree;

/// A run of GADM + DQN in memory.
pub struct Run {
    /// Settings.
    pub config: TrainConfig,
    /// Networks.
    pub agent: Agent,
    /// Averages of the networks, from the first round of training on, where `track.average` is set.
    pub averages: Option<Averages>,
    /// Environments.
    pub envs: VecEnv,
    /// n-step assembly, one per environment.
    pub nsteps: Vec<NStep>,
    /// State-action pairs.
    pub d_ar: ActionBuffer,
    /// Transitions.
    pub d_rl: RlBuffer,
    /// Random streams.
    pub streams: Streams,
    /// Counters.
    pub counters: Counters,
    /// Sums since the last record.
    pub window: Window,
    batch: RlBatch,
    obs: Vec<f32>,
    actions: Vec<f32>,
    codes: Vec<u32>,
    obs_dim: usize,
    slots: usize,
}

/// Checks settings that only a run relates to each other.
fn check(config: &TrainConfig) -> Result<(), TrainError> {
    let batch = config.round.batch;
    for (key, capacity) in
        [("replay.rl_capacity", config.replay.rl_capacity), ("replay.ar_capacity", config.replay.ar_capacity)]
    {
        if capacity < batch {
            return Err(TrainError::config(key, &format!("at least round.batch = {batch}"), capacity));
        }
    }
    if config.action_model.standardise && batch < 2 {
        return Err(TrainError::config("round.batch", "at least 2 where action_model.standardise is on", batch));
    }
    let momentum = config.action_model.statistics_momentum;
    if !(momentum > 0.0 && momentum <= 1.0) {
        return Err(TrainError::config("action_model.statistics_momentum", "above 0, at most 1", momentum));
    }
    if config.explore.random == RandomChoice::Action && !config.round.remap {
        let expected = "\"latent\" where round.remap is off: a random action has a latent by remapping alone";
        return Err(TrainError::config("explore.random", expected, "\"action\""));
    }
    let w = &config.warmup;
    if w.enabled && w.data.is_none() && config.steps <= w.steps {
        let expected = format!("above warmup.steps = {}, for nothing is learned before", w.steps);
        return Err(TrainError::config("steps", &expected, config.steps));
    }
    if config.explore.epsilon_decay.is_infinite() {
        return Err(TrainError::config("explore.epsilon_decay", "a finite number", config.explore.epsilon_decay));
    }
    if !(0.0..=1.0).contains(&config.track.average) {
        return Err(TrainError::config("track.average", "0 to 1", config.track.average));
    }
    if let Some(target) = config.track.stop_at_return.filter(|t| !t.is_finite()) {
        return Err(TrainError::config("track.stop_at_return", "a finite number", target));
    }
    Ok(())
}

/// Checks that recorded numbers are an action in the form of the networks.
fn check_action(heads: &[ActionHead], action: &[f32]) -> Result<(), String> {
    for (slot, (head, &value)) in heads.iter().zip(action).enumerate() {
        let (fits, expected) = match *head {
            ActionHead::Discrete { n } => {
                (value.fract() == 0.0 && (0.0..f32::from(n)).contains(&value), format!("a whole number below {n}"))
            }
            ActionHead::Binary => (value == 0.0 || value == 1.0, "0 or 1".to_owned()),
            ActionHead::Continuous { .. } => ((-1.0..=1.0).contains(&value), "-1 to 1 (normalised)".to_owned()),
        };
        if !fits {
            return Err(format!("`actions` slot {slot}: expected {expected}, found {value}"));
        }
    }
    Ok(())
}

impl Run {
    /// A run at step 0.
    ///
    /// # Errors
    /// For an unknown environment or impossible settings.
    pub fn new(config: TrainConfig) -> Result<Self, TrainError> {
        config.validate()?;
        if config.algo != Algorithm::GadmDqn {
            return Err(TrainError::config("algo", "gadm-dqn", config.algo.name().id()));
        }
        check(&config)?;
        let spec = make_with(&config.env, &config.env_options)?.spec().clone();
        let seeds = SeedTree::new(config.seed);
        let envs = VecEnv::new(&config.env, config.collect.envs, seeds.number("environments"), &config.env_options)?;
        let agent = Agent::new(&config, &spec)?;
        let (obs_dim, slots) = (spec.obs_dim(), spec.action_dim());
        let streams = Streams::new(seeds);
        Ok(Self {
            agent,
            averages: None,
            envs,
            nsteps: vec![NStep::new(config.dqn.n_step, config.dqn.gamma); config.collect.envs],
            d_ar: ActionBuffer::new(config.replay.ar_capacity, obs_dim, slots),
            d_rl: RlBuffer::new(config.replay.rl_capacity, obs_dim, slots),
            streams,
            counters: Counters::default(),
            window: Window::new(config.action_model.latents),
            config,
            batch: RlBatch::default(),
            obs: Vec::new(),
            actions: Vec::new(),
            codes: Vec::new(),
            obs_dim,
            slots,
        })
    }

    /// True when the configured steps are done.
    pub fn finished(&self) -> bool {
        self.counters.env_steps >= self.config.steps
    }

    /// What the next round does: `warm-up` or `training`.
    pub fn phase(&self) -> &'static str {
        let w = &self.config.warmup;
        match self.counters.warm || !w.enabled {
            true => "training",
            false if w.data.is_none() && self.counters.env_steps < w.steps => "warm-up: random steps",
            false if self.counters.action_updates < w.updates => "warm-up: action model",
            false => "warm-up: confidence",
        }
    }

    /// One round: a slice of the warm-up, or collection followed by the phases AR, LACP, RL.
    ///
    /// # Errors
    /// [`NotFinite`] where a loss, a gradient or a weight is not a finite number; environment errors.
    pub fn round(&mut self) -> Result<Result<(), NotFinite>, TrainError> {
        let result = self.slice()?.and_then(|()| self.check_weights());
        if result.is_ok() {
            self.average()?;
        }
        Ok(result)
    }

    fn average(&mut self) -> Result<(), TrainError> {
        let tau = self.config.track.average as f32;
        match &mut self.averages {
            _ if tau == 0.0 => self.averages = None,
            Some(averages) => averages.approach(&self.agent, tau),
            None if self.counters.warm => self.averages = Some(Averages::of(&self.agent)?),
            None => {}
        }
        Ok(())
    }

    fn slice(&mut self) -> Result<Result<(), NotFinite>, TrainError> {
        let steps = self.config.collect.steps_per_round / self.config.collect.envs;
        if !self.counters.warm && self.config.warmup.enabled {
            return self.warmup_round(steps);
        }
        self.counters.warm = true;
        for _ in 0..steps {
            self.collect_step()?;
        }
        let r = self.config.round.clone();
        let ar_ready = self.d_ar.len() >= r.batch;
        if ar_ready {
            for _ in 0..r.action_updates {
                if let Err(e) = self.update_action_model() {
                    return Ok(Err(e));
                }
            }
            if self.agent.confidence.is_some() {
                for _ in 0..r.confidence_updates {
                    if let Err(e) = self.update_confidence() {
                        return Ok(Err(e));
                    }
                }
            }
        }
        if self.d_rl.len() >= r.batch {
            for _ in 0..r.q_updates {
                if let Err(e) = self.update_q() {
                    return Ok(Err(e));
                }
            }
        }
        Ok(Ok(()))
    }

    fn warmup_round(&mut self, steps: usize) -> Result<Result<(), NotFinite>, TrainError> {
        let w = self.config.warmup.clone();
        // Slices of about one round's work, so that progress, signals and checkpoints are served in between.
        let slice = 64;
        let confidence_goal = if self.agent.confidence.is_some() { w.confidence_updates } else { 0 };
        if self.d_ar.is_empty() {
            self.load_warmup_data()?;
        }
        if w.data.is_none() && self.counters.env_steps < w.steps {
            for _ in 0..steps {
                self.random_step()?;
            }
        } else if self.counters.action_updates < w.updates && !self.d_ar.is_empty() {
            for _ in 0..slice.min(w.updates - self.counters.action_updates) {
                if let Err(e) = self.update_action_model() {
                    return Ok(Err(e));
                }
            }
        } else if self.counters.confidence_updates < confidence_goal && !self.d_ar.is_empty() {
            for _ in 0..slice.min(confidence_goal - self.counters.confidence_updates) {
                if let Err(e) = self.update_confidence() {
                    return Ok(Err(e));
                }
            }
        } else {
            self.counters.warm = true;
            if !w.keep {
                self.d_ar = ActionBuffer::new(self.config.replay.ar_capacity, self.obs_dim, self.slots);
            }
        }
        Ok(Ok(()))
    }

    /// Fills D_AR from `warmup.data`, if that is set.
    ///
    /// # Errors
    /// [`TrainError::Data`] for a file that does not fit the environment.
    pub fn load_warmup_data(&mut self) -> Result<(), TrainError> {
        let Some(path) = self.config.warmup.data.as_ref().filter(|_| self.config.warmup.enabled) else { return Ok(()) };
        let (space, d_ar) = (self.agent.model.space(), &mut self.d_ar);
        super::checkpoint::load_pairs(path, self.obs_dim, self.slots, |obs, action| {
            check_action(space.heads(), action)?;
            d_ar.push(obs, action);
            Ok(())
        })
    }

    fn random_step(&mut self) -> Result<(), TrainError> {
        let n = self.envs.len();
        let obs = self.envs.obs().to_vec();
        self.actions.resize(n * self.slots, 0.0);
        for action in self.actions.chunks_exact_mut(self.slots) {
            self.agent.model.space().random(&mut self.streams.warmup, action);
        }
        for (o, a) in obs.chunks_exact(self.obs_dim).zip(self.actions.chunks_exact(self.slots)) {
            self.d_ar.push(o, a);
        }
        self.step_environments()?;
        self.counters.env_steps += n as u64;
        Ok(())
    }

    /// Current ε.
    pub fn epsilon(&self) -> f64 {
        let e = &self.config.explore;
        EpsilonConfig { start: e.epsilon_start, end: e.epsilon_end, decay: e.epsilon_decay }.at(self.counters.env_steps)
    }

    /// One step of every environment with ε-greedy latents and extreme noise; draws are per environment.
    fn collect_step(&mut self) -> Result<(), TrainError> {
        let n = self.envs.len();
        let (epsilon, extreme, sigma) =
            (self.epsilon(), self.config.explore.extreme_noise, self.config.explore.gaussian_noise as f32);
        let obs = self.envs.obs().to_vec();
        let mut codes = std::mem::take(&mut self.codes);
        self.agent.greedy(&obs, n, &mut codes);
        let mut raw = vec![false; n];
        for (code, raw) in codes.iter_mut().zip(&mut raw) {
            if self.streams.explore.random_bool(epsilon) {
                match self.config.explore.random {
                    RandomChoice::Latent => {
                        *code = self.streams.explore.random_range(0..self.agent.model.num_latents() as u32);
                    }
                    RandomChoice::Action => *raw = true,
                }
            }
        }
        self.actions.resize(n * self.slots, 0.0);
        self.agent.model.decode(&obs, &codes, &mut self.actions, false);
        for (action, _) in self.actions.chunks_exact_mut(self.slots).zip(&raw).filter(|(_, raw)| **raw) {
            self.agent.model.space().random(&mut self.streams.explore, action);
        }
        if extreme > 0.0 {
            for action in self.actions.chunks_exact_mut(self.slots) {
                if self.streams.noise.random_bool(extreme) {
                    self.agent.model.space().extreme(&mut self.streams.noise, action);
                }
            }
        }
        if sigma > 0.0 {
            for action in self.actions.chunks_exact_mut(self.slots) {
                self.agent.model.space().gaussian(sigma, &mut self.streams.noise, action);
            }
        }
        self.step_environments()?;
        let batch = self.envs.last();
        for i in 0..n {
            let rows = |v: &[f32], width: usize| v[i * width..(i + 1) * width].to_vec();
            let (o, a) = (rows(&obs, self.obs_dim), rows(&self.actions, self.slots));
            self.d_ar.push(&o, &a);
            let next = rows(&batch.next_obs, self.obs_dim);
            let d_rl = &mut self.d_rl;
            self.nsteps[i].push(
                &o,
                &a,
                codes[i],
                batch.rewards[i],
                &next,
                batch.terminated[i],
                batch.truncated[i],
                |t| d_rl.push(&t),
            );
        }
        self.codes = codes;
        self.counters.env_steps += n as u64;
        Ok(())
    }

    fn step_environments(&mut self) -> Result<(), TrainError> {
        step_environments(&mut self.envs, self.agent.model.space(), &self.actions, &mut self.counters, &mut self.window)
    }

    /// `what` with the pairs of the last batch from D_AR.
    fn bad_pairs(&self, what: &'static str) -> NotFinite {
        let arrays = [("obs", self.obs_dim, &self.obs), ("actions", self.slots, &self.actions)];
        NotFinite { what, arrays: arrays.map(|(name, width, v)| (name, width, v.clone())).to_vec() }
    }

    /// `what` with the transitions of the last batch from D_RL.
    fn bad_transitions(&self, what: &'static str) -> NotFinite {
        NotFinite::in_batch(what, &self.batch, self.obs_dim, self.slots)
    }

    /// Weights are looked at after every round, so that no checkpoint holds one that is not finite.
    fn check_weights(&self) -> Result<(), NotFinite> {
        if !finite(&self.agent.model.params) {
            return Err(self.bad_pairs("a weight of the action model"));
        }
        if self.agent.confidence.as_ref().is_some_and(|c| !finite(&c.params)) {
            return Err(self.bad_pairs("a weight of the confidence predictor"));
        }
        if !finite(&self.agent.dqn.params) {
            return Err(self.bad_transitions("a weight of the Q-network"));
        }
        Ok(())
    }

    fn update_action_model(&mut self) -> Result<(), NotFinite> {
        self.d_ar.sample(self.config.round.batch, &mut self.streams.sample_ar, &mut self.obs, &mut self.actions);
        let m = self.agent.model.update(&self.obs, &self.actions);
        if !m.loss.is_finite() {
            return Err(self.bad_pairs("action-model loss"));
        }
        if !m.grad_norm.is_finite() {
            return Err(self.bad_pairs("gradient of the action model"));
        }
        self.counters.action_updates += 1;
        for &code in self.agent.model.training_codes() {
            self.window.code_counts[code as usize] += 1;
        }
        self.window.add(keys::AE_LOSS, f64::from(m.loss));
        self.window.add(keys::RECON_CONTINUOUS, f64::from(m.reconstruction.continuous));
        self.window.add(keys::RECON_TYPE, f64::from(m.reconstruction.types));
        self.window.add(keys::COMMITMENT, f64::from(m.commitment));
        self.window.add(keys::AE_GRAD_NORM, f64::from(m.grad_norm));
        Ok(())
    }

    fn update_confidence(&mut self) -> Result<(), NotFinite> {
        self.d_ar.sample(self.config.round.batch, &mut self.streams.sample_ar, &mut self.obs, &mut self.actions);
        let mut codes = std::mem::take(&mut self.codes);
        self.agent.model.encode(&self.obs, &self.actions, &mut codes);
        let loss = self.agent.update_confidence(&self.obs, &codes);
        self.codes = codes;
        if !loss.is_finite() {
            return Err(self.bad_pairs("confidence loss"));
        }
        self.counters.confidence_updates += 1;
        self.agent.confidence_updates = self.counters.confidence_updates;
        self.window.add(keys::CONFIDENCE_LOSS, f64::from(loss));
        Ok(())
    }

    fn update_q(&mut self) -> Result<(), NotFinite> {
        let n = self.config.round.batch;
        self.d_rl.sample(n, &mut self.streams.sample_rl, &mut self.batch);
        let mut codes = std::mem::take(&mut self.codes);
        if self.config.round.remap {
            self.agent.model.encode(&self.batch.obs, &self.batch.actions, &mut codes);
            if self.config.round.assign == Assignment::Nearest {
                let chosen: Vec<u32> = self.batch.codes.iter().map(|&c| c as u32).collect();
                self.agent.model.keep_nearer(&self.batch.obs, &self.batch.actions, &chosen, &mut codes);
            }
            let changed = codes.iter().zip(&self.batch.codes).filter(|(a, b)| **a != **b as u32).count();
            self.window.add(keys::REMAPPED, changed as f64 / n as f64);
        } else {
            codes.clear();
            codes.extend(self.batch.codes.iter().map(|&c| c as u32));
        }
        let m = self.agent.update_q(&self.batch, &codes);
        self.codes = codes;
        if !m.loss.is_finite() {
            return Err(self.bad_transitions("Q loss"));
        }
        if !m.grad_norm.is_finite() {
            return Err(self.bad_transitions("gradient of the Q-network"));
        }
        self.counters.q_updates += 1;
        self.window.add(keys::Q_LOSS, f64::from(m.loss));
        self.window.add(keys::Q_MEAN, f64::from(m.q_mean));
        self.window.add(keys::GRAD_NORM, f64::from(m.grad_norm));
        Ok(())
    }

    /// The metric record of everything since the last one, and a fresh window.
    pub fn record(&mut self) -> Record {
        let mut record = Record::new(self.counters.env_steps);
        record.push(keys::UPDATES, self.counters.updates() as f64);
        record.push(keys::EPISODES, self.counters.episodes as f64);
        record.push(keys::EPSILON, self.epsilon());
        record.push(keys::REPLAY_SIZE, self.d_rl.len() as f64);
        push_means(
            &mut record,
            &self.window,
            &[
                keys::EPISODE_RETURN,
                keys::EPISODE_LENGTH,
                keys::Q_LOSS,
                keys::Q_MEAN,
                keys::GRAD_NORM,
                keys::AE_LOSS,
                keys::RECON_CONTINUOUS,
                keys::RECON_TYPE,
                keys::COMMITMENT,
                keys::AE_GRAD_NORM,
                keys::CONFIDENCE_LOSS,
                keys::REMAPPED,
            ],
        );
        let (used, perplexity) = self.window.code_use();
        if used > 0 {
            record.push(keys::CODES_USED, used as f64);
            record.push(keys::CODE_PERPLEXITY, perplexity);
        }
        let (fallbacks, rows, allowed) = std::mem::take(&mut self.agent.mask_statistics);
        if rows > 0 {
            record.push(keys::MASK_SIZE, allowed as f64 / rows as f64);
            record.push(keys::MASK_FALLBACK, fallbacks as f64 / rows as f64);
        }
        self.window = Window::new(self.config.action_model.latents);
        record
    }
}

impl AnyRun for Run {
    any_run_fields!();

    fn phase(&self) -> &'static str {
        self.phase()
    }

    fn prepare(&mut self) -> Result<(), TrainError> {
        self.load_warmup_data()
    }

    fn round(&mut self) -> Result<Result<(), NotFinite>, TrainError> {
        self.round()
    }

    fn record(&mut self) -> Record {
        self.record()
    }

    fn actor(&mut self) -> &mut dyn Actor {
        &mut self.agent
    }

    fn swap_averages(&mut self) {
        if let Some(averages) = &mut self.averages {
            averages.swap(&mut self.agent);
        }
    }

    fn save(&mut self, dir: &Path) -> Result<(), TrainError> {
        checkpoint::save(self, dir)
    }

    fn save_networks(&mut self, dir: &Path, name: &str) -> Result<(), TrainError> {
        checkpoint::save_networks(self, dir, name)
    }
}
