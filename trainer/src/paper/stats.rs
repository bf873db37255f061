//! What a table says about a handful of runs: mean, standard deviation, and the interquartile mean with a bootstrap interval
//! (Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice", sections 4.1 and 4.3).

use rand::RngExt as _;
use serde::Serialize;

use crate::seed::{Rng, SeedTree};

/// Resamples behind an interval.
pub const REPLICATES: usize = 2_000;
/// Share of the bootstrap distribution that an interval covers.
pub const COVERAGE: f64 = 0.95;
/// Seed of the resampling: the same values give the same interval, always.
const SEED: u64 = 0;

/// Both ends of an interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// What a table says about some runs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Runs.
    pub n: usize,
    /// Mean.
    pub mean: f64,
    /// Sample standard deviation (divisor n - 1); none for a single run.
    pub sd: Option<f64>,
    /// Interquartile mean.
    pub iqm: f64,
    /// Its bootstrap interval; none where no stratum has two runs.
    pub iqm_interval: Option<Interval>,
}

impl Summary {
    /// Of the runs in `strata`: one list of values for each task. `None` without any value.
    pub fn of(strata: &[Vec<f64>]) -> Option<Self> {
        let all: Vec<f64> = strata.concat();
        Some(Self {
            n: all.len(),
            mean: mean(&all)?,
            sd: sample_sd(&all),
            iqm: interquartile_mean(&all)?,
            iqm_interval: stratified_bootstrap(strata, |v| interquartile_mean(v).unwrap_or(f64::NAN)),
        })
    }
}

/// Mean; `None` of nothing.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Sample standard deviation; `None` below two values.
pub fn sample_sd(values: &[f64]) -> Option<f64> {
    let mean = mean(values).filter(|_| values.len() > 1)?;
    Some((values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (values.len() - 1) as f64).sqrt())
}

/// Mean of what is left when a quarter of the values, rounded down, is cut off at either end; `None` of nothing. Below four
/// values that is the mean.
// Source: Agarwal et al. 2021, section 4.3: the 25 % trimmed mean.
pub fn interquartile_mean(values: &[f64]) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let cut = sorted.len() / 4;
    mean(&sorted[cut..sorted.len() - cut])
}

/// Percentile bootstrap of `statistic` of all values: every replicate draws, with replacement, as many values from each stratum
/// as that has, so that no task gets more or fewer runs than it had. `None` where no stratum has two values, for then there is
/// nothing to draw from.
// Source: Agarwal et al. 2021, section 4.1: stratified bootstrap over runs, percentile method.
pub fn stratified_bootstrap(strata: &[Vec<f64>], statistic: impl Fn(&[f64]) -> f64) -> Option<Interval> {
    if strata.iter().all(|s| s.len() < 2) {
        return None;
    }
    let mut rng: Rng = SeedTree::new(SEED).stream("paper.bootstrap");
    let mut drawn = Vec::new();
    let mut found: Vec<f64> = (0..REPLICATES)
        .map(|_| {
            drawn.clear();
            for stratum in strata.iter().filter(|s| !s.is_empty()) {
                drawn.extend((0..stratum.len()).map(|_| stratum[rng.random_range(0..stratum.len())]));
            }
            statistic(&drawn)
        })
        .collect();
    found.sort_by(f64::total_cmp);
    let tail = (1.0 - COVERAGE) / 2.0;
    Some(Interval { low: quantile(&found, tail), high: quantile(&found, 1.0 - tail) })
}

/// Quantile of sorted values, linear between neighbours; at least one value.
fn quantile(sorted: &[f64], q: f64) -> f64 {
    let at = q * (sorted.len() - 1) as f64;
    let (below, above) = (sorted[at.floor() as usize], sorted[at.ceil() as usize]);
    below + (above - below) * at.fract()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interquartile_mean_cuts_a_quarter_at_either_end_rounded_down() {
        assert_eq!(interquartile_mean(&[]), None);
        assert_eq!(interquartile_mean(&[7.0]), Some(7.0));
        assert_eq!(interquartile_mean(&[1.0, 2.0, 9.0]), Some(4.0), "too few to cut");
        assert_eq!(interquartile_mean(&[100.0, 1.0, 3.0, -50.0]), Some(2.0));
        assert_eq!(interquartile_mean(&[0.0, 5.0, 6.0, 7.0, 1000.0]), Some(6.0), "one of five at either end");
        assert_eq!(interquartile_mean(&[0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 9.0, 9.0]), Some(2.5));
    }

    #[test]
    fn mean_and_sample_deviation_are_the_textbook_ones() {
        let summary = Summary::of(&[vec![2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0]]).unwrap();
        assert_eq!((summary.n, summary.mean), (8, 5.0));
        assert!((summary.sd.unwrap() - (32.0f64 / 7.0).sqrt()).abs() < 1e-12);
        assert_eq!(summary.iqm, 4.5);
        assert_eq!(Summary::of(&[vec![], vec![]]), None);
    }

    #[test]
    fn quantiles_lie_between_neighbours() {
        assert_eq!(quantile(&[1.0], 0.3), 1.0);
        assert_eq!(quantile(&[0.0, 10.0], 0.25), 2.5);
        assert_eq!(quantile(&[0.0, 1.0, 2.0, 3.0, 4.0], 0.5), 2.0);
    }

    #[test]
    fn a_single_run_has_no_interval_and_equal_runs_an_empty_one() {
        let single = Summary::of(&[vec![3.0]]).unwrap();
        assert_eq!((single.sd, single.iqm_interval), (None, None));
        let equal = Summary::of(&[vec![3.0; 5]]).unwrap();
        assert_eq!(equal.iqm_interval, Some(Interval { low: 3.0, high: 3.0 }));
    }

    /// Two values: the mean of two draws is 0, 0.5 or 1 with probabilities 1/4, 1/2, 1/4, so that both 2.5 % tails lie in the
    /// outer atoms.
    #[test]
    fn the_interval_of_two_values_spans_them() {
        let interval = stratified_bootstrap(&[vec![0.0, 1.0]], |v| mean(v).unwrap()).unwrap();
        assert_eq!(interval, Interval { low: 0.0, high: 1.0 });
    }

    /// The sum of 100 draws of {0, 1} has mean 50 and standard deviation 5: the interval of their mean is 0.5 ± 1.96 · 0.05.
    #[test]
    fn the_interval_of_many_values_is_the_normal_one() {
        let values: Vec<f64> = (0..100).map(|i| f64::from(i % 2)).collect();
        let Interval { low, high } = stratified_bootstrap(&[values], |v| mean(v).unwrap()).unwrap();
        assert!((low - 0.402).abs() < 0.02 && (high - 0.598).abs() < 0.02, "{low} {high}");
    }

    /// Strata far apart, each of equal values: stratified draws keep the share of each, so that nothing varies. Drawn from all
    /// values alike, the mean would.
    #[test]
    fn strata_keep_their_shares() {
        let strata = [vec![0.0; 3], vec![90.0; 6]];
        let interval = stratified_bootstrap(&strata, |v| mean(v).unwrap()).unwrap();
        assert_eq!(interval, Interval { low: 60.0, high: 60.0 });
        let mixed = stratified_bootstrap(&[strata.concat()], |v| mean(v).unwrap()).unwrap();
        assert!(mixed.high - mixed.low > 20.0, "{mixed:?}");
    }

    #[test]
    fn the_same_values_give_the_same_interval() {
        let strata = [vec![1.0, 5.0, 2.0, 8.0], vec![0.5, 0.25, 7.0]];
        assert_eq!(Summary::of(&strata), Summary::of(&strata));
    }
}
