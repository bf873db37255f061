//! Writes the corpus: `cargo run --bin seeds` in this folder.

use gadm_fuzz::Source;
use gadm_runtime::encode::{FileOptions, QuantiseOptions, TrailerRecord, quantise, write_float, write_int8};
use std::fs;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
    for target in ["load", "act", "roundtrip", "codec", "node"] {
        fs::create_dir_all(root.join(target))?;
    }
    let mut state = 1u32;
    let mut written = 0;
    while written < 8 {
        let mut bytes = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            // Two thirds of the numbers small.
            let byte = (state >> 24) as u8;
            if state & 0x300 == 0 { byte } else { byte & 0x7F }
        };
        let seed: Vec<u8> = (0..600).map(|_| bytes()).collect();
        let model = Source(&seed).model();
        let obs = model.obs_mean.repeat(2);
        let options = FileOptions { policy_seq: 1, trailer: vec![TrailerRecord { kind: 7, data: vec![1; 5] }] };
        let Ok(quantised) = quantise(&model, &obs, &QuantiseOptions::default()) else { continue };
        fs::write(root.join(format!("load/int8-{written}")), write_int8(&quantised, &obs, &options)?)?;
        if written < 2 {
            fs::write(root.join(format!("load/float-{written}")), write_float(&model, &obs, &options)?)?;
        }
        fs::write(root.join(format!("roundtrip/{written}")), &seed[..200])?;
        fs::write(root.join(format!("act/{written}")), &seed[..48])?;
        fs::write(root.join(format!("codec/{written}")), &seed[..160])?;
        // RUN, then periods: most of what a node does happens in control.
        let mut control = vec![seed[0], seed[1], seed[2], 6];
        control.extend(&seed[..300]);
        fs::write(root.join(format!("node/{written}")), control)?;
        written += 1;
    }
    Ok(())
}
