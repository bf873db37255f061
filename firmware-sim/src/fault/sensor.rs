//! Faults of the plant's sensors: what is sent is not what is.

use std::collections::VecDeque;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::spec::{Check, one};

/// What happens to the chosen signals. Sizes are fractions of the signal's declared range.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum SensorFault {
    /// Stays at the value it had at the start of the window.
    Freeze {},
    /// Dead: reads as invalid.
    Nan {
        /// Probability per tick.
        #[serde(default = "one")]
        p: f64,
    },
    /// Any value of the range.
    Garbage {
        /// Probability per tick.
        #[serde(default = "one")]
        p: f64,
    },
    /// A constant is added.
    Offset {
        /// Fraction of the range.
        amount: f64,
    },
    /// A growing offset.
    Drift {
        /// Fraction of the range per tick.
        rate: f64,
    },
    /// Gaussian noise is added.
    Noise {
        /// Standard deviation, fraction of the range.
        sd: f64,
    },
    /// Reads what was some ticks ago.
    Delay {
        /// Ticks.
        ticks: u32,
    },
    /// Dead by turns.
    Intermittent {
        /// Probability per tick that it dies.
        enter: f64,
        /// Probability per tick that it comes back.
        exit: f64,
    },
    /// Cut to the middle of the range.
    Saturate {
        /// Part of the range that is left.
        level: f64,
    },
}

impl SensorFault {
    pub(super) fn check(&self, check: &mut Check) {
        match *self {
            Self::Freeze {} => {}
            Self::Nan { p } | Self::Garbage { p } => check.probability("p", p),
            Self::Offset { amount } => check.range("amount", amount, -10.0, 10.0),
            Self::Drift { rate } => check.range("rate", rate, -1.0, 1.0),
            Self::Noise { sd } => check.range("sd", sd, 0.0, 10.0),
            Self::Delay { ticks } => check.count("ticks", ticks, 1, 1000),
            Self::Intermittent { enter, exit } => {
                check.probability("enter", enter);
                check.probability("exit", exit);
            }
            Self::Saturate { level } => check.range("level", level, 0.0, 1.0),
        }
    }
}

/// What a sensor fault remembers of one signal.
#[derive(Debug, Default)]
pub(super) struct SensorState {
    frozen: Option<f32>,
    ticks: u64,
    past: VecDeque<f32>,
    dead: bool,
}

impl SensorState {
    /// What the sensor tells instead of `value`, of a signal with range `lo..hi`; `None` where it tells the truth. Call
    /// it in every tick, also outside of the window (`active` false), so that it knows the past.
    pub(super) fn read(
        &mut self,
        fault: &SensorFault,
        value: f32,
        (lo, hi): (f32, f32),
        active: bool,
        rng: &mut ChaCha8Rng,
    ) -> Option<f32> {
        let range = f64::from(hi) - f64::from(lo);
        let mut hit = |p: f64| rng.random::<f64>() < p;
        if let SensorFault::Delay { ticks } = *fault {
            self.past.push_back(value);
            let old = if self.past.len() > ticks as usize { self.past.pop_front() } else { self.past.front().copied() };
            return old.filter(|_| active);
        }
        if !active {
            *self = Self::default();
            return None;
        }
        self.ticks += 1;
        match *fault {
            SensorFault::Freeze {} => Some(*self.frozen.get_or_insert(value)),
            SensorFault::Nan { p } => hit(p).then_some(f32::NAN),
            SensorFault::Garbage { p } => {
                let (hit, at) = (hit(p), rng.random::<f64>());
                hit.then_some((f64::from(lo) + at * range) as f32)
            }
            SensorFault::Offset { amount } => Some((f64::from(value) + amount * range) as f32),
            SensorFault::Drift { rate } => Some((f64::from(value) + rate * self.ticks as f64 * range) as f32),
            SensorFault::Noise { sd } => Some((f64::from(value) + sd * range * gaussian(rng)) as f32),
            SensorFault::Intermittent { enter, exit } => {
                self.dead = if self.dead { !hit(exit) } else { hit(enter) };
                self.dead.then_some(f32::NAN)
            }
            SensorFault::Saturate { level } => {
                let (middle, half) = (f64::midpoint(f64::from(lo), f64::from(hi)), level * range / 2.0);
                let cut = (f64::from(value)).clamp(middle - half, middle + half) as f32;
                (cut != value).then_some(cut)
            }
            SensorFault::Delay { .. } => None,
        }
    }
}

/// One standard normal number. Source: Box and Muller 1958.
fn gaussian(rng: &mut ChaCha8Rng) -> f64 {
    let (u, v) = (1.0 - rng.random::<f64>(), rng.random::<f64>());
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    fn run(fault: &SensorFault, values: &[f32], from: usize) -> Vec<Option<f32>> {
        let (mut state, mut rng) = (SensorState::default(), ChaCha8Rng::seed_from_u64(1));
        values.iter().enumerate().map(|(i, v)| state.read(fault, *v, (-1.0, 3.0), i >= from, &mut rng)).collect()
    }

    #[test]
    fn each_does_what_it_says() {
        let ramp = [0.0, 0.5, 1.0, 1.5];
        assert_eq!(run(&SensorFault::Freeze {}, &ramp, 1), [None, Some(0.5), Some(0.5), Some(0.5)]);
        assert_eq!(run(&SensorFault::Offset { amount: 0.25 }, &ramp, 2), [None, None, Some(2.0), Some(2.5)]);
        assert_eq!(run(&SensorFault::Drift { rate: 0.25 }, &ramp, 2), [None, None, Some(2.0), Some(3.5)]);
        assert_eq!(run(&SensorFault::Delay { ticks: 2 }, &ramp, 2), [None, None, Some(0.0), Some(0.5)]);
        assert_eq!(run(&SensorFault::Delay { ticks: 2 }, &ramp, 0)[..2], [Some(0.0), Some(0.0)]);
        assert_eq!(run(&SensorFault::Saturate { level: 0.125 }, &ramp, 0), [Some(0.75), Some(0.75), None, Some(1.25)]);
        assert!(run(&SensorFault::Nan { p: 1.0 }, &ramp, 0).iter().all(|v| v.unwrap().is_nan()));
        let garbage = run(&SensorFault::Garbage { p: 1.0 }, &[9.0; 50], 0);
        assert!(garbage.iter().all(|v| (-1.0..=3.0).contains(&v.unwrap())) && garbage[0] != garbage[1]);
        let dead = run(&SensorFault::Intermittent { enter: 0.2, exit: 0.5 }, &[0.0; 1000], 0);
        let n = dead.iter().flatten().count();
        assert!((200..400).contains(&n), "0.2 / 0.7 of the time, found {n}");
        let noisy = run(&SensorFault::Noise { sd: 0.1 }, &[1.0; 4000], 0);
        let sd = (noisy.iter().map(|v| f64::from(v.unwrap() - 1.0).powi(2)).sum::<f64>() / 4000.0).sqrt();
        assert!((sd - 0.4).abs() < 0.02, "{sd}");
    }
}
