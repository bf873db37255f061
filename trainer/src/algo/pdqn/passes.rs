//! `Q(s, x̃_k)_k` of every type `k` with its own arguments `x̃_k`: the diagonal of the multi-pass network, and its gradient with
//! respect to the arguments.
//!
//! The first layers after the encoder are linear in the arguments, and the arguments of two types differ in a few places. So the
//! passes go from type to type, adding what changes, and only the one output of each pass that counts is formed: with the 1024
//! types of HardMove-10 a thousandth of the work of 1024 whole passes.

use std::ops::Range;

use crate::nn::Params;
use crate::nn::vector::{add_scaled, dot, vectorised};

use super::types::Types;

/// Types after which a running sum is formed anew, so that roundings do not add up.
const FRESH: usize = 32;

/// A stream (advantage or value) as the passes read it.
#[derive(Clone, Debug, Default)]
struct Stream {
    /// Weights of the encoder's values, `H x E`.
    encoder: Vec<f32>,
    bias: Vec<f32>,
    /// Weights of the arguments, `arguments x H`.
    arguments: Vec<f32>,
    /// Weights of the output, one row for each type (advantage, less the mean over types) or one in all (value).
    out: Vec<f32>,
    out_bias: Vec<f32>,
}

/// Weights of both streams, prepared once per change of the parameters.
#[derive(Clone, Debug, Default)]
pub struct Passes {
    version: Option<u64>,
    width: usize,
    encoder: usize,
    advantage: Stream,
    value: Stream,
}

/// Work memory of one row.
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    base: [Vec<f32>; 2],
    sum: [Vec<f32>; 2],
    back: [Vec<f32>; 2],
}

fn part(params: &Params, name: &str) -> Range<usize> {
    let parts = params.layout().parts();
    parts.iter().find(|p| p.name == name).map(|p| p.range.clone()).expect("the layers of the Q-network")
}

impl Stream {
    fn refresh(&mut self, params: &Params, name: &str, encoder: usize, arguments: usize) {
        let width = encoder + arguments;
        let [w, b] = ["weight", "bias"].map(|part_name| part(params, &format!("{name}.hidden.{part_name}")));
        let [ow, ob] = ["weight", "bias"].map(|part_name| part(params, &format!("{name}.{part_name}")));
        params.with(|p| {
            let rows = p[w].chunks_exact(width);
            self.encoder.clear();
            rows.clone().for_each(|row| self.encoder.extend_from_slice(&row[..encoder]));
            self.arguments.clear();
            (0..arguments).for_each(|j| self.arguments.extend(rows.clone().map(|row| row[encoder + j])));
            self.bias.clear();
            self.bias.extend_from_slice(&p[b]);
            self.out.clear();
            self.out.extend_from_slice(&p[ow]);
            self.out_bias.clear();
            self.out_bias.extend_from_slice(&p[ob]);
        });
    }

    /// Takes the mean over the rows of the output away from each.
    fn centre(&mut self) {
        let width = self.bias.len();
        let n = self.out_bias.len() as f32;
        let mut mean = vec![0.0; width];
        self.out.chunks_exact(width).for_each(|row| add_scaled(&mut mean, row, 1.0 / n));
        self.out.chunks_exact_mut(width).for_each(|row| add_scaled(row, &mean, -1.0));
        let mean: f32 = self.out_bias.iter().sum::<f32>() / n;
        self.out_bias.iter_mut().for_each(|b| *b -= mean);
    }

    /// Layer before its ReLU without any argument.
    fn base(&self, e: &[f32], base: &mut Vec<f32>) {
        base.clear();
        base.extend(self.encoder.chunks_exact(e.len()).zip(&self.bias).map(|(row, b)| dot(row, e) + b));
    }
}

/// `Σ relu(h) ⊙ w`.
#[inline(always)]
fn relu_dot(h: &[f32], w: &[f32]) -> f32 {
    let mut lanes = [0.0_f32; 16];
    let (ch, cw) = (h.chunks_exact(16), w.chunks_exact(16));
    let rest: f32 = ch.remainder().iter().zip(cw.remainder()).map(|(h, w)| if *h > 0.0 { h * w } else { 0.0 }).sum();
    for (h, w) in ch.zip(cw) {
        for ((l, h), w) in lanes.iter_mut().zip(h).zip(w) {
            *l += if *h > 0.0 { h * w } else { 0.0 };
        }
    }
    lanes.iter().sum::<f32>() + rest
}

/// `Σ w ⊙ d` where `h > 0`.
#[inline(always)]
fn gate(h: &[f32], w: &[f32], scale: f32, to: &mut [f32]) {
    for ((t, h), w) in to.iter_mut().zip(h).zip(w) {
        *t = if *h > 0.0 { scale * w } else { 0.0 };
    }
}

impl Passes {
    /// Brings the weights up to date with a Q-network whose encoder ends with `encoder` values.
    pub fn refresh(&mut self, params: &Params, encoder: usize, arguments: usize) {
        if self.version == Some(params.version()) {
            return;
        }
        self.version = Some(params.version());
        (self.width, self.encoder) = (encoder + arguments, encoder);
        self.advantage.refresh(params, "advantage", encoder, arguments);
        self.advantage.centre();
        self.value.refresh(params, "value", encoder, arguments);
    }

    /// Values of all types of one row: `e` are the encoder's values, `x` the arguments, `uses` as in [`Types`] and `absent` what
    /// stands for an argument that a type does not use. `each` gets every type with its value. Where `dx` is given, the
    /// gradient of `scale · Σ_k Q_k` is added to it.
    #[expect(clippy::too_many_arguments, reason = "the tensors of one layer")]
    pub fn row(
        &self,
        types: &Types,
        uses: &[bool],
        absent: f32,
        e: &[f32],
        x: &[f32],
        scratch: &mut Scratch,
        mut dx: Option<(&mut [f32], f32)>,
        mut each: impl FnMut(usize, f32),
    ) {
        let (n, h) = (x.len(), self.width);
        let streams = [&self.advantage, &self.value];
        for (stream, base) in streams.iter().zip(&mut scratch.base) {
            stream.base(e, base);
        }
        for back in &mut scratch.back {
            back.resize(h, 0.0);
        }
        for k in 0..types.len() {
            let now = &uses[k * n..(k + 1) * n];
            let anew = k.is_multiple_of(FRESH);
            for (stream, (sum, base)) in streams.iter().zip(scratch.sum.iter_mut().zip(&scratch.base)) {
                if anew {
                    sum.clone_from(base);
                }
                for (j, &x) in x.iter().enumerate() {
                    let change = match (anew, now[j]) {
                        (true, used) => {
                            if used {
                                x
                            } else {
                                absent
                            }
                        }
                        (false, used) if used == uses[(k - 1) * n + j] => continue,
                        (false, true) => x - absent,
                        (false, false) => absent - x,
                    };
                    let column = &stream.arguments[j * h..(j + 1) * h];
                    vectorised!(add_scaled(&mut sum[..], column, change));
                }
            }
            let [a, v] = &scratch.sum;
            let row = &self.advantage.out[k * h..(k + 1) * h];
            let q = vectorised!(relu_dot(&a[..], row)) + vectorised!(relu_dot(&v[..], &self.value.out[..]));
            each(k, q + self.advantage.out_bias[k] + self.value.out_bias[0]);
            if let Some((dx, scale)) = &mut dx {
                let [da, dv] = &mut scratch.back;
                vectorised!(gate(&a[..], row, *scale, &mut da[..]));
                vectorised!(gate(&v[..], &self.value.out[..], *scale, &mut dv[..]));
                for (j, dx) in dx.iter_mut().enumerate().filter(|(j, _)| now[*j]) {
                    let [ca, cv] = streams.map(|s| &s.arguments[j * h..(j + 1) * h]);
                    *dx += vectorised!(dot(ca, da)) + vectorised!(dot(cv, dv));
                }
            }
        }
    }
}
