//! Folding for the device: code table and latent branch of the decoder become one scale and shift per latent and row of the
//! state branch, so that the device never runs the latent branch (specification 2.6; architecture section 5).

use gadm_runtime::encode::{Dense, FloatDecoder, HeadEncoding, Snap};
use gadm_runtime::space::ActionHead;

use super::super::config::Fusion;
use super::ActionModel;
use crate::action_space::{ContinuousHead, SnapRule};
use crate::error::TrainError;
use crate::nn::{DenseParams, Params};

/// A layer with its weights copied out.
pub fn dense(params: &Params, layer: &DenseParams) -> Dense {
    params.with(|p| Dense {
        rows: layer.outputs,
        cols: layer.inputs,
        weight: p[layer.w.clone()].to_vec(),
        bias: p[layer.b.clone()].to_vec(),
    })
}

fn apply(layer: &Dense, x: &[f32]) -> Vec<f32> {
    let rows = layer.weight.chunks_exact(layer.cols).zip(&layer.bias);
    rows.map(|(w, b)| w.iter().zip(x).map(|(w, x)| w * x).sum::<f32>() + b).collect()
}

impl ActionModel {
    /// How each action slot is read from the decoder's outputs.
    pub fn head_encodings(&self) -> Vec<HeadEncoding> {
        let of = |head: &ActionHead| match (head, self.space.continuous_head()) {
            (ActionHead::Discrete { .. }, _) => HeadEncoding::Types,
            (ActionHead::Binary, _) => HeadEncoding::Switch,
            (ActionHead::Continuous { .. }, ContinuousHead::Tanh) => HeadEncoding::Tanh,
            (ActionHead::Continuous { .. }, ContinuousHead::Categorical { atoms, snap }) => HeadEncoding::Categorical {
                atoms,
                snap: match snap {
                    SnapRule::None => Snap::None,
                    SnapRule::Edges => Snap::Edges,
                    SnapRule::Any => Snap::Any,
                },
            },
        };
        self.space.heads().iter().map(of).collect()
    }

    /// The decoder as the device runs it.
    ///
    /// - [`Fusion::Mul`]: `relu(W s + b) ⊙ u_k` with `u_k >= 0` equals `relu(u_k ⊙ (W s + b))`: scale `u_k`, shift 0.
    /// - [`Fusion::FilmLatentToState`]: scale `1 + Γ_k`, shift `B_k`.
    /// - [`Fusion::None`]: a table of K actions.
    ///
    /// # Errors
    /// [`TrainError::Export`] for [`Fusion::FilmStateToLatent`], which is no per-latent constant.
    pub fn folded_decoder(&mut self) -> Result<FloatDecoder, TrainError> {
        let k = self.num_latents();
        if self.config.fusion == Fusion::None {
            let slots = self.space.slots();
            let codes: Vec<u32> = (0..k as u32).collect();
            let mut actions = vec![0.0; k * slots];
            self.decode(&vec![0.0; k * self.obs_dim], &codes, &mut actions, true);
            return Ok(FloatDecoder::Table { actions: actions.chunks_exact(slots).map(<[f32]>::to_vec).collect() });
        }
        let state = self.layers.state.as_ref().expect("a conditioned model has a state branch");
        let (params, layers) = (&self.params, &self.layers);
        let (state, code) = (dense(params, state), dense(params, &layers.code));
        let table = params.with(|p| p[layers.table.clone()].to_vec());
        let (mut scale, mut shift) = (Vec::new(), Vec::new());
        for row in table.chunks_exact(self.config.code_dim()) {
            let embedded: Vec<f32> = apply(&code, row).into_iter().map(|v| v.max(0.0)).collect();
            match (self.config.fusion, &layers.decoder_film) {
                (Fusion::Mul, _) => {
                    shift.push(vec![0.0; embedded.len()]);
                    scale.push(embedded);
                }
                (Fusion::FilmLatentToState, Some((gamma, beta))) => {
                    scale.push(apply(&dense(params, gamma), &embedded).into_iter().map(|g| 1.0 + g).collect());
                    shift.push(apply(&dense(params, beta), &embedded));
                }
                _ => {
                    return Err(TrainError::Export(
                        "fusion `film-state-to-latent` does not fold into per-latent constants, and the device has no other form \
                         of it: train with `action_model.fusion = \"mul\"` or `\"film-latent-to-state\"`"
                            .to_owned(),
                    ));
                }
            }
        }
        Ok(FloatDecoder::Modulated {
            state,
            scale,
            shift,
            hidden: layers.decoder.iter().map(|layer| dense(params, layer)).collect(),
            head: dense(params, &layers.head),
        })
    }
}
