//! The float model that a device runs, taken out of a trained agent.

use gadm_envs::EnvSpec;
use gadm_runtime::encode::{ActionSlot, Dense, FloatModel, Interface, ObservationSlot, ProvenanceOwned};

use crate::discretizer::gadm::model::fold::dense;
use crate::error::TrainError;
use crate::runner::checkpoint::Trained;

/// Folds an agent: ensemble heads to their mean, value stream dropped (the argmax does not see it), code table and latent branch
/// to one modulation per latent. The confidence network goes along once it masks.
///
/// # Errors
/// [`TrainError::Export`] for a fusion that does not fold.
pub fn float_model(trained: &mut Trained, spec: &EnvSpec) -> Result<FloatModel, TrainError> {
    let agent = trained.agent()?;
    let (layers, weight, bias) = agent.dqn.folded();
    let mut q: Vec<Dense> = layers.iter().map(|layer| dense(&agent.dqn.params, layer)).collect();
    let cols = q.last().map_or(0, |layer| layer.rows);
    q.push(Dense { rows: bias.len(), cols, weight, bias });
    let (masking, shared_trunk) = (agent.masking(), agent.shares_trunk());
    let confidence = agent.confidence.as_ref().filter(|_| masking);
    let beta =
        confidence.map_or(1.0 / agent.model.num_latents() as f32, crate::discretizer::gadm::Confidence::threshold);
    let confidence = confidence.map(|c| c.layers().iter().map(|layer| dense(&c.params, layer)).collect());
    let decoder = agent.model.folded_decoder()?;
    let heads = match decoder {
        gadm_runtime::encode::FloatDecoder::Table { .. } => Vec::new(),
        gadm_runtime::encode::FloatDecoder::Modulated { .. } => agent.model.head_encodings(),
    };
    let observations = spec.observations.iter().map(|s| ObservationSlot {
        name: s.name.clone(),
        unit: s.unit.clone(),
        lo: s.lo,
        hi: s.hi,
    });
    let actions = spec.actions.iter().map(|s| ActionSlot {
        name: s.name.clone(),
        unit: s.unit.clone(),
        head: s.head,
        safe: s.safe,
    });
    Ok(FloatModel {
        interface: Interface {
            observations: observations.collect(),
            actions: actions.collect(),
            control_period_us: spec.control_period_us,
        },
        obs_mean: vec![0.0; spec.obs_dim()],
        obs_std: vec![1.0; spec.obs_dim()],
        q,
        shared_trunk: confidence.is_some() && shared_trunk,
        confidence,
        beta,
        decoder,
        heads,
        provenance: ProvenanceOwned {
            environment: spec.id.clone(),
            algorithm: "gadm-dqn".to_owned(),
            train_seed: trained.config.seed,
            env_steps: trained.counters.env_steps,
            ..ProvenanceOwned::default()
        },
    })
}
