//! The rungs of the ladder: where the node of a run is, and what bus lies between it and the plant.
//!
//! | rung | node | bus |
//! | --- | --- | --- |
//! | A | in this process | in this process |
//! | B | another process | a hub: unix socket, TCP, pseudo-terminal |
//! | C | emulated board | its UART (`target::qemu`) |
//! | D | another process | SocketCAN, such as `vcan0` |
//! | E | a board on a desk | a serial adapter, or SocketCAN such as `can0` |
//!
//! Plant, host, trace, faults and result are the same code on each: a [`Target`] takes the node's place on the loopback.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use gadm_node::{Link, NodeConfig, NodeStatus, TimeSource};
use gadm_runtime::Policy;

use crate::bus::hub::{Hub, Options};
use crate::bus::load::BitRate;
use crate::bus::loopback::Loopback;
use crate::bus::{self, Address};
use crate::sil::{policy_layout, run_with};
use crate::target::qemu::{Board, Emulator};
use crate::target::{Expected, InProcess, Pace, Paced, Remote, Target, Timing};
use crate::{Progress, RunOptions, RunResult, SimError};

/// How long a node may take to appear on its bus.
pub const PATIENCE: Duration = Duration::from_secs(10);

/// Where the node is.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum Place {
    /// In this process.
    #[default]
    InProcess,
    /// In a process of its own, over a hub that is made for this run.
    Hub {
        /// The program whose `node` command runs it: this one.
        program: PathBuf,
    },
    /// On a bus.
    Bus {
        /// Where.
        address: Address,
        /// The program whose `node` command is started for it; `None` = somebody else has put a node there.
        program: Option<PathBuf>,
    },
    /// On an emulated board.
    Board(Board),
}

/// Where the node is, and what time is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rung {
    /// Where the node is.
    pub place: Place,
    /// Virtual seconds in a second of the wall; `None` = lockstep.
    pub realtime: Option<f64>,
}

/// What a node runs.
#[derive(Debug)]
pub struct Job<'p> {
    /// File of the policy, for a node in another process.
    pub policy: &'p Path,
    /// The file's bytes.
    pub image: &'p [u8],
    /// How the node is set up.
    pub config: NodeConfig,
    /// Bit rates, for an adapter.
    pub bit_rate: BitRate,
    /// Work memory for a node in this process.
    pub scratch: &'p mut [u32],
}

impl Rung {
    /// Puts a node with `job` at its place. `link` is its port on the loopback `local`, or a link around it.
    ///
    /// # Errors
    /// [`SimError::Remote`] where the bus is not there, no node comes, or it has another policy.
    #[expect(clippy::needless_pass_by_value, reason = "the work memory in it goes to the node for good")]
    pub fn target<'p, L: Link + 'p>(
        &self,
        link: L,
        local: &Loopback,
        job: Job<'p>,
    ) -> Result<Box<dyn Target + 'p>, SimError> {
        let policy = Policy::load(job.image).map_err(SimError::Policy)?;
        let pace = self.realtime.map(|factor| Pace::new(factor, policy.spec().control_period_us));
        if self.place != Place::InProcess && self.realtime.is_none() && job.config.time == TimeSource::Local {
            return Err(SimError::Remote {
                bus: "lockstep".to_owned(),
                what: "a fault of the node's own timer (clock-drift) needs a node in this process, or --realtime"
                    .to_owned(),
            });
        }
        let mut emulator = None;
        let (address, program, hub) = match &self.place {
            Place::InProcess => {
                let node = InProcess::new(job.config, link, job.image, job.scratch);
                return Ok(match pace {
                    Some(pace) => Box::new(Paced::new(node, pace)),
                    None => Box::new(node),
                });
            }
            Place::Bus { address, program } => (address.clone(), program.as_ref(), None),
            Place::Board(board) => {
                let time = if pace.is_some() { TimeSource::Local } else { TimeSource::Tick };
                let board = emulator.insert(board.power_on(job.image, &NodeConfig { time, ..job.config })?);
                (Address::Unix(board.socket().to_owned()), None, None)
            }
            Place::Hub { program } => {
                let path = std::env::temp_dir().join(format!("gadm-sim-{}.sock", std::process::id()));
                let mut hub = Hub::new(Options::default(), None, |_| {});
                hub.listen_unix(&path).map_err(|e| failed(&path.display().to_string(), &e))?;
                (Address::Unix(path), Some(program), Some(hub))
            }
        };
        let name = match &self.place {
            Place::Board(board) => board.machine.to_string(),
            _ => address.to_string(),
        };
        let joined = bus::open(&address, job.bit_rate).map_err(|e| failed(&name, &e))?;
        let child = program.map(|p| spawn(p, &address, &job, self.realtime)).transpose()?;
        let expected = Expected {
            bus: name,
            node: job.config.node,
            policy_crc: policy.header().payload_crc32,
            profile: job.config.profile,
            action_frames: policy_layout(&policy, job.config.profile)?.action_parts(),
            patience: PATIENCE,
        };
        let inner = Remote::start(link, local.clone(), joined, expected, pace)?;
        Ok(Box::new(Spawned { inner, _child: child, _emulator: emulator, _hub: hub }))
    }
}

fn failed(bus: &str, error: &std::io::Error) -> SimError {
    SimError::Remote { bus: bus.to_owned(), what: format!("cannot join the bus: {error}") }
}

/// Runs a policy file on a plant of the registry, with the node where `rung` says.
///
/// # Errors
/// Everything in [`SimError`].
pub fn run_on(options: &RunOptions, rung: &Rung, progress: &mut dyn FnMut(Progress)) -> Result<RunResult, SimError> {
    run_with(options, progress, |image, env, tap, progress| {
        let policy = Policy::load(image).map_err(SimError::Policy)?;
        let mut scratch = vec![0; policy.spec().scratch_words];
        let config = crate::sil::node_config(options);
        let job = Job { policy: &options.policy, image, config, bit_rate: options.bit_rate, scratch: &mut scratch };
        crate::sil::simulate_on(options, image, env, tap, progress, |port, bus| rung.target(port, bus, job))
    })
}

/// A node process, ended with the run.
#[derive(Debug)]
struct NodeProcess(Child);

impl Drop for NodeProcess {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn spawn(program: &Path, address: &Address, job: &Job<'_>, realtime: Option<f64>) -> Result<NodeProcess, SimError> {
    let mut command = Command::new(program);
    command.arg("node").arg(job.policy).arg("--quiet").args(["--connect", &address.to_string()]);
    command.args(["--profile", job.config.profile.name(), "--node", &job.config.node.get().to_string()]);
    command.args(["--bitrate", &job.bit_rate.nominal.to_string(), "--data-bitrate", &job.bit_rate.data.to_string()]);
    if let Some(factor) = realtime {
        command.args(["--realtime", &factor.to_string()]);
    }
    // The node ends when this process does, however that ends: nobody else holds the other end of its input.
    command.arg("--until-input-ends").stdin(Stdio::piped()).stdout(Stdio::null());
    command.spawn().map(NodeProcess).map_err(|e| SimError::Remote {
        bus: address.to_string(),
        what: format!("cannot start the node process {}: {e}", program.display()),
    })
}

/// A target with what was started for it. Fields are dropped in order: the bus, the process, the hub.
struct Spawned<T> {
    inner: T,
    _child: Option<NodeProcess>,
    _emulator: Option<Emulator>,
    _hub: Option<Hub>,
}

impl<T: Target> Target for Spawned<T> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn settle(&mut self, now_us: u64) -> Result<(), SimError> {
        self.inner.settle(now_us)
    }

    fn power_cycle(&mut self) -> Result<(), SimError> {
        self.inner.power_cycle()
    }

    fn status(&self) -> Option<NodeStatus> {
        self.inner.status()
    }

    fn timing(&self) -> Option<Timing> {
        self.inner.timing()
    }
}
