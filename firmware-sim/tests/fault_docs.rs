//! The page about faults is that of the code.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

use std::fmt::Write as _;
use std::path::Path;

use gadm_sim::fault::CATALOGUE;

fn catalogue() -> String {
    let mut t = String::from("| layer | kind | parameters, as an example | varied | counted | what happens |\n");
    t.push_str("| --- | --- | --- | --- | --- | --- |\n");
    for r in CATALOGUE {
        let code = |s: &str| if s.is_empty() { "–".to_owned() } else { format!("`{s}`") };
        writeln!(
            t,
            "| {} | `{}` | {} | {} | {} | {} |",
            r.layer,
            r.kind,
            code(r.example),
            code(r.intensity),
            r.counts,
            r.meaning
        )
        .unwrap();
    }
    t
}

/// The text between `<!-- name -->` and `<!-- end -->` must be the table; `UPDATE_DOCS=1` writes it there.
#[test]
fn the_catalogue_on_the_page_is_the_one_in_the_code() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/src/faults.md");
    let page = std::fs::read_to_string(&path).unwrap();
    let start = page.find("<!-- catalogue -->\n").unwrap() + "<!-- catalogue -->\n".len();
    let end = start + page[start..].find("<!-- end -->").unwrap();
    let wanted = format!("\n{}\n", catalogue());
    if std::env::var_os("UPDATE_DOCS").is_some() {
        std::fs::write(&path, format!("{}{wanted}{}", &page[..start], &page[end..])).unwrap();
    } else {
        assert!(page[start..end] == wanted, "run: UPDATE_DOCS=1 cargo test -p gadm-sim --test fault_docs");
    }
}
