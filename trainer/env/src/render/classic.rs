//! Drawings of the small tasks with continuous actions.

use super::scene::{Paint, Scene};

/// A pendulum of length 1 m at this angle from upright, counter-clockwise, rad.
pub(crate) fn pendulum(angle: f64) -> Scene {
    let mut scene = Scene::new([-1.4, 1.4], [-1.4, 1.4]);
    let tip = [-angle.sin(), angle.cos()];
    scene
        .ring([0.0, 0.0], 1.0, 0.012, Paint::Tile)
        .line(&[[0.0, 1.1], [0.0, 1.25]], 0.03, Paint::Goal)
        .capsule([[0.0, 0.0], tip], 0.11, Paint::Limb)
        .disc([0.0, 0.0], 0.05, Paint::Outline);
    scene
}

/// The ring of four states, the active one (0..4) filled.
pub(crate) fn toy(active: usize) -> Scene {
    let mut scene = Scene::new([-1.5, 1.5], [-1.5, 1.5]);
    let at = |i: usize| [[-0.9, 0.9], [0.9, 0.9], [0.9, -0.9], [-0.9, -0.9]][i % 4];
    for i in 0..4 {
        let (from, to) = (at(i), at(i + 1));
        let part = |share: f64| [from[0] + share * (to[0] - from[0]), from[1] + share * (to[1] - from[1])];
        scene.arrow(part(0.24), part(0.76), 0.03, Paint::Mark);
    }
    for i in 0..4 {
        let paint = match (i == active, i == 3) {
            (true, _) => Paint::Accent,
            (false, true) => Paint::Goal,
            (false, false) => Paint::Floor,
        };
        scene.disc(at(i), 0.36, Paint::Outline).disc(at(i), 0.33, paint);
        let ink = if paint == Paint::Floor { Paint::Outline } else { Paint::Ground };
        scene.number(i as i64 + 1, [at(i)[0], at(i)[1] - 0.14], 0.28, ink);
    }
    scene
}
