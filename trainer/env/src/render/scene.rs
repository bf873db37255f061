//! A drawing as a list of shapes, painted in order.

/// What a shape stands for, which gives its colour.
///
/// The colours of things are those of Okabe and Ito, which people with any common colour blindness tell apart; grounds
/// and marks are greys.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Paint {
    /// Background.
    Ground,
    /// Floor, and inside of a field.
    Floor,
    /// Every other tile of the floor.
    Tile,
    /// Rails, axes, walls, distance marks.
    Mark,
    /// Outline of a body.
    Outline,
    /// Torso, cart, agent.
    Body,
    /// Limbs, pole.
    Limb,
    /// Limbs of the other side.
    OtherLimb,
    /// What is to be reached.
    Goal,
    /// Velocity, the active state, what failed.
    Accent,
}

impl Paint {
    /// All paints.
    pub const ALL: [Self; 10] = [
        Self::Ground,
        Self::Floor,
        Self::Tile,
        Self::Mark,
        Self::Outline,
        Self::Body,
        Self::Limb,
        Self::OtherLimb,
        Self::Goal,
        Self::Accent,
    ];

    /// Red, green, blue.
    pub const fn rgb(self) -> [u8; 3] {
        match self {
            Self::Ground => [0xfb, 0xfb, 0xfa],
            Self::Floor => [0xe9, 0xec, 0xef],
            Self::Tile => [0xd5, 0xda, 0xdf],
            Self::Mark => [0x7d, 0x86, 0x8f],
            Self::Outline => [0x24, 0x29, 0x2f],
            // Source: Okabe and Ito 2008, "Color universal design": blue, orange, reddish purple, bluish green, vermilion.
            Self::Body => [0x00, 0x72, 0xb2],
            Self::Limb => [0xe6, 0x9f, 0x00],
            Self::OtherLimb => [0xcc, 0x79, 0xa7],
            Self::Goal => [0x00, 0x9e, 0x73],
            Self::Accent => [0xd5, 0x5e, 0x00],
        }
    }
}

/// The part of the plane that a picture shows, in the scene's units; y points up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Left and right end.
    pub x: [f64; 2],
    /// Lower and upper end.
    pub y: [f64; 2],
}

impl View {
    /// Width over height.
    pub fn aspect(&self) -> f64 {
        (self.x[1] - self.x[0]) / (self.y[1] - self.y[0])
    }
}

/// One shape, in the scene's units.
#[derive(Clone, Debug, PartialEq)]
pub enum Shape {
    /// A filled circle.
    Disc {
        /// Centre.
        center: [f64; 2],
        /// Radius.
        radius: f64,
        /// Colour.
        paint: Paint,
    },
    /// A line of this width with round ends and corners.
    Line {
        /// Points, at least two.
        points: Vec<[f64; 2]>,
        /// Width.
        width: f64,
        /// Colour.
        paint: Paint,
    },
    /// A filled polygon.
    Area {
        /// Corners, at least three.
        points: Vec<[f64; 2]>,
        /// Colour.
        paint: Paint,
    },
}

/// A drawing of one state of an environment.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// What the picture shows.
    pub view: View,
    /// Shapes; later ones cover earlier ones.
    pub shapes: Vec<Shape>,
}

/// The seven segments of a digit, as pairs of corners: 0 and 1 at the top, 2 and 3 in the middle, 4 and 5 at the bottom.
const SEGMENTS: [[usize; 2]; 7] = [[0, 1], [1, 3], [3, 5], [5, 4], [4, 2], [2, 0], [2, 3]];
/// Segments of the digits, bit 0 first.
const DIGITS: [u8; 10] = [0x3F, 0x06, 0x5B, 0x4F, 0x66, 0x6D, 0x7D, 0x07, 0x7F, 0x6F];

impl Scene {
    /// An empty ground.
    pub fn new(x: [f64; 2], y: [f64; 2]) -> Self {
        let mut scene = Self { view: View { x, y }, shapes: Vec::new() };
        scene.rectangle(x, y, Paint::Ground);
        scene
    }

    /// Adds a filled circle.
    pub fn disc(&mut self, center: [f64; 2], radius: f64, paint: Paint) -> &mut Self {
        self.shapes.push(Shape::Disc { center, radius, paint });
        self
    }

    /// Adds a line with round ends.
    pub fn line(&mut self, points: &[[f64; 2]], width: f64, paint: Paint) -> &mut Self {
        self.shapes.push(Shape::Line { points: points.to_vec(), width, paint });
        self
    }

    /// Adds a filled polygon.
    pub fn area(&mut self, points: &[[f64; 2]], paint: Paint) -> &mut Self {
        self.shapes.push(Shape::Area { points: points.to_vec(), paint });
        self
    }

    /// Adds a filled rectangle with sides along the axes.
    pub fn rectangle(&mut self, x: [f64; 2], y: [f64; 2], paint: Paint) -> &mut Self {
        self.area(&[[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]], paint)
    }

    /// Adds a circle that is not filled.
    pub fn ring(&mut self, center: [f64; 2], radius: f64, width: f64, paint: Paint) -> &mut Self {
        let corner = |i: u32| {
            let angle = f64::from(i) / 48.0 * std::f64::consts::TAU;
            [center[0] + radius * angle.cos(), center[1] + radius * angle.sin()]
        };
        let points: Vec<_> = (0..=48).map(corner).collect();
        self.line(&points, width, paint)
    }

    /// Adds a capsule (a disc where both ends are the same) with an outline.
    pub fn capsule(&mut self, ends: [[f64; 2]; 2], radius: f64, paint: Paint) -> &mut Self {
        let outline = 0.012 * (self.view.y[1] - self.view.y[0]);
        if ends[0] == ends[1] {
            return self.disc(ends[0], radius, Paint::Outline).disc(ends[0], (radius - outline).max(0.0), paint);
        }
        let inner = (2.0 * (radius - outline)).max(0.25 * radius);
        self.line(&ends, 2.0 * radius, Paint::Outline).line(&ends, inner, paint)
    }

    /// Adds an arrow; nothing where it has no length.
    pub fn arrow(&mut self, from: [f64; 2], to: [f64; 2], width: f64, paint: Paint) -> &mut Self {
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        let length = dx.hypot(dy);
        if length < 1e-9 {
            return self;
        }
        let (ux, uy) = (dx / length, dy / length);
        let head = (3.5 * width).min(length);
        let base = [to[0] - head * ux, to[1] - head * uy];
        let side = |s: f64| [base[0] - s * 0.6 * head * uy, base[1] + s * 0.6 * head * ux];
        self.line(&[from, base], width, paint).area(&[to, side(1.0), side(-1.0)], paint)
    }

    /// Adds a number of this height, centred at x, its lower edge at y, in seven segments.
    pub fn number(&mut self, number: i64, at: [f64; 2], height: f64, paint: Paint) -> &mut Self {
        let text = number.to_string();
        let (width, step) = (0.5 * height, 0.8 * height);
        let mut left = at[0] - 0.5 * (step * (text.len() as f64 - 1.0) + width);
        for c in text.chars() {
            let corner = |i: usize| [left + width * (i % 2) as f64, at[1] + height * (1.0 - 0.5 * (i / 2) as f64)];
            let lit = c.to_digit(10).map_or(0x40, |d| DIGITS[d as usize]); // anything else is the minus sign
            for (_, [a, b]) in SEGMENTS.iter().enumerate().filter(|(bit, _)| lit >> bit & 1 == 1) {
                self.line(&[corner(*a), corner(*b)], 0.14 * height, paint);
            }
            left += step;
        }
        self
    }
}
