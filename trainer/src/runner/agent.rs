//! The learner as a whole: action model, confidence predictor and Q-network, and how they choose an action.

use crate::action_space::ActionSpace;
use crate::algo::Actor;
use crate::algo::dqn::{Dqn, DqnMetrics, masked_argmax};
use crate::config::TrainConfig;
use crate::discretizer::gadm::{ActionModel, Confidence, Trunk};
use crate::error::TrainError;
use crate::nn::Params;
use crate::replay::RlBatch;
use crate::seed::SeedTree;
use gadm_envs::EnvSpec;

/// Rows a single call of the networks may have outside training; larger sets go in chunks.
pub const MAX_ROWS: usize = 512;

/// GADM + DQN.
pub struct Agent {
    /// Encoder, code table, decoder.
    pub model: ActionModel,
    /// Confidence predictor, where masking is on.
    pub confidence: Option<Confidence>,
    /// Q-network.
    pub dqn: Dqn,
    /// Updates of the confidence predictor so far; decides when masking starts.
    pub confidence_updates: u64,
    obs_dim: usize,
    features: Vec<f32>,
    scores: Vec<f32>,
    allowed: Vec<bool>,
    /// Rows since the last reading that fell back, rows in all, latents allowed in all.
    pub mask_statistics: (u64, u64, u64),
}

impl Agent {
    /// A fresh agent for an environment.
    ///
    /// # Errors
    /// [`TrainError::Config`] for impossible settings.
    pub fn new(config: &TrainConfig, spec: &EnvSpec) -> Result<Self, TrainError> {
        let seeds = SeedTree::new(config.seed);
        let space = ActionSpace::new(spec, config.action_model.head, config.action_model.argument_mask);
        let (obs_dim, k, rows) = (spec.obs_dim(), config.action_model.latents, config.round.batch.max(MAX_ROWS));
        let model = ActionModel::new(
            config.action_model.clone(),
            obs_dim,
            space,
            rows,
            &mut seeds.stream("init.action-model"),
        )?;
        let dqn = Dqn::new(config.dqn.clone(), obs_dim, k, rows, &mut seeds.stream("init.q"))?;
        let confidence = config.confidence.enabled.then(|| {
            let inputs = match config.confidence.trunk {
                Trunk::Own => obs_dim,
                Trunk::Shared => dqn.feature_width(),
            };
            Confidence::new(config.confidence.clone(), inputs, k, rows, &mut seeds.stream("init.confidence"))
        });
        Ok(Self {
            model,
            confidence: confidence.transpose()?,
            dqn,
            confidence_updates: 0,
            obs_dim,
            features: Vec::new(),
            scores: Vec::new(),
            allowed: Vec::new(),
            mask_statistics: (0, 0, 0),
        })
    }

    /// Parameters of all networks by name, the confidence predictor's last.
    pub fn networks(&self) -> Vec<(&'static str, &Params)> {
        let mut all = vec![("action-model", &self.model.params), ("q", &self.dqn.params)];
        all.extend(self.confidence.as_ref().map(|c| ("confidence", &c.params)));
        all
    }

    /// The same, to be changed.
    pub fn networks_mut(&mut self) -> Vec<(&'static str, &mut Params)> {
        let mut all = vec![("action-model", &mut self.model.params), ("q", &mut self.dqn.params)];
        all.extend(self.confidence.as_mut().map(|c| ("confidence", &mut c.params)));
        all
    }

    /// True once the confidence predictor masks latents.
    pub fn masking(&self) -> bool {
        self.confidence.as_ref().is_some_and(|c| self.confidence_updates >= c.config().start_after)
    }

    /// True where the confidence predictor reads the Q-network's last hidden layer.
    pub fn shares_trunk(&self) -> bool {
        self.confidence.as_ref().is_some_and(|c| c.config().trunk == Trunk::Shared)
    }

    /// One update of the confidence predictor on `obs` (`B x obs_dim`) and their latents; returns the mean loss. A shared
    /// trunk is read as it is now, by the online parameters, and not changed.
    pub fn update_confidence(&mut self, obs: &[f32], codes: &[u32]) -> f32 {
        let shared = self.shares_trunk();
        let Some(confidence) = &mut self.confidence else { return 0.0 };
        if !shared {
            return confidence.update(obs, codes);
        }
        self.dqn.features(obs, codes.len(), &mut self.features);
        confidence.update(&self.features, codes)
    }

    /// Masks of `batch` observations, `B x K`; empty while masking is off. With a shared trunk they come from the online
    /// Q-network, for targets too: there it is the online network that chooses the successor's latent (double DQN), and the
    /// mask is a part of that choice.
    pub fn masks(&mut self, obs: &[f32], batch: usize) -> &[bool] {
        self.allowed.clear();
        let shared = self.shares_trunk();
        if self.masking()
            && let Some(confidence) = &mut self.confidence
        {
            let seen = if shared {
                self.dqn.features(obs, batch, &mut self.features);
                &self.features
            } else {
                obs
            };
            let fallbacks = confidence.masks(seen, batch, &mut self.scores, &mut self.allowed);
            self.mask_statistics.0 += fallbacks as u64;
            self.mask_statistics.1 += batch as u64;
            self.mask_statistics.2 += self.allowed.iter().filter(|a| **a).count() as u64;
        }
        &self.allowed
    }

    /// One update of the Q-network on a batch and its latents, with the masks of the successors.
    pub fn update_q(&mut self, batch: &RlBatch, codes: &[u32]) -> DqnMetrics {
        self.masks(&batch.next_obs, codes.len());
        self.dqn.update(batch, codes, &self.allowed)
    }

    /// Greedy latents of `batch` observations.
    pub fn greedy(&mut self, obs: &[f32], batch: usize, codes: &mut Vec<u32>) {
        let k = self.model.num_latents();
        codes.clear();
        let mut done = 0;
        while done < batch {
            let rows = (batch - done).min(MAX_ROWS);
            let part = &obs[done * self.obs_dim..(done + rows) * self.obs_dim];
            self.masks(part, rows);
            let allowed = std::mem::take(&mut self.allowed);
            let scores = self.dqn.advantages(part, rows);
            codes.extend(scores.chunks_exact(k).enumerate().map(|(b, row)| {
                let allowed = if allowed.is_empty() { &allowed[..] } else { &allowed[b * k..(b + 1) * k] };
                masked_argmax(row, allowed) as u32
            }));
            self.allowed = allowed;
            done += rows;
        }
    }
}

impl Actor for Agent {
    fn space(&self) -> &ActionSpace {
        self.model.space()
    }

    fn choices(&self) -> usize {
        self.model.num_latents()
    }

    /// Greedy latents, decoded with the snap rule; the mask statistics of training stay as they are.
    fn act(&mut self, obs: &[f32], batch: usize, chosen: &mut Vec<u32>, actions: &mut [f32]) {
        let statistics = self.mask_statistics;
        self.greedy(obs, batch, chosen);
        self.model.decode(obs, chosen, actions, true);
        self.mask_statistics = statistics;
    }
}
