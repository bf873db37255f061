use super::*;
use crate::algo::dqn::TargetUpdate;
use crate::config::Schedule;
use crate::nn::AdamConfig;

fn space(env: &str) -> ActionSpace {
    ActionSpace::new(gadm_envs::make(env).unwrap().spec(), ContinuousHead::Tanh, true)
}

#[test]
fn bins_are_those_of_the_specification() {
    assert_eq!(bins(Grid::Inclusive, 3), [-1.0, 0.0, 1.0]);
    assert_eq!(bins(Grid::Inclusive, 5), [-1.0, -0.5, 0.0, 0.5, 1.0]);
    assert_eq!(bins(Grid::Authors, 2), [-1.0, 0.0], "+1 is never reached");
    assert_eq!(bins(Grid::Authors, 4), [-1.0, -0.5, 0.0, 0.5]);
}

/// Specification 7.2: 27, 729, 6561, and 3^17 for Humanoid.
#[test]
fn the_products_have_the_sizes_of_the_specification() {
    assert_eq!(count(&space("pendulum"), 3), Some(3));
    assert_eq!(count(&space("moving"), 3), Some(3 + 3 + 1), "each type with its own argument, brake without any");
    assert_eq!(count(&space("hard-move-4"), 3), Some(256), "sum over switches of 3^on = 4^4");
    #[cfg(feature = "mujoco")]
    for (env, n) in [("hopper-v5", 27), ("half-cheetah-v5", 729), ("ant-v5", 6561), ("humanoid-v4", 129_140_163)] {
        assert_eq!(count(&space(env), 3), Some(n), "{env}");
    }
    let list = product(&space("moving"), &[-1.0, 0.0, 1.0]);
    let rows: Vec<_> = list.chunks(3).map(<[f32]>::to_vec).collect();
    let expected = [[0, -1, 0], [0, 0, 0], [0, 1, 0], [1, 0, -1], [1, 0, 0], [1, 0, 1], [2, 0, 0]];
    assert_eq!(rows, expected.map(|row| row.map(|v| v as f32).to_vec()));
    assert_eq!(product(&space("hard-move-4"), &[-1.0, 0.0, 1.0]).len(), 256 * 8);
}

fn config(layout: HeadLayout) -> DqnManualConfig {
    let mut c = DqnManualConfig { layout, ..DqnManualConfig::default() };
    c.schedule = Schedule { batch: 4, ..Schedule::default() };
    (c.dqn.hidden, c.dqn.target) = (vec![4], TargetUpdate::Soft { tau: 1.0 });
    c.dqn.adam = AdamConfig { learning_rate: 0.1, grad_clip: 0.0, epsilon: 1e-3, ..AdamConfig::default() };
    c
}

#[test]
fn a_product_too_large_for_a_list_gets_an_output_group_per_slot() {
    let spec = gadm_envs::make("hard-move-4").unwrap().spec().clone();
    let seeds = SeedTree::new(1);
    let small = DqnManualConfig { limit: 255, ..config(HeadLayout::Auto) };
    let parts = |c: &DqnManualConfig| manual(c, &spec, seeds).map(|mut l| l.networks().len());
    assert_eq!(parts(&config(HeadLayout::Auto)).unwrap(), 3, "256 actions: a list");
    assert_eq!(parts(&small).unwrap(), 2);
    let text = parts(&DqnManualConfig { layout: HeadLayout::Flat, ..small }).unwrap_err().to_string();
    assert!(text.contains("dqn_manual.layout") && text.contains("255"), "{text}");
    let text = config(HeadLayout::Auto);
    let text = DqnManualConfig { dqn: DqnConfig { heads: 0, ..text.dqn.clone() }, ..text }.validate().unwrap_err();
    assert!(text.to_string().contains("`dqn_manual.dqn.heads`"), "{text}");
}

/// A network that is only biases, so that every number can be followed by hand: pendulum, bins -1, 0, 1.
#[test]
fn a_decoupled_update_by_hand() {
    let spec = gadm_envs::make("pendulum").unwrap().spec().clone();
    let (mut two, mut second) = (spec.clone(), spec.actions[0].clone());
    "second".clone_into(&mut second.name);
    two.actions.push(second);
    let mut c = config(HeadLayout::Decoupled);
    c.dqn.target = TargetUpdate::Hard { every: 500 };
    let values = bins(c.grid, c.bins);
    let mut q = Decoupled::new(&c, values, &two, SeedTree::new(1)).unwrap();
    let set = |params: &mut Params, biases: [f32; 6]| {
        let n = params.layout().len();
        params.with_mut(|p| {
            p.fill(0.0);
            p[n - 6..].copy_from_slice(&biases);
        });
    };
    // Online: slot 0 prefers bin 2 (value 3), slot 1 bin 0 (value 5); the target says 10 and 2 of those.
    set(&mut q.net.params, [1.0, 2.0, 3.0, 5.0, 4.0, 0.0]);
    set(&mut q.net.target, [0.0, 0.0, 10.0, 2.0, 0.0, 0.0]);
    let batch = RlBatch {
        obs: vec![0.0; 6],
        actions: vec![0.0, 1.0, -1.0, 0.0],
        codes: vec![0.0; 2],
        returns: vec![1.0, -1.0],
        bootstrap: vec![0.5, 0.0],
        next_obs: vec![0.0; 6],
    };
    let mut report = Report::new();
    q.update(&batch, &mut SeedTree::new(1).stream("x"), &mut report);
    // y = 1 + 0.5 (10 + 2)/2 = 4 and -1; Q = (2 + 0)/2 = 1 and (1 + 4)/2 = 2.5; loss (3² + 3.5²)/2.
    assert_eq!(q.targets(2), [4.0, -1.0]);
    assert_eq!(report[..2], [(keys::Q_LOSS, 10.625), (keys::Q_MEAN, 1.75)]);
    // Gradients of the taken outputs: 2 (Q - y) / 2 / (2 slots) = -1.5 for bins (1, 2), 1.75 for bins (0, 1).
    let new = q.net.params.with(|p| p[p.len() - 6..].to_vec());
    let step = |g: f32| 0.1 * g / (g.abs() + 1e-3);
    let expected = [1.0 - step(1.75), 2.0 - step(-1.5), 3.0, 5.0, 4.0 - step(1.75), 0.0 - step(-1.5)];
    for (a, b) in new.iter().zip(expected) {
        assert!((a - b).abs() < 1e-6, "{new:?}, expected {expected:?}");
    }
    let (mut chosen, mut action) = (Vec::new(), [0.0; 2]);
    q.act(&[0.0; 3], 1, &mut chosen, &mut action);
    assert_eq!((action, chosen.len()), ([1.0, -1.0], 0), "the best bin of each slot");
}

#[test]
fn centres_are_the_means_of_separate_groups() {
    let mut rng = SeedTree::new(3).stream("k");
    let mut points = Vec::new();
    for i in 0..40 {
        let wobble = 0.01 * (i / 4) as f32;
        let (x, y) = [(-0.8, -0.8), (-0.8, 0.8), (0.8, -0.8), (0.8, 0.8)][i % 4];
        points.extend([x + wobble, y - wobble]);
    }
    let centres = cluster(&points, 2, 4, 100, &mut rng).unwrap();
    let mut rows: Vec<_> = centres.chunks(2).map(|c| (c[0], c[1])).collect();
    rows.sort_by(|a, b| a.partial_cmp(b).unwrap());
    let expected = [(-0.755, -0.845), (-0.755, 0.755), (0.845, -0.845), (0.845, 0.755)];
    for ((x, y), (ex, ey)) in rows.iter().zip(expected) {
        assert!((x - ex).abs() < 1e-5 && (y - ey).abs() < 1e-5, "{rows:?}");
    }
    assert_eq!(cluster(&[0.5, 0.5, 0.5], 1, 2, 10, &mut rng), None, "one point, twice");
}
