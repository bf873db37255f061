//! Policy files: writing, reading back, and everything that can be wrong with one.
#![cfg(feature = "encode")]
#![allow(clippy::unwrap_used, reason = "tests may panic")]

mod support;

use gadm_runtime::encode::{
    AlignedImage, FileOptions, FloatDecoder, FloatModel, HeadEncoding, QuantiseOptions, QuantisedModel, Snap,
    TrailerRecord, quantise, reseal, write_float, write_int8,
};
use gadm_runtime::{ActError, ActionHead, LoadError, Policy, Scratch, Section, SelfTestError, WeightKind};
use proptest::prelude::*;
use support::{Rng, Shape, continuous, model, observations, share_trunk};

/// A small policy with every kind of head.
fn small() -> FloatModel {
    let mut actions = continuous(2);
    actions[1].name = "torque_cat".into();
    actions.push(gadm_runtime::encode::ActionSlot {
        name: "gear".into(),
        unit: String::new(),
        head: ActionHead::Discrete { n: 3 },
        safe: 2.0,
    });
    actions.push(gadm_runtime::encode::ActionSlot {
        name: "valve".into(),
        unit: String::new(),
        head: ActionHead::Binary,
        safe: 1.0,
    });
    let heads = vec![
        HeadEncoding::Tanh,
        HeadEncoding::Categorical { atoms: 11, snap: Snap::Any },
        HeadEncoding::Types,
        HeadEncoding::Switch,
    ];
    let shape = Shape { obs: 3, q: &[10], confidence: Some(&[6]), decoder: &[9, 7], latents: 5, actions, heads };
    model(3, &shape)
}

fn quantised(model: &FloatModel) -> QuantisedModel {
    quantise(model, &observations(1, model, 64), &QuantiseOptions::default()).unwrap()
}

fn written(model: &FloatModel) -> Vec<u8> {
    let options = FileOptions { policy_seq: 42, trailer: vec![TrailerRecord { kind: 900, data: vec![1, 2, 3] }] };
    write_int8(&quantised(model), &observations(2, model, 3), &options).unwrap()
}

fn load_error(bytes: &[u8]) -> LoadError {
    Policy::load(&AlignedImage::new(bytes)).unwrap_err()
}

/// Changes bytes, makes the checksums right again, and gives the error.
fn changed(bytes: &[u8], at: usize, new: &[u8]) -> LoadError {
    let mut bytes = bytes.to_vec();
    bytes[at..at + new.len()].copy_from_slice(new);
    reseal(&mut bytes);
    load_error(&bytes)
}

#[test]
fn everything_written_comes_back() {
    let model = small();
    let image = AlignedImage::new(&written(&model));
    let policy = Policy::load(&image).unwrap();
    let spec = policy.spec();
    assert_eq!((spec.obs_dim, spec.action_dim, spec.num_latents), (3, 4, 5));
    assert_eq!(spec.control_period_us, 8000);
    assert_eq!(spec.weights, WeightKind::Int8);
    assert_eq!(spec.macs, 3 * 10 + 10 * 5 + 3 * 6 + 6 * 5 + 3 * 9 + 9 * 7 + 7 * 16);
    assert_eq!(policy.header().policy_seq, 42);
    let names: Vec<&str> = policy.observation_signals().map(|signal| signal.name).collect();
    assert_eq!(names, ["x0", "x1", "x2"]);
    assert!(policy.observation_signals().all(|s| s.unit == "rad" && s.lo == -10.0 && s.hi == 10.0));
    let actions: Vec<_> = policy.action_signals().collect();
    assert_eq!(actions[1].head, ActionHead::Continuous { lo: -1.0, hi: 2.0 });
    assert_eq!(actions[2].head, ActionHead::Discrete { n: 3 });
    assert_eq!((actions[2].safe, actions[3].safe, actions[3].name), (2.0, 1.0, "valve"));
    let provenance = policy.provenance();
    assert_eq!((provenance.environment, provenance.commit, provenance.eval_seed), ("Hopper-v5", "deadbeef", 8));
    assert_eq!(policy.trailer().collect::<Vec<_>>(), [(900, &[1, 2, 3][..])]);
    assert_eq!(policy.mask_threshold(), Some((1, 5)));
    let sizes = policy.section_sizes();
    assert_eq!(sizes.total, image.len());
    assert!(sizes.padding < 200, "{sizes:?}");
    let shapes: Vec<_> = policy.layers().map(|l| (l.network, l.rows, l.cols, l.out_bits)).collect();
    assert_eq!(shapes[0], (Section::Q, 10, 3, 10));
    assert_eq!(shapes[6], (Section::Decoder, 16, 7, 32));
    assert_eq!(shapes.len(), 7);
    policy.self_test(&mut Scratch::new(&mut vec![0; spec.scratch_words])).unwrap();
}

#[test]
fn write_load_write_is_the_identity() {
    let model = small();
    let options = FileOptions { policy_seq: 42, trailer: vec![TrailerRecord { kind: 900, data: vec![1, 2, 3] }] };
    let first = written(&model);
    let image = AlignedImage::new(&first);
    let policy = Policy::load(&image).unwrap();
    let again = write_int8(&QuantisedModel::read(&policy), &observations(2, &model, 3), &options).unwrap();
    assert_eq!(first, again);
}

/// Where the record of the confidence network's first layer says what it reads.
fn reads_at(bytes: &[u8]) -> usize {
    let section = u32::from_le_bytes(bytes[64 + 3 * 8..][..4].try_into().unwrap()) as usize;
    section + 16 + 6
}

#[test]
fn a_confidence_network_on_the_q_networks_trunk() {
    for hidden in [&[][..], &[7]] {
        let model = share_trunk(4, small(), hidden);
        let bytes = written(&model);
        let image = AlignedImage::new(&bytes);
        let policy = Policy::load(&image).unwrap();
        assert!(policy.shared_trunk());
        assert_eq!(policy.header().runtime_abi, 2, "a runtime that does not know it must refuse it");
        assert_eq!(policy.layers().nth(2).map(|layer| (layer.network, layer.cols)), Some((Section::Confidence, 10)));
        let options = FileOptions { policy_seq: 42, trailer: vec![TrailerRecord { kind: 900, data: vec![1, 2, 3] }] };
        let again = write_int8(&QuantisedModel::read(&policy), &observations(2, &model, 3), &options).unwrap();
        assert_eq!(bytes, again);
        // The file and the header must agree on what the first layer reads.
        let at = reads_at(&bytes);
        assert_eq!(bytes[at..at + 2], [1, 0]);
        assert!(matches!(changed(&bytes, at, &[0, 0]), LoadError::Field { min: 1, max: 1, found: 0, .. }));
        assert!(matches!(changed(&bytes, at, &[2, 0]), LoadError::Field { min: 1, max: 1, found: 2, .. }));
        assert!(matches!(
            changed(&bytes, 40, &[1]),
            LoadError::Field { section: Section::Confidence, min: 3, max: 3, found: 10, .. }
        ));
    }
    let separate = written(&small());
    assert_eq!(Policy::load(&AlignedImage::new(&separate)).unwrap().header().runtime_abi, 1);
    assert!(matches!(changed(&separate, reads_at(&separate), &[1, 0]), LoadError::Field { max: 0, found: 1, .. }));
}

#[test]
fn a_shared_trunk_must_be_there() {
    let mut model = share_trunk(4, small(), &[]);
    model.q.remove(0);
    let error = quantise(&model, &observations(1, &model, 8), &QuantiseOptions::default()).unwrap_err();
    assert!(error.to_string().contains("columns"), "{error}");
    model.q[0] = support::dense(&mut Rng(1), 5, 3, 1.0);
    let error = quantise(&model, &observations(1, &model, 8), &QuantiseOptions::default()).unwrap_err();
    assert!(error.to_string().contains("shared trunk"), "{error}");
    let model = share_trunk(4, small(), &[12, 6]);
    let error = quantise(&model, &observations(1, &model, 8), &QuantiseOptions::default()).unwrap_err();
    assert!(error.to_string().contains("1..=2"), "{error}");
    let mut model = small();
    (model.confidence, model.shared_trunk) = (None, true);
    let error = quantise(&model, &observations(1, &model, 8), &QuantiseOptions::default()).unwrap_err();
    assert!(error.to_string().contains("shared trunk"), "{error}");
    // A file of runtime ABI 2 without a confidence network.
    model.shared_trunk = false;
    let error = changed(&written(&model), 40, &[2]);
    assert!(matches!(error, LoadError::SectionLength { section: Section::Confidence, .. }), "{error}");
}

#[test]
fn a_table_decoder_gives_its_constants() {
    let mut model = small();
    let actions = vec![
        vec![-1.0, 1.0, 0.0, 0.0],
        vec![0.0, 0.5, 1.0, 1.0],
        vec![1.0, -1.0, 2.0, 0.0],
        vec![0.25, 0.0, 0.0, 1.0],
        vec![-0.5, 0.0, 1.0, 0.0],
    ];
    model.decoder = FloatDecoder::Table { actions: actions.clone() };
    let first = written(&model);
    let image = AlignedImage::new(&first);
    let policy = Policy::load(&image).unwrap();
    let mut memory = vec![0; policy.spec().scratch_words];
    for obs in observations(5, &model, 50).chunks(3) {
        let mut action = [0.0; 4];
        let decision = policy.act(obs, &mut Scratch::new(&mut memory), &mut action).unwrap();
        let raw = &actions[usize::from(decision.latent)];
        assert_eq!(action[0], ActionHead::Continuous { lo: -1.0, hi: 2.0 }.denormalise(raw[0]));
        assert_eq!(action[2..], raw[2..]);
    }
    let options = FileOptions { policy_seq: 42, trailer: vec![TrailerRecord { kind: 900, data: vec![1, 2, 3] }] };
    let again = write_int8(&QuantisedModel::read(&policy), &observations(2, &model, 3), &options).unwrap();
    assert_eq!(first, again);
}

#[test]
fn a_policy_without_confidence_network_allows_every_latent() {
    let mut model = small();
    model.confidence = None;
    let image = AlignedImage::new(&written(&model));
    let policy = Policy::load(&image).unwrap();
    let mut memory = vec![0; policy.spec().scratch_words];
    let decision = policy.act(&[0.0; 3], &mut Scratch::new(&mut memory), &mut [0.0; 4]).unwrap();
    assert_eq!((decision.allowed.len(), decision.fallback), (5, false));
    assert_eq!(policy.mask_threshold(), None);
}

#[test]
fn an_untrained_confidence_network_falls_back_to_every_latent() {
    let mut model = small();
    for layer in model.confidence.as_mut().unwrap() {
        layer.weight.fill(0.0);
        layer.bias.fill(0.0);
    }
    let image = AlignedImage::new(&written(&model));
    let policy = Policy::load(&image).unwrap();
    let mut memory = vec![0; policy.spec().scratch_words];
    let decision = policy.act(&[0.0; 3], &mut Scratch::new(&mut memory), &mut [0.0; 4]).unwrap();
    assert_eq!((decision.allowed.len(), decision.fallback), (5, true));
}

#[test]
fn infinite_bounds_are_taken_from_the_calibration() {
    let mut model = small();
    model.interface.observations[1].hi = f32::INFINITY;
    let quantised = quantised(&model);
    let calibration = observations(1, &model, 64);
    let largest = calibration.iter().skip(1).step_by(3).copied().fold(f32::MIN, f32::max);
    let hi = quantised.interface().observations[1].hi;
    assert!(hi > largest && hi.is_finite());
    assert!(write_int8(&quantised, &calibration[..3], &FileOptions::default()).is_ok());
}

#[test]
fn the_file_may_lie_in_a_longer_slot() {
    let mut bytes = written(&small());
    bytes.extend([0xFF; 1000]);
    assert!(Policy::load(&AlignedImage::new(&bytes)).is_ok());
}

#[test]
fn truncated_files_are_refused_at_every_length() {
    let bytes = written(&small());
    for len in 0..bytes.len() {
        let expected = if len < 64 { 64 } else { bytes.len() };
        assert_eq!(load_error(&bytes[..len]), LoadError::Truncated { expected, found: len });
    }
}

#[test]
fn foreign_files_are_named() {
    assert_eq!(load_error(&[0xFF; 256]), LoadError::Erased);
    assert_eq!(load_error(&[0; 256]), LoadError::Erased);
    let elf = [b"\x7FELF".as_slice(), &[1; 60]].concat();
    assert!(matches!(load_error(&elf), LoadError::NotAPolicy { found } if found.starts_with(b"\x7FELF")));
    let bytes = written(&small());
    let unix: Vec<u8> = bytes.iter().copied().filter(|&byte| byte != b'\r').chain([0; 16]).collect();
    assert!(matches!(load_error(&unix), LoadError::TextDamage { .. }));
    let seven: Vec<u8> = bytes.iter().map(|byte| byte & 0x7F).collect();
    assert!(matches!(load_error(&seven), LoadError::TextDamage { .. }));
}

#[test]
fn newer_versions_are_named() {
    let bytes = written(&small());
    assert_eq!(changed(&bytes, 8, &[2, 0]), LoadError::Version { format: 2, numerics: 1, runtime_abi: 1 });
    assert_eq!(changed(&bytes, 10, &[7, 0]), LoadError::Version { format: 1, numerics: 7, runtime_abi: 1 });
    assert_eq!(changed(&bytes, 40, &[9, 0, 0, 0]), LoadError::Version { format: 1, numerics: 1, runtime_abi: 9 });
}

#[test]
fn float_files_are_refused_by_the_integer_runtime() {
    let model = small();
    let bytes = write_float(&model, &observations(2, &model, 2), &FileOptions::default()).unwrap();
    assert_eq!(load_error(&bytes), LoadError::WeightKind { expected: WeightKind::Int8, found: 1 });
}

#[test]
fn misaligned_images_are_refused() {
    let bytes = written(&small());
    let shifted = [&[0u8][..], &bytes].concat();
    let image = AlignedImage::new(&shifted);
    assert_eq!(Policy::load(&image[1..]).unwrap_err(), LoadError::Misaligned { expected: 4, found: 1 });
}

#[test]
fn every_single_bit_flip_is_noticed() {
    let bytes = written(&small());
    let mut image = AlignedImage::new(&bytes);
    for at in 0..bytes.len() {
        for bit in 0..8 {
            image.as_bytes_mut()[at] ^= 1 << bit;
            // Only the kind of a trailer record that nobody knows is not covered by a checksum.
            assert!(Policy::load(&image).is_err() || is_trailer_kind(&bytes, at), "byte {at} bit {bit}");
            image.as_bytes_mut()[at] ^= 1 << bit;
        }
    }
}

fn is_trailer_kind(bytes: &[u8], at: usize) -> bool {
    let start = bytes.len() - 32;
    (start..start + 2).contains(&at)
}

#[test]
fn bounds_are_proven_from_the_weights() {
    let bytes = written(&small());
    let image = AlignedImage::new(&bytes);
    let q = section(&bytes, 2);
    let stream = u32::from_le_bytes(bytes[q + 24..q + 28].try_into().unwrap()) as usize;
    Policy::load(&image).unwrap();
    // First block: start values, 8 column pairs of 2 words, M, P.
    let at_m = stream + 16 + 64;
    let huge = (i32::MAX).to_le_bytes();
    assert!(matches!(
        changed(&bytes, at_m + 16, &huge),
        LoadError::Bound { section: Section::Q, row: 0, limit: 0x3FFF_FFFF, .. }
    ));
    // raw0 - b0 is 256 times the start of the first row.
    let raw = 0x7FFF_FF00i32.to_le_bytes();
    assert!(matches!(
        changed(&bytes, stream, &[raw, [0; 4]].concat()),
        LoadError::Bound { section: Section::Q, layer: 0, row: 0, limit: 0x7FFF_FFFF, .. }
    ));
    // A b weight of -128.
    let lane = (-128i16).to_le_bytes();
    assert_eq!(changed(&bytes, stream + 16, &lane), LoadError::Weight { section: Section::Q, layer: 0, row: 1 });
    // A weight in the padding: column 3 of 3, lane 1 of the second word pair.
    assert_eq!(
        changed(&bytes, stream + 16 + 8 + 2, &[1, 0]),
        LoadError::PaddedWeight { section: Section::Q, layer: 0, row: 1 }
    );
}

/// Offset of section `index` of the table.
fn section(bytes: &[u8], index: usize) -> usize {
    u32::from_le_bytes(bytes[64 + index * 8..68 + index * 8].try_into().unwrap()) as usize
}

#[test]
fn fields_outside_of_their_range_are_named_with_their_place() {
    let bytes = written(&small());
    let interface = section(&bytes, 0);
    assert!(matches!(
        changed(&bytes, interface, &[0xFF, 0xFF]),
        LoadError::Field { section: Section::Interface, min: 1, max: 512, found: 0xFFFF, offset } if offset == interface
    ));
    let nan = f32::NAN.to_le_bytes();
    assert!(matches!(
        changed(&bytes, section(&bytes, 1) + 16, &nan),
        LoadError::Number { section: Section::Input, found, .. } if found.is_nan()
    ));
    assert!(matches!(
        changed(&bytes, section(&bytes, 1) + 20, &(-1.0f32).to_le_bytes()),
        LoadError::Number { section: Section::Input, found: -1.0, .. }
    ));
    assert!(matches!(
        changed(&bytes, 36, &[1, 0, 0, 0]),
        LoadError::Field { section: Section::Header, offset: 36, .. }
    ));
    assert!(matches!(changed(&bytes, 24, &[1, 2, 3]), LoadError::InterfaceHash { .. }));
    assert!(matches!(
        changed(&bytes, 68, &[1, 0, 0, 0]),
        LoadError::Field { section: Section::Table, .. } | LoadError::SectionLength { .. }
    ));
    let text = interface + 16 + 3 * 16 + 4 * 24;
    assert!(
        matches!(changed(&bytes, text, &[0xFF]), LoadError::Text { section: Section::Interface, offset } if offset == text)
    );
    assert!(matches!(changed(&bytes, text, b"\n"), LoadError::Text { .. }));
}

#[test]
fn a_policy_that_fails_its_own_vectors_says_which() {
    let bytes = written(&small());
    let vectors = section(&bytes, 5) + 16;
    let mut wrong = bytes.clone();
    wrong[vectors + 12] ^= 1;
    reseal(&mut wrong);
    let image = AlignedImage::new(&wrong);
    let policy = Policy::load(&image).unwrap();
    let mut memory = vec![0; policy.spec().scratch_words];
    let error = policy.self_test(&mut Scratch::new(&mut memory)).unwrap_err();
    assert!(matches!(error, SelfTestError::Latent { vector: 0, .. }), "{error:?}");

    let mut wrong = bytes;
    // The lowest bit of the first action of the second vector (3 observations, latent, 4 actions).
    wrong[vectors + 32 + 16] ^= 1;
    reseal(&mut wrong);
    let image = AlignedImage::new(&wrong);
    let policy = Policy::load(&image).unwrap();
    let error = policy.self_test(&mut Scratch::new(&mut memory)).unwrap_err();
    assert!(matches!(error, SelfTestError::Action { vector: 1, slot: 0, .. }), "{error:?}");
}

#[test]
fn wrong_calls_say_what_was_expected_and_leave_the_action_alone() {
    let image = AlignedImage::new(&written(&small()));
    let policy = Policy::load(&image).unwrap();
    let words = policy.spec().scratch_words;
    let mut memory = vec![0; words];
    let mut action = [7.0; 4];
    let mut act = |obs: &[f32], words: usize, slots: usize| {
        policy.act(obs, &mut Scratch::new(&mut memory[..words]), &mut action[..slots]).unwrap_err()
    };
    assert_eq!(act(&[0.0; 2], words, 4), ActError::ObservationLength { expected: 3, found: 2 });
    assert_eq!(act(&[0.0; 4], words, 4), ActError::ObservationLength { expected: 3, found: 4 });
    assert_eq!(act(&[0.0, f32::NAN, 0.0], words, 4), ActError::NonFinite { index: 1 });
    assert_eq!(act(&[0.0, 0.0, f32::INFINITY], words, 4), ActError::NonFinite { index: 2 });
    assert_eq!(act(&[f32::NEG_INFINITY, 0.0, 0.0], words, 4), ActError::NonFinite { index: 0 });
    assert_eq!(act(&[0.0; 3], words, 3), ActError::ActionLength { expected: 4, found: 3 });
    assert_eq!(act(&[0.0; 3], words - 1, 4), ActError::ScratchLength { expected: words, found: words - 1 });
    assert_eq!(action, [7.0; 4]);
    assert_eq!(
        policy.self_test(&mut Scratch::new(&mut [])),
        Err(SelfTestError::Act(ActError::ScratchLength { expected: words, found: 0 }))
    );
}

#[test]
fn extreme_observations_are_clipped_and_flagged() {
    let image = AlignedImage::new(&written(&small()));
    let policy = Policy::load(&image).unwrap();
    let mut memory = vec![0; policy.spec().scratch_words];
    let mut action = [0.0; 4];
    let mut act = |obs: &[f32]| policy.act(obs, &mut Scratch::new(&mut memory), &mut action).unwrap();
    assert!(act(&[f32::MAX, f32::MIN, 0.0]).clipped);
    assert!(!act(&[0.0; 3]).clipped);
}

#[test]
fn scratch_content_does_not_matter() {
    let model = small();
    let image = AlignedImage::new(&written(&model));
    let policy = Policy::load(&image).unwrap();
    let run = |fill: u32, obs: &[f32]| {
        let mut memory = vec![fill; policy.spec().scratch_words];
        let mut action = [0.0; 4];
        let decision = policy.act(obs, &mut Scratch::new(&mut memory), &mut action).unwrap();
        (decision, action.map(f32::to_bits))
    };
    for obs in observations(9, &model, 20).chunks(3) {
        assert_eq!(run(0, obs), run(0xDEAD_BEEF, obs));
        assert_eq!(run(0, obs), run(u32::MAX, obs));
    }
}

#[test]
fn quantised_observations_take_the_same_step() {
    let model = small();
    let image = AlignedImage::new(&written(&model));
    let policy = Policy::load(&image).unwrap();
    let mut memory = vec![0; policy.spec().scratch_words];
    let (mut x, mut y) = ([0.0; 4], [0.0; 4]);
    for obs in observations(9, &model, 20).chunks(3) {
        let quantised: Vec<i16> =
            policy.input_quantisers().zip(obs).map(|(quantiser, &x)| quantiser.quantise(x).0).collect();
        let float = policy.act(obs, &mut Scratch::new(&mut memory), &mut x).unwrap();
        let int = policy.act_q(&quantised, &mut Scratch::new(&mut memory), &mut y).unwrap();
        assert_eq!((float.latent, float.q, x), (int.latent, int.q, y));
    }
    let decision = policy.act_q(&[i16::MAX, i16::MIN, 0], &mut Scratch::new(&mut memory), &mut y).unwrap();
    assert!(decision.clipped);
    let error = policy.act_q(&[0; 2], &mut Scratch::new(&mut memory), &mut y).unwrap_err();
    assert_eq!(error, ActError::ObservationLength { expected: 3, found: 2 });
}

#[test]
fn hard_move_with_ten_switches_and_ten_arguments_fits() {
    let mut actions = continuous(10);
    for i in 0..10 {
        actions.push(gadm_runtime::encode::ActionSlot {
            name: format!("move{i}"),
            unit: String::new(),
            head: ActionHead::Binary,
            safe: 0.0,
        });
    }
    let heads = [vec![HeadEncoding::Tanh; 10], vec![HeadEncoding::Switch; 10]].concat();
    let shape = Shape { obs: 512, q: &[32], confidence: None, decoder: &[16], latents: 256, actions, heads };
    let model = model(8, &shape);
    let image = AlignedImage::new(&written(&model));
    let policy = Policy::load(&image).unwrap();
    assert_eq!((policy.spec().action_dim, policy.spec().obs_dim, policy.spec().num_latents), (20, 512, 256));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Random shapes: what is written is read back, passes its vectors and is written again to the same bytes.
    #[test]
    fn random_models_round_trip(seed in any::<u64>(), obs in 1usize..40, widths in proptest::collection::vec(1usize..40, 3), latents in 2usize..40) {
        let shape = Shape {
            obs,
            q: &widths[..2],
            confidence: seed.is_multiple_of(2).then_some(&widths[1..]),
            decoder: &widths,
            latents,
            actions: continuous(2),
            heads: vec![HeadEncoding::Tanh, HeadEncoding::Categorical { atoms: 2 + (seed % 62) as usize, snap: Snap::Edges }],
        };
        let model = model(seed, &shape);
        let bytes = write_int8(&quantised(&model), &observations(2, &model, 3), &FileOptions::default()).unwrap();
        let image = AlignedImage::new(&bytes);
        let policy = Policy::load(&image).unwrap();
        let again = write_int8(&QuantisedModel::read(&policy), &observations(2, &model, 3), &FileOptions::default()).unwrap();
        prop_assert_eq!(bytes, again);
    }

    /// Random damage with right checksums: never a panic, and what is accepted can be run.
    #[test]
    fn damaged_files_never_panic(seed in any::<u64>()) {
        let mut bytes = written(&small());
        let mut rng = Rng(seed);
        for _ in 0..=rng.below(4) {
            let at = rng.below(bytes.len());
            bytes[at] = rng.next() as u8;
        }
        reseal(&mut bytes);
        let image = AlignedImage::new(&bytes);
        if let Ok(policy) = Policy::load(&image) {
            let mut memory = vec![0; policy.spec().scratch_words];
            let mut action = [0.0; 4];
            prop_assert!(policy.act(&[1.0, -1.0, 0.5], &mut Scratch::new(&mut memory), &mut action).is_ok());
            prop_assert!(action.iter().all(|x| x.is_finite()));
            let _ = policy.self_test(&mut Scratch::new(&mut memory));
        }
    }
}
