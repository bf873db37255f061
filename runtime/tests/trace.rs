//! What a trace shows is what the step computes.
#![cfg(feature = "encode")]
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use gadm_runtime::encode::{
    AlignedImage, FileOptions, FloatDecoder, FloatModel, QuantiseOptions, QuantisedModel, Trace, quantise, write_int8,
};
use gadm_runtime::{Policy, Scratch};
use support::{Rng, hopper, observations, share_trunk};

fn written(model: &FloatModel) -> Vec<u8> {
    let calibration = observations(100, model, 400);
    let quantised = quantise(model, &calibration, &QuantiseOptions::default()).unwrap();
    write_int8(&quantised, &calibration[..44], &FileOptions::default()).unwrap()
}

fn table(seed: u64, mut model: FloatModel) -> FloatModel {
    let mut rng = Rng(seed);
    let action = |rng: &mut Rng| (0..3).map(|_| 2.0 * rng.uniform() - 1.0).collect();
    let actions = (0..model.num_latents()).map(|_| action(&mut rng)).collect();
    (model.decoder, model.heads) = (FloatDecoder::Table { actions }, Vec::new());
    model
}

fn models() -> Vec<FloatModel> {
    let unmasked = FloatModel { confidence: None, ..hopper(3) };
    vec![hopper(1), share_trunk(2, hopper(2), &[]), unmasked, table(5, hopper(4))]
}

/// The allowed latent with the largest Q-value, lowest on a tie.
fn best(trace: &Trace) -> u16 {
    let of = |latent: u16| trace.q[usize::from(latent)];
    trace.allowed.iter().reduce(|best, next| if of(next) > of(best) { next } else { best }).unwrap()
}

fn names(trace: &Trace) -> Vec<&str> {
    trace.layers.iter().map(|layer| layer.layer.as_str()).collect()
}

#[test]
fn the_trace_of_a_file_is_the_step_of_the_file() {
    for model in models() {
        let bytes = written(&model);
        let image = AlignedImage::new(&bytes);
        let policy = Policy::load(&image).unwrap();
        let mut memory = vec![0; policy.spec().scratch_words];
        for obs in observations(7, &model, 50).chunks(11) {
            let mut action = [0.0; 3];
            let decision = policy.act(obs, &mut Scratch::new(&mut memory), &mut action).unwrap();
            let trace = policy.trace(obs).unwrap();
            assert_eq!(
                (trace.latent, trace.allowed, trace.fallback),
                (decision.latent, decision.allowed, decision.fallback)
            );
            let latent = usize::from(trace.latent);
            assert_eq!(trace.q[latent], decision.q as f32 * policy.q_scale());
            assert_eq!(trace.actions[latent * 3..][..3], action);
            assert_eq!(best(&trace), decision.latent);
            assert_eq!(trace.layers.len(), policy.layers().count());
            for (layer, shape) in trace.layers.iter().zip(policy.layers()) {
                assert_eq!(layer.outputs.len(), usize::from(shape.rows), "{}", layer.layer);
            }
            let Some(confidence) = &trace.confidence else { continue };
            assert!((confidence.iter().sum::<f32>() - 1.0).abs() < 1e-5);
            let (num, den) = policy.mask_threshold().unwrap();
            if !trace.fallback {
                // The decision is made in integers: on the threshold itself both answers are right.
                let beta = num as f32 / den as f32;
                for (latent, &p) in (0u16..).zip(confidence) {
                    assert!(trace.allowed.contains(latent) == (p > beta) || (p - beta).abs() < 1e-5, "{latent}: {p}");
                }
            }
        }
    }
}

#[test]
fn the_trace_of_a_model_is_the_step_of_the_model() {
    for model in models() {
        for obs in observations(8, &model, 50).chunks(11) {
            let mut action = [0.0; 3];
            let decision = model.act(obs, &mut action);
            let trace = model.trace(obs);
            assert_eq!(
                (trace.latent, trace.allowed, trace.fallback),
                (decision.latent, decision.allowed, decision.fallback)
            );
            assert_eq!(trace.q[usize::from(trace.latent)], decision.q);
            assert_eq!(trace.actions[usize::from(trace.latent) * 3..][..3], action);
            assert_eq!(best(&trace), decision.latent);
        }
    }
}

/// Layer by layer, a file and its dequantised model differ by rounding only.
#[test]
fn layers_of_a_file_count_like_those_of_its_dequantised_model() {
    for model in models() {
        let bytes = written(&model);
        let image = AlignedImage::new(&bytes);
        let policy = Policy::load(&image).unwrap();
        let float = QuantisedModel::read(&policy).dequantised();
        let (mut noise, mut signal) = (vec![0.0; policy.layers().count()], vec![0.0; policy.layers().count()]);
        for obs in observations(9, &model, 50).chunks(11) {
            let (int, float) = (policy.trace(obs).unwrap(), float.trace(obs));
            assert_eq!(names(&int), names(&float));
            if int.latent != float.latent {
                continue; // Their decoders answer to different questions then.
            }
            for (layer, (int, float)) in int.layers.iter().zip(&float.layers).enumerate() {
                for (a, b) in int.outputs.iter().zip(&float.outputs) {
                    noise[layer] += f64::from(a - b).powi(2);
                    signal[layer] += f64::from(*b).powi(2);
                }
            }
        }
        for (layer, (noise, signal)) in noise.iter().zip(&signal).enumerate() {
            let relative = (noise / signal).sqrt();
            assert!(*signal > 0.0 && relative > 0.0 && relative < 0.05, "layer {layer}: {relative}");
        }
    }
}
