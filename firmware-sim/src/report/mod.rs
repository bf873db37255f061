//! What a run or a campaign shows to people: pages that need nothing but themselves.
//!
//! | module | holds |
//! | --- | --- |
//! | [`page`] | a page: verdicts, tables, figures, pictures, commands |
//! | [`chart`] | lines, dots, columns and timelines |
//! | [`svg`] | drawing elements with every text escaped |

pub mod chart;
mod html;
pub mod page;
pub mod svg;

pub use page::{Cell, Mark, Page};
pub use svg::Svg;
