//! Writes a [`Page`] as HTML.

use std::fmt::{Result, Write as _};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use super::page::{Block, Cell, Mark, Page, Picture};
use super::svg::escape;

/// The page's style: a readable column, light or dark as the reader's system has it, colours that the colour-blind
/// tell apart (after Okabe and Ito).
const STYLE: &str = include_str!("page.css");

/// Forbids everything but the page's own styles and embedded pictures.
const POLICY: &str =
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'";

/// A table of more columns is set closer.
const MANY_COLUMNS: usize = 10;

/// The whole page.
pub(super) fn page(page: &Page) -> String {
    let mut out = String::new();
    // Writing into a `String` cannot fail.
    let _ = write_page(&mut out, page);
    out
}

fn write_page(out: &mut String, page: &Page) -> Result {
    let title = escape(&page.title);
    writeln!(out, "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">")?;
    writeln!(out, "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">")?;
    writeln!(out, "<meta name=\"color-scheme\" content=\"light dark\">")?;
    writeln!(out, "<meta http-equiv=\"Content-Security-Policy\" content=\"{POLICY}\">")?;
    writeln!(out, "<title>{title}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n<h1>{title}</h1>")?;
    if !page.lead.is_empty() {
        writeln!(out, "<p class=\"lead\">{}</p>", escape(&page.lead))?;
    }
    for (mark, text) in &page.verdicts {
        let (class, word) = (mark.class(), mark.word());
        writeln!(out, "<p class=\"verdict {class}\"><strong>{word}</strong> {}</p>", escape(text))?;
    }
    for section in &page.sections {
        writeln!(out, "<section>")?;
        if !section.heading.is_empty() {
            writeln!(out, "<h2>{}</h2>", escape(&section.heading))?;
        }
        for block in &section.blocks {
            write_block(out, block)?;
        }
        writeln!(out, "</section>")?;
    }
    writeln!(out, "</main>\n</body>\n</html>")
}

fn write_block(out: &mut String, block: &Block) -> Result {
    match block {
        Block::Text(text) => {
            for paragraph in text.split("\n\n").map(str::trim).filter(|paragraph| !paragraph.is_empty()) {
                writeln!(out, "<p>{}</p>", escape(paragraph))?;
            }
            Ok(())
        }
        Block::Facts(facts) => {
            writeln!(out, "<div class=\"scroll\" tabindex=\"0\"><table class=\"facts\"><tbody>")?;
            for (name, value) in facts {
                writeln!(out, "<tr><th scope=\"row\">{}</th><td>{}</td></tr>", escape(name), escape(value))?;
            }
            writeln!(out, "</tbody></table></div>")
        }
        Block::Table { columns, rows } => {
            let class = if columns.len() > MANY_COLUMNS { " class=\"wide\"" } else { "" };
            writeln!(out, "<div class=\"scroll\" tabindex=\"0\"><table{class}>\n<thead><tr>")?;
            for column in columns {
                write_cell(out, "th scope=\"col\"", "th", column)?;
            }
            writeln!(out, "</tr></thead>\n<tbody>")?;
            for row in rows {
                writeln!(out, "<tr>")?;
                for cell in row {
                    write_cell(out, "td", "td", cell)?;
                }
                writeln!(out, "</tr>")?;
            }
            writeln!(out, "</tbody></table></div>")
        }
        Block::Figure { svg, caption } => {
            writeln!(out, "<figure>\n<div class=\"scroll\" tabindex=\"0\">{}</div>", svg.to_text())?;
            write_caption(out, caption)
        }
        Block::Picture { picture, still, caption } => {
            writeln!(out, "<figure>\n<picture>")?;
            if let Some(still) = still {
                let uri = data_uri(still);
                writeln!(out, "<source media=\"(prefers-reduced-motion: reduce)\" srcset=\"{uri}\">")?;
            }
            writeln!(out, "<img src=\"{}\" alt=\"{}\"></picture>", data_uri(picture), escape(&picture.alt))?;
            write_caption(out, caption)
        }
        Block::Code(code) => writeln!(out, "<pre><code>{}</code></pre>", escape(code.trim_end())),
    }
}

fn write_caption(out: &mut String, caption: &str) -> Result {
    if !caption.is_empty() {
        writeln!(out, "<figcaption>{}</figcaption>", escape(caption))?;
    }
    writeln!(out, "</figure>")
}

fn write_cell(out: &mut String, open: &str, close: &str, cell: &Cell) -> Result {
    let mut classes: Vec<&str> = cell.mark.map(Mark::class).into_iter().collect();
    classes.extend(cell.numeric.then_some("number"));
    classes.extend(cell.heat.map(|_| "heat"));
    write!(out, "<{open}")?;
    if !classes.is_empty() {
        write!(out, " class=\"{}\"", classes.join(" "))?;
    }
    if let Some(heat) = cell.heat {
        write!(out, " style=\"--h: {:.0}\"", 100.0 * heat)?;
    }
    writeln!(out, ">{}</{close}>", escape(&cell.text))
}

fn data_uri(picture: &Picture) -> String {
    format!("data:{};base64,{}", picture.media, STANDARD.encode(&picture.bytes))
}

#[cfg(test)]
mod tests {
    use super::super::svg::Svg;
    use super::*;

    const HOSTILE: &str = "</td><script>alert('x' & \"y\")</script>";

    fn hostile_page() -> String {
        let mut page = Page::new(HOSTILE);
        page.lead(HOSTILE).verdict(Mark::Missed, HOSTILE).section(HOSTILE).text(HOSTILE).code(HOSTILE);
        page.facts([(HOSTILE, HOSTILE)]).table([HOSTILE], [vec![Cell::number(HOSTILE).shaded(0.25)]]);
        let picture = Picture { media: "image/gif", bytes: vec![1, 2, 3], alt: HOSTILE.to_owned() };
        page.figure(Svg::new(1, 1, HOSTILE), HOSTILE).picture(picture.clone(), Some(picture), HOSTILE);
        page.to_html()
    }

    #[test]
    fn every_text_is_escaped() {
        let html = hostile_page();
        assert!(!html.contains("<script"), "{html}");
        let escaped = "&lt;/td&gt;&lt;script&gt;alert(&#39;x&#39; &amp; &quot;y&quot;)&lt;/script&gt;";
        // Title twice, lead, verdict, heading, text, code, two facts, column, cell, two of the drawing, two captions, alt.
        assert_eq!(html.matches(escaped).count(), 16);
    }

    #[test]
    fn the_verdict_comes_first_and_in_words() {
        let html = hostile_page();
        assert!(html.find("class=\"verdict missed\"").unwrap() < html.find("<section").unwrap());
        assert!(html.contains("<strong>Missed</strong>"));
    }

    #[test]
    fn tags_are_balanced() {
        let html = hostile_page();
        for tag in ["html", "head", "body", "main", "section", "div", "table", "tr", "th", "td", "figure", "picture"] {
            let count = |pattern: &str| html.matches(pattern).count();
            let opened = count(&format!("<{tag}>")) + count(&format!("<{tag} "));
            assert_eq!(opened, count(&format!("</{tag}>")), "{tag}");
        }
    }

    #[test]
    fn nothing_is_loaded_from_elsewhere() {
        let html = hostile_page();
        for word in ["http://", "https://", "url(", "@import", "href="] {
            assert!(!html.contains(word), "{word}");
        }
        assert_eq!(html.matches("data:image/gif;base64,AQID\"").count(), 2);
        assert!(html.contains("default-src 'none'"));
    }

    #[test]
    fn rows_are_filled_and_columns_follow_their_numbers() {
        let mut page = Page::new("t");
        page.table(["a", "b"], [vec![Cell::text("x"), Cell::number("1")], vec![Cell::mark(Mark::Met)]]);
        let html = page.to_html();
        assert_eq!(html.matches("<td").count(), 4);
        assert!(html.contains("<th scope=\"col\" class=\"number\">b</th>"), "{html}");
        assert!(html.contains("<td class=\"met\">Met</td>"), "{html}");
    }
}
