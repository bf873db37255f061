//! What can go wrong with an environment.

/// What can go wrong with an environment.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EnvError {
    /// No environment of that name.
    #[error("unknown environment `{id}`{}; known: {known}", nearest.as_ref().map(|n| format!(" (did you mean `{n}`?)")).unwrap_or_default())]
    Unknown {
        /// The name asked for.
        id: String,
        /// The most similar name that exists, if one is similar.
        nearest: Option<String>,
        /// The names that exist.
        known: String,
    },
    /// The environment exists but was left out of this build.
    #[error(
        "environment `{id}` needs the cargo feature `{feature}`, which this program was built without; build with `--features {feature}` (after `make setup`)"
    )]
    Feature {
        /// Environment.
        id: String,
        /// Feature that holds it.
        feature: &'static str,
    },
    /// The simulator refused a model.
    #[error("environment `{id}`: MuJoCo cannot load its model: {message}")]
    Model {
        /// Environment.
        id: String,
        /// The simulator's reason.
        message: String,
    },
    /// An option that the environment does not have, or a value out of range.
    #[error("environment `{id}`: option `{option}`: {message}")]
    Option {
        /// Environment.
        id: String,
        /// Name of the option.
        option: &'static str,
        /// What was expected and found.
        message: String,
    },
    /// A saved state of another shape.
    #[error(
        "state does not fit environment `{id}`: expected {expected} numbers, found {found}; it was saved by another environment or version"
    )]
    State {
        /// Environment.
        id: String,
        /// Numbers expected.
        expected: usize,
        /// Numbers found.
        found: usize,
    },
    /// A saved state of the right shape with an impossible value.
    #[error("state does not fit environment `{id}`: {message}")]
    StateValue {
        /// Environment.
        id: String,
        /// Which value, what was expected and found.
        message: String,
    },
    /// A disturbance that the plant cannot take.
    #[error("environment `{id}` cannot be disturbed so: {message}")]
    Disturbance {
        /// Environment.
        id: String,
        /// Which disturbance, what was expected.
        message: String,
    },
    /// A batch of another shape, or a row of environments that cannot be.
    #[error("{what}: expected {expected}, found {found}")]
    Batch {
        /// What was given.
        what: &'static str,
        /// Number expected.
        expected: usize,
        /// Number found.
        found: usize,
    },
    /// The thread that steps a part of the environments stopped.
    #[error("the environment worker thread stopped; its panic message is above")]
    Worker,
}
