//! Any bytes: `load` does not panic, and what it accepts can be run.
//!
//! Checksums, interface hash and scratch size are made right first, so that the fuzzer gets past them.
#![no_main]

use gadm_runtime::encode::{AlignedImage, QuantisedModel, reseal};
use gadm_runtime::{FloatPolicy, LoadError, Policy, Scratch, Section};
use libfuzzer_sys::fuzz_target;

/// Repairs what a mutation cannot guess; gives up on anything else.
fn repaired<T>(image: &mut AlignedImage, load: impl Fn(&[u8]) -> Result<T, LoadError>) -> bool {
    for _ in 0..4 {
        reseal(image.as_bytes_mut());
        match load(image) {
            Ok(_) => return true,
            Err(LoadError::InterfaceHash { found, .. }) => {
                image.as_bytes_mut()[24..32].copy_from_slice(&found.to_le_bytes());
            }
            Err(LoadError::Field { section: Section::Header, offset: 36, min, .. }) => {
                image.as_bytes_mut()[36..40].copy_from_slice(&min.to_le_bytes());
            }
            Err(error) => {
                let _ = format!("{error} {error:?}");
                return false;
            }
        }
    }
    false
}

/// The loader that trusts the exporter takes more; a step must stay within the ranges of the file all the same.
fn trusted(image: &AlignedImage) {
    let Ok(policy) = Policy::load_trusted(image) else { return };
    let spec = policy.spec();
    let mut memory = vec![0x5A5A_5A5A; spec.scratch_words];
    let mut scratch = Scratch::new(&mut memory);
    let _ = policy.self_test(&mut scratch);
    let mut action = vec![f32::NAN; usize::from(spec.action_dim)];
    let obs = vec![1.0; usize::from(spec.obs_dim)];
    let decision = policy.act(&obs, &mut scratch, &mut action).expect("a finite observation");
    assert!(decision.latent < spec.num_latents);
    for (value, signal) in action.iter().zip(policy.action_signals()) {
        match signal.head {
            gadm_runtime::ActionHead::Continuous { lo, hi } => assert!((lo..=hi).contains(value)),
            gadm_runtime::ActionHead::Discrete { n } => assert!(*value >= 0.0 && *value < f32::from(n.max(1))),
            gadm_runtime::ActionHead::Binary => assert!(*value == 0.0 || *value == 1.0),
        }
    }
}

fuzz_target!(|data: &[u8]| {
    let mut image = AlignedImage::new(data);
    let _ = Policy::load(&image);
    let mut resealed = AlignedImage::new(data);
    reseal(resealed.as_bytes_mut());
    trusted(&resealed);
    if repaired(&mut image, |bytes| Policy::load(bytes).map(|_| ())) {
        let policy = Policy::load(&image).expect("loaded a moment ago");
        let spec = policy.spec();
        let mut memory = vec![0xA5A5_A5A5; spec.scratch_words];
        let mut scratch = Scratch::new(&mut memory);
        let _ = policy.self_test(&mut scratch);
        let mut action = vec![0.0; usize::from(spec.action_dim)];
        for value in [0.0, 1.0, -3e38, f32::MIN_POSITIVE] {
            let obs = vec![value; usize::from(spec.obs_dim)];
            let decision = policy.act(&obs, &mut scratch, &mut action).expect("a finite observation");
            assert!(decision.latent < spec.num_latents && decision.allowed.contains(decision.latent));
            for (value, signal) in action.iter().zip(policy.action_signals()) {
                match signal.head {
                    gadm_runtime::ActionHead::Continuous { lo, hi } => assert!((lo..=hi).contains(value)),
                    gadm_runtime::ActionHead::Discrete { n } => assert!(*value >= 0.0 && *value < f32::from(n)),
                    gadm_runtime::ActionHead::Binary => assert!(*value == 0.0 || *value == 1.0),
                }
            }
        }
        let names: usize = policy.observation_signals().map(|signal| signal.name.len()).sum();
        assert!(names > 0);
        let sizes = policy.section_sizes();
        assert!(sizes.padding < sizes.total && policy.layers().count() > 0);
        let _ = (policy.trailer().count(), policy.provenance(), QuantisedModel::read(&policy));
    }
    let mut image = AlignedImage::new(data);
    if repaired(&mut image, |bytes| FloatPolicy::load(bytes).map(|_| ())) {
        let policy = FloatPolicy::load(&image).expect("loaded a moment ago");
        let spec = policy.spec();
        let mut memory = vec![0; spec.scratch_words];
        let mut action = vec![0.0; usize::from(spec.action_dim)];
        let _ = policy.self_test(&mut Scratch::new(&mut memory));
        let obs = vec![1.0; usize::from(spec.obs_dim)];
        let _ = policy.act(&obs, &mut Scratch::new(&mut memory), &mut action);
    }
});
