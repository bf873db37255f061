//! The numbers of the footprint table in the README.
#![cfg(feature = "encode")]
#![allow(clippy::unwrap_used, reason = "tests may panic")]

mod support;

use gadm_runtime::encode::{AlignedImage, FileOptions, QuantiseOptions, quantise, write_int8};
use gadm_runtime::{Policy, Section};
use support::{hopper, observations};

#[test]
fn the_hopper_networks_take_what_the_readme_says() {
    let model = hopper(1);
    let calibration = observations(1, &model, 50);
    let quantised = quantise(&model, &calibration, &QuantiseOptions::default()).unwrap();
    let image = AlignedImage::new(&write_int8(&quantised, &calibration[..11], &FileOptions::default()).unwrap());
    let policy = Policy::load(&image).unwrap();
    let bytes = |network: Section| -> usize {
        policy.layers().filter(|layer| layer.network == network).map(|layer| layer.bytes).sum()
    };
    assert_eq!(bytes(Section::Q), 119_040);
    assert_eq!(bytes(Section::Confidence), 92_928);
    assert_eq!(bytes(Section::Decoder), 115_536);
    assert_eq!(policy.section_sizes().latent_table, 131_072);
    assert_eq!(policy.spec().macs, 301_568);
    assert_eq!(policy.spec().scratch_words * 4, 1680);
}
