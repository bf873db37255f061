//! Writes a [`Report`] as HTML.

use super::{Column, Content, FileLink, Report, Section, Verdict};
use crate::plot::escape;
use std::fmt::{Result, Write as _};

/// The page's style: a readable column, light or dark as the reader's system has it.
const STYLE: &str = include_str!("report.css");

/// Forbids everything but the page's own styles.
const POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'";

/// The whole page.
pub(super) fn page(report: &Report) -> String {
    let mut out = String::new();
    // Writing into a `String` cannot fail.
    let _ = write_page(&mut out, report);
    out
}

fn write_page(out: &mut String, report: &Report) -> Result {
    let title = escape(&report.title);
    writeln!(out, "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">")?;
    writeln!(out, "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">")?;
    writeln!(out, "<meta name=\"color-scheme\" content=\"light dark\">")?;
    writeln!(out, "<meta http-equiv=\"Content-Security-Policy\" content=\"{POLICY}\">")?;
    writeln!(out, "<title>{title}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n<h1>{title}</h1>")?;
    for verdict in &report.verdicts {
        write_verdict(out, verdict)?;
    }
    for section in &report.sections {
        write_section(out, section)?;
    }
    writeln!(out, "</main>\n</body>\n</html>")
}

fn write_verdict(out: &mut String, verdict: &Verdict) -> Result {
    // The word carries the meaning; the colour only repeats it.
    let (class, word) = if verdict.ok { ("met", "Met") } else { ("missed", "Missed") };
    writeln!(out, "<p class=\"verdict {class}\"><strong>{word}</strong> {}</p>", escape(&verdict.text))
}

fn write_section(out: &mut String, section: &Section) -> Result {
    writeln!(out, "<section>\n<h2>{}</h2>", escape(&section.heading))?;
    match &section.content {
        Content::Text(text) => {
            for paragraph in text.split("\n\n").map(str::trim).filter(|paragraph| !paragraph.is_empty()) {
                writeln!(out, "<p>{}</p>", escape_lines(paragraph))?;
            }
        }
        Content::Facts(facts) => {
            writeln!(out, "<div class=\"scroll\" tabindex=\"0\"><table class=\"facts\"><tbody>")?;
            for (name, value) in facts {
                writeln!(out, "<tr><th scope=\"row\">{}</th><td>{}</td></tr>", escape(name), escape_lines(value))?;
            }
            writeln!(out, "</tbody></table></div>")?;
        }
        Content::Table { columns, rows } => write_table(out, columns, rows)?,
        Content::Figure { svg, caption } => {
            writeln!(out, "<figure>\n<div class=\"scroll\" tabindex=\"0\">{svg}</div>")?;
            if !caption.is_empty() {
                writeln!(out, "<figcaption>{}</figcaption>", escape_lines(caption))?;
            }
            writeln!(out, "</figure>")?;
        }
        Content::Code(code) => writeln!(out, "<pre><code>{}</code></pre>", escape_lines(code.trim_end()))?,
        Content::Files(files) => {
            writeln!(out, "<ul>")?;
            for FileLink { path, description } in files {
                let text = escape(path);
                write!(out, "<li><a href=\"{}\"><code>{text}</code></a>", encode(path))?;
                let description = escape(description);
                writeln!(out, "{}{description}</li>", if description.is_empty() { "" } else { " — " })?;
            }
            writeln!(out, "</ul>")?;
        }
    }
    writeln!(out, "</section>")
}

fn write_table(out: &mut String, columns: &[Column], rows: &[Vec<String>]) -> Result {
    let class = |column: &Column| if column.numeric { " class=\"number\"" } else { "" };
    writeln!(out, "<div class=\"scroll\" tabindex=\"0\"><table>\n<thead><tr>")?;
    for column in columns {
        writeln!(out, "<th scope=\"col\"{}>{}</th>", class(column), escape(&column.name))?;
    }
    writeln!(out, "</tr></thead>\n<tbody>")?;
    for row in rows {
        write!(out, "<tr>")?;
        for (column, value) in columns.iter().zip(row) {
            write!(out, "<td{}>{}</td>", class(column), escape_lines(value))?;
        }
        writeln!(out, "</tr>")?;
    }
    writeln!(out, "</tbody></table></div>")
}

/// [`escape`] that keeps line ends.
fn escape_lines(text: &str) -> String {
    text.split('\n').map(escape).collect::<Vec<_>>().join("\n")
}

/// `path` for a link: everything but unreserved characters and `/` in percent form.
// Source: RFC 3986, section 2.3.
fn encode(path: &str) -> String {
    path.bytes().fold(String::with_capacity(path.len()), |mut encoded, byte| {
        if byte.is_ascii_alphanumeric() || b"-._~/".contains(&byte) {
            encoded.push(char::from(byte));
        } else {
            // Writing into a `String` cannot fail.
            let _ = write!(encoded, "%{byte:02X}");
        }
        encoded
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOSTILE: &str = "</td><script>alert('x' & \"y\")</script>";

    fn hostile_report() -> Report {
        let mut report = Report::new(HOSTILE);
        report.facts(HOSTILE, [(HOSTILE, HOSTILE)]);
        report.verdict(false, HOSTILE).text(HOSTILE, HOSTILE).code(HOSTILE, HOSTILE);
        report.table(HOSTILE, vec![Column::text(HOSTILE)], vec![vec![HOSTILE.into()]]).unwrap();
        report.figure(HOSTILE, "<svg></svg>", HOSTILE).unwrap();
        let file = FileLink { path: "a \"<b>\".bin".into(), description: HOSTILE.into() };
        report.files(HOSTILE, vec![file]).unwrap();
        report
    }

    #[test]
    fn every_text_is_escaped() {
        let page = hostile_report().to_html();
        assert!(!page.contains("<script"), "{page}");
        let escaped = "&lt;/td&gt;&lt;script&gt;alert(&#39;x&#39; &amp; &quot;y&quot;)&lt;/script&gt;";
        // Title twice, verdict, six headings, two facts, text, code, column, cell, caption, description.
        assert_eq!(page.matches(escaped).count(), 17);
        assert!(page.contains("href=\"a%20%22%3Cb%3E%22.bin\"") && page.contains("a &quot;&lt;b&gt;&quot;.bin"));
    }

    #[test]
    fn the_verdict_comes_first_and_in_words() {
        let page = hostile_report().to_html();
        let (verdict, table) = (page.find("class=\"verdict missed\"").unwrap(), page.find("<table").unwrap());
        assert!(verdict < table);
        assert!(page.contains("<strong>Missed</strong>"));
    }

    #[test]
    fn tags_are_balanced() {
        let page = hostile_report().to_html();
        for tag in
            ["html", "head", "body", "main", "section", "div", "table", "tr", "th", "td", "ul", "li", "figure", "pre"]
        {
            let count = |pattern: &str| page.matches(pattern).count();
            let opened = count(&format!("<{tag}>")) + count(&format!("<{tag} "));
            assert_eq!(opened, count(&format!("</{tag}>")), "{tag}");
        }
    }

    #[test]
    fn nothing_is_loaded_from_elsewhere() {
        let page = hostile_report().to_html();
        for word in ["http://", "https://", "url(", "@import", "src="] {
            assert!(!page.contains(word), "{word}");
        }
        assert!(page.contains("default-src &#39;none&#39;") || page.contains("default-src 'none'"));
    }
}
