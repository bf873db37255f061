//! Faults of the plant's actuators: what is done is not what was asked for.

use serde::{Deserialize, Serialize};

use super::spec::Check;

/// What happens to the chosen continuous actions. Sizes are fractions of half the range of the head.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum ActuatorFault {
    /// Stays where it is at the start of the window, or at a given place.
    Stuck {
        /// Place, -1 = lower end of the range, 1 = upper end.
        at: Option<f64>,
    },
    /// Follows as a first-order low pass.
    Lag {
        /// Time constant, ticks.
        ticks: f64,
    },
    /// Small commands have no effect.
    DeadZone {
        /// Half width around the middle of the range, fraction of half the range.
        width: f64,
    },
    /// Weaker (or stronger) than it should be.
    Gain {
        /// Factor.
        factor: f64,
    },
}

impl ActuatorFault {
    pub(super) fn check(&self, check: &mut Check) {
        match *self {
            Self::Stuck { at } => check.range("at", at.unwrap_or(0.0), -1.0, 1.0),
            Self::Lag { ticks } => check.range("ticks", ticks, 0.0, 1000.0),
            Self::DeadZone { width } => check.range("width", width, 0.0, 1.0),
            Self::Gain { factor } => check.range("factor", factor, -2.0, 2.0),
        }
    }
}

/// What an actuator fault remembers of one action.
#[derive(Debug, Default)]
pub(super) struct ActuatorState {
    /// What the actuator did last.
    done: Option<f32>,
    stuck: Option<f32>,
}

impl ActuatorState {
    /// What the actuator does instead of `asked`, with range `lo..hi`; `None` where it obeys. Call it in every tick.
    pub(super) fn act(&mut self, fault: &ActuatorFault, asked: f32, (lo, hi): (f32, f32), active: bool) -> Option<f32> {
        let (middle, half) = (f64::midpoint(f64::from(lo), f64::from(hi)), (f64::from(hi) - f64::from(lo)) / 2.0);
        if !active {
            (self.done, self.stuck) = (Some(asked), None);
            return None;
        }
        let wanted = f64::from(asked);
        let does = match *fault {
            ActuatorFault::Stuck { at } => {
                let place = at.map_or(self.done.unwrap_or(asked), |at| (middle + at * half) as f32);
                f64::from(*self.stuck.get_or_insert(place))
            }
            ActuatorFault::Lag { ticks } => {
                let last = f64::from(self.done.unwrap_or(asked));
                last + (wanted - last) * (1.0 - (-1.0 / ticks.max(1e-9)).exp())
            }
            ActuatorFault::DeadZone { width } => {
                if (wanted - middle).abs() < width * half {
                    middle
                } else {
                    wanted
                }
            }
            ActuatorFault::Gain { factor } => middle + (wanted - middle) * factor,
        } as f32;
        let does = does.clamp(lo, hi);
        self.done = Some(does);
        (does != asked).then_some(does)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(fault: &ActuatorFault, asked: &[f32], from: usize) -> Vec<Option<f32>> {
        let mut state = ActuatorState::default();
        asked.iter().enumerate().map(|(i, a)| state.act(fault, *a, (-1.0, 3.0), i >= from)).collect()
    }

    #[test]
    fn each_does_what_it_says() {
        let asked = [0.0, 3.0, 1.2, -1.0];
        assert_eq!(run(&ActuatorFault::Stuck { at: None }, &asked, 2), [None, None, Some(3.0), Some(3.0)]);
        assert_eq!(run(&ActuatorFault::Stuck { at: Some(0.5) }, &asked, 3)[3], Some(2.0));
        assert_eq!(run(&ActuatorFault::DeadZone { width: 0.25 }, &asked, 0), [None, None, Some(1.0), None]);
        assert_eq!(run(&ActuatorFault::Gain { factor: 0.5 }, &asked, 0), [Some(0.5), Some(2.0), Some(1.1), Some(0.0)]);
        let lag = run(&ActuatorFault::Lag { ticks: 1.0 }, &[0.0, 2.0, 2.0], 1);
        let e = f64::from(lag[1].unwrap()) / 2.0;
        assert!((e - (1.0 - (-1.0_f64).exp())).abs() < 1e-6, "{e}");
        assert!(lag[2] > lag[1]);
    }
}
