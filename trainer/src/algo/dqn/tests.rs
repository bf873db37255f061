use candle_core::{D, Device, Tensor};
use rand::RngExt as _;

use super::*;
use crate::nn::AdamConfig;
use crate::seed::SeedTree;

fn random(rng: &mut Rng, n: usize) -> Vec<f32> {
    (0..n).map(|_| rng.random_range(-1.0_f32..1.0)).collect()
}

fn tensor(values: &[f32], shape: &[usize]) -> Tensor {
    Tensor::from_slice(values, shape, &Device::Cpu).unwrap()
}

/// Full Q of every latent and head, `B x K x E`, from the unfused formula with candle.
fn full_q(dqn: &Dqn, params: &Params, obs: &Tensor) -> Tensor {
    let part = |name: &str| {
        let p = params.layout().parts().iter().find(|p| p.name == name).unwrap();
        params.tensor(&p.range, &p.shape).unwrap()
    };
    let dense = |x: &Tensor, name: &str| {
        let y = x.matmul(&part(&format!("{name}.weight")).t().unwrap()).unwrap();
        y.broadcast_add(&part(&format!("{name}.bias"))).unwrap()
    };
    let mut x = obs.clone();
    for i in 0..dqn.config.hidden.len() {
        x = dense(&x, &format!("trunk{i}")).relu().unwrap();
    }
    let ha = dense(&x, "advantage.hidden").relu().unwrap();
    let b = obs.dim(0).unwrap();
    let a = dense(&ha, "advantage").reshape((b, dqn.latents, dqn.config.heads)).unwrap();
    if !dqn.config.dueling {
        return a;
    }
    let hv = dense(&x, "value.hidden").relu().unwrap();
    let v = dense(&hv, "value").reshape((b, 1, dqn.config.heads)).unwrap();
    a.broadcast_sub(&a.mean_keepdim(1).unwrap()).unwrap().broadcast_add(&v).unwrap()
}

/// Target, loss, gradient and the whole update equal candle's autograd on the unfused graph (paper eq. 5, 6; appendix A item 7).
#[test]
fn one_update_equals_the_unfused_graph() {
    for (heads, dueling, masked) in [(1, true, false), (3, true, true), (2, false, true)] {
        let (obs_dim, k, b) = (5, 7, 12);
        let mut rng = SeedTree::new(11).stream("dqn");
        let config = DqnConfig {
            hidden: vec![16, 8],
            heads,
            dueling,
            target: TargetUpdate::Soft { tau: 0.25 },
            adam: AdamConfig { grad_clip: 0.0, ..Default::default() },
            ..Default::default()
        };
        let mut dqn = Dqn::new(config, obs_dim, k, b, &mut rng).unwrap();
        // Another target than the online network, so that mixing them up would show.
        let noise = random(&mut rng, dqn.target.layout().len());
        dqn.target.with_mut(|t| t.iter_mut().zip(&noise).for_each(|(t, n)| *t += 0.3 * n));
        let batch = RlBatch {
            obs: random(&mut rng, b * obs_dim),
            actions: Vec::new(),
            codes: Vec::new(),
            returns: random(&mut rng, b),
            bootstrap: (0..b).map(|i| if i % 4 == 0 { 0.0 } else { 0.97 }).collect(),
            next_obs: random(&mut rng, b * obs_dim),
        };
        let codes: Vec<u32> = (0..b).map(|_| rng.random_range(0..k as u32)).collect();
        let allowed: Vec<bool> =
            if masked { (0..b * k).map(|i| i % k == i / k % k || rng.random_bool(0.4)).collect() } else { Vec::new() };

        let next = full_q(&dqn, &dqn.params, &tensor(&batch.next_obs, &[b, obs_dim])).mean(2).unwrap();
        let mut mean: Vec<f32> = next.flatten_all().unwrap().to_vec1().unwrap();
        mean.iter_mut().enumerate().for_each(|(i, q)| {
            if masked && !allowed[i] {
                *q = -1e9;
            }
        });
        let best = tensor(&mean, &[b, k]).argmax(1).unwrap();
        let at = |q: &Tensor, codes: &Tensor| {
            let index = codes.reshape((b, 1, 1)).unwrap().broadcast_as((b, 1, heads)).unwrap().contiguous().unwrap();
            q.contiguous().unwrap().gather(&index, 1).unwrap().squeeze(1).unwrap()
        };
        let least =
            at(&full_q(&dqn, &dqn.target, &tensor(&batch.next_obs, &[b, obs_dim])), &best).min(D::Minus1).unwrap();
        let y = (tensor(&batch.returns, &[b]) + (tensor(&batch.bootstrap, &[b]) * least).unwrap()).unwrap();
        let q = at(
            &full_q(&dqn, &dqn.params, &tensor(&batch.obs, &[b, obs_dim])),
            &Tensor::new(codes.as_slice(), &Device::Cpu).unwrap(),
        );
        let error = q.broadcast_sub(&y.detach().unsqueeze(1).unwrap()).unwrap();
        let loss = error.sqr().unwrap().mean(0).unwrap().sum_all().unwrap();
        let store = loss.backward().unwrap();
        let expected: Vec<f32> = store.get(dqn.params.var()).unwrap().to_vec1().unwrap();
        let old_target: Vec<f32> = dqn.target.with(<[f32]>::to_vec);

        let metrics = dqn.update(&batch, &codes, &allowed);
        let expected_loss = loss.to_scalar::<f32>().unwrap();
        assert!((metrics.loss - expected_loss).abs() <= 1e-5 * expected_loss.abs());
        let scale = expected.iter().fold(0.0_f32, |m, g| m.max(g.abs()));
        for (i, (ours, candle)) in dqn.parts[0].ws.gradient().iter().zip(&expected).enumerate() {
            assert!(
                (ours - candle).abs() <= 1e-5 * scale,
                "E {heads}, dueling {dueling}: gradient {i}: {ours}, candle {candle}"
            );
        }
        let online: Vec<f32> = dqn.params.with(<[f32]>::to_vec);
        dqn.target.with(|t| {
            for ((t, old), p) in t.iter().zip(&old_target).zip(&online) {
                assert!((t - (old + 0.25 * (p - old))).abs() < 1e-6);
            }
        });
    }
}

#[test]
fn masked_argmax_breaks_ties_low_and_respects_the_mask() {
    assert_eq!(masked_argmax(&[1.0, 3.0, 3.0], &[]), 1);
    assert_eq!(masked_argmax(&[-5.0, -1.0, -2.0], &[true, false, true]), 2);
    assert_eq!(masked_argmax(&[f32::NEG_INFINITY, 0.0], &[true, false]), 0);
}

#[test]
fn the_folded_network_orders_latents_as_the_mean_q() {
    let mut rng = SeedTree::new(2).stream("fold");
    let config = DqnConfig { hidden: vec![16, 8], heads: 4, ..Default::default() };
    let mut dqn = Dqn::new(config, 3, 6, 32, &mut rng).unwrap();
    let obs = random(&mut rng, 32 * 3);
    let q: Vec<f32> =
        full_q(&dqn, &dqn.params, &tensor(&obs, &[32, 3])).mean(2).unwrap().flatten_all().unwrap().to_vec1().unwrap();
    let advantages = dqn.advantages(&obs, 32).to_vec();
    for (q, a) in q.chunks(6).zip(advantages.chunks(6)) {
        assert!(a.iter().zip(q).all(|(x, y)| ((x - a[0]) - (y - q[0])).abs() < 1e-5));
    }
}

/// What a confidence predictor on the trunk reads is the last hidden layer of the network that the device runs.
#[test]
fn features_are_the_last_hidden_layer_of_the_folded_network() {
    let (obs_dim, k, b) = (5, 7, 12);
    let mut rng = SeedTree::new(12).stream("dqn");
    let config = DqnConfig { hidden: vec![16, 8], heads: 3, ..Default::default() };
    let mut dqn = Dqn::new(config, obs_dim, k, b, &mut rng).unwrap();
    let obs = random(&mut rng, b * obs_dim);
    let mut features = Vec::new();
    dqn.features(&obs, b, &mut features);
    assert_eq!(features.len(), b * dqn.feature_width());
    let (_, weight, bias) = dqn.folded();
    let scores = dqn.advantages(&obs, b);
    for (row, scores) in features.chunks(8).zip(scores.chunks(k)) {
        for ((weight, bias), score) in weight.chunks(8).zip(&bias).zip(scores) {
            let sum: f32 = weight.iter().zip(row).map(|(w, x)| w * x).sum();
            assert!((sum + bias - score).abs() < 1e-5, "{} for {score}", sum + bias);
        }
    }
}
