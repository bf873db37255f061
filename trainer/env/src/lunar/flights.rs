//! Where running episodes are kept: on the thread that steps them.
//!
//! Box2D's objects cannot be sent to another thread, nor written out and read back exactly. But an episode is a function of
//! its random source and of what the engines did, so that is what an environment holds, and can send and save; the
//! simulation is a working copy that each thread makes when it is first asked for one, by flying the episode again.

use std::{
    cell::RefCell,
    sync::{Arc, Weak},
};

use super::flight::{Flight, Reading, Thrust};
use crate::{sampling::EpisodeRng, task::Outcome};

/// Start of an episode; the allocation itself is the episode's identity.
pub(super) type Start = Arc<EpisodeRng>;

struct Kept {
    /// Keeps the address from being used again, not the episode.
    start: Weak<EpisodeRng>,
    steps: usize,
    flight: Flight,
}

thread_local! {
    static KEPT: RefCell<Vec<Kept>> = const { RefCell::new(Vec::new()) };
}

/// Brings this thread's copy of an episode to the end of `thrusts`, which only ever grows, and tells what is seen there.
pub(super) fn advance(start: &Start, thrusts: &[Thrust]) -> (Reading, Outcome) {
    KEPT.with_borrow_mut(|kept| {
        let at = kept.iter().position(|k| k.start.as_ptr() == Arc::as_ptr(start)).unwrap_or_else(|| {
            kept.retain(|k| k.start.strong_count() > 0);
            let flight = Flight::start(EpisodeRng::clone(start));
            kept.push(Kept { start: Arc::downgrade(start), steps: 0, flight });
            kept.len() - 1
        });
        let Kept { steps, flight, .. } = &mut kept[at];
        for thrust in &thrusts[*steps..] {
            flight.step(*thrust);
        }
        *steps = thrusts.len();
        flight.now()
    })
}

/// Drops this thread's copy of an episode. Copies on other threads go when those start another one, or end.
pub(super) fn forget(start: &Start) {
    // At the end of a thread its copies may be gone already.
    let _ = KEPT.try_with(|kept| kept.borrow_mut().retain(|k| k.start.as_ptr() != Arc::as_ptr(start)));
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kept() -> usize {
        KEPT.with_borrow(Vec::len)
    }

    #[test]
    fn a_thread_flies_again_what_another_began() {
        let start = Arc::new(EpisodeRng::from_seed(5));
        let mut thrusts: Vec<Thrust> =
            (0..60).map(|i| Thrust { main: f64::from(i % 2), side: f64::from(i % 3 - 1) }).collect();
        let here = advance(&start, &thrusts);
        std::thread::scope(|scope| {
            scope.spawn(|| assert_eq!(advance(&start, &thrusts), here)).join().expect("the same on another thread");
        });
        // And it goes on from where this thread's copy is.
        thrusts.push(Thrust::default());
        let there = std::thread::scope(|scope| scope.spawn(|| advance(&start, &thrusts)).join());
        assert_eq!(advance(&start, &thrusts), there.expect("no panic"));
    }

    #[test]
    fn copies_do_not_pile_up() {
        let before = kept();
        for seed in 0..20 {
            advance(&Arc::new(EpisodeRng::from_seed(seed)), &[]);
        }
        assert!(kept() <= before + 1, "ended episodes go when the next begins");
        let start = Arc::new(EpisodeRng::from_seed(1));
        advance(&start, &[]);
        let with = kept();
        forget(&start);
        assert_eq!(kept(), with - 1);
    }
}
