//! Random models for the tests: same seed, same model.
#![allow(dead_code, reason = "every test binary uses a part of this module")]

use gadm_runtime::ActionHead;
pub use gadm_runtime::encode::Dense;
use gadm_runtime::encode::{
    ActionSlot, FloatDecoder, FloatModel, HeadEncoding, Interface, ObservationSlot, ProvenanceOwned, Snap,
};

/// SplitMix64 with a normal deviate on top.
pub struct Rng(pub u64);

impl Rng {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// In 0..1.
    pub fn uniform(&mut self) -> f32 {
        (self.next() >> 40) as f32 / (1u64 << 24) as f32
    }

    pub fn normal(&mut self) -> f32 {
        let radius = (-2.0 * self.uniform().max(1e-7).ln()).sqrt();
        radius * (std::f32::consts::TAU * self.uniform()).cos()
    }

    pub fn below(&mut self, n: usize) -> usize {
        (self.next() % n as u64) as usize
    }
}

/// He-initialised, with `gain` on the weights.
pub fn dense(rng: &mut Rng, rows: usize, cols: usize, gain: f32) -> Dense {
    let deviation = gain * (2.0 / cols as f32).sqrt();
    Dense {
        rows,
        cols,
        weight: (0..rows * cols).map(|_| deviation * rng.normal()).collect(),
        bias: (0..rows).map(|_| 0.1 * rng.normal()).collect(),
    }
}

/// Uniform in +-1/sqrt(fan in), as PyTorch and our trainer start; no tails, the hardest case for the bounds.
pub fn dense_uniform(rng: &mut Rng, rows: usize, cols: usize, gain: f32) -> Dense {
    let bound = gain / (cols as f32).sqrt();
    let mut draw = || bound * (2.0 * rng.uniform() - 1.0);
    Dense { rows, cols, weight: (0..rows * cols).map(|_| draw()).collect(), bias: (0..rows).map(|_| draw()).collect() }
}

pub fn chain(rng: &mut Rng, widths: &[usize], last_gain: f32) -> Vec<Dense> {
    let last = widths.len() - 2;
    widths
        .windows(2)
        .enumerate()
        .map(|(index, pair)| dense(rng, pair[1], pair[0], if index == last { last_gain } else { 1.0 }))
        .collect()
}

pub fn observation_slots(count: usize) -> Vec<ObservationSlot> {
    (0..count).map(|i| ObservationSlot { name: format!("x{i}"), unit: "rad".into(), lo: -10.0, hi: 10.0 }).collect()
}

pub fn continuous(count: usize) -> Vec<ActionSlot> {
    (0..count)
        .map(|i| ActionSlot {
            name: format!("torque{i}"),
            unit: "N m".into(),
            head: ActionHead::Continuous { lo: -1.0, hi: 2.0 },
            safe: 0.0,
        })
        .collect()
}

pub fn provenance() -> ProvenanceOwned {
    ProvenanceOwned {
        environment: "Hopper-v5".into(),
        algorithm: "dqn".into(),
        config_hash: "0123abcd".into(),
        commit: "deadbeef".into(),
        train_seed: 7,
        eval_seed: 8,
        env_steps: 1_000_000,
        ..ProvenanceOwned::default()
    }
}

pub struct Shape<'a> {
    pub obs: usize,
    pub q: &'a [usize],
    pub confidence: Option<&'a [usize]>,
    pub decoder: &'a [usize],
    pub latents: usize,
    pub actions: Vec<ActionSlot>,
    pub heads: Vec<HeadEncoding>,
}

/// A random model with modulated decoder; `shape.q` and the others are hidden widths.
pub fn model(seed: u64, shape: &Shape) -> FloatModel {
    let mut rng = Rng(seed);
    let widths = |hidden: &[usize], last: usize| {
        core::iter::once(shape.obs).chain(hidden.iter().copied()).chain([last]).collect::<Vec<_>>()
    };
    let head_rows = shape.heads.iter().zip(&shape.actions).map(|(h, a)| h.rows(a.head)).sum();
    let mut decoder = chain(&mut rng, &widths(shape.decoder, head_rows), 1.0);
    let (head, state) = (decoder.pop().unwrap(), decoder.remove(0));
    let table = |rng: &mut Rng, mean: f32, deviation: f32| -> Vec<Vec<f32>> {
        (0..shape.latents).map(|_| (0..state.rows).map(|_| mean + deviation * rng.normal()).collect()).collect()
    };
    FloatModel {
        interface: Interface {
            observations: observation_slots(shape.obs),
            actions: shape.actions.clone(),
            control_period_us: 8000,
        },
        obs_mean: (0..shape.obs).map(|_| rng.normal()).collect(),
        obs_std: (0..shape.obs).map(|_| 0.2 + 2.0 * rng.uniform()).collect(),
        q: chain(&mut rng, &widths(shape.q, shape.latents), 1.0),
        confidence: shape.confidence.map(|hidden| chain(&mut rng, &widths(hidden, shape.latents), 2.0)),
        shared_trunk: false,
        beta: 1.0 / shape.latents as f32,
        decoder: FloatDecoder::Modulated {
            scale: table(&mut rng, 1.0, 0.5),
            shift: table(&mut rng, 0.0, 0.5),
            state,
            hidden: decoder,
            head,
        },
        heads: shape.heads.clone(),
        provenance: provenance(),
    }
}

/// The model with a confidence network on the Q-network's last hidden layer; `hidden` are its hidden widths.
pub fn share_trunk(seed: u64, mut model: FloatModel, hidden: &[usize]) -> FloatModel {
    let (latents, trunk) = (model.q.last().unwrap().rows, model.q.last().unwrap().cols);
    let widths: Vec<usize> = core::iter::once(trunk).chain(hidden.iter().copied()).chain([latents]).collect();
    model.confidence = Some(chain(&mut Rng(seed), &widths, 2.0));
    model.shared_trunk = true;
    model
}

/// Observations as the model's normalisation expects them, row-major.
pub fn observations(seed: u64, model: &FloatModel, count: usize) -> Vec<f32> {
    let mut rng = Rng(seed);
    let mut out = vec![];
    for _ in 0..count {
        for (mean, std) in model.obs_mean.iter().zip(&model.obs_std) {
            out.push(mean + std * rng.normal());
        }
    }
    out
}

/// The networks of the Hopper policy: 11-256-256-128-64, 11-256-256-64, 11-256-256-153.
#[must_use]
pub fn hopper(seed: u64) -> FloatModel {
    model(
        seed,
        &Shape {
            obs: 11,
            q: &[256, 256, 128],
            confidence: Some(&[256, 256]),
            decoder: &[256, 256],
            latents: 64,
            actions: continuous(3),
            heads: vec![HeadEncoding::Categorical { atoms: 51, snap: Snap::Edges }; 3],
        },
    )
}
