//! The last layers of the Q-network: E dueling heads on shared streams,
//! `Q[k,e] = A[k,e] - mean_K A[·,e] + V[e]` (specification 4.1), computed only where they are needed.
//!
//! A decision needs the mean over heads of every latent: one product with the head-averaged weights, and since neither the mean
//! over latents nor the value moves the argmax, nothing else. A target or a loss needs E numbers of one latent per row: a
//! gather. The full `K x E` product (10 times the cost of the trunk at K = 64, E = 20) is never formed.

use std::ops::Range;

use crate::nn::gemm::{matmul_nn, matmul_nt, matmul_tn_add};
use crate::nn::{Init, ParamLayout};

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

/// Averages of the advantage weights, made once per parameter change.
#[derive(Clone, Debug, Default)]
pub struct Averages {
    /// Mean over heads, `K x width` and `K`.
    per_latent: (Vec<f32>, Vec<f32>),
    /// Value minus mean-over-latents advantage: mean over latents, `E x width` and `E`.
    per_head: (Vec<f32>, Vec<f32>),
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0_f32; 8];
    let (ca, cb) = (a.chunks_exact(8), b.chunks_exact(8));
    let rest: f32 = ca.remainder().iter().zip(cb.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in ca.zip(cb) {
        for ((l, x), y) in lanes.iter_mut().zip(x).zip(y) {
            *l += x * y;
        }
    }
    lanes.iter().sum::<f32>() + rest
}

fn add_scaled(to: &mut [f32], from: &[f32], scale: f32) {
    to.iter_mut().zip(from).for_each(|(t, f)| *t += scale * f);
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

    /// Averages the weights.
    pub fn average(&self, p: &[f32], out: &mut Averages) {
        let (k, e, w) = (self.latents, self.heads, self.width);
        let (wa, ba) = (&p[self.wa.clone()], &p[self.ba.clone()]);
        let reset = |v: &mut Vec<f32>, n| {
            v.clear();
            v.resize(n, 0.0);
        };
        reset(&mut out.per_latent.0, k * w);
        reset(&mut out.per_latent.1, k);
        reset(&mut out.per_head.0, e * w);
        reset(&mut out.per_head.1, e);
        for row in 0..k * e {
            let (latent, head, weights) = (row / e, row % e, &wa[row * w..(row + 1) * w]);
            add_scaled(&mut out.per_latent.0[latent * w..(latent + 1) * w], weights, 1.0 / e as f32);
            out.per_latent.1[latent] += ba[row] / e as f32;
            if self.dueling {
                add_scaled(&mut out.per_head.0[head * w..(head + 1) * w], weights, 1.0 / k as f32);
                out.per_head.1[head] += ba[row] / k as f32;
            }
        }
    }

    /// Mean over heads of every latent's advantage, `B x K`: orders latents as the mean Q does.
    pub fn scores(&self, averages: &Averages, ha: &[f32], batch: usize, out: &mut Vec<f32>) {
        out.resize(batch * self.latents, 0.0);
        matmul_nt(batch, self.latents, self.width, ha, &averages.per_latent.0, out);
        for row in out.chunks_exact_mut(self.latents) {
            row.iter_mut().zip(&averages.per_latent.1).for_each(|(o, b)| *o += b);
        }
    }

    /// Head-averaged advantage layer: `K x width` weights and `K` biases. What the device keeps of the heads.
    pub fn folded(averages: &Averages) -> (Vec<f32>, Vec<f32>) {
        averages.per_latent.clone()
    }

    /// `Q[b, codes[b], e]` into `out` (`B x E`).
    pub fn gather(&self, p: &[f32], averages: &Averages, ha: &[f32], hv: &[f32], codes: &[u32], out: &mut Vec<f32>) {
        let (batch, e, w) = (codes.len(), self.heads, self.width);
        out.clear();
        out.resize(batch * e, 0.0);
        if self.dueling {
            let mut mean = vec![0.0; batch * e];
            matmul_nt(batch, e, w, hv, &p[self.wv.clone()], out);
            matmul_nt(batch, e, w, ha, &averages.per_head.0, &mut mean);
            let bv = &p[self.bv.clone()];
            for (o, m) in out.chunks_exact_mut(e).zip(mean.chunks_exact(e)) {
                for (i, (o, m)) in o.iter_mut().zip(m).enumerate() {
                    *o += bv[i] - m - averages.per_head.1[i];
                }
            }
        }
        let (wa, ba) = (&p[self.wa.clone()], &p[self.ba.clone()]);
        for ((o, h), &code) in out.chunks_exact_mut(e).zip(ha.chunks_exact(w)).zip(codes) {
            for (head, o) in o.iter_mut().enumerate() {
                let row = code as usize * e + head;
                *o += dot(&wa[row * w..(row + 1) * w], h) + ba[row];
            }
        }
    }

    /// Back-propagates `grad` (`B x E`, of the gathered Q values): parameter gradients are added to `grads`, stream gradients
    /// to `dha` and `dhv` (zero at the start).
    #[expect(clippy::too_many_arguments, reason = "the tensors of one layer")]
    pub fn backward(
        &self,
        p: &[f32],
        averages: &Averages,
        ha: &[f32],
        hv: &[f32],
        codes: &[u32],
        grad: &[f32],
        grads: &mut [f32],
        dha: &mut [f32],
        dhv: &mut [f32],
    ) {
        let (batch, k, e, w) = (codes.len(), self.latents, self.heads, self.width);
        if self.dueling {
            matmul_tn_add(e, w, batch, grad, hv, &mut grads[self.wv.clone()]);
            for row in grad.chunks_exact(e) {
                add_scaled(&mut grads[self.bv.clone()], row, 1.0);
            }
            matmul_nn(batch, w, e, grad, &p[self.wv.clone()], dhv, false);
            // The mean over latents: -1/K of the head's gradient reaches every row of that head.
            let (mut mean_w, mut mean_b) = (vec![0.0; e * w], vec![0.0; e]);
            matmul_tn_add(e, w, batch, grad, ha, &mut mean_w);
            for row in grad.chunks_exact(e) {
                add_scaled(&mut mean_b, row, 1.0);
            }
            for row in 0..k * e {
                let head = row % e;
                let at = self.wa.start + row * w;
                add_scaled(&mut grads[at..at + w], &mean_w[head * w..(head + 1) * w], -1.0 / k as f32);
                grads[self.ba.start + row] -= mean_b[head] / k as f32;
            }
            matmul_nn(batch, w, e, grad, &averages.per_head.0, dha, false);
            dha[..batch * w].iter_mut().for_each(|v| *v = -*v);
        }
        let wa = &p[self.wa.clone()];
        let rows = ha.chunks_exact(w).zip(dha.chunks_exact_mut(w)).zip(grad.chunks_exact(e)).zip(codes);
        for (((h, dh), g), &code) in rows {
            for (head, &g) in g.iter().enumerate() {
                let row = code as usize * e + head;
                let at = self.wa.start + row * w;
                add_scaled(&mut grads[at..at + w], h, g);
                grads[self.ba.start + row] += g;
                add_scaled(dh, &wa[row * w..(row + 1) * w], g);
            }
        }
    }
}
