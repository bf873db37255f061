//! What a campaign runs.

use serde_json::{Value, json};

use crate::SimError;
use crate::fault::Fault;
use crate::scenario::{Criteria, Scenario};
use crate::sil::read_image;

/// One run.
#[derive(Clone, Debug, PartialEq)]
pub struct Job {
    /// The fault; `None` = the nominal run of this seed.
    pub fault: Option<Fault>,
    /// Intensity as the scenario writes it.
    pub intensity: String,
    /// Seed of the run.
    pub seed: u64,
    /// What must hold.
    pub criteria: Criteria,
}

/// All runs of a campaign: the nominal ones first, then fault by intensity by seed.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// The runs.
    pub jobs: Vec<Job>,
    /// What the results depend on but for the seeds, to tell whether a folder belongs to this campaign.
    pub identity: Value,
}

impl Plan {
    /// The plan of a scenario with so many seeds, from the scenario's own on.
    ///
    /// # Errors
    /// [`SimError::Read`] where the policy cannot be read.
    pub fn new(scenario: &Scenario, seeds: u64) -> Result<Self, SimError> {
        let image = read_image(&scenario.policy)?;
        let crc = crc32(&image);
        let seeds = scenario.seed..scenario.seed.saturating_add(seeds.max(1));
        let nominal = scenario.criteria.without_faults();
        let mut jobs: Vec<Job> =
            seeds.clone().map(|seed| Job { fault: None, intensity: "–".to_owned(), seed, criteria: nominal }).collect();
        for entry in &scenario.faults {
            for (intensity, fault) in &entry.sweep {
                let (fault, criteria) = (Some(fault.clone()), entry.criteria);
                let with = |seed| Job { fault: fault.clone(), intensity: intensity.clone(), seed, criteria };
                jobs.extend(seeds.clone().map(with));
            }
        }
        let faults: Vec<Value> = scenario
            .faults
            .iter()
            .flat_map(|e| e.sweep.iter().map(|(label, f)| json!([f, label, e.criteria])))
            .collect();
        let identity = json!({
            "policy_crc32": format!("{crc:08x}"),
            "plant": scenario.plant,
            "episodes": scenario.episodes,
            "profile": scenario.profile.name(),
            "bit_rate": scenario.bit_rate,
            "criteria": scenario.criteria,
            "faults": faults,
        });
        Ok(Self { jobs, identity })
    }
}

/// CRC-32/ISO-HDLC.
fn crc32(bytes: &[u8]) -> u32 {
    let mut crc = !0_u32;
    for &byte in bytes {
        crc ^= u32::from(byte);
        for _ in 0..8 {
            crc = crc >> 1 ^ (0xEDB8_8320 & 0_u32.wrapping_sub(crc & 1));
        }
    }
    !crc
}

#[cfg(test)]
mod tests {
    #[test]
    fn check_value_of_the_crc() {
        assert_eq!(super::crc32(b"123456789"), 0xCBF4_3926);
    }
}
