//! Settings of the action model and of the confidence predictor, with the source of every default.

use serde::{Deserialize, Serialize};

use super::codetable::Codetable;
use crate::action_space::ContinuousHead;
use crate::nn::AdamConfig;

/// How state and action (or code) meet (paper section 3.2, "FiLM"; specification 2.3).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Fusion {
    /// No state conditioning (ablation): the decoder is a table of K actions.
    None,
    /// Element-wise product of both ReLU embeddings (the authors' code). Folds into per-latent constants on the device.
    #[default]
    Mul,
    /// The state modulates the action or code: `(1 + Γ(h_s)) ⊙ h + B(h_s)`, identity at the start (standard FiLM). Does not fold.
    FilmStateToLatent,
    /// The action or code modulates the state branch before its ReLU: `relu((1 + Γ(h)) ⊙ (W s + b) + B(h))`. Folds.
    FilmLatentToState,
}

/// Loss of a continuous slot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RegressionLoss {
    /// Squared error (paper eq. 2).
    #[default]
    Mse,
    /// Absolute error.
    L1,
    /// Huber with delta 1.
    Huber,
}

/// The action model: encoder, code table, decoder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ActionModelConfig {
    /// Latent actions K.
    pub latents: usize,
    /// Length D of a code; 0 means K (specification 2.4: one-hot with D = K).
    pub code_dim: usize,
    /// Hidden width H.
    pub hidden: usize,
    /// Dense layers of the encoder after the fusion, before the linear one.
    pub encoder_layers: usize,
    /// Dense layers of the decoder after the fusion, before the heads.
    pub decoder_layers: usize,
    /// How state and action meet.
    pub fusion: Fusion,
    /// The code table.
    pub codetable: Codetable,
    /// Standardise the encoder's output before the nearest-code search: the cure for code collapse (specification 2.10).
    pub standardise: bool,
    /// Share of a batch in the running mean and variance of the standardised output, above 0 to 1. The specification's
    /// 0.01 lags about a hundred updates behind weights that drift: latents assigned with running statistics then differ
    /// from those of training, up to whole action types decoded wrongly (`cargo run --release -p gadm-trainer --example choices momentum`).
    pub statistics_momentum: f64,
    /// Weight λ of the commitment term, on the mean over batch and D (specification 2.8).
    pub commitment: f64,
    /// Loss of continuous slots.
    pub regression: RegressionLoss,
    /// Weight of the continuous part of the reconstruction loss.
    pub continuous_weight: f64,
    /// Weight of the cross-entropy to the two-hot projection of the action; categorical head only (specification 2.7).
    pub two_hot_weight: f64,
    /// Leave arguments that a type does not use out of loss and input (specification 2.8).
    pub argument_mask: bool,
    /// Head of continuous slots.
    pub head: ContinuousHead,
    /// Optimiser.
    pub adam: AdamConfig,
}

impl Default for ActionModelConfig {
    fn default() -> Self {
        Self {
            latents: 64,
            code_dim: 0,
            hidden: 256,
            encoder_layers: 2,
            decoder_layers: 1,
            fusion: Fusion::Mul,
            codetable: Codetable::OneHot,
            standardise: true,
            statistics_momentum: 0.2,
            commitment: 0.25,
            regression: RegressionLoss::Mse,
            continuous_weight: 1.0,
            two_hot_weight: 0.0,
            argument_mask: true,
            head: ContinuousHead::Tanh,
            adam: AdamConfig::default(),
        }
    }
}

impl ActionModelConfig {
    /// Length of a code.
    pub fn code_dim(&self) -> usize {
        if self.code_dim == 0 { self.latents } else { self.code_dim }
    }
}

/// What the confidence predictor reads.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Trunk {
    /// The observation, through hidden layers of its own (paper section 3.3).
    #[default]
    Own,
    /// The Q-network's last hidden layer, without a gradient into it: a device then computes one trunk instead of two.
    Shared,
}

/// The confidence predictor (paper section 3.3; specification 3).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ConfidenceConfig {
    /// Train the predictor and mask latents with it.
    pub enabled: bool,
    /// What it reads.
    pub trunk: Trunk,
    /// Hidden widths with a trunk of its own.
    pub hidden: Vec<usize>,
    /// Hidden widths on a shared trunk, at most one; empty is one linear layer on the Q-network's last hidden layer.
    pub shared_hidden: Vec<usize>,
    /// Focal exponent; 0 is cross-entropy.
    pub focal_gamma: f64,
    /// Mask threshold as a multiple of 1/K: a latent is allowed where its confidence exceeds `threshold / K`.
    pub threshold: f64,
    /// Updates after which the mask is applied online.
    pub start_after: u64,
    /// Optimiser.
    pub adam: AdamConfig,
}

impl ConfidenceConfig {
    /// Hidden widths between what the predictor reads and its scores, and the key that sets them.
    pub fn widths(&self) -> (&[usize], &'static str) {
        match self.trunk {
            Trunk::Own => (&self.hidden, "confidence.hidden"),
            Trunk::Shared => (&self.shared_hidden, "confidence.shared_hidden"),
        }
    }
}

impl Default for ConfidenceConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            trunk: Trunk::Own,
            hidden: vec![256, 256],
            shared_hidden: Vec::new(),
            focal_gamma: 2.0,
            threshold: 1.0,
            start_after: 2000,
            adam: AdamConfig::default(),
        }
    }
}
