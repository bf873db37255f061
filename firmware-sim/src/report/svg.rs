//! SVG as text, element by element, so that no text or attribute gets into a page unescaped.

use std::fmt::Write as _;

/// A drawing of a size, to be shown inline in a [`Page`](super::Page), whose style sheet gives the colours.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Svg {
    width: u32,
    height: u32,
    title: String,
    body: String,
}

/// `text` for HTML and SVG, in text and in quoted attributes.
#[must_use]
pub fn escape(text: &str) -> String {
    text.chars().fold(String::with_capacity(text.len()), |mut escaped, c| {
        match c {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            // Not allowed in XML at all.
            '\0'..='\u{8}' | '\u{b}' | '\u{c}' | '\u{e}'..='\u{1f}' => escaped.push('\u{fffd}'),
            c => escaped.push(c),
        }
        escaped
    })
}

/// The variable of the page's style sheet that holds the `i`-th colour of data.
#[must_use]
pub fn data_color(i: usize) -> String {
    format!("var(--data-{})", i % 8)
}

impl Svg {
    /// An empty drawing in CSS pixels; `title` is its name for those who cannot see it.
    #[must_use]
    pub fn new(width: u32, height: u32, title: impl Into<String>) -> Self {
        Self { width, height, title: title.into(), body: String::new() }
    }

    /// Width, CSS pixels.
    #[must_use]
    pub fn width(&self) -> f64 {
        f64::from(self.width)
    }

    /// Height, CSS pixels.
    #[must_use]
    pub fn height(&self) -> f64 {
        f64::from(self.height)
    }

    /// Adds an empty element.
    pub fn element(&mut self, name: &'static str, attributes: &[(&'static str, &str)]) -> &mut Self {
        self.open(name, attributes);
        self.body.push_str("/>\n");
        self
    }

    /// Adds an element with a text in it; for `text`, or with a `title` shown at the pointer.
    pub fn text(&mut self, x: f64, y: f64, class: &'static str, text: &str) -> &mut Self {
        self.open("text", &[("x", &number(x)), ("y", &number(y)), ("class", class)]);
        // Writing to a String cannot fail.
        let _ = writeln!(self.body, ">{}</text>", escape(text));
        self
    }

    /// Adds a filled rectangle with a text shown at the pointer.
    pub fn block(&mut self, [x, y, width, height]: [f64; 4], fill: &str, tip: &str) -> &mut Self {
        let attributes = [x, y, width.max(0.0), height.max(0.0)].map(number);
        let [x, y, width, height] = &attributes;
        self.open("rect", &[("x", x), ("y", y), ("width", width), ("height", height), ("fill", fill)]);
        // Writing to a String cannot fail.
        let _ = writeln!(self.body, "><title>{}</title></rect>", escape(tip));
        self
    }

    /// Adds a straight line.
    pub fn line(&mut self, [x1, y1, x2, y2]: [f64; 4], class: &'static str) -> &mut Self {
        let [x1, y1, x2, y2] = &[x1, y1, x2, y2].map(number);
        self.element("line", &[("x1", x1), ("y1", y1), ("x2", x2), ("y2", y2), ("class", class)])
    }

    /// Adds a line through points.
    pub fn path(&mut self, points: &[(f64, f64)], stroke: &str) -> &mut Self {
        let mut d = String::with_capacity(points.len() * 12);
        for (i, (x, y)) in points.iter().enumerate() {
            let _ = write!(d, "{}{} {}", if i == 0 { 'M' } else { 'L' }, number(*x), number(*y));
        }
        self.element("path", &[("d", &d), ("class", "line"), ("stroke", stroke)])
    }

    /// The element as text.
    #[must_use]
    pub fn to_text(&self) -> String {
        let Self { width, height, title, body } = self;
        let title = escape(title);
        format!(
            "<svg viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" role=\"img\" \
             aria-label=\"{title}\">\n<title>{title}</title>\n{body}</svg>"
        )
    }

    fn open(&mut self, name: &'static str, attributes: &[(&'static str, &str)]) {
        let _ = write!(self.body, "<{name}");
        for (name, value) in attributes {
            let _ = write!(self.body, " {name}=\"{}\"", escape(value));
        }
    }
}

/// Two decimals are a hundredth of a pixel.
fn number(value: f64) -> String {
    if !value.is_finite() {
        return "0".to_owned();
    }
    let text = format!("{value:.2}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_text_and_attribute_is_escaped() {
        let hostile = "\"><script>alert('&')</script>\u{1}";
        let mut svg = Svg::new(10, 20, hostile);
        svg.text(1.0, 2.0, "muted", hostile).block([0.0; 4], hostile, hostile).path(&[(0.0, 0.0)], hostile);
        let text = svg.to_text();
        assert!(!text.contains("<script") && !text.contains('\u{1}'), "{text}");
        assert_eq!(text.matches("&quot;&gt;&lt;script&gt;alert(&#39;&amp;&#39;)").count(), 6, "{text}");
    }

    #[test]
    fn numbers_are_short_and_always_numbers() {
        assert_eq!([1.0, 2.5, -0.001, 1e3, 0.126, f64::NAN].map(number), ["1", "2.5", "0", "1000", "0.13", "0"]);
    }
}
