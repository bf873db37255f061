//! Points in classes, on panels that share their axes.

use super::axis::{Axes, chart};
use super::theme::{
    Entry, INK, LABEL_PX, MUTED, Swatch, data_color, draw_error, figure, font, legend, units, with_overlay,
};
use super::{PlotError, PlotOptions};
use plotters::prelude::*;
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::ops::Range;

/// Distance of the grid that points are moved to, so that a point is drawn once: half a CSS pixel.
const GRID_UNITS: i32 = units(1) as i32 / 2;

/// A class of points.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Class {
    /// Name in the legend.
    pub name: String,
    /// Which colour of the palette.
    pub color: usize,
}

/// What all panels have in common.
#[derive(Debug, Clone, PartialEq)]
pub struct CloudAxes {
    /// Name of the horizontal axis with its unit.
    pub x_name: String,
    /// Name of the vertical axis with its unit.
    pub y_name: String,
    /// Ends of the horizontal axis; points beyond are not drawn.
    pub x: Range<f64>,
    /// Ends of the vertical axis; points beyond are not drawn.
    pub y: Range<f64>,
}

/// One panel.
#[derive(Debug, Clone, PartialEq)]
pub struct Cloud {
    /// Text above it.
    pub title: String,
    /// Points of each class, in the order of the classes; later ones lie on top. Empty: there is nothing yet.
    pub points: Vec<Vec<(f64, f64)>>,
}

/// Draws panels, `columns` in a row, under one legend of `classes`. The size in `options` is that of a panel.
///
/// # Errors
/// [`PlotError::NoData`] where no panel has points, [`PlotError::Draw`] from the plotting library.
pub fn clouds(
    clouds: &[Cloud],
    columns: usize,
    classes: &[Class],
    axes: &CloudAxes,
    options: &PlotOptions,
) -> Result<String, PlotError> {
    if columns == 0 || clouds.iter().all(|cloud| cloud.points.iter().all(Vec::is_empty)) {
        return Err(PlotError::NoData("no panel has points"));
    }
    let entry =
        |class: &Class| Entry { name: class.name.clone(), color: data_color(class.color), swatch: Swatch::Block };
    let entries: Vec<Entry> = classes.iter().map(entry).collect();
    let (columns, rows) = (columns.min(clouds.len()), clouds.len().div_ceil(columns));
    let whole = options.clone().with_size(options.width * columns as u32, options.height * rows as u32 + 60);
    let mut dots = String::new();
    let svg = figure(&whole, whole.height, |area| {
        let below = legend(area, &entries)?;
        for (cloud, area) in clouds.iter().zip(below.split_evenly((rows, columns))) {
            let (top, chart_area) = area.margin(units(8), units(4), 0, 0).split_vertically(units(LABEL_PX + 10));
            let at = (units(8) as i32, 0);
            top.draw(&Text::new(cloud.title.clone(), at, font(LABEL_PX, &INK.color()))).map_err(draw_error)?;
            if cloud.points.iter().all(Vec::is_empty) {
                let (at, muted) = ((units(8) as i32, units(8) as i32), MUTED.color());
                chart_area.draw(&Text::new("nothing yet", at, font(LABEL_PX, &muted))).map_err(draw_error)?;
                continue;
            }
            let chart = chart(
                &chart_area,
                &Axes {
                    x_name: &axes.x_name,
                    y_name: &axes.y_name,
                    x: axes.x.clone(),
                    y: axes.y.clone(),
                    whole_x: false,
                    least_y_label_px: 0,
                },
            )?;
            for (points, class) in cloud.points.iter().zip(classes) {
                let inside = points.iter().filter(|(x, y)| axes.x.contains(x) && axes.y.contains(y));
                let places: BTreeSet<(i32, i32)> = inside
                    .map(|point| {
                        let (x, y) = chart.backend_coord(point);
                        (x / GRID_UNITS * GRID_UNITS, y / GRID_UNITS * GRID_UNITS)
                    })
                    .collect();
                dots.push_str(&path(&places, data_color(class.color)));
            }
        }
        Ok(())
    })?;
    Ok(with_overlay(&svg, &dots))
}

/// Dots at `places` as one element: a circle for each would be eight times as long.
fn path(places: &BTreeSet<(i32, i32)>, RGBColor(r, g, b): RGBColor) -> String {
    if places.is_empty() {
        return String::new();
    }
    let mut text = format!(
        "<path fill=\"none\" stroke=\"#{r:02X}{g:02X}{b:02X}\" stroke-width=\"{}\" stroke-linecap=\"round\" opacity=\"0.7\" d=\"",
        units(2)
    );
    for (x, y) in places {
        // Writing into a `String` cannot fail.
        let _ = write!(text, "M{x} {y}h0");
    }
    text.push_str("\"/>\n");
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn draw(panels: &[Cloud]) -> Result<String, PlotError> {
        let classes = [3, 0].map(|color| Class { name: format!("class {color}"), color });
        let axes = CloudAxes { x_name: "x (1)".into(), y_name: "y (1)".into(), x: -1.0..1.0, y: 0.0..2.0 };
        clouds(panels, 2, &classes, &axes, &PlotOptions::new("Paths").with_size(260, 240))
    }

    #[test]
    fn a_point_is_drawn_once_and_not_beyond_the_axes() {
        let points = vec![vec![(0.0, 1.0), (0.0, 1.0), (0.5, 0.5), (3.0, 1.0)], vec![(0.0, 0.2)]];
        let svg = draw(&[Cloud { title: "a".into(), points }, Cloud { title: "b".into(), points: vec![] }]).unwrap();
        assert_eq!(svg.matches("h0").count(), 3);
        let RGBColor(r, g, b) = data_color(3);
        // Its line in the legend comes before.
        let own = svg.split(&format!("stroke=\"#{r:02X}{g:02X}{b:02X}\" stroke-width=\"16\"")).last().unwrap();
        assert_eq!(own[..own.find("/>").unwrap()].matches("h0").count(), 2, "its own colour");
        for text in ["class 3", "class 0", "x (1)", "y (1)", "nothing yet", "width=\"520\""] {
            assert!(svg.contains(text), "{text}");
        }
        assert!(svg.trim_end().ends_with("</svg>"));
    }

    #[test]
    fn panels_without_points_are_refused() {
        let empty = Cloud { title: "a".into(), points: vec![vec![], vec![]] };
        assert!(matches!(draw(&[empty]), Err(PlotError::NoData(_))));
    }
}
