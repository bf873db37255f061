//! Which of the runtime's loaders the node uses.

use gadm_runtime::{LoadError, Policy};

/// Proves the file, or trusts its exporter where the firmware was built so (feature `trust-exporter`).
///
/// # Errors
/// Why the image is not a policy that can be run.
pub(crate) fn load(image: &[u8]) -> Result<Policy<'_>, LoadError> {
    if cfg!(feature = "trust-exporter") { Policy::load_trusted(image) } else { Policy::load(image) }
}
