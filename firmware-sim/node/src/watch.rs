//! Sliding counts: the share of wrong frames, and how often the controller was restarted.

use heapless::Deque;

use crate::safety::{BUS_OFF_LIMIT, BUS_OFF_WINDOW_US, CRC_LIMIT_FRAMES, CRC_LIMIT_PERCENT, CRC_WINDOW_US};

const BUCKETS: usize = 10;

/// Good and wrong frames of the last window, in ten buckets.
#[derive(Clone, Debug)]
pub(crate) struct CrcWatch {
    bucket_us: u64,
    current: u64,
    buckets: Deque<(u32, u32), BUCKETS>,
}

impl CrcWatch {
    pub(crate) fn new(period_us: u32) -> Self {
        let window = CRC_WINDOW_US.max(10 * u64::from(period_us));
        Self { bucket_us: window / BUCKETS as u64, current: 0, buckets: Deque::new() }
    }

    /// Counts one frame.
    pub(crate) fn count(&mut self, now_us: u64, good: bool) {
        let bucket = now_us / self.bucket_us.max(1);
        let new = bucket.saturating_sub(self.current).min(BUCKETS as u64);
        for _ in 0..if self.buckets.is_empty() { new.max(1) } else { new } {
            if self.buckets.is_full() {
                self.buckets.pop_front();
            }
            let _full = self.buckets.push_back((0, 0));
        }
        self.current = self.current.max(bucket);
        if let Some((frames, wrong)) = self.buckets.back_mut() {
            *frames = frames.saturating_add(1);
            *wrong = wrong.saturating_add(u32::from(!good));
        }
    }

    /// True where the share of wrong frames is above the limit.
    pub(crate) fn too_many(&self) -> bool {
        let (frames, wrong) =
            self.buckets.iter().fold((0_u64, 0_u64), |(f, w), b| (f + u64::from(b.0), w + u64::from(b.1)));
        wrong >= u64::from(CRC_LIMIT_FRAMES) && wrong * 100 > frames * u64::from(CRC_LIMIT_PERCENT)
    }

    /// Starts again, so that old errors do not end a new run.
    pub(crate) fn clear(&mut self) {
        self.buckets.clear();
    }
}

/// Restarts of the controller within the last minute.
#[derive(Clone, Debug, Default)]
pub(crate) struct Restarts {
    times_us: Deque<u64, BUS_OFF_LIMIT>,
}

impl Restarts {
    /// True, and counted, where one more restart is allowed at `now_us`.
    pub(crate) fn allow(&mut self, now_us: u64) -> bool {
        while self.times_us.front().is_some_and(|&t| now_us.saturating_sub(t) >= BUS_OFF_WINDOW_US) {
            self.times_us.pop_front();
        }
        self.times_us.push_back(now_us).is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_than_ten_percent_and_at_least_three() {
        let mut w = CrcWatch::new(8000);
        w.count(0, false);
        w.count(0, false);
        assert!(!w.too_many(), "two frames are not enough");
        for i in 0..28 {
            w.count(i * 8000, true);
        }
        w.count(240_000, false);
        assert!(!w.too_many(), "3 of 31 is under 10 %");
        w.count(240_000, false);
        assert!(w.too_many(), "4 of 32");
        w.count(1_050_000, true);
        assert!(!w.too_many(), "the first ones have left the window");
    }

    #[test]
    fn three_restarts_a_minute() {
        let mut r = Restarts::default();
        assert!(r.allow(0) && r.allow(1) && r.allow(2));
        assert!(!r.allow(59_999_999));
        assert!(r.allow(60_000_000));
        assert!(!r.allow(60_000_000));
    }
}
