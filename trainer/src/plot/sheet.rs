//! Figures and drawings of several kinds side by side in one.

use super::theme::{INK, LABEL_PX, draw_error, escape, figure, font, ground, units, with_overlay};
use super::{PlotError, PlotOptions};
use plotters::prelude::Text;
use std::fmt::Write as _;

/// Height of a line of text under a drawing, CSS pixels.
const LINE_PX: u32 = 21;

/// Puts SVG texts side by side, `columns` in a row, under `title`, which is the accessible name alone: what is to be read stands in
/// the parts. Columns are as wide as their widest part, rows as high as their highest; parts are centred in theirs.
///
/// # Errors
/// [`PlotError::NoData`] without a part, [`PlotError::Draw`] for a part that says no size in CSS pixels.
pub fn sheet(parts: &[String], columns: usize, title: &str) -> Result<String, PlotError> {
    if parts.is_empty() || columns == 0 {
        return Err(PlotError::NoData("a sheet without parts"));
    }
    let sizes = parts.iter().map(|part| size(part)).collect::<Result<Vec<_>, _>>()?;
    let columns = columns.min(parts.len());
    let rows = parts.len().div_ceil(columns);
    let largest = |of: &dyn Fn(usize) -> Option<u32>| (0..parts.len()).filter_map(of).max().unwrap_or(0);
    let widths: Vec<u32> =
        (0..columns).map(|column| largest(&|i| (i % columns == column).then(|| sizes[i].0))).collect();
    let heights: Vec<u32> = (0..rows).map(|row| largest(&|i| (i / columns == row).then(|| sizes[i].1))).collect();
    let (width, height): (u32, u32) = (widths.iter().sum(), heights.iter().sum());
    let title = escape(title);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"gadm-plot\" role=\"img\" aria-label=\"{title}\" width=\"{width}\" \
         height=\"{height}\" viewBox=\"0 0 {width} {height}\">\n<title>{title}</title>\n{}",
        ground(width, height)
    );
    for (i, part) in parts.iter().enumerate() {
        let (row, column) = (i / columns, i % columns);
        let left = widths[..column].iter().sum::<u32>() + (widths[column] - sizes[i].0) / 2;
        let top = heights[..row].iter().sum::<u32>() + (heights[row] - sizes[i].1) / 2;
        // Writing into a `String` cannot fail.
        let _ = writeln!(svg, "<g transform=\"translate({left} {top})\">\n{}\n</g>", part.trim_end());
    }
    svg.push_str("</svg>\n");
    Ok(svg)
}

/// Width and height of an SVG text in CSS pixels, from its opening tag.
fn size(svg: &str) -> Result<(u32, u32), PlotError> {
    let tag = &svg[..svg.find('>').unwrap_or(0)];
    let value = |name: &str| tag.split(&format!(" {name}=\"")).nth(1)?.split('"').next()?.parse().ok();
    match (value("width"), value("height")) {
        (Some(width), Some(height)) => Ok((width, height)),
        _ => Err(PlotError::Draw("a part of a sheet has no width and height in whole CSS pixels".to_owned())),
    }
}

/// Puts a drawing that is no chart (an SVG text) on the ground of a figure, under the heading and above lines of text.
///
/// # Errors
/// [`PlotError::TooSmall`], [`PlotError::Draw`] for a drawing without a size.
pub fn picture(drawing: &str, lines: &[String], options: &PlotOptions) -> Result<String, PlotError> {
    let (width, height) = size(drawing)?;
    let mut left_top = (0, 0);
    let svg = figure(options, options.height, |area| {
        let (x, y) = area.get_pixel_range();
        let px = |at: i32| at / units(1) as i32;
        let room = (px(x.end - x.start), px(y.end - y.start));
        let below = height + lines.len() as u32 * LINE_PX + LINE_PX / 2;
        if room.0 < width as i32 || room.1 < below as i32 {
            let needed = (options.width + width - room.0 as u32, options.height + below - room.1 as u32);
            return Err(PlotError::TooSmall { width: options.width, height: options.height, needed });
        }
        left_top = (px(x.start) + (room.0 - width as i32) / 2, px(y.start));
        let left = left_top.0 - px(x.start);
        for (i, line) in lines.iter().enumerate() {
            let at = [left, (height + LINE_PX / 2 + i as u32 * LINE_PX) as i32].map(|at| at * units(1) as i32);
            area.draw(&Text::new(line.clone(), (at[0], at[1]), font(LABEL_PX, &INK.color()))).map_err(draw_error)?;
        }
        Ok(())
    })?;
    let (scale, (left, top)) = (units(1) as i32, left_top);
    let place = format!("translate({} {}) scale({scale})", left * scale, top * scale);
    Ok(with_overlay(&svg, &format!("<g transform=\"{place}\">\n{}\n</g>\n", drawing.trim_end())))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(width: u32, height: u32) -> String {
        format!("<svg xmlns=\"x\" width=\"{width}\" height=\"{height}\"><g/></svg>")
    }

    #[test]
    fn parts_stand_in_columns_as_wide_and_rows_as_high_as_they_need() {
        let svg = sheet(&[part(100, 50), part(60, 80), part(40, 20)], 2, "a < b").unwrap();
        assert!(svg.contains("width=\"160\" height=\"100\"") && svg.contains("<title>a &lt; b</title>"), "{svg}");
        for place in ["translate(0 15)", "translate(100 0)", "translate(30 80)"] {
            assert!(svg.contains(place), "{place} in {svg}");
        }
    }

    #[test]
    fn a_sheet_needs_parts_with_a_size() {
        assert!(matches!(sheet(&[], 2, ""), Err(PlotError::NoData(_))));
        assert!(matches!(sheet(&["<svg width=\"1em\">".to_owned()], 2, ""), Err(PlotError::Draw(_))));
    }

    #[test]
    fn a_drawing_has_room_below_the_heading_or_is_refused() {
        let lines = ["one line".to_owned(), "another".to_owned()];
        let svg = picture(&part(300, 200), &lines, &PlotOptions::new("Frame").with_size(360, 310)).unwrap();
        for text in ["Frame", "one line", "another", "<g transform=\"translate(240 "] {
            assert!(svg.contains(text), "{text} in {svg}");
        }
        for (width, height) in [(260, 310), (360, 260)] {
            let small = PlotOptions::new("Frame").with_size(width, height);
            assert!(matches!(picture(&part(300, 200), &lines, &small), Err(PlotError::TooSmall { .. })));
        }
    }
}
