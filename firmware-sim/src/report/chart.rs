//! Charts: lines and dots over time, columns, and rows of spans.

use super::svg::{Svg, data_color};

/// Width of a chart, CSS pixels.
const WIDTH: u32 = 920;
/// Room for the labels of the y axis, and at the right end.
const LEFT: f64 = 74.0;
const RIGHT: f64 = 16.0;
/// Room for the labels and the name of the x axis.
const BOTTOM: f64 = 44.0;
/// Height of a row of the legend or of a timeline.
const ROW: f64 = 22.0;
/// Most width of a column.
const MOST_THICK: f64 = 60.0;
/// Estimated width of a character.
const CHARACTER: f64 = 7.4;

/// One set of data.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// x and y; a gap is a y that is not finite.
    pub points: Vec<(f64, f64)>,
}

/// How the points of a chart are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Style {
    /// A line from point to point.
    Line,
    /// A line that keeps a value until the next point.
    Steps,
    /// A dot at each point.
    Dots,
}

/// Name, axes and size of a chart.
#[derive(Clone, Debug, PartialEq)]
pub struct Chart {
    /// What it shows, for those who cannot see it.
    pub title: String,
    /// Name of the x axis with its unit.
    pub x_name: String,
    /// Name of the y axis with its unit.
    pub y_name: String,
    /// Height of the plot without legend and axis, CSS pixels.
    pub height: u32,
    /// Ends of the x axis; `None` = those of the data. Charts below one another share theirs.
    pub x_range: Option<(f64, f64)>,
    /// Horizontal lines with a name: a mean, a limit.
    pub levels: Vec<(f64, String)>,
}

/// One stretch of a timeline.
#[derive(Clone, Debug, PartialEq)]
pub struct Span {
    /// Begin, in units of the x axis.
    pub from: f64,
    /// End.
    pub to: f64,
    /// Number of its colour.
    pub color: usize,
    /// Text at the pointer.
    pub tip: String,
}

/// A scale of one axis: values on `0..=length` pixels.
struct Scale {
    from: f64,
    to: f64,
    length: f64,
}

impl Scale {
    fn at(&self, value: f64) -> f64 {
        (value - self.from) / (self.to - self.from) * self.length
    }

    /// Round numbers on the axis, about one every `pixels`.
    fn ticks(&self, pixels: f64) -> Vec<f64> {
        let step = round_step((self.to - self.from) / (self.length / pixels).max(1.0));
        let first = (self.from / step).ceil() as i64;
        let last = (self.to / step).floor() as i64;
        (first..=last.min(first + 100)).map(|i| i as f64 * step).collect()
    }
}

/// 1, 2 or 5 times a power of ten, at least `least`.
fn round_step(least: f64) -> f64 {
    if !(least.is_finite() && least > 0.0) {
        return 1.0;
    }
    let power = 10.0_f64.powf(least.log10().floor());
    let factor = [1.0, 2.0, 5.0, 10.0].into_iter().find(|f| f * power >= least * 0.999_999).unwrap_or(10.0);
    factor * power
}

/// A number for a tick or a tip: six digits at most, a true minus sign.
#[must_use]
pub fn label(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return if value == 0.0 { "0".to_owned() } else { "–".to_owned() };
    }
    let size = value.abs();
    let text = if (1e-4..1e7).contains(&size) {
        let decimals = (5 - size.log10().floor() as i32).clamp(0, 8) as usize;
        let text = format!("{value:.decimals$}");
        if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
    } else {
        format!("{value:.2e}")
    };
    text.replace('-', "−")
}

/// The ends of an axis that holds `values`: a little more than they span, never empty.
fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let ends = values
        .filter(|v| v.is_finite())
        .fold(None, |ends: Option<(f64, f64)>, v| Some(ends.map_or((v, v), |(low, high)| (low.min(v), high.max(v)))));
    match ends {
        None => (0.0, 1.0),
        Some((low, high)) if high - low <= 1e-9 * high.abs().max(low.abs()).max(1e-9) => {
            let half = if low == 0.0 { 1.0 } else { 0.1 * low.abs() };
            (low - half, high + half)
        }
        Some((low, high)) => (low - 0.05 * (high - low), high + 0.05 * (high - low)),
    }
}

impl Chart {
    /// A chart of the usual height.
    #[must_use]
    pub fn new(title: impl Into<String>, x_name: impl Into<String>, y_name: impl Into<String>) -> Self {
        let (title, x_name, y_name) = (title.into(), x_name.into(), y_name.into());
        Self { title, x_name, y_name, height: 180, x_range: None, levels: Vec::new() }
    }

    /// The same between these ends of the x axis.
    #[must_use]
    pub fn between(self, from: f64, to: f64) -> Self {
        Self { x_range: Some((from, if to > from { to } else { from + 1.0 })), ..self }
    }

    /// The same with a horizontal line.
    #[must_use]
    pub fn level(mut self, value: f64, name: impl Into<String>) -> Self {
        self.levels.push((value, name.into()));
        self
    }

    /// Draws sets of data, each in its colour. Long ones are thinned to what can be seen: of all points on one pixel
    /// column, the first, lowest, highest and last are drawn.
    #[must_use]
    pub fn draw(&self, style: Style, series: &[Series]) -> Svg {
        let legend = legend_rows(series.iter().map(|s| s.name.as_str()), f64::from(WIDTH) - LEFT - RIGHT);
        let rows = if series.len() > 1 { legend.last().map_or(0, |(row, ..)| row + 1) } else { 0 };
        let top = 22.0 + ROW * rows as f64;
        let points = || series.iter().flat_map(|s| &s.points);
        let x = self.x_range.unwrap_or_else(|| {
            let (from, to) = points().fold((f64::MAX, f64::MIN), |(a, b), p| (a.min(p.0), b.max(p.0)));
            if from < to { (from, to) } else { range(points().map(|p| p.0)) }
        });
        let y = range(points().map(|p| p.1).chain(self.levels.iter().map(|l| l.0)));
        let (mut svg, x, y) = self.frame(top, x, y, true);
        if series.len() > 1 {
            for ((row, left, name), i) in legend.iter().zip(0..) {
                let (left, middle) = (LEFT + left, 8.0 + ROW * *row as f64);
                svg.block([left, middle - 2.0, 16.0, 4.0], &data_color(i), name);
                svg.text(left + 21.0, middle + 4.0, "", name);
            }
        }
        for (value, name) in &self.levels {
            let at = top + y.length - y.at(*value);
            svg.line([LEFT, at, LEFT + x.length, at], "dash");
            svg.text(LEFT + x.length - 4.0, at - 5.0, "end muted", name);
        }
        for (i, one) in series.iter().enumerate() {
            let place = |p: &(f64, f64)| (LEFT + x.at(p.0), top + y.length - y.at(p.1));
            let inside = |p: &&(f64, f64)| p.0 >= x.from && p.0 <= x.to;
            let color = data_color(i);
            for stretch in one.points.split(|p| !p.1.is_finite()) {
                let placed: Vec<_> = stretch.iter().filter(inside).map(place).collect();
                let thin = thinned(&placed);
                match style {
                    Style::Line if thin.len() > 1 => _ = svg.path(&thin, &color),
                    Style::Steps if thin.len() > 1 => {
                        let corners = thin.windows(2).flat_map(|w| [w[0], (w[1].0, w[0].1)]);
                        let corners: Vec<_> = corners.chain(thin.last().copied()).collect();
                        svg.path(&corners, &color);
                    }
                    Style::Line | Style::Steps | Style::Dots => {
                        for (cx, cy) in &thin {
                            let (cx, cy) = (format!("{cx:.1}"), format!("{cy:.1}"));
                            svg.element("circle", &[("cx", &cx), ("cy", &cy), ("r", "1.8"), ("fill", &color)]);
                        }
                    }
                }
            }
        }
        svg
    }

    /// Draws one column for each name and value, from zero.
    #[must_use]
    pub fn columns(&self, values: &[(String, f64)]) -> Svg {
        let top = 22.0;
        let n = values.len().max(1) as f64;
        let (low, high) = range(values.iter().map(|v| v.1).chain([0.0]).chain(self.levels.iter().map(|l| l.0)));
        let low = if low < 0.0 && values.iter().all(|v| v.1 >= 0.0) { 0.0 } else { low };
        let (mut svg, x, y) = self.frame(top, (0.0, n), (low, high), false);
        let zero = top + y.length - y.at(0.0_f64.max(low));
        let wide = x.length / n;
        // As many names as have room.
        let longest = values.iter().map(|v| v.0.chars().count()).max().unwrap_or(1) as f64;
        let every = ((longest * CHARACTER + 8.0) / wide).ceil().max(1.0) as usize;
        for (i, (name, value)) in values.iter().enumerate() {
            let left = LEFT + x.at(i as f64);
            let at = top + y.length - y.at(if value.is_finite() { *value } else { 0.0 });
            let thick = (0.8 * wide).min(MOST_THICK);
            let block = [left + 0.5 * (wide - thick), at.min(zero), thick, (at - zero).abs()];
            svg.block(block, &data_color(0), &format!("{name}: {}", label(*value)));
            if i.is_multiple_of(every) {
                svg.text(left + 0.5 * wide, top + y.length + 16.0, "middle", name);
            }
        }
        for (value, name) in &self.levels {
            let at = top + y.length - y.at(*value);
            svg.line([LEFT, at, LEFT + x.length, at], "dash");
            svg.text(LEFT + x.length - 4.0, at - 5.0, "end muted", name);
        }
        svg
    }

    /// Draws rows of spans over the x axis.
    #[must_use]
    pub fn timeline(&self, rows: &[(String, Vec<Span>)]) -> Svg {
        let ends = rows.iter().flat_map(|r| &r.1).fold((f64::MAX, f64::MIN), |(a, b), s| (a.min(s.from), b.max(s.to)));
        let (from, to) = self.x_range.unwrap_or(if ends.0 < ends.1 { ends } else { (0.0, 1.0) });
        let height = ROW * rows.len() as f64;
        let names = rows.iter().map(|r| r.0.chars().count()).max().unwrap_or(0) as f64 * CHARACTER + 16.0;
        let left = names.clamp(LEFT, 0.4 * f64::from(WIDTH));
        let mut svg = Svg::new(WIDTH, (6.0 + height + BOTTOM) as u32, &self.title);
        let x = Scale { from, to, length: f64::from(WIDTH) - left - RIGHT };
        for tick in x.ticks(90.0) {
            let at = left + x.at(tick);
            svg.line([at, 6.0, at, 6.0 + height], "grid");
            svg.text(at, 6.0 + height + 16.0, "middle", &label(tick));
        }
        for (i, (name, spans)) in rows.iter().enumerate() {
            let top = 6.0 + ROW * i as f64;
            svg.text(left - 8.0, top + 15.0, "end", name);
            svg.line([left, top + ROW, left + x.length, top + ROW], "grid");
            for span in merged(spans, x.length / (to - from)) {
                let (a, b) = (x.at(span.from.max(from)), x.at(span.to.min(to)));
                if b >= a {
                    svg.block([left + a, top + 4.0, (b - a).max(1.5), ROW - 8.0], &data_color(span.color), &span.tip);
                }
            }
        }
        svg.line([left, 6.0 + height, left + x.length, 6.0 + height], "axis");
        svg.text(left + 0.5 * x.length, 6.0 + height + 36.0, "middle muted", &self.x_name);
        svg
    }

    /// Grid, axes and labels.
    fn frame(&self, top: f64, x: (f64, f64), y: (f64, f64), x_ticks: bool) -> (Svg, Scale, Scale) {
        let height = f64::from(self.height);
        let bottom = if self.x_name.is_empty() { BOTTOM - 20.0 } else { BOTTOM };
        let mut svg = Svg::new(WIDTH, (top + height + bottom) as u32, &self.title);
        let x = Scale { from: x.0, to: x.1, length: f64::from(WIDTH) - LEFT - RIGHT };
        let y = Scale { from: y.0, to: y.1, length: height };
        for tick in y.ticks(42.0_f64.min(height / 3.0)) {
            let at = top + height - y.at(tick);
            svg.line([LEFT, at, LEFT + x.length, at], "grid");
            svg.text(LEFT - 8.0, at + 4.5, "end", &label(tick));
        }
        for tick in if x_ticks { x.ticks(90.0) } else { Vec::new() } {
            let at = LEFT + x.at(tick);
            svg.line([at, top, at, top + height], "grid");
            svg.text(at, top + height + 16.0, "middle", &label(tick));
        }
        svg.line([LEFT, top + height, LEFT + x.length, top + height], "axis");
        if !self.x_name.is_empty() {
            svg.text(LEFT + 0.5 * x.length, top + height + 36.0, "middle muted", &self.x_name);
        }
        svg.text(4.0, top - 8.0, "muted", &self.y_name);
        (svg, x, y)
    }
}

/// Row, left end and name of each entry of a legend.
fn legend_rows<'a>(names: impl Iterator<Item = &'a str>, width: f64) -> Vec<(usize, f64, &'a str)> {
    let (mut row, mut left) = (0, 0.0);
    names
        .map(|name| {
            let wide = 21.0 + CHARACTER * name.chars().count() as f64 + 18.0;
            if left > 0.0 && left + wide > width {
                (row, left) = (row + 1, 0.0);
            }
            let place = (row, left, name);
            left += wide;
            place
        })
        .collect()
}

/// First, lowest, highest and last point of each pixel column, in order.
fn thinned(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    if points.len() <= WIDTH as usize {
        return points.to_vec();
    }
    let mut kept = Vec::new();
    for column in points.chunk_by(|a, b| a.0.floor() == b.0.floor()) {
        let by_y = |a: &&(f64, f64), b: &&(f64, f64)| a.1.total_cmp(&b.1);
        let ends = [column.first(), column.iter().min_by(by_y), column.iter().max_by(by_y), column.last()];
        for point in ends.into_iter().flatten() {
            if kept.last() != Some(point) {
                kept.push(*point);
            }
        }
    }
    kept
}

/// Neighbours of one colour and text less than a pixel apart become one, so that a long run stays a small page.
fn merged(spans: &[Span], pixels: f64) -> Vec<Span> {
    let mut all: Vec<Span> = Vec::new();
    for span in spans {
        match all.last_mut() {
            Some(last) if last.color == span.color && last.tip == span.tip && (span.from - last.to) * pixels < 1.0 => {
                last.to = last.to.max(span.to);
            }
            _ => all.push(span.clone()),
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        let scale = Scale { from: -1.3, to: 9.9, length: 500.0 };
        assert_eq!(scale.ticks(100.0), [0.0, 5.0]);
        assert_eq!([0.7, 1.0, 1.1, 30.0, 0.0021].map(round_step), [1.0, 1.0, 2.0, 50.0, 0.005]);
        assert_eq!(round_step(f64::NAN), 1.0);
    }

    #[test]
    fn labels_are_short() {
        let values = [0.0, 0.1 + 0.2, -1234.5, 3012.123456, 1e9, 12.0, f64::NAN];
        assert_eq!(values.map(label), ["0", "0.3", "−1234.5", "3012.12", "1.00e9", "12", "–"]);
    }

    #[test]
    fn axes_hold_their_values_and_are_never_empty() {
        assert_eq!(range([].into_iter()), (0.0, 1.0));
        assert_eq!(range([1000.0].into_iter()), (900.0, 1100.0));
        assert_eq!(range([0.0, f64::NAN, 10.0].into_iter()), (-0.5, 10.5));
    }

    #[test]
    fn a_line_passes_through_its_points_and_parts_at_gaps() {
        let points = vec![(0.0, 0.0), (1.0, 1.0), (2.0, f64::NAN), (3.0, 0.5), (4.0, 0.5)];
        let chart = Chart { height: 110, ..Chart::new("t", "time (s)", "value") };
        let text = chart.draw(Style::Line, &[Series { name: "a".into(), points }]).to_text();
        // y runs from −0.05 to 1.05 over 110 pixels below 22, x from 0 to 4 over 830 right of 74.
        assert!(text.contains("d=\"M74 127L281.5 27\"") && text.contains("d=\"M696.5 77L904 77\""), "{text}");
    }

    #[test]
    fn long_data_is_thinned_but_keeps_its_peaks() {
        let mut points: Vec<(f64, f64)> = (0..100_000).map(|i| (f64::from(i) * 0.008, 0.0)).collect();
        points[51_234].1 = 7.0;
        let thin = thinned(&points);
        assert!(thin.len() < 4000 && thin.contains(&points[51_234]), "{}", thin.len());
    }

    #[test]
    fn spans_lie_where_they_belong_and_neighbours_become_one() {
        let span = |from, to, tip: &str| Span { from, to, color: 1, tip: tip.into() };
        let chart = Chart::new("t", "time (s)", "").between(0.0, 10.0);
        let spans: Vec<_> =
            (0..1000).map(|i| span(f64::from(i) * 0.005, f64::from(i) * 0.005 + 0.005, "held")).collect();
        let text = chart.timeline(&[("flags".into(), spans)]).to_text();
        assert_eq!(text.matches("<rect").count(), 1, "{text}");
        assert!(text.contains("x=\"74\"") && text.contains("width=\"415\""), "{text}");
    }

    #[test]
    fn columns_start_at_zero() {
        let chart = Chart { height: 100, ..Chart::new("t", "latent", "times") };
        let text = chart.columns(&[("0".into(), 100.0), ("1".into(), 0.0)]).to_text();
        assert!(text.contains("height=\"95.24\"") && text.contains("<title>0: 100</title>"), "{text}");
    }
}
