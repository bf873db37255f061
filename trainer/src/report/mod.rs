//! The report of a run for people: one HTML file that needs nothing but itself.
//!
//! [`Report`] collects what is to be said, verdict first, and [`Report::to_html`] writes it down. Every text is escaped. The page has no
//! script and loads nothing: its figures are inline SVG and its content security policy forbids everything else.

mod html;

/// A report under construction. Sections appear in the order they are added; the verdict is always first.
///
/// # Examples
/// ```
/// use gadm_trainer::report::{Column, Report};
/// let mut report = Report::new("inverted-pendulum-v5, seed 1");
/// report.verdict(true, "Mean return 1000 in all three forms.");
/// report.table("Returns", vec![Column::text("policy"), Column::number("mean")], vec![vec!["int8".into(), "1000".into()]])?;
/// let page = report.to_html();
/// assert!(page.starts_with("<!DOCTYPE html>") && page.contains("Mean return 1000"));
/// # Ok::<(), gadm_trainer::report::ReportError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Report {
    title: String,
    verdicts: Vec<Verdict>,
    sections: Vec<Section>,
}

/// One judgement.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Verdict {
    ok: bool,
    text: String,
}

/// A part of the page with its heading.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Section {
    heading: String,
    content: Content,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Content {
    Text(String),
    Facts(Vec<(String, String)>),
    Table { columns: Vec<Column>, rows: Vec<Vec<String>> },
    Figure { svg: String, caption: String },
    Code(String),
    Files(Vec<FileLink>),
}

/// A column of a data table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Column {
    name: String,
    numeric: bool,
}

impl Column {
    /// A column of words, aligned left.
    pub fn text(name: impl Into<String>) -> Self {
        Self { name: name.into(), numeric: false }
    }

    /// A column of numbers, aligned right.
    pub fn number(name: impl Into<String>) -> Self {
        Self { name: name.into(), numeric: true }
    }
}

/// A file in the folder of the report.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FileLink {
    /// Path relative to the report.
    pub path: String,
    /// What the file is.
    pub description: String,
}

/// A section does not fit a report.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum ReportError {
    /// A row has another number of cells than the table has columns.
    #[error("table `{heading}`: row {row} has {found} cells for {expected} columns")]
    RowLength {
        /// Heading of the table.
        heading: String,
        /// Row from 0.
        row: usize,
        /// Number of columns.
        expected: usize,
        /// Number of cells.
        found: usize,
    },
    /// A figure is not an SVG element, or could run or load something.
    #[error("figure `{heading}`: {reason}; figures come from the `plot` module")]
    Figure {
        /// Heading of the figure.
        heading: String,
        /// What is wrong.
        reason: &'static str,
    },
    /// A link leaves the report's folder.
    #[error("link `{path}` must be a path relative to the report, inside its folder")]
    Link {
        /// The path.
        path: String,
    },
}

impl Report {
    /// An empty report.
    pub fn new(title: impl Into<String>) -> Self {
        Self { title: title.into(), verdicts: Vec::new(), sections: Vec::new() }
    }

    /// Adds a judgement: what was to be reached, whether it was, and by what.
    pub fn verdict(&mut self, ok: bool, text: impl Into<String>) -> &mut Self {
        self.verdicts.push(Verdict { ok, text: text.into() });
        self
    }

    /// Adds paragraphs, parted by empty lines.
    pub fn text(&mut self, heading: impl Into<String>, text: impl Into<String>) -> &mut Self {
        self.push(heading, Content::Text(text.into()))
    }

    /// Adds a table of names and values.
    pub fn facts<K: Into<String>, V: Into<String>>(
        &mut self,
        heading: impl Into<String>,
        facts: impl IntoIterator<Item = (K, V)>,
    ) -> &mut Self {
        let facts = facts.into_iter().map(|(name, value)| (name.into(), value.into())).collect();
        self.push(heading, Content::Facts(facts))
    }

    /// Adds a data table.
    ///
    /// # Errors
    /// [`ReportError::RowLength`].
    pub fn table(
        &mut self,
        heading: impl Into<String>,
        columns: Vec<Column>,
        rows: Vec<Vec<String>>,
    ) -> Result<&mut Self, ReportError> {
        let heading = heading.into();
        if let Some(row) = rows.iter().position(|row| row.len() != columns.len()) {
            let (expected, found) = (columns.len(), rows[row].len());
            return Err(ReportError::RowLength { heading, row, expected, found });
        }
        Ok(self.push(heading, Content::Table { columns, rows }))
    }

    /// Adds a figure: an SVG element as [`crate::plot`] makes it.
    ///
    /// # Errors
    /// [`ReportError::Figure`].
    pub fn figure(
        &mut self,
        heading: impl Into<String>,
        svg: impl Into<String>,
        caption: impl Into<String>,
    ) -> Result<&mut Self, ReportError> {
        let (heading, svg) = (heading.into(), svg.into());
        match fault_of_figure(&svg) {
            Some(reason) => Err(ReportError::Figure { heading, reason }),
            None => Ok(self.push(heading, Content::Figure { svg, caption: caption.into() })),
        }
    }

    /// Adds preformatted text, such as a command or a configuration.
    pub fn code(&mut self, heading: impl Into<String>, code: impl Into<String>) -> &mut Self {
        self.push(heading, Content::Code(code.into()))
    }

    /// Adds links to files in the report's folder.
    ///
    /// # Errors
    /// [`ReportError::Link`].
    pub fn files(&mut self, heading: impl Into<String>, files: Vec<FileLink>) -> Result<&mut Self, ReportError> {
        for FileLink { path, .. } in &files {
            let leaves = path.split(['/', '\\']).any(|part| part == "..");
            if path.is_empty() || leaves || path.starts_with(['/', '\\']) || path.contains(':') {
                return Err(ReportError::Link { path: path.clone() });
            }
        }
        Ok(self.push(heading, Content::Files(files)))
    }

    /// The page.
    pub fn to_html(&self) -> String {
        html::page(self)
    }

    fn push(&mut self, heading: impl Into<String>, content: Content) -> &mut Self {
        self.sections.push(Section { heading: heading.into(), content });
        self
    }
}

/// Why `svg` must not be put into a page.
fn fault_of_figure(svg: &str) -> Option<&'static str> {
    let lower = svg.trim().to_ascii_lowercase();
    if !lower.starts_with("<svg") || !lower.ends_with("</svg>") || lower.matches("<svg").count() != 1 {
        return Some("it is not one SVG element");
    }
    let forbidden = ["<script", "<foreignobject", "<iframe", "<image", "href=", "@import", "url(", " on"];
    // Event handlers are attributes: look for ` on…=` inside tags only, where texts cannot be.
    let tags = lower.split('<').map(|part| part.split('>').next().unwrap_or_default());
    let in_tags = tags.map(|tag| format!("<{tag}")).any(|tag| {
        let unquoted: String = tag.split('"').step_by(2).collect();
        forbidden.iter().any(|word| unquoted.contains(word))
    });
    (in_tags || lower.contains("@import") || lower.contains("url(")).then_some("it holds a script, a link or an event")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_must_match_the_columns() {
        let columns = vec![Column::text("a"), Column::number("b")];
        let rows = vec![vec!["x".into(), "1".into()], vec!["y".into()]];
        let error = Report::new("t").table("Returns", columns, rows).unwrap_err();
        assert_eq!(error, ReportError::RowLength { heading: "Returns".into(), row: 1, expected: 2, found: 1 });
    }

    #[test]
    fn figures_must_be_harmless_svg() {
        let mut report = Report::new("t");
        report.figure("f", "<svg width=\"1\"><text>turn on = off; href=x</text></svg>", "").unwrap();
        for bad in [
            "<p>x</p>",
            "<svg></svg><script>x</script>",
            "<svg></svg><svg></svg>",
            "<svg><script>x</script></svg>",
            "<svg onload=\"x\"></svg>",
            "<svg><a href=\"https://example.org\"></a></svg>",
            "<svg><style>@import 'x';</style></svg>",
        ] {
            assert!(matches!(report.figure("f", bad, ""), Err(ReportError::Figure { .. })), "{bad}");
        }
    }

    #[test]
    fn links_stay_in_the_folder() {
        let link = |path: &str| vec![FileLink { path: path.into(), description: String::new() }];
        let mut report = Report::new("t");
        report.files("Files", link("checkpoints/last.bin")).unwrap();
        for bad in ["", "/etc/passwd", "../x", "a/../../x", "https://example.org", "javascript:x"] {
            assert!(matches!(report.files("Files", link(bad)), Err(ReportError::Link { .. })), "{bad}");
        }
    }
}
