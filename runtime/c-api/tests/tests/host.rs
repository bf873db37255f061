//! The C example and the checks of arguments, compiled for this machine.
#![allow(clippy::unwrap_used, reason = "tests may panic")]

use std::path::{Path, PathBuf};
use std::process::Command;

use gadm_c_api_tests::{expected, library, observations, policies, root, run, same_lines};
use gadm_runtime::Policy;
use gadm_runtime::encode::AlignedImage;

const STRICT: [&str; 6] = ["-std=c11", "-Wall", "-Wextra", "-Wconversion", "-Wcast-qual", "-Werror"];

fn compiled(name: &str, sources: &[&str]) -> PathBuf {
    let program = std::env::current_exe().unwrap().parent().unwrap().join(name);
    let sources = sources.iter().map(|source| root().join(source));
    run(Command::new("cc")
        .args(STRICT)
        .args(["-O1", "-fsanitize=undefined", "-fno-sanitize-recover=all"])
        .arg("-I")
        .arg(root().join("include"))
        .args(sources)
        .arg(library(None))
        .arg("-o")
        .arg(&program));
    program
}

fn temporary(name: &str, bytes: &[u8]) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

#[test]
fn the_example_computes_the_bits_of_the_rust_runtime() {
    let program = compiled("c-api-host", &["examples/control.c", "examples/host.c"]);
    for (name, file) in policies() {
        let image = AlignedImage::new(&file);
        let observations = observations(&Policy::load(&image).unwrap(), 400);
        let (policy, obs) =
            (temporary(&format!("{name}.bin"), &file), temporary(&format!("{name}.obs"), &observations.file()));
        let said = run(Command::new(&program).arg(policy).arg(obs));
        let wanted = expected(&file, &observations);
        assert!(wanted.matches("\nstep ").count() > 700 && wanted.contains("refused"), "{name}: too few steps");
        same_lines(name, &said, &wanted);
    }
}

#[test]
fn the_example_says_why_a_policy_is_refused() {
    let program = compiled("c-api-refused", &["examples/control.c", "examples/host.c"]);
    let (_, mut file) = policies().swap_remove(0);
    file[300] ^= 1;
    let obs = temporary("refused.obs", &[0; 12]);
    let out = Command::new(program).arg(temporary("refused.bin", &file)).arg(obs).output().unwrap();
    let said = String::from_utf8(out.stdout).unwrap();
    assert_eq!(out.status.code(), Some(1));
    assert!(said.starts_with("load: image damaged: copy or flash it again\nrefused 00000017"), "{said}");
}

/// `arguments.c` calls every function with everything that can be wrong and ends with the number of its checks.
#[test]
fn wrong_arguments_give_a_status() {
    let program = compiled("c-api-arguments", &["tests/arguments.c"]);
    let (_, file) = policies().swap_remove(0);
    let said = run(Command::new(program).arg(temporary("arguments.bin", &file)));
    let checks: u32 = said.trim().strip_suffix(" checks passed").unwrap_or_else(|| panic!("{said}")).parse().unwrap();
    assert!(checks > 40, "{said}");
}

#[test]
fn cpp_takes_the_header() {
    let source =
        temporary("header.cpp", b"#include \"gadm.h\"\nint main() { return gadm_abi_version() == 1 ? 0 : 1; }\n");
    let program = std::env::current_exe().unwrap().with_file_name("c-api-cpp");
    let include = root().join("include");
    run(Command::new("c++")
        .args(["-Wall", "-Wextra", "-Werror", "-I"])
        .arg(include)
        .arg(source)
        .arg(library(None))
        .arg("-o")
        .arg(&program));
    run(&mut Command::new(program));
}
