//! The float runtime against the float model: the same policy but for the order of sums.
#![cfg(all(feature = "encode", feature = "float"))]
#![allow(clippy::unwrap_used, reason = "tests may panic")]

mod support;

use gadm_runtime::encode::{AlignedImage, FileOptions, FloatDecoder, FloatModel, reseal, write_float};
use gadm_runtime::{ActError, FloatPolicy, LoadError, Scratch, WeightKind};
use support::{hopper, observations, share_trunk};

#[test]
fn the_float_policy_takes_the_steps_of_the_model() {
    for model in [hopper(1), share_trunk(7, hopper(1), &[]), share_trunk(8, hopper(1), &[32])] {
        takes_the_steps(&model);
    }
}

fn takes_the_steps(model: &FloatModel) {
    let bytes = write_float(model, &observations(2, model, 4), &FileOptions::default()).unwrap();
    let image = AlignedImage::new(&bytes);
    let policy = FloatPolicy::load(&image).unwrap();
    assert_eq!(policy.spec().weights, WeightKind::Float32);
    assert_eq!(policy.spec().scratch_words * 4, 2704);
    assert_eq!(policy.shared_trunk(), model.shared_trunk);
    let mut memory = vec![0; policy.spec().scratch_words];
    policy.self_test(&mut Scratch::new(&mut memory)).unwrap();
    let (mut expected, mut found) = ([0.0; 3], [0.0; 3]);
    let mut same = 0;
    for obs in observations(3, model, 500).chunks(11) {
        let reference = model.act(obs, &mut expected);
        let decision = policy.act(obs, &mut Scratch::new(&mut memory), &mut found).unwrap();
        if reference.latent == decision.latent {
            same += 1;
            assert!((reference.q - decision.q).abs() < 1e-4);
            assert!(expected.iter().zip(&found).all(|(x, y)| (x - y).abs() < 1e-4), "{expected:?} {found:?}");
        }
    }
    assert!(same >= 499, "{same} of 500");
}

#[test]
fn table_decoders_are_the_same() {
    let mut model = hopper(2);
    model.decoder =
        FloatDecoder::Table { actions: (0..64).map(|k| vec![k as f32 / 64.0, -0.5, 1.0 - k as f32 / 32.0]).collect() };
    let bytes = write_float(&model, &observations(2, &model, 4), &FileOptions::default()).unwrap();
    let image = AlignedImage::new(&bytes);
    let policy = FloatPolicy::load(&image).unwrap();
    let mut memory = vec![0; policy.spec().scratch_words];
    let (mut expected, mut found) = ([0.0; 3], [0.0; 3]);
    for obs in observations(3, &model, 50).chunks(11) {
        model.act(obs, &mut expected);
        policy.act(obs, &mut Scratch::new(&mut memory), &mut found).unwrap();
        assert_eq!(expected, found);
    }
}

#[test]
fn wrong_calls_and_files_are_refused() {
    let model = hopper(1);
    let bytes = write_float(&model, &observations(2, &model, 1), &FileOptions::default()).unwrap();
    let image = AlignedImage::new(&bytes);
    let policy = FloatPolicy::load(&image).unwrap();
    let mut memory = vec![0; policy.spec().scratch_words];
    let mut scratch = Scratch::new(&mut memory);
    let error = policy.act(&[0.0; 3], &mut scratch, &mut [0.0; 3]).unwrap_err();
    assert_eq!(error, ActError::ObservationLength { expected: 11, found: 3 });
    let error = policy.act(&[f32::NAN; 11], &mut scratch, &mut [0.0; 3]).unwrap_err();
    assert_eq!(error, ActError::NonFinite { index: 0 });
    let error = policy.act(&[0.0; 11], &mut scratch, &mut [0.0; 2]).unwrap_err();
    assert_eq!(error, ActError::ActionLength { expected: 3, found: 2 });
    let error = policy.act(&[0.0; 11], &mut Scratch::new(&mut []), &mut [0.0; 3]).unwrap_err();
    assert_eq!(error, ActError::ScratchLength { expected: 676, found: 0 });

    let mut wrong = bytes;
    let last = wrong.len() - 200_000;
    wrong[last / 4 * 4..][..4].copy_from_slice(&f32::INFINITY.to_le_bytes());
    reseal(&mut wrong);
    let image = AlignedImage::new(&wrong);
    assert!(matches!(FloatPolicy::load(&image), Err(LoadError::Number { .. })));
}
