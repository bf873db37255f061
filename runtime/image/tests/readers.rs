//! The formats through readers of others: GNU binutils, the C compiler, and two Python packages.
//!
//! Python packages are those that `make setup` brings into `target/python`.
#![allow(clippy::unwrap_used, reason = "tests may panic")]

use std::path::{Path, PathBuf};
use std::process::Command;

use gadm_image::{EncodeOptions, Format, PolicyImage};

const FILE: &[u8] = include_bytes!("../../tests/data/format-1.bin");
const ADDRESS: u32 = 0x0806_0000;
const FAMILY: u32 = 0x5775_5A57;

fn written(folder: &Path, format: Format) -> PathBuf {
    let options = EncodeOptions { address: Some(ADDRESS), uf2_family: Some(FAMILY) };
    let content = format.encode(&PolicyImage::check(FILE).unwrap(), &options).unwrap();
    let path = folder.join(format!("policy.{}", format.extension()));
    std::fs::write(&path, content).unwrap();
    path
}

/// Standard output of a program that has to succeed.
#[track_caller]
fn output(program: &Path, words: &[&str]) -> String {
    let out = Command::new(program).args(words).output();
    let out = out.unwrap_or_else(|error| panic!("{}: {error}; `make setup` says what is missing", program.display()));
    let said = String::from_utf8_lossy(&out.stderr);
    assert!(out.status.success(), "{} {words:?}: {}{said}", program.display(), String::from_utf8_lossy(&out.stdout));
    String::from_utf8(out.stdout).unwrap()
}

fn python(script: &str, file: &Path) -> String {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap();
    output(&root.join("target/python/bin/python"), &["-c", script, file.to_str().unwrap()])
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |text, byte| text + &format!("{byte:02x}"))
}

#[test]
fn objcopy_reads_intel_hex_and_elf() {
    let folder = tempfile::tempdir().unwrap();
    for (format, target) in [(Format::Hex, "ihex"), (Format::Elf, "elf32-little")] {
        let (file, raw) = (written(folder.path(), format), folder.path().join("raw"));
        let words = ["-I", target, "-O", "binary", file.to_str().unwrap(), raw.to_str().unwrap()];
        output(Path::new("objcopy"), &words);
        assert_eq!(std::fs::read(&raw).unwrap(), FILE, "{format}");
        let headers = output(Path::new("objdump"), &["-h", "-b", target, file.to_str().unwrap()]);
        assert!(headers.contains("08060000"), "{headers}");
    }
}

#[test]
fn readelf_sees_an_arm_executable_with_one_segment() {
    let folder = tempfile::tempdir().unwrap();
    let file = written(folder.path(), Format::Elf);
    let seen =
        output(Path::new("readelf"), &["--wide", "--file-header", "--segments", "--symbols", file.to_str().unwrap()]);
    let size = format!("0x{:05x}", FILE.len());
    let load: Vec<_> = seen.lines().filter(|line| line.trim_start().starts_with("LOAD")).collect();
    assert!(load.len() == 1 && load[0].contains("0x08060000 0x08060000") && load[0].contains(&size), "{seen}");
    let symbol = seen.lines().find(|line| line.ends_with(" gadm_policy")).unwrap_or_default();
    assert!(symbol.contains("08060000") && symbol.contains("OBJECT") && symbol.contains("GLOBAL"), "{seen}");
    assert!(seen.contains("ARM") && seen.contains("EXEC") && seen.contains("Version5 EABI"), "{seen}");
    assert!(!seen.to_lowercase().contains("warning"), "{seen}");
}

#[test]
fn the_python_package_intelhex_reads_intel_hex() {
    let folder = tempfile::tempdir().unwrap();
    let file = written(folder.path(), Format::Hex);
    let script =
        "import sys, intelhex; h = intelhex.IntelHex(sys.argv[1]); print(hex(h.minaddr()), h.tobinstr().hex())";
    assert_eq!(python(script, &file).trim(), format!("{ADDRESS:#x} {}", hex(FILE)));
}

#[test]
fn the_reference_converter_reads_uf2() {
    let folder = tempfile::tempdir().unwrap();
    let file = written(folder.path(), Format::Uf2);
    let script = "import sys\nfrom adafruit_uf2 import uf2conv as u\nb = open(sys.argv[1], 'rb').read()\nassert u.is_uf2(b)\n\
                  d = u.convert_from_uf2(b)\nprint('policy', hex(u.appstartaddr), d.hex())";
    let said = python(script, &file);
    // The converter reports families on its own lines; bytes are padded to whole blocks.
    let line = said.lines().find(|line| line.starts_with("policy ")).unwrap();
    let mut padded = FILE.to_vec();
    padded.resize(FILE.len().next_multiple_of(256), 0xFF);
    assert_eq!(line, format!("policy {ADDRESS:#x} {}", hex(&padded)));
    assert!(said.contains(&format!("{FAMILY:#x}")), "{}", said.lines().next().unwrap_or_default());
}

#[test]
fn the_compiler_reads_the_c_header() {
    let folder = tempfile::tempdir().unwrap();
    written(folder.path(), Format::CHeader);
    let main = "#include \"policy.h\"\n#include <stdio.h>\n#include <stdint.h>\n\
                int main(void) {\n    if ((uintptr_t)gadm_policy % 16u != 0u || GADM_POLICY_ADDRESS != 0x08060000u) return 1;\n\
                if (GADM_POLICY_OBSERVATIONS != 5u || GADM_POLICY_ACTIONS != 3u) return 2;\n\
                return fwrite(gadm_policy, 1, sizeof gadm_policy, stdout) == GADM_POLICY_SIZE ? 0 : 3;\n}\n";
    let (source, program) = (folder.path().join("main.c"), folder.path().join("main"));
    std::fs::write(&source, main).unwrap();
    let (source, program) = (source.to_str().unwrap(), program.to_str().unwrap());
    for words in [
        &["-std=c11", "-Wall", "-Wextra", "-Werror", "-pedantic"][..],
        &["-std=c11", "-DGADM_POLICY_SECTION=\".policy\"", "-Wall", "-Werror"],
    ] {
        output(Path::new("cc"), &[words, &["-o", program, source]].concat());
        let out = Command::new(program).output().unwrap();
        assert!(out.status.success() && out.stdout == FILE, "{words:?}: {:?}", out.status);
    }
}
