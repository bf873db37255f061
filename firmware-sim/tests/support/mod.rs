//! Small policies for real environments, and the episode without a bus that a run must equal.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used, reason = "shared by several test binaries, each uses a part")]

pub mod program;

use gadm_envs::{Env, EnvSpec};
use gadm_runtime::encode::{
    ActionSlot, AlignedImage, Dense, FileOptions, FloatDecoder, FloatModel, HeadEncoding, Interface, ObservationSlot,
    ProvenanceOwned, QuantiseOptions, quantise, write_int8,
};
use gadm_runtime::{ActionHead, Policy, Scratch};
use gadm_sim::episode_seed;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const LATENTS: usize = 8;
const WIDTH: usize = 16;

/// A policy of random weights for an environment: two layers of Q, a confidence network, a modulated decoder. It is no
/// good, but its actions depend on every observation.
pub fn random_policy(spec: &EnvSpec, seed: u64) -> AlignedImage {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let obs = spec.obs_dim();
    let mut dense = |rows: usize, cols: usize| {
        let scale = (2.0 / cols as f32).sqrt();
        let mut draw =
            |n: usize, s: f32| -> Vec<f32> { (0..n).map(|_| (rng.random::<f32>() * 2.0 - 1.0) * s).collect() };
        Dense { rows, cols, weight: draw(rows * cols, scale), bias: draw(rows, 0.1) }
    };
    let heads: Vec<HeadEncoding> = spec
        .actions
        .iter()
        .map(|a| match a.head {
            ActionHead::Continuous { .. } => HeadEncoding::Tanh,
            ActionHead::Discrete { .. } => HeadEncoding::Types,
            ActionHead::Binary => HeadEncoding::Switch,
        })
        .collect();
    let rows =
        spec.actions.iter().map(|a| if let ActionHead::Discrete { n } = a.head { usize::from(n) } else { 1 }).sum();
    let q = vec![dense(WIDTH, obs), dense(LATENTS, WIDTH)];
    let confidence = Some(vec![dense(WIDTH, obs), dense(LATENTS, WIDTH)]);
    let state = dense(WIDTH, obs);
    let head = dense(rows, WIDTH);
    let mut table = |lo: f32, hi: f32| -> Vec<Vec<f32>> {
        (0..LATENTS).map(|_| (0..WIDTH).map(|_| lo + (hi - lo) * rng.random::<f32>()).collect()).collect()
    };
    let model = FloatModel {
        interface: interface(spec),
        obs_mean: vec![0.0; obs],
        obs_std: vec![1.0; obs],
        q,
        confidence,
        shared_trunk: false,
        beta: 1.0 / LATENTS as f32,
        decoder: FloatDecoder::Modulated {
            state,
            scale: table(0.5, 1.5),
            shift: table(-0.5, 0.5),
            hidden: vec![],
            head,
        },
        heads,
        provenance: ProvenanceOwned { environment: spec.id.clone(), ..ProvenanceOwned::default() },
    };
    let samples = observations(spec);
    let quantised = quantise(&model, &samples, &QuantiseOptions::default()).unwrap();
    AlignedImage::new(&write_int8(&quantised, &samples[..obs * 4], &FileOptions::default()).unwrap())
}

/// The interface record of an environment.
pub fn interface(spec: &EnvSpec) -> Interface {
    Interface {
        observations: spec
            .observations
            .iter()
            .map(|s| ObservationSlot { name: s.name.clone(), unit: s.unit.clone(), lo: s.lo, hi: s.hi })
            .collect(),
        actions: spec
            .actions
            .iter()
            .map(|s| ActionSlot { name: s.name.clone(), unit: s.unit.clone(), head: s.head, safe: s.safe })
            .collect(),
        control_period_us: spec.control_period_us,
    }
}

/// Observations of episodes with random actions.
fn observations(spec: &EnvSpec) -> Vec<f32> {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut env = gadm_envs::make(&spec.id).unwrap();
    let mut obs = vec![0.0; spec.obs_dim()];
    let mut all = Vec::new();
    for seed in 0..20 {
        env.reset(seed, &mut obs);
        all.extend_from_slice(&obs);
        for _ in 0..20 {
            let action: Vec<f32> = spec
                .actions
                .iter()
                .map(|a| match a.head {
                    ActionHead::Continuous { .. } => a.head.denormalise(rng.random::<f32>() * 2.0 - 1.0),
                    ActionHead::Discrete { n } => f32::from(rng.random_range(0..n)),
                    ActionHead::Binary => f32::from(rng.random_range(0..2_u8)),
                })
                .collect();
            let step = env.step(&action, &mut obs);
            all.extend_from_slice(&obs);
            if step.terminated || step.truncated {
                break;
            }
        }
    }
    all
}

/// One control step without a bus.
#[derive(Clone, Debug, PartialEq)]
pub struct DirectStep {
    pub latent: u16,
    pub action: Vec<f32>,
}

/// The episode as an evaluation without a bus runs it: return and all steps.
pub fn direct(image: &[u8], env: &mut dyn Env, seed: u64, episode: u64) -> (f64, Vec<DirectStep>) {
    let policy = Policy::load(image).unwrap();
    let mut memory = vec![0; policy.spec().scratch_words];
    let mut scratch = Scratch::new(&mut memory);
    let mut obs = vec![0.0; env.spec().obs_dim()];
    let mut action = vec![0.0; env.spec().action_dim()];
    env.reset(episode_seed(seed, episode), &mut obs);
    let (mut total, mut steps) = (0.0, Vec::new());
    loop {
        let decision = policy.act(&obs, &mut scratch, &mut action).unwrap();
        let step = env.step(&action, &mut obs);
        total += step.reward;
        steps.push(DirectStep { latent: decision.latent, action: action.clone() });
        if step.terminated || step.truncated {
            return (total, steps);
        }
    }
}
