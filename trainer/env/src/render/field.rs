//! Drawings of the square field: Moving, Sliding, HardMove.

use super::scene::{Paint, Scene};
use crate::hybrid::field::{Field, TARGET_RADIUS};

/// Half of the width that is shown: the field is 1, and an agent that left it is still seen.
const HALF_VIEW: f64 = 1.15;
/// Length of the velocity arrow for 1 m/s, m.
const ARROW: f64 = 0.08;

/// The field with target and agent. `motion` is the direction of the velocity, rad; `actuators` their unit vectors.
pub(crate) fn field(at: &Field, motion: f64, actuators: &[(f64, f64)]) -> Scene {
    let view = [-HALF_VIEW, HALF_VIEW];
    let mut scene = Scene::new(view, view);
    scene.rectangle([-1.0, 1.0], [-1.0, 1.0], Paint::Floor);
    for i in 1..4 {
        let p = -1.0 + 0.5 * f64::from(i);
        scene.line(&[[p, -1.0], [p, 1.0]], 0.006, Paint::Tile).line(&[[-1.0, p], [1.0, p]], 0.006, Paint::Tile);
    }
    let wall = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]];
    scene.line(&wall, 0.02, Paint::Mark);
    let target = [at.target_x, at.target_y];
    let agent = [at.x, at.y].map(|v| v.clamp(-HALF_VIEW, HALF_VIEW));
    scene.disc(target, TARGET_RADIUS, Paint::Goal).disc(target, 0.2 * TARGET_RADIUS, Paint::Ground);
    for (x, y) in actuators {
        scene.line(&[agent, [agent[0] + 0.16 * x, agent[1] + 0.16 * y]], 0.02, Paint::Limb);
    }
    let outside = agent[0].abs() > 1.0 || agent[1].abs() > 1.0;
    let paint = if outside { Paint::Accent } else { Paint::Body };
    if actuators.is_empty() {
        // A triangle in the direction of the heading.
        let corner = |turn: f64, r: f64| {
            let angle = at.theta + turn;
            [agent[0] + r * angle.cos(), agent[1] + r * angle.sin()]
        };
        let tip = |grow: f64| [corner(0.0, 0.11 + grow), corner(2.4, 0.09 + grow), corner(-2.4, 0.09 + grow)];
        scene.area(&tip(0.02), Paint::Outline).area(&tip(0.0), paint);
    } else {
        scene.disc(agent, 0.06, Paint::Outline).disc(agent, 0.048, paint);
    }
    let length = ARROW * at.speed;
    let end = [agent[0] + length * motion.cos(), agent[1] + length * motion.sin()];
    scene.arrow(agent, end, 0.018, Paint::Accent);
    scene
}
