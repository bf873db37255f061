//! The fused layers against the same layers in candle, differentiated by its autograd, and against a graph on a candle device.

use candle_core::{Device, Tensor};
use proptest::prelude::*;

use crate::nn::device::Engine;
use crate::nn::graph::{Graph, Slot, Weights, declare_dense};
use crate::nn::params::{Init, ParamLayout, Params};
use crate::seed::{Rng, SeedTree};

fn random(rng: &mut Rng, n: usize) -> Vec<f32> {
    use rand::RngExt as _;
    (0..n).map(|_| rng.random_range(-1.0_f32..1.0)).collect()
}

/// A graph with every kind of layer; returns it with its inputs and its output.
fn everything(
    layout: &mut ParamLayout,
    [obs, act, h, d, k]: [usize; 5],
    standardise: bool,
    one_hot: bool,
) -> (Graph, [Slot; 2], Slot) {
    let mut dense = |name: &str, i, o| declare_dense(layout, name, i, o, Init::torch(i));
    let (wa, ws, wg, wb) = (dense("a", act, h), dense("s", obs, h), dense("g", h, h), dense("b", h, h));
    let (wz, wu, wo) = (dense("z", h, d), dense("u", d, h), dense("o", h + d, 3));
    let table = layout.buffer("table", &[k, d], if one_hot { Init::OneHot } else { Init::Uniform(1.0) });
    let (mean, var) = (layout.buffer("mean", &[d], Init::Zero), layout.buffer("var", &[d], Init::Constant(1.0)));
    let mut graph = Graph::new();
    let (obs, act) = (graph.input(obs), graph.input(act));
    let (ha, hs) = (graph.dense(act, &wa, true), graph.dense(obs, &ws, true));
    let (scale, shift) = (graph.dense(hs, &wg, false), graph.dense(hs, &wb, false));
    let fused = graph.film(ha, scale, shift, true);
    let z = graph.dense(fused, &wz, false);
    // In a small batch the variance can be next to nothing, and dividing by it lifts every rounding above the
    // tolerance, candle's as much as ours: such batches go without.
    let z = if standardise { graph.standardise(z, mean, var, 0.5, 0.01) } else { z };
    let q = graph.quantise(z, table, one_hot);
    let u = graph.dense(q, &wu, true);
    let g = graph.mul(u, hs);
    let both = graph.concat(g, z);
    let out = graph.dense(both, &wo, false);
    (graph, [obs, act], out)
}

fn compare(batch: usize, obs: usize, act: usize, h: usize, d: usize, k: usize, seed: u64) {
    let mut rng = SeedTree::new(seed).stream("test");
    let mut layout = ParamLayout::new();
    let one_hot = d >= k && seed.is_multiple_of(2);
    let (graph, [so, sa], out) = everything(&mut layout, [obs, act, h, d, k], batch >= 12 && h >= 8, one_hot);
    let mut params = Params::init(layout, &mut rng).unwrap();
    let n = params.layout().trainable_len();
    let (mut ws, mut packed) = (graph.workspace(batch + 3, n), graph.packed());
    graph.refresh(&params, &mut packed, true);
    let (x, a, c) = (random(&mut rng, batch * obs), random(&mut rng, batch * act), random(&mut rng, batch * 3));
    ws.value_mut(so)[..x.len()].copy_from_slice(&x);
    ws.value_mut(sa)[..a.len()].copy_from_slice(&a);
    params.with(|p| graph.forward(Weights { flat: p, packed: &packed }, &mut ws, batch, true));
    ws.grad_mut(out)[..c.len()].copy_from_slice(&c);
    params.with(|p| graph.backward(Weights { flat: p, packed: &packed }, &mut ws));
    let grads = ws.gradient().to_vec();

    let tensor = |v: &[f32], w: usize| Tensor::from_slice(v, (batch, w), &Device::Cpu).unwrap();
    let inputs = [(so, tensor(&x, obs)), (sa, tensor(&a, act))];
    // The codes of the fused pass: an argmin has no gradient, and a tie may go either way.
    let values = graph.evaluate(params.var(), &inputs, true, Some(ws.codes())).unwrap().values;
    let expected: Vec<f32> = values[out.0].flatten_all().unwrap().to_vec1().unwrap();
    close("output", &ws.value(out)[..batch * 3], &expected);
    let loss = (&values[out.0] * tensor(&c, 3)).unwrap().sum_all().unwrap();
    let store = loss.backward().unwrap();
    let expected: Vec<f32> = store.get(params.var()).unwrap().to_vec1().unwrap();
    close("gradient", &grads[..n], &expected[..n]);

    // The same in two parts.
    let whole: Vec<f32> = values[out.0].flatten_all().unwrap().to_vec1().unwrap();
    let parts = in_parts(&graph, &mut params, [so, sa], out, [&x, &a, &c], batch);
    close("output in parts", &parts.output, &whole);
    close("gradient in parts", &parts.gradient, &expected[..n]);
}

/// What a training pass over two parts of a batch gives.
struct Pass {
    output: Vec<f32>,
    gradient: Vec<f32>,
    codes: Vec<u32>,
    /// Parameters after the running statistics moved.
    params: Vec<f32>,
}

/// `numbers` are both inputs and the gradient of the output.
fn in_parts(
    graph: &Graph,
    params: &mut Params,
    inputs: [Slot; 2],
    out: Slot,
    numbers: [&[f32]; 3],
    batch: usize,
) -> Pass {
    let first = batch / 2 + 1;
    let rows = [0..first, first..batch];
    let n = params.layout().trainable_len();
    let of = |numbers: &[f32], rows: &std::ops::Range<usize>| {
        let width = numbers.len() / batch;
        numbers[rows.start * width..rows.end * width].to_vec()
    };
    let (mut parts, mut packed) = ([graph.workspace(first, n), graph.workspace(first, n)], graph.packed());
    graph.refresh(params, &mut packed, true);
    for (part, rows) in parts.iter_mut().zip(&rows) {
        for (slot, numbers) in inputs.into_iter().zip(numbers) {
            let own = of(numbers, rows);
            part.value_mut(slot)[..own.len()].copy_from_slice(&own);
        }
    }
    params.with(|p| {
        let weights = Weights { flat: p, packed: &packed };
        graph.forward_parts(weights, &mut parts, &rows);
        for (part, rows) in parts.iter_mut().zip(&rows).filter(|(_, rows)| !rows.is_empty()) {
            let own = of(numbers[2], rows);
            part.grad_mut(out)[..own.len()].copy_from_slice(&own);
        }
        graph.backward_parts(weights, &mut parts, &rows);
    });
    params.with_mut(|p| graph.update_running_statistics(p, &parts[0], batch));
    let used = || parts.iter().zip(&rows).filter(|(_, rows)| !rows.is_empty());
    let mut gradient = vec![0.0; n];
    used().for_each(|(part, _)| gradient.iter_mut().zip(part.gradient()).for_each(|(g, p)| *g += p));
    Pass {
        output: used().flat_map(|(part, rows)| part.value(out)[..rows.len() * 3].to_vec()).collect(),
        gradient,
        codes: used().flat_map(|(part, _)| part.codes().to_vec()).collect(),
        params: params.with(<[f32]>::to_vec),
    }
}

/// A graph that candle evaluates on a device gives what the fused layers give, in training and with running statistics. The device
/// is the processor; a GPU runs the same operations.
#[test]
fn a_graph_on_a_device_equals_the_fused_one() {
    for (seed, batch) in [(0, 12), (1, 12), (2, 33), (3, 33), (4, 200), (5, 3), (6, 2)] {
        let sizes @ [obs, act, ..] = [7, 3, 24, 8, 6];
        let make = |engine: Engine| {
            let mut layout = ParamLayout::new();
            engine.start().unwrap();
            let graph = everything(&mut layout, sizes, batch >= 12, seed % 2 == 0);
            Engine::Fused.start().unwrap();
            (Params::init(layout, &mut SeedTree::new(seed).stream("weights")).unwrap(), graph)
        };
        let rng = &mut SeedTree::new(seed).stream("data");
        let numbers = [random(rng, batch * obs), random(rng, batch * act), random(rng, batch * 3)];
        let [fused, device] = [Engine::Fused, Engine::Candle].map(|engine| {
            let (mut params, (graph, inputs, out)) = make(engine);
            let pass = in_parts(&graph, &mut params, inputs, out, numbers.each_ref().map(Vec::as_slice), batch);
            let (mut ws, mut packed) = (graph.workspace(batch, 0), graph.packed());
            graph.refresh(&params, &mut packed, false);
            for (slot, numbers) in inputs.into_iter().zip(&numbers) {
                ws.value_mut(slot)[..numbers.len()].copy_from_slice(numbers);
            }
            params.with(|p| graph.forward(Weights { flat: p, packed: &packed }, &mut ws, batch, false));
            (pass, ws.codes().to_vec(), ws.value(out)[..batch * 3].to_vec())
        });
        assert_eq!((&device.0.codes, &device.1), (&fused.0.codes, &fused.1), "codes of batch {batch}");
        close("output", &device.0.output, &fused.0.output);
        close("gradient", &device.0.gradient, &fused.0.gradient);
        close("parameters", &device.0.params, &fused.0.params);
        close("output with running statistics", &device.2, &fused.2);
    }
}

/// Relative to the largest entry, as the issue states it: 1e-5.
fn close(what: &str, ours: &[f32], expected: &[f32]) {
    let scale = expected.iter().fold(1e-3_f32, |m, v| m.max(v.abs()));
    for (i, (a, b)) in ours.iter().zip(expected).enumerate() {
        assert!((a - b).abs() <= 1e-5 * scale, "{what} {i}: ours {a}, candle {b}, scale {scale}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn fused_values_and_gradients_equal_candles(
        batch in 2_usize..40, obs in 1_usize..9, act in 1_usize..6, h in 1_usize..33, d in 1_usize..9, k in 1_usize..9, seed: u64
    ) {
        compare(batch, obs, act, h, d, k, seed);
    }
}
