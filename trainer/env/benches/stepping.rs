//! Steps per second of every environment, resets included: `cargo bench -p gadm-envs`.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use gadm_envs::{EnvOptions, VecEnv, ids, make};
use gadm_runtime::space::ActionHead;

/// An action that keeps the body moving: alternating signs at half the range.
fn action(env: &dyn gadm_envs::Env) -> Vec<f32> {
    let half = |(i, signal): (usize, &gadm_envs::ActionSignal)| match signal.head {
        ActionHead::Continuous { .. } => signal.head.denormalise(if i % 2 == 0 { 0.5 } else { -0.5 }),
        ActionHead::Discrete { .. } | ActionHead::Binary => signal.safe,
    };
    env.spec().actions.iter().enumerate().map(half).collect()
}

fn single(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("step");
    group.throughput(Throughput::Elements(1));
    for id in ids() {
        let Ok(mut env) = make(id) else { continue };
        let action = action(&*env);
        let mut obs = vec![0.0; env.spec().obs_dim()];
        env.reset(0, &mut obs);
        let mut episode = 0;
        group.bench_function(id, |bencher| {
            bencher.iter(|| {
                let step = env.step(&action, &mut obs);
                if step.terminated || step.truncated {
                    episode += 1;
                    env.reset(episode, &mut obs);
                }
                step.reward
            });
        });
    }
    group.finish();
}

fn rows(criterion: &mut Criterion) {
    const N: usize = 16;
    let mut group = criterion.benchmark_group("row_of_16");
    group.throughput(Throughput::Elements(N as u64));
    for id in ["moving", "inverted-pendulum-v5", "hopper-v5"] {
        let Ok(env) = make(id) else { continue };
        let actions = action(&*env).repeat(N);
        for threads in [1, 2] {
            let Ok(envs) = (0..N).map(|_| gadm_envs::make_with(id, &EnvOptions::default())).collect() else { continue };
            let Ok(mut row) = VecEnv::from_envs(envs, 0, threads) else { continue };
            group.bench_function(format!("{id}/threads_{threads}"), |bencher| {
                bencher.iter(|| row.step(&actions).map(|batch| batch.rewards[0]));
            });
        }
    }
    group.finish();
}

criterion_group!(benches, single, rows);
criterion_main!(benches);
