//! One layer: weights to int8 with a scale per row, rows to `a` and `b` places, scales to multipliers and offsets.
//!
//! An accumulator of an `a` row (even places) must stay below 2^23, one of a `b` row fits 32 bits; see `prove.rs`, which
//! checks the result.

use super::int_model::IntLayer;
use super::model::Dense;
use crate::prove::{ACC_LIMIT, RESULT_LIMIT, Range};
use crate::quant::HIDDEN_SHIFT;
use std::vec;
use std::vec::Vec;

/// Largest magnitude of a weight.
const TOP: f64 = 127.0;
/// Largest accumulator of an `a` row.
const A_LIMIT: f64 = 8_388_607.0;

/// A layer in `f64`.
#[derive(Clone, Debug)]
pub(crate) struct RealLayer {
    pub(crate) rows: usize,
    pub(crate) cols: usize,
    pub(crate) weight: Vec<f64>,
    pub(crate) bias: Vec<f64>,
}

impl RealLayer {
    pub(crate) fn new(layer: &Dense) -> Self {
        Self {
            rows: layer.rows,
            cols: layer.cols,
            weight: layer.weight.iter().map(|&w| f64::from(w)).collect(),
            bias: layer.bias.iter().map(|&b| f64::from(b)).collect(),
        }
    }

    pub(crate) fn permute_columns(&mut self, order: &[usize]) {
        for row in self.weight.chunks_exact_mut(self.cols) {
            let old = row.to_vec();
            for (w, &column) in row.iter_mut().zip(order) {
                *w = old[column];
            }
        }
    }

    pub(crate) fn permute_rows(&mut self, order: &[usize]) {
        self.weight = order.iter().flat_map(|&r| self.weight[r * self.cols..(r + 1) * self.cols].to_vec()).collect();
        self.bias = order.iter().map(|&r| self.bias[r]).collect();
    }

    fn row(&self, row: usize) -> &[f64] {
        &self.weight[row * self.cols..(row + 1) * self.cols]
    }
}

/// Integers of a row for a step, and their interval of sums without start value.
fn integers(row: &[f64], step: f64) -> Vec<i8> {
    row.iter().map(|w| (w / step).round().clamp(-TOP, TOP) as i8).collect()
}

fn interval(row: &[i8], range: Range) -> (f64, f64) {
    let (lo, hi) = (range.lo as f64, range.hi as f64);
    row.iter().fold((0.0, 0.0), |(low, high), &w| {
        let w = f64::from(w);
        (low + (w * lo).min(w * hi), high + (w * lo).max(w * hi))
    })
}

/// Largest magnitude of the sums of a row at full scale.
fn reach(row: &[f64], range: Range) -> f64 {
    let (low, high) = interval(&integers(row, full_step(row)), range);
    low.abs().max(high.abs())
}

/// Step that gives the largest weight 127.
fn full_step(row: &[f64]) -> f64 {
    let max = row.iter().fold(0.0, |max: f64, w| max.max(w.abs()));
    if max > 0.0 { max / TOP } else { 1.0 }
}

/// Order of hidden rows that puts those with the smaller sums into the `a` places (even), the others into the `b` places.
pub(crate) fn pair_order(layer: &RealLayer, range: Range) -> Vec<usize> {
    let mut sorted: Vec<(f64, usize)> = (0..layer.rows).map(|row| (reach(layer.row(row), range), row)).collect();
    sorted.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
    let half = layer.rows.div_ceil(2);
    let place = |index: usize| if index.is_multiple_of(2) { index / 2 } else { half + index / 2 };
    (0..layer.rows).map(|index| sorted[place(index)].1).collect()
}

/// How many times the largest sum of an `a` row is beyond its limit at full scale; `free`: rows may be reordered.
pub(crate) fn excess(layer: &RealLayer, range: Range, free: bool) -> f64 {
    let order = if free { pair_order(layer, range) } else { (0..layer.rows).collect() };
    order.iter().step_by(2).map(|&row| reach(layer.row(row), range) / A_LIMIT).fold(0.0, f64::max)
}

/// A layer with integer weights and a step per row.
#[derive(Clone, Debug)]
pub(crate) struct Rows {
    count: usize,
    cols: usize,
    weights: Vec<i8>,
    step: Vec<f64>,
    bias: Vec<f64>,
    /// `a` rows whose weights were made smaller.
    pub(crate) shrunk: usize,
}

/// Rounds weights; makes those of an `a` row smaller where its sums would leave their range; puts the mean error of
/// rounding over the calibration set into the bias.
pub(crate) fn quantise_rows(layer: &RealLayer, range: Range, x_mean: &[f64]) -> Rows {
    let mut rows = Rows { count: layer.rows, cols: layer.cols, weights: vec![], step: vec![], bias: vec![], shrunk: 0 };
    for index in 0..layer.rows {
        let row = layer.row(index);
        let mut step = full_step(row);
        let mut weights = integers(row, step);
        if index.is_multiple_of(2) && reach(row, range) > A_LIMIT {
            rows.shrunk += 1;
            while {
                let (low, high) = interval(&weights, range);
                low.abs().max(high.abs()) > A_LIMIT
            } {
                let (low, high) = interval(&weights, range);
                step *= (low.abs().max(high.abs()) / A_LIMIT).max(1.001);
                weights = integers(row, step);
            }
        }
        let errors = row.iter().zip(&weights).zip(x_mean);
        let lost: f64 = errors.map(|((w, q), x)| (w - f64::from(*q) * step) * x).sum();
        rows.bias.push(layer.bias[index] + lost);
        rows.step.push(step);
        rows.weights.extend(weights);
    }
    rows
}

/// A row's start value and what it leaves of the bias.
struct Start {
    /// 256 A or B.
    value: i64,
    /// Bias that the start value does not hold.
    rest: f64,
    /// Largest magnitude of the accumulator (256 A or B).
    reach: i64,
}

impl Rows {
    /// 256 for `a` rows, 1 for `b` rows.
    fn lift(row: usize) -> i64 {
        if row.is_multiple_of(2) { 256 } else { 1 }
    }

    fn start(&self, row: usize, x_scale: f64, range: Range) -> Start {
        let weights = &self.weights[row * self.cols..(row + 1) * self.cols];
        let (low, high) = interval(weights, range);
        let unit = self.step[row] * x_scale;
        let limit = if row.is_multiple_of(2) { A_LIMIT } else { (1i64 << 29) as f64 };
        let used = weights.iter().any(|&w| w != 0);
        let start = if used {
            (self.bias[row] / unit).round().clamp((-limit - low).min(0.0), (limit - high).max(0.0))
        } else {
            0.0
        };
        let lift = Self::lift(row);
        Start {
            value: start as i64 * lift,
            rest: self.bias[row] - start * unit,
            reach: ((low + start).abs().max((high + start).abs())) as i64 * lift,
        }
    }

    /// Multiplier for `real = unit * acc` in units of `step / 2^shift`, and offset for `offset` in the same units;
    /// `None` when one of them or a result leaves its range.
    fn constants(row: usize, start: &Start, unit: f64, offset: f64, half: f64) -> Option<(i32, i32)> {
        let m = (unit * 4_294_967_296.0 / Self::lift(row) as f64).round();
        let p = (offset + half).round();
        if m.abs() > f64::from(i32::MAX) || p.abs() > f64::from(RESULT_LIMIT) || start.reach > i64::from(ACC_LIMIT) {
            return None;
        }
        let product = (i128::from(start.reach) * (m.abs() as i128)) >> 32;
        (product + 1 + p.abs() as i128 <= i128::from(RESULT_LIMIT)).then_some((m as i32, p as i32))
    }

    fn layer(&self, bits: u16, starts: &[Start], constants: Vec<Vec<(i32, i32)>>) -> IntLayer {
        let start = starts.iter().map(|start| start.value as i32).collect();
        IntLayer { rows: self.count, cols: self.cols, bits, weights: self.weights.clone(), start, constants }
    }

    /// Multiplier of an unused row is 0.
    fn unit(&self, row: usize, x_scale: f64) -> f64 {
        let used = self.weights[row * self.cols..(row + 1) * self.cols].iter().any(|&w| w != 0);
        if used { self.step[row] * x_scale } else { 0.0 }
    }
}

/// Scale and shift before the ReLU, per latent and row.
type Modulation = (Vec<Vec<f64>>, Vec<Vec<f64>>);

/// A ReLU layer with outputs of `bits` bits; `wanted` is the step of its outputs, made larger where a multiplier would
/// not fit. Returns the step used.
pub(crate) fn finish_hidden(
    rows: &Rows,
    x_scale: f64,
    wanted: f64,
    range: Range,
    bits: u16,
    modulation: Option<&Modulation>,
) -> Option<(IntLayer, f64)> {
    let starts: Vec<Start> = (0..rows.count).map(|row| rows.start(row, x_scale, range)).collect();
    let none = (vec![vec![1.0; rows.count]], vec![vec![0.0; rows.count]]);
    let (scale, shift) = modulation.unwrap_or(&none);
    let fraction = f64::from(1u32 << HIDDEN_SHIFT);
    let mut step = wanted;
    for _ in 0..200 {
        let per = fraction / step;
        let constants: Option<Vec<Vec<(i32, i32)>>> = scale
            .iter()
            .zip(shift)
            .map(|(scale, shift)| {
                (0..rows.count)
                    .map(|row| {
                        let offset = (scale[row] * starts[row].rest + shift[row]) * per;
                        let unit = scale[row] * rows.unit(row, x_scale) * per;
                        Rows::constants(row, &starts[row], unit, offset, fraction / 2.0)
                    })
                    .collect()
            })
            .collect();
        if let Some(constants) = constants {
            return Some((rows.layer(bits, &starts, constants), step));
        }
        step *= 2.0;
    }
    None
}

/// A linear layer of logits in one scale: log2 units with as many fraction bits as fit, or for a Q-network the finest
/// scale that fits. Returns fraction bits and scale.
pub(crate) fn finish_logits(rows: &Rows, x_scale: f64, range: Range, log2: bool) -> Option<(IntLayer, u16, f64)> {
    let starts: Vec<Start> = (0..rows.count).map(|row| rows.start(row, x_scale, range)).collect();
    let try_step = |step: f64| -> Option<IntLayer> {
        let constants: Option<Vec<(i32, i32)>> = (0..rows.count)
            .map(|row| {
                let unit = rows.unit(row, x_scale) / step;
                Rows::constants(row, &starts[row], unit, starts[row].rest / step, 0.0)
            })
            .collect();
        Some(rows.layer(32, &starts, vec![constants?]))
    };
    if log2 {
        return (0..=crate::load_net::MAX_FRAC_BITS).rev().find_map(|frac_bits| {
            let step = std::f64::consts::LN_2 / f64::from(1u32 << frac_bits);
            try_step(step).map(|layer| (layer, frac_bits, step))
        });
    }
    // From far below the finest scale that could fit, in powers of two.
    let largest = (0..rows.count).map(|row| rows.unit(row, x_scale)).fold(1e-30, f64::max);
    (-20..200).find_map(|exponent| {
        let step = largest * f64::from(exponent).exp2();
        try_step(step).map(|layer| (layer, 0, step))
    })
}
