//! The loader that trusts the exporter: the same policy from a good file, and from any other an error or an action in range.
#![cfg(feature = "encode")]
#![allow(clippy::unwrap_used, reason = "tests may panic")]

mod support;

use gadm_runtime::encode::{
    ActionSlot, AlignedImage, FileOptions, FloatDecoder, FloatModel, HeadEncoding, QuantiseOptions, Snap, quantise,
    reseal, write_float, write_int8,
};
use gadm_runtime::{ActionHead, LoadError, Policy, Scratch, WeightKind};
use support::{Rng, Shape, continuous, model, observations, share_trunk};

/// Every kind of head behind a mask.
fn every_head() -> FloatModel {
    let mut actions = continuous(2);
    actions[1].name = "torque_cat".into();
    let slot = |name: &str, head| ActionSlot { name: name.into(), unit: String::new(), head, safe: 1.0 };
    actions.push(slot("gear", ActionHead::Discrete { n: 3 }));
    actions.push(slot("valve", ActionHead::Binary));
    let heads = vec![
        HeadEncoding::Tanh,
        HeadEncoding::Categorical { atoms: 11, snap: Snap::Any },
        HeadEncoding::Types,
        HeadEncoding::Switch,
    ];
    model(3, &Shape { obs: 3, q: &[10], confidence: Some(&[6]), decoder: &[9, 7], latents: 5, actions, heads })
}

/// The same slots from a table.
fn table() -> FloatModel {
    let actions = vec![vec![-1.0, 0.25, 2.0, 1.0], vec![1.0, -0.5, 0.0, 0.0], vec![0.0, 0.0, 1.0, 1.0]];
    let mut model = every_head();
    let whole = model.q.len() - 1;
    model.q[whole].weight.truncate(3 * 10);
    model.q[whole].bias.truncate(3);
    model.q[whole].rows = 3;
    FloatModel { confidence: None, decoder: FloatDecoder::Table { actions }, ..model }
}

fn written(model: &FloatModel) -> Vec<u8> {
    let quantised = quantise(model, &observations(1, model, 64), &QuantiseOptions::default()).unwrap();
    write_int8(&quantised, &observations(2, model, 3), &FileOptions::default()).unwrap()
}

fn files() -> Vec<Vec<u8>> {
    [every_head(), share_trunk(5, every_head(), &[]), table()].iter().map(written).collect()
}

/// A step and the self-test of what the loader takes: no panic, and the action is one of the file's interface.
fn steps_stay_in_range(image: &AlignedImage) -> bool {
    let Ok(policy) = Policy::load_trusted(image) else { return false };
    let spec = policy.spec();
    let mut memory = vec![0xA5A5_A5A5; spec.scratch_words];
    let mut scratch = Scratch::new(&mut memory);
    let _ = policy.self_test(&mut scratch);
    for value in [1.0, -3e38, f32::MIN_POSITIVE] {
        let mut action = vec![f32::NAN; usize::from(spec.action_dim)];
        let obs = vec![value; usize::from(spec.obs_dim)];
        let decision = policy.act(&obs, &mut scratch, &mut action).unwrap();
        assert!(decision.latent < spec.num_latents);
        assert_eq!(policy.action_signals().count(), action.len());
        for (value, signal) in action.iter().zip(policy.action_signals()) {
            match signal.head {
                ActionHead::Continuous { lo, hi } => assert!((lo..=hi).contains(value), "{value} in {lo}..={hi}"),
                ActionHead::Discrete { n } => {
                    assert!(value.fract() == 0.0 && (0.0..f32::from(n.max(1))).contains(value));
                }
                ActionHead::Binary => assert!(*value == 0.0 || *value == 1.0),
            }
        }
    }
    let _ = (policy.trailer().count(), policy.provenance(), policy.section_sizes(), policy.layers().count());
    let _ = policy.observation_signals().map(|signal| signal.name.len()).sum::<usize>();
    true
}

#[test]
fn a_proven_file_gives_the_same_policy() {
    for bytes in files() {
        let image = AlignedImage::new(&bytes);
        let (proven, trusted) = (Policy::load(&image).unwrap(), Policy::load_trusted(&image).unwrap());
        assert_eq!((proven.spec(), proven.header()), (trusted.spec(), trusted.header()));
        let mut memory = vec![0; proven.spec().scratch_words];
        let mut scratch = Scratch::new(&mut memory);
        trusted.self_test(&mut scratch).unwrap();
        let mut rng = Rng(7);
        for _ in 0..300 {
            let obs: Vec<f32> = (0..3).map(|_| 4.0 * rng.normal()).collect();
            let (mut x, mut y) = ([0.0f32; 4], [0.0f32; 4]);
            let expected = proven.act(&obs, &mut scratch, &mut x).unwrap();
            assert_eq!(trusted.act(&obs, &mut scratch, &mut y).unwrap(), expected);
            assert_eq!(x.map(f32::to_bits), y.map(f32::to_bits));
        }
    }
}

#[test]
fn damage_versions_and_float_files_are_refused() {
    let model = every_head();
    let bytes = written(&model);
    for len in 0..bytes.len() {
        let expected = if len < 64 { 64 } else { bytes.len() };
        let error = Policy::load_trusted(&AlignedImage::new(&bytes[..len])).unwrap_err();
        assert_eq!(error, LoadError::Truncated { expected, found: len });
    }
    let mut image = AlignedImage::new(&bytes);
    let trailer = bytes.len() - 16;
    for at in 0..trailer {
        image.as_bytes_mut()[at] ^= 0x10;
        assert!(Policy::load_trusted(&image).is_err(), "byte {at}");
        image.as_bytes_mut()[at] ^= 0x10;
    }
    let changed = |at: usize, value: u8| {
        let mut bytes = bytes.clone();
        bytes[at] = value;
        reseal(&mut bytes);
        Policy::load_trusted(&AlignedImage::new(&bytes)).unwrap_err()
    };
    assert_eq!(changed(8, 2), LoadError::Version { format: 2, numerics: 1, runtime_abi: 1 });
    assert_eq!(changed(10, 7), LoadError::Version { format: 1, numerics: 7, runtime_abi: 1 });
    assert_eq!(changed(40, 9), LoadError::Version { format: 1, numerics: 1, runtime_abi: 9 });
    assert_eq!(changed(0, 0), LoadError::NotAPolicy { found: [0, b'G', b'D', b'M', b'\r', b'\n', 0x1A, b'\n'] });
    let float = write_float(&model, &observations(2, &model, 2), &FileOptions::default()).unwrap();
    let error = Policy::load_trusted(&AlignedImage::new(&float)).unwrap_err();
    assert_eq!(error, LoadError::WeightKind { expected: WeightKind::Int8, found: 1 });
}

#[test]
fn no_byte_of_a_file_can_make_an_action_leave_its_range() {
    for bytes in files() {
        let mut taken = 0;
        for at in 12..bytes.len() {
            for value in [0, 1, 0x7F, 0x80, 0xFF] {
                let mut changed = bytes.clone();
                changed[at] = value;
                reseal(&mut changed);
                taken += u32::from(steps_stay_in_range(&AlignedImage::new(&changed)));
            }
        }
        assert!(taken > 1000, "the steps of {taken} files were tried");
    }
}

#[test]
fn random_damage_is_refused_or_harmless() {
    let mut rng = Rng(11);
    let files = files();
    let mut taken = 0;
    for _ in 0..6000 {
        let mut changed = files[rng.below(files.len())].clone();
        // Half of the time all of a stretch, which is how a wrong exporter would be wrong.
        let (from, len) = (12 + rng.below(changed.len() - 12), 1 + rng.below(40));
        let dense = rng.next().is_multiple_of(2);
        for byte in changed.iter_mut().skip(from).take(len) {
            if dense || rng.below(8) == 0 {
                *byte = rng.next() as u8;
            }
        }
        reseal(&mut changed);
        taken += u32::from(steps_stay_in_range(&AlignedImage::new(&changed)));
    }
    assert!(taken > 1000, "the steps of {taken} files were tried");
}
