//! The heat map: faults down, intensities from left to right, the return that is lost as colour.

use super::record::NOMINAL;
use super::{Campaign, Tally};
use crate::report::Svg;

const LEFT: f64 = 220.0;
const TOP: f64 = 34.0;
const ROW: f64 = 34.0;
const COLUMN: f64 = 96.0;
/// Classes of texts.
const PALE: &str = "on-pale";
const DARK: &str = "on-dark";

/// The map as a file of its own.
pub(super) fn svg(found: &Campaign) -> String {
    // The style sheet of a page gives drawings their looks; this one stands alone.
    let head = "<svg xmlns=\"http://www.w3.org/2000/svg\" ";
    let style = "<style>text{font:12px sans-serif}.on-pale{fill:#222}.on-dark{fill:#fff}</style>\n<title>";
    drawing(found).to_text().replacen("<svg ", head, 1).replacen("<title>", style, 1)
}

fn drawing(found: &Campaign) -> Svg {
    let faults = rows(found);
    let columns = faults.iter().map(|(_, cells)| cells.len()).max().unwrap_or(1);
    let (width, height) = (LEFT + COLUMN * columns as f64 + 10.0, TOP + ROW * faults.len() as f64 + 10.0);
    let mut svg = Svg::new(width as u32, height as u32, format!("{}: return against nominal", found.name));
    svg.block([0.0, 0.0, width, height], "#ffffff", "");
    svg.text(8.0, 20.0, PALE, &format!("{}: return left of nominal, ✗ = criteria missed", found.name));
    for (i, (fault, cells)) in faults.iter().enumerate() {
        let y = TOP + ROW * i as f64;
        svg.text(8.0, y + 21.0, PALE, fault);
        for (j, tally) in cells.iter().enumerate() {
            let x = LEFT + COLUMN * j as f64;
            let left = tally.return_ratio.unwrap_or(0.0);
            let (fill, ink) = colour(left);
            let missed = if tally.passed < tally.runs { " ✗" } else { "" };
            let tip = format!("{fault} {}: {:.0} % of the nominal return{missed}", tally.intensity, left * 100.0);
            svg.block([x + 1.0, y + 1.0, COLUMN - 2.0, ROW - 2.0], &fill, &tip);
            svg.text(x + 6.0, y + 15.0, ink, &tally.intensity);
            svg.text(x + 6.0, y + 29.0, ink, &format!("{:.0} %{missed}", left * 100.0));
        }
    }
    svg
}

/// Faults with their intensities, without the nominal runs.
pub(super) fn rows(found: &Campaign) -> Vec<(&str, Vec<&Tally>)> {
    let mut rows: Vec<(&str, Vec<&Tally>)> = Vec::new();
    for tally in found.tallies.iter().filter(|t| t.fault != NOMINAL) {
        match rows.last_mut().filter(|(name, _)| *name == tally.fault) {
            Some((_, cells)) => cells.push(tally),
            None => rows.push((&tally.fault, vec![tally])),
        }
    }
    rows
}

/// White where nothing is lost of the return, to dark orange for all of it: readable without telling red from green. Also
/// the ink on it.
fn colour(left: f64) -> (String, &'static str) {
    let t = 1.0 - left.clamp(0.0, 1.0);
    let mix = |a: f64, b: f64| (a + (b - a) * t).round() as u8;
    let fill = format!("#{:02x}{:02x}{:02x}", mix(255.0, 166.0), mix(250.0, 68.0), mix(245.0, 0.0));
    (fill, if t > 0.55 { DARK } else { PALE })
}
