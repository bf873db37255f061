//! Drawings of MuJoCo bodies from the positions of their geoms.
//!
//! Bodies in a plane are seen exactly from the side; those in space from the side and a little from above and behind, in
//! parallel projection. The camera follows the torso; tiles and numbers (metres) on the floor show how far it came.

use super::scene::{Paint, Scene};

/// Shape of a geom. The models of this crate have no other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Form {
    /// The floor.
    Plane,
    /// Half of the length of the axis; 0 for a sphere.
    Capsule {
        /// Half of the length between the centres of the two ends, m.
        half: f64,
        /// Radius, m.
        radius: f64,
    },
}

/// One geom where it is now.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Geom {
    pub(crate) form: Form,
    /// Centre, m.
    pub(crate) center: [f64; 3],
    /// Unit vector of the capsule's axis.
    pub(crate) axis: [f64; 3],
    pub(crate) paint: Paint,
}

/// A body as far as it is seen.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Figure {
    pub(crate) geoms: Vec<Geom>,
    /// Position of the first body, which the camera follows, m.
    pub(crate) torso: [f64; 3],
    /// Moves freely in space.
    pub(crate) in_space: bool,
}

/// Width and height of the view, m.
const VIEW: [f64; 2] = [3.6, 2.1];
/// Lower end of the view of a body on a floor, m.
const BELOW: f64 = -0.35;
/// Height of the torso from which on the camera rises with it, m.
const RISE: f64 = 1.45;
/// How far the view is turned around the vertical, rad, and how far it looks down, rad, for bodies in space.
const TURN: f64 = 0.35;
const LOOK_DOWN: f64 = 0.32;
/// Depth of the visible floor on both sides of the torso, tiles of 1 m.
const DEPTH: i32 = 3;

struct Camera {
    origin: [f64; 2],
    turn: (f64, f64),
    down: (f64, f64),
}

impl Camera {
    /// Coordinates on the picture, and depth (larger is farther).
    fn see(&self, p: [f64; 3]) -> ([f64; 2], f64) {
        let (x, y) = (p[0] - self.origin[0], p[1] - self.origin[1]);
        let (sin, cos) = self.turn;
        let (right, depth) = (x * cos - y * sin, x * sin + y * cos);
        let (sin, cos) = self.down;
        ([right, p[2] * cos + depth * sin], depth * cos - p[2] * sin)
    }
}

/// The drawing.
pub(crate) fn body(figure: &Figure) -> Scene {
    let [x, y, z] = figure.torso.map(|v| if v.is_finite() { v.clamp(-1e6, 1e6) } else { 0.0 });
    let on_floor = figure.geoms.iter().any(|g| g.form == Form::Plane);
    let mut scene = if on_floor {
        let low = BELOW + (z - RISE).max(0.0);
        Scene::new([-0.5 * VIEW[0], 0.5 * VIEW[0]], [low, low + VIEW[1]])
    } else {
        Scene::new([-1.3, 1.3], [-0.45, 0.95]) // a cart on a rail of 1 m to both sides
    };
    let camera = Camera {
        origin: if on_floor { [x, if figure.in_space { y } else { 0.0 }] } else { [0.0, 0.0] },
        turn: if figure.in_space { TURN.sin_cos() } else { (0.0, 1.0) },
        down: if figure.in_space { LOOK_DOWN.sin_cos() } else { (0.0, 1.0) },
    };
    match (on_floor, figure.in_space) {
        (true, true) => floor_in_space(&mut scene, &camera),
        (true, false) => floor_from_the_side(&mut scene, x),
        (false, _) => {}
    }
    let ends = |g: &Geom| {
        let half = if let Form::Capsule { half, .. } = g.form { half } else { 0.0 };
        [1.0, -1.0].map(|s| [0, 1, 2].map(|i| g.center[i] + s * half * g.axis[i]))
    };
    let mut geoms: Vec<&Geom> = figure.geoms.iter().filter(|g| g.form != Form::Plane).collect();
    geoms.sort_by(|a, b| camera.see(b.center).1.total_cmp(&camera.see(a.center).1));
    for geom in geoms {
        if let Form::Capsule { radius, .. } = geom.form {
            scene.capsule(ends(geom).map(|p| camera.see(p).0), radius, geom.paint);
        }
    }
    scene
}

/// The floor as a strip of tiles of 1 m, with the distance under every second one.
fn floor_from_the_side(scene: &mut Scene, x: f64) {
    let [left, right] = scene.view.x;
    let low = scene.view.y[0];
    if low >= 0.0 {
        return;
    }
    scene.rectangle([left, right], [low, 0.0], Paint::Floor);
    for metre in (x + left).floor() as i64..=(x + right).ceil() as i64 {
        let at = metre as f64 - x;
        if metre.rem_euclid(2) == 0 {
            scene.rectangle([at, at + 1.0], [low, 0.0], Paint::Tile);
        }
        scene.line(&[[at, 0.0], [at, -0.06]], 0.012, Paint::Mark);
        scene.number(metre, [at, -0.24], 0.12, Paint::Mark);
    }
    scene.line(&[[left, 0.0], [right, 0.0]], 0.015, Paint::Mark);
}

/// The floor as a chess board of tiles of 1 m around the torso, with the distance along x on the front row.
fn floor_in_space(scene: &mut Scene, camera: &Camera) {
    let [ox, oy] = camera.origin.map(|v| v.floor() as i64);
    let on_floor = |x: i64, y: i64| camera.see([x as f64, y as f64, 0.0]).0;
    for x in ox - 4..=ox + 4 {
        for y in oy - i64::from(DEPTH)..=oy + i64::from(DEPTH) {
            let paint = if (x + y).rem_euclid(2) == 0 { Paint::Tile } else { Paint::Floor };
            scene.area(&[on_floor(x, y), on_floor(x + 1, y), on_floor(x + 1, y + 1), on_floor(x, y + 1)], paint);
        }
    }
    for x in ox - 4..=ox + 4 {
        let [at, _] = on_floor(x, oy - 1);
        scene.number(x, [at, scene.view.y[0] + 0.06], 0.12, Paint::Mark);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::Shape;

    fn figure(torso: [f64; 3], in_space: bool) -> Figure {
        let capsule = Geom {
            form: Form::Capsule { half: 0.2, radius: 0.05 },
            center: torso,
            axis: [0.0, 0.0, 1.0],
            paint: Paint::Body,
        };
        let floor = Geom { form: Form::Plane, center: [0.0; 3], axis: [0.0, 0.0, 1.0], paint: Paint::Floor };
        Figure { geoms: vec![floor, capsule], torso, in_space }
    }

    fn body_line(scene: &Scene) -> Vec<[f64; 2]> {
        let found = scene.shapes.iter().find_map(|s| match s {
            Shape::Line { points, paint: Paint::Body, .. } => Some(points.clone()),
            _ => None,
        });
        found.unwrap()
    }

    #[test]
    fn the_side_view_keeps_lengths_and_follows_the_torso() {
        for x in [0.0, 7.25, -3.0] {
            let line = body_line(&body(&figure([x, 0.0, 1.2], false)));
            assert_eq!(line, [[0.0, 1.4], [0.0, 1.0]]);
        }
        let high = body(&figure([0.0, 0.0, 3.45], false));
        assert_eq!(high.view.y, [BELOW + 2.0, BELOW + 2.0 + VIEW[1]]);
    }

    #[test]
    fn numbers_that_are_none_do_not_break_a_drawing() {
        for in_space in [false, true] {
            let scene = body(&figure([f64::NAN, f64::INFINITY, 1.0], in_space));
            assert!(scene.to_svg(100).ends_with("</svg>\n"));
        }
    }
}
