//! A run of a baseline algorithm: collect, store, update.

use std::path::Path;

use gadm_envs::{EnvSpec, VecEnv, make_with};

use super::any::{AnyRun, any_run_fields};
use super::bookkeeping::{Counters, NotFinite, Streams, Window, finite, push_means, step_environments};
use super::checkpoint;
use crate::algo::hppo::Hppo;
use crate::algo::listed::{self, Listed};
use crate::algo::pdqn::Pdqn;
use crate::algo::td3::Td3;
use crate::algo::{Actor, Explorer, Learner, Observed, Report};
use crate::config::{Algorithm, Schedule, TrainConfig};
use crate::error::TrainError;
use crate::metrics::{Record, keys};
use crate::replay::{NStep, RlBatch, RlBuffer};
use crate::seed::SeedTree;

/// A run in memory.
pub struct BaselineRun {
    /// Settings.
    pub config: TrainConfig,
    /// Networks.
    pub learner: Box<dyn Learner>,
    /// Environments.
    pub envs: VecEnv,
    /// n-step assembly, one per environment.
    pub nsteps: Vec<NStep>,
    /// Transitions.
    pub replay: RlBuffer,
    /// Random streams.
    pub streams: Streams,
    /// Counters.
    pub counters: Counters,
    /// Sums since the last record.
    pub window: Window,
    schedule: Schedule,
    batch: RlBatch,
    report: Report,
    chosen: Vec<u32>,
    actions: Vec<f32>,
}

/// What learns, for an environment.
///
/// # Errors
/// [`TrainError::Config`] for impossible settings, or GADM+DQN, which has a run of its own.
pub fn learner(config: &TrainConfig, spec: &EnvSpec) -> Result<Box<dyn Learner>, TrainError> {
    let seeds = SeedTree::new(config.seed);
    match &config.algo {
        Algorithm::GadmDqn => Err(TrainError::config("algo", "a baseline", "gadm-dqn")),
        Algorithm::Td3(own) => Ok(Box::new(Td3::new(own.clone(), spec, seeds)?)),
        Algorithm::DqnManual(own) => listed::manual(own, spec, seeds),
        Algorithm::Pdqn(own) => Ok(Box::new(Pdqn::single_pass(own, spec, seeds)?)),
        Algorithm::Hppo(own) => Ok(Box::new(Hppo::new(own, spec, seeds)?)),
        Algorithm::Mpdqn(own) => Ok(Box::new(Pdqn::multi_pass(own, spec, seeds)?)),
        Algorithm::DqnCluster(own) => Ok(Box::new(Listed::clusters(own, spec, seeds)?)),
    }
}

/// Schedule, horizon n and discount γ of an algorithm.
fn plan(algo: &Algorithm) -> (Schedule, usize, f64) {
    match algo {
        Algorithm::GadmDqn => (Schedule::default(), 1, 1.0),
        Algorithm::Td3(c) => (c.schedule.clone(), c.n_step, c.gamma),
        Algorithm::DqnManual(c) => (c.schedule.clone(), c.dqn.n_step, c.dqn.gamma),
        Algorithm::Pdqn(c) => (c.schedule.clone(), c.n_step, c.gamma),
        Algorithm::Hppo(c) => {
            let (envs, steps_per_round) = (c.envs, c.steps_per_round);
            (Schedule { envs, steps_per_round, updates: 0, batch: 1, capacity: 1, random_steps: 0 }, 1, c.gamma)
        }
        Algorithm::Mpdqn(c) => (c.pdqn.schedule.clone(), c.pdqn.n_step, c.pdqn.gamma),
        Algorithm::DqnCluster(c) => (c.schedule.clone(), c.dqn.n_step, c.dqn.gamma),
    }
}

impl BaselineRun {
    /// A run at step 0.
    ///
    /// # Errors
    /// For an unknown environment or impossible settings.
    pub fn new(config: TrainConfig) -> Result<Self, TrainError> {
        config.validate()?;
        if config.track.average != 0.0 {
            let expected = "0: only the networks of gadm-dqn are averaged";
            return Err(TrainError::config("track.average", expected, config.track.average));
        }
        let spec = make_with(&config.env, &config.env_options)?.spec().clone();
        let (schedule, n_step, gamma) = plan(&config.algo);
        let seeds = SeedTree::new(config.seed);
        let envs = VecEnv::new(&config.env, schedule.envs, seeds.number("environments"), &config.env_options)?;
        Ok(Self {
            learner: learner(&config, &spec)?,
            envs,
            nsteps: vec![NStep::new(n_step, gamma); schedule.envs],
            replay: RlBuffer::new(schedule.capacity, spec.obs_dim(), spec.action_dim()),
            streams: Streams::new(seeds),
            counters: Counters::default(),
            window: Window::default(),
            config,
            schedule,
            batch: RlBatch::default(),
            report: Report::new(),
            chosen: Vec::new(),
            actions: Vec::new(),
        })
    }

    /// One step of every environment.
    fn collect(&mut self) -> Result<(), TrainError> {
        let n = self.envs.len();
        let (width, slots) = (self.envs.spec().obs_dim(), self.envs.spec().action_dim());
        let obs = self.envs.obs().to_vec();
        self.actions.resize(n * slots, 0.0);
        if self.counters.env_steps < self.schedule.random_steps {
            self.chosen.clear();
            let (learner, rng) = (&mut self.learner, &mut self.streams.warmup);
            learner.random(n, rng, &mut self.chosen, &mut self.actions);
        } else {
            let Streams { explore, noise, .. } = &mut self.streams;
            let by = Explorer { env_steps: self.counters.env_steps, choose: explore, noise };
            self.learner.explore(&obs, n, by, &mut self.chosen, &mut self.actions);
        }
        let Self { envs, learner, actions, counters, window, .. } = self;
        step_environments(envs, learner.space(), actions, counters, window)?;
        let Self { nsteps, replay, chosen, .. } = self;
        let step = envs.last();
        let on_policy = learner.on_policy();
        for i in (0..n).filter(|_| on_policy) {
            let row = |v: &'_ [f32]| v[i * width..(i + 1) * width].to_vec();
            learner.observe(&Observed {
                obs: &row(&obs),
                reward: step.rewards[i],
                next_obs: &row(&step.next_obs),
                terminated: step.terminated[i],
                truncated: step.truncated[i],
            });
        }
        for (i, nstep) in nsteps.iter_mut().enumerate().filter(|_| !on_policy) {
            let (end, code) = ((step.terminated[i], step.truncated[i]), chosen.get(i).copied().unwrap_or(0));
            let row = |v: &'_ [f32], width: usize| v[i * width..(i + 1) * width].to_vec();
            let (o, a, next) = (row(&obs, width), row(actions, slots), row(&step.next_obs, width));
            nstep.push(&o, &a, code, step.rewards[i], &next, end.0, end.1, |t| replay.push(&t));
        }
        counters.env_steps += n as u64;
        Ok(())
    }

    fn update(&mut self) -> Result<(), NotFinite> {
        let Self { learner, replay, streams, batch, report, window, counters, envs, .. } = self;
        replay.sample(self.schedule.batch, &mut streams.sample_rl, batch);
        learner.update(batch, &mut streams.noise, report);
        if let Some((key, _)) = report.iter().find(|(_, value)| !value.is_finite()) {
            return Err(NotFinite::in_batch(key, batch, envs.spec().obs_dim(), envs.spec().action_dim()));
        }
        counters.q_updates += 1;
        for &(key, value) in &*report {
            window.add(key, f64::from(value));
        }
        Ok(())
    }

    /// The updates of an on-policy round.
    fn learn(&mut self) -> Result<(), NotFinite> {
        let Self { learner, streams, window, counters, .. } = self;
        let mut bad = None;
        learner.learn(&mut streams.sample_rl, &mut |report| {
            bad = report.iter().find(|(_, value)| !value.is_finite()).map(|(key, _)| *key);
            counters.q_updates += 1;
            for &(key, value) in report {
                window.add(key, f64::from(value));
            }
            bad.is_none()
        });
        bad.map_or(Ok(()), |what| Err(NotFinite { what, arrays: Vec::new() }))
    }

    fn updates(&mut self) -> Result<(), NotFinite> {
        if self.learner.on_policy() {
            self.learn()?;
        } else if self.replay.len() < self.schedule.batch {
            return Ok(());
        }
        for _ in 0..self.schedule.updates {
            self.update()?;
        }
        let bad = self.learner.networks().into_iter().find(|(_, params)| !finite(params)).map(|(name, _)| name);
        let (obs_dim, slots) = (self.envs.spec().obs_dim(), self.envs.spec().action_dim());
        bad.map_or(Ok(()), |name| Err(NotFinite::in_batch(name, &self.batch, obs_dim, slots)))
    }
}

impl AnyRun for BaselineRun {
    any_run_fields!();

    fn phase(&self) -> &'static str {
        if self.counters.env_steps < self.schedule.random_steps { "random steps" } else { "training" }
    }

    fn prepare(&mut self) -> Result<(), TrainError> {
        self.learner.prepare()
    }

    fn round(&mut self) -> Result<Result<(), NotFinite>, TrainError> {
        for _ in 0..self.schedule.steps_per_round / self.schedule.envs {
            self.collect()?;
        }
        self.counters.warm = self.counters.env_steps >= self.schedule.random_steps;
        Ok(if self.counters.warm { self.updates() } else { Ok(()) })
    }

    fn record(&mut self) -> Record {
        let mut record = Record::new(self.counters.env_steps);
        record.push(keys::UPDATES, self.counters.updates() as f64);
        record.push(keys::EPISODES, self.counters.episodes as f64);
        if let Some(epsilon) = self.learner.epsilon(self.counters.env_steps) {
            record.push(keys::EPSILON, epsilon);
        }
        if !self.learner.on_policy() {
            record.push(keys::REPLAY_SIZE, self.replay.len() as f64);
        }
        let means = [
            keys::EPISODE_RETURN,
            keys::EPISODE_LENGTH,
            keys::Q_LOSS,
            keys::Q_MEAN,
            keys::GRAD_NORM,
            keys::POLICY_LOSS,
            keys::VALUE_LOSS,
            keys::POLICY_ENTROPY,
        ];
        push_means(&mut record, &self.window, &means);
        self.window = Window::default();
        record
    }

    fn actor(&mut self) -> &mut dyn Actor {
        self.learner.actor()
    }

    fn save(&mut self, dir: &Path) -> Result<(), TrainError> {
        checkpoint::baseline::save(self, dir)
    }

    fn save_networks(&mut self, dir: &Path, name: &str) -> Result<(), TrainError> {
        checkpoint::baseline::save_networks(self, dir, name)
    }
}
