//! The hub: a bus between processes. Members come over unix sockets, TCP and pseudo-terminals and speak SLCAN.
//!
//! Two threads a member, one that reads it and one that writes to it; what they do is [`Exchange`]. A member that does not
//! read loses frames or, with [`Slow::Wait`], slows the bus down until its patience ends; it never stops it.

use std::fs::File;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{IpAddr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

#[cfg(feature = "socketcan")]
use gadm_node::Frame;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use super::exchange::{Counts, Exchange, Id, Limits};
use super::loopback::Tap;

/// Bytes that are read or written at once.
const CHUNK: usize = 16 << 10;

/// Frames that a chunk can hold at most: the shortest has six characters.
const CHUNK_FRAMES: usize = CHUNK / 6 + 1;

/// How often threads look whether the hub ends.
const TICK: Duration = Duration::from_millis(100);

/// What happens to a member whose queue is full.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Slow {
    /// It loses frames, which are counted.
    Drop,
    /// The others wait for it this long, then it is shut out.
    Wait(Duration),
}

/// How a hub is set up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Options {
    /// Bounds.
    pub limits: Limits,
    /// What happens to slow members.
    pub slow: Slow,
}

impl Default for Options {
    /// 32 members, 8192 frames each; slow members lose frames.
    fn default() -> Self {
        Self { limits: Limits::default(), slow: Slow::Drop }
    }
}

/// What happens at a hub.
#[derive(Clone, Debug)]
pub enum Event {
    /// A member came.
    Joined {
        /// Its number.
        member: Id,
        /// From where.
        from: String,
    },
    /// Somebody was turned away, for want of room.
    Full {
        /// From where.
        from: String,
    },
    /// A member left or was shut out.
    Left {
        /// Its number.
        member: Id,
        /// What it did.
        counts: Counts,
        /// It did not read in time.
        too_slow: bool,
    },
    /// The trace cannot be written any more.
    Trace(Arc<io::Error>),
}

type Listener = Box<dyn Fn(Event) + Send + Sync>;

struct State {
    exchange: Exchange,
    trace: Option<Box<dyn Tap + Send>>,
    /// Hang up on these members.
    shut: Vec<(Id, Hangup)>,
}

struct Shared {
    state: Mutex<State>,
    changed: Condvar,
    options: Options,
    closing: AtomicBool,
    tell: Listener,
}

/// A running hub. It ends when this is dropped.
pub struct Hub {
    shared: Arc<Shared>,
    sockets: Vec<PathBuf>,
    // The other end of each pseudo-terminal stays open, so that a reader that goes away is no error.
    terminals: Vec<OwnedFd>,
}

impl std::fmt::Debug for Hub {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Hub")
            .field("options", &self.shared.options)
            .field("sockets", &self.sockets)
            .finish_non_exhaustive()
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        // A thread that panicked leaves the exchange as it was between two bytes.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn closing(&self) -> bool {
        self.closing.load(Ordering::Relaxed)
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>, at_most: Duration) -> MutexGuard<'a, State> {
        self.changed.wait_timeout(state, at_most).unwrap_or_else(PoisonError::into_inner).0
    }

    /// Waits until everybody has room for a chunk of `from`; shuts out who keeps the others waiting.
    fn make_room<'a>(&self, mut state: MutexGuard<'a, State>, from: Id) -> MutexGuard<'a, State> {
        let Slow::Wait(patience) = self.options.slow else { return state };
        let mut waited = Duration::ZERO;
        let step = Duration::from_millis(10).min(patience);
        while let Some(slow) = state.exchange.crowded(from, CHUNK_FRAMES.min(self.options.limits.queue / 2)) {
            if self.closing() || !state.exchange.has(from) {
                break;
            }
            if waited >= patience {
                self.remove(&mut state, slow, true);
                waited = Duration::ZERO;
                continue;
            }
            state = self.wait(state, step);
            waited += step;
        }
        state
    }

    fn remove(&self, state: &mut State, member: Id, too_slow: bool) {
        if let Some(counts) = state.exchange.leave(member) {
            state.shut.retain(|(id, hangup)| {
                if *id == member {
                    hangup.now();
                }
                *id != member
            });
            (self.tell)(Event::Left { member, counts, too_slow });
        }
        self.changed.notify_all();
    }

    fn put(&self, state: &mut State, member: Id, bytes: &[u8]) {
        let now_us = wall_us();
        let State { exchange, trace, .. } = state;
        let mut failed = None;
        exchange.receive(member, bytes, now_us, &mut |frame| {
            if let (Some(tap), None) = (trace.as_mut(), &failed) {
                failed = tap.frame(now_us, frame).err();
            }
        });
        self.trace_failed(trace, failed);
        self.changed.notify_all();
    }

    fn trace_failed(&self, trace: &mut Option<Box<dyn Tap + Send>>, failed: Option<io::Error>) {
        if let Some(error) = failed {
            *trace = None;
            (self.tell)(Event::Trace(Arc::new(error)));
        }
    }
}

#[expect(clippy::disallowed_methods, reason = "the time stamps of a hub are those of the wall, as candump's are")]
fn wall_us() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_micros() as u64)
}

/// How to end a connection from elsewhere.
enum Hangup {
    Unix(UnixStream),
    Tcp(TcpStream),
    /// A pseudo-terminal cannot be hung up; its threads look at the exchange.
    No,
}

impl Hangup {
    fn now(&self) {
        // Who is gone already cannot be hung up on; that is what is wanted.
        let _ = match self {
            Self::Unix(s) => s.shutdown(Shutdown::Both),
            Self::Tcp(s) => s.shutdown(Shutdown::Both),
            Self::No => Ok(()),
        };
    }
}

impl Hub {
    /// A hub without members. `trace` gets every frame with the time of the wall; `tell` hears what happens.
    pub fn new(
        options: Options,
        trace: Option<Box<dyn Tap + Send>>,
        tell: impl Fn(Event) + Send + Sync + 'static,
    ) -> Self {
        let state = State { exchange: Exchange::new(options.limits), trace, shut: Vec::new() };
        let shared = Shared {
            state: Mutex::new(state),
            changed: Condvar::new(),
            options,
            closing: AtomicBool::new(false),
            tell: Box::new(tell),
        };
        Self { shared: Arc::new(shared), sockets: Vec::new(), terminals: Vec::new() }
    }

    /// Listens on a unix socket that only this user may open. A socket file that nobody listens on is replaced.
    ///
    /// # Errors
    /// Where another hub listens there, or the file cannot be made.
    pub fn listen_unix(&mut self, path: &Path) -> io::Result<()> {
        let listener = match UnixListener::bind(path) {
            Err(e) if e.kind() == ErrorKind::AddrInUse => {
                if UnixStream::connect(path).is_ok() {
                    return Err(io::Error::new(e.kind(), "another program listens there; end it or take another path"));
                }
                std::fs::remove_file(path)?;
                UnixListener::bind(path)?
            }
            other => other?,
        };
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o600))?;
        listener.set_nonblocking(true)?;
        self.sockets.push(path.to_owned());
        let shared = Arc::clone(&self.shared);
        thread::spawn(move || {
            while readable(&shared, listener.as_fd()) {
                if let Ok((stream, _)) = listener.accept() {
                    serve_unix(&shared, stream);
                }
            }
        });
        Ok(())
    }

    /// Listens on TCP and returns the address, whose port the system has chosen where `address` says 0.
    ///
    /// # Errors
    /// Where `address` is not of this machine's loopback and `anywhere` is not set, or it is taken.
    pub fn listen_tcp(&mut self, address: SocketAddr, anywhere: bool) -> io::Result<SocketAddr> {
        if !is_loopback(address.ip()) && !anywhere {
            return Err(io::Error::new(
                ErrorKind::PermissionDenied,
                format!("{address} can be reached from other machines, and the bus has no password"),
            ));
        }
        let listener = TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        let bound = listener.local_addr()?;
        let shared = Arc::clone(&self.shared);
        thread::spawn(move || {
            while readable(&shared, listener.as_fd()) {
                if let Ok((stream, peer)) = listener.accept() {
                    serve_tcp(&shared, stream, peer);
                }
            }
        });
        Ok(bound)
    }

    /// Makes a pseudo-terminal and returns its device, for programs that want a serial port.
    ///
    /// # Errors
    /// Where the system has none left.
    pub fn open_pty(&mut self) -> io::Result<PathBuf> {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        let name = ptsname(&master, Vec::new())?;
        let path = PathBuf::from(name.to_string_lossy().into_owned());
        let other = OwnedFd::from(File::options().read(true).write(true).open(&path)?);
        let mut settings = tcgetattr(&other)?;
        settings.make_raw();
        tcsetattr(&other, OptionalActions::Now, &settings)?;
        self.terminals.push(other);
        let master = File::from(master);
        let writer = master.try_clone()?;
        serve(&self.shared, master, writer, Hangup::No, &format!("pty:{}", path.display()));
        Ok(path)
    }

    /// Makes a SocketCAN interface a member: frames pass both ways.
    ///
    /// # Errors
    /// Where it cannot be opened.
    #[cfg(all(target_os = "linux", feature = "socketcan"))]
    pub fn add_socketcan(&mut self, interface: &str) -> io::Result<()> {
        use super::Bus;
        use gadm_node::Link;

        let mut reader = super::socketcan::SocketCan::open(interface)?;
        let mut writer = reader.clone();
        let Some(member) = join(&self.shared, true, Hangup::No, &format!("socketcan:{interface}")) else {
            return Err(io::Error::other("the hub is full"));
        };
        let shared = Arc::clone(&self.shared);
        thread::spawn(move || {
            let mut frame = Frame::empty();
            while !shared.closing() && shared.lock().exchange.has(member) && reader.wait(TICK).is_ok() {
                while let Ok(true) = reader.receive(&mut frame) {
                    let mut state = shared.make_room(shared.lock(), member);
                    let now_us = wall_us();
                    state.exchange.send(member, &frame, now_us);
                    let failed = state.trace.as_mut().and_then(|t| t.frame(now_us, &frame).err());
                    shared.trace_failed(&mut state.trace, failed);
                    shared.changed.notify_all();
                }
            }
            shared.remove(&mut shared.lock(), member, false);
        });
        let shared = Arc::clone(&self.shared);
        thread::spawn(move || {
            let mut state = shared.lock();
            while !shared.closing() && state.exchange.has(member) {
                match state.exchange.take_frame(member) {
                    Some(frame) => {
                        drop(state);
                        // What the interface does not take (an FD frame on a classic one, say) it loses, as a gateway does.
                        let _ = writer.send(&frame);
                        state = shared.lock();
                    }
                    None => state = shared.wait(state, TICK),
                }
            }
        });
        Ok(())
    }

    /// Number of members that have come so far and are there.
    pub fn members(&self) -> usize {
        self.shared.lock().exchange.len()
    }
}

impl Drop for Hub {
    fn drop(&mut self) {
        self.shared.closing.store(true, Ordering::Relaxed);
        let mut state = self.shared.lock();
        for (_, hangup) in state.shut.drain(..) {
            hangup.now();
        }
        state.trace = None; // flushes it
        self.shared.changed.notify_all();
        for path in &self.sockets {
            // Somebody may have removed it before.
            let _ = std::fs::remove_file(path);
        }
    }
}

fn is_loopback(ip: IpAddr) -> bool {
    match ip {
        IpAddr::V4(ip) => ip.is_loopback(),
        IpAddr::V6(ip) => ip.is_loopback() || ip.to_ipv4_mapped().is_some_and(|ip| ip.is_loopback()),
    }
}

/// Waits for something to read; false when the hub ends.
fn readable(shared: &Shared, fd: BorrowedFd<'_>) -> bool {
    loop {
        if shared.closing() {
            return false;
        }
        let time = Timespec { tv_sec: 0, tv_nsec: i64::from(TICK.subsec_nanos()) };
        match poll(&mut [PollFd::from_borrowed_fd(fd, PollFlags::IN)], Some(&time)) {
            Ok(0) | Err(rustix::io::Errno::INTR) => {}
            Ok(_) => return true,
            Err(_) => return false,
        }
    }
}

fn serve_unix(shared: &Arc<Shared>, stream: UnixStream) {
    // Without two handles there is nothing to serve; the client sees the end of the connection.
    let (Ok(()), Ok(writer), Ok(hangup)) = (stream.set_nonblocking(false), stream.try_clone(), stream.try_clone())
    else {
        return;
    };
    serve(shared, stream, writer, Hangup::Unix(hangup), "unix");
}

fn serve_tcp(shared: &Arc<Shared>, stream: TcpStream, peer: SocketAddr) {
    let set = stream.set_nonblocking(false).and_then(|()| stream.set_nodelay(true));
    let (Ok(()), Ok(writer), Ok(hangup)) = (set, stream.try_clone(), stream.try_clone()) else {
        return;
    };
    serve(shared, stream, writer, Hangup::Tcp(hangup), &format!("tcp:{peer}"));
}

fn join(shared: &Shared, open: bool, hangup: Hangup, from: &str) -> Option<Id> {
    let mut state = shared.lock();
    let Some(member) = state.exchange.join(open) else {
        hangup.now();
        (shared.tell)(Event::Full { from: from.to_owned() });
        return None;
    };
    state.shut.push((member, hangup));
    (shared.tell)(Event::Joined { member, from: from.to_owned() });
    Some(member)
}

fn serve<R, W>(shared: &Arc<Shared>, mut reader: R, mut writer: W, hangup: Hangup, from: &str)
where
    R: Read + AsFd + Send + 'static,
    W: Write + Send + 'static,
{
    let Some(member) = join(shared, false, hangup, from) else { return };
    let ours = Arc::clone(shared);
    thread::spawn(move || {
        let mut bytes = vec![0; CHUNK];
        while readable(&ours, reader.as_fd()) && ours.lock().exchange.has(member) {
            match reader.read(&mut bytes) {
                Ok(0) => break,
                Ok(n) => {
                    let mut state = ours.make_room(ours.lock(), member);
                    ours.put(&mut state, member, &bytes[..n]);
                }
                Err(e) if matches!(e.kind(), ErrorKind::Interrupted | ErrorKind::WouldBlock) => {}
                Err(_) => break,
            }
        }
        ours.remove(&mut ours.lock(), member, false);
    });
    let ours = Arc::clone(shared);
    thread::spawn(move || {
        let mut bytes = Vec::with_capacity(CHUNK + 256);
        let mut state = ours.lock();
        while !ours.closing() && state.exchange.has(member) {
            if state.exchange.queued(member) == 0 {
                state = ours.wait(state, TICK);
                continue;
            }
            bytes.clear();
            state.exchange.take(member, &mut bytes, CHUNK);
            drop(state);
            ours.changed.notify_all(); // there is room again
            let sent = writer.write_all(&bytes);
            state = ours.lock();
            if sent.is_err() {
                ours.remove(&mut state, member, false);
            }
        }
    });
}
