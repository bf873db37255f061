//! Lander, legs and ground in Box2D. Single precision, as the engine has it.

use std::{cell::Cell, rc::Rc, sync::Once};

use wrapped2d::{
    b2,
    dynamics::world::callbacks::ContactAccess,
    user_data::{UserData, UserDataTypes},
};

/// Units of the reference's drawing per metre, in which its sizes are written.
pub(crate) const SCALE: f64 = 30.0;
/// Width of the view, m.
pub(crate) const WIDTH: f64 = 600.0 / SCALE;
/// Height of the view, m.
pub(crate) const HEIGHT: f64 = 400.0 / SCALE;
/// Height of the pad, m.
pub(crate) const PAD_HEIGHT: f64 = HEIGHT / 4.0;
/// Points of the terrain.
pub(crate) const POINTS: usize = 11;
/// Draws of heights: one more than points.
pub(crate) const HEIGHTS: usize = POINTS + 1;
/// Control steps per second.
pub(crate) const STEPS_PER_S: f64 = 50.0;
/// From the middle of the lander down to the feet, m times [`SCALE`].
pub(crate) const LEG_DOWN: f64 = 18.0;
/// Outline of the lander around its origin, m times [`SCALE`].
pub(crate) const HULL: [[f64; 2]; 6] =
    [[-14.0, 17.0], [-17.0, 0.0], [-17.0, -10.0], [17.0, -10.0], [17.0, 0.0], [14.0, 17.0]];
/// Half width and half height of a leg, m times [`SCALE`].
pub(crate) const LEG: [f64; 2] = [2.0, 8.0];

/// Sideways distance of a leg's middle from the lander's, m times [`SCALE`].
const LEG_AWAY: f64 = 20.0;
/// Angle at which a leg starts, to its side, rad.
const LEG_ANGLE: f64 = 0.05;
/// Torque with which a leg's spring holds, N m.
const LEG_TORQUE: f32 = 40.0;
/// Iterations of the solver for velocities and positions.
const ITERATIONS: (i32, i32) = (180, 60);

/// Position and motion of a body.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Pose {
    /// Origin, m.
    pub(crate) position: [f32; 2],
    /// rad, counter-clockwise.
    pub(crate) angle: f32,
    /// Of the centre of mass, m/s.
    pub(crate) velocity: [f32; 2],
    /// rad/s.
    pub(crate) angular_velocity: f32,
    /// Centre of mass, m.
    pub(crate) center: [f32; 2],
    /// Not put to rest by the engine.
    pub(crate) awake: bool,
}

/// What has been touched.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Touch {
    /// Flags of the legs (+x side first): set by a beginning contact, cleared by any ending one.
    pub(crate) legs: [bool; 2],
    /// The lander's hull touched something in this episode.
    pub(crate) hull: bool,
    /// Anything touched something in this episode.
    pub(crate) any: bool,
}

/// What a body is, told to the listener by Box2D.
#[derive(Clone, Copy)]
enum Part {
    Ground,
    Hull,
    Leg(usize),
}

/// The engine's user data: bodies know their part.
struct Parts;

impl UserDataTypes for Parts {
    type BodyData = Part;
    type JointData = ();
    type FixtureData = ();
}

/// Writes contacts down.
struct Listener(Rc<Cell<Touch>>);

impl Listener {
    fn note(&self, contact: &ContactAccess<Parts>, begins: bool) {
        let mut touch = self.0.get();
        touch.any |= begins;
        for part in [contact.body_a.user_data(), contact.body_b.user_data()] {
            match part {
                Part::Ground => {}
                Part::Hull => touch.hull |= begins,
                Part::Leg(i) => touch.legs[*i] = begins,
            }
        }
        self.0.set(touch);
    }
}

impl b2::ContactListener<Parts> for Listener {
    fn begin_contact(&mut self, contact: ContactAccess<Parts>) {
        self.note(&contact, true);
    }

    fn end_contact(&mut self, contact: ContactAccess<Parts>) {
        self.note(&contact, false);
    }
}

/// One world. It stays on the thread that made it.
pub(super) struct Plant {
    world: b2::World<Parts>,
    lander: b2::BodyHandle,
    legs: [b2::BodyHandle; 2],
    touch: Rc<Cell<Touch>>,
}

impl Plant {
    /// The lander above the terrain of these draws, with a force (N) at its centre that acts during the first step.
    pub(super) fn new(heights: &[f64; HEIGHTS], force: [f64; 2]) -> Self {
        fill_tables();
        let mut world = b2::World::new(&vector([0.0, -10.0]));
        let touch = Rc::new(Cell::new(Touch::default()));
        world.set_contact_listener(Box::new(Listener(Rc::clone(&touch))));

        let ground = world.create_body_with(&b2::BodyDef::new(), Part::Ground);
        edge(&world, ground, [[0.0, 0.0], [WIDTH, 0.0]], 0.2);
        for ends in terrain(heights).windows(2) {
            edge(&world, ground, [ends[0], ends[1]], 0.1);
        }

        let start = [WIDTH / 2.0, HEIGHT];
        let lander = dynamic(&mut world, start, 0.0, Part::Hull);
        let hull = HULL.map(|corner| vector(corner.map(|v| v / SCALE)));
        fixture(&world, lander, &b2::PolygonShape::new_with(&hull), [5.0, 0.1], 0x10);
        world.body_mut(lander).apply_force_to_center(&vector(force), true);
        let legs = [-1.0, 1.0].map(|side| leg(&mut world, lander, start, side));
        Self { world, lander, legs, touch }
    }

    /// Where the lander is, m.
    pub(super) fn position(&self) -> [f64; 2] {
        let body = self.world.body(self.lander);
        [body.position().x, body.position().y].map(f64::from)
    }

    /// Its angle, rad.
    pub(super) fn angle(&self) -> f64 {
        f64::from(self.world.body(self.lander).angle())
    }

    /// An impulse (N s) on the lander at a point of the world (m).
    pub(super) fn push(&mut self, impulse: [f64; 2], point: [f64; 2]) {
        self.world.body_mut(self.lander).apply_linear_impulse(&vector(impulse), &vector(point), true);
    }

    /// One control period.
    pub(super) fn step(&mut self) {
        self.world.step((1.0 / STEPS_PER_S) as f32, ITERATIONS.0, ITERATIONS.1);
    }

    /// Lander and legs.
    pub(super) fn poses(&self) -> (Pose, [Pose; 2]) {
        (self.pose(self.lander), self.legs.map(|leg| self.pose(leg)))
    }

    fn pose(&self, body: b2::BodyHandle) -> Pose {
        let body = self.world.body(body);
        let pair = |v: &b2::Vec2| [v.x, v.y];
        Pose {
            position: pair(body.position()),
            angle: body.angle(),
            velocity: pair(body.linear_velocity()),
            angular_velocity: body.angular_velocity(),
            center: pair(body.world_center()),
            awake: body.is_awake(),
        }
    }

    /// Contacts so far.
    pub(super) fn touch(&self) -> Touch {
        self.touch.get()
    }
}

/// The terrain of these draws, m. Flat at the pad; elsewhere the means of three draws, the last of which also stands before
/// the first.
pub(super) fn terrain(heights: &[f64; HEIGHTS]) -> [[f64; 2]; POINTS] {
    let mut heights = *heights;
    heights[POINTS / 2 - 2..=POINTS / 2 + 2].fill(PAD_HEIGHT);
    std::array::from_fn(|i| {
        let before = heights[(i + HEIGHTS - 1) % HEIGHTS];
        [WIDTH / (POINTS - 1) as f64 * i as f64, 0.33 * (before + heights[i] + heights[i + 1])]
    })
}

/// A vector as the engine has it.
fn vector([x, y]: [f64; 2]) -> b2::Vec2 {
    b2::Vec2 { x: x as f32, y: y as f32 }
}

fn dynamic(world: &mut b2::World<Parts>, position: [f64; 2], angle: f64, part: Part) -> b2::BodyHandle {
    let def = b2::BodyDef {
        body_type: b2::BodyType::Dynamic,
        position: vector(position),
        angle: angle as f32,
        ..b2::BodyDef::new()
    };
    world.create_body_with(&def, part)
}

/// A piece of ground.
fn edge(world: &b2::World<Parts>, ground: b2::BodyHandle, ends: [[f64; 2]; 2], friction: f32) {
    let shape = b2::EdgeShape::new_with(&vector(ends[0]), &vector(ends[1]));
    let mut def = b2::FixtureDef { friction, ..b2::FixtureDef::new() };
    world.body_mut(ground).create_fixture(&shape, &mut def);
}

/// A part of the lander, of this density (kg/m²) and friction, which touches nothing but the ground.
fn fixture(world: &b2::World<Parts>, body: b2::BodyHandle, shape: &b2::PolygonShape, made: [f32; 2], category: u16) {
    let filter = b2::Filter { category_bits: category, mask_bits: 1, ..b2::Filter::new() };
    let [density, friction] = made;
    let mut def = b2::FixtureDef { density, friction, filter, ..b2::FixtureDef::new() };
    world.body_mut(body).create_fixture(shape, &mut def);
}

/// The leg that starts at the +x (`side` -1) or -x (`side` 1) side, on its sprung joint.
fn leg(world: &mut b2::World<Parts>, lander: b2::BodyHandle, start: [f64; 2], side: f64) -> b2::BodyHandle {
    let away = side * LEG_AWAY / SCALE;
    let index = usize::from(side > 0.0);
    let leg = dynamic(world, [start[0] - away, start[1]], side * LEG_ANGLE, Part::Leg(index));
    let shape = b2::PolygonShape::new_box((LEG[0] / SCALE) as f32, (LEG[1] / SCALE) as f32);
    fixture(world, leg, &shape, [1.0, 0.2], 0x20);
    let [lower, upper] = if side < 0.0 { [0.9 - 0.5, 0.9] } else { [-0.9, -0.9 + 0.5] };
    let joint = b2::RevoluteJointDef {
        local_anchor_b: vector([away, LEG_DOWN / SCALE]),
        // The reference's binding takes the angle between the bodies as they are.
        reference_angle: world.body(leg).angle() - world.body(lander).angle(),
        enable_limit: true,
        lower_angle: lower as f32,
        upper_angle: upper as f32,
        enable_motor: true,
        motor_speed: (0.3 * side) as f32,
        max_motor_torque: LEG_TORQUE,
        ..b2::RevoluteJointDef::new(lander, leg)
    };
    world.create_joint(&joint);
    leg
}

/// Box2D fills two tables of the process without a lock: of block sizes at the first world, of collision functions at the
/// first contact. Here one thread does both, before any other can come to them.
fn fill_tables() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let mut world = b2::World::<Parts>::new(&vector([0.0, -10.0]));
        let ground = world.create_body_with(&b2::BodyDef::new(), Part::Ground);
        edge(&world, ground, [[-1.0, 0.0], [1.0, 0.0]], 0.1);
        let body = dynamic(&mut world, [0.0, 0.0], 0.0, Part::Hull);
        fixture(&world, body, &b2::PolygonShape::new_box(0.5, 0.5), [1.0, 0.1], 0x10);
        world.step((1.0 / STEPS_PER_S) as f32, 1, 1);
        assert!(world.contact_count() > 0, "a box on an edge has a contact");
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_terrain_is_flat_at_the_pad_and_wraps_at_the_left() {
        let mut heights = [0.0; HEIGHTS];
        (heights[0], heights[1], heights[11]) = (1.0, 2.0, 6.0);
        let points = terrain(&heights);
        assert_eq!(points[0], [0.0, 0.33 * (6.0 + 1.0 + 2.0)]);
        for (i, x) in [(4, 8.0), (5, 10.0), (6, 12.0)] {
            assert_eq!(points[i], [x, 0.33 * (PAD_HEIGHT + PAD_HEIGHT + PAD_HEIGHT)]);
        }
        assert_eq!(points[10], [20.0, 0.33 * (0.0 + 0.0 + 6.0)]);
    }

    #[test]
    fn masses_are_the_references() {
        let plant = Plant::new(&[1.0; HEIGHTS], [0.0; 2]);
        // Source: `meta` of the recording.
        assert_eq!(plant.world.body(plant.lander).mass(), 4.816_666_6);
        assert_eq!(plant.legs.map(|leg| plant.world.body(leg).mass()), [0.071_111_12; 2]);
    }

    #[test]
    fn without_engines_it_falls_on_its_legs_and_then_its_hull_or_rests() {
        let mut plant = Plant::new(&[0.0; HEIGHTS], [0.0; 2]);
        let mut first = None;
        for n in 1..200 {
            plant.step();
            if plant.touch().any && first.is_none() {
                first = Some((n, plant.touch()));
            }
        }
        let (n, touch) = first.expect("the ground is met");
        // From 13.3 m to the legs' ends on the pad at 3.3 m in free fall: sqrt(2 · 9 m / 10 m/s²) = 1.3 s.
        assert!((60..80).contains(&n) && touch.legs.contains(&true), "{n} {touch:?}");
    }
}
