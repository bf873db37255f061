//! A row of environments: automatic reset, seeds, threads, saving.
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use gadm_envs::{
    ActionSignal, ArgumentMask, Env, EnvError, EnvOptions, EnvSpec, EnvState, ObservationSignal, Step, VecEnv,
    VecEnvState, make, reset_seed,
};
use gadm_runtime::space::ActionHead;

/// Ends its third step, and observes `(seed mod 1000, steps)`; negative actions panic.
struct Counter {
    spec: EnvSpec,
    seed: u64,
    steps: u64,
}

fn counter() -> Box<dyn Env> {
    let signal = |name: &str| ObservationSignal { name: name.into(), unit: "1".into(), lo: 0.0, hi: 1000.0 };
    let head = ActionHead::Continuous { lo: 0.0, hi: 1.0 };
    let spec = EnvSpec {
        id: "counter".into(),
        observations: vec![signal("seed"), signal("steps")],
        actions: vec![ActionSignal { name: "a".into(), unit: "1".into(), head, safe: 0.0 }],
        argument_mask: ArgumentMask::All,
        control_period_us: 1000,
        time_limit: None,
        goal_terminal: true,
    };
    Box::new(Counter { spec, seed: 0, steps: 0 })
}

impl Counter {
    fn observe(&self, obs: &mut [f32]) {
        obs.copy_from_slice(&[(self.seed % 1000) as f32, self.steps as f32]);
    }
}

impl Env for Counter {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64, obs: &mut [f32]) {
        (self.seed, self.steps) = (seed, 0);
        self.observe(obs);
    }

    fn step(&mut self, action: &[f32], obs: &mut [f32]) -> Step {
        assert!(action[0] >= 0.0, "the simulated fault of the test");
        self.steps += 1;
        self.observe(obs);
        Step { reward: f64::from(action[0]), terminated: self.steps == 3, truncated: false }
    }

    fn state(&self) -> EnvState {
        EnvState { reals: vec![], counts: vec![self.seed, self.steps] }
    }

    fn restore(&mut self, state: &EnvState) -> Result<(), EnvError> {
        (self.seed, self.steps) = (state.counts[0], state.counts[1]);
        Ok(())
    }
}

#[test]
fn an_ended_episode_is_followed_by_the_next_and_its_successor_is_kept() {
    let mut row = VecEnv::from_envs(vec![counter(), counter()], 42, 1).unwrap();
    let first = |env, episode| (reset_seed(42, env, episode) % 1000) as f32;
    assert_eq!(row.obs(), [first(0, 0), 0.0, first(1, 0), 0.0]);
    for n in 1..=2 {
        let batch = row.step(&[0.5, 0.25]).unwrap();
        assert_eq!(batch.obs, [first(0, 0), n as f32, first(1, 0), n as f32]);
        assert_eq!(batch.obs, batch.next_obs);
        assert!(batch.ended.is_empty());
    }
    let batch = row.step(&[0.5, 0.25]).unwrap();
    assert_eq!(batch.next_obs, [first(0, 0), 3.0, first(1, 0), 3.0]);
    assert_eq!(batch.obs, [first(0, 1), 0.0, first(1, 1), 0.0]);
    assert_eq!((&batch.rewards[..], &batch.terminated[..]), (&[0.5, 0.25][..], &[true, true][..]));
    assert_eq!(
        batch.ended.iter().map(|e| (e.env, e.total_reward, e.length, e.goal)).collect::<Vec<_>>(),
        [(0, 1.5, 3, true), (1, 0.75, 3, true)]
    );
    assert_eq!(row.reset().unwrap(), [first(0, 2), 0.0, first(1, 2), 0.0]);
}

#[test]
fn seeds_differ_between_runs_environments_and_episodes() {
    let mut seen = std::collections::HashSet::new();
    for run in [0, 1, u64::MAX] {
        for env in 0..16 {
            for episode in 0..200 {
                assert!(seen.insert(reset_seed(run, env, episode)), "{run} {env} {episode}");
            }
        }
    }
    // Computed apart from this code: the scheme is part of every stored result.
    assert_eq!(reset_seed(0, 0, 0), 0x2382_75bc_38fc_be91);
    assert_eq!(reset_seed(42, 3, 7), 0xab2f_9774_6e2e_a953);
}

/// Bits of observations and rewards of `steps` steps of a row.
fn trace(row: &mut VecEnv, from: usize, steps: usize) -> Vec<u64> {
    let a = row.spec().action_dim() * row.len();
    let mut out = vec![];
    for t in from..from + steps {
        let actions: Vec<f32> = (0..a).map(|i| ((t * 31 + i * 17) % 23) as f32 / 11.0 - 1.0).collect();
        let batch = row.step(&actions).unwrap();
        out.extend(batch.next_obs.iter().chain(&batch.obs).map(|o| u64::from(o.to_bits())));
        out.extend(batch.rewards.iter().map(|r| r.to_bits()));
        out.extend(batch.ended.iter().map(|e| e.total_reward.to_bits()));
    }
    out
}

fn plants() -> Vec<&'static str> {
    let mut ids = vec!["sliding", "hard-move-4", "pendulum"];
    if cfg!(feature = "mujoco") {
        ids.push("hopper-v5");
    }
    ids
}

#[test]
fn threads_change_no_result() {
    for id in plants() {
        let row = |threads| {
            let envs = (0..5).map(|_| make(id).unwrap()).collect();
            trace(&mut VecEnv::from_envs(envs, 9, threads).unwrap(), 0, 300)
        };
        let one = row(1);
        assert_eq!(one, row(2), "{id}");
        assert_eq!(one, row(3), "{id}");
        assert_eq!(one, row(64), "{id}");
    }
}

#[test]
fn a_restored_row_goes_on_bit_for_bit() {
    for id in plants() {
        let mut row = VecEnv::new(id, 3, 17, &EnvOptions::default()).unwrap();
        trace(&mut row, 0, 137);
        let saved = serde_json::to_string(&row.save()).unwrap();
        let saved: VecEnvState = serde_json::from_str(&saved).unwrap();
        let envs = (0..3).map(|_| make(id).unwrap()).collect();
        let mut copy = VecEnv::from_envs(envs, 1, 2).unwrap();
        copy.restore(&saved).unwrap();
        assert_eq!(copy.obs(), row.obs());
        assert_eq!(copy.save(), saved);
        assert_eq!(trace(&mut copy, 137, 200), trace(&mut row, 137, 200), "{id}");
    }
}

#[test]
fn wrong_shapes_are_errors() {
    let mut row = VecEnv::new("pendulum", 2, 0, &EnvOptions::default()).unwrap();
    assert_eq!(row.step(&[0.0; 3]).unwrap_err().to_string(), "numbers of a batch of actions: expected 2, found 3");
    assert!(VecEnv::new("pendulum", 0, 0, &EnvOptions::default()).is_err());
    let mixed = vec![make("moving").unwrap(), make("sliding").unwrap()];
    assert!(matches!(VecEnv::from_envs(mixed, 0, 1), Err(EnvError::Batch { .. })));
    let mut saved = row.save();
    saved.envs[1].obs.pop();
    assert!(row.restore(&saved).unwrap_err().to_string().contains("saved observation"));
    saved.envs.pop();
    assert!(row.restore(&saved).unwrap_err().to_string().contains("expected 2, found 1"));
    let other = VecEnv::new("moving", 2, 0, &EnvOptions::default()).unwrap().save();
    assert!(row.restore(&other).is_err());
}

#[test]
fn a_fault_in_a_worker_is_an_error_and_not_a_hang() {
    let mut row = VecEnv::from_envs(vec![counter(), counter()], 0, 2).unwrap();
    assert!(row.step(&[0.0, 0.0]).is_ok());
    assert!(matches!(row.step(&[0.0, -1.0]), Err(EnvError::Worker)));
    assert!(matches!(row.step(&[0.0, 0.0]), Err(EnvError::Worker)));
    assert!(matches!(row.reset(), Err(EnvError::Worker)));
}
