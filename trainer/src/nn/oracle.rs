//! The oracle of [`super::graph`]: the same layers as plain candle operations, differentiated by candle's autograd.

use candle_core::{D, Result, Tensor};

use super::graph::{Graph, Op, STANDARDISE_EPS, Slot, Workspace};
use super::params::Params;

impl Graph {
    /// Interprets the graph with candle on batch statistics. `inputs` are the input slots with their tensors
    /// (`batch x width`); returns every value. Codes are taken from `ws`, where the fused pass left them, since an argmin has no
    /// gradient.
    ///
    /// # Errors
    /// Whatever candle reports.
    ///
    /// # Panics
    /// Where an input is missing.
    pub fn oracle(&self, params: &Params, ws: &Workspace, inputs: &[(Slot, Tensor)]) -> Result<Vec<Tensor>> {
        let mut values: Vec<Option<Tensor>> = vec![None; self.widths.len()];
        for (slot, tensor) in inputs {
            values[slot.0] = Some(tensor.clone());
        }
        let get = |values: &[Option<Tensor>], i: usize| values[i].clone().expect("inputs come first");
        for op in &self.ops {
            let (y, value) = match op {
                Op::Dense { x, y, w, b, relu, .. } => {
                    let w = params.tensor(w, &[self.widths[*y], self.widths[*x]])?;
                    let b = params.tensor(b, &[self.widths[*y]])?;
                    let value = get(&values, *x).matmul(&w.t()?)?.broadcast_add(&b)?;
                    (*y, if *relu { value.relu()? } else { value })
                }
                Op::Mul { a, b, y } => (*y, (get(&values, *a) * get(&values, *b))?),
                Op::Concat { a, b, y } => (*y, Tensor::cat(&[get(&values, *a), get(&values, *b)], 1)?),
                Op::Film { x, scale, shift, y, relu } => {
                    let value = (((get(&values, *scale) + 1.0)? * get(&values, *x))? + get(&values, *shift))?;
                    (*y, if *relu { value.relu()? } else { value })
                }
                Op::Standardise { x, y, gain, .. } => {
                    let x = get(&values, *x);
                    let centred = x.broadcast_sub(&x.mean_keepdim(0)?)?;
                    let deviation = (centred.sqr()?.mean_keepdim(0)? + f64::from(STANDARDISE_EPS))?.sqrt()?;
                    (*y, (centred.broadcast_div(&deviation)? * f64::from(*gain))?)
                }
                Op::Quantise { x, y, table, .. } => {
                    let x = get(&values, *x);
                    let width = x.dim(D::Minus1)?;
                    let table = params.tensor(table, &[table.len() / width, width])?;
                    let codes = Tensor::new(ws.codes(), x.device())?;
                    let rows = table.index_select(&codes, 0)?;
                    (*y, (&x + (rows - &x)?.detach())?)
                }
            };
            values[y] = Some(value);
        }
        Ok(values.into_iter().map(|v| v.expect("every value is computed")).collect())
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Tensor};
    use proptest::prelude::*;

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
        let mut grads = ws.gradient().to_vec();

        let tensor = |v: &[f32], w: usize| Tensor::from_slice(v, (batch, w), &Device::Cpu).unwrap();
        let values = graph.oracle(&params, &ws, &[(so, tensor(&x, obs)), (sa, tensor(&a, act))]).unwrap();
        let expected: Vec<f32> = values[out.0].flatten_all().unwrap().to_vec1().unwrap();
        close("output", &ws.value(out)[..batch * 3], &expected);
        let loss = (&values[out.0] * tensor(&c, 3)).unwrap().sum_all().unwrap();
        let store = loss.backward().unwrap();
        let expected: Vec<f32> = store.get(params.var()).unwrap().to_vec1().unwrap();
        close("gradient", &grads[..n], &expected[..n]);

        // The same in two parts.
        let first = batch / 2 + 1;
        let rows = [0..first, first..batch];
        let mut parts = [graph.workspace(first, n), graph.workspace(first, n)];
        for (part, rows) in parts.iter_mut().zip(&rows) {
            for (slot, values) in [(so, &x), (sa, &a)] {
                let w = values.len() / batch;
                part.value_mut(slot)[..rows.len() * w].copy_from_slice(&values[rows.start * w..rows.end * w]);
            }
        }
        params.with(|p| {
            let weights = Weights { flat: p, packed: &packed };
            graph.forward_parts(weights, &mut parts, &rows);
            for (part, rows) in parts.iter_mut().zip(&rows).filter(|(_, rows)| !rows.is_empty()) {
                part.grad_mut(out)[..rows.len() * 3].copy_from_slice(&c[rows.start * 3..rows.end * 3]);
            }
            graph.backward_parts(weights, &mut parts, &rows);
        });
        let whole: Vec<f32> = values[out.0].flatten_all().unwrap().to_vec1().unwrap();
        let used = parts.iter().zip(&rows).filter(|(_, rows)| !rows.is_empty());
        let joined: Vec<f32> = used.clone().flat_map(|(p, rows)| p.value(out)[..rows.len() * 3].to_vec()).collect();
        close("output in parts", &joined, &whole);
        grads.fill(0.0);
        for (part, _) in used {
            grads.iter_mut().zip(part.gradient()).for_each(|(g, p)| *g += p);
        }
        close("gradient in parts", &grads[..n], &expected[..n]);
        params.with_mut(|p| graph.update_running_statistics(p, &ws, batch));
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
}
