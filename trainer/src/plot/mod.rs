//! Figures as SVG text: learning curves, latent usage, float-against-int8 action error, episodes over time, values by latent, maps of
//! coloured cells, clouds of points, and several of them on a sheet.
//!
//! A figure is self-contained, scales without loss, and carries its own colours for light and dark surroundings
//! (`prefers-color-scheme`). It can stand alone as a file or inline in an HTML page.

pub mod actions;
mod axis;
pub mod bars;
pub mod curve;
pub mod episode;
pub mod latents;
pub mod map;
pub mod scatter;
pub mod sheet;
mod theme;
pub mod usage;

pub use actions::action_error;
pub use bars::{GroupedBars, grouped_bars};
pub use curve::{CurvePanel, CurvePoint, RunCurve, learning_curve, learning_curves, read_run};
pub use episode::{Panel, Series, episode};
pub use latents::{LatentPanel, by_latent};
pub use map::{Map, Mark, Paint, Shape, map, maps};
pub use scatter::{Class, Cloud, CloudAxes, clouds};
pub use sheet::{picture, sheet};
pub(crate) use theme::escape;
pub use usage::latent_usage;

use crate::metrics::MetricsError;
use std::path::PathBuf;

/// Size and title of a figure.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PlotOptions {
    /// Text above the figure, also its accessible name.
    pub title: String,
    /// Width in CSS pixels.
    pub width: u32,
    /// Height in CSS pixels; for [`episode()`], of one panel.
    pub height: u32,
}

impl PlotOptions {
    /// The default size (720 × 420) with `title`.
    pub fn new(title: impl Into<String>) -> Self {
        Self { title: title.into(), width: 720, height: 420 }
    }

    /// The same with another size in CSS pixels.
    #[must_use]
    pub fn with_size(self, width: u32, height: u32) -> Self {
        Self { width, height, ..self }
    }
}

/// A figure could not be drawn.
#[derive(Debug, thiserror::Error)]
pub enum PlotError {
    /// There is nothing to draw.
    #[error("nothing to draw: {0}")]
    NoData(&'static str),
    /// A run folder holds no evaluation.
    #[error("{} holds no finite `{key}`: the run has not been evaluated yet", path.display())]
    NoEvaluation {
        /// The metrics file.
        path: PathBuf,
        /// The metric looked for.
        key: &'static str,
    },
    /// Two lists that belong together differ in length.
    #[error("{what}: {left} values against {right}")]
    Lengths {
        /// The lists.
        what: &'static str,
        /// Length of the first.
        left: usize,
        /// Length of the second.
        right: usize,
    },
    /// The metrics could not be read.
    #[error(transparent)]
    Metrics(#[from] MetricsError),
    /// The figure has no room for what it must show.
    #[error("{width} × {height} px are too small for the figure: make it at least {} × {} px", needed.0, needed.1)]
    TooSmall {
        /// Width in CSS pixels.
        width: u32,
        /// Height in CSS pixels.
        height: u32,
        /// Width and height that are needed, in CSS pixels.
        needed: (u32, u32),
    },
    /// The plotting library refused.
    #[error("cannot draw the figure: {0}")]
    Draw(String),
}
