//! The model card: what a policy file is, how it was made, what it can do, and how to check all that.
//!
//! `card.toml` is for programs, `card.md` says the same to people. Every number in a card comes with the command, the
//! configuration and the seeds that make it again.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::fmt::Write as _;

/// Version of the card's own layout.
pub const CARD_VERSION: u32 = 1;

/// A card could not be read, written, or does not belong to a policy file.
#[derive(Debug, thiserror::Error)]
pub enum CardError {
    /// The text is not a card.
    #[error("not a model card: {0}")]
    Parse(#[from] toml::de::Error),
    /// The card cannot be expressed in TOML.
    #[error("the model card cannot be written as TOML: {0}")]
    Serialise(#[from] toml::ser::Error),
    /// The card is of another layout.
    #[error("model card of version {found}, this program reads version {CARD_VERSION}: use the program that made it")]
    Version {
        /// The card's version.
        found: u32,
    },
    /// The policy file is not the one that the card describes.
    #[error(
        "the policy file ({found_bytes} bytes, SHA-256 {found}) is not the one of its card ({expected_bytes} bytes, \
         SHA-256 {expected}): export it again or restore it"
    )]
    WrongPolicy {
        /// SHA-256 in the card.
        expected: String,
        /// SHA-256 of the file.
        found: String,
        /// Length in the card.
        expected_bytes: u64,
        /// Length of the file.
        found_bytes: u64,
    },
}

/// Everything a card says. Tables come after plain values, as TOML wants them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Card {
    /// [`CARD_VERSION`].
    pub card_version: u32,
    /// Environment id, such as `hopper-v5`.
    pub environment: String,
    /// Algorithm, such as `gadm-dqn`.
    pub algorithm: String,
    /// Licence of the policy file (SPDX expression).
    pub licence: String,
    /// What the policy is not good for; one sentence each.
    pub limits: Vec<String>,
    /// The policy file.
    pub policy: PolicyFile,
    /// How it was trained.
    pub training: Training,
    /// What it reaches.
    pub returns: Returns,
    /// How near the int8 policy is to the float policy.
    pub parity: Parity,
    /// Meaning of the policy's inputs and outputs.
    pub interface: Interface,
}

/// The file that the card is about.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyFile {
    /// File name beside the card.
    pub file: String,
    /// SHA-256 of the file, 64 hexadecimal digits.
    pub sha256: String,
    /// Length in bytes.
    pub bytes: u64,
    /// Multiply-accumulate operations of one decision.
    pub macs: u64,
    /// Latents that the policy can choose from.
    pub latents: u32,
    /// Latents that it chose in its evaluation.
    pub latents_used: u32,
    /// Bytes by part of the file, in file order.
    pub parts: Vec<Part>,
}

/// One part of the policy file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Part {
    /// Name of the part.
    pub name: String,
    /// Its length in bytes.
    pub bytes: u64,
}

/// How a policy was made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Training {
    /// The exact command.
    pub command: String,
    /// Commit of the source, with `+dirty` if the tree had changes.
    pub commit: String,
    /// Training seeds.
    pub seeds: Vec<u64>,
    /// Environment steps.
    pub env_steps: u64,
    /// Gradient updates.
    pub updates: u64,
    /// Wall-clock time in seconds.
    pub wall_time_s: f64,
    /// The machine: processor, cores, memory, system.
    pub machine: String,
    /// Hash of the resolved configuration.
    pub config_hash: String,
    /// The resolved configuration as TOML.
    pub config: String,
}

/// Undiscounted returns of the three forms of the policy. A form that was not evaluated is absent.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Returns {
    /// Float networks on the host.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub float: Option<ReturnStats>,
    /// The int8 policy file on the host.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub int8: Option<ReturnStats>,
    /// The int8 policy file in the software-in-the-loop run, over the bus.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sil: Option<ReturnStats>,
}

/// Statistics of evaluation episodes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReturnStats {
    /// Mean return.
    pub mean: f64,
    /// Sample standard deviation of the return.
    pub sd: f64,
    /// Number of episodes.
    pub n: u32,
    /// Seed of the first episode.
    pub seed: u64,
}

impl ReturnStats {
    /// Mean and sample standard deviation (0 for one episode) of `returns`; `None` if there are none.
    ///
    /// # Examples
    /// ```
    /// let stats = gadm_trainer::card::ReturnStats::of(&[1.0, 2.0, 3.0], 7).expect("three episodes");
    /// assert_eq!((stats.mean, stats.sd, stats.n, stats.seed), (2.0, 1.0, 3, 7));
    /// ```
    pub fn of(returns: &[f64], seed: u64) -> Option<Self> {
        if returns.is_empty() {
            return None;
        }
        let n = returns.len() as f64;
        let mean = returns.iter().sum::<f64>() / n;
        let squares: f64 = returns.iter().map(|value| (value - mean).powi(2)).sum();
        let sd = if returns.len() > 1 { (squares / (n - 1.0)).sqrt() } else { 0.0 };
        Some(Self { mean, sd, n: returns.len() as u32, seed })
    }
}

/// Float policy against int8 policy on the same observations.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Parity {
    /// Observations compared.
    pub samples: u64,
    /// Share of observations on which both choose the same latent, 0 to 1.
    pub argmax_agreement: f64,
    /// Mean absolute action difference where the latents agree, as a share of the action range.
    pub action_error_mean: f64,
    /// Largest absolute action difference where the latents agree, as a share of the action range.
    pub action_error_max: f64,
}

/// Inputs and outputs of the policy in their order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Interface {
    /// Time between decisions in microseconds.
    pub control_period_us: u32,
    /// Inputs.
    pub observations: Vec<Signal>,
    /// Outputs.
    pub actions: Vec<Signal>,
}

/// One input or output.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Signal {
    /// Name.
    pub name: String,
    /// Unit, `1` for none.
    pub unit: String,
    /// Lower bound; absent if there is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub low: Option<f64>,
    /// Upper bound; absent if there is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub high: Option<f64>,
}

/// SHA-256 of `bytes` as 64 hexadecimal digits.
pub fn sha256_hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().fold(String::with_capacity(64), |mut digits, byte| {
        // Writing into a `String` cannot fail.
        let _ = write!(digits, "{byte:02x}");
        digits
    })
}

/// Checks that `policy` is the file that `card` describes.
///
/// # Errors
/// [`CardError::WrongPolicy`] with both lengths and sums.
pub fn verify(card: &Card, policy: &[u8]) -> Result<(), CardError> {
    let found = sha256_hex(policy);
    if found.eq_ignore_ascii_case(&card.policy.sha256) && policy.len() as u64 == card.policy.bytes {
        return Ok(());
    }
    Err(CardError::WrongPolicy {
        expected: card.policy.sha256.clone(),
        found,
        expected_bytes: card.policy.bytes,
        found_bytes: policy.len() as u64,
    })
}

impl Card {
    /// Reads a `card.toml`.
    ///
    /// # Errors
    /// [`CardError::Version`] for a card of another layout, [`CardError::Parse`] for anything else.
    pub fn from_toml(text: &str) -> Result<Self, CardError> {
        // The version first, so that a newer card is called newer and not damaged.
        let found = toml::from_str::<toml::Table>(text)?.get("card_version").and_then(toml::Value::as_integer);
        match found {
            Some(found) if found != i64::from(CARD_VERSION) => {
                Err(CardError::Version { found: u32::try_from(found).unwrap_or(u32::MAX) })
            }
            _ => Ok(toml::from_str(text)?),
        }
    }

    /// The card as `card.toml`.
    ///
    /// # Errors
    /// [`CardError::Serialise`], such as for a seed beyond 63 bits.
    pub fn to_toml(&self) -> Result<String, CardError> {
        Ok(toml::to_string_pretty(self)?)
    }

    /// The card as `card.md`.
    pub fn to_markdown(&self) -> String {
        let mut text = String::new();
        // Writing into a `String` cannot fail.
        let _ = self.write_markdown(&mut text);
        text
    }

    fn write_markdown(&self, out: &mut String) -> std::fmt::Result {
        let Self { policy, training, parity, interface, .. } = self;
        writeln!(out, "# {} · {}\n", self.environment, self.algorithm)?;
        writeln!(out, "Licence: {}. Machine-readable form: `card.toml`.\n", self.licence)?;

        writeln!(
            out,
            "## Returns\n\n| policy | mean | sd | episodes | first seed |\n| --- | ---: | ---: | ---: | ---: |"
        )?;
        let forms = [
            ("float, host", self.returns.float),
            ("int8, host", self.returns.int8),
            ("int8, SIL over the bus", self.returns.sil),
        ];
        for (name, stats) in forms {
            match stats {
                Some(ReturnStats { mean, sd, n, seed }) => {
                    writeln!(out, "| {name} | {mean:.2} | {sd:.2} | {n} | {seed} |")?;
                }
                None => writeln!(out, "| {name} | not evaluated | | | |")?,
            }
        }

        writeln!(out, "\n## Float against int8\n\n| quantity | value |\n| --- | ---: |")?;
        writeln!(out, "| observations compared | {} |", parity.samples)?;
        writeln!(out, "| same latent | {:.2} % |", 100.0 * parity.argmax_agreement)?;
        writeln!(out, "| mean action error | {:.3} % of range |", 100.0 * parity.action_error_mean)?;
        writeln!(out, "| largest action error | {:.3} % of range |", 100.0 * parity.action_error_max)?;

        writeln!(out, "\n## Policy file\n\n`{}`, SHA-256 `{}`\n", policy.file, policy.sha256)?;
        writeln!(out, "| part | bytes |\n| --- | ---: |")?;
        for part in &policy.parts {
            writeln!(out, "| {} | {} |", cell(&part.name), part.bytes)?;
        }
        writeln!(out, "| **total** | **{}** |\n", policy.bytes)?;
        writeln!(
            out,
            "{} of {} latents used; {} multiply-accumulates a decision.",
            policy.latents_used, policy.latents, policy.macs
        )?;

        writeln!(out, "\n## Interface\n\nControl period: {} µs.\n", interface.control_period_us)?;
        for (title, signals) in [("observation", &interface.observations), ("action", &interface.actions)] {
            writeln!(out, "| # | {title} | unit | low | high |\n| ---: | --- | --- | ---: | ---: |")?;
            for (i, signal) in signals.iter().enumerate() {
                let bound = |value: Option<f64>| value.map_or("–".to_owned(), |value| value.to_string());
                let (name, unit) = (cell(&signal.name), cell(&signal.unit));
                writeln!(out, "| {i} | {name} | {unit} | {} | {} |", bound(signal.low), bound(signal.high))?;
            }
            writeln!(out)?;
        }

        writeln!(out, "## Training\n\n```sh\n{}\n```\n", training.command)?;
        let seeds: Vec<String> = training.seeds.iter().map(u64::to_string).collect();
        writeln!(out, "| item | value |\n| --- | --- |")?;
        writeln!(out, "| seeds | {} |", seeds.join(", "))?;
        writeln!(out, "| environment steps | {} |", training.env_steps)?;
        writeln!(out, "| updates | {} |", training.updates)?;
        writeln!(out, "| wall time | {:.0} s |", training.wall_time_s)?;
        writeln!(out, "| machine | {} |", cell(&training.machine))?;
        writeln!(out, "| commit | `{}` |", training.commit)?;
        writeln!(out, "| config hash | `{}` |\n", training.config_hash)?;
        writeln!(out, "Resolved configuration:\n\n```toml\n{}\n```\n", training.config.trim_end())?;

        writeln!(out, "## Limits\n")?;
        for limit in &self.limits {
            writeln!(out, "- {limit}")?;
        }
        if self.limits.is_empty() {
            writeln!(out, "None stated.")?;
        }
        Ok(())
    }
}

/// A text that stays inside one cell of a Markdown table.
fn cell(text: &str) -> String {
    text.replace('|', "\\|").replace('\n', " ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn card(policy: &[u8]) -> Card {
        let signal = |name: &str, low, high| Signal { name: name.into(), unit: "m".into(), low, high };
        Card {
            card_version: CARD_VERSION,
            environment: "inverted-pendulum-v5".into(),
            algorithm: "gadm-dqn".into(),
            licence: "MIT OR Apache-2.0".into(),
            limits: vec!["Trained without disturbances.".into()],
            policy: PolicyFile {
                file: "policy.bin".into(),
                sha256: sha256_hex(policy),
                bytes: policy.len() as u64,
                macs: 5312,
                latents: 16,
                latents_used: 11,
                parts: vec![Part { name: "Q-network".into(), bytes: 2 }, Part { name: "decoder".into(), bytes: 1 }],
            },
            training: Training {
                command: "gadm train --env inverted-pendulum-v5 --seed 1".into(),
                commit: "0123abc".into(),
                seeds: vec![1, 2],
                env_steps: 60_000,
                updates: 30_000,
                wall_time_s: 123.5,
                machine: "2 cores | 8 GiB".into(),
                config_hash: "00ff00ff00ff00ff".into(),
                config: "seed = 1\n\n[algo]\nkind = \"dqn\"\nname = '''a \"quoted\" \\ name'''\n".into(),
            },
            returns: Returns {
                float: ReturnStats::of(&[1.0, 2.0, 4.0], 100),
                int8: ReturnStats::of(&[3.0], 100),
                sil: None,
            },
            parity: Parity {
                samples: 1000,
                argmax_agreement: 0.9975,
                action_error_mean: 0.001,
                action_error_max: 0.0125,
            },
            interface: Interface {
                control_period_us: 40_000,
                observations: vec![signal("cart position", None, None), signal("pole|angle", Some(-0.2), Some(0.2))],
                actions: vec![signal("force", Some(-3.0), Some(3.0))],
            },
        }
    }

    #[test]
    fn a_card_reads_back_equal() {
        let card = card(b"abc");
        let text = card.to_toml().unwrap();
        assert_eq!(Card::from_toml(&text).unwrap(), card);
        assert_eq!(Card::from_toml(&text).unwrap().to_toml().unwrap(), text);
    }

    #[test]
    fn the_sum_is_checked() {
        // FIPS 180-4 example: SHA-256("abc").
        let expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(sha256_hex(b"abc"), expected);
        let card = card(b"abc");
        verify(&card, b"abc").unwrap();
        let text = verify(&card, b"abd!").unwrap_err().to_string();
        assert!(text.contains(expected) && text.contains("4 bytes") && text.contains("3 bytes"), "{text}");
    }

    #[test]
    fn statistics_are_of_a_sample() {
        let stats = ReturnStats::of(&[1.0, 2.0, 4.0], 5).unwrap();
        assert!((stats.mean - 7.0 / 3.0).abs() < 1e-15 && (stats.sd - (7.0f64 / 3.0).sqrt()).abs() < 1e-15);
        assert_eq!(ReturnStats::of(&[3.0], 5).unwrap().sd, 0.0);
        assert!(ReturnStats::of(&[], 5).is_none());
    }

    #[test]
    fn unknown_fields_and_other_versions_are_refused() {
        let text = card(b"abc").to_toml().unwrap();
        let newer = text.replace("card_version = 1", "card_version = 2");
        assert!(matches!(Card::from_toml(&newer), Err(CardError::Version { found: 2 })));
        let typo = text.replace("licence", "license");
        assert!(Card::from_toml(&typo).unwrap_err().to_string().contains("license"));
    }

    #[test]
    fn the_markdown_form_holds_every_part() {
        let text = card(b"abc").to_markdown();
        for part in [
            "# inverted-pendulum-v5 · gadm-dqn",
            "| float, host | 2.33 | 1.53 | 3 | 100 |",
            "| int8, SIL over the bus | not evaluated | | | |",
            "| same latent | 99.75 % |",
            "| **total** | **3** |",
            "11 of 16 latents used; 5312 multiply-accumulates",
            "| 1 | pole\\|angle | m | -0.2 | 0.2 |",
            "| 0 | cart position | m | – | – |",
            "```sh\ngadm train --env inverted-pendulum-v5 --seed 1\n```",
            "kind = \"dqn\"",
            "- Trained without disturbances.",
        ] {
            assert!(text.contains(part), "{part}\n---\n{text}");
        }
    }
}
