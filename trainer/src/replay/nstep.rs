//! Sums n rewards into one transition, across collection boundaries (specification 4.2, 4.5).

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

/// An n-step transition.
#[derive(Clone, Debug, PartialEq)]
pub struct Transition {
    /// Observation at the start.
    pub obs: Vec<f32>,
    /// Action taken there (slots, normalised).
    pub action: Vec<f32>,
    /// Latent chosen there (for training without remapping).
    pub code: u32,
    /// `Σ γ^i r_{t+i}` over the rewards summed.
    pub ret: f32,
    /// `γ^m (1 - done)` with m the number of rewards summed: weight of the bootstrap value at `next_obs`.
    pub bootstrap: f32,
    /// Observation after the last reward summed.
    pub next_obs: Vec<f32>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Pending {
    obs: Vec<f32>,
    action: Vec<f32>,
    code: u32,
    rewards: Vec<f64>,
}

/// The last n - 1 steps of one environment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NStep {
    n: usize,
    gamma: f64,
    pending: VecDeque<Pending>,
}

impl NStep {
    /// For horizon `n` and discount `gamma`.
    pub fn new(n: usize, gamma: f64) -> Self {
        Self { n, gamma, pending: VecDeque::new() }
    }

    /// Adds one step; calls `emit` for every transition that is now complete. A terminated episode flushes without bootstrap, a
    /// truncated one bootstraps from `next_obs` with γ^m.
    #[expect(clippy::too_many_arguments, reason = "the fields of one step")]
    pub fn push(
        &mut self,
        obs: &[f32],
        action: &[f32],
        code: u32,
        reward: f64,
        next_obs: &[f32],
        terminated: bool,
        truncated: bool,
        mut emit: impl FnMut(Transition),
    ) {
        self.pending.push_back(Pending { obs: obs.to_vec(), action: action.to_vec(), code, rewards: Vec::new() });
        self.pending.iter_mut().for_each(|p| p.rewards.push(reward));
        let ends = terminated || truncated;
        while self.pending.front().is_some_and(|p| ends || p.rewards.len() == self.n) {
            let p = self.pending.pop_front().expect("a front exists");
            let ret: f64 = p.rewards.iter().rev().fold(0.0, |sum, r| r + self.gamma * sum);
            let bootstrap = if terminated { 0.0 } else { self.gamma.powi(p.rewards.len() as i32) };
            emit(Transition {
                obs: p.obs,
                action: p.action,
                code: p.code,
                ret: ret as f32,
                bootstrap: bootstrap as f32,
                next_obs: next_obs.to_vec(),
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(terminated: bool) -> Vec<(f32, f32)> {
        let mut nstep = NStep::new(3, 0.5);
        let mut out = Vec::new();
        for (t, reward) in [1.0, 2.0, 4.0].into_iter().enumerate() {
            let last = t == 2;
            nstep.push(
                &[t as f32],
                &[0.0],
                0,
                reward,
                &[t as f32 + 1.0],
                last && terminated,
                last && !terminated,
                |tr| {
                    assert_eq!(tr.next_obs, [3.0]);
                    out.push((tr.ret, tr.bootstrap));
                },
            );
        }
        out
    }

    /// Specification, appendix A, item 8 (with γ = 1/2, so that every number is exact).
    #[test]
    fn termination_and_truncation() {
        assert_eq!(run(true), [(3.0, 0.0), (4.0, 0.0), (4.0, 0.0)]);
        assert_eq!(run(false), [(3.0, 0.125), (4.0, 0.25), (4.0, 0.5)]);
    }

    #[test]
    fn a_long_episode_gives_one_transition_a_step() {
        let mut nstep = NStep::new(2, 0.9);
        let mut starts = Vec::new();
        for t in 0..5 {
            let obs = [t as f32];
            nstep.push(&obs, &[0.0], t, 1.0, &[t as f32 + 1.0], false, false, |tr| {
                assert_eq!(tr.next_obs[0], tr.obs[0] + 2.0);
                starts.push(tr.code);
            });
        }
        assert_eq!(starts, [0, 1, 2, 3]);
    }
}
