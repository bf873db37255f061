//! First-in first-out buffers in flat arrays, sampled uniformly with replacement.

use rand::RngExt as _;

use super::nstep::Transition;
use crate::seed::Rng;

/// Rows of fixed width that overwrite the oldest once full.
#[derive(Clone, Debug)]
struct Rows {
    width: usize,
    data: Vec<f32>,
}

impl Rows {
    fn write(&mut self, at: usize, row: &[f32]) {
        debug_assert_eq!(row.len(), self.width);
        if at * self.width == self.data.len() {
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
        self.obs.write(at, obs);
        self.actions.write(at, action);
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

/// D_RL: n-step transitions for the Q-network.
#[derive(Clone, Debug)]
pub struct RlBuffer {
    cursor: Cursor,
    columns: [Rows; 6],
    indices: Vec<usize>,
}

/// Names of the columns, in order, for checkpoints.
pub const RL_COLUMNS: [&str; 6] = ["obs", "actions", "codes", "returns", "bootstrap", "next_obs"];

impl RlBuffer {
    /// An empty buffer.
    pub fn new(capacity: usize, obs_dim: usize, slots: usize) -> Self {
        let columns = [obs_dim, slots, 1, 1, 1, obs_dim].map(|width| Rows { width, data: Vec::new() });
        Self { cursor: Cursor { capacity: capacity.max(1), len: 0, next: 0 }, columns, indices: Vec::new() }
    }

    /// Transitions held.
    pub fn len(&self) -> usize {
        self.cursor.len
    }

    /// True before the first transition.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Memory held for rows, bytes.
    pub fn bytes(&self) -> usize {
        self.columns.iter().map(|c| c.data.capacity() * size_of::<f32>()).sum()
    }

    /// Adds a transition.
    pub fn push(&mut self, t: &Transition) {
        let at = self.cursor.advance();
        let values: [&[f32]; 6] = [&t.obs, &t.action, &[t.code as f32], &[t.ret], &[t.bootstrap], &t.next_obs];
        for (column, row) in self.columns.iter_mut().zip(values) {
            column.write(at, row);
        }
    }

    /// Draws `n` transitions.
    pub fn sample(&mut self, n: usize, rng: &mut Rng, batch: &mut RlBatch) {
        self.cursor.draw(n, rng, &mut self.indices);
        let RlBatch { obs, actions, codes, returns, bootstrap, next_obs } = batch;
        for (column, out) in self.columns.iter().zip([obs, actions, codes, returns, bootstrap, next_obs]) {
            column.gather(&self.indices, out);
        }
    }

    /// Arrays for a checkpoint: next index and the columns in order of [`RL_COLUMNS`].
    pub fn arrays(&self) -> (usize, [&[f32]; 6]) {
        (self.cursor.next, [0, 1, 2, 3, 4, 5].map(|i| self.columns[i].data.as_slice()))
    }

    /// Takes arrays back. False where their lengths do not fit.
    #[must_use]
    pub fn restore(&mut self, next: usize, columns: [Vec<f32>; 6]) -> bool {
        let len = columns[2].len();
        let fits = self.columns.iter().zip(&columns).all(|(c, data)| data.len() == len * c.width)
            && len <= self.cursor.capacity
            && (next == len % self.cursor.capacity || len == self.cursor.capacity && next < len);
        if fits {
            (self.cursor.len, self.cursor.next) = (len, next);
            for (column, data) in self.columns.iter_mut().zip(columns) {
                column.data = data;
            }
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
}
