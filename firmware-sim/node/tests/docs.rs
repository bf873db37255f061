//! The tables of the book are those of the code.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

use std::fmt::Write as _;
use std::path::Path;

use gadm_node::protocol::{Field, Index, MESSAGES, Message, Period};
use gadm_node::reason::Reason;
use gadm_node::safety::TRANSITIONS;
use gadm_node::service::Page;
use gadm_node::slots::SlotState;
use gadm_node::store::Refusal;
use gadm_node::{Event, Fault, Flags, State};

/// Compares the text between `<!-- name -->` and `<!-- end -->` with the tables, or writes it with `UPDATE_DOCS=1`.
fn check(page: &str, tables: &[(&str, String)]) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/src").join(page);
    let mut text = std::fs::read_to_string(&path).unwrap();
    let before = text.clone();
    for (name, table) in tables {
        let begin = format!("<!-- {name} -->\n");
        let start = text.find(&begin).unwrap_or_else(|| panic!("{page} has no mark {begin}")) + begin.len();
        let end = start + text[start..].find("<!-- end -->").unwrap_or_else(|| panic!("{page}: {name} has no end"));
        text.replace_range(start..end, &format!("\n{table}\n"));
    }
    if std::env::var_os("UPDATE_DOCS").is_some() {
        std::fs::write(&path, text).unwrap();
    } else {
        assert!(
            text == before,
            "docs/src/{page} is not what the code says; run: UPDATE_DOCS=1 cargo test -p gadm-node --test docs"
        );
    }
}

fn identifiers(m: &Message) -> String {
    let base = format!("0x{:03X}", m.base);
    let last = m.base + m.count - 1;
    match m.index {
        Index::Single => base,
        Index::Node => format!("{base} + n"),
        Index::Part => format!("{base} + part, to 0x{last:03X}"),
        Index::NodePart => format!("{base} + 64 (part − 1) + n, to 0x{last:03X}"),
    }
}

fn messages() -> String {
    let mut t = String::from("| identifier | name | from → to | period | meaning |\n| --- | --- | --- | --- | --- |\n");
    for m in MESSAGES {
        let period = match m.period {
            Period::Event => "event".to_owned(),
            Period::Control => "control period".to_owned(),
            Period::Millis(ms) => format!("{ms} ms"),
        };
        let (id, from, to) = (identifiers(m), m.from.name(), m.to.name());
        writeln!(t, "| {id} | {} | {from} → {to} | {period} | {} |", m.name, m.doc).unwrap();
    }
    t
}

fn layout(t: &mut String, name: &str, form: &str, fields: &[Field]) {
    let mut offset = 0;
    for f in fields {
        let count = if f.kind.count() > 1 { format!("up to {} × ", f.kind.count()) } else { String::new() };
        let at = if f.name == "crc" { "end".to_owned() } else { offset.to_string() };
        let unit = if f.unit.is_empty() { "–" } else { f.unit };
        writeln!(t, "| {name} {form} | {at} | {} | {count}{} | {unit} | {} |", f.name, f.kind.name(), f.doc).unwrap();
        offset += f.kind.bytes();
    }
}

fn payloads() -> String {
    let mut t =
        String::from("| message | byte | field | type | unit | meaning |\n| --- | --- | --- | --- | --- | --- |\n");
    for m in MESSAGES {
        layout(&mut t, m.name, if m.fd.is_empty() { "" } else { "classic" }, m.classic);
        layout(&mut t, m.name, "FD", m.fd);
    }
    t.replace("  |", " |")
}

fn flags() -> String {
    let meaning = [
        "the safe action, or a step of the ramp to it",
        "the mask left no latent; the most confident one was taken",
        "an observation was cut to the input range of the policy, or an action to its limits",
        "the last action again, for want of a good observation set",
        "timing not as agreed: period off by more than 20 %, or a part came after its tick had passed",
    ];
    let mut t = String::from("| bit | flag | meaning |\n| --- | --- | --- |\n");
    for (i, (name, meaning)) in Flags::NAMES.iter().zip(meaning).enumerate() {
        writeln!(t, "| {i} | `{name}` | {meaning} |").unwrap();
    }
    t
}

fn pages() -> String {
    let mut t = String::from("| page | value |\n| --- | --- |\n");
    for &page in Page::ALL {
        writeln!(t, "| {} | `{}` |", page.code(), page.name()).unwrap();
    }
    t
}

fn states() -> String {
    let mut t = String::from("| number | state | what the node does |\n| --- | --- | --- |\n");
    for &state in State::ALL {
        let does = match state {
            State::Boot => "reads the policy image",
            State::SelfTest => "runs the policy's own vectors",
            State::NoPolicy => "has no policy that may be run; heartbeat only",
            State::Ready => "waits for RUN; heartbeat only",
            State::Run => "controls: one action set for each TICK",
            State::Safe => "sends the safe action for each TICK",
            State::Fault => "sends the safe action for each TICK; only RESET or power leads out",
        };
        writeln!(t, "| {} | {} | {does} |", state.code(), state.name()).unwrap();
    }
    t
}

fn event(e: Event) -> &'static str {
    match e {
        Event::Loaded => "policy image read",
        Event::LoadFailed => "image is no policy, or does not fit the profile",
        Event::SelfTestPassed => "own vectors passed",
        Event::SelfTestFailed => "own vectors failed",
        Event::RunRequest => "MODE RUN",
        Event::StopRequest => "MODE STOP",
        Event::ResetRequest => "MODE RESET",
        Event::ObservationLost => "no good set for 3 T",
        Event::ObservationInvalid => "3 invalid sets in a row",
        Event::TickLost => "TICK lost, or 3 out of sequence",
        Event::HostLost => "host heartbeat lost",
        Event::CrcErrors => "too many wrong frames",
        Event::BusOff => "bus-off",
        Event::BusOffRepeated => "bus-off, fourth in a minute",
        Event::Estop => "ESTOP",
    }
}

fn transitions() -> String {
    let mut t = String::from("| from | event | to | on the way |\n| --- | --- | --- | --- |\n");
    for a in TRANSITIONS {
        let condition = if a.from == State::Safe && a.event == Event::RunRequest {
            " after 5 good sets in a row, bus up, no ESTOP latched"
        } else {
            ""
        };
        writeln!(t, "| {} | {}{condition} | {} | {} |", a.from.name(), event(a.event), a.to.name(), a.action).unwrap();
    }
    t
}

fn faults() -> String {
    let mut t = String::from("| number | fault | meaning |\n| --- | --- | --- |\n");
    for f in Fault::ALL {
        writeln!(t, "| {} | {} | {} |", f.code(), f.name(), f.meaning()).unwrap();
    }
    t
}

fn reasons() -> String {
    let mut t = String::from("| number | reason | meaning |\n| --- | --- | --- |\n");
    for r in Reason::ALL {
        writeln!(t, "| {} | {} | {} |", r.code(), r.name(), r.meaning()).unwrap();
    }
    t
}

fn refusals() -> String {
    let mut t = String::from("| number | name | meaning |\n| --- | --- | --- |\n");
    for r in Refusal::ALL {
        writeln!(t, "| {} | {} | {} |", r.code(), r.name(), r.meaning()).unwrap();
    }
    t
}

fn slots() -> String {
    let mut t = String::from("| number | state | boots by itself |\n| --- | --- | --- |\n");
    for s in SlotState::ALL {
        let boots = match s {
            SlotState::Flashed => "yes: a flashing tool wrote it",
            SlotState::Confirmed => "yes",
            _ => "no",
        };
        writeln!(t, "| {} | {} | {boots} |", s.code(), s.name()).unwrap();
    }
    t
}

#[test]
fn protocol_page() {
    check(
        "can-protocol.md",
        &[
            ("messages", messages()),
            ("payloads", payloads()),
            ("flags", flags()),
            ("pages", pages()),
            ("refusals", refusals()),
            ("slots", slots()),
        ],
    );
}

#[test]
fn safety_page() {
    check(
        "safety.md",
        &[("states", states()), ("transitions", transitions()), ("faults", faults()), ("reasons", reasons())],
    );
}
