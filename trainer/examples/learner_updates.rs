//! One update of every baseline learner on a small fixed batch, as JSON: settings, weights before and after, batch, targets and
//! losses. `tests/peers/oracle.py` repeats it in PyTorch; `make test-peers` runs both.

use gadm_envs::EnvSpec;
use gadm_trainer::algo::dqn::TargetUpdate;
use gadm_trainer::algo::hppo::{Hppo, HppoConfig};
use gadm_trainer::algo::listed::{DqnManualConfig, HeadLayout, manual};
use gadm_trainer::algo::pdqn::{MpdqnConfig, Pdqn, PdqnConfig};
use gadm_trainer::algo::td3::{Td3, Td3Config};
use gadm_trainer::algo::{Explorer, Learner, Observed, Report};
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

/// Settings of both PDQNs.
fn pdqn_config(n: usize) -> PdqnConfig {
    let mut config =
        PdqnConfig { hidden: vec![16, 8], tau: 0.25, q_adam: adam(), x_adam: adam(), ..PdqnConfig::default() };
    config.schedule.batch = n;
    config
}

/// One update of the Q-network, then one of the arguments, of PDQN (`absent` is `None`) or MPDQN.
fn pdqn(n: usize, env: &str, absent: Option<f64>) -> anyhow::Result<Value> {
    let seeds = SeedTree::new(n as u64);
    let rng = &mut seeds.stream("data");
    let spec = gadm_envs::make(env)?.spec().clone();
    let config = pdqn_config(n);
    let mut learner = match absent {
        None => Pdqn::single_pass(&config, &spec, seeds)?,
        Some(absent) => Pdqn::multi_pass(&MpdqnConfig { pdqn: config.clone(), absent }, &spec, seeds)?,
    };
    move_targets(&mut learner, rng);
    let mut actions = vec![0.0; n * spec.action_dim()];
    learner.random(n, rng, &mut Vec::new(), &mut actions);
    let types = learner.types().clone();
    let mut data = batch(rng, n, spec.obs_dim(), actions);
    data.codes = data.actions.chunks_exact(types.slots).map(|action| types.of(action) as f32).collect();
    let before = networks(&mut learner);
    let (mut q, mut x) = (Report::new(), Report::new());
    learner.update_q(&data, &mut q);
    let targets = learner.targets(n);
    learner.update_x(&data, &mut x);
    q.extend(x);
    let uses: Vec<f32> = types.uses.iter().map(|&used| f32::from(u8::from(used || absent.is_none()))).collect();
    let algorithm = if absent.is_some() { "mpdqn" } else { "pdqn" };
    let mut inputs = batch_json(&data);
    inputs["uses"] = array(&uses, &[types.len(), types.arguments()]);
    Ok(json!({
        "algorithm": "pdqn",
        "name": format!("{algorithm}, {env}, batch {n}"),
        "settings": {
            "hidden": config.hidden,
            "learning_rate": adam().learning_rate,
            "epsilon": adam().epsilon,
            "tau": config.tau,
            "absent": absent.unwrap_or(0.0),
        },
        "batch": inputs,
        "before": before,
        "targets": targets,
        "report": report_json(&q),
        "after": networks(&mut learner),
    }))
}

/// A round of `n` steps that the policy itself took, and one update on all of it.
fn hppo(n: usize, env: &str) -> anyhow::Result<Value> {
    let seeds = SeedTree::new(n as u64);
    let (rng, noise) = (&mut seeds.stream("data"), &mut seeds.stream("noise"));
    let spec = gadm_envs::make(env)?.spec().clone();
    let (envs, o) = (4, spec.obs_dim());
    let config =
        HppoConfig { envs, steps_per_round: n, batch: n, hidden: vec![16, 8], adam: adam(), ..HppoConfig::default() };
    let mut learner = Hppo::new(&config, &spec, seeds)?;
    let (mut chosen, mut actions) = (Vec::new(), vec![0.0; envs * spec.action_dim()]);
    for _ in 0..n / envs {
        let (obs, next_obs) = (random(rng, envs * o), random(rng, envs * o));
        let by = Explorer { env_steps: 0, choose: &mut *rng, noise: &mut *noise };
        learner.explore(&obs, envs, by, &mut chosen, &mut actions);
        for (obs, next_obs) in obs.chunks(o).zip(next_obs.chunks(o)) {
            let (terminated, truncated) = (rng.random_bool(0.2), rng.random_bool(0.2));
            let reward = rng.random_range(-1.0..1.0);
            learner.observe(&Observed { obs, reward, next_obs, terminated, truncated });
        }
    }
    // Some rows of the past are moved away, so that ratios leave their bounds.
    learner.rollout.log.iter_mut().flatten().for_each(|log| *log += rng.random_range(-0.5..0.5));
    // The running deviation is that of before the pass: 1 at the start.
    let pass = learner.pass();
    let before = networks(&mut learner);
    let mut report = Report::new();
    let rollout = learner.rollout.clone();
    learner.update_on(&pass, &(0..n).collect::<Vec<_>>(), &mut report);
    let flags = |flags: &[bool]| flags.iter().map(|&f| f32::from(u8::from(f))).collect::<Vec<_>>();
    let wide = |values: &[f32]| array(values, &[n, values.len() / n]);
    let one = |values: &[f32]| array(values, &[n]);
    let kinds: Vec<f32> = rollout.kinds.iter().map(|&k| k as f32).collect();
    Ok(json!({
        "algorithm": "hppo",
        "name": format!("hppo, {env}, batch {n}"),
        "settings": {
            "hidden": config.hidden,
            "envs": envs,
            "deviation": 1.0,
            "sigma": config.sigma,
            "gamma": config.gamma,
            "gae_lambda": config.gae_lambda,
            "clip": config.clip,
            "value_clip": config.value_clip,
            "value_weight": config.value_weight,
            "entropy_weight": config.entropy_weight,
            "learning_rate": adam().learning_rate,
            "epsilon": adam().epsilon,
        },
        "batch": {
            "obs": wide(&rollout.obs),
            "next_obs": wide(&rollout.next_obs),
            "x": wide(&rollout.x),
            "log": wide(rollout.log.as_flattened()),
            "kinds": one(&kinds),
            "rewards": one(&rollout.rewards),
            "goes_on": one(&flags(&rollout.goes_on)),
            "ends": one(&flags(&rollout.ends)),
            "advantages": one(&pass.advantages),
            "returns": one(&pass.returns),
            "values": one(&pass.values),
        },
        "before": before,
        "report": report_json(&report),
        "after": networks(&mut learner),
    }))
}

fn main() -> anyhow::Result<()> {
    let mut cases = Vec::new();
    // A batch in one part, and one that is computed in two.
    for n in [12, 140] {
        cases.extend([td3(n)?, dqn(n, HeadLayout::Flat)?, dqn(n, HeadLayout::Decoupled)?]);
        cases.extend([pdqn(n, "moving", None)?, pdqn(n, "moving", Some(-2.0))?, pdqn(n, "hard-move-4", Some(0.0))?]);
        cases.extend([hppo(n, "moving")?, hppo(n, "hard-move-4")?]);
    }
    println!("{}", json!({ "cases": cases }));
    Ok(())
}
