//! What the tests of the project as a whole share: the files of the repository, the programs, and pages that are made.
#![allow(clippy::expect_used, reason = "a fixture may fail loudly: only tests depend on this crate")]

pub mod markdown;
pub mod metadata;
pub mod programs;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The folder of the root manifest.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("this package lies one folder below the root").to_path_buf()
}

/// Paths relative to [`root`] of all files under version control, in order. In a tree without git (an unpacked archive)
/// all files but those that builds and runs leave behind.
pub fn repository_files() -> Vec<PathBuf> {
    let listed = Command::new("git").args(["ls-files", "-z"]).current_dir(root()).output();
    let mut files: Vec<PathBuf> = match listed {
        Ok(out) if out.status.success() && !out.stdout.is_empty() => String::from_utf8_lossy(&out.stdout)
            .split_terminator('\0')
            .map(PathBuf::from)
            // Deleted, but not yet from the index.
            .filter(|path| root().join(path).exists())
            .collect(),
        _ => {
            let mut found = Vec::new();
            walk(&root(), Path::new(""), &mut found);
            found
        }
    };
    files.sort();
    files
}

fn walk(root: &Path, folder: &Path, found: &mut Vec<PathBuf>) {
    let entries = fs::read_dir(root.join(folder)).expect("a folder of the repository can be read");
    for entry in entries.map(|entry| entry.expect("an entry of a folder can be read")) {
        let path = folder.join(entry.file_name());
        let name = entry.file_name();
        let made = ["target", ".git", "runs", ".venv", "artifacts", "coverage"].iter().any(|made| name == *made);
        let is_source = path.starts_with("firmware-sim/src/target");
        if made && !is_source {
            continue;
        }
        if root.join(&path).is_dir() {
            walk(root, &path, found);
        } else {
            found.push(path);
        }
    }
}

/// The content of a file of the repository.
pub fn read(path: impl AsRef<Path>) -> String {
    let path = root().join(path);
    fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Compares a page that is made from code with the file at `path`; with `UPDATE_DOCS=1` in the environment it writes it.
///
/// # Panics
/// If they differ.
pub fn check_page(path: &str, expected: &str) {
    let file = root().join(path);
    if std::env::var_os("UPDATE_DOCS").is_some() {
        fs::write(&file, expected).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
        return;
    }
    let found = fs::read_to_string(&file).unwrap_or_default();
    assert!(
        found == expected,
        "{path} is not what the code says; UPDATE_DOCS=1 cargo test -p gadm-integration-tests writes it again"
    );
}
