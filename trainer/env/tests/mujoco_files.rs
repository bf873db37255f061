//! MuJoCo leaves no files behind, needs none at run time, and runs the models that the recordings name.
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]
#![cfg(feature = "mujoco")]

use std::{fs, path::Path};

use flate2::read::GzDecoder;
use sha2::{Digest, Sha256};

/// The only test that changes the current folder, hence the only one in this file that makes environments.
#[test]
fn loading_needs_no_folder_and_warnings_go_to_no_file() {
    let folder = tempfile::tempdir().unwrap();
    std::env::set_current_dir(folder.path()).unwrap();
    // This model makes the engine warn; its own handler would print that and write MUJOCO_LOG.TXT.
    let mut env = gadm_envs::make("half-cheetah-v5").unwrap();
    assert!(gadm_envs::mujoco_warning_count() > 0);
    let mut obs = vec![0.0; env.spec().obs_dim()];
    env.reset(0, &mut obs);
    env.step(&[0.0; 6], &mut obs);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn the_models_are_those_of_the_recordings() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut checked = 0;
    for entry in fs::read_dir(root.join("../../tests/golden/envs")).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|e| e != "gz") {
            continue;
        }
        let document: serde_json::Value =
            serde_json::from_reader(GzDecoder::new(fs::File::open(&path).unwrap())).unwrap();
        if let Some(name) = document["meta"]["xml"].as_str() {
            let xml = fs::read(root.join("assets").join(name)).unwrap();
            let hash = Sha256::digest(xml);
            let recorded = document["meta"]["xml_sha256"].as_str().unwrap();
            let recorded: Vec<u8> =
                (0..recorded.len()).step_by(2).map(|i| u8::from_str_radix(&recorded[i..i + 2], 16).unwrap()).collect();
            assert_eq!(recorded, hash.as_slice(), "{name}");
            checked += 1;
        }
    }
    assert_eq!(checked, 13);
}
