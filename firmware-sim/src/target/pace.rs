//! Real time: when a control period begins by the wall, and how well that was kept. Measures, and never judges.

use std::time::{Duration, Instant};

use serde::Serialize;

/// Where the samples of a long run would need too much memory, later ones are only counted.
const SAMPLES: usize = 1 << 20;

/// Control periods by the wall.
#[derive(Debug)]
pub struct Pace {
    factor: f64,
    period_us: u64,
    zero: Instant,
    /// When the current period should begin and did, microseconds of wall time.
    due_us: f64,
    begun_us: f64,
    periods: u64,
    overruns: u64,
    unanswered: u64,
    latency_us: Vec<f32>,
    jitter_us: Vec<f32>,
}

/// How well real time was kept.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Timing {
    /// Virtual seconds in one second.
    pub factor: f64,
    /// Control periods.
    pub periods: u64,
    /// Periods that began more than one period late; the clock was then set back.
    pub overruns: u64,
    /// Periods without an answer before the next one.
    pub unanswered: u64,
    /// From the first frame of an observation set to the last of its answer, microseconds of wall time.
    pub latency_us: Quantiles,
    /// How much later than due a period began, microseconds of wall time.
    pub jitter_us: Quantiles,
    /// Time that the answers took, per cent of the period.
    pub load_percent: f64,
}

/// Distribution of a measured time.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Quantiles {
    /// Smallest.
    pub min: f64,
    /// Half are not above it.
    pub p50: f64,
    /// 90 per cent.
    pub p90: f64,
    /// 99 per cent.
    pub p99: f64,
    /// Largest.
    pub max: f64,
    /// Mean.
    pub mean: f64,
    /// Number of samples.
    pub n: usize,
    /// Equal columns from the smallest sample to the 99 % quantile, and one for the rest.
    pub histogram: Vec<Bin>,
}

/// One column of a histogram: the samples above `from` up to `to`; in the first column also `from` itself.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Bin {
    /// Lower end.
    pub from: f64,
    /// Upper end.
    pub to: f64,
    /// Samples.
    pub count: usize,
}

/// Equal columns of a histogram.
const BINS: usize = 24;

/// The histogram of samples in rising order, the equal columns up to `p99`.
fn histogram(sorted: &[f32], p99: f64) -> Vec<Bin> {
    let (Some(&min), Some(&max)) = (sorted.first(), sorted.last()) else { return Vec::new() };
    let (min, max) = (f64::from(min), f64::from(max));
    let width = (p99 - min) / BINS as f64;
    let edges = (1..BINS).map(|i| min + width * i as f64).filter(|_| width > 0.0).chain([p99, max]);
    let (mut bins, mut from, mut done) = (Vec::new(), min, 0);
    for to in edges {
        let up_to = sorted.partition_point(|&x| f64::from(x) <= to);
        if up_to > done || to < p99 {
            bins.push(Bin { from, to, count: up_to - done });
        }
        (from, done) = (to, up_to);
    }
    bins
}

impl Quantiles {
    /// Of samples in any order; all zero without samples.
    #[must_use]
    pub fn of(samples: &[f32]) -> Self {
        let mut sorted = samples.to_vec();
        sorted.sort_by(f32::total_cmp);
        let n = sorted.len();
        let (Some(&min), Some(&max)) = (sorted.first(), sorted.last()) else { return Self::default() };
        let at = |q: f64| f64::from(sorted[((q * n as f64).ceil() as usize).clamp(1, n) - 1]);
        let mean = sorted.iter().map(|&x| f64::from(x)).sum::<f64>() / n as f64;
        let histogram = histogram(&sorted, at(0.99));
        Self { min: f64::from(min), p50: at(0.5), p90: at(0.9), p99: at(0.99), max: f64::from(max), mean, n, histogram }
    }
}

impl Pace {
    /// `factor` virtual seconds in each second, periods of `period_us` virtual microseconds. Time begins now.
    #[must_use]
    pub fn new(factor: f64, period_us: u32) -> Self {
        Self {
            factor,
            period_us: u64::from(period_us),
            zero: now(),
            due_us: 0.0,
            begun_us: 0.0,
            periods: 0,
            overruns: 0,
            unanswered: 0,
            latency_us: Vec::new(),
            jitter_us: Vec::new(),
        }
    }

    fn wall_us(&self) -> f64 {
        now().duration_since(self.zero).as_secs_f64() * 1e6
    }

    fn period_wall_us(&self) -> f64 {
        self.period_us as f64 / self.factor
    }

    /// Virtual time by the wall, microseconds.
    #[must_use]
    pub fn now_us(&self) -> u64 {
        (self.wall_us() * self.factor) as u64
    }

    /// Waits for the time at which the period that starts at `now_us` of virtual time is due.
    pub fn begin(&mut self, now_us: u64) {
        let wanted = now_us as f64 / self.factor;
        let wall = self.wall_us();
        if wall - wanted > self.period_wall_us() {
            // Too late to catch up: go on from here.
            self.overruns += u64::from(self.periods > 0);
            if let Some(zero) = self.zero.checked_add(Duration::from_secs_f64((wall - wanted) / 1e6)) {
                self.zero = zero;
            }
        } else if wanted > wall {
            std::thread::sleep(Duration::from_secs_f64((wanted - wall) / 1e6));
        }
        self.due_us = wanted;
        self.begun_us = self.wall_us();
        self.periods += 1;
        push(&mut self.jitter_us, self.begun_us - wanted);
    }

    /// When the period ends.
    #[must_use]
    pub fn end(&self) -> Instant {
        self.zero + Duration::from_secs_f64((self.due_us + self.period_wall_us()) / 1e6)
    }

    /// The answer of the period is there, or did not come.
    pub fn answered(&mut self, came: bool) {
        if came {
            let latency = self.wall_us() - self.begun_us;
            push(&mut self.latency_us, latency);
        } else {
            self.unanswered += 1;
        }
    }

    /// What was measured.
    #[must_use]
    pub fn timing(&self) -> Timing {
        let latency_us = Quantiles::of(&self.latency_us);
        Timing {
            factor: self.factor,
            periods: self.periods,
            overruns: self.overruns,
            unanswered: self.unanswered,
            load_percent: latency_us.mean / self.period_wall_us() * 100.0,
            latency_us,
            jitter_us: Quantiles::of(&self.jitter_us),
        }
    }
}

fn push(samples: &mut Vec<f32>, value: f64) {
    if samples.len() < SAMPLES {
        samples.push(value as f32);
    }
}

#[expect(clippy::disallowed_methods, reason = "real time is what this measures")]
fn now() -> Instant {
    Instant::now()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_known_samples() {
        let samples: Vec<f32> = (1..=100).rev().map(|x| x as f32).collect();
        let q = Quantiles::of(&samples);
        assert_eq!((q.min, q.p50, q.p90, q.p99, q.max, q.mean, q.n), (1.0, 50.0, 90.0, 99.0, 100.0, 50.5, 100));
        assert_eq!(Quantiles::of(&[]), Quantiles::default());
        assert_eq!(Quantiles::of(&[3.0]).p99, 3.0);
        assert_eq!(Quantiles::of(&[3.0, 3.0]).histogram, [Bin { from: 3.0, to: 3.0, count: 2 }]);
        assert_eq!(q.histogram.iter().map(|bin| bin.count).sum::<usize>(), q.n);
        assert!(q.histogram.windows(2).all(|pair| pair[0].to == pair[1].from && pair[0].from < pair[0].to));
        let last = q.histogram.last().unwrap();
        assert_eq!((last.from, last.to, q.histogram.len()), (q.p99, q.max, BINS + 1));
    }

    #[test]
    fn periods_never_begin_early_and_a_late_one_sets_the_clock_back() {
        let mut pace = Pace::new(100.0, 50_000); // half a millisecond by the wall
        for i in 0..20 {
            pace.begin(i * 50_000);
            assert!(pace.end() + Duration::from_mins(1) > now());
            pace.answered(i % 2 == 0);
        }
        pace.zero -= Duration::from_secs(1);
        pace.begin(20 * 50_000);
        let t = pace.timing();
        assert_eq!((t.periods, t.unanswered, t.latency_us.n), (21, 10, 10));
        assert!(t.overruns >= 1 && t.jitter_us.min >= 0.0);
    }
}
