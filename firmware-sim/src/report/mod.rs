//! What a run or a campaign shows to people: pages that need nothing but themselves.
//!
//! | module | holds |
//! | --- | --- |
//! | [`page`] | a page: verdicts, tables, figures, pictures, commands |
//! | [`recording`], [`run`] | what a run leaves behind for its report; the report |
//! | [`chart`] | lines, dots, columns and timelines |
//! | [`svg`] | drawing elements with every text escaped |

pub mod chart;
mod html;
pub mod page;
pub mod recording;
pub mod run;
pub mod svg;

pub use page::{Cell, Mark, Page};
pub use recording::{Episode, FILM_WIDTH, Recording};
pub use run::{About, run_report};
pub use svg::Svg;
