//! A scene as pixels.

use tiny_skia::{Color, FillRule, LineCap, LineJoin, Paint as Ink, Path, PathBuilder, Pixmap, Stroke, Transform};

use super::scene::{Paint, Scene, Shape};

/// A picture: rows from the top, three bytes (red, green, blue) a pixel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pixels {
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `3 · width · height` bytes.
    pub rgb: Vec<u8>,
}

impl Scene {
    /// The scene as a picture of this width (1 to 4096); the height follows from the view.
    pub fn to_pixels(&self, width: u32) -> Pixels {
        let map = self.draw(width);
        let rgb = map.pixels().iter().flat_map(|p| [p.red(), p.green(), p.blue()]).collect();
        Pixels { width: map.width(), height: map.height(), rgb }
    }

    /// As [`to_pixels`](Self::to_pixels), as a PNG file.
    pub fn to_png(&self, width: u32) -> Vec<u8> {
        self.draw(width).encode_png().expect("a picture in memory can be written to memory")
    }

    fn draw(&self, width: u32) -> Pixmap {
        let width = width.clamp(1, 4096);
        let height = self.height_for(width).min(4096);
        let mut map = Pixmap::new(width, height).expect("neither side is zero or beyond 4096");
        map.fill(Color::WHITE);
        let scale = width as f32 / (self.view.x[1] - self.view.x[0]) as f32;
        let at = |p: &[f64; 2]| {
            let point = [(p[0] - self.view.x[0]) as f32 * scale, (self.view.y[1] - p[1]) as f32 * scale];
            // What is not a number or far outside is not seen anyway; the library wants moderate numbers.
            point.map(|v| if v.is_finite() { v.clamp(-1e5, 1e5) } else { -1e5 })
        };
        for shape in &self.shapes {
            match shape {
                Shape::Disc { center, radius, paint } => {
                    let [x, y] = at(center);
                    let radius = *radius as f32 * scale;
                    let path = (radius > 0.0 && radius < 1e5).then(|| PathBuilder::from_circle(x, y, radius));
                    fill(&mut map, path.flatten(), *paint);
                }
                Shape::Area { points, paint } => {
                    fill(&mut map, path(points.iter().map(at), true), *paint);
                }
                Shape::Line { points, width, paint } => {
                    let stroke = Stroke {
                        width: (*width as f32 * scale).clamp(0.0, 1e4),
                        line_cap: LineCap::Round,
                        line_join: LineJoin::Round,
                        ..Stroke::default()
                    };
                    if let Some(path) = path(points.iter().map(at), false) {
                        map.stroke_path(&path, &ink(*paint), &stroke, Transform::identity(), None);
                    }
                }
            }
        }
        map
    }
}

fn path(points: impl Iterator<Item = [f32; 2]>, closed: bool) -> Option<Path> {
    let mut builder = PathBuilder::new();
    for (i, [x, y]) in points.enumerate() {
        if i == 0 { builder.move_to(x, y) } else { builder.line_to(x, y) }
    }
    if closed {
        builder.close();
    }
    builder.finish()
}

fn ink(paint: Paint) -> Ink<'static> {
    let [r, g, b] = paint.rgb();
    let mut ink = Ink { anti_alias: true, ..Ink::default() };
    ink.set_color_rgba8(r, g, b, 255);
    ink
}

fn fill(map: &mut Pixmap, path: Option<Path>, paint: Paint) {
    if let Some(path) = path {
        map.fill_path(&path, &ink(paint), FillRule::Winding, Transform::identity(), None);
    }
}
