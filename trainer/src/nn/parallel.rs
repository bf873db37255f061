//! Two cores, one result. A batch is always computed in the same two halves, each with its own gradient, whichever thread runs
//! them; so no number depends on how many threads there are, and where there is one it does the halves in turn.
//!
//! The second half waits for a worker of `rayon`, which looks for work a short while before it sleeps; where no worker has come
//! by the time the first half is done, the caller takes the second one too. That is what keeps training going when another
//! program has a core.

use std::cell::OnceCell;
use std::ops::Range;

/// Parts of a batch. Two, for the two cores this is made for; another number changes the order of sums, and so the results.
pub const PARTS: usize = 2;

/// Fewer rows than this are one part: the hand-over would take longer than the work.
const LEAST_ROWS: usize = 128;

/// The rows of each part of a batch. All but the first may be empty.
pub fn split(batch: usize) -> [Range<usize>; PARTS] {
    let first = if batch < LEAST_ROWS { batch } else { batch.div_ceil(2) };
    [0..first, first..batch]
}

/// The most rows that one part of up to `batch` rows can have.
pub fn part_rows(batch: usize) -> usize {
    batch.div_ceil(2).max(batch.min(LEAST_ROWS))
}

/// Lets the calling thread share its work with others; `threads` counts it in. Without this call, and on every other
/// thread, all work is done by the calling thread. Results are the same. False where the thread shares already, or no
/// other thread can be started.
pub fn start(threads: usize) -> bool {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads.clamp(1, PARTS))
        .use_current_thread()
        .thread_name(|i| format!("nn-worker-{i}"))
        .build();
    // The workers live as long as the thread that they help.
    pool.is_ok_and(|pool| POOL.with(|own| own.set(pool).is_ok()))
}

thread_local! {
    static POOL: OnceCell<rayon::ThreadPool> = const { OnceCell::new() };
}

/// Threads that share the calling thread's work, itself included.
pub fn threads() -> usize {
    if rayon::current_thread_index().is_some() { rayon::current_num_threads() } else { 1 }
}

/// Does both, at the same time where a worker is free.
pub fn join<A: Send, B: Send>(a: impl FnOnce() -> A + Send, b: impl FnOnce() -> B + Send) -> (A, B) {
    if threads() > 1 { rayon::join(a, b) } else { (a(), b()) }
}

/// Does `work` on the first one or two elements that `work` has rows for.
///
/// # Panics
/// Where there are fewer elements than parts that are not empty.
pub fn each<T: Send>(parts: &mut [T], rows: &[Range<usize>; PARTS], work: impl Fn(&mut T, Range<usize>) + Sync) {
    let [first, second] = rows.clone();
    if second.is_empty() {
        return work(&mut parts[0], first);
    }
    let (a, b) = parts.split_at_mut(1);
    join(|| work(&mut a[0], first), || work(&mut b[0], second));
}

/// Where a vector of that length is cut in two halves for two threads; `len` where that is not worth it.
pub fn halves(len: usize) -> usize {
    if len < 1 << 14 { len } else { (len / 2).next_multiple_of(64) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_batch_is_split_in_two_halves_or_not_at_all() {
        assert_eq!(split(512), [0..256, 256..512]);
        assert_eq!(split(129), [0..65, 65..129]);
        assert_eq!(split(100), [0..100, 100..100]);
    }

    #[test]
    fn both_parts_are_done_with_and_without_a_worker() {
        let run = || {
            let mut parts = [0, 0];
            each(&mut parts, &split(300), |part, rows| *part = rows.sum::<usize>());
            parts
        };
        let alone = run();
        assert_eq!((alone, threads()), ([(0..150).sum(), (150..300).sum()], 1));
        let shared = std::thread::spawn(move || {
            assert!(start(2));
            assert!(!start(2), "once a thread");
            (run(), threads())
        });
        assert_eq!(shared.join().unwrap(), (alone, 2));
    }

    #[test]
    fn the_second_part_runs_on_another_thread() {
        let helped = std::thread::spawn(|| {
            assert!(start(2));
            let meet = std::sync::Barrier::new(2);
            let id = || {
                meet.wait();
                std::thread::current().id()
            };
            join(id, id)
        });
        let (a, b) = helped.join().unwrap();
        assert_ne!(a, b);
    }
}
