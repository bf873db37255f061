//! Ranges of inputs and activations over the calibration set.

use super::model::{Dense, FloatModel};
use std::vec;
use std::vec::Vec;

/// Activations of one layer over the calibration set.
#[derive(Clone, Debug, Default)]
pub(crate) struct Samples {
    width: usize,
    values: Vec<f32>,
}

impl Samples {
    pub(crate) fn new(width: usize, rows: &[Vec<f32>]) -> Self {
        Self { width, values: rows.concat() }
    }

    /// Mean per column.
    pub(crate) fn mean(&self) -> Vec<f64> {
        let mut sums = vec![0.0; self.width];
        for row in self.values.chunks_exact(self.width.max(1)) {
            for (sum, x) in sums.iter_mut().zip(row) {
                *sum += f64::from(*x);
            }
        }
        let count = (self.values.len() / self.width.max(1)).max(1) as f64;
        sums.iter().map(|sum| sum / count).collect()
    }

    /// The value that the largest of `levels` integers should stand for: the share of the largest activation with the
    /// least squared error of rounding and clamping together.
    pub(crate) fn best_top(&self, levels: f64) -> f64 {
        let max = self.values.iter().copied().fold(0.0, f32::max);
        if max <= 0.0 {
            return 1.0;
        }
        let stride = self.values.len().div_ceil(200_000);
        let error = |top: f64| -> f64 {
            let step = top / levels;
            let values = self.values.iter().step_by(stride).map(|&x| f64::from(x));
            values.map(|x| ((x / step).round().min(levels) * step - x).powi(2)).sum()
        };
        let candidates = (3..=10).rev().map(|tenths| f64::from(max) * f64::from(tenths) / 10.0);
        candidates
            .map(|top| (error(top), top))
            .fold((f64::INFINITY, 1.0), |best, next| if next.0 < best.0 { next } else { best })
            .1
    }

    /// Share of the values above `top`.
    pub(crate) fn share_above(&self, top: f64) -> f64 {
        let above = self.values.iter().filter(|&&x| f64::from(x) > top * (1.0 + 1e-9)).count();
        above as f64 / self.values.len().max(1) as f64
    }
}

/// Centre and half width of each input in normalised units: the calibrated range with its margin, then widened up to
/// four times where the input weighs little, so that the columns of the first layers use their int8 range alike.
pub(crate) fn input_ranges(model: &FloatModel, firsts: &[&Dense], calibration: &[f32], margin: f32) -> Vec<(f64, f64)> {
    const SMALLEST: f64 = 0.1;
    const WIDEST: f64 = 4.0;
    let dim = model.obs_mean.len();
    let mut ranges: Vec<(f64, f64)> = (0..dim)
        .map(|j| {
            let column = calibration.iter().skip(j).step_by(dim);
            let lo = f64::from(column.clone().copied().fold(f32::INFINITY, f32::min));
            let hi = f64::from(column.copied().fold(f32::NEG_INFINITY, f32::max));
            let (mean, std) = (f64::from(model.obs_mean[j]), f64::from(model.obs_std[j]));
            let half = (hi - lo) / 2.0 * (1.0 + 2.0 * f64::from(margin)) / std;
            ((f64::midpoint(lo, hi) - mean) / std, half.max(SMALLEST))
        })
        .collect();
    let weight = |j: usize| {
        let columns = firsts.iter().flat_map(|layer| layer.weight.iter().skip(j).step_by(layer.cols));
        columns.map(|w| f64::from(w.abs())).fold(0.0, f64::max)
    };
    let reach: Vec<f64> = ranges.iter().enumerate().map(|(j, (_, half))| weight(j) * half).collect();
    let largest = reach.iter().copied().fold(0.0, f64::max);
    for ((_, half), reach) in ranges.iter_mut().zip(reach) {
        *half *= if reach > 0.0 { (largest / reach).clamp(1.0, WIDEST) } else { WIDEST };
    }
    ranges
}
