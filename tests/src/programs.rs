//! The programs `gadm` and `gadm-sim`, and what their help says.

use std::path::PathBuf;
use std::process::Command;

/// The program beside the tests that run now. Cargo builds it with the workspace's tests; if these tests are built
/// alone, it is built here.
pub fn program(name: &str) -> PathBuf {
    let test = std::env::current_exe().expect("a test knows its own path");
    let folder = test.parent().and_then(|deps| deps.parent()).expect("tests lie in <profile>/deps");
    let path = folder.join(format!("{name}{}", std::env::consts::EXE_SUFFIX));
    if !path.exists() {
        let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
        let built = Command::new(cargo)
            .args(["build", "--quiet", "--workspace", "--bin", name])
            .current_dir(crate::root())
            .status()
            .expect("cargo runs");
        assert!(built.success() && path.exists(), "{} is not there and could not be built", path.display());
    }
    path
}

/// What `program words… --help` prints, or its complaint.
///
/// # Errors
/// What it printed when it did not exit with 0.
pub fn help(name: &str, words: &[&str]) -> Result<String, String> {
    let out = Command::new(program(name)).args(words).arg("--help").output().expect("the program starts");
    if out.status.success() {
        Ok(String::from_utf8_lossy(&out.stdout).into_owned())
    } else {
        Err(String::from_utf8_lossy(&out.stderr).into_owned())
    }
}
