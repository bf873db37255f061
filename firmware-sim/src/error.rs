//! What can go wrong, each with what to do next.

use std::io;
use std::path::PathBuf;

use gadm_envs::EnvError;
use gadm_node::codec::LayoutError;
use gadm_runtime::LoadError;

/// What can go wrong in a simulation or while reading a trace.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SimError {
    /// A file could not be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A file could not be written.
    #[error("cannot write {}: {source}; check the folder, its permissions and the free space", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The image is not a policy that can be run.
    #[error("not a policy that can be run: {0}; `gadm inspect` tells more, `gadm export` writes a new file")]
    Policy(LoadError),
    /// A node in another process or on another machine does not do its part.
    #[error("{bus}: {what}")]
    Remote {
        /// Where it is, or should be.
        bus: String,
        /// What is wrong, and what to do.
        what: String,
    },
    /// There is no such plant, or it cannot be made here.
    #[error("plant: {0}")]
    Plant(#[from] EnvError),
    /// Neither the command nor the policy names a plant.
    #[error("the policy file does not say which environment it was trained for; name one with --plant")]
    NoPlant,
    /// The policy was made for another plant.
    #[error(
        "the policy does not fit plant `{plant}`: {what}: the plant has {expected}, the policy {found}; \
         run it on the environment it was trained for{}",
        hint(trained_for)
    )]
    Interface {
        /// The plant.
        plant: String,
        /// The environment named in the policy file; may be empty.
        trained_for: String,
        /// Which part of the interface differs.
        what: String,
        /// What the plant has.
        expected: String,
        /// What the policy has.
        found: String,
    },
    /// The policy does not fit the bus profile.
    #[error("profile {profile} cannot carry this policy: {source}")]
    Layout {
        /// Name of the profile.
        profile: &'static str,
        /// Why.
        source: LayoutError,
    },
    /// A trace that cannot be replayed.
    #[error("there is nothing to replay in the trace: {reason}")]
    Replay {
        /// Why.
        reason: String,
    },
    /// The policy needs more of the bus than it may have.
    #[error(
        "profile {profile} at {rate} kbit/s does not fit: {reason}; {advice} \
         (`gadm-sim bus load` shows all, --allow-overload runs it all the same)"
    )]
    Overload {
        /// Name of the profile.
        profile: &'static str,
        /// Bit rates, kbit/s.
        rate: String,
        /// Which limit, with numbers.
        reason: String,
        /// What fits.
        advice: String,
    },
    /// The node did not become ready, or did not start to control.
    #[error("the node is in state {state} with fault {fault} ({meaning}), expected {expected}; {next}")]
    Node {
        /// State it should have.
        expected: &'static str,
        /// State it has.
        state: String,
        /// Fault it reports.
        fault: &'static str,
        /// The fault in words.
        meaning: &'static str,
        /// What to do.
        next: &'static str,
    },
    /// The target went on and on without waiting for frames.
    #[error(
        "target `{target}` did not come to rest at {now_us} us after {polls} polls; this is a defect of the target"
    )]
    Restless {
        /// Name of the target.
        target: String,
        /// Virtual time.
        now_us: u64,
        /// How often it was polled.
        polls: u32,
    },
    /// This machine lacks something.
    #[error("{what}; {next}")]
    Lacking {
        /// What.
        what: String,
        /// What to do.
        next: String,
    },
    /// A participant could not put a frame on the bus.
    #[error("the bus did not take a frame of the {participant} at {now_us} us: {source}")]
    Bus {
        /// Who sent.
        participant: &'static str,
        /// Virtual time.
        now_us: u64,
        /// Why.
        source: gadm_node::LinkError,
    },
    /// A scenario file has a mistake.
    #[error("{}{}: {what}", path.display(), line.map(|l| format!(":{l}")).unwrap_or_default())]
    Scenario {
        /// The file.
        path: PathBuf,
        /// Line, from 1, where it can be told.
        line: Option<usize>,
        /// What is wrong.
        what: String,
    },
    /// A folder holds another campaign.
    #[error(
        "{} holds a campaign of another scenario, policy or criteria (campaign.json); name another folder with -o, or remove it",
        path.display()
    )]
    Campaign {
        /// The folder.
        path: PathBuf,
    },
    /// A fault cannot be injected here.
    #[error("fault `{name}`: {what}")]
    Fault {
        /// Name of the fault.
        name: String,
        /// Why.
        what: String,
    },
    /// A line of a trace is not one.
    #[error("{} line {line}: {source}; the file must be a `candump -L` log", path.display())]
    Trace {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong.
        source: crate::bus::trace::LineError,
    },
}

impl SimError {
    /// Exit code of a program that ends with this error: 4 where this machine or build lacks something, 3 where the
    /// policy does not fit the bus, else 1.
    #[must_use]
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Plant(EnvError::Feature { .. } | EnvError::Model { .. }) | Self::Lacking { .. } => 4,
            Self::Overload { .. } => 3,
            _ => 1,
        }
    }
}

fn hint(trained_for: &str) -> String {
    if trained_for.is_empty() { String::new() } else { format!(", `--plant {trained_for}`") }
}
