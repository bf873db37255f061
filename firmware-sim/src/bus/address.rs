//! Where a bus is, as people write it: `unix:PATH`, `tcp:HOST:PORT`, `serial:DEVICE`, `socketcan:INTERFACE`.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

/// Where a bus is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Address {
    /// A hub's unix socket.
    Unix(PathBuf),
    /// A hub's TCP socket, `host:port`.
    Tcp(String),
    /// A serial device or pseudo-terminal with an SLCAN adapter behind it.
    Serial(PathBuf),
    /// A network interface of the Linux kernel, such as `vcan0` or `can0`.
    SocketCan(String),
}

/// The text is no address of a bus.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{0}` is no bus: expected unix:PATH, tcp:HOST:PORT, serial:DEVICE or socketcan:INTERFACE, such as \
     unix:/run/can.sock, tcp:127.0.0.1:29536, serial:/dev/ttyACM0, socketcan:vcan0"
)]
pub struct AddressError(String);

impl FromStr for Address {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, AddressError> {
        let wrong = || AddressError(text.to_owned());
        let (scheme, rest) = text.split_once(':').filter(|(_, rest)| !rest.is_empty()).ok_or_else(wrong)?;
        match scheme {
            "unix" => Ok(Self::Unix(rest.into())),
            "tcp" => {
                let port =
                    rest.rsplit_once(':').filter(|(host, _)| !host.is_empty()).map(|(_, port)| port.parse::<u16>());
                if matches!(port, Some(Ok(_))) { Ok(Self::Tcp(rest.to_owned())) } else { Err(wrong()) }
            }
            "serial" => Ok(Self::Serial(rest.into())),
            // An interface name of Linux has at most 15 bytes and no slash.
            "socketcan" if rest.len() <= 15 && !rest.contains('/') => Ok(Self::SocketCan(rest.to_owned())),
            _ => Err(wrong()),
        }
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unix(path) => write!(f, "unix:{}", path.display()),
            Self::Tcp(address) => write!(f, "tcp:{address}"),
            Self::Serial(path) => write!(f, "serial:{}", path.display()),
            Self::SocketCan(interface) => write!(f, "socketcan:{interface}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_as_they_are_written() {
        for text in
            ["unix:/run/can.sock", "tcp:127.0.0.1:29536", "tcp:[::1]:1", "serial:/dev/ttyACM0", "socketcan:vcan0"]
        {
            assert_eq!(text.parse::<Address>().unwrap().to_string(), text);
        }
        for text in ["", "unix", "unix:", "tcp:localhost", "tcp::29536", "tcp:h:99999", "can:vcan0", "socketcan:a/b"] {
            assert!(text.parse::<Address>().unwrap_err().to_string().contains("unix:PATH"), "{text}");
        }
    }
}
