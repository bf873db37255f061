//! First-in first-out buffers in flat arrays, sampled uniformly with replacement.

use rand::RngExt as _;

use super::nstep::Transition;
use super::states::States;
use crate::seed::Rng;

/// Rows of fixed width that overwrite the oldest once full.
#[derive(Clone, Debug)]
struct Rows {
    width: usize,
    data: Vec<f32>,
}

impl Rows {
    /// Writes row `at` of at most `capacity`.
    fn write(&mut self, at: usize, row: &[f32], capacity: usize) {
        debug_assert_eq!(row.len(), self.width);
        if at * self.width == self.data.len() {
            if self.data.capacity() - self.data.len() < row.len() {
                self.data.reserve_exact(more(at, capacity) * self.width);
            }
            self.data.extend_from_slice(row);
        } else {
            self.data[at * self.width..(at + 1) * self.width].copy_from_slice(row);
        }
    }

    fn gather(&self, indices: &[usize], out: &mut Vec<f32>) {
        out.clear();
        for &i in indices {
            out.extend_from_slice(&self.data[i * self.width..(i + 1) * self.width]);
        }
    }
}

/// Rows to make room for when `len` of at most `capacity` are held. All of a common capacity at once: pages that are not written
/// take no memory, and a vector that grows leaves holes behind. Beyond that an eighth more.
fn more(len: usize, capacity: usize) -> usize {
    if len == 0 { capacity.min(1 << 20) } else { (len / 8).max(1024).min(capacity - len) }
}

/// Where the next row goes.
#[derive(Clone, Copy, Debug)]
struct Cursor {
    capacity: usize,
    len: usize,
    next: usize,
}

impl Cursor {
    fn advance(&mut self) -> usize {
        let at = self.next;
        self.next = (at + 1) % self.capacity;
        self.len = self.len.max(at + 1);
        at
    }

    fn draw(&self, n: usize, rng: &mut Rng, indices: &mut Vec<usize>) {
        indices.clear();
        indices.extend((0..n).map(|_| rng.random_range(0..self.len)));
    }
}

/// D_AR: state-action pairs for the action model and the confidence predictor.
#[derive(Clone, Debug)]
pub struct ActionBuffer {
    cursor: Cursor,
    obs: Rows,
    actions: Rows,
    indices: Vec<usize>,
}

impl ActionBuffer {
    /// An empty buffer.
    pub fn new(capacity: usize, obs_dim: usize, slots: usize) -> Self {
        let rows = |width| Rows { width, data: Vec::new() };
        let cursor = Cursor { capacity: capacity.max(1), len: 0, next: 0 };
        Self { cursor, obs: rows(obs_dim), actions: rows(slots), indices: Vec::new() }
    }

    /// Pairs held.
    pub fn len(&self) -> usize {
        self.cursor.len
    }

    /// True before the first pair.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Adds a pair.
    pub fn push(&mut self, obs: &[f32], action: &[f32]) {
        let at = self.cursor.advance();
        self.obs.write(at, obs, self.cursor.capacity);
        self.actions.write(at, action, self.cursor.capacity);
    }

    /// Draws `n` pairs into `obs` (`n x obs_dim`) and `actions` (`n x slots`).
    pub fn sample(&mut self, n: usize, rng: &mut Rng, obs: &mut Vec<f32>, actions: &mut Vec<f32>) {
        self.cursor.draw(n, rng, &mut self.indices);
        self.obs.gather(&self.indices, obs);
        self.actions.gather(&self.indices, actions);
    }

    /// Arrays for a checkpoint: next index, observations, actions.
    pub fn arrays(&self) -> (usize, &[f32], &[f32]) {
        (self.cursor.next, &self.obs.data, &self.actions.data)
    }

    /// Takes arrays back. False where their lengths do not fit.
    #[must_use]
    pub fn restore(&mut self, next: usize, obs: Vec<f32>, actions: Vec<f32>) -> bool {
        let len = obs.len() / self.obs.width;
        let fits = len * self.obs.width == obs.len()
            && len * self.actions.width == actions.len()
            && len <= self.cursor.capacity
            && (next == len % self.cursor.capacity || len == self.cursor.capacity && next < len);
        if fits {
            (self.cursor.len, self.cursor.next, self.obs.data, self.actions.data) = (len, next, obs, actions);
        }
        fits
    }
}

/// A batch of n-step transitions, row-major.
#[derive(Clone, Debug, Default)]
pub struct RlBatch {
    /// Observations, `B x obs_dim`.
    pub obs: Vec<f32>,
    /// Actions, `B x slots`.
    pub actions: Vec<f32>,
    /// Latents chosen at collection, `B`.
    pub codes: Vec<f32>,
    /// n-step returns, `B`.
    pub returns: Vec<f32>,
    /// Bootstrap weights, `B`.
    pub bootstrap: Vec<f32>,
    /// Successor observations, `B x obs_dim`.
    pub next_obs: Vec<f32>,
}

/// D_RL: n-step transitions for the Q-network. An observation that two transitions share is held once.
#[derive(Clone, Debug)]
pub struct RlBuffer {
    cursor: Cursor,
    states: States,
    /// Per transition: rows of its observation and of its successor.
    rows: Vec<[u32; 2]>,
    /// Actions, codes, returns, bootstrap weights.
    columns: [Rows; 4],
    indices: Vec<usize>,
}

/// Names of the columns, in order, for checkpoints.
pub const RL_COLUMNS: [&str; 6] = ["obs", "actions", "codes", "returns", "bootstrap", "next_obs"];

impl RlBuffer {
    /// An empty buffer.
    pub fn new(capacity: usize, obs_dim: usize, slots: usize) -> Self {
        let columns = [slots, 1, 1, 1].map(|width| Rows { width, data: Vec::new() });
        let cursor = Cursor { capacity: capacity.max(1), len: 0, next: 0 };
        Self { cursor, states: States::new(obs_dim), rows: Vec::new(), columns, indices: Vec::new() }
    }

    /// Transitions held.
    pub fn len(&self) -> usize {
        self.cursor.len
    }

    /// True before the first transition.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Memory held for transitions, bytes.
    pub fn bytes(&self) -> usize {
        let columns: usize = self.columns.iter().map(|c| c.data.capacity()).sum();
        self.states.bytes() + 8 * self.rows.capacity() + 4 * columns
    }

    /// Adds a transition.
    pub fn push(&mut self, t: &Transition) {
        self.put([&t.obs, &t.action, &[t.code as f32], &[t.ret], &[t.bootstrap], &t.next_obs]);
    }

    fn put(&mut self, [obs, action, code, ret, bootstrap, next_obs]: [&[f32]; 6]) {
        let at = self.cursor.advance();
        if let Some(&old) = self.rows.get(at) {
            for row in old {
                self.states.release(row);
            }
        } else {
            if self.rows.capacity() == at {
                self.rows.reserve_exact(more(at, self.cursor.capacity));
            }
            self.rows.push([0; 2]);
        }
        self.rows[at] = [self.states.hold(obs), self.states.hold(next_obs)];
        for (column, row) in self.columns.iter_mut().zip([action, code, ret, bootstrap]) {
            column.write(at, row, self.cursor.capacity);
        }
    }

    /// Draws `n` transitions.
    pub fn sample(&mut self, n: usize, rng: &mut Rng, batch: &mut RlBatch) {
        self.cursor.draw(n, rng, &mut self.indices);
        let RlBatch { obs, actions, codes, returns, bootstrap, next_obs } = batch;
        obs.clear();
        next_obs.clear();
        for &i in &self.indices {
            let [start, end] = self.rows[i];
            obs.extend_from_slice(self.states.row(start));
            next_obs.extend_from_slice(self.states.row(end));
        }
        for (column, out) in self.columns.iter().zip([actions, codes, returns, bootstrap]) {
            column.gather(&self.indices, out);
        }
    }

    /// Index of the transition that is overwritten next; the oldest one, once the buffer is full.
    pub fn next(&self) -> usize {
        self.cursor.next
    }

    /// Observation of transition `i`.
    pub fn obs(&self, i: usize) -> &[f32] {
        self.states.row(self.rows[i][0])
    }

    /// Arrays for a checkpoint: next index and the columns in order of [`RL_COLUMNS`].
    pub fn arrays(&self) -> (usize, [Vec<f32>; 6]) {
        let observations =
            |end: usize| self.rows.iter().flat_map(|rows| self.states.row(rows[end])).copied().collect::<Vec<f32>>();
        let [actions, codes, returns, bootstrap] = [0, 1, 2, 3].map(|i| self.columns[i].data.clone());
        (self.cursor.next, [observations(0), actions, codes, returns, bootstrap, observations(1)])
    }

    /// Takes arrays back. False where their lengths do not fit.
    #[must_use]
    pub fn restore(&mut self, next: usize, columns: &[Vec<f32>; 6]) -> bool {
        let len = columns[2].len();
        let slots = self.columns[0].width;
        let widths = [self.states.width(), slots, 1, 1, 1, self.states.width()];
        let fits = columns.iter().zip(widths).all(|(data, width)| data.len() == len * width)
            && len <= self.cursor.capacity
            && (next == len % self.cursor.capacity || len == self.cursor.capacity && next < len);
        if fits {
            *self = Self::new(self.cursor.capacity, self.states.width(), slots);
            // In order of time, so that shared observations lie as close together as when they came.
            let oldest = if len == self.cursor.capacity { next } else { 0 };
            self.rows = vec![[0; 2]; len];
            for (column, data) in self.columns.iter_mut().zip(&columns[1..5]) {
                column.data.clone_from(data);
            }
            let width = self.states.width();
            for i in (oldest..len).chain(0..oldest) {
                let row = |data: &[f32]| data[i * width..(i + 1) * width].to_vec();
                self.rows[i] = [self.states.hold(&row(&columns[0])), self.states.hold(&row(&columns[5]))];
            }
            (self.cursor.len, self.cursor.next) = (len, next);
        }
        fits
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::seed::SeedTree;

    #[test]
    fn the_oldest_row_is_overwritten_and_rows_stay_together() {
        let mut buffer = ActionBuffer::new(3, 2, 1);
        for i in 0..5 {
            buffer.push(&[i as f32, -(i as f32)], &[10.0 * i as f32]);
        }
        assert_eq!(buffer.len(), 3);
        let (mut obs, mut actions) = (Vec::new(), Vec::new());
        buffer.sample(200, &mut SeedTree::new(1).stream("s"), &mut obs, &mut actions);
        let mut seen: Vec<i32> = Vec::new();
        for (o, a) in obs.chunks(2).zip(&actions) {
            assert_eq!((o[1], *a), (-o[0], 10.0 * o[0]));
            seen.push(o[0] as i32);
        }
        seen.sort_unstable();
        seen.dedup();
        assert_eq!(seen, [2, 3, 4]);
    }

    #[test]
    fn restored_buffers_continue_alike_and_misfits_are_refused() {
        let mut a = ActionBuffer::new(4, 1, 1);
        (0..6).for_each(|i| a.push(&[i as f32], &[0.5]));
        let mut b = ActionBuffer::new(4, 1, 1);
        let (next, obs, actions) = a.arrays();
        assert!(b.restore(next, obs.to_vec(), actions.to_vec()));
        assert!(!b.restore(9, obs.to_vec(), actions.to_vec()));
        assert!(!b.restore(0, obs.to_vec(), vec![0.0]));
        a.push(&[9.0], &[0.0]);
        b.push(&[9.0], &[0.0]);
        assert_eq!(a.arrays(), b.arrays());
    }

    /// Transitions of two environments in turn, n = 2, episodes of five steps.
    fn pushed(capacity: usize, steps: usize) -> (RlBuffer, Vec<Transition>) {
        let (mut buffer, mut all) = (RlBuffer::new(capacity, 3, 2), Vec::new());
        let mut nsteps = vec![crate::replay::NStep::new(2, 0.5); 2];
        for step in 0..steps {
            for (env, nstep) in nsteps.iter_mut().enumerate() {
                let at = |t: usize, end: bool| [t as f32, env as f32, f32::from(u8::from(end))];
                let end = step % 5 == 4;
                nstep.push(&at(step, false), &[0.25, step as f32], 3, 1.0, &at(step + 1, end), end, false, |t| {
                    buffer.push(&t);
                    all.push(t);
                });
            }
        }
        (buffer, all)
    }

    #[test]
    fn transitions_come_back_as_they_were_and_share_observations() {
        let (mut buffer, all) = pushed(40, 100);
        let kept = &all[all.len() - 40..];
        let (next, columns) = buffer.arrays();
        for (i, t) in kept.iter().enumerate() {
            let at = (next + i) % 40;
            assert_eq!(columns[0][3 * at..3 * at + 3], t.obs);
            assert_eq!(columns[5][3 * at..3 * at + 3], t.next_obs);
            assert_eq!((columns[1][2 * at + 1], columns[3][at], columns[4][at]), (t.action[1], t.ret, t.bootstrap));
            assert_eq!(buffer.obs(at), t.obs);
        }
        // 40 starts, and 2 observations per episode that no transition starts from (8 ends), 4 pending ones.
        let used: std::collections::HashSet<u32> = buffer.rows.iter().flatten().copied().collect();
        assert!(used.len() <= 40 + 8 + 4, "{}", used.len());
        let mut batch = RlBatch::default();
        buffer.sample(64, &mut SeedTree::new(1).stream("s"), &mut batch);
        for (o, n) in batch.obs.chunks(3).zip(batch.next_obs.chunks(3)) {
            assert!(kept.iter().any(|t| t.obs == o && t.next_obs == n));
        }
    }

    #[test]
    fn a_restored_buffer_of_transitions_continues_alike() {
        for steps in [10, 100] {
            let (mut a, _) = pushed(40, steps);
            let (next, columns) = a.arrays();
            let mut b = RlBuffer::new(40, 3, 2);
            assert!(b.restore(next, &columns));
            let (_, more) = pushed(40, 130);
            for t in &more {
                a.push(t);
                b.push(t);
            }
            assert_eq!(a.arrays(), b.arrays());
            let mut short = columns;
            short[5].pop();
            assert!(!b.restore(next, &short));
        }
    }
}
