//! What faults did: when they were noticed, when the actuators were safe, and how wrong an action was.

use gadm_node::{Counters, Fault};
use gadm_runtime::{ActionHead, Policy, Scratch};

use crate::plant_node::Applied;
use crate::result::EpisodeFaults;

/// What can be seen after one control period.
#[derive(Clone, Copy, Debug)]
pub struct Signs {
    /// What the actuators got.
    pub applied: Applied,
    /// What the node's heartbeat says.
    pub fault: Fault,
    /// What the node counted; `None` where the target tells frames only.
    pub counted: Option<Counters>,
}

/// Looks at every control period of a run with faults.
#[derive(Debug)]
pub struct Watch<'p> {
    policy: Policy<'p>,
    memory: Vec<u32>,
    on: bool,
    /// The policy's decision on the true observation.
    wanted: Vec<f32>,
    decided: bool,
    ranges: Vec<f64>,
    before: Option<Counters>,
    found: EpisodeFaults,
}

const NOTHING: EpisodeFaults =
    EpisodeFaults { first_tick: None, detected_after: None, safe_after: None, worst_action_error: 0.0 };

impl<'p> Watch<'p> {
    /// A watch that decides beside the node with `policy`; where it is not `on`, it does nothing.
    #[must_use]
    pub fn new(policy: Policy<'p>, on: bool) -> Self {
        let range = |head| match head {
            ActionHead::Continuous { lo, hi } => f64::from(hi) - f64::from(lo),
            ActionHead::Discrete { .. } | ActionHead::Binary => 1.0,
        };
        let ranges: Vec<f64> = policy.action_signals().map(|s| range(s.head)).collect();
        Self {
            memory: if on { vec![0; policy.spec().scratch_words] } else { Vec::new() },
            wanted: vec![0.0; ranges.len()],
            policy,
            on,
            decided: false,
            ranges,
            before: None,
            found: NOTHING,
        }
    }

    /// Forgets the last episode; `counted` is what the node has counted until now.
    pub fn begin_episode(&mut self, counted: Option<Counters>) {
        self.found = NOTHING;
        self.before = counted;
    }

    /// Takes the true observation of a period.
    pub fn decide(&mut self, obs: &[f32]) {
        if self.on {
            let mut scratch = Scratch::new(&mut self.memory);
            self.decided = self.policy.act(obs, &mut scratch, &mut self.wanted).is_ok();
        }
    }

    /// Looks at the end of period `tick`; `first_tick` is that of the first fault of the episode, `applied` what the
    /// actuators did.
    pub fn observe(&mut self, tick: u64, first_tick: Option<u64>, signs: &Signs, applied: &[f32]) {
        if !self.on {
            return;
        }
        let Some(first) = first_tick else {
            self.before = signs.counted;
            return;
        };
        let after = tick.saturating_sub(first);
        if self.found.detected_after.is_none() && self.noticed(signs) {
            self.found.detected_after = Some(after);
        }
        if self.found.safe_after.is_none() && signs.applied.safe {
            self.found.safe_after = Some(after);
        }
        if self.decided {
            for ((does, wanted), range) in applied.iter().zip(&self.wanted).zip(&self.ranges) {
                let error = (f64::from(*does) - f64::from(*wanted)).abs() / range.max(f64::MIN_POSITIVE);
                self.found.worst_action_error = self.found.worst_action_error.max(error);
            }
        }
    }

    fn noticed(&self, signs: &Signs) -> bool {
        use gadm_node::Flags;
        let flags = signs.applied.flags;
        let flagged = [Flags::HELD, Flags::SAFE, Flags::LATE].into_iter().any(|f| flags.contains(f));
        let zero = Counters::default();
        let (now, before) = (signs.counted.unwrap_or(zero), self.before.unwrap_or(zero));
        let troubles =
            |s: Counters| [s.missed, s.late, s.torn, s.sequence, s.crc_errors, s.invalid, s.safe_entries, s.bus_errors];
        let counted = troubles(now).into_iter().zip(troubles(before)).any(|(now, before)| now > before);
        flagged || !signs.applied.fresh || counted || signs.fault != Fault::None
    }

    /// What was found in the episode.
    #[must_use]
    pub fn end_episode(&self, first_tick: Option<u64>) -> EpisodeFaults {
        EpisodeFaults { first_tick, ..self.found }
    }
}
