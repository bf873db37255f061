//! Centres of an expert's actions by k-means.

use std::path::PathBuf;

use rand::RngExt as _;

use super::config::DqnClusterConfig;
use crate::error::TrainError;
use crate::runner::checkpoint::load_pairs;
use crate::seed::{Rng, SeedTree};

/// What centres are looked for.
#[derive(Clone, Debug)]
pub struct Clusters {
    data: PathBuf,
    k: usize,
    iterations: usize,
    seeds: SeedTree,
}

impl Clusters {
    /// As the settings say.
    pub fn new(config: &DqnClusterConfig, seeds: SeedTree) -> Self {
        let data = config.data.clone().unwrap_or_default();
        Self { data, k: config.clusters, iterations: config.iterations, seeds }
    }

    /// The centres, `K x slots`.
    ///
    /// # Errors
    /// [`TrainError::Data`] for a file that does not fit, or with fewer different actions than centres.
    pub fn centres(&self, obs_dim: usize, slots: usize) -> Result<Vec<f32>, TrainError> {
        let mut actions = Vec::new();
        load_pairs(&self.data, obs_dim, slots, |_, action| {
            if let Some(value) = action.iter().find(|v| !(-1.0..=1.0).contains(*v)) {
                return Err(format!("`actions`: expected -1 to 1 (normalised), found {value}"));
            }
            actions.extend_from_slice(action);
            Ok(())
        })?;
        let rng = &mut self.seeds.stream("clusters");
        cluster(&actions, slots, self.k, self.iterations, rng).ok_or_else(|| TrainError::Data {
            path: self.data.clone(),
            reason: format!("expected at least {} different actions", self.k),
        })
    }
}

/// `k` centres of `points` (`N x width`) by Lloyd's algorithm from a k-means++ start (Arthur & Vassilvitskii 2007), at most
/// `iterations` rounds; `None` for fewer than `k` different points. The order of the centres is that in which they were drawn.
pub fn cluster(points: &[f32], width: usize, k: usize, iterations: usize, rng: &mut Rng) -> Option<Vec<f32>> {
    let n = points.len() / width;
    let distance =
        |a: &[f32], b: &[f32]| -> f64 { a.iter().zip(b).map(|(x, y)| f64::from(x - y) * f64::from(x - y)).sum() };
    let point = |i: usize| &points[i * width..(i + 1) * width];
    if n == 0 {
        return None;
    }
    let mut centres = point(rng.random_range(0..n)).to_vec();
    let mut nearest: Vec<f64> = (0..n).map(|i| distance(point(i), &centres)).collect();
    while centres.len() < k * width {
        let total: f64 = nearest.iter().sum();
        if total <= 0.0 {
            return None;
        }
        let mut left = rng.random_range(0.0..total);
        let drawn = nearest.iter().position(|d| {
            left -= d;
            left < 0.0
        });
        // Rounding may leave a remainder behind the last point; the farthest one then is as good.
        let far = |a: &usize, b: &usize| nearest[*a].total_cmp(&nearest[*b]);
        let drawn = drawn.or_else(|| (0..n).max_by(far))?;
        let centre = point(drawn).to_vec();
        for (i, d) in nearest.iter_mut().enumerate() {
            *d = d.min(distance(point(i), &centre));
        }
        centres.extend(centre);
    }
    let closest = |centres: &[f32], p: &[f32]| {
        let distances = centres.chunks_exact(width).map(|c| distance(c, p));
        distances.enumerate().min_by(|a, b| a.1.total_cmp(&b.1)).map_or(0, |(i, _)| i)
    };
    for _ in 0..iterations {
        let (mut sums, mut counts) = (vec![0.0_f64; k * width], vec![0_u64; k]);
        for p in points.chunks_exact(width) {
            let c = closest(&centres, p);
            counts[c] += 1;
            sums[c * width..][..width].iter_mut().zip(p).for_each(|(s, p)| *s += f64::from(*p));
        }
        let before = centres.clone();
        for (c, &n) in counts.iter().enumerate().filter(|(_, n)| **n > 0) {
            let centre = centres[c * width..][..width].iter_mut().zip(&sums[c * width..][..width]);
            centre.for_each(|(to, sum)| *to = (sum / n as f64) as f32);
        }
        if centres == before {
            break;
        }
    }
    Some(centres)
}
