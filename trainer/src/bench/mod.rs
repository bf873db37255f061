//! How fast this program's own parts are on this machine: `gadm bench`. The same work by other programs is in `tests/peers`,
//! which runs both in turn; `docs/src/performance.md` holds the comparison.

mod clock;
pub mod env;
pub mod replay;
pub mod train;

use serde::Serialize;

pub use clock::Clock;

/// Speed of one piece of work.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Timing {
    /// Name of the work.
    pub case: String,
    /// What it is, for people.
    pub what: String,
    /// What is counted.
    pub unit: &'static str,
    /// Threads that work on it.
    pub threads: usize,
    /// Units per second of wall-clock time, one number a chunk.
    pub rates: Vec<f64>,
    /// Units per second of processor time of all threads, one number a chunk; empty where the system does not tell. On a
    /// machine that others use too, this is the steadier number for one thread.
    pub cpu_rates: Vec<f64>,
    /// Floating-point operations of the matrix products per unit; 0 where that says nothing.
    pub flop: f64,
}

/// Middle value of `values`; 0 of none.
pub fn median(values: &[f64]) -> f64 {
    quantile(values, 0.5)
}

/// The value below which a share `q` (0..=1) of `values` lies (nearest rank); 0 of none.
pub fn quantile(values: &[f64], q: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let rank = (q * sorted.len().saturating_sub(1) as f64).round() as usize;
    sorted.get(rank).copied().unwrap_or(0.0)
}

impl Timing {
    /// Median rate.
    pub fn rate(&self) -> f64 {
        median(&self.rates)
    }

    /// Median of the matrix products' rate, 1e9 operations a second.
    pub fn gflops(&self) -> f64 {
        self.rate() * self.flop / 1e9
    }
}

/// What a piece of work is called.
#[derive(Clone, Debug)]
pub struct Label {
    /// As in [`Timing::case`].
    pub case: &'static str,
    /// As in [`Timing::what`].
    pub what: String,
    /// As in [`Timing::unit`].
    pub unit: &'static str,
    /// As in [`Timing::flop`].
    pub flop: f64,
}

/// Runs `work` in chunks of about a fiftieth of a second for `seconds`, after one tenth of that unmeasured. `work` does one
/// piece and returns how many units that were.
pub fn repeat(label: &Label, threads: usize, seconds: f64, mut work: impl FnMut() -> u64) -> Timing {
    let start = Clock::start();
    let mut pieces = 0_u32;
    while start.wall_s() < 0.1 * seconds || pieces == 0 {
        work();
        pieces += 1;
    }
    let per_chunk = (f64::from(pieces) * 0.02 / start.wall_s()).ceil().clamp(1.0, 1e6) as u32;
    let (mut rates, mut cpu_rates) = (Vec::new(), Vec::new());
    let all = Clock::start();
    while all.wall_s() < seconds || rates.is_empty() {
        let clock = Clock::start();
        let units: u64 = (0..per_chunk).map(|_| work()).sum();
        rates.push(units as f64 / clock.wall_s());
        if let Some(cpu) = clock.cpu_s().filter(|s| *s > 0.0) {
            cpu_rates.push(units as f64 / cpu);
        }
    }
    let Label { case, what, unit, flop } = label.clone();
    Timing { case: case.to_owned(), what, unit, threads, rates, cpu_rates, flop }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_are_units_over_time() {
        let label = Label { case: "sum", what: String::new(), unit: "sums", flop: 2e9 };
        let mut x = 1.0_f64;
        let timing = repeat(&label, 1, 0.05, || {
            (0..1000).for_each(|_| x = std::hint::black_box(x * 1.000_000_1));
            3
        });
        assert!(timing.rates.iter().all(|r| *r > 0.0 && r.is_finite()));
        assert!((timing.gflops() / (2.0 * timing.rate()) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn quantiles_are_ranks() {
        assert_eq!((quantile(&[], 0.5), median(&[3.0, 1.0, 2.0])), (0.0, 2.0));
        assert_eq!((quantile(&[3.0, 1.0, 2.0], 0.0), quantile(&[3.0, 1.0, 2.0], 1.0)), (1.0, 3.0));
    }
}
