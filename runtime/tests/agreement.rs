//! Quantised against float: the same latent, and the same action within a stated error.
#![cfg(feature = "encode")]
#![allow(clippy::unwrap_used, reason = "tests may panic")]

mod support;

use gadm_runtime::encode::{
    AlignedImage, FileOptions, FloatDecoder, FloatModel, QuantiseOptions, QuantiseReport, QuantisedModel, quantise,
    write_int8,
};
use gadm_runtime::{ActionHead, Policy, Scratch};
use support::{Rng, dense_uniform, hopper, observations, share_trunk};

/// What 2,000 observations of the calibrated distribution show.
#[derive(Debug)]
struct Measured {
    /// Share of steps with the same latent.
    latents: f64,
    /// Share of single mask decisions that agree.
    mask: f64,
    /// Errors of an action relative to its range, where the latents agree.
    rms: f64,
    /// Largest such error.
    largest: f64,
    report: QuantiseReport,
}

fn measure(model: &FloatModel) -> Measured {
    const STEPS: usize = 2000;
    let dim = model.obs_mean.len();
    let calibration = observations(100, model, 1000);
    let quantised = quantise(model, &calibration, &QuantiseOptions::default()).unwrap();
    let bytes = write_int8(&quantised, &calibration[..4 * dim], &FileOptions::default()).unwrap();
    let image = AlignedImage::new(&bytes);
    let policy = Policy::load(&image).unwrap();
    let mut memory = vec![0; policy.spec().scratch_words];
    let heads: Vec<ActionHead> = policy.action_signals().map(|signal| signal.head).collect();
    let (mut expected, mut found) = (vec![0.0; heads.len()], vec![0.0; heads.len()]);
    let (mut same, mut same_mask, mut errors) = (0, 0, vec![]);
    for obs in observations(200, model, STEPS).chunks(dim) {
        let float = model.act(obs, &mut expected);
        let int = policy.act(obs, &mut Scratch::new(&mut memory), &mut found).unwrap();
        let agrees = |latent: &u16| float.allowed.contains(*latent) == int.allowed.contains(*latent);
        same_mask += (0..policy.spec().num_latents).filter(agrees).count();
        if float.latent == int.latent {
            same += 1;
            for ((x, y), head) in expected.iter().zip(&found).zip(&heads) {
                errors.push(f64::from((head.normalise(*x) - head.normalise(*y)).abs()) / 2.0);
            }
        }
    }
    let square: f64 = errors.iter().map(|e| e * e).sum();
    let measured = Measured {
        latents: f64::from(same) / STEPS as f64,
        mask: same_mask as f64 / STEPS as f64 / f64::from(policy.spec().num_latents),
        rms: (square / errors.len() as f64).sqrt(),
        largest: errors.iter().copied().fold(0.0, f64::max),
        report: quantised.report,
    };
    eprintln!("{measured:?}");
    measured
}

#[test]
fn gaussian_networks_of_the_hopper_size() {
    for seed in 1..=3 {
        let measured = measure(&hopper(seed));
        assert!(measured.latents >= 0.97, "{measured:?}");
        assert!(measured.mask >= 0.995, "{measured:?}");
        assert!(measured.rms <= 0.002, "{measured:?}");
        // A probability close to 0.9 may snap on one side only: a jump of at most 0.1, here of some 0.02.
        assert!(measured.largest <= 0.05, "{measured:?}");
        assert!(measured.report.layers.iter().all(|layer| layer.out_bits != 8), "{measured:?}");
    }
}

/// The confidence network on the Q-network's last hidden layer, whose rows the exporter has put into another order.
#[test]
fn shared_trunks_of_the_hopper_size() {
    for (seed, hidden) in [(1, &[][..]), (2, &[64])] {
        let measured = measure(&share_trunk(seed + 20, hopper(seed), hidden));
        assert!(measured.latents >= 0.97, "{measured:?}");
        assert!(measured.mask >= 0.995, "{measured:?}");
        assert!(measured.rms <= 0.002, "{measured:?}");
    }
}

/// The float model of an int8 file computes what the file does, but for rounding and clamping of activations.
#[test]
fn dequantised_files_take_the_steps_of_the_file() {
    for model in [hopper(9), share_trunk(29, hopper(9), &[])] {
        let calibration = observations(100, &model, 1000);
        let quantised = quantise(&model, &calibration, &QuantiseOptions::default()).unwrap();
        let bytes = write_int8(&quantised, &calibration[..44], &FileOptions::default()).unwrap();
        let image = AlignedImage::new(&bytes);
        let policy = Policy::load(&image).unwrap();
        let float = QuantisedModel::read(&policy).dequantised();
        let mut memory = vec![0; policy.spec().scratch_words];
        let (mut expected, mut found) = ([0.0; 3], [0.0; 3]);
        let (mut same, mut far) = (0, 0);
        for obs in observations(200, &model, 500).chunks(11) {
            let int = policy.act(obs, &mut Scratch::new(&mut memory), &mut expected).unwrap();
            if float.act(obs, &mut found).latent == int.latent {
                same += 1;
                far += usize::from(expected.iter().zip(&found).any(|(x, y)| (x - y).abs() > 0.02));
            }
        }
        assert!(same >= 485 && far <= 5, "{same} of 500 latents, {far} actions more than 0.02 off");
    }
}

/// Freshly initialised as the trainer does it: no tails, so the weights use int8 least well and the bounds are tight.
#[test]
fn uniform_networks_of_the_hopper_size() {
    let mut model = hopper(4);
    let mut rng = Rng(5);
    let again = |rng: &mut Rng, layers: &mut Vec<support::Dense>| {
        for layer in layers {
            *layer = dense_uniform(rng, layer.rows, layer.cols, 1.7);
        }
    };
    again(&mut rng, &mut model.q);
    again(&mut rng, model.confidence.as_mut().unwrap());
    if let FloatDecoder::Modulated { state, hidden, head, .. } = &mut model.decoder {
        again(&mut rng, hidden);
        *state = dense_uniform(&mut rng, state.rows, state.cols, 1.7);
        *head = dense_uniform(&mut rng, head.rows, head.cols, 1.7);
    }
    let measured = measure(&model);
    assert!(measured.latents >= 0.95, "{measured:?}");
    assert!(measured.mask >= 0.98, "{measured:?}");
    assert!(measured.rms <= 0.002, "{measured:?}");
}

/// Inputs of very different reach, some of them constant, some with rare large values.
#[test]
fn uneven_inputs() {
    let mut model = hopper(6);
    model.obs_std[0] *= 1e-3;
    model.obs_std[1] *= 1e3;
    for (index, weight) in model.q[0].weight.iter_mut().enumerate() {
        if index % 11 == 2 {
            *weight *= 0.02;
        }
    }
    let measured = measure(&model);
    assert!(measured.latents >= 0.97, "{measured:?}");
    assert!(measured.rms <= 0.002, "{measured:?}");
}
