//! Float model against policy file on the same observations.

use gadm_runtime::encode::{AlignedImage, FloatModel};
use gadm_runtime::space::ActionHead;
use gadm_runtime::{Policy, Scratch, WeightKind};

use super::Exported;
use crate::card::Parity;
use crate::error::TrainError;

/// Below these an export is refused.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Least share of observations on which both choose the same latent.
    pub agreement: f64,
    /// Largest mean action error, as a share of the action range, where they agree.
    pub action_error: f64,
    /// Largest loss of mean return, as a share of the float return's size.
    pub return_loss: f64,
}

impl Default for Limits {
    fn default() -> Self {
        Self { agreement: 0.85, action_error: 0.02, return_loss: 0.1 }
    }
}

impl Limits {
    /// What an export misses; empty if it meets all. A loss of return within two standard errors of the difference is noise and
    /// passes.
    pub fn missed(&self, exported: &Exported) -> Vec<String> {
        let mut missed = Vec::new();
        let p = &exported.parity;
        if p.argmax_agreement < self.agreement {
            missed.push(format!(
                "latents agree on {:.4} of the observations, limit {}",
                p.argmax_agreement, self.agreement
            ));
        }
        if p.action_error_mean > self.action_error {
            missed.push(format!(
                "mean action error {:.4} of the range, limit {}",
                p.action_error_mean, self.action_error
            ));
        }
        let (float, device) = (&exported.float, &exported.device);
        let n = float.returns.len() as f64;
        let noise = 2.0 * ((float.sd().powi(2) + device.sd().powi(2)) / n).sqrt();
        let loss = float.mean() - device.mean();
        if loss > (self.return_loss * float.mean().abs()).max(noise) {
            missed.push(format!(
                "return falls from {:.2} to {:.2}; limit {} of its size, or two standard errors ({noise:.2})",
                float.mean(),
                device.mean(),
                self.return_loss
            ));
        }
        missed
    }
}

/// Compares on `observations` (`N x obs_dim`).
///
/// # Errors
/// Where the file does not load or refuses an observation.
pub fn measure(model: &FloatModel, bytes: &[u8], observations: &[f32]) -> Result<Parity, TrainError> {
    let image = AlignedImage::new(bytes);
    let policy = Policy::load(&image).map_err(|e| TrainError::Export(e.to_string()))?;
    let float_file = policy.spec().weights == WeightKind::Float32;
    let float_policy = if float_file {
        Some(gadm_runtime::FloatPolicy::load(&image).map_err(|e| TrainError::Export(e.to_string()))?)
    } else {
        None
    };
    let obs_dim = model.interface.observations.len();
    let heads: Vec<ActionHead> = model.interface.actions.iter().map(|a| a.head).collect();
    let mut memory = vec![0; policy.spec().scratch_words];
    let mut scratch = Scratch::new(&mut memory);
    let (mut expected, mut found) = (vec![0.0; heads.len()], vec![0.0; heads.len()]);
    let (mut agreeing, mut errors, mut largest) = (0_u64, 0.0, 0.0_f64);
    let mut samples = 0_u64;
    for obs in observations.chunks_exact(obs_dim) {
        let float = model.act(obs, &mut expected);
        let latent = match &float_policy {
            Some(policy) => policy.act(obs, &mut scratch, &mut found).map(|d| d.latent),
            None => policy.act(obs, &mut scratch, &mut found).map(|d| d.latent),
        }
        .map_err(|e| TrainError::Export(e.to_string()))?;
        samples += 1;
        if latent != float.latent {
            continue;
        }
        agreeing += 1;
        for ((head, a), b) in heads.iter().zip(&expected).zip(&found) {
            let error = match head {
                ActionHead::Continuous { lo, hi } => f64::from((a - b).abs() / (hi - lo)),
                ActionHead::Discrete { .. } | ActionHead::Binary => f64::from(u8::from(a != b)),
            };
            errors += error / heads.len() as f64;
            largest = largest.max(error);
        }
    }
    Ok(Parity {
        samples,
        argmax_agreement: agreeing as f64 / samples.max(1) as f64,
        action_error_mean: errors / agreeing.max(1) as f64,
        action_error_max: largest,
    })
}
