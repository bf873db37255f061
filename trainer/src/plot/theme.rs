//! Colours, text and frame that all figures share.

use super::{PlotError, PlotOptions};
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::fmt::Write as _;

/// The area that figures draw on.
pub(super) type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// Drawing units in one CSS pixel: the backend rounds to whole units, and a line must not look rounded.
pub(super) const UNITS: u32 = 8;

/// A colour on light and on dark ground. The light one is what the backend writes; a style sheet replaces it.
pub(super) struct Pair {
    light: RGBColor,
    dark: RGBColor,
}

const fn pair(light: u32, dark: u32) -> Pair {
    const fn rgb(code: u32) -> RGBColor {
        RGBColor((code >> 16) as u8, (code >> 8) as u8, code as u8)
    }
    Pair { light: rgb(light), dark: rgb(dark) }
}

impl Pair {
    /// The colour to draw with.
    pub(super) fn color(&self) -> RGBColor {
        self.light
    }
}

/// Ground of a figure.
const GROUND: Pair = pair(0xfeffff, 0x0d1117);
/// Text and axes.
pub(super) const INK: Pair = pair(0x1f2328, 0xe6edf3);
/// Reference lines.
pub(super) const MUTED: Pair = pair(0x59636e, 0x9198a1);
/// Grid.
pub(super) const GRID: Pair = pair(0xdfe3e8, 0x2b3138);

/// Colours of data, told apart by hue and, by their order, by lightness.
const PALETTE: [Pair; 8] = [
    pair(0x0969da, 0x58a6ff),
    pair(0xbc4c00, 0xf0883e),
    pair(0x1a7f37, 0x3fb950),
    pair(0x8250df, 0xbc8cff),
    pair(0xcf222e, 0xff7b72),
    pair(0x0e7490, 0x39c5cf),
    pair(0x9a6700, 0xd29922),
    pair(0xbf3989, 0xf778ba),
];

/// The colour of the `i`-th set of data.
pub(super) fn data_color(i: usize) -> RGBColor {
    PALETTE[i % PALETTE.len()].light
}

/// `px` CSS pixels in drawing units.
pub(super) const fn units(px: u32) -> u32 {
    px * UNITS
}

/// Font of `px` CSS pixels in `color`.
pub(super) fn font(px: u32, color: &RGBColor) -> TextStyle<'_> {
    // The backend divides sizes by 1.24.
    ("sans-serif", f64::from(units(px)) * 1.24).into_font().color(color)
}

/// Estimated width of `text` at `px` CSS pixels, in CSS pixels; on the wide side for common sans-serif fonts.
pub(super) fn text_width(text: &str, px: u32) -> u32 {
    (text.chars().count() as f64 * f64::from(px) * 0.6).ceil() as u32
}

/// Size of tick labels in CSS pixels.
pub(super) const TICK_PX: u32 = 13;
/// Size of axis names and legends in CSS pixels.
pub(super) const LABEL_PX: u32 = 14;
/// Size of titles in CSS pixels.
pub(super) const TITLE_PX: u32 = 17;
/// Height of a legend row in CSS pixels.
const ROW_PX: u32 = 21;
/// Width of a legend's swatch with its gap in CSS pixels.
const SWATCH_PX: u32 = 30;
/// Margin of a figure in CSS pixels.
const MARGIN_PX: u32 = 12;
/// Least width and height of a chart with its axes in CSS pixels.
pub(super) const MIN_CHART_PX: (u32, u32) = (160, 100);

pub(super) fn draw_error(error: impl std::fmt::Display) -> PlotError {
    PlotError::Draw(error.to_string())
}

/// What a legend row shows beside its name.
#[derive(Clone, Copy)]
pub(super) enum Swatch {
    /// A line.
    Line,
    /// A line in a band.
    Band,
    /// A filled block.
    Block,
    /// A thin dashed line.
    Dashed,
}

/// A legend entry.
pub(super) struct Entry {
    pub(super) name: String,
    pub(super) color: RGBColor,
    pub(super) swatch: Swatch,
}

/// Draws a figure of `height` CSS pixels: ground, title, and what `draw` puts below the title.
pub(super) fn figure(
    options: &PlotOptions,
    height: u32,
    draw: impl FnOnce(&Area<'_>) -> Result<(), PlotError>,
) -> Result<String, PlotError> {
    let needed = (MIN_CHART_PX.0 + 2 * MARGIN_PX, MIN_CHART_PX.1 + 2 * MARGIN_PX + TITLE_PX + 11);
    if options.width < needed.0 || height < needed.1 {
        return Err(PlotError::TooSmall { width: options.width, height, needed });
    }
    let mut body = String::new();
    let size = (units(options.width), units(height));
    {
        let root = SVGBackend::with_string(&mut body, size).into_drawing_area();
        root.fill(&GROUND.light).map_err(draw_error)?;
        let margin = units(MARGIN_PX) as i32;
        let inside = root.margin(margin, margin, margin, margin);
        let below = if options.title.is_empty() {
            inside
        } else {
            let (title, below) = inside.split_vertically(units(TITLE_PX + 11));
            let shown = shortened(&options.title, TITLE_PX, options.width - 2 * MARGIN_PX);
            title.draw(&Text::new(shown, (0, 0), font(TITLE_PX, &INK.light))).map_err(draw_error)?;
            below
        };
        draw(&below)?;
        root.present().map_err(draw_error)?;
    }
    Ok(with_head(&body, options, height))
}

/// Size of `area` in CSS pixels.
pub(super) fn inner_px(area: &Area<'_>) -> (u32, u32) {
    let (width, height) = area.dim_in_pixel();
    (width / UNITS, height / UNITS)
}

/// Columns of a legend of `width`, their width, and the height of the whole, in CSS pixels.
fn legend_layout(entries: &[Entry], width: u32) -> (usize, u32, u32) {
    let widest = entries.iter().map(|entry| text_width(&entry.name, LABEL_PX)).max().unwrap_or(0);
    let column = (SWATCH_PX + widest + 18).min(width).max(1);
    let columns = (width / column).max(1) as usize;
    (columns, column, entries.len().div_ceil(columns) as u32 * ROW_PX + 4)
}

/// Height that a figure as wide as `options` should have for a legend and a readable chart, in CSS pixels.
pub(super) fn height_with_legend(entries: &[Entry], options: &PlotOptions) -> u32 {
    let (_, _, legend) = legend_layout(entries, options.width.saturating_sub(2 * MARGIN_PX));
    options.height.max(legend + 300)
}

/// Draws a legend on top of `area` and gives back what is left below it.
pub(super) fn legend<'a>(area: &Area<'a>, entries: &[Entry]) -> Result<Area<'a>, PlotError> {
    let (width, height) = inner_px(area);
    let (columns, column, needed) = legend_layout(entries, width);
    if needed + MIN_CHART_PX.1 > height {
        return Err(PlotError::TooSmall { width, height, needed: (MIN_CHART_PX.0, needed + MIN_CHART_PX.1) });
    }
    let (top, below) = area.split_vertically(units(needed));
    for (i, entry) in entries.iter().enumerate() {
        let left = units((i % columns) as u32 * column) as i32;
        let middle = units((i / columns) as u32 * ROW_PX + ROW_PX / 2) as i32;
        let right = left + units(SWATCH_PX - 8) as i32;
        let half = units(6) as i32;
        let line = match entry.swatch {
            Swatch::Dashed => entry.color.stroke_width(units(1)),
            Swatch::Line | Swatch::Band | Swatch::Block => entry.color.stroke_width(units(2)),
        };
        let opacity = if matches!(entry.swatch, Swatch::Block) { 1.0 } else { 0.2 };
        if matches!(entry.swatch, Swatch::Band | Swatch::Block) {
            let corners = [(left, middle - half), (right, middle + half)];
            top.draw(&Rectangle::new(corners, entry.color.mix(opacity).filled())).map_err(draw_error)?;
        }
        match entry.swatch {
            Swatch::Dashed => {
                let (dash, gap) = (units(5), units(3));
                let points = [(left, middle), (right, middle)];
                top.draw(&plotters::element::DashedPathElement::new(points, dash, gap, line)).map_err(draw_error)?;
            }
            Swatch::Line | Swatch::Band | Swatch::Block => {
                top.draw(&PathElement::new(vec![(left, middle), (right, middle)], line)).map_err(draw_error)?;
            }
        }
        let name = shortened(&entry.name, LABEL_PX, column.saturating_sub(SWATCH_PX));
        let style = font(LABEL_PX, &INK.light).pos(Pos::new(HPos::Left, VPos::Center));
        top.draw(&Text::new(name, (left + units(SWATCH_PX) as i32, middle), style)).map_err(draw_error)?;
    }
    Ok(below)
}

/// `text` cut with an ellipsis to fit `width` at `px`, both in CSS pixels.
fn shortened(text: &str, px: u32, width: u32) -> String {
    if text_width(text, px) <= width {
        return text.to_owned();
    }
    let fitting = (f64::from(width) / (f64::from(px) * 0.6)) as usize;
    text.chars().take(fitting.saturating_sub(1)).chain(['…']).collect()
}

/// Replaces the backend's opening tag by one with size in CSS pixels, accessible name, and colours for dark ground.
fn with_head(body: &str, options: &PlotOptions, height: u32) -> String {
    let content = body.find('>').map_or("", |end| &body[end + 1..]);
    let (width, title) = (options.width, escape(&options.title));
    let view = format!("0 0 {} {}", units(width), units(height));
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"gadm-plot\" role=\"img\" aria-label=\"{title}\" \
         width=\"{width}\" height=\"{height}\" viewBox=\"{view}\">\n<title>{title}</title>\n<style>\n\
         .gadm-plot rect{{shape-rendering:crispEdges}}\n\
         @media (prefers-color-scheme: dark) {{\n"
    );
    for Pair { light, dark } in [&GROUND, &INK, &MUTED, &GRID].into_iter().chain(&PALETTE) {
        let code = |color: &RGBColor| format!("#{:02X}{:02X}{:02X}", color.0, color.1, color.2);
        for property in ["fill", "stroke"] {
            // Writing into a `String` cannot fail.
            let _ = writeln!(svg, ".gadm-plot [{property}=\"{}\"]{{{property}:{}}}", code(light), code(dark));
        }
    }
    svg.push_str("}\n</style>");
    svg.push_str(content);
    svg
}

/// `svg` with `content` on top of everything in it.
pub(super) fn with_overlay(svg: &str, content: &str) -> String {
    let end = svg.rfind("</svg>").unwrap_or(svg.len());
    [&svg[..end], content, &svg[end..]].concat()
}

/// The ground of a figure, as an element of `width` x `height` user units.
pub(super) fn ground(width: u32, height: u32) -> String {
    let RGBColor(r, g, b) = GROUND.light;
    format!("<rect width=\"{width}\" height=\"{height}\" fill=\"#{r:02X}{g:02X}{b:02X}\"/>\n")
}

/// `text` for XML content and attributes; control characters, which XML forbids, become spaces.
pub(crate) fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            character if character.is_control() => escaped.push(' '),
            character => escaped.push(character),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_style_sheet_covers_every_colour_that_is_drawn() {
        let svg = figure(&PlotOptions::new("a < b & \"c\""), 300, |area| {
            let entries = [Swatch::Line, Swatch::Band, Swatch::Block, Swatch::Dashed].map(|swatch| Entry {
                name: "x".into(),
                color: data_color(swatch as usize),
                swatch,
            });
            legend(area, &entries).map(drop)
        })
        .unwrap();
        assert!(svg.contains("<title>a &lt; b &amp; &quot;c&quot;</title>"), "{svg}");
        let (style, content) = svg.split_once("</style>").unwrap();
        let mut found = 0;
        for part in content.split("=\"#").skip(1) {
            let code = &part[..6];
            assert!(style.contains(&format!("\"#{code}\"")), "{code} has no dark form");
            found += 1;
        }
        assert!(found > 5);
    }

    #[test]
    fn a_figure_without_room_is_refused() {
        let entries =
            || (0..30).map(|i| Entry { name: format!("run {i}"), color: data_color(i), swatch: Swatch::Line });
        let draw = |area: &Area<'_>| legend(area, &entries().collect::<Vec<_>>()).map(drop);
        let narrow = PlotOptions::new("t").with_size(200, 300);
        assert!(matches!(figure(&narrow, 300, draw), Err(PlotError::TooSmall { .. })));
        let height = height_with_legend(&entries().collect::<Vec<_>>(), &narrow);
        figure(&narrow, height, draw).unwrap();
        let tiny = PlotOptions::new("t").with_size(10, 10);
        assert!(matches!(figure(&tiny, 10, draw), Err(PlotError::TooSmall { .. })));
    }

    #[test]
    fn long_texts_are_cut_with_an_ellipsis() {
        assert_eq!(shortened("short", 10, 100), "short");
        assert_eq!(shortened("a very long legend entry", 10, 60), "a very lo…");
    }
}
