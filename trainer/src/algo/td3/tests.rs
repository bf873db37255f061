use candle_core::{D, Device, Tensor, Var};
use rand::RngExt as _;

use super::*;
use crate::config::Schedule;
use crate::nn::AdamConfig;

fn random(rng: &mut Rng, n: usize) -> Vec<f32> {
    (0..n).map(|_| rng.random_range(-1.0_f32..1.0)).collect()
}

/// Four layers of a stack as candle computes them, from flat numbers in the order weight, bias, weight, bias, ...
fn mlp(flat: &Tensor, widths: &[usize], from: usize, x: &Tensor) -> Tensor {
    let (mut at, mut x) = (from, x.clone());
    for (i, w) in widths.windows(2).enumerate() {
        let weight = flat.narrow(0, at, w[0] * w[1]).unwrap().reshape((w[1], w[0])).unwrap();
        let bias = flat.narrow(0, at + w[0] * w[1], w[1]).unwrap();
        at += w[0] * w[1] + w[1];
        x = x.matmul(&weight.t().unwrap()).unwrap().broadcast_add(&bias).unwrap();
        if i + 2 < widths.len() {
            x = x.relu().unwrap();
        }
    }
    x
}

fn small(batch: usize) -> Td3Config {
    let adam = AdamConfig { learning_rate: 1e-2, grad_clip: 0.0, epsilon: 1e-3, ..AdamConfig::default() };
    Td3Config {
        schedule: Schedule { batch, ..Td3Config::default().schedule },
        hidden: vec![16, 8],
        policy_delay: 2,
        tau: 0.25,
        actor_adam: adam,
        critic_adam: adam,
        ..Td3Config::default()
    }
}

fn adam_step(p: &[f32], g: &[f32], lr: f32, eps: f32) -> Vec<f32> {
    // The first step of Adam: both moments corrected to the gradient itself.
    p.iter().zip(g).map(|(p, g)| p - lr * g / (g.abs() + eps)).collect()
}

fn close(what: &str, ours: &[f32], expected: &[f32]) {
    assert_eq!(ours.len(), expected.len(), "{what}");
    let scale = expected.iter().fold(1e-3_f32, |m, v| m.max(v.abs()));
    for (i, (a, b)) in ours.iter().zip(expected).enumerate() {
        assert!((a - b).abs() <= 2e-5 * scale, "{what} {i}: ours {a}, candle {b}");
    }
}

/// Targets, losses, both gradients and one whole update equal candle's autograd, in one part and in two.
#[test]
fn one_update_equals_candles_autograd() {
    for batch in [10, 140] {
        let mut spec = gadm_envs::make("pendulum").unwrap().spec().clone();
        let mut second = spec.actions[0].clone();
        "second".clone_into(&mut second.name);
        spec.actions.push(second);
        let (o, a) = (3, 2);
        // The policy is updated with the first update of the critics, so that one update shows everything.
        let config = Td3Config { policy_delay: 1, ..small(batch) };
        let seeds = SeedTree::new(7);
        let mut td3 = Td3::new(config.clone(), &spec, seeds).unwrap();
        let mut rng = seeds.stream("test");
        for net in [&mut td3.actor, &mut td3.critic] {
            let noise = random(&mut rng, net.target.layout().len());
            net.target.with_mut(|t| t.iter_mut().zip(&noise).for_each(|(t, n)| *t += 0.2 * n));
        }
        let data = RlBatch {
            obs: random(&mut rng, batch * o),
            actions: random(&mut rng, batch * a),
            codes: vec![0.0; batch],
            returns: random(&mut rng, batch),
            bootstrap: (0..batch).map(|i| if i % 4 == 0 { 0.0 } else { 0.97 }).collect(),
            next_obs: random(&mut rng, batch * o),
        };
        // Large enough that both bounds, of the noise and of the action, are reached.
        let noise: Vec<f32> = random(&mut rng, batch * a).iter().map(|n| 4.0 * n).collect();

        let tensor = |v: &[f32], w: usize| Tensor::from_slice(v, (batch, w), &Device::Cpu).unwrap();
        let flat = |p: &Params| Var::from_vec(p.with(<[f32]>::to_vec), p.layout().len(), &Device::Cpu).unwrap();
        let (actor, actor_target) = (flat(&td3.actor.params), flat(&td3.actor.target));
        let (critic, critic_target) = (flat(&td3.critic.params), flat(&td3.critic.target));
        let (wa, wq) = ([o, 16, 8, a], [o + a, 16, 8, 1]);
        let one = td3.critic.params.layout().len() / 2;
        let q = |p: &Tensor, i: usize, s: &Tensor, a: &Tensor| {
            mlp(p, &wq, i * one, &Tensor::cat(&[s, a], 1).unwrap()).squeeze(1).unwrap()
        };
        let next = tensor(&data.next_obs, o);
        let smooth = (tensor(&noise, a) * config.target_noise).unwrap().clamp(-0.5, 0.5).unwrap();
        let next_action = mlp(&actor_target, &wa, 0, &next).tanh().unwrap();
        let next_action = (next_action + smooth).unwrap().clamp(-1.0, 1.0).unwrap();
        let both = [0, 1].map(|i| q(&critic_target, i, &next, &next_action));
        let least = Tensor::stack(&both, 1).unwrap().min(D::Minus1).unwrap();
        let column = |v: &[f32]| Tensor::from_slice(v, batch, &Device::Cpu).unwrap();
        let y = (column(&data.returns) + (column(&data.bootstrap) * least).unwrap()).unwrap().detach();
        let (s, taken) = (tensor(&data.obs, o), tensor(&data.actions, a));
        let square = |i| (q(&critic, i, &s, &taken) - &y).unwrap().sqr().unwrap().mean_all().unwrap();
        let loss = (square(0) + square(1)).unwrap();
        let gradient =
            |loss: &Tensor, var: &Var| -> Vec<f32> { loss.backward().unwrap().get(var).unwrap().to_vec1().unwrap() };
        let numbers = |v: &Var| -> Vec<f32> { v.to_vec1().unwrap() };
        let new_critic = adam_step(&numbers(&critic), &gradient(&loss, &critic), 1e-2, 1e-3);
        let updated = Tensor::from_vec(new_critic.clone(), 2 * one, &Device::Cpu).unwrap();
        let policy = mlp(&actor, &wa, 0, &s).tanh().unwrap();
        let policy_loss = q(&updated, 0, &s, &policy).mean_all().unwrap().neg().unwrap();
        let new_actor = adam_step(&numbers(&actor), &gradient(&policy_loss, &actor), 1e-2, 1e-3);

        let mut report = Report::new();
        td3.update_with(&data, &noise, &mut report);
        close("targets", &td3.targets(batch), &y.to_vec1::<f32>().unwrap());
        let scalar = |t: &Tensor| t.to_scalar::<f32>().unwrap();
        let reported = |key| report.iter().find(|(k, _)| *k == key).unwrap().1;
        close("critic loss", &[reported(keys::Q_LOSS)], &[scalar(&loss)]);
        close("policy loss", &[reported(keys::POLICY_LOSS)], &[scalar(&policy_loss)]);
        close("critics", &td3.critic.params.with(<[f32]>::to_vec), &new_critic);
        close("actor", &td3.actor.params.with(<[f32]>::to_vec), &new_actor);
        for (net, old, new) in [(&td3.actor, actor_target, new_actor), (&td3.critic, critic_target, new_critic)] {
            let moved: Vec<f32> = numbers(&old).iter().zip(&new).map(|(t, p)| t + 0.25 * (p - t)).collect();
            close("target", &net.target.with(<[f32]>::to_vec), &moved);
        }
    }
}

#[test]
fn the_policy_and_the_targets_wait_for_the_delay() {
    let spec = gadm_envs::make("pendulum").unwrap().spec().clone();
    let seeds = SeedTree::new(1);
    let mut td3 = Td3::new(small(8), &spec, seeds).unwrap();
    let mut rng = seeds.stream("test");
    let data = RlBatch {
        obs: random(&mut rng, 24),
        actions: random(&mut rng, 8),
        codes: vec![0.0; 8],
        returns: random(&mut rng, 8),
        bootstrap: vec![0.9; 8],
        next_obs: random(&mut rng, 24),
    };
    let bits = |p: &Params| p.with(<[f32]>::to_vec);
    let (actor, target, critic) = (bits(&td3.actor.params), bits(&td3.critic.target), bits(&td3.critic.params));
    let mut report = Report::new();
    td3.update(&data, &mut rng, &mut report);
    assert!(bits(&td3.actor.params) == actor && bits(&td3.critic.target) == target);
    assert!(bits(&td3.critic.params) != critic && report.iter().all(|(key, _)| *key != keys::POLICY_LOSS));
    td3.update(&data, &mut rng, &mut report);
    assert!(bits(&td3.actor.params) != actor && bits(&td3.critic.target) != target);
}

#[test]
fn discrete_actions_and_impossible_settings_are_refused() {
    let refuse = |config: Td3Config, env: &str| {
        let spec = gadm_envs::make(env).unwrap().spec().clone();
        Td3::new(config, &spec, SeedTree::new(1)).err().unwrap().to_string()
    };
    assert!(refuse(Td3Config::default(), "moving").contains("continuous actions only"));
    let text = refuse(Td3Config { policy_delay: 0, ..Td3Config::default() }, "pendulum");
    assert_eq!(text, "config `td3.policy_delay`: expected at least 1, found 0");
}
