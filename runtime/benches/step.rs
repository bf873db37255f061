//! Time of a control step on the host, networks of the Hopper policy: `cargo bench -p gadm-runtime --features encode`.
#![allow(clippy::unwrap_used, missing_docs, reason = "a benchmark may panic and is no API")]

#[path = "../tests/support/mod.rs"]
mod support;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use gadm_runtime::encode::{AlignedImage, FileOptions, QuantiseOptions, quantise, write_int8};
use gadm_runtime::{Policy, Scratch};
use std::hint::black_box;
use support::{hopper, observations};

fn step(criterion: &mut Criterion) {
    let model = hopper(1);
    let calibration = observations(1, &model, 200);
    let quantised = quantise(&model, &calibration, &QuantiseOptions::default()).unwrap();
    let image = AlignedImage::new(&write_int8(&quantised, &calibration[..44], &FileOptions::default()).unwrap());
    let policy = Policy::load(&image).unwrap();
    let mut memory = vec![0; policy.spec().scratch_words];
    let mut action = [0.0; 3];
    let obs = &calibration[..11];
    let mut group = criterion.benchmark_group("hopper");
    group.throughput(Throughput::Elements(u64::from(policy.spec().macs)));
    group.bench_function("act int8", |bencher| {
        bencher.iter(|| policy.act(black_box(obs), &mut Scratch::new(&mut memory), &mut action).unwrap());
    });
    group.bench_function("act float model", |bencher| {
        bencher.iter(|| model.act(black_box(obs), &mut action));
    });
    group.bench_function("load", |bencher| bencher.iter(|| Policy::load(black_box(&image)).unwrap()));
    group.finish();
}

criterion_group!(benches, step);
criterion_main!(benches);
