//! ToyDataset: actions as an offline learner gets them for ToyEnv, which fill a small square of the plane in every state and nothing
//! outside of it.
//!
//! Source: the GADM paper, appendix A.7 (squares, uniform draws, 5,000 actions a state; A.6.1 says 4,096).

use crate::sampling::EpisodeRng;

/// Lower left corner of the square of each state, in the environment's units.
const CORNERS: [[f64; 2]; 4] = [[0.75, 0.75], [2.875, 0.75], [0.75, 2.875], [2.875, 2.875]];
/// Side of the squares.
const SIDE: f64 = 0.375;

/// Ends of the square of state `state` (0 to 3) along x and y, normalised to -1..1 as the networks see actions.
///
/// # Panics
/// Beyond state 3.
pub fn toy_square(state: usize) -> [[f64; 2]; 2] {
    CORNERS[state].map(|low| [low, low + SIDE].map(|end| end / 2.0 - 1.0))
}

/// `per_state` actions for each state, drawn uniformly from its square: observations (`4 per_state x 4`, one-hot) and normalised
/// actions (`4 per_state x 2`), state by state.
#[must_use]
pub fn toy_dataset(per_state: usize, seed: u64) -> (Vec<f32>, Vec<f32>) {
    let mut rng = EpisodeRng::from_seed(seed);
    let (mut obs, mut actions) = (Vec::with_capacity(16 * per_state), Vec::with_capacity(8 * per_state));
    for state in 0..CORNERS.len() {
        for _ in 0..per_state {
            obs.extend((0..CORNERS.len()).map(|i| f32::from(u8::from(i == state))));
            actions.extend(toy_square(state).map(|[low, high]| rng.uniform(low, high) as f32));
        }
    }
    (obs, actions)
}

#[cfg(test)]
mod tests {
    use super::super::toy_env::THRESHOLDS;
    use super::*;

    #[test]
    fn the_squares_are_those_of_the_specification_around_the_thresholds() {
        assert_eq!(toy_square(0), [[-0.625, -0.4375], [-0.625, -0.4375]]);
        assert_eq!(toy_square(1), [[0.4375, 0.625], [-0.625, -0.4375]]);
        assert_eq!(toy_square(2), [[-0.625, -0.4375], [0.4375, 0.625]]);
        assert_eq!(toy_square(3), [[0.4375, 0.625], [0.4375, 0.625]]);
        for (state, threshold) in THRESHOLDS.into_iter().enumerate() {
            let [_, [low, high]] = toy_square(state);
            assert_eq!(f64::midpoint(low, high), threshold / 2.0 - 1.0);
        }
    }

    #[test]
    fn actions_fill_the_square_of_their_state_and_follow_the_seed() {
        let (obs, actions) = toy_dataset(500, 3);
        assert_eq!((obs.len(), actions.len()), (2000 * 4, 2000 * 2));
        for (row, (o, a)) in obs.chunks_exact(4).zip(actions.chunks_exact(2)).enumerate() {
            let state = row / 500;
            assert!(o.iter().enumerate().all(|(i, &v)| v == f32::from(u8::from(i == state))));
            let inside = toy_square(state).iter().zip(a).all(|(end, &v)| (end[0]..=end[1]).contains(&f64::from(v)));
            assert!(inside, "row {row}: {a:?}");
        }
        let mean = actions[..1000].iter().map(|&v| f64::from(v)).sum::<f64>() / 1000.0;
        assert!((mean + 0.53125).abs() < 0.006, "{mean}: standard error 0.0017");
        assert_eq!(actions, toy_dataset(500, 3).1);
        assert_ne!(actions, toy_dataset(500, 4).1);
    }
}
