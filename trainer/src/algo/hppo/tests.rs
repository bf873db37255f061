use candle_core::{Device, Tensor, Var};

use super::loss::{surrogate, value_loss};
use super::*;

#[test]
fn ratios_are_cut_on_the_side_that_would_gain() {
    let close = |(a, b): (f32, f32), (c, d): (f32, f32)| (a - c).abs() < 1e-6 && (b - d).abs() < 1e-6;
    // Ratio 1: loss -A, slope -A.
    assert!(close(surrogate(-1.0, -1.0, 2.0, 0.2), (-2.0, -2.0)));
    // Ratio 2 and A > 0: held at 1.2, no slope; A < 0: the larger loss counts.
    assert!(close(surrogate(2.0_f32.ln(), 0.0, 1.0, 0.2), (-1.2, 0.0)));
    assert!(close(surrogate(2.0_f32.ln(), 0.0, -1.0, 0.2), (2.0, 2.0)));
    // Ratio 1/2 and A < 0: held at 0.8.
    assert!(close(surrogate(0.5_f32.ln(), 0.0, -1.0, 0.2), (0.8, 0.0)));
}

#[test]
fn values_are_held_near_the_old_ones() {
    let old = Old { ret: 1.0, value: 0.0, ..Old::default() };
    // 0.1 is within the bound; 0.9 counts as 0.2, which is farther from 1; 3 counts as 3, which is farther than 0.2.
    assert_eq!(value_loss(0.0, &old, 0.2), (0.5, -1.0));
    let (loss, slope) = value_loss(0.9, &old, 0.2);
    assert!((loss - 0.5 * 0.64).abs() < 1e-6 && slope == 0.0);
    assert_eq!(value_loss(3.0, &old, 0.2), (2.0, 2.0));
}

/// Two environments, two steps each; γ = λ = 1/2, so that every number is exact.
#[test]
fn advantages_by_hand() {
    let mut r = Rollout { envs: 2, ..Rollout::default() };
    r.rewards = vec![1.0, 2.0, 4.0, 8.0];
    (r.goes_on, r.ends) = (vec![true, false, true, true], vec![false, true, false, false]);
    // Second steps: 4 + 1/2·2 - 1 = 4 and 8 + 1 - 1 = 8. First environment: 1 + 1/2·2 - 1 + 1/4·4 = 2. The second one's first
    // step ended its episode: 2 - 1, and nothing of what came after.
    assert_eq!(r.advantages(&[1.0; 4], &[2.0; 4], 0.5, 0.5), [2.0, 1.0, 4.0, 8.0]);
    // A limit ends the sum, and the successor's value counts.
    r.goes_on[1] = true;
    assert_eq!(r.advantages(&[1.0; 4], &[2.0; 4], 0.5, 0.5), [2.0, 2.0, 4.0, 8.0]);
}

#[test]
fn running_statistics_are_those_of_all_numbers() {
    let mut running = Running { count: 0.0, ..Running::START };
    running.add(&[1.0, 2.0, 3.0]);
    running.add(&[10.0]);
    assert!((running.mean - 4.0).abs() < 1e-6 && (running.variance - 12.5).abs() < 1e-5, "{running:?}");
}

/// The gradient of one row with respect to all of its outputs equals candle's.
#[test]
fn the_gradient_of_a_row_equals_candles_autograd() {
    let config = HppoConfig::default();
    let (logits, z, value) = ([0.3_f32, -0.5, 1.1], [0.4_f32, -0.7], 0.35_f32);
    for (advantage, shift) in [(1.5_f32, 0.05_f32), (-0.8, 0.1), (1.0, -0.6), (-1.0, 0.6)] {
        let var = |v: &[f32]| Var::from_slice(v, v.len(), &Device::Cpu).unwrap();
        let (l, a, v) = (var(&logits), var(&z), var(&[value]));
        let log = candle_log_softmax(&l);
        let new = log.narrow(0, 2, 1).unwrap();
        let x = [0.2_f32, -0.1];
        let apart = (Tensor::new(&x, &Device::Cpu).unwrap() - a.tanh().unwrap()).unwrap();
        let constant = f64::from(config.sigma as f32).ln() + 0.5 * std::f64::consts::TAU.ln();
        let density = ((apart.sqr().unwrap() * (-0.5 / config.sigma / config.sigma)).unwrap() - constant).unwrap();
        let density = density.sum_all().unwrap().reshape(1).unwrap();
        let first = |t: &Tensor| t.to_vec1::<f32>().unwrap()[0];
        let old = Old {
            kind: 2,
            x: &x,
            log: [first(&new) - shift, first(&density) + shift],
            advantage,
            ret: 1.0,
            value: 0.3,
        };
        let part = |new: &Tensor, old: f32| {
            let ratio = (new - f64::from(old)).unwrap().exp().unwrap();
            let free = (&ratio * f64::from(advantage)).unwrap();
            let bound = (ratio.clamp(0.8, 1.2).unwrap() * f64::from(advantage)).unwrap();
            free.minimum(&bound).unwrap().neg().unwrap()
        };
        let entropy = (log.exp().unwrap() * &log).unwrap().sum_all().unwrap().neg().unwrap();
        let held = ((v.as_tensor() - 0.3).unwrap().clamp(-0.2, 0.2).unwrap() + 0.3).unwrap();
        let square = |t: &Tensor| (t - 1.0).unwrap().sqr().unwrap();
        let worst = square(v.as_tensor()).maximum(&square(&held)).unwrap();
        let policy = (part(&new, old.log[0]) + part(&density, old.log[1])).unwrap();
        let loss = ((&policy + (worst * (0.5 * config.value_weight)).unwrap()).unwrap().sum_all().unwrap()
            - (entropy * config.entropy_weight).unwrap())
        .unwrap();
        let store = loss.backward().unwrap();
        let expected = [&l, &a, &v].map(|v| store.get(v).unwrap().to_vec1::<f32>().unwrap());
        let (mut logits, mut z, mut value) = (logits, z, value);
        let parts = loss::row(&config, &old, 1.0, &mut logits, &mut z, &mut value);
        assert!((parts[0] - first(&policy)).abs() < 1e-5, "policy loss");
        for (ours, expected) in logits.iter().chain(&z).chain([&value]).zip(expected.iter().flatten()) {
            assert!((ours - expected).abs() < 2e-5, "A {advantage}, shift {shift}: {ours}, candle {expected}");
        }
    }
}

fn candle_log_softmax(logits: &Tensor) -> Tensor {
    let top = logits.max(0).unwrap();
    let shifted = logits.broadcast_sub(&top).unwrap();
    let sum = shifted.exp().unwrap().sum_all().unwrap().log().unwrap();
    shifted.broadcast_sub(&sum).unwrap()
}
