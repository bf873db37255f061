//! Values on a grid as coloured cells: latents along an episode, regions of an action space.

use super::axis::{Axes, chart};
use super::theme::{Area, Entry, Swatch, TICK_PX, data_color, draw_error, figure, font, legend, units};
use super::{PlotError, PlotOptions};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::ops::Range;

/// Shades of a scale: enough to read, few enough that equal neighbours become one rectangle.
const SHADES: f64 = 24.0;
/// Latents that the legend of a map names; of more, the marks have to tell.
const MOST_NAMED: usize = 16;

/// Which colour of the palette is red.
const RED: usize = 4;

/// What the colour of a cell says.
#[derive(Debug, Clone, PartialEq)]
pub enum Paint {
    /// A number in a range, from dark (lowest) to bright (highest); values beyond are clamped.
    Scale {
        /// What is shown, with its unit.
        name: String,
        /// Values of the darkest and the brightest colour.
        range: Range<f64>,
    },
    /// The index of a latent or of a type; every one has a colour of its own.
    Index {
        /// What the index counts, such as `latent`.
        name: String,
    },
}

/// What a mark looks like.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Shape {
    /// A small circle.
    #[default]
    Dot,
    /// A star with five points.
    Star,
}

/// A point on a map, with a text beside it.
#[derive(Debug, Clone, PartialEq)]
pub struct Mark {
    /// Where, on the axes of the map.
    pub at: (f64, f64),
    /// Text; empty for none.
    pub text: String,
    /// What it looks like.
    pub shape: Shape,
}

/// A grid of values.
#[derive(Debug, Clone, PartialEq)]
pub struct Map {
    /// Name of the horizontal axis with its unit.
    pub x_name: String,
    /// Name of the vertical axis with its unit.
    pub y_name: String,
    /// Ends of the horizontal axis, the outer edges of the first and last column.
    pub x: Range<f64>,
    /// Ends of the vertical axis, the outer edges of the first and last row.
    pub y: Range<f64>,
    /// Number of columns.
    pub columns: usize,
    /// Row by row from below, `rows x columns`; not finite: nothing is drawn.
    pub values: Vec<f64>,
    /// What the colours say.
    pub paint: Paint,
    /// Points on top.
    pub marks: Vec<Mark>,
    /// Red lines above the cells and below the points, on the axes of the map.
    pub lines: Vec<Vec<(f64, f64)>>,
}

/// Draws a map.
///
/// # Errors
/// [`PlotError::NoData`] without a finite value, [`PlotError::Lengths`] where the last row is not full, [`PlotError::Draw`]
/// from the plotting library.
pub fn map(map: &Map, options: &PlotOptions) -> Result<String, PlotError> {
    maps(std::slice::from_ref(map), options)
}

/// Draws maps below one another; [`PlotOptions::height`] is the height of one.
///
/// # Errors
/// As [`map()`].
pub fn maps(maps: &[Map], options: &PlotOptions) -> Result<String, PlotError> {
    for map in maps {
        if map.columns == 0 || !map.values.iter().any(|value| value.is_finite()) {
            return Err(PlotError::NoData("the map has no finite value"));
        }
        if !map.values.len().is_multiple_of(map.columns) {
            let right = map.values.len().next_multiple_of(map.columns);
            return Err(PlotError::Lengths { what: "cells of a map in full rows", left: map.values.len(), right });
        }
    }
    figure(options, options.height * maps.len() as u32, |area| {
        for (map, place) in maps.iter().zip(area.split_evenly((maps.len(), 1))) {
            draw(&place.margin(units(6), 0, 0, 0), map)?;
        }
        Ok(())
    })
}

/// The colour of latent `index`: hues a golden angle apart, so that neighbours differ, in three lightnesses.
fn index_color(index: usize) -> RGBColor {
    let hue = (index as f64 * 0.618_033_988_75).fract();
    let lightness = [0.45, 0.62, 0.78][index % 3];
    let (r, g, b) = HSLColor(hue, 0.65, lightness).rgb();
    RGBColor(r, g, b)
}

impl Paint {
    /// A number that is equal for cells of the same colour; `None` for cells without one.
    fn shade(&self, value: f64) -> Option<usize> {
        if !value.is_finite() {
            return None;
        }
        Some(match self {
            Self::Scale { range, .. } => {
                let length = (range.end - range.start).max(f64::MIN_POSITIVE);
                (((value - range.start) / length).clamp(0.0, 1.0) * SHADES).round() as usize
            }
            Self::Index { .. } => value as usize,
        })
    }

    fn color(&self, shade: usize) -> RGBColor {
        match self {
            Self::Scale { .. } => ViridisRGB::get_color_normalized(shade as f64, 0.0, SHADES),
            Self::Index { .. } => index_color(shade),
        }
    }

    /// Names the colours above the chart; gives back what is left below.
    fn legend<'a>(&self, area: &Area<'a>, values: &[f64]) -> Result<Area<'a>, PlotError> {
        match self {
            Self::Scale { name, range } => {
                let entry = |shade: f64, text: String| Entry {
                    name: text,
                    color: self.color(shade as usize),
                    swatch: Swatch::Block,
                };
                let middle = f64::midpoint(range.start, range.end);
                legend(
                    area,
                    &[
                        entry(0.0, format!("{name} {}", number(range.start))),
                        entry(SHADES / 2.0, number(middle)),
                        entry(SHADES, number(range.end)),
                    ],
                )
            }
            Self::Index { name } => {
                let mut present: Vec<usize> = values.iter().filter_map(|&value| self.shade(value)).collect();
                present.sort_unstable();
                present.dedup();
                let entries: Vec<Entry> = present
                    .iter()
                    .take(MOST_NAMED)
                    .map(|&index| Entry {
                        name: format!("{name} {index}"),
                        color: index_color(index),
                        swatch: Swatch::Block,
                    })
                    .collect();
                legend(area, &entries)
            }
        }
    }
}

/// A number as people write it, with at most four digits behind the point.
fn number(value: f64) -> String {
    let text = format!("{value:.4}");
    let short = text.trim_end_matches('0').trim_end_matches('.');
    if short == "-0" { "0".to_owned() } else { short.replace('-', "−") }
}

fn draw(area: &Area<'_>, map: &Map) -> Result<(), PlotError> {
    let below = map.paint.legend(area, &map.values)?;
    let axes = Axes {
        x_name: &map.x_name,
        y_name: &map.y_name,
        x: map.x.clone(),
        y: map.y.clone(),
        whole_x: false,
        least_y_label_px: 0,
    };
    let mut chart = chart(&below, &axes)?;
    let rows = map.values.len() / map.columns;
    let (width, height) = ((map.x.end - map.x.start) / map.columns as f64, (map.y.end - map.y.start) / rows as f64);
    let cells = map.values.chunks_exact(map.columns).enumerate().flat_map(|(row, values)| {
        let (low, high) = (map.y.start + row as f64 * height, map.y.start + (row + 1) as f64 * height);
        let shades: Vec<Option<usize>> = values.iter().map(|&value| map.paint.shade(value)).collect();
        let mut column = 0;
        let stretches: Vec<(usize, usize, Option<usize>)> = shades
            .chunk_by(|a, b| a == b)
            .map(|stretch| {
                let first = column;
                column += stretch.len();
                (first, column, stretch[0])
            })
            .collect();
        stretches.into_iter().filter_map(move |(first, end, shade)| {
            let (left, right) = (map.x.start + first as f64 * width, map.x.start + end as f64 * width);
            Some(Rectangle::new([(left, low), (right, high)], map.paint.color(shade?).filled()))
        })
    });
    chart.draw_series(cells).map_err(draw_error)?;
    let (white, ink) = (RGBColor(255, 255, 255), RGBColor(0, 0, 0));
    for (width, color) in [(4, white), (2, data_color(RED))] {
        let lines = map.lines.iter().map(|line| PathElement::new(line.clone(), color.stroke_width(units(width))));
        chart.draw_series(lines).map_err(draw_error)?;
    }
    let of = |shape: Shape| map.marks.iter().filter(move |mark| mark.shape == shape);
    for (size, color) in [(4, ink), (3, white)] {
        let dots = of(Shape::Dot).map(|mark| Circle::new(mark.at, units(size) as i32, color.filled()));
        chart.draw_series(dots).map_err(draw_error)?;
    }
    for (size, color) in [(10, ink), (8, white)] {
        let stars = of(Shape::Star).map(|mark| EmptyElement::at(mark.at) + Polygon::new(star(size), color.filled()));
        chart.draw_series(stars).map_err(draw_error)?;
    }
    let labels = map.marks.iter().filter(|mark| !mark.text.is_empty()).map(|mark| {
        let beside = units(if mark.shape == Shape::Star { 9 } else { 5 }) as i32;
        // Near the right end a text would be cut.
        let far = mark.at.0 > map.x.end - 0.2 * (map.x.end - map.x.start);
        let (anchor, beside) = if far { (HPos::Right, -beside) } else { (HPos::Left, beside) };
        let style = font(TICK_PX, &ink).pos(Pos::new(anchor, VPos::Bottom));
        EmptyElement::at(mark.at) + Text::new(mark.text.clone(), (beside, -(units(3) as i32)), style)
    });
    chart.draw_series(labels).map_err(draw_error)?;
    Ok(())
}

/// Corners of a star around the origin, its points `px` CSS pixels away, in drawing units.
fn star(px: u32) -> Vec<(i32, i32)> {
    let corner = |i: u32| {
        let (sin, cos) = (f64::from(i) * std::f64::consts::PI / 5.0).sin_cos();
        let radius = f64::from(units(px)) * if i.is_multiple_of(2) { 1.0 } else { 0.45 };
        ((radius * sin).round() as i32, (-radius * cos).round() as i32)
    };
    (0..10).map(corner).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(values: Vec<f64>, paint: Paint) -> Map {
        Map {
            x_name: "time (s)".into(),
            y_name: "latent".into(),
            x: 0.0..3.0,
            y: -0.5..1.5,
            columns: 3,
            values,
            paint,
            marks: vec![Mark { at: (1.0, 0.0), text: "7".into(), shape: Shape::Dot }],
            lines: Vec::new(),
        }
    }

    fn scale() -> Paint {
        Paint::Scale { name: "torque (N m)".into(), range: -1.0..1.0 }
    }

    #[test]
    fn equal_neighbours_are_one_rectangle_and_gaps_are_none() {
        let cells = |values: &[f64]| {
            let svg = map(&grid(values.to_vec(), scale()), &PlotOptions::new("t")).unwrap();
            svg.matches("<rect").count()
        };
        let all_equal = cells(&[0.0; 6]);
        assert_eq!(cells(&[0.0, 0.5, 1.0, 0.0, 0.0, 0.0]), all_equal + 2);
        assert_eq!(cells(&[f64::NAN, f64::NAN, f64::NAN, 0.0, 0.0, 0.0]), all_equal - 1);
    }

    #[test]
    fn names_of_axes_scale_and_marks_are_there() {
        let svg = map(&grid(vec![0.0, 0.5, 1.0, 0.0, 0.0, 0.0], scale()), &PlotOptions::new("t")).unwrap();
        for text in ["time (s)", "latent", "torque (N m) −1", "\n7\n", "<circle"] {
            assert!(svg.contains(text), "{text}");
        }
        let index = Paint::Index { name: "latent".into() };
        let svg = map(&grid(vec![0.0, 5.0, 5.0, 5.0, 5.0, 5.0], index), &PlotOptions::new("t")).unwrap();
        assert!(svg.contains("latent 0") && svg.contains("latent 5") && !svg.contains("latent 1"), "{svg}");
    }

    #[test]
    fn stars_and_lines_are_drawn_above_the_cells() {
        let mut own = grid(vec![0.0; 6], scale());
        own.marks[0].shape = Shape::Star;
        own.lines = vec![vec![(0.0, 0.0), (3.0, 0.0)]];
        let svg = map(&own, &PlotOptions::new("t")).unwrap();
        assert_eq!((svg.matches("<polygon").count(), svg.matches("<circle").count()), (2, 0));
        let RGBColor(r, g, b) = data_color(RED);
        let line = svg.find(&format!("stroke=\"#{r:02X}{g:02X}{b:02X}\" stroke-width=\"16\"")).unwrap();
        assert!(line < svg.find("<polygon").unwrap(), "below the marks");
        assert!(svg[..line].contains("<rect"), "above the cells");
    }

    #[test]
    fn latents_have_colours_of_their_own() {
        let mut colors: Vec<_> = (0..64)
            .map(|i| {
                let c = index_color(i);
                (c.0, c.1, c.2)
            })
            .collect();
        colors.sort_unstable();
        colors.dedup();
        assert_eq!(colors.len(), 64);
    }

    #[test]
    fn values_beyond_the_scale_take_its_ends() {
        let paint = scale();
        assert_eq!(paint.shade(-7.0), paint.shade(-1.0));
        assert_eq!(paint.shade(7.0), Some(SHADES as usize));
        assert_eq!(paint.shade(f64::NAN), None);
        assert_eq!(number(-0.000_01), "0");
        assert_eq!(number(-2.5), "−2.5");
    }

    #[test]
    fn a_map_without_values_or_with_a_torn_row_is_refused() {
        let options = PlotOptions::new("t");
        assert!(matches!(map(&grid(vec![f64::NAN; 6], scale()), &options), Err(PlotError::NoData(_))));
        assert!(matches!(
            map(&grid(vec![0.0; 5], scale()), &options),
            Err(PlotError::Lengths { left: 5, right: 6, .. })
        ));
    }
}
