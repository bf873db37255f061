//! Wall-clock and processor time since a moment.

use std::time::Instant;

/// A moment.
#[derive(Clone, Debug)]
pub struct Clock {
    wall: Instant,
    cpu: Option<f64>,
}

impl Clock {
    /// Now.
    #[expect(clippy::disallowed_methods, reason = "a benchmark measures time; nothing it computes depends on it")]
    pub fn start() -> Self {
        Self { cpu: cpu_s(), wall: Instant::now() }
    }

    /// Seconds of wall-clock time since then.
    pub fn wall_s(&self) -> f64 {
        self.wall.elapsed().as_secs_f64()
    }

    /// Seconds that this program's threads have run since then; `None` where the system does not tell.
    pub fn cpu_s(&self) -> Option<f64> {
        Some(cpu_s()? - self.cpu?)
    }
}

/// Time on a processor of all threads so far, from the Linux scheduler's statistics (nanoseconds, first field).
fn cpu_s() -> Option<f64> {
    let mut sum = 0.0;
    for task in std::fs::read_dir("/proc/self/task").ok()? {
        let text = std::fs::read_to_string(task.ok()?.path().join("schedstat")).ok()?;
        sum += text.split_whitespace().next()?.parse::<f64>().ok()? * 1e-9;
    }
    Some(sum)
}
