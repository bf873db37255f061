//! A board that QEMU emulates, with the firmware as its program, a policy flashed, and its UART as a socket.

use std::fmt;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::str::FromStr;
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::Duration;

use gadm_node::NodeConfig;
use gadm_node::settings::write_settings;

use crate::SimError;
use crate::bus::stream::{deadline, left};

/// The emulator.
const PROGRAM: &str = "qemu-system-arm";

/// How long the emulator may take to offer its UART.
const PATIENCE: Duration = Duration::from_secs(20);

/// A board that there is firmware for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Machine {
    /// Arm MPS2 with a Cortex-M4F.
    Mps2An386,
    /// Arm MPS2 with a Cortex-M7.
    Mps2An500,
    /// Netduino Plus 2: STM32F405, Cortex-M4F.
    NetduinoPlus2,
}

impl Machine {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Mps2An386, Self::Mps2An500, Self::NetduinoPlus2];

    /// Name, as QEMU spells it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Mps2An386 => "mps2-an386",
            Self::Mps2An500 => "mps2-an500",
            Self::NetduinoPlus2 => "netduinoplus2",
        }
    }

    /// Address of policy slot 0 and of the settings record. The firmware has the same numbers in `src/board`.
    #[must_use]
    pub const fn addresses(self) -> (u32, u32) {
        match self {
            Self::Mps2An386 | Self::Mps2An500 => (0x0020_0000, 0x0030_0000),
            Self::NetduinoPlus2 => (0x0806_0000, 0x080E_0000),
        }
    }
}

impl fmt::Display for Machine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "qemu:{}", self.name())
    }
}

/// The text names no board.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is no emulated board: expected qemu:mps2-an386, qemu:mps2-an500 or qemu:netduinoplus2")]
pub struct MachineError(String);

impl FromStr for Machine {
    type Err = MachineError;

    fn from_str(text: &str) -> Result<Self, MachineError> {
        Self::ALL.into_iter().find(|m| m.to_string() == text).ok_or_else(|| MachineError(text.to_owned()))
    }
}

/// A board, and the firmware that it is given.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Board {
    /// The board.
    pub machine: Machine,
    /// ELF file of the firmware.
    pub firmware: PathBuf,
}

impl Board {
    /// A board with the firmware that `firmware-sim/firmware/build.sh` builds, in the project's folder.
    #[must_use]
    pub fn new(machine: Machine) -> Self {
        Self { machine, firmware: format!("target/firmware/{}.elf", machine.name()).into() }
    }

    /// Powers the board on with `policy` in slot 0 and `config` as its settings. It waits for the first who connects to its
    /// UART. `policy` is the policy's bytes, or an Intel HEX file (its first byte is a colon), which says itself where it is
    /// flashed.
    ///
    /// # Errors
    /// [`SimError::Lacking`] without emulator or firmware, [`SimError::Remote`] where the emulator does not come up.
    pub fn power_on(&self, policy: &[u8], config: &NodeConfig) -> Result<Emulator, SimError> {
        if !self.firmware.is_file() {
            return Err(SimError::Lacking {
                what: format!("there is no firmware {}", self.firmware.display()),
                next: format!(
                    "build it in the project's folder with firmware-sim/firmware/build.sh {}, or name another with --firmware",
                    self.machine.name()
                ),
            });
        }
        let failed = |what: String| SimError::Remote { bus: self.machine.to_string(), what };
        let folder = Folder::new().map_err(|e| failed(format!("cannot make a folder for the emulator: {e}")))?;
        let (slot, settings) = self.machine.addresses();
        let mut command = Command::new(PROGRAM);
        command.args(["-M", self.machine.name(), "-display", "none", "-monitor", "none"]);
        command.args(["-accel", "tcg,thread=single"]).arg("-kernel").arg(&self.firmware);
        let (name, place) =
            if policy.first() == Some(&b':') { ("policy.hex", String::new()) } else { ("policy.bin", raw_at(slot)) };
        let settings_bytes = write_settings(config);
        for (name, bytes, place) in [(name, policy, place), ("settings.bin", &settings_bytes[..], raw_at(settings))] {
            let path = folder.0.join(name);
            fs::write(&path, bytes).map_err(|source| SimError::Write { path: path.clone(), source })?;
            command.args(["-device", &format!("loader,file={}{place}", option(&path))]);
        }
        let socket = folder.0.join("uart");
        command.args(["-serial", &format!("unix:{},server=on,wait=on", option(&socket))]);
        let log = folder.0.join("log");
        let stderr = File::create(&log).map_err(|source| SimError::Write { path: log.clone(), source })?;
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(stderr);
        let child = command.spawn().map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => SimError::Lacking {
                what: format!("{PROGRAM} is not installed"),
                next: "install it (Debian: apt-get install qemu-system-arm)".to_owned(),
            },
            _ => failed(format!("cannot start {PROGRAM}: {error}")),
        })?;
        let mut emulator = Emulator { child, socket, _folder: folder };
        let end = deadline(PATIENCE);
        loop {
            // The socket's file is there a moment before anybody may connect; then the emulator says that it waits.
            let said = fs::read_to_string(&log).unwrap_or_default();
            if said.contains("waiting for connection") {
                break;
            }
            let ended = emulator.child.try_wait().ok().flatten();
            if ended.is_some() || left(end).is_none() {
                let how = ended.map_or_else(|| "hangs".to_owned(), |status| format!("ended ({status})"));
                return Err(failed(format!("{PROGRAM} {how}: {}", said.trim())));
            }
            thread::sleep(Duration::from_millis(5));
        }
        Ok(emulator)
    }
}

/// Where QEMU's loader puts a file that is only bytes.
fn raw_at(address: u32) -> String {
    format!(",addr={address:#x},force-raw=on")
}

/// A path within an option of QEMU, where commas separate.
fn option(path: &Path) -> String {
    path.display().to_string().replace(',', ",,")
}

/// A running emulator; ends with this value.
#[derive(Debug)]
pub struct Emulator {
    child: Child,
    socket: PathBuf,
    _folder: Folder,
}

impl Emulator {
    /// The unix socket that is the board's UART.
    #[must_use]
    pub fn socket(&self) -> &Path {
        &self.socket
    }
}

impl Drop for Emulator {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A folder that goes with its value.
#[derive(Debug)]
struct Folder(PathBuf);

impl Folder {
    fn new() -> io::Result<Self> {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let number = COUNT.fetch_add(1, Ordering::Relaxed);
        let path = std::env::temp_dir().join(format!("gadm-qemu-{}-{number}", std::process::id()));
        fs::create_dir(&path)?;
        Ok(Self(path))
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // What is left behind is a temporary folder.
        let _ = fs::remove_dir_all(&self.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn machines_are_read_as_they_are_written() {
        for machine in Machine::ALL {
            assert_eq!(machine.to_string().parse(), Ok(machine));
        }
        let error = "qemu:mps3".parse::<Machine>().unwrap_err().to_string();
        assert!(error.contains("qemu:mps2-an386"), "{error}");
    }

    #[test]
    fn without_firmware_it_is_said_how_to_build_it() {
        let board = Board { firmware: "no/such.elf".into(), ..Board::new(Machine::Mps2An386) };
        let error = board.power_on(&[], &NodeConfig::default()).unwrap_err();
        assert!(error.to_string().contains("firmware-sim/firmware/build.sh mps2-an386"), "{error}");
        assert_eq!(error.exit_code(), 4);
    }
}
