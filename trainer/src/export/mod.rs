//! From a trained run to a policy file: fold, calibrate, quantise, write, read back, compare, and say how good it is.

mod card;
mod fold;
mod parity;

pub use card::{make_card, parts_of};
pub use fold::float_model;
pub use parity::{Limits, measure};

use std::path::Path;

use gadm_runtime::encode::{
    AlignedImage, FileOptions, FloatModel, QuantiseOptions, QuantiseReport, quantise, write_float, write_int8,
};
use gadm_runtime::{Policy, ReturnStats};

use crate::card::Parity;
use crate::config::{TrainConfig, config_hash};
use crate::error::TrainError;
use crate::runner::checkpoint::{Networks, Trained, load_trained};
use crate::runner::origin::Origin;
use crate::runner::{Evaluation, evaluate, evaluate_policy};

/// Self-test vectors stored in a policy.
const SELF_TESTS: usize = 8;

/// What to export.
#[derive(Clone, Debug)]
pub struct ExportOptions {
    /// The networks of the best evaluation rather than the last ones.
    pub best: bool,
    /// Episodes of the comparison.
    pub episodes: usize,
    /// Seed of the comparison's episodes.
    pub seed: u64,
    /// Write f32 weights (FPU targets) instead of int8.
    pub float_weights: bool,
    /// Sequence number of the policy.
    pub policy_seq: u32,
}

/// What an export made and measured.
pub struct Exported {
    /// The policy file.
    pub bytes: Vec<u8>,
    /// Settings of the run.
    pub config: TrainConfig,
    /// Counters of the exported networks.
    pub env_steps: u64,
    /// Updates of the exported networks.
    pub updates: u64,
    /// Returns of the float networks.
    pub float: Evaluation,
    /// Returns of the file in the runtime, same episodes.
    pub device: Evaluation,
    /// Float against device on the observations of the calibration set.
    pub parity: Parity,
    /// How the quantiser fared, by layer; none for float weights.
    pub report: Option<QuantiseReport>,
    /// The float model behind the file.
    pub model: FloatModel,
}

fn stats(evaluation: &Evaluation) -> ReturnStats {
    ReturnStats {
        mean: evaluation.mean() as f32,
        std: evaluation.sd() as f32,
        episodes: evaluation.returns.len() as u32,
    }
}

fn encode_error(error: &gadm_runtime::encode::EncodeError) -> TrainError {
    TrainError::Export(error.to_string())
}

/// Exports the networks of a run folder.
///
/// # Errors
/// [`TrainError::Export`] for a model the device cannot hold; those of loading a run.
pub fn export(dir: &Path, options: &ExportOptions) -> Result<Exported, TrainError> {
    let mut trained = load_trained(dir, if options.best { Networks::Best } else { Networks::Last })?;
    let config = trained.config.clone();
    let spec = gadm_envs::make_with(&config.env, &config.env_options)?.spec().clone();
    let mut model = float_model(&mut trained, &spec)?;
    let float = evaluate(trained.actor(), &config.env, &config.env_options, options.episodes, options.seed)?;
    model.provenance.config_hash = config_hash(&config)?;
    model.provenance.commit = Origin::of_run(dir)?.commit;
    model.provenance.eval_seed = options.seed;
    model.provenance.float_return = stats(&float);
    let Trained { calibration, counters, .. } = trained;
    let obs_dim = spec.obs_dim();
    let rows = calibration.len() / obs_dim;
    if rows == 0 {
        return Err(TrainError::Export(format!(
            "{} has collected no observation to calibrate with: train longer",
            dir.display()
        )));
    }
    let tests: Vec<f32> = (0..SELF_TESTS.min(rows))
        .flat_map(|i| {
            let row = i * rows / SELF_TESTS.min(rows);
            calibration[row * obs_dim..(row + 1) * obs_dim].iter().copied()
        })
        .collect();
    let file = FileOptions { policy_seq: options.policy_seq, ..FileOptions::default() };
    let encode = |model: &FloatModel| -> Result<(Vec<u8>, Option<QuantiseReport>), TrainError> {
        if options.float_weights {
            return Ok((write_float(model, &tests, &file).map_err(|e| encode_error(&e))?, None));
        }
        let quantised = quantise(model, &calibration, &QuantiseOptions::default()).map_err(|e| encode_error(&e))?;
        let bytes = write_int8(&quantised, &tests, &file).map_err(|e| encode_error(&e))?;
        Ok((bytes, Some(quantised.report.clone())))
    };
    // Twice: the returns of the file belong into its provenance, and do not change what it computes.
    let (draft, _) = encode(&model)?;
    let device = evaluate_policy(&draft, &config.env, &config.env_options, options.episodes, options.seed)?;
    model.provenance.device_return = stats(&device);
    let (bytes, report) = encode(&model)?;
    let image = AlignedImage::new(&bytes);
    Policy::load(&image).map_err(|e| TrainError::Export(format!("the file just written does not load: {e}")))?;
    let parity = measure(&model, &bytes, &calibration)?;
    let updates = counters.updates();
    Ok(Exported { bytes, config, env_steps: counters.env_steps, updates, float, device, parity, report, model })
}
