//! `gadm-sim bus monitor`.

use std::fs::File;
use std::io::{BufRead, BufReader, IsTerminal as _, Write as _};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use gadm_runtime::Policy;
use gadm_sim::bus::Address;
use gadm_sim::monitor::view::View;
use gadm_sim::monitor::{End, Item, Model, Snapshot, Source};
use gadm_sim::sil::read_image;
use gadm_sim::{BitRate, SimError};
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEventKind, KeyModifiers};

use super::say;

const EXAMPLES: &str = "\
Examples:
  gadm-sim bus monitor unix:can.sock --policy policy.bin
  gadm-sim bus monitor --trace run.log --policy policy.bin --once --json
  candump -L can0 | gadm-sim bus monitor --trace - --policy policy.bin

It only listens. Without --policy it shows what every node says, and the bytes
of the rest. With --once it prints one picture and ends: after the whole trace,
or after --for seconds of a bus.

Exit codes: 0 ok, 1 error, 2 usage.";

/// How often a person sees a new picture.
const REFRESH: Duration = Duration::from_millis(100);
/// Most frames between two looks at the keyboard.
const BATCH: usize = 20_000;

/// Arguments of `bus monitor`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The bus: unix:PATH, tcp:HOST:PORT, serial:DEVICE, socketcan:INTERFACE
    #[arg(required_unless_present = "trace", conflicts_with = "trace")]
    bus: Option<Address>,
    /// Read a candump trace instead; - is standard input
    #[arg(long, value_name = "FILE")]
    trace: Option<PathBuf>,
    /// Policy file, for the names and ranges of the signals
    #[arg(long, value_name = "FILE")]
    policy: Option<PathBuf>,
    /// Play the trace X times as fast as it was recorded; 0 reads it at once [default: 1, with --once 0]
    #[arg(long, value_name = "X", requires = "trace")]
    speed: Option<f64>,
    /// Print one picture and end
    #[arg(long)]
    once: bool,
    /// With --once: how long to listen to a bus, seconds
    #[arg(long = "for", value_name = "SECONDS", default_value_t = 2.0, requires = "once")]
    seconds: f64,
    /// With --once: the picture as JSON
    #[arg(long, requires = "once")]
    json: bool,
    /// Bit rate of classic frames and of the arbitration of FD frames, bit/s
    #[arg(long, default_value_t = BitRate::default().nominal, value_name = "BPS",
          value_parser = clap::value_parser!(u32).range(10_000..=1_000_000))]
    bitrate: u32,
    /// Bit rate of the data of FD frames, bit/s
    #[arg(long, default_value_t = BitRate::default().data, value_name = "BPS",
          value_parser = clap::value_parser!(u32).range(10_000..=8_000_000))]
    data_bitrate: u32,
}

/// Runs the command.
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let rate = BitRate { nominal: args.bitrate, data: args.data_bitrate };
    let image = args.policy.as_deref().map(read_image).transpose()?;
    let policy = image.as_ref().map(|image| Policy::load(image).map_err(SimError::Policy)).transpose()?;
    let mut model = Model::new(policy.as_ref(), rate);
    let (source, name) = open(args, rate)?;
    if args.once {
        return once(args, source, &mut model, &name);
    }
    if !std::io::stdout().is_terminal() {
        anyhow::bail!("standard output is no terminal; add --once for one picture as text, or --once --json");
    }
    let view =
        View { source: name, color: std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty()), ..View::default() };
    let mut terminal = ratatui::try_init().context("cannot use this terminal; add --once for one picture as text")?;
    let done = watch(&mut terminal, view, source, &mut model);
    ratatui::restore();
    match done? {
        Some(End::Broken(why)) => Err(anyhow::anyhow!(why)),
        Some(End::Done) | None => Ok(ExitCode::SUCCESS),
    }
}

fn open(args: &Args, rate: BitRate) -> anyhow::Result<(Source, String)> {
    if let Some(address) = &args.bus {
        return Ok((Source::bus(address.clone(), rate), address.to_string()));
    }
    let path = args.trace.clone().unwrap_or_default();
    let speed = args.speed.unwrap_or(if args.once { 0.0 } else { 1.0 });
    if !(speed.is_finite() && speed >= 0.0) {
        anyhow::bail!("--speed: expected 0 or more, found {speed}");
    }
    let live = path.as_os_str() == "-";
    let input: Box<dyn BufRead + Send> = if live {
        Box::new(BufReader::new(std::io::stdin()))
    } else {
        Box::new(BufReader::new(File::open(&path).map_err(|source| SimError::Read { path: path.clone(), source })?))
    };
    // What comes through a pipe has its own pace.
    let pace = (speed > 0.0 && !live).then_some(speed);
    let name = if live { "standard input".to_owned() } else { path.display().to_string() };
    Ok((Source::trace(input, pace), name))
}

fn take(model: &mut Model, item: Item) -> Result<(), SimError> {
    match item {
        Item::Frame(time_us, frame) => model.frame(time_us, &frame)?,
        Item::ErrorFrame(time_us) => model.error_frame(time_us),
        Item::BadLine(what) => model.bad_line(what),
        Item::End(_) => {}
    }
    Ok(())
}

#[expect(clippy::disallowed_methods, reason = "a person watches; no result depends on it")]
fn now() -> Instant {
    Instant::now()
}

fn once(args: &Args, mut source: Source, model: &mut Model, name: &str) -> anyhow::Result<ExitCode> {
    let started = now();
    let limit = args.bus.is_some().then(|| Duration::from_secs_f64(args.seconds.clamp(0.0, 86_400.0)));
    while source.ended().is_none() && limit.is_none_or(|limit| started.elapsed() < limit) {
        if let Some(item) = source.next_within(Duration::from_millis(50)) {
            take(model, item)?;
        }
    }
    if let Some(End::Broken(why)) = source.ended() {
        anyhow::bail!("{name}: {why}");
    }
    let snapshot = model.snapshot();
    let mut out = std::io::stdout().lock();
    if args.json {
        writeln!(out, "{}", serde_json::to_string_pretty(&snapshot)?)?;
    } else {
        write!(out, "{}", text(name, &snapshot)?)?;
    }
    if let Some(line) = &snapshot.bad_line {
        say(&format!("{} lines of {name} are no frames; the last: {line}", snapshot.bad_lines));
    }
    Ok(ExitCode::SUCCESS)
}

/// The picture as the terminal would show it, as text.
fn text(name: &str, snapshot: &Snapshot) -> anyhow::Result<String> {
    let height = 20 + snapshot.rows.len().min(200) as u16;
    let mut terminal = ratatui::Terminal::new(ratatui::backend::TestBackend::new(120, height))?;
    let mut view = View { source: name.to_owned(), ..View::default() };
    terminal.draw(|frame| view.draw(frame, snapshot))?;
    let buffer = terminal.backend().buffer();
    let width = usize::from(buffer.area.width);
    let lines = buffer.content.chunks(width).map(|cells| {
        let line: String = cells.iter().map(ratatui::buffer::Cell::symbol).collect();
        format!("{}\n", line.trim_end())
    });
    // The last line names keys that nobody can press here.
    let lines: Vec<String> = lines.collect();
    Ok(lines[..lines.len() - 1].concat())
}

/// Shows the picture until a person has seen enough. Tells whether the source ended.
fn watch(
    terminal: &mut ratatui::DefaultTerminal,
    mut view: View,
    mut source: Source,
    model: &mut Model,
) -> anyhow::Result<Option<End>> {
    let mut shown = model.snapshot();
    let mut last_frame = (now(), 0);
    loop {
        for _ in 0..BATCH {
            let Some(item) = source.try_next() else { break };
            take(model, item)?;
            last_frame = (now(), model.now_us());
        }
        // On a silent bus the ages grow too.
        if source.ended().is_none() {
            model.advance(last_frame.1 + last_frame.0.elapsed().as_micros() as u64);
        }
        view.ended = source.ended().cloned();
        if !view.paused {
            shown = model.snapshot();
        }
        terminal.draw(|frame| view.draw(frame, &shown))?;
        let deadline = now() + REFRESH;
        while event::poll(deadline.saturating_duration_since(now()))? {
            let Event::Key(key) = event::read()? else { continue };
            if key.kind == KeyEventKind::Release {
                continue;
            }
            match key.code {
                KeyCode::Char('q') | KeyCode::Esc => return Ok(view.ended),
                KeyCode::Char('c') if key.modifiers.contains(KeyModifiers::CONTROL) => return Ok(view.ended),
                KeyCode::Char(' ') => view.paused = !view.paused,
                KeyCode::Char('r') => model.reset(),
                KeyCode::Down | KeyCode::Char('j') => view.select(1, shown.rows.len()),
                KeyCode::Up | KeyCode::Char('k') => view.select(-1, shown.rows.len()),
                KeyCode::PageDown => view.select(10, shown.rows.len()),
                KeyCode::PageUp => view.select(-10, shown.rows.len()),
                _ => continue,
            }
            break;
        }
    }
}
