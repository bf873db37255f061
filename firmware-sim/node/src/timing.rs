//! Jitter and bias of the control period, measured at the ticks.
//!
//! Limits as in the executor of RLtools: 20 % of the period. A policy was trained for one period; a plant that ticks
//! faster, slower or unevenly is another plant, so this is reported and never silent.

/// Periods in one window.
const WINDOW: u32 = 64;
/// Limit of jitter and bias, per mille of the period.
pub const LIMIT_PERMILLE: u32 = 200;

/// What the monitor found in the last full window and in the one under way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PeriodReport {
    /// Largest deviation of one period from the agreed one, per mille.
    pub jitter_permille: u16,
    /// Mean deviation, per mille, positive where the plant is slow.
    pub bias_permille: i16,
}

/// Collects time between ticks.
#[derive(Clone, Debug)]
pub struct PeriodMonitor {
    period_us: u64,
    count: u32,
    sum_us: i64,
    max_us: u64,
    last: PeriodReport,
    jitter: bool,
    bias: bool,
}

impl PeriodMonitor {
    /// A monitor for an agreed period of `period_us` microseconds.
    #[must_use]
    pub fn new(period_us: u32) -> Self {
        Self {
            period_us: u64::from(period_us.max(1)),
            count: 0,
            sum_us: 0,
            max_us: 0,
            last: PeriodReport::default(),
            jitter: false,
            bias: false,
        }
    }

    /// Takes the time that `ticks` periods (at least 1) took together.
    pub fn observe(&mut self, elapsed_us: u64, ticks: u32) {
        let one = elapsed_us / u64::from(ticks.max(1));
        let deviation = one.abs_diff(self.period_us).min(u64::from(u32::MAX));
        let signed = i64::try_from(deviation).unwrap_or(i64::MAX);
        self.max_us = self.max_us.max(deviation);
        self.sum_us = self.sum_us.saturating_add(if one < self.period_us { -signed } else { signed });
        self.count += 1;
        self.jitter |= self.permille(self.max_us) > LIMIT_PERMILLE;
        if self.count >= WINDOW {
            let mean = self.sum_us / i64::from(WINDOW);
            let bias = self.permille(mean.unsigned_abs());
            self.jitter = self.permille(self.max_us) > LIMIT_PERMILLE;
            self.bias = bias > LIMIT_PERMILLE;
            let bias = i16::try_from(bias).unwrap_or(i16::MAX);
            self.last = PeriodReport {
                jitter_permille: u16::try_from(self.permille(self.max_us)).unwrap_or(u16::MAX),
                bias_permille: if mean < 0 { -bias } else { bias },
            };
            (self.count, self.sum_us, self.max_us) = (0, 0, 0);
        }
    }

    fn permille(&self, us: u64) -> u32 {
        u32::try_from(us.saturating_mul(1000) / self.period_us.max(1)).unwrap_or(u32::MAX)
    }

    /// One period was off by more than the limit: at once, and until a window of 64 periods without one.
    #[must_use]
    pub fn jitter(&self) -> bool {
        self.jitter
    }

    /// The mean of the last 64 periods is off by more than the limit.
    #[must_use]
    pub fn bias(&self) -> bool {
        self.bias
    }

    /// Numbers of the last full window.
    #[must_use]
    pub fn report(&self) -> PeriodReport {
        self.last
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exact_periods_raise_nothing() {
        let mut m = PeriodMonitor::new(8000);
        for _ in 0..200 {
            m.observe(8000, 1);
        }
        m.observe(24_000, 3);
        assert!(!m.jitter() && !m.bias());
        assert_eq!(m.report(), PeriodReport::default());
    }

    #[test]
    fn one_period_beyond_20_percent_is_jitter_until_a_clean_window() {
        let mut m = PeriodMonitor::new(1000);
        m.observe(1200, 1);
        assert!(!m.jitter(), "20 % exactly is allowed");
        m.observe(1201, 1);
        assert!(m.jitter());
        for _ in 0..62 {
            m.observe(1000, 1);
        }
        assert!(m.jitter() && !m.bias());
        assert_eq!(m.report().jitter_permille, 201);
        for _ in 0..64 {
            m.observe(1000, 1);
        }
        assert!(!m.jitter());
    }

    #[test]
    fn a_fast_plant_has_negative_bias() {
        let mut m = PeriodMonitor::new(1000);
        for _ in 0..64 {
            m.observe(700, 1);
        }
        assert!(m.bias());
        assert_eq!(m.report(), PeriodReport { jitter_permille: 300, bias_permille: -300 });
    }
}
