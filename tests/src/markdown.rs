//! As much of Markdown as the checks of the documentation need.

/// The text between the heading `title` and the next heading of the same or a higher level.
///
/// # Panics
/// Without such a heading.
pub fn section<'a>(page: &'a str, title: &str) -> &'a str {
    let mut start = None;
    let mut at = 0;
    for line in page.split_inclusive('\n') {
        let level = line.bytes().take_while(|b| *b == b'#').count();
        if let Some((begin, own)) = start {
            if level > 0 && level <= own {
                return &page[begin..at];
            }
        } else if level > 0 && line[level..].trim() == title {
            start = Some((at + line.len(), level));
        }
        at += line.len();
    }
    let (begin, _) = start.unwrap_or_else(|| panic!("no heading `{title}`"));
    &page[begin..]
}

/// The cells of the first table, heading row first, rule row left out.
pub fn table(text: &str) -> Vec<Vec<String>> {
    let lines = text.lines().skip_while(|line| !line.starts_with('|')).take_while(|line| line.starts_with('|'));
    let cells = |line: &str| line.trim_matches('|').split('|').map(|cell| cell.trim().to_owned()).collect();
    lines.enumerate().filter(|(i, _)| *i != 1).map(|(_, line)| cells(line)).collect()
}

/// The words in backticks.
pub fn code_words(text: &str) -> Vec<String> {
    text.split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

/// The lines of a page with what they are.
pub fn lines(page: &str) -> impl Iterator<Item = Line<'_>> {
    let mut fence: Option<&str> = None;
    page.lines().enumerate().map(move |(i, text)| {
        let mark = text.trim_start().strip_prefix("```");
        let language = match (mark, fence) {
            (Some(_), Some(_)) => {
                fence = None;
                Some("fence")
            }
            (Some(language), None) => {
                fence = Some(language.trim());
                Some("fence")
            }
            (None, inside) => inside,
        };
        Line { number: i + 1, text, language }
    })
}

/// One line of a page.
#[derive(Debug, Clone, Copy)]
pub struct Line<'a> {
    /// From 1.
    pub number: usize,
    /// The line.
    pub text: &'a str,
    /// Language of the code block around it, `fence` on its borders, `None` in prose.
    pub language: Option<&'a str>,
}

/// Targets of the links of a line of prose: `[text](target)`, and `src` of images.
pub fn links(line: &str) -> Vec<&str> {
    // Code is no link.
    let mut found = Vec::new();
    let mut at = 0;
    let mut in_code = false;
    while let Some(c) = line[at..].chars().next() {
        if c == '`' {
            in_code = !in_code;
        } else if !in_code && line[at..].starts_with("](") {
            let rest = &line[at + 2..];
            if let Some(end) = rest.find(')') {
                found.push(&rest[..end]);
            }
        }
        at += c.len_utf8();
    }
    found
}

/// The anchors that a page offers: its headings as GitHub and mdBook write them.
pub fn anchors(page: &str) -> Vec<String> {
    let headings = lines(page).filter(|line| line.language.is_none()).filter_map(|line| {
        let level = line.text.bytes().take_while(|b| *b == b'#').count();
        (1..=6).contains(&level).then(|| line.text[level..].trim())
    });
    headings
        .map(|heading| {
            let kept = heading.chars().filter(|c| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_'));
            kept.map(|c| if c == ' ' { '-' } else { c.to_ascii_lowercase() }).collect()
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sections_end_at_the_next_heading_of_their_level() {
        let page = "# a\nx\n## b\ny\n### c\nz\n## d\nw\n";
        assert_eq!(section(page, "b"), "y\n### c\nz\n");
        assert_eq!(section(page, "d"), "w\n");
    }

    #[test]
    fn tables_and_words() {
        let rows = table("text\n\n| a | b |\n| - | - |\n| `x`, `y` | 1 |\n\n| other |\n");
        assert_eq!(rows, [["a", "b"], ["`x`, `y`", "1"]]);
        assert_eq!(code_words(&rows[1][0]), ["x", "y"]);
    }

    #[test]
    fn links_are_not_in_code() {
        assert_eq!(links("see [a](b.md) and `[c](d)` and ![e](f.svg#g)"), ["b.md", "f.svg#g"]);
        let page = "# t\n```sh\ngadm train\n```\ntext\n";
        let kinds: Vec<_> = lines(page).map(|line| line.language).collect();
        assert_eq!(kinds, [None, Some("fence"), Some("sh"), Some("fence"), None]);
        assert_eq!(anchors("# One, two\n```\n# no\n```\n## `x` y-z\n"), ["one-two", "x-y-z"]);
    }
}
