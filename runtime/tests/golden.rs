//! A committed file of format 1: it must stay readable, give the same bits, and be what the writer writes.
//!
//! Rewritten only with `UPDATE_GOLDEN=1 cargo test -p gadm-runtime --features encode --test golden`.
#![allow(clippy::unwrap_used, reason = "tests may panic")]

#[cfg(feature = "encode")]
mod support;

use gadm_runtime::{Policy, Scratch};

/// `include_bytes!` promises no alignment.
#[repr(C, align(16))]
struct Aligned<T: ?Sized>(T);

static IMAGE: &Aligned<[u8]> = &Aligned(*include_bytes!("data/format-1.bin"));

#[test]
fn the_golden_file_passes_its_own_vectors_without_the_write_side() {
    let policy = Policy::load(&IMAGE.0).unwrap();
    let mut memory = vec![0; policy.spec().scratch_words];
    policy.self_test(&mut Scratch::new(&mut memory)).unwrap();
    assert_eq!(policy.provenance().environment, "Hopper-v5");
    assert_eq!(policy.observation_signals().count(), 5);
    let mut action = [0.0; 3];
    let decision = policy.act(&[0.0; 5], &mut Scratch::new(&mut memory), &mut action).unwrap();
    assert!(decision.allowed.contains(decision.latent));
}

#[cfg(feature = "encode")]
#[test]
fn the_writer_still_writes_the_golden_file() {
    use gadm_runtime::encode::{FileOptions, HeadEncoding, QuantiseOptions, Snap, quantise, write_int8};
    let shape = support::Shape {
        obs: 5,
        q: &[20, 12],
        confidence: Some(&[16]),
        decoder: &[18, 9],
        latents: 7,
        actions: support::continuous(3),
        heads: vec![HeadEncoding::Tanh, HeadEncoding::Categorical { atoms: 5, snap: Snap::Edges }, HeadEncoding::Tanh],
    };
    let model = support::model(11, &shape);
    let calibration = support::observations(12, &model, 100);
    let quantised = quantise(&model, &calibration, &QuantiseOptions::default()).unwrap();
    let bytes = write_int8(&quantised, &calibration[..40], &FileOptions::default()).unwrap();
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        std::fs::write(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/format-1.bin"), &bytes).unwrap();
    } else {
        assert!(bytes == IMAGE.0, "the writer's bytes changed: bump a version, or explain and rewrite the golden file");
    }
}
