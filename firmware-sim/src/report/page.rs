//! A page under construction: verdicts first, then sections in the order they are added.
//!
//! Every text is escaped, figures come from [`Svg`] alone, and the page's content security policy forbids everything
//! but its own styles and pictures: it has no script and loads nothing. It is light or dark as the reader's system is.

use super::html;
use super::svg::Svg;

/// How something was judged. The word carries the meaning; the colour only repeats it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mark {
    /// What was required was reached.
    Met,
    /// It was not.
    Missed,
    /// Nothing was required, but a reader should know.
    Note,
}

impl Mark {
    /// [`Met`](Mark::Met) or [`Missed`](Mark::Missed).
    #[must_use]
    pub fn of(met: bool) -> Self {
        if met { Self::Met } else { Self::Missed }
    }

    /// The word shown.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Met => "Met",
            Self::Missed => "Missed",
            Self::Note => "Note",
        }
    }

    /// The style class.
    pub(super) const fn class(self) -> &'static str {
        match self {
            Self::Met => "met",
            Self::Missed => "missed",
            Self::Note => "note",
        }
    }
}

/// A cell of a table.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cell {
    pub(super) text: String,
    pub(super) numeric: bool,
    pub(super) mark: Option<Mark>,
    pub(super) heat: Option<f64>,
}

impl Cell {
    /// Words, aligned left.
    #[must_use]
    pub fn text(text: impl Into<String>) -> Self {
        Self { text: text.into(), ..Self::default() }
    }

    /// A number as it should be shown, aligned right.
    #[must_use]
    pub fn number(text: impl Into<String>) -> Self {
        Self { text: text.into(), numeric: true, ..Self::default() }
    }

    /// A mark with its word.
    #[must_use]
    pub fn mark(mark: Mark) -> Self {
        Self { text: mark.word().to_owned(), mark: Some(mark), ..Self::default() }
    }

    /// The same in the colour of `mark`.
    #[must_use]
    pub fn marked(self, mark: Mark) -> Self {
        Self { mark: Some(mark), ..self }
    }

    /// The same on a ground between none (0) and full colour (1), as in a heat map. Not-a-number leaves the ground.
    #[must_use]
    pub fn shaded(self, heat: f64) -> Self {
        Self { heat: heat.is_finite().then(|| heat.clamp(0.0, 1.0)), ..self }
    }
}

impl From<&str> for Cell {
    fn from(text: &str) -> Self {
        Self::text(text)
    }
}

impl From<String> for Cell {
    fn from(text: String) -> Self {
        Self::text(text)
    }
}

/// A picture as it lies in a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Media type: `image/gif`, `image/png`.
    pub media: &'static str,
    /// The file.
    pub bytes: Vec<u8>,
    /// What it shows, in words.
    pub alt: String,
}

#[derive(Clone, Debug, PartialEq)]
pub(super) enum Block {
    Text(String),
    Facts(Vec<(String, String)>),
    Table { columns: Vec<Cell>, rows: Vec<Vec<Cell>> },
    Figure { svg: Svg, caption: String },
    Picture { picture: Picture, still: Option<Picture>, caption: String },
    Code(String),
}

#[derive(Clone, Debug, PartialEq)]
pub(super) struct Section {
    pub(super) heading: String,
    pub(super) blocks: Vec<Block>,
}

/// A page.
///
/// ```
/// use gadm_sim::report::{Cell, Mark, Page};
/// let mut page = Page::new("hopper-v5 over CAN");
/// page.verdict(Mark::Met, "mean return 3012, required 3000");
/// page.section("Criteria").table(["criterion", "found", ""], [vec![
///     Cell::text("return"), Cell::number("3012"), Cell::mark(Mark::Met),
/// ]]);
/// page.section("Command to repeat").code("gadm-sim run policy.bin --seed 1");
/// assert!(page.to_html().starts_with("<!DOCTYPE html>"));
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Page {
    pub(super) title: String,
    pub(super) lead: String,
    pub(super) verdicts: Vec<(Mark, String)>,
    pub(super) sections: Vec<Section>,
}

impl Page {
    /// An empty page.
    #[must_use]
    pub fn new(title: impl Into<String>) -> Self {
        Self { title: title.into(), lead: String::new(), verdicts: Vec::new(), sections: Vec::new() }
    }

    /// One line under the title: what, with what, where.
    pub fn lead(&mut self, text: impl Into<String>) -> &mut Self {
        self.lead = text.into();
        self
    }

    /// Adds a judgement: what was required and what was found.
    pub fn verdict(&mut self, mark: Mark, text: impl Into<String>) -> &mut Self {
        self.verdicts.push((mark, text.into()));
        self
    }

    /// Starts a section; what is added from here on belongs to it.
    pub fn section(&mut self, heading: impl Into<String>) -> &mut Self {
        self.sections.push(Section { heading: heading.into(), blocks: Vec::new() });
        self
    }

    /// Adds paragraphs, parted by empty lines.
    pub fn text(&mut self, text: impl Into<String>) -> &mut Self {
        self.push(Block::Text(text.into()))
    }

    /// Adds a table of names and values.
    pub fn facts<K: Into<String>, V: Into<String>>(&mut self, facts: impl IntoIterator<Item = (K, V)>) -> &mut Self {
        self.push(Block::Facts(facts.into_iter().map(|(name, value)| (name.into(), value.into())).collect()))
    }

    /// Adds a table. Short rows are filled with empty cells. A column with a number is aligned as numbers are.
    pub fn table<C: Into<Cell>>(
        &mut self,
        columns: impl IntoIterator<Item = C>,
        rows: impl IntoIterator<Item = Vec<Cell>>,
    ) -> &mut Self {
        let mut columns: Vec<Cell> = columns.into_iter().map(Into::into).collect();
        let mut rows: Vec<Vec<Cell>> = rows.into_iter().collect();
        let width = rows.iter().map(Vec::len).max().unwrap_or(0).max(columns.len());
        columns.resize_with(width, Cell::default);
        for row in &mut rows {
            row.resize_with(width, Cell::default);
        }
        for (i, column) in columns.iter_mut().enumerate() {
            column.numeric |= rows.iter().any(|row| row[i].numeric);
        }
        self.push(Block::Table { columns, rows })
    }

    /// Adds a drawing with its caption.
    pub fn figure(&mut self, svg: Svg, caption: impl Into<String>) -> &mut Self {
        self.push(Block::Figure { svg, caption: caption.into() })
    }

    /// Adds a picture, embedded; `still` is shown instead to readers who ask for no motion.
    pub fn picture(&mut self, picture: Picture, still: Option<Picture>, caption: impl Into<String>) -> &mut Self {
        self.push(Block::Picture { picture, still, caption: caption.into() })
    }

    /// Adds preformatted text, such as a command.
    pub fn code(&mut self, code: impl Into<String>) -> &mut Self {
        self.push(Block::Code(code.into()))
    }

    /// The page as HTML.
    #[must_use]
    pub fn to_html(&self) -> String {
        html::page(self)
    }

    fn push(&mut self, block: Block) -> &mut Self {
        match self.sections.last_mut() {
            Some(section) => section.blocks.push(block),
            None => self.sections.push(Section { heading: String::new(), blocks: vec![block] }),
        }
        self
    }
}
