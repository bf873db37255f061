//! Load and response time of a policy on a bus: what the two profiles ask for, and what to do where one does not fit.
//!
//! The arithmetic is [`gadm_node::load`], which the exporter uses too.

use gadm_node::Profile;
pub use gadm_node::load::{BitRate, Load, load, worst_case_bits};
use gadm_node::load::{policy_load, proposal};
use gadm_runtime::Policy;
use serde::Serialize;

use crate::SimError;

/// One profile at one bit rate.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// Name of the profile.
    pub profile: &'static str,
    /// Bit rates.
    pub bit_rate: BitRate,
    /// The load; `None` where the profile cannot carry the policy at all.
    pub load: Option<Load>,
    /// Within the limits.
    pub fits: bool,
    /// Why it does not fit.
    pub reason: Option<String>,
}

/// Answer to "does this policy fit this bus".
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Survey {
    /// Version of this record.
    pub version: u32,
    /// Environment that the policy was trained for; may be empty.
    pub environment: String,
    /// Numbers of an observation.
    pub observations: usize,
    /// Numbers of an action.
    pub actions: usize,
    /// Control period, µs.
    pub control_period_us: u32,
    /// The profiles at the bit rate asked for.
    pub profiles: Vec<Row>,
    /// For each profile, the slowest usual bit rate at which it fits.
    pub proposals: Vec<Row>,
}

impl Survey {
    /// Looks at `profiles` at a bit rate.
    #[must_use]
    pub fn new(policy: &Policy, profiles: &[Profile], rate: BitRate) -> Self {
        let row = |profile: Profile, bit_rate, load: Result<Load, String>| {
            let reason = match &load {
                Ok(load) => load.excess().map(|e| e.to_string()),
                Err(reason) => Some(reason.clone()),
            };
            Row { profile: profile.name(), bit_rate, load: load.ok(), fits: reason.is_none(), reason }
        };
        let now = |profile| policy_load(policy, profile, rate).map_err(|e| e.to_string());
        Self {
            version: 1,
            environment: policy.provenance().environment.to_owned(),
            observations: usize::from(policy.spec().obs_dim),
            actions: usize::from(policy.spec().action_dim),
            control_period_us: policy.spec().control_period_us,
            profiles: profiles.iter().map(|&p| row(p, rate, now(p))).collect(),
            proposals: Profile::ALL
                .iter()
                .filter_map(|&p| proposal(policy, p).map(|(bit_rate, load)| row(p, bit_rate, Ok(load))))
                .collect(),
        }
    }

    /// One of the profiles fits.
    #[must_use]
    pub fn fits(&self) -> bool {
        self.profiles.iter().any(|row| row.fits)
    }

    /// What to do where none fits: the profiles and bit rates that do.
    #[must_use]
    pub fn advice(&self) -> String {
        let all: Vec<_> = self.proposals.iter().map(Row::brief).collect();
        if all.is_empty() {
            "no profile fits at any usual bit rate: lower the control rate or send fewer signals".to_owned()
        } else {
            format!("what fits: {}", all.join("; "))
        }
    }
}

impl Row {
    /// Bit rate in kbit/s, as people write it: `500`, or `500/2000` with CAN FD.
    #[must_use]
    pub fn rate(&self) -> String {
        let (nominal, data) = (self.bit_rate.nominal / 1000, self.bit_rate.data / 1000);
        if self.profile == Profile::FdF32.name() { format!("{nominal}/{data}") } else { nominal.to_string() }
    }

    /// `fd-f32 at 1000/5000 kbit/s (31 %)`.
    fn brief(&self) -> String {
        let percent = self.load.map_or(0.0, |l| l.total_percent);
        format!("{} at {} kbit/s ({percent:.0} %)", self.profile, self.rate())
    }
}

/// Refuses a profile that does not fit.
///
/// # Errors
/// [`SimError::Overload`] with the reason and what fits instead; [`SimError::Layout`] where the profile cannot carry
/// the policy at any bit rate.
pub fn check(policy: &Policy, profile: Profile, rate: BitRate) -> Result<Load, SimError> {
    let load =
        policy_load(policy, profile, rate).map_err(|source| SimError::Layout { profile: profile.name(), source })?;
    match load.excess() {
        None => Ok(load),
        Some(excess) => {
            let survey = Survey::new(policy, &[profile], rate);
            let at = survey.profiles.first().map_or_else(String::new, Row::rate);
            Err(SimError::Overload {
                profile: profile.name(),
                rate: at,
                reason: excess.to_string(),
                advice: survey.advice(),
            })
        }
    }
}
