//! Drawing of the lander over its terrain.

use super::scene::{Paint, Scene};
use crate::lunar::{
    flight::Reading,
    plant::{HEIGHT, HULL, LEG, Pose, SCALE, WIDTH},
};

/// Upper end of the view: the lander starts at [`HEIGHT`], m.
const TOP: f64 = HEIGHT + 1.7;
/// Length of the main engine's flame at full power, m, and of a side engine's.
const FLAMES: [f64; 2] = [1.3, 0.6];

/// A point of a body in the world, m.
fn placed(pose: &Pose, [x, y]: [f64; 2]) -> [f64; 2] {
    let (sin, cos) = f64::from(pose.angle).sin_cos();
    let [px, py] = pose.position.map(f64::from);
    [px + cos * x - sin * y, py + sin * x + cos * y]
}

/// Terrain with the pad between two flags, flames, legs (those on the ground marked) and hull.
pub(crate) fn lander(reading: &Reading) -> Scene {
    let mut scene = Scene::new([0.0, WIDTH], [0.0, TOP]);
    let mut ground = reading.terrain.to_vec();
    ground.extend([[WIDTH, 0.0], [0.0, 0.0]]);
    scene.area(&ground, Paint::Tile).line(&reading.terrain, 0.06, Paint::Mark);
    let pad = &reading.terrain[4..=6];
    scene.line(pad, 0.14, Paint::Goal);
    for [x, y] in [pad[0], pad[2]] {
        scene.line(&[[x, y], [x, y + 1.6]], 0.06, Paint::Outline);
        scene.area(&[[x, y + 1.65], [x, y + 1.15], [x + 0.8, y + 1.4]], Paint::Goal);
    }
    let at = |x: f64, y: f64| placed(&reading.lander, [x / SCALE, y / SCALE]);
    if reading.thrust.main > 0.0 {
        let length = FLAMES[0] * reading.thrust.main * SCALE;
        scene.area(&[at(-6.0, -10.0), at(6.0, -10.0), at(0.0, -10.0 - length)], Paint::Accent);
    }
    if reading.thrust.side != 0.0 {
        // The engine on the left pushes to the right.
        let out = -reading.thrust.side.signum();
        let length = FLAMES[1] * reading.thrust.side.abs() * SCALE;
        scene.area(&[at(out * 14.0, 15.0), at(out * 15.0, 9.0), at(out * (15.0 + length), 12.0)], Paint::Accent);
    }
    for (leg, touches) in reading.legs.iter().zip(reading.touch.legs) {
        let [w, h] = LEG.map(|v| v / SCALE);
        let paint = if touches { Paint::Goal } else { Paint::Limb };
        let corners = |grow: f64| {
            let (w, h) = (w + grow, h + grow);
            [[-w, -h], [w, -h], [w, h], [-w, h]].map(|corner| placed(leg, corner))
        };
        scene.area(&corners(0.04), Paint::Outline).area(&corners(0.0), paint);
    }
    let paint = if reading.touch.hull { Paint::Accent } else { Paint::Body };
    let mut outline = HULL.map(|[x, y]| at(x, y)).to_vec();
    scene.area(&outline, paint);
    outline.push(outline[0]);
    scene.line(&outline, 0.08, Paint::Outline);
    scene
}
