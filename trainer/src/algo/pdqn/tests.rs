use super::*;
use crate::config::Schedule;
use crate::nn::AdamConfig;

fn spec(env: &str) -> EnvSpec {
    gadm_envs::make(env).unwrap().spec().clone()
}

/// HardMove: an argument belongs to half of all types, and every combination of switches sees exactly its own.
#[test]
fn overlapping_arguments_are_seen_by_every_type_that_uses_them() {
    let types = Types::new(&spec("hard-move-10"), "mpdqn", 4096).unwrap();
    assert_eq!((types.len(), types.arguments()), (1024, 10));
    for (row, uses) in types.rows.chunks(20).zip(types.uses.chunks(10)) {
        let switches: Vec<bool> = row[..10].iter().map(|s| *s > 0.5).collect();
        assert_eq!(switches, uses);
    }
    for j in 0..10 {
        assert_eq!(types.uses.chunks(10).filter(|uses| uses[j]).count(), 512, "argument {j}");
    }
    let types = Types::new(&spec("moving"), "mpdqn", 4096).unwrap();
    assert_eq!(types.uses, [true, false, false, true, false, false], "specification 7.3");
    assert_eq!(types.of(&[1.0, 0.3, 0.4]), 1);
    let refuse = |env: &str, limit| Types::new(&spec(env), "mpdqn", limit).unwrap_err().to_string();
    assert!(refuse("pendulum", 10).contains("mpdqn, and pendulum"));
    assert!(refuse("hard-move-10", 1023).contains("mpdqn.limit"));
}

fn small(batch: usize) -> PdqnConfig {
    let adam = AdamConfig { learning_rate: 1e-2, grad_clip: 0.0, epsilon: 1e-3, ..AdamConfig::default() };
    PdqnConfig {
        schedule: Schedule { batch, ..Schedule::default() },
        hidden: vec![12, 8],
        q_adam: adam,
        x_adam: adam,
        ..PdqnConfig::default()
    }
}

/// The running sums of the passes against one whole pass of the graph per type, and their gradient against differences.
#[test]
fn passes_are_whole_passes_and_their_gradient_is_right() {
    for env in ["moving", "hard-move-4"] {
        let spec = spec(env);
        let config = MpdqnConfig { pdqn: small(16), absent: -2.0 };
        let mut learner = Pdqn::multi_pass(&config, &spec, SeedTree::new(5)).unwrap();
        let mut rng = SeedTree::new(6).stream("x");
        let (o, a, k) = (spec.obs_dim(), learner.types.arguments(), learner.types.len());
        let obs: Vec<f32> = (0..o).map(|_| rng.random_range(-1.0..1.0)).collect();
        let x: Vec<f32> = (0..a).map(|_| rng.random_range(-1.0..1.0)).collect();
        learner.refresh();
        let Pdqn { types, seen, absent, q, encoder, heads, derived, passes, slots, parts, .. } = &mut learner;
        let Part { next, encoder: enc, heads: scratch, scratch: row, .. } = &mut parts[0];
        let mut whole = vec![0.0; k];
        for (code, value) in whole.iter_mut().enumerate() {
            next.value_mut(slots.obs)[..o].copy_from_slice(&obs);
            seen_arguments(seen, *absent, code, &x, &mut next.value_mut(slots.arguments)[..a]);
            q.with(|online, _| {
                q.graph.forward(online, next, 1, false);
                let (ha, hv) = (next.value(slots.advantage), next.value(slots.value));
                let one = std::slice::from_mut(value);
                heads.gather(online.flat, &derived[0], ha, hv, &[code as u32], scratch, one);
            });
        }
        enc.value_mut(slots.encoder_obs)[..o].copy_from_slice(&obs);
        q.params.with(|p| encoder.0.forward(Weights { flat: p, packed: &encoder.1 }, enc, 1, false));
        let e = enc.value(slots.encoded)[..8].to_vec();
        let mut values = |x: &[f32], dx: Option<(&mut [f32], f32)>| {
            let mut values = Vec::new();
            passes.row(types, seen, *absent, &e, x, row, dx, |_, q| values.push(q));
            values
        };
        let mut dx = vec![0.0; a];
        let found = values(&x, Some((&mut dx, 1.0)));
        for (k, (a, b)) in found.iter().zip(&whole).enumerate() {
            assert!((a - b).abs() < 1e-5, "{env}: type {k}: {a}, whole pass {b}");
        }
        for j in 0..a {
            let shifted = |by: f32| {
                let mut x = x.clone();
                x[j] += by;
                x
            };
            let sum = |values: Vec<f32>| values.iter().map(|v| f64::from(*v)).sum::<f64>();
            let slope = (sum(values(&shifted(1e-3), None)) - sum(values(&shifted(-1e-3), None))) / 2e-3;
            assert!((slope - f64::from(dx[j])).abs() < 2e-2 * slope.abs().max(1.0), "{env}: {slope}, {}", dx[j]);
        }
    }
}

#[test]
fn blocks_of_updates_follow_each_other_and_leave_the_other_network_alone() {
    let spec = spec("moving");
    let config = PdqnConfig { q_block: 2, x_block: 1, ..small(8) };
    let mut learner = Pdqn::single_pass(&config, &spec, SeedTree::new(1)).unwrap();
    let mut rng = SeedTree::new(2).stream("x");
    let (mut actions, mut chosen) = (vec![0.0; 24], Vec::new());
    learner.random(8, &mut rng, &mut chosen, &mut actions);
    let batch = RlBatch {
        obs: (0..80).map(|_| rng.random_range(-1.0..1.0)).collect(),
        actions,
        codes: vec![0.0; 8],
        returns: vec![0.5; 8],
        bootstrap: vec![0.9; 8],
        next_obs: (0..80).map(|_| rng.random_range(-1.0..1.0)).collect(),
    };
    let mut report = Report::new();
    let mut changed = Vec::new();
    for _ in 0..6 {
        let before: Vec<_> = learner.networks().into_iter().map(|(_, p)| p.with(<[f32]>::to_vec)).collect();
        learner.update(&batch, &mut rng, &mut report);
        let after: Vec<_> = learner.networks().into_iter().map(|(_, p)| p.with(<[f32]>::to_vec)).collect();
        changed.push((before[0] != after[0], before[2] != after[2]));
    }
    let (q, x) = ((true, false), (false, true));
    assert_eq!(changed, [q, q, x, q, q, x]);
}
