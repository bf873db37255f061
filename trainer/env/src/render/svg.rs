//! A scene as SVG.

use std::fmt::Write as _;

use super::scene::{Paint, Scene, Shape};

impl Scene {
    /// The scene as an SVG document of this width in CSS pixels; the height follows from the view.
    ///
    /// ```
    /// use gadm_envs::render::{Paint, Scene};
    /// let mut scene = Scene::new([-1.0, 1.0], [-1.0, 1.0]);
    /// scene.disc([0.5, 0.5], 0.1, Paint::Goal);
    /// assert!(scene.to_svg(200).contains("<circle cx=\"150\" cy=\"50\" r=\"10\" fill=\"#009e73\"/>"));
    /// ```
    pub fn to_svg(&self, width: u32) -> String {
        let height = self.height_for(width);
        let scale = f64::from(width) / (self.view.x[1] - self.view.x[0]);
        let at = |p: &[f64; 2]| [(p[0] - self.view.x[0]) * scale, (self.view.y[1] - p[1]) * scale];
        let points = |points: &[[f64; 2]]| {
            let all = points.iter().map(|p| at(p).map(short).join(","));
            all.collect::<Vec<_>>().join(" ")
        };
        let mut out = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" \
             height=\"{height}\">\n"
        );
        for shape in &self.shapes {
            // Writing to a String cannot fail.
            let _ = match shape {
                Shape::Disc { center, radius, paint } => {
                    let [x, y] = at(center).map(short);
                    let r = short(radius * scale);
                    writeln!(out, "<circle cx=\"{x}\" cy=\"{y}\" r=\"{r}\" fill=\"{}\"/>", hex(*paint))
                }
                Shape::Line { points: line, width, paint } => writeln!(
                    out,
                    "<polyline points=\"{}\" fill=\"none\" stroke=\"{}\" stroke-width=\"{}\" \
                     stroke-linecap=\"round\" stroke-linejoin=\"round\"/>",
                    points(line),
                    hex(*paint),
                    short(width * scale)
                ),
                Shape::Area { points: corners, paint } => {
                    writeln!(out, "<polygon points=\"{}\" fill=\"{}\"/>", points(corners), hex(*paint))
                }
            };
        }
        out.push_str("</svg>\n");
        out
    }

    /// Height of a picture of this width, pixels; at least 1.
    pub fn height_for(&self, width: u32) -> u32 {
        ((f64::from(width) / self.view.aspect()).round() as u32).max(1)
    }
}

fn hex(paint: Paint) -> String {
    let [r, g, b] = paint.rgb();
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// At most two decimals; 0 for what is no number.
fn short(value: f64) -> String {
    let value = if value.is_finite() { (value * 100.0).round() / 100.0 + 0.0 } else { 0.0 };
    value.to_string()
}
