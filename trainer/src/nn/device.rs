//! Where networks are evaluated: by the fused layers of the processor, or by candle on one of its devices.

use std::cell::RefCell;
use std::fmt;
use std::str::FromStr;

use candle_core::Device;

use crate::error::TrainError;

/// What evaluates the networks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Engine {
    /// The fused layers, on the processor.
    #[default]
    Fused,
    /// candle, on the processor: the reference of the fused layers, and of what a GPU does.
    Candle,
    /// candle, on the CUDA device of that number.
    Cuda(usize),
}

impl FromStr for Engine {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let number =
            |n: &str| n.parse().map_err(|_| format!("expected the number of a device behind `cuda:`, found `{n}`"));
        match text.split_once(':') {
            None if text == "cpu" => Ok(Self::Fused),
            None if text == "candle" => Ok(Self::Candle),
            None if text == "cuda" => Ok(Self::Cuda(0)),
            Some(("cuda", n)) => number(n).map(Self::Cuda),
            _ => Err(format!("expected cpu, candle, cuda or cuda:N, found `{text}`")),
        }
    }
}

impl fmt::Display for Engine {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Fused => f.write_str("cpu"),
            Self::Candle => f.write_str("candle"),
            Self::Cuda(n) => write!(f, "cuda:{n}"),
        }
    }
}

thread_local! {
    static DEVICE: RefCell<Option<Device>> = const { RefCell::new(None) };
}

impl Engine {
    /// Has the networks that this thread makes from now on evaluated so.
    ///
    /// # Errors
    /// [`TrainError::Device`] for a CUDA device in a build without CUDA, or one that is not there.
    pub fn start(self) -> Result<(), TrainError> {
        let device = match self {
            Self::Fused => None,
            Self::Candle => Some(Device::Cpu),
            Self::Cuda(_) if !cfg!(feature = "cuda") => {
                return Err(TrainError::Device {
                    device: self.to_string(),
                    reason:
                        "this build has no CUDA; build with `--features cuda` where the CUDA toolkit is installed, or \
                             train with `--device cpu`"
                            .to_owned(),
                });
            }
            Self::Cuda(n) => Some(Device::new_cuda(n).map_err(|e| TrainError::Device {
                device: self.to_string(),
                reason: format!(
                    "cannot be opened ({e}); see `nvidia-smi` for the devices there are, or train with `--device cpu`"
                ),
            })?),
        };
        DEVICE.set(device);
        Ok(())
    }
}

/// The candle device of the networks that this thread makes; none for the fused layers.
pub(super) fn current() -> Option<Device> {
    DEVICE.with_borrow(Clone::clone)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_are_named_as_on_the_command_line() {
        for (text, engine) in [
            ("cpu", Engine::Fused),
            ("candle", Engine::Candle),
            ("cuda:0", Engine::Cuda(0)),
            ("cuda:3", Engine::Cuda(3)),
        ] {
            assert_eq!((text.parse(), engine.to_string()), (Ok(engine), text.to_owned()));
        }
        assert_eq!("cuda".parse(), Ok(Engine::Cuda(0)));
        assert_eq!("gpu".parse::<Engine>().unwrap_err(), "expected cpu, candle, cuda or cuda:N, found `gpu`");
        assert!("cuda:x".parse::<Engine>().is_err() && "candle:1".parse::<Engine>().is_err());
    }

    #[cfg(not(feature = "cuda"))]
    #[test]
    fn a_build_without_cuda_says_what_to_do() {
        let text = Engine::Cuda(1).start().unwrap_err().to_string();
        assert!(text.starts_with("device `cuda:1`: this build has no CUDA") && text.contains("--device cpu"), "{text}");
    }
}
