//! The documentation against the repository: links, commands, pages made from code, and what must not be in a file.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::{Component, Path, PathBuf};

use gadm_integration_tests::{check_page, markdown, programs, read, repository_files, root};
use gadm_trainer::metrics::keys;

fn pages() -> Vec<PathBuf> {
    let pages: Vec<_> =
        repository_files().into_iter().filter(|path| path.extension().is_some_and(|e| e == "md")).collect();
    assert!(pages.iter().any(|page| page == Path::new("README.md")), "no README.md among {} pages", pages.len());
    pages
}

/// `a/b/../c` without the detour; `None` where it leaves the repository.
fn normal(path: &Path) -> Option<PathBuf> {
    let mut plain = PathBuf::new();
    for part in path.components() {
        match part {
            Component::Normal(name) => plain.push(name),
            Component::CurDir => {}
            Component::ParentDir => {
                if !plain.pop() {
                    return None;
                }
            }
            Component::RootDir | Component::Prefix(_) => return None,
        }
    }
    Some(plain)
}

#[test]
fn links_lead_somewhere() {
    let mut broken = Vec::new();
    let mut seen = 0;
    for page in pages() {
        let text = read(&page);
        for line in markdown::lines(&text).filter(|line| line.language.is_none()) {
            for link in markdown::links(line.text) {
                if ["https://", "http://", "mailto:"].iter().any(|scheme| link.starts_with(scheme)) {
                    continue;
                }
                seen += 1;
                let (file, anchor) = link.split_once('#').unwrap_or((link, ""));
                let folder = page.parent().unwrap_or(Path::new(""));
                let target = if file.is_empty() { Some(page.clone()) } else { normal(&folder.join(file)) };
                let there = target.is_some_and(|target| {
                    root().join(&target).exists()
                        && (anchor.is_empty() || markdown::anchors(&read(&target)).iter().any(|a| a == anchor))
                });
                if !there {
                    broken.push(format!("{}:{}: {link}", page.display(), line.number));
                }
            }
        }
    }
    assert!(seen > 10, "only {seen} links found: does the search work?");
    assert!(broken.is_empty(), "links that lead nowhere: {broken:#?}");
}

#[test]
fn the_book_has_every_page() {
    let summary = read("docs/src/SUMMARY.md");
    let listed: BTreeSet<PathBuf> =
        summary.lines().flat_map(markdown::links).map(|link| Path::new("docs/src").join(link)).collect();
    let own = Path::new("docs/src/SUMMARY.md");
    let there: BTreeSet<PathBuf> =
        pages().into_iter().filter(|page| page.starts_with("docs/src") && page != own).collect();
    let missing: Vec<_> = there.difference(&listed).collect();
    assert!(missing.is_empty(), "not in docs/src/SUMMARY.md: {missing:?}");
}

/// A command of ours in a code block: where it is, the program, its words.
fn commands() -> Vec<(String, String, Vec<String>)> {
    let mut found = Vec::new();
    for page in pages() {
        let text = read(&page);
        let mut joined = String::new();
        for line in markdown::lines(&text) {
            if !line.language.is_some_and(|l| ["sh", "console", "bash", "shell"].contains(&l)) {
                continue;
            }
            // A command goes on after a backslash.
            let part = line.text.trim().trim_start_matches("$ ");
            joined.push_str(part.trim_end_matches('\\'));
            if part.ends_with('\\') {
                continue;
            }
            let command = std::mem::take(&mut joined);
            let command = command.split(" #").next().unwrap_or_default();
            let words: Vec<String> = command.split_whitespace().map(str::to_owned).collect();
            let program = words.first().map_or("", |word| word.rsplit('/').next().unwrap_or_default()).to_owned();
            if ["gadm", "gadm-sim", "make"].contains(&program.as_str()) {
                let place = format!("{}:{}", page.display(), line.number);
                let end = words.iter().position(|w| ["|", ">", "2>", "&&", ";"].contains(&w.as_str()));
                found.push((place, program, words[1..end.unwrap_or(words.len())].to_vec()));
            }
        }
    }
    found
}

#[test]
fn commands_in_the_documentation_exist() {
    let makefile = read("Makefile");
    let mut faults = Vec::new();
    let mut seen = 0;
    for (place, program, words) in commands() {
        seen += 1;
        if program == "make" {
            for word in words.iter().filter(|word| !word.contains('=') && !word.starts_with('-')) {
                if !makefile.lines().any(|line| line.starts_with(&format!("{word}:"))) {
                    faults.push(format!("{place}: make {word}"));
                }
            }
            continue;
        }
        let plain: Vec<&str> = words.iter().take_while(|w| !w.starts_with('-')).map(String::as_str).collect();
        // The longest row of leading words that are subcommands; at least one must be.
        let Some((verbs, help)) = (1..=plain.len().min(2))
            .rev()
            .find_map(|n| is_verb(&program, &plain[..n]).then(|| (n, programs::help(&program, &plain[..n]))))
        else {
            faults.push(format!("{place}: {program} has no command `{}`", plain.join(" ")));
            continue;
        };
        let help = help.unwrap_or_else(|complaint| panic!("{place}: {program} --help: {complaint}"));
        for flag in words[verbs..].iter().filter(|word| word.starts_with('-')) {
            let flag = flag.split('=').next().unwrap_or(flag);
            let known = help.split([' ', ',', '\n', '[', ']', '=']).any(|word| word.trim_end_matches("...") == flag);
            if !known {
                faults.push(format!("{place}: {program} {} has no option {flag}", plain[..verbs].join(" ")));
            }
        }
    }
    assert!(seen > 5, "only {seen} commands found: does the search work?");
    assert!(faults.is_empty(), "{faults:#?}");
}

/// Whether the last of `words` is a subcommand of the others, by the list in their help.
fn is_verb(program: &str, words: &[&str]) -> bool {
    let Some((last, before)) = words.split_last() else { return false };
    if !before.is_empty() && !is_verb(program, before) {
        return false;
    }
    let help = programs::help(program, before)
        .unwrap_or_else(|complaint| panic!("{program} {} --help: {complaint}", before.join(" ")));
    let list = help.lines().skip_while(|line| *line != "Commands:").skip(1);
    list.take_while(|line| line.starts_with("  ")).any(|line| line.split_whitespace().next() == Some(last))
}

#[test]
fn programs_refuse_what_the_documentation_must_not_name() {
    assert!(!is_verb("gadm", &["no-such-command"]) && is_verb("gadm-sim", &["run"]));
    assert!(!is_verb("gadm-sim", &["run", "policy.bin"]));
}

#[test]
fn every_metric_is_explained() {
    let mut page = String::from(
        "# Metrics\n\nEvery name that `metrics.jsonl`, `timing.jsonl` and the TensorBoard files of a run can hold. This \
         page is made from\n`trainer/src/metrics/keys.rs`; a test fails where they differ (`UPDATE_DOCS=1 cargo test -p \
         gadm-integration-tests`\nwrites it again).\n",
    );
    let row = |page: &mut String, (name, doc): &(&str, &str)| {
        let (meaning, unit) = doc.rsplit_once(" Unit: ").expect("keys.rs gives every metric a unit");
        writeln!(page, "| `{name}` | {} | {meaning} |", unit.trim_end_matches('.')).expect("a String takes any text");
    };
    let groups = [
        ("Reproducible", "In `metrics.jsonl`: a function of configuration, seed and machine.", false),
        ("Timing", "In `timing.jsonl`: depends on the clock.", true),
    ];
    for (title, text, timing) in groups {
        write!(page, "\n## {title}\n\n{text}\n\n| name | unit | meaning |\n| --- | --- | --- |\n").expect("as above");
        keys::ALL.iter().filter(|(name, _)| keys::is_timing(name) == timing).for_each(|key| row(&mut page, key));
    }
    check_page("docs/src/metrics.md", &page);
}

/// A file must mean the same on every machine: no path of the machine it was made on.
#[test]
fn no_machine_paths_in_files() {
    // Put together here, so that this file does not hold them.
    let needles = ["home", "root", "work", "Users", "tmp"].map(|folder| format!("/{folder}/"));
    let mut faults = Vec::new();
    for path in repository_files() {
        let Ok(text) = std::fs::read_to_string(root().join(&path)) else { continue };
        for (i, line) in text.lines().enumerate() {
            for needle in &needles {
                // Inside a longer path or an address it is no absolute path.
                let inside = |c: char| c.is_alphanumeric() || matches!(c, '.' | '-' | '_' | '~' | '}');
                let absolute = line.match_indices(needle.as_str()).any(|(at, _)| !line[..at].ends_with(inside));
                if absolute {
                    faults.push(format!("{}:{}: {}", path.display(), i + 1, line.trim()));
                }
            }
        }
    }
    assert!(faults.is_empty(), "paths of one machine: {faults:#?}");
}
