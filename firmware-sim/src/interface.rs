//! Does a policy fit a plant? Names, units, order, heads and period must agree; the first difference is told.

use gadm_envs::EnvSpec;
use gadm_runtime::Policy;

use crate::SimError;

/// Compares the interface record of a policy with a plant.
///
/// The ranges `lo..hi` of observations may differ: they scale integers on the bus, and both sides take them from the
/// policy file.
///
/// # Errors
/// [`SimError::Interface`] with the first difference.
pub fn check(policy: &Policy, plant: &EnvSpec) -> Result<(), SimError> {
    let differs = |what: String, expected: String, found: String| {
        if expected == found {
            return Ok(());
        }
        let trained_for = policy.provenance().environment.to_owned();
        Err(SimError::Interface { plant: plant.id.clone(), trained_for, what, expected, found })
    };
    let spec = policy.spec();
    differs("observation length".into(), plant.obs_dim().to_string(), spec.obs_dim.to_string())?;
    differs("action length".into(), plant.action_dim().to_string(), spec.action_dim.to_string())?;
    let period = |us: u32| format!("{us} us");
    differs("control period".into(), period(plant.control_period_us), period(spec.control_period_us))?;
    let named = |name: &str, unit: &str| format!("`{name}` in `{unit}`");
    for (i, (want, have)) in plant.observations.iter().zip(policy.observation_signals()).enumerate() {
        differs(format!("observation {i}"), named(&want.name, &want.unit), named(have.name, have.unit))?;
    }
    for (i, (want, have)) in plant.actions.iter().zip(policy.action_signals()).enumerate() {
        differs(format!("action {i}"), named(&want.name, &want.unit), named(have.name, have.unit))?;
        differs(format!("range of action {i}"), format!("{:?}", want.head), format!("{:?}", have.head))?;
    }
    Ok(())
}
