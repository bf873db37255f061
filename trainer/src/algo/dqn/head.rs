//! The last layers of the Q-network: E dueling heads on shared streams,
//! `Q[k,e] = A[k,e] - mean_K A[·,e] + V[e]` (specification 4.1), computed only where they are needed.
//!
//! A decision needs the mean over heads of every latent: one product with the head-averaged weights, and since neither the mean
//! over latents nor the value moves the argmax, nothing else. A target or a loss needs E numbers of one latent per row: a
//! gather. The full `K x E` product (10 times the cost of the trunk at K = 64, E = 20) is never formed.

use std::ops::Range;

use crate::nn::graph::OuterLayer;
use crate::nn::kernel::{Epilogue, Left, Product, Right, product};
use crate::nn::pack::{PANEL, groups_len, pack_groups_and_sum, pack_panels, pack_panels_transposed, panels_len};
use crate::nn::vector::{add_scaled, dot, vectorised};
use crate::nn::{Init, ParamLayout, Params};

/// Places and sizes of the heads' parameters.
#[derive(Clone, Debug)]
#[expect(clippy::struct_field_names, reason = "the field's term for E")]
pub struct Heads {
    latents: usize,
    heads: usize,
    width: usize,
    dueling: bool,
    wa: Range<usize>,
    ba: Range<usize>,
    wv: Range<usize>,
    bv: Range<usize>,
}

/// What is derived from the parameters once per change of them: averages, and weights as the products read them.
#[derive(Clone, Debug, Default)]
pub struct Derived {
    version: Option<u64>,
    /// Advantage weights and biases: mean over heads, `K x width` and `K`.
    per_latent: (Vec<f32>, Vec<f32>),
    /// Minus the mean over latents, `E x width`.
    minus_mean: Vec<f32>,
    /// Value bias minus the mean over latents of the advantage biases, `E`.
    bias: Vec<f32>,
    /// `per_latent`, for the forward product.
    latent_panels: Vec<f32>,
    /// `minus_mean`, for the forward and for the backward product.
    mean_panels: (Vec<f32>, Vec<f32>),
    /// Value weights, for the forward and for the backward product.
    value_panels: (Vec<f32>, Vec<f32>),
}

/// Work memory of the heads for some rows.
#[derive(Clone, Debug)]
pub struct HeadScratch {
    /// Rows in order of their codes, so that the weights of a code are read once.
    order: Vec<u32>,
    starts: Vec<u32>,
    left: Vec<f32>,
    right: Vec<f32>,
    mean: (Vec<f32>, Vec<f32>),
}

impl HeadScratch {
    /// Sorts the rows by code (counting sort; equal codes keep their order).
    fn sort(&mut self, codes: &[u32]) {
        self.starts.fill(0);
        for &code in codes {
            self.starts[code as usize + 1] += 1;
        }
        for i in 1..self.starts.len() {
            self.starts[i] += self.starts[i - 1];
        }
        for (row, &code) in codes.iter().enumerate() {
            let at = &mut self.starts[code as usize];
            self.order[*at as usize] = row as u32;
            *at += 1;
        }
    }
}

impl Heads {
    /// Declares the parameters `advantage.*` (`K·E x width`, row `k·E + e`) and `value.*` (`E x width`).
    pub fn declare(layout: &mut ParamLayout, latents: usize, heads: usize, width: usize, dueling: bool) -> Self {
        let init = Init::torch(width);
        Self {
            latents,
            heads,
            width,
            dueling,
            wa: layout.param("advantage.weight", &[latents * heads, width], init),
            ba: layout.param("advantage.bias", &[latents * heads], init),
            wv: layout.param("value.weight", &[if dueling { heads } else { 0 }, width], init),
            bv: layout.param("value.bias", &[if dueling { heads } else { 0 }], init),
        }
    }

    /// Work memory for up to `batch` rows.
    pub fn scratch(&self, batch: usize) -> HeadScratch {
        let (e, w) = (self.heads, self.width);
        HeadScratch {
            order: vec![0; batch],
            starts: vec![0; self.latents + 1],
            left: vec![0.0; if self.dueling { groups_len(e, batch) } else { 0 }],
            right: vec![0.0; if self.dueling { PANEL * batch } else { 0 }],
            mean: (vec![0.0; e * w], vec![0.0; e]),
        }
    }

    /// Brings `derived` up to date with `params`.
    pub fn refresh(&self, params: &Params, derived: &mut Derived) {
        if derived.version == Some(params.version()) {
            return;
        }
        derived.version = Some(params.version());
        let (k, e, w) = (self.latents, self.heads, self.width);
        params.with(|p| {
            self.average(p, derived);
            let Derived { per_latent, minus_mean, latent_panels, mean_panels, value_panels, .. } = derived;
            latent_panels.resize(panels_len(w, k), 0.0);
            pack_panels_transposed(&per_latent.0, w, k, latent_panels);
            if self.dueling {
                for ((forward, backward), weights) in
                    [(mean_panels, minus_mean.as_slice()), (value_panels, &p[self.wv.clone()])]
                {
                    forward.resize(panels_len(w, e), 0.0);
                    backward.resize(panels_len(e, w), 0.0);
                    pack_panels_transposed(weights, w, e, forward);
                    pack_panels(weights, e, w, backward);
                }
            }
        });
    }

    fn average(&self, p: &[f32], out: &mut Derived) {
        let (k, e, w) = (self.latents, self.heads, self.width);
        let (wa, ba) = (&p[self.wa.clone()], &p[self.ba.clone()]);
        let reset = |v: &mut Vec<f32>, n| {
            v.clear();
            v.resize(n, 0.0);
        };
        reset(&mut out.per_latent.0, k * w);
        reset(&mut out.per_latent.1, k);
        reset(&mut out.minus_mean, e * w);
        reset(&mut out.bias, e);
        if self.dueling {
            out.bias.copy_from_slice(&p[self.bv.clone()]);
        }
        let Derived { per_latent, minus_mean, bias, .. } = out;
        for (latent, (weights, biases)) in wa.chunks_exact(e * w).zip(ba.chunks_exact(e)).enumerate() {
            let mean = &mut per_latent.0[latent * w..(latent + 1) * w];
            for (row, b) in weights.chunks_exact(w).zip(biases) {
                vectorised!(add_scaled(&mut *mean, row, 1.0 / e as f32));
                per_latent.1[latent] += b / e as f32;
            }
            if self.dueling {
                vectorised!(add_scaled(&mut minus_mean[..], weights, -1.0 / k as f32));
                add_scaled(bias, biases, -1.0 / k as f32);
            }
        }
    }

    /// Mean over heads of every latent's advantage into `out` (`B x K`): orders latents as the mean Q does.
    pub fn scores(&self, derived: &Derived, ha: &[f32], batch: usize, out: &mut [f32]) {
        product(Product {
            m: batch,
            n: self.latents,
            k: self.width,
            left: Left::Rows(ha),
            right: Right::Panels(&derived.latent_panels),
            c: out,
            end: Epilogue::Bias(&derived.per_latent.1, false),
        });
    }

    /// Head-averaged advantage layer: `K x width` weights and `K` biases. What the device keeps of the heads.
    pub fn folded(derived: &Derived) -> (Vec<f32>, Vec<f32>) {
        derived.per_latent.clone()
    }

    /// `Q[b, codes[b], e]` into `out` (`B x E`). Leaves the order of the codes in `scratch` for [`backward`](Self::backward).
    #[expect(clippy::too_many_arguments, reason = "the tensors of one layer")]
    pub fn gather(
        &self,
        p: &[f32],
        derived: &Derived,
        ha: &[f32],
        hv: &[f32],
        codes: &[u32],
        scratch: &mut HeadScratch,
        out: &mut [f32],
    ) {
        let (batch, e, w) = (codes.len(), self.heads, self.width);
        if self.dueling {
            let layer = |left, right, c: &mut [f32], end| {
                let (left, right) = (Left::Rows(left), Right::Panels(right));
                product(Product { m: batch, n: e, k: w, left, right, c, end });
            };
            layer(hv, &derived.value_panels.0, &mut *out, Epilogue::Bias(&derived.bias, false));
            layer(ha, &derived.mean_panels.0, &mut *out, Epilogue::Add);
        } else {
            out[..batch * e].fill(0.0);
        }
        scratch.sort(codes);
        let (wa, ba) = (&p[self.wa.clone()], &p[self.ba.clone()]);
        vectorised!(gather_rows(&scratch.order[..batch], codes, (e, w), ha, wa, ba, out));
    }

    /// Back-propagates `grad` (`B x E`, of the Q values that [`gather`](Self::gather) has just given): parameter gradients are
    /// added, the gradients of both streams set. `layer.a` is the advantage stream, `layer.b` the value stream.
    pub fn backward(
        &self,
        p: &[f32],
        derived: &Derived,
        codes: &[u32],
        grad: &[f32],
        scratch: &mut HeadScratch,
        layer: OuterLayer,
    ) {
        let (batch, k, e, w) = (codes.len(), self.latents, self.heads, self.width);
        let OuterLayer { a: ha, b: hv, da, db, gradient } = layer;
        if self.dueling {
            let HeadScratch { left, right, mean, .. } = scratch;
            vectorised!(pack_groups_and_sum(&grad[..batch * e], e, batch, left, &mut mean.1));
            let mut weights = |inputs: &[f32], c: &mut [f32]| {
                let (left, right) = (Left::Groups(left), Right::Rows(inputs, right));
                product(Product { m: e, n: w, k: batch, left, right, c, end: Epilogue::Store });
            };
            let inputs = |right: &[f32], c: &mut [f32]| {
                let (left, right) = (Left::Rows(grad), Right::Panels(right));
                product(Product { m: batch, n: w, k: e, left, right, c, end: Epilogue::Store });
            };
            weights(&hv[..batch * w], &mut gradient[self.wv.clone()]);
            inputs(&derived.value_panels.1, db);
            weights(&ha[..batch * w], &mut mean.0);
            inputs(&derived.mean_panels.1, da);
            vectorised!({
                add_scaled(&mut gradient[self.bv.clone()], &mean.1, 1.0);
                // The mean over latents: -1/K of the head's gradient reaches every row of that head.
                for block in gradient[self.wa.clone()].chunks_exact_mut(e * w) {
                    add_scaled(block, &mean.0, -1.0 / k as f32);
                }
                for block in gradient[self.ba.clone()].chunks_exact_mut(e) {
                    add_scaled(block, &mean.1, -1.0 / k as f32);
                }
            });
        } else {
            da[..batch * w].fill(0.0);
        }
        let wa = &p[self.wa.clone()];
        let (advantage, rest) = gradient[self.wa.start..].split_at_mut(self.wa.len());
        let bias = &mut rest[self.ba.start - self.wa.end..][..self.ba.len()];
        vectorised!(backward_rows(&scratch.order[..batch], codes, (e, w), ha, wa, grad, da, advantage, bias));
    }
}

/// Adds `A[code, e]` of each row, in the order of the codes. `shape` is (E, width).
#[inline(always)]
fn gather_rows(
    order: &[u32],
    codes: &[u32],
    (e, w): (usize, usize),
    ha: &[f32],
    wa: &[f32],
    ba: &[f32],
    out: &mut [f32],
) {
    for &b in order {
        let (b, first) = (b as usize, codes[b as usize] as usize * e);
        let h = &ha[b * w..(b + 1) * w];
        let rows = wa[first * w..(first + e) * w].chunks_exact(w).zip(&ba[first..first + e]);
        for (o, (row, bias)) in out[b * e..(b + 1) * e].iter_mut().zip(rows) {
            *o += dot(row, h) + bias;
        }
    }
}

/// Adds the gradients of the rows that [`gather_rows`] read and of the stream, in the order of the codes.
#[inline(always)]
#[expect(clippy::too_many_arguments, reason = "the tensors of one layer")]
fn backward_rows(
    order: &[u32],
    codes: &[u32],
    (e, w): (usize, usize),
    ha: &[f32],
    wa: &[f32],
    grad: &[f32],
    dha: &mut [f32],
    dwa: &mut [f32],
    dba: &mut [f32],
) {
    for &b in order {
        let (b, first) = (b as usize, codes[b as usize] as usize * e);
        let (h, dh, g) = (&ha[b * w..(b + 1) * w], &mut dha[b * w..(b + 1) * w], &grad[b * e..(b + 1) * e]);
        let rows = dwa[first * w..(first + e) * w].chunks_exact_mut(w).zip(wa[first * w..].chunks_exact(w));
        for (&g, (to, row)) in g.iter().zip(rows) {
            add_scaled(to, h, g);
            add_scaled(dh, row, g);
        }
        add_scaled(&mut dba[first..first + e], g, 1.0);
    }
}
