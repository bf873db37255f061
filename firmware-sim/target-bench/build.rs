//! Makes the policies that the programs run: random weights, the shapes of the tables in
//! `docs/src/device-performance.md`, and what the host answers for every observation.
#![allow(clippy::unwrap_used, missing_docs, reason = "a build script may panic and is no API")]

use std::fmt::Write as _;
use std::path::PathBuf;

use gadm_runtime::encode::{
    AlignedImage, FileOptions, FloatDecoder, FloatModel, HeadEncoding, QuantiseOptions, Snap, quantise, write_int8,
};
use gadm_runtime::{ActionHead, Policy, Scratch};

#[path = "src/digest.rs"]
mod digest;
#[path = "../../runtime/tests/support/mod.rs"]
mod support;

use digest::Digest;
use support::{Rng, Shape, continuous, model, observations, share_trunk};

/// Observations a policy is asked on the target: drawn from the calibration, and beyond it.
const ASKED: usize = 96;

/// A policy whose decoder is a table, so that a step is its Q-network, the choice and little else.
fn table(mut model: FloatModel) -> FloatModel {
    let latents = model.q.last().unwrap().rows;
    let slots = model.interface.actions.len();
    let actions = (0..latents).map(|k| vec![k as f32 / latents as f32; slots]).collect();
    model.decoder = FloatDecoder::Table { actions };
    model
}

fn plain(seed: u64, obs: usize, q: &[usize], confidence: Option<&[usize]>, latents: usize) -> FloatModel {
    let heads = vec![HeadEncoding::Tanh];
    table(model(seed, &Shape { obs, q, confidence, decoder: &[8], latents, actions: continuous(1), heads }))
}

fn models() -> Vec<(&'static str, FloatModel)> {
    let categorical = |snap| vec![HeadEncoding::Categorical { atoms: 51, snap }; 3];
    let step = model(
        1,
        &Shape {
            obs: 11,
            q: &[256, 256, 128],
            confidence: Some(&[256, 256]),
            decoder: &[256, 256, 256],
            latents: 64,
            actions: continuous(3),
            heads: categorical(Snap::Edges),
        },
    );
    let mut slots = continuous(4);
    slots[2].head = ActionHead::Discrete { n: 5 };
    slots[3].head = ActionHead::Binary;
    let mut mixed = model(
        6,
        &Shape {
            obs: 7,
            q: &[33, 20],
            confidence: Some(&[18]),
            decoder: &[40, 21],
            latents: 9,
            actions: slots,
            heads: vec![
                HeadEncoding::Tanh,
                HeadEncoding::Categorical { atoms: 7, snap: Snap::Any },
                HeadEncoding::Types,
                HeadEncoding::Switch,
            ],
        },
    );
    // Some observations leave a latent above the threshold and some do not.
    mixed.beta = 0.5;
    let mut equal = plain(7, 4, &[16], Some(&[16]), 8);
    // An untrained predictor: all confidences equal.
    let last = equal.confidence.as_mut().unwrap().last_mut().unwrap();
    last.weight.fill(0.0);
    last.bias.fill(0.25);
    vec![
        ("step_shared", share_trunk(10, step.clone(), &[])),
        ("small_shared", share_trunk(11, mixed.clone(), &[18])),
        ("step", step),
        ("q", plain(2, 11, &[256, 256, 128], None, 64)),
        ("q_confidence", plain(2, 11, &[256, 256, 128], Some(&[256, 256]), 64)),
        ("small", plain(4, 10, &[128, 128, 64], None, 16)),
        ("tiny", plain(5, 13, &[64, 64], None, 4)),
        ("mixed", mixed),
        ("equal", equal),
    ]
}

fn asked(seed: u64, model: &FloatModel) -> Vec<f32> {
    let mut rng = Rng(seed);
    let mut out = observations(seed + 100, model, ASKED / 2);
    let width = model.obs_mean.len();
    for row in 0..ASKED - ASKED / 2 {
        for (mean, std) in model.obs_mean.iter().zip(&model.obs_std) {
            let scale = [0.0, 1e-3, 10.0, 1e30][row % 4];
            out.push(mean + std * scale * rng.normal());
        }
    }
    assert_eq!(out.len(), ASKED * width);
    out
}

fn main() {
    let out = PathBuf::from(std::env::var_os("OUT_DIR").unwrap());
    let here = PathBuf::from(std::env::var_os("CARGO_MANIFEST_DIR").unwrap());
    for file in ["build.rs", "memory.x", "src/digest.rs", "../../runtime/tests/support/mod.rs"] {
        println!("cargo::rerun-if-changed={file}");
    }
    println!("cargo::rustc-link-search={}", here.display());
    println!("cargo::rustc-link-arg-bins=-Tlink.x");
    // Sections start at multiples of 4 in cortex-m-rt's script; pages of 64 KiB would only pad the file.
    println!("cargo::rustc-link-arg-bins=--nmagic");
    let mut code = String::new();
    for (name, model) in models() {
        let calibration = observations(3, &model, 200);
        let quantised = quantise(&model, &calibration, &QuantiseOptions::default()).unwrap();
        let width = model.obs_mean.len();
        let file = write_int8(&quantised, &calibration[..8 * width], &FileOptions::default()).unwrap();
        let image = AlignedImage::new(&file);
        let policy = Policy::load(&image).unwrap();
        let asked = asked(9, &model);
        let mut memory = vec![0; policy.spec().scratch_words];
        let mut action = vec![0.0; usize::from(policy.spec().action_dim)];
        let mut digest = Digest::default();
        let mut fallbacks = 0;
        for obs in asked.chunks_exact(width) {
            let decision = policy.act(obs, &mut Scratch::new(&mut memory), &mut action).unwrap();
            fallbacks += usize::from(decision.fallback);
            digest.step(&decision, &action);
        }
        if name == "mixed" {
            assert!(0 < fallbacks && fallbacks < ASKED, "{fallbacks} of {ASKED} steps without a latent");
        }
        std::fs::write(out.join(format!("{name}.bin")), &file).unwrap();
        let bytes: Vec<u8> = asked.iter().flat_map(|x| x.to_le_bytes()).collect();
        std::fs::write(out.join(format!("{name}.obs")), bytes).unwrap();
        let constant = name.to_uppercase();
        let path = |extension| format!("include_bytes!(concat!(env!(\"OUT_DIR\"), \"/{name}.{extension}\"))");
        writeln!(
            code,
            "/// Policy `{name}`.\npub static {constant}: Case = Case {{ name: \"{name}\", image: &Aligned(*{}).0, \
             observations: &Aligned(*{}).0, digest: {:#018x} }};",
            path("bin"),
            path("obs"),
            digest.value()
        )
        .unwrap();
    }
    std::fs::write(out.join("cases.rs"), code).unwrap();
}
