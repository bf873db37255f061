//! The committed header is what cbindgen makes of the crate. `UPDATE_HEADER=1` writes it again.
#![allow(clippy::unwrap_used, reason = "tests may panic")]

use gadm_c_api_tests::root;

#[test]
fn the_header_is_made_from_the_crate() {
    let config = cbindgen::Config::from_file(root().join("cbindgen.toml")).unwrap();
    let sources = ["types", "status", "functions"];
    let builder = sources.iter().fold(cbindgen::Builder::new().with_config(config), |builder, name| {
        builder.with_src(root().join(format!("src/{name}.rs")))
    });
    let mut made = Vec::new();
    builder.generate().unwrap().write(&mut made);
    let path = root().join("include/gadm.h");
    if std::env::var_os("UPDATE_HEADER").is_some() {
        std::fs::write(&path, &made).unwrap();
    }
    let found = std::fs::read(&path).unwrap_or_default();
    assert!(
        found == made,
        "include/gadm.h is not what the crate says: UPDATE_HEADER=1 .ci/test.py c-api writes it again"
    );
}
