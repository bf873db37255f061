//! The last step before the wire: bounds, rate limit, hold, and the ramp to the safe action.

use gadm_runtime::ActionHead;
use heapless::Vec;

use crate::protocol::MAX_ACTIONS;

/// Holds the action that is on the wire and decides how it may change.
#[derive(Clone, Debug, Default)]
pub(crate) struct Shaper {
    heads: Vec<ActionHead, MAX_ACTIONS>,
    safe: Vec<f32, MAX_ACTIONS>,
    action: Vec<f32, MAX_ACTIONS>,
    start: Vec<f32, MAX_ACTIONS>,
    ramp_ticks: u16,
    step: u16,
    rate_limit: Option<f32>,
}

impl Shaper {
    /// For `(head, safe value)` of each slot. At most [`MAX_ACTIONS`] are taken.
    ///
    /// `rate_limit` is the largest change of a continuous slot in one period, as a fraction of its range.
    pub(crate) fn new(
        slots: impl Iterator<Item = (ActionHead, f32)>,
        ramp_ticks: u16,
        rate_limit: Option<f32>,
    ) -> Self {
        let mut shaper = Self { ramp_ticks, rate_limit, ..Self::default() };
        for (head, safe) in slots.take(MAX_ACTIONS) {
            let safe = bounded(head, safe, bounded(head, 0.0, 0.0));
            let _full = shaper.heads.push(head);
            let _full = shaper.safe.push(safe);
        }
        shaper.action = shaper.safe.clone();
        shaper.start = shaper.safe.clone();
        shaper
    }

    /// The action on the wire.
    pub(crate) fn action(&self) -> &[f32] {
        &self.action
    }

    /// Takes the safe action at once.
    pub(crate) fn reset(&mut self) {
        self.action.clone_from(&self.safe);
        self.start.clone_from(&self.safe);
        self.step = self.ramp_ticks;
    }

    /// Takes a new action; true where a range or rate limit cut it. Values within the limits pass bit for bit.
    pub(crate) fn take(&mut self, wanted: &[f32]) -> bool {
        let mut clipped = false;
        for (((slot, &want), &head), &safe) in self.action.iter_mut().zip(wanted).zip(&self.heads).zip(&self.safe) {
            let mut value = bounded(head, want, safe);
            if let (ActionHead::Continuous { lo, hi }, Some(rate)) = (head, self.rate_limit) {
                let reach = (hi - lo) * rate;
                value = if value > *slot + reach {
                    *slot + reach
                } else if value < *slot - reach {
                    *slot - reach
                } else {
                    value
                };
            }
            clipped |= value.to_bits() != want.to_bits();
            *slot = value;
        }
        clipped
    }

    /// Begins the way from the action on the wire to the safe one; `at_once` leaves the ramp out.
    pub(crate) fn begin_ramp(&mut self, at_once: bool) {
        self.start.clone_from(&self.action);
        self.step = if at_once { self.ramp_ticks } else { 0 };
    }

    /// The next step of the ramp: continuous slots on a straight line, types and switches at once.
    pub(crate) fn ramp(&mut self) {
        self.step = self.step.saturating_add(1).min(self.ramp_ticks.max(1));
        let done = self.step >= self.ramp_ticks;
        let share = f32::from(self.step) / f32::from(self.ramp_ticks.max(1));
        for (((slot, &start), &safe), &head) in self.action.iter_mut().zip(&self.start).zip(&self.safe).zip(&self.heads)
        {
            *slot = match head {
                ActionHead::Continuous { .. } if !done => bounded(head, start + (safe - start) * share, safe),
                _ => safe,
            };
        }
    }
}

/// `value` where the head allows it, else the nearest allowed one; `instead` where it is not a number.
fn bounded(head: ActionHead, value: f32, instead: f32) -> f32 {
    let limit = |lo: f32, hi: f32| {
        if value < lo {
            lo
        } else if value > hi {
            hi
        } else {
            value
        }
    };
    if !value.is_finite() {
        return instead;
    }
    match head {
        ActionHead::Continuous { lo, hi } => limit(lo, hi),
        ActionHead::Discrete { n } => whole(limit(0.0, f32::from(n.saturating_sub(1)))),
        ActionHead::Binary => whole(limit(0.0, 1.0)),
    }
}

/// Nearest whole number of a value in 0 to 65535; whole values keep their bits.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "the caller bounds the value to u16")]
fn whole(value: f32) -> f32 {
    f32::from((value + 0.5) as u16)
}

#[cfg(test)]
mod tests {
    use super::*;

    const C: ActionHead = ActionHead::Continuous { lo: -1.0, hi: 3.0 };

    #[test]
    fn bounds_cut_and_say_so() {
        let mut s = Shaper::new(
            [(C, 0.5), (ActionHead::Discrete { n: 3 }, 1.0), (ActionHead::Binary, 0.0)].into_iter(),
            4,
            None,
        );
        assert_eq!(s.action(), [0.5, 1.0, 0.0]);
        assert!(!s.take(&[3.0, 2.0, 1.0]));
        assert_eq!(s.action(), [3.0, 2.0, 1.0]);
        assert!(s.take(&[3.5, 9.0, -4.0]));
        assert_eq!(s.action(), [3.0, 2.0, 0.0]);
        assert!(s.take(&[f32::NAN, 0.0, 0.0]));
        assert_eq!(s.action(), [0.5, 0.0, 0.0]);
    }

    #[test]
    fn rate_limit_counts_from_the_action_on_the_wire() {
        let mut s = Shaper::new([(C, 0.0)].into_iter(), 4, Some(0.25));
        assert!(s.take(&[3.0]));
        assert_eq!(s.action(), [1.0]);
        assert!(!s.take(&[1.5]));
        assert!(s.take(&[-1.0]));
        assert_eq!(s.action(), [0.5]);
    }

    #[test]
    fn ramp_is_straight_and_ends_exactly_at_the_safe_value() {
        let mut s = Shaper::new([(C, 0.1), (ActionHead::Binary, 0.0)].into_iter(), 4, None);
        s.take(&[2.1, 1.0]);
        s.begin_ramp(false);
        let mut seen = std::vec::Vec::new();
        for _ in 0..5 {
            s.ramp();
            assert_eq!(s.action()[1], 0.0, "switches do not ramp");
            seen.push(s.action()[0]);
        }
        assert!((seen[0] - 1.6).abs() < 1e-6 && (seen[2] - 0.6).abs() < 1e-6);
        assert_eq!(seen[3..], [0.1, 0.1]);
        s.take(&[2.0, 1.0]);
        s.begin_ramp(true);
        s.ramp();
        assert_eq!(s.action(), [0.1, 0.0]);
    }

    #[test]
    fn an_illegal_safe_value_is_brought_into_bounds() {
        let s = Shaper::new([(C, 9.0), (C, f32::NAN)].into_iter(), 4, None);
        assert_eq!(s.action(), [3.0, 0.0]);
    }
}
