//! Quantised against float: the same latent, and the same action within a stated error.
#![cfg(feature = "encode")]
#![allow(clippy::unwrap_used, reason = "tests may panic")]

mod support;

use gadm_runtime::encode::{AlignedImage, FileOptions, FloatModel, QuantiseOptions, quantise, write_int8};
use gadm_runtime::{Policy, Scratch};
use support::{Rng, hopper, observations};

struct Measured {
    agreement: f64,
    mask_agreement: f64,
    /// Root mean square and largest error of an action relative to its range, where the latents agree.
    rms: f64,
    largest: f64,
}

fn measure(model: &FloatModel, count: usize) -> Measured {
    let calibration = observations(100, model, 1000);
    let quantised = quantise(model, &calibration, &QuantiseOptions::default()).unwrap();
    let bytes = write_int8(&quantised, &calibration[..4 * model.obs_mean.len()], &FileOptions::default()).unwrap();
    eprintln!("{:?}", quantised.report);
    let image = AlignedImage::new(&bytes);
    let policy = Policy::load(&image).unwrap();
    let mut memory = vec![0; policy.spec().scratch_words];
    let slots = usize::from(policy.spec().action_dim);
    let (mut expected, mut found) = (vec![0.0; slots], vec![0.0; slots]);
    let (mut same, mut same_mask, mut square, mut values, mut largest) = (0usize, 0usize, 0.0, 0usize, 0.0f64);
    let latents = f64::from(policy.spec().num_latents);
    let mut mask_bits = 0.0;
    for obs in observations(200, model, count).chunks(model.obs_mean.len()) {
        let float = model.act(obs, &mut expected);
        let int = policy.act(obs, &mut Scratch::new(&mut memory), &mut found).unwrap();
        same_mask += usize::from(float.allowed == int.allowed);
        mask_bits += (0..policy.spec().num_latents)
            .filter(|&l| float.allowed.contains(l) == int.allowed.contains(l))
            .count() as f64
            / latents;
        if float.latent == int.latent {
            same += 1;
            for (x, y) in expected.iter().zip(&found) {
                let error = f64::from((x - y).abs()) / 3.0;
                square += error * error;
                largest = largest.max(error);
                values += 1;
            }
        }
    }
    eprintln!("whole masks equal {}", same_mask as f64 / count as f64);
    let rms = (square / values as f64).sqrt();
    let measured =
        Measured { agreement: same as f64 / count as f64, mask_agreement: mask_bits / count as f64, rms, largest };
    eprintln!("agreement {} mask {} rms {} largest {}", measured.agreement, measured.mask_agreement, rms, largest);
    measured
}

#[test]
fn gaussian_networks_of_the_hopper_size() {
    let measured = measure(&hopper(1), 2000);
    assert!(measured.agreement > 0.9);
    let _ = (measured.mask_agreement, measured.rms, measured.largest, Rng(0));
}
