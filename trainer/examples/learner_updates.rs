//! One update of every baseline learner on a small fixed batch, as JSON: settings, weights before and after, batch, targets and
//! losses. `tests/peers/oracle.py` repeats it in PyTorch; `make test-peers` runs both.

use gadm_envs::EnvSpec;
use gadm_trainer::algo::dqn::TargetUpdate;
use gadm_trainer::algo::listed::{DqnManualConfig, HeadLayout, manual};
use gadm_trainer::algo::td3::{Td3, Td3Config};
use gadm_trainer::algo::{Learner, Report};
use gadm_trainer::nn::AdamConfig;
use gadm_trainer::replay::RlBatch;
use gadm_trainer::seed::{Rng, SeedTree};
use rand::RngExt as _;
use serde_json::{Map, Value, json};

fn random(rng: &mut Rng, n: usize) -> Vec<f32> {
    (0..n).map(|_| rng.random_range(-1.0_f32..1.0)).collect()
}

fn array(values: &[f32], shape: &[usize]) -> Value {
    json!({ "shape": shape, "values": values })
}

/// A step size and an epsilon with which one step of Adam is well behaved: it divides by the size of the gradient.
fn adam() -> AdamConfig {
    AdamConfig { learning_rate: 1e-2, grad_clip: 0.0, epsilon: 1e-3, ..AdamConfig::default() }
}

/// Every network of a learner, by name and part.
fn networks(learner: &mut dyn Learner) -> Value {
    let mut all = Map::new();
    for (name, params) in learner.networks() {
        let parts = params.export().into_iter().map(|(part, (shape, values))| (part, array(&values, &shape)));
        all.insert(name.to_owned(), parts.collect());
    }
    Value::Object(all)
}

/// Moves the targets away from their networks, so that mixing them up would show.
fn move_targets(learner: &mut dyn Learner, rng: &mut Rng) {
    for (name, params) in learner.networks() {
        if name.ends_with("target") {
            let noise = random(rng, params.layout().len());
            params.with_mut(|p| p.iter_mut().zip(&noise).for_each(|(p, n)| *p += 0.2 * n));
        }
    }
}

fn batch(rng: &mut Rng, n: usize, obs: usize, actions: Vec<f32>) -> RlBatch {
    RlBatch {
        obs: random(rng, n * obs),
        actions,
        codes: vec![0.0; n],
        returns: random(rng, n),
        bootstrap: (0..n).map(|i| if i % 4 == 0 { 0.0 } else { 0.97 }).collect(),
        next_obs: random(rng, n * obs),
    }
}

fn batch_json(data: &RlBatch) -> Value {
    let n = data.returns.len();
    let wide = |values: &[f32]| array(values, &[n, values.len() / n]);
    json!({
        "obs": wide(&data.obs),
        "actions": wide(&data.actions),
        "codes": array(&data.codes, &[n]),
        "returns": array(&data.returns, &[n]),
        "bootstrap": array(&data.bootstrap, &[n]),
        "next_obs": wide(&data.next_obs),
    })
}

fn report_json(report: &Report) -> Value {
    report.iter().map(|(key, value)| ((*key).to_owned(), json!(value))).collect()
}

/// Pendulum with a second torque.
fn two_torques() -> anyhow::Result<EnvSpec> {
    let mut spec = gadm_envs::make("pendulum")?.spec().clone();
    let mut second = spec.actions[0].clone();
    "second".clone_into(&mut second.name);
    spec.actions.push(second);
    Ok(spec)
}

fn td3(n: usize) -> anyhow::Result<Value> {
    let seeds = SeedTree::new(n as u64);
    let rng = &mut seeds.stream("data");
    let spec = two_torques()?;
    let mut config = Td3Config { hidden: vec![16, 8], policy_delay: 1, tau: 0.25, ..Td3Config::default() };
    (config.actor_adam, config.critic_adam, config.schedule.batch) = (adam(), adam(), n);
    let mut learner = Td3::new(config.clone(), &spec, seeds)?;
    move_targets(&mut learner, rng);
    let actions = random(rng, n * 2);
    let data = batch(rng, n, spec.obs_dim(), actions);
    // Large enough that the bounds of noise and action are reached.
    let noise: Vec<f32> = random(rng, n * 2).iter().map(|v| 4.0 * v).collect();
    let before = networks(&mut learner);
    let mut report = Report::new();
    learner.update_with(&data, &noise, &mut report);
    let mut inputs = batch_json(&data);
    inputs["noise"] = array(&noise, &[n, 2]);
    Ok(json!({
        "algorithm": "td3",
        "name": format!("td3, batch {n}"),
        "settings": {
            "hidden": config.hidden,
            "learning_rate": adam().learning_rate,
            "epsilon": adam().epsilon,
            "tau": config.tau,
            "policy_delay": config.policy_delay,
            "target_noise": config.target_noise,
            "noise_clip": config.noise_clip,
        },
        "batch": inputs,
        "before": before,
        "targets": learner.targets(n),
        "report": report_json(&report),
        "after": networks(&mut learner),
    }))
}

/// Settings of DQN on Pendulum with two torques, 3 bins each.
fn dqn_manual(n: usize, layout: HeadLayout) -> DqnManualConfig {
    let mut config = DqnManualConfig { layout, ..DqnManualConfig::default() };
    (config.dqn.hidden, config.dqn.target, config.dqn.adam) = (vec![16, 8], TargetUpdate::Soft { tau: 0.25 }, adam());
    config.schedule.batch = n;
    config
}

fn dqn(n: usize, layout: HeadLayout) -> anyhow::Result<Value> {
    let seeds = SeedTree::new(n as u64);
    let rng = &mut seeds.stream("data");
    let spec = two_torques()?;
    let config = dqn_manual(n, layout);
    let mut learner = manual(&config, &spec, seeds)?;
    move_targets(learner.as_mut(), rng);
    let (mut actions, mut codes) = (vec![0.0; n * 2], Vec::new());
    learner.random(n, rng, &mut codes, &mut actions);
    let mut data = batch(rng, n, spec.obs_dim(), actions);
    if layout == HeadLayout::Flat {
        data.codes = codes.iter().map(|&code| code as f32).collect();
    }
    let before = networks(learner.as_mut());
    let mut report = Report::new();
    learner.update(&data, rng, &mut report);
    let algorithm = if layout == HeadLayout::Flat { "dqn-manual" } else { "dqn-decoupled" };
    Ok(json!({
        "algorithm": algorithm,
        "name": format!("{algorithm}, batch {n}"),
        "settings": {
            "hidden": config.dqn.hidden,
            "bins": config.bins,
            "learning_rate": adam().learning_rate,
            "epsilon": adam().epsilon,
            "tau": 0.25,
        },
        "batch": batch_json(&data),
        "before": before,
        "report": report_json(&report),
        "after": networks(learner.as_mut()),
    }))
}

fn main() -> anyhow::Result<()> {
    let mut cases = Vec::new();
    // A batch in one part, and one that is computed in two.
    for n in [12, 140] {
        cases.extend([td3(n)?, dqn(n, HeadLayout::Flat)?, dqn(n, HeadLayout::Decoupled)?]);
    }
    println!("{}", json!({ "cases": cases }));
    Ok(())
}
