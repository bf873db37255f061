//! The picture of a bus on a terminal.
//!
//! Words and numbers carry everything; colours, where the terminal has them and `NO_COLOR` is not set, only repeat it.

use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{
    Bar, BarChart, BarGroup, Block, Cell, Gauge, Paragraph, Row as TableRow, Table, TableState, Wrap,
};
use serde_json::{Map, Value};

use super::model::{Node, Row, Snapshot};
use super::source::End;

/// Bus load from which on it is marked, per cent.
const HIGH_LOAD: f64 = 70.0;

/// What of the view a person changes, and what is not in the picture.
#[derive(Clone, Debug, Default)]
pub struct View {
    /// Where the frames come from.
    pub source: String,
    /// Colours may be used.
    pub color: bool,
    /// The picture stands still.
    pub paused: bool,
    /// The source has ended.
    pub ended: Option<End>,
    /// Selected line of the table and the first one shown.
    pub table: TableState,
}

impl View {
    /// Moves the selection by `lines`, within a table of `rows`.
    pub fn select(&mut self, lines: i32, rows: usize) {
        let last = rows.saturating_sub(1);
        let now = self.table.selected().unwrap_or(0).min(last);
        self.table.select(Some(now.saturating_add_signed(lines as isize).min(last)));
    }

    fn style(&self, color: Color) -> Style {
        if self.color { Style::new().fg(color) } else { Style::new() }
    }

    /// Draws the picture.
    pub fn draw(&mut self, frame: &mut Frame<'_>, now: &Snapshot) {
        let middle = if now.latent_counts.is_empty() { 3 + now.nodes.len().min(4) as u16 } else { 9 };
        let chosen = self.table.selected().and_then(|i| now.rows.get(i));
        let [head, middle, table, detail, foot] = Layout::vertical([
            Constraint::Length(2),
            Constraint::Length(middle),
            Constraint::Min(4),
            Constraint::Length(if chosen.is_some() { 5 } else { 0 }),
            Constraint::Length(1),
        ])
        .areas(frame.area());
        self.head(frame, head, now);
        let [nodes, latents] = if now.latent_counts.is_empty() {
            Layout::horizontal([Constraint::Fill(1), Constraint::Length(0)]).areas(middle)
        } else {
            Layout::horizontal([Constraint::Fill(1), Constraint::Fill(1)]).areas(middle)
        };
        self.nodes(frame, nodes, now);
        if !now.latent_counts.is_empty() {
            self.latents(frame, latents, now);
        }
        self.rows(frame, table, now);
        if let Some(row) = chosen {
            let text = row.error.as_ref().map_or_else(|| signals(&row.signals), |error| format!("!! {error}"));
            let block = Block::bordered().title(format!(" {} ", row.name));
            frame.render_widget(Paragraph::new(text).wrap(Wrap { trim: true }).block(block), detail);
        }
        let keys = " q quit   space pause   r start anew   up/down select ";
        frame.render_widget(Paragraph::new(keys).style(Style::new().add_modifier(Modifier::DIM)), foot);
    }

    fn head(&self, frame: &mut Frame<'_>, area: Rect, now: &Snapshot) {
        let [line, gauge] = Layout::vertical([Constraint::Length(1), Constraint::Length(1)]).areas(area);
        let mut words = vec![
            Span::styled(self.source.clone(), Style::new().add_modifier(Modifier::BOLD)),
            Span::raw(format!(
                "  {:.1} s  {} frames  {:.0}/s{}",
                now.time_us as f64 / 1e6,
                now.frames,
                now.rate_hz,
                now.profile.map_or_else(String::new, |p| format!("  {p}"))
            )),
        ];
        for (count, what) in [(now.error_frames, "error frames"), (now.bad_lines, "lines that are no frame")] {
            if count > 0 {
                words.push(Span::styled(format!("  {count} {what}"), self.style(Color::LightRed)));
            }
        }
        match (&self.ended, self.paused) {
            (Some(End::Broken(why)), _) => {
                words.push(Span::styled(format!("  ENDED: {why}"), self.style(Color::LightRed)));
            }
            (Some(End::Done), _) => words.push(Span::raw("  END OF TRACE")),
            (None, true) => words.push(Span::raw("  PAUSED")),
            (None, false) => {}
        }
        frame.render_widget(Paragraph::new(Line::from(words)), line);
        let load = now.load_percent.unwrap_or(0.0);
        let high = load >= HIGH_LOAD;
        let rate = if now.profile == Some("fd-f32") {
            format!("{}/{} kbit/s", now.bit_rate.nominal / 1000, now.bit_rate.data / 1000)
        } else {
            format!("{} kbit/s", now.bit_rate.nominal / 1000)
        };
        let text = match now.load_percent {
            None => format!("load: too early to tell ({rate})"),
            Some(load) => format!("load {load:.1} % of {rate}, worst case{}", if high { " HIGH" } else { "" }),
        };
        let style = self.style(if high { Color::LightRed } else { Color::Cyan });
        frame.render_widget(
            Gauge::default().ratio((load / 100.0).clamp(0.0, 1.0)).label(text).gauge_style(style),
            gauge,
        );
    }

    fn nodes(&self, frame: &mut Frame<'_>, area: Rect, now: &Snapshot) {
        let mut lines = Vec::new();
        for node in &now.nodes {
            lines.push(self.node_line(node));
            let pages = ["misses", "torn_sets", "sequence", "crc_errors", "invalid", "safe_entries", "inference_us"];
            let known: Vec<String> =
                pages.iter().filter_map(|p| node.pages.get(*p).map(|v| format!("{p} {v}"))).collect();
            if !known.is_empty() && !now.latent_counts.is_empty() {
                lines.push(Line::from(format!("  {}", known.join("  "))));
            }
            if node.fault != "NONE" {
                lines.push(Line::styled(format!("  {}", node.meaning), self.style(Color::LightRed)));
            }
        }
        if lines.is_empty() {
            lines.push(Line::from("no heartbeat yet"));
        }
        let block = Block::bordered().title(" nodes ");
        frame.render_widget(Paragraph::new(lines).wrap(Wrap { trim: false }).block(block), area);
    }

    fn node_line(&self, node: &Node) -> Line<'static> {
        let color = match node.state.as_str() {
            "RUN" => Color::Cyan,
            "SAFE" | "FAULT" | "NO_POLICY" => Color::LightRed,
            _ => Color::Yellow,
        };
        let mut words = vec![
            Span::raw(format!("node {} ", node.node)),
            Span::styled(node.state.clone(), self.style(color).add_modifier(Modifier::BOLD)),
            Span::raw(format!("  fault {}  {} changes", node.fault, node.changes)),
        ];
        if node.age_us > 300_000 {
            let silent = format!("  SILENT {:.1} s", node.age_us as f64 / 1e6);
            words.push(Span::styled(silent, self.style(Color::LightRed)));
        }
        Line::from(words)
    }

    fn latents(&self, frame: &mut Frame<'_>, area: Rect, now: &Snapshot) {
        let used = now.latent_counts.iter().filter(|c| **c > 0).count();
        let last = now.latent.map_or_else(|| "none".to_owned(), |l| l.to_string());
        let flags: Vec<String> = now.flags.iter().map(|(name, n)| format!("{name} {n}")).collect();
        let title = format!(" latents: last {last}, {used} of {} used ", now.latent_counts.len());
        let foot = if flags.is_empty() { String::new() } else { format!(" {} ", flags.join("  ")) };
        let block = Block::bordered().title(title).title_bottom(foot);
        let inner = block.inner(area);
        // With little room only the first bars would be shown: then neighbours share a bar.
        let width = usize::from(inner.width.max(1));
        let each = now.latent_counts.len().div_ceil((width / 3).max(1)).max(1);
        let bars = now.latent_counts.chunks(each).enumerate().map(|(i, counts)| {
            let label = (i * each).to_string();
            let mine = now.latent.is_some_and(|l| usize::from(l) / each == i);
            let style = self.style(if mine { Color::Yellow } else { Color::Cyan });
            Bar::default().value(counts.iter().sum()).label(Line::from(label)).text_value(String::new()).style(style)
        });
        let group = BarGroup::default().bars(&bars.collect::<Vec<_>>());
        frame.render_widget(BarChart::default().block(block).data(group).bar_width(2).bar_gap(1), area);
    }

    fn rows(&mut self, frame: &mut Frame<'_>, area: Rect, now: &Snapshot) {
        let head = ["id", "name", "node", "rate", "frames", "gaps", "errors", "age", "signals"];
        let wide = usize::from(area.width).saturating_sub(64);
        let rows = now.rows.iter().map(|row| self.row(row, wide));
        let widths = [
            Constraint::Length(8),
            Constraint::Length(14),
            Constraint::Length(4),
            Constraint::Length(6),
            Constraint::Length(8),
            Constraint::Length(6),
            Constraint::Length(6),
            Constraint::Length(6),
            Constraint::Fill(1),
        ];
        let table = Table::new(rows, widths)
            .header(TableRow::new(head).style(Style::new().add_modifier(Modifier::BOLD)))
            .row_highlight_style(Style::new().add_modifier(Modifier::REVERSED))
            .block(Block::bordered().title(" messages "));
        frame.render_stateful_widget(table, area, &mut self.table);
    }

    fn row(&self, row: &Row, wide: usize) -> TableRow<'static> {
        let mark = |n: u64| {
            let style = if n > 0 { self.style(Color::LightRed) } else { Style::new() };
            Cell::from(n.to_string()).style(style)
        };
        let id = if row.extended { format!("{:08X}", row.id) } else { format!("{:03X}", row.id) };
        let age = if row.age_us < 1_000_000 {
            format!("{} ms", row.age_us / 1000)
        } else {
            format!("{} s", row.age_us / 1_000_000)
        };
        let text = match &row.error {
            Some(error) => format!("!! {error}"),
            None => signals(&row.signals),
        };
        let text: String = text.chars().take(wide.max(8)).collect();
        TableRow::new([
            Cell::from(id),
            Cell::from(row.name),
            Cell::from(row.node.map_or_else(String::new, |n| n.to_string())),
            Cell::from(format!("{:.0}", row.rate_hz)),
            Cell::from(row.frames.to_string()),
            mark(row.gaps.missing),
            mark(row.errors),
            Cell::from(age),
            Cell::from(text),
        ])
    }
}

/// Signals in one line; numbers with at most four digits after the point.
fn signals(signals: &Map<String, Value>) -> String {
    let one = |(name, value): (&String, &Value)| match value {
        Value::Number(n) if n.is_f64() => format!("{name}={:.4}", n.as_f64().unwrap_or(f64::NAN)),
        Value::String(text) => format!("{name}={text}"),
        Value::Array(all) => {
            let words: Vec<&str> = all.iter().filter_map(Value::as_str).collect();
            format!("{name}=[{}]", words.join(" "))
        }
        Value::Null => format!("{name}=none"),
        other => format!("{name}={other}"),
    };
    signals.iter().map(one).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::BitRate;
    use crate::monitor::Model;
    use gadm_node::frame::standard;
    use gadm_node::service::Tick;
    use gadm_node::{Fault, Frame as CanFrame, State};
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;

    fn drawn(view: &mut View, snapshot: &Snapshot, width: u16, height: u16) -> (String, bool) {
        let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
        terminal.draw(|frame| view.draw(frame, snapshot)).unwrap();
        let cells = &terminal.backend().buffer().content;
        let text: String = cells
            .chunks(usize::from(width))
            .map(|line| line.iter().map(ratatui::buffer::Cell::symbol).collect::<String>() + "\n")
            .collect();
        (text, cells.iter().any(|c| c.fg != Color::Reset))
    }

    fn busy() -> Model<'static> {
        let mut model = Model::new(None, BitRate { nominal: 125_000, data: 500_000 });
        for i in 0..1000_u32 {
            let tick = if i < 500 { i } else { i + 3 };
            model.frame(u64::from(i) * 1000, &Tick { tick, time_us: 0 }.frame()).unwrap();
        }
        let beat = [State::Safe.code(), 0, Fault::TickLost.code(), 0, 1, 0, 0, 0];
        model.frame(999_000, &CanFrame::classic(standard(0x702), &beat).unwrap()).unwrap();
        model
    }

    #[test]
    fn the_picture_says_in_words_what_is_wrong() {
        let mut view = View { source: "vcan0".to_owned(), ..View::default() };
        let (text, colored) = drawn(&mut view, &busy().snapshot(), 110, 24);
        for word in
            ["vcan0", "1001 frames", "worst case HIGH", "node 2 SAFE", "TICK_LOST", "no TICK for 300 ms", "tick=1002"]
        {
            assert!(text.contains(word), "{word}:\n{text}");
        }
        let row = text.lines().find(|l| l.contains("080 ")).unwrap();
        assert!(row.contains("TICK") && row.split_whitespace().any(|w| w == "3"), "three ticks are missing: {row}");
        assert!(!colored, "no colour was asked for");
    }

    #[test]
    fn colours_are_used_where_they_may() {
        let mut view = View { color: true, ..View::default() };
        assert!(drawn(&mut view, &busy().snapshot(), 110, 24).1);
    }

    #[test]
    fn latents_become_bars_and_the_end_of_a_trace_is_told() {
        let mut snapshot = busy().snapshot();
        snapshot.latent_counts = vec![0, 40, 10, 0];
        (snapshot.latent, snapshot.profile) = (Some(1), Some("fd-f32"));
        snapshot.flags.insert("clipped", 12);
        let mut view = View { ended: Some(End::Done), ..View::default() };
        let (text, _) = drawn(&mut view, &snapshot, 100, 30);
        for word in ["last 1, 2 of 4 used", "clipped 12", "END OF TRACE", "125/500 kbit/s"] {
            assert!(text.contains(word), "{word}:\n{text}");
        }
        assert!(text.contains('█'), "{text}");
    }

    #[test]
    fn no_size_of_a_terminal_is_too_small() {
        let snapshot = busy().snapshot();
        for (width, height) in [(1, 1), (20, 5), (80, 24), (300, 100)] {
            drawn(&mut View::default(), &snapshot, width, height);
        }
    }

    #[test]
    fn the_selection_stays_in_the_table() {
        let mut view = View::default();
        view.select(-1, 5);
        assert_eq!(view.table.selected(), Some(0));
        view.select(100, 5);
        assert_eq!(view.table.selected(), Some(4));
        view.select(1, 0);
        assert_eq!(view.table.selected(), Some(0));
    }

    #[test]
    fn the_selected_message_is_shown_whole() {
        let mut view = View::default();
        view.select(0, 2);
        let (text, _) = drawn(&mut view, &busy().snapshot(), 90, 24);
        assert!(
            text.contains(" TICK ─") && text.lines().filter(|l| l.contains("tick=1002 time_us=0")).count() == 2,
            "{text}"
        );
    }
}
