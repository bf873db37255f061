//! The card of an exported policy.

use gadm_runtime::Policy;
use gadm_runtime::encode::AlignedImage;
use gadm_runtime::space::ActionHead;

use super::Exported;
use crate::card::{
    CARD_VERSION, Card, Interface, Part, PolicyFile, ReturnStats, Returns, Signal, Training, sha256_hex,
};
use crate::config::{config_hash, to_toml};
use crate::error::TrainError;
use crate::runner::origin::Origin;

/// Names and bytes of a file's parts, in file order.
pub fn parts_of(sizes: &gadm_runtime::SectionSizes) -> [(&'static str, usize); 12] {
    [
        ("header", sizes.header),
        ("section table", sizes.table),
        ("interface", sizes.interface),
        ("input quantiser", sizes.input),
        ("Q-network", sizes.q),
        ("confidence network", sizes.confidence),
        ("decoder layers", sizes.decoder),
        ("decoder latent table", sizes.latent_table),
        ("self-test vectors", sizes.self_test),
        ("provenance", sizes.provenance),
        ("trailer", sizes.trailer),
        ("padding", sizes.padding),
    ]
}

/// Writes the card of an export. `wall_time_s` is the training's, `command` what makes it again, `origin` where it trained.
///
/// # Errors
/// Where the file does not load.
pub fn make_card(
    exported: &Exported,
    file: &str,
    command: &str,
    wall_time_s: f64,
    origin: &Origin,
    seed: u64,
    sil: Option<ReturnStats>,
) -> Result<Card, TrainError> {
    let image = AlignedImage::new(&exported.bytes);
    let policy = Policy::load(&image).map_err(|e| TrainError::Export(e.to_string()))?;
    let parts = parts_of(&policy.section_sizes()).into_iter().filter(|(_, bytes)| *bytes > 0);
    let signal = |name: &str, unit: &str, low: f32, high: f32| Signal {
        name: name.to_owned(),
        unit: unit.to_owned(),
        low: Some(f64::from(low)),
        high: Some(f64::from(high)),
    };
    let action = |a: gadm_runtime::ActionSignal| match a.head {
        ActionHead::Continuous { lo, hi } => signal(a.name, a.unit, lo, hi),
        ActionHead::Discrete { n } => signal(a.name, a.unit, 0.0, f32::from(n - 1)),
        ActionHead::Binary => signal(a.name, a.unit, 0.0, 1.0),
    };
    Ok(Card {
        card_version: CARD_VERSION,
        environment: exported.config.env.clone(),
        algorithm: "gadm-dqn".to_owned(),
        licence: "MIT OR Apache-2.0".to_owned(),
        limits: vec![
            "Trained and tested in simulation only.".to_owned(),
            "Observations outside the ranges below are clipped, and the decision says so.".to_owned(),
        ],
        policy: PolicyFile {
            file: file.to_owned(),
            sha256: sha256_hex(&exported.bytes),
            bytes: exported.bytes.len() as u64,
            macs: u64::from(policy.spec().macs),
            latents: u32::from(policy.spec().num_latents),
            latents_used: exported.device.latent_counts.iter().filter(|c| **c > 0).count() as u32,
            parts: parts.map(|(name, bytes)| Part { name: name.to_owned(), bytes: bytes as u64 }).collect(),
        },
        training: Training {
            command: command.to_owned(),
            commit: origin.commit.clone(),
            seeds: vec![exported.config.seed],
            env_steps: exported.env_steps,
            updates: exported.updates,
            wall_time_s,
            machine: origin.machine.clone(),
            config_hash: config_hash(&exported.config)?,
            config: to_toml(&exported.config)?,
        },
        returns: Returns {
            float: ReturnStats::of(&exported.float.returns, seed),
            int8: ReturnStats::of(&exported.device.returns, seed),
            sil,
        },
        parity: exported.parity,
        interface: Interface {
            control_period_us: policy.spec().control_period_us,
            observations: policy.observation_signals().map(|o| signal(o.name, o.unit, o.lo, o.hi)).collect(),
            actions: policy.action_signals().map(action).collect(),
        },
    })
}
