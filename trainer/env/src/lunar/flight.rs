//! One episode: engines, their scatter, observation, reward and end.

use super::plant::{
    HEIGHT, HEIGHTS, LEG_DOWN, PAD_HEIGHT, POINTS, Plant, Pose, SCALE, STEPS_PER_S, Touch, WIDTH, terrain,
};
use crate::{
    sampling::EpisodeRng,
    task::{Draws, Outcome},
};

/// Impulse of the main engine at full power for a metre of its lever, N s/m.
const MAIN_POWER: f64 = 13.0;
/// The same of the side engines.
const SIDE_POWER: f64 = 0.6;
/// Distance of the main engine below the lander's origin, m times [`SCALE`].
const MAIN_DOWN: f64 = 4.0;
/// Distance of the side engines to the sides and above, m times [`SCALE`].
const SIDE_AWAY: f64 = 12.0;
const SIDE_UP: f64 = 14.0;
/// What the reference has in the place of [`SIDE_UP`] in x.
const SIDE_UP_IN_X: f64 = 17.0;
/// Largest force of the push at the start, N.
const START_FORCE: f64 = 1000.0;

/// Heights, push, and the scatter of the reset's step and of each other one.
pub(super) const DRAWS: Draws = Draws { at_reset: HEIGHTS + 2 + 2, per_step: 2 };

/// What the engines do in a step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Thrust {
    /// Power of the main engine: 0 or 0.5..=1.
    pub(crate) main: f64,
    /// Power of the side engine that pushes towards +x, negative for the other: 0 or 0.5..=1 in size.
    pub(crate) side: f64,
}

/// All that is seen of an episode from outside.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Reading {
    pub(crate) terrain: [[f64; 2]; POINTS],
    pub(crate) lander: Pose,
    /// +x side first.
    pub(crate) legs: [Pose; 2],
    pub(crate) touch: Touch,
    /// Engines in the last step.
    pub(crate) thrust: Thrust,
    pub(crate) shaping: f64,
}

impl Reading {
    /// The observation before it is rounded to f32.
    pub(super) fn observation(&self) -> [f64; 8] {
        let Pose { position, angle, velocity, angular_velocity, .. } = self.lander;
        let [x, y] = position.map(f64::from);
        let [vx, vy] = velocity.map(f64::from);
        let flag = |leg: usize| f64::from(u8::from(self.touch.legs[leg]));
        [
            (x - WIDTH / 2.0) / (WIDTH / 2.0),
            (y - (PAD_HEIGHT + LEG_DOWN / SCALE)) / (HEIGHT / 2.0),
            vx * (WIDTH / 2.0) / STEPS_PER_S,
            vy * (HEIGHT / 2.0) / STEPS_PER_S,
            f64::from(angle),
            20.0 * f64::from(angular_velocity) / STEPS_PER_S,
            flag(0),
            flag(1),
        ]
    }
}

/// Nearness to the pad, at rest, upright and on the legs. Its gain is the reward of a step, engines apart.
pub(super) fn shaping(o: &[f64; 8]) -> f64 {
    -100.0 * (o[0] * o[0] + o[1] * o[1]).sqrt() - 100.0 * (o[2] * o[2] + o[3] * o[3]).sqrt() - 100.0 * o[4].abs()
        + 10.0 * o[6]
        + 10.0 * o[7]
}

/// A running episode.
pub(super) struct Flight {
    plant: Plant,
    rng: EpisodeRng,
    reading: Reading,
    outcome: Outcome,
}

impl Flight {
    /// Draws the terrain and the push, and makes the reset's step without engines.
    pub(super) fn start(mut rng: EpisodeRng) -> Self {
        let mut heights = [0.0; HEIGHTS];
        heights.fill_with(|| rng.uniform(0.0, HEIGHT / 2.0));
        let force = [(); 2].map(|()| rng.uniform(-START_FORCE, START_FORCE));
        let reading = Reading { terrain: terrain(&heights), ..Reading::default() };
        let outcome = Outcome { reward: 0.0, terminated: false };
        let mut flight = Self { plant: Plant::new(&heights, force), rng, reading, outcome };
        flight.step(Thrust::default());
        flight
    }

    /// What can be seen now, and what the last step gave; that of the reset means nothing.
    pub(super) fn now(&self) -> (Reading, Outcome) {
        (self.reading, self.outcome)
    }

    /// One control period with these engines.
    pub(super) fn step(&mut self, thrust: Thrust) {
        self.fire(thrust);
        self.plant.step();
        let (lander, legs) = self.plant.poses();
        let before = self.reading.shaping;
        self.reading = Reading { lander, legs, touch: self.plant.touch(), thrust, ..self.reading };
        let observation = self.reading.observation();
        self.reading.shaping = shaping(&observation);
        let gain = self.reading.shaping - before;
        self.outcome = judge(&self.reading, &observation, gain);
    }

    /// The engines' impulses. Their directions scatter, by draws that are made with and without engines.
    fn fire(&mut self, Thrust { main, side }: Thrust) {
        let angle = self.plant.angle();
        let tip = [angle.sin(), angle.cos()];
        let across = [-tip[1], tip[0]];
        let scatter = [(); 2].map(|()| self.rng.uniform(-1.0, 1.0) / SCALE);
        // Read before both impulses: they change speeds, not positions.
        let at = self.plant.position();
        if main > 0.0 {
            let down = MAIN_DOWN / SCALE + 2.0 * scatter[0];
            let lever = [tip[0] * down + across[0] * scatter[1], -tip[1] * down - across[1] * scatter[1]];
            let impulse = lever.map(|v| -v * MAIN_POWER * main);
            self.plant.push(impulse, [at[0] + lever[0], at[1] + lever[1]]);
        }
        if side != 0.0 {
            let away = 3.0 * scatter[1] + side.signum() * SIDE_AWAY / SCALE;
            let lever = [tip[0] * scatter[0] + across[0] * away, -tip[1] * scatter[0] - across[1] * away];
            let impulse = lever.map(|v| -v * SIDE_POWER * side.abs());
            let point = [at[0] + lever[0] - tip[0] * SIDE_UP_IN_X / SCALE, at[1] + lever[1] + tip[1] * SIDE_UP / SCALE];
            self.plant.push(impulse, point);
        }
    }
}

/// Reward and end of a step that gained so much shaping.
fn judge(reading: &Reading, observation: &[f64; 8], gain: f64) -> Outcome {
    let Thrust { main, side } = reading.thrust;
    if !reading.lander.awake {
        // At rest, wherever and however that is.
        return Outcome { reward: 100.0, terminated: true };
    }
    if reading.touch.hull || observation[0].abs() >= 1.0 {
        return Outcome { reward: -100.0, terminated: true };
    }
    Outcome { reward: gain - main * 0.3 - side.abs() * 0.03, terminated: false }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reading() -> Reading {
        let lander = Pose { awake: true, ..Pose::default() };
        Reading { lander, ..Reading::default() }
    }

    #[test]
    fn rewards_and_ends_by_hand() {
        let thrust = Thrust { main: 1.0, side: -0.5 };
        let flying = Reading { thrust, ..reading() };
        let middle = [0.0; 8];
        assert_eq!(judge(&flying, &middle, 2.0), Outcome { reward: 2.0 - 0.3 - 0.015, terminated: false });
        let crashed = Reading { touch: Touch { hull: true, ..Touch::default() }, ..flying };
        assert_eq!(judge(&crashed, &middle, 2.0), Outcome { reward: -100.0, terminated: true });
        for x in [-1.0, 1.0] {
            let outside = [x, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
            assert_eq!(judge(&flying, &outside, 2.0), Outcome { reward: -100.0, terminated: true });
        }
        let asleep = Reading { lander: Pose { awake: false, ..flying.lander }, ..crashed };
        assert_eq!(judge(&asleep, &middle, 2.0), Outcome { reward: 100.0, terminated: true }, "rest wins");
    }

    #[test]
    fn shaping_and_observation_by_hand() {
        assert_eq!(shaping(&[0.6, 0.8, 0.3, -0.4, -0.1, 9.0, 1.0, 0.0]), -100.0 - 50.0 - 10.0 + 10.0);
        let lander = Pose {
            position: [15.0, (PAD_HEIGHT + 0.6) as f32],
            angle: 0.25,
            velocity: [5.0, -3.0],
            angular_velocity: 2.5,
            ..Pose::default()
        };
        let touch = Touch { legs: [false, true], ..Touch::default() };
        let o = Reading { lander, touch, ..Reading::default() }.observation();
        assert_eq!([o[0], o[2], o[4], o[5], o[6], o[7]], [0.5, 1.0, 0.25, 1.0, 0.0, 1.0]);
        assert!(o[1].abs() < 1e-7 && (o[3] + 0.4).abs() < 1e-12, "{o:?}");
    }

    #[test]
    fn engines_push_to_their_sides() {
        let after = |thrust| {
            let mut flight = Flight::start(EpisodeRng::from_seed(3));
            for _ in 0..10 {
                flight.step(thrust);
            }
            flight.now().0.lander
        };
        let [still, up, right, left] =
            [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.0, -1.0)].map(|(main, side)| after(Thrust { main, side }));
        assert!(up.velocity[1] > still.velocity[1] + 1.0, "{up:?} {still:?}");
        assert!(left.velocity[0] < still.velocity[0] && still.velocity[0] < right.velocity[0]);
        assert!(left.angular_velocity > still.angular_velocity && still.angular_velocity > right.angular_velocity);
    }
}
