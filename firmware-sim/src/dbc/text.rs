//! The text of a DBC file.

use std::fmt::Write as _;

use gadm_node::protocol::Role;
use gadm_node::service::Page;
use gadm_node::{Fault, Profile, State};

use super::signals::names;
use super::{Database, DbMessage, DbSignal, Mux, Number};

/// What `VFrameFormat` calls the formats; index 0 is a classic and 14 an FD frame with an 11-bit identifier.
const FRAME_FORMATS: [&str; 16] = [
    "StandardCAN",
    "ExtendedCAN",
    "reserved",
    "J1939PG",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "StandardCAN_FD",
    "ExtendedCAN_FD",
];
/// Participants.
const ROLES: [(Role, &str); 3] = [(Role::Host, "HOST"), (Role::Plant, "PLANT"), (Role::Node, "NODE")];

/// Writes a database.
pub(super) fn write(db: &Database) -> String {
    let mut out = String::new();
    // Writing to a String cannot fail.
    let _ = db_text(&mut out, db);
    out
}

fn db_text(out: &mut String, db: &Database) -> std::fmt::Result {
    writeln!(out, "VERSION \"GADM {:016x} {}\"\n", db.interface_hash, db.profile.name())?;
    writeln!(
        out,
        "NS_ :\n\tBO_TX_BU_\n\tCM_\n\tBA_DEF_\n\tBA_\n\tVAL_\n\tVAL_TABLE_\n\tBA_DEF_DEF_\n\tSIG_VALTYPE_\n"
    )?;
    writeln!(out, "BS_:\n\nBU_: HOST PLANT NODE\n")?;
    let table =
        |out: &mut String, name: &str, rows: &[(i64, String)]| writeln!(out, "VAL_TABLE_ {name}{};", values(rows));
    table(out, "NodeState", &names(State::ALL, State::code, State::name))?;
    table(out, "NodeFault", &names(Fault::ALL, Fault::code, Fault::name))?;
    table(out, "Page", &names(Page::ALL, Page::code, Page::name))?;
    writeln!(out)?;
    for message in &db.messages {
        let first = senders(message).first().copied().unwrap_or_default();
        writeln!(out, "BO_ {} {}: {} {first}", message.id, message.name, message.len)?;
        for signal in &message.signals {
            signal_line(out, message, signal)?;
        }
        writeln!(out)?;
    }
    for (message, senders) in db.messages.iter().map(|m| (m, senders(m))).filter(|(_, senders)| senders.len() > 1) {
        writeln!(out, "BO_TX_BU_ {} : {};\n", message.id, senders.join(","))?;
    }
    comments(out, db)?;
    attributes(out, db)?;
    for (message, signal) in signals(db).filter(|(_, s)| !s.values.is_empty()) {
        writeln!(out, "VAL_ {} {}{};", message.id, signal.name, values(&signal.values))?;
    }
    for (message, signal) in signals(db).filter(|(_, s)| s.number == Number::Float) {
        writeln!(out, "SIG_VALTYPE_ {} {} : 1;", message.id, signal.name)?;
    }
    Ok(())
}

fn signals(db: &Database) -> impl Iterator<Item = (&DbMessage, &DbSignal)> {
    db.messages.iter().flat_map(|m| m.signals.iter().map(move |s| (m, s)))
}

/// Names of the participants for which `wanted` holds, in the order of [`ROLES`].
fn participants(wanted: impl Fn(Role) -> bool) -> Vec<&'static str> {
    ROLES.iter().filter(|(role, _)| wanted(*role)).map(|(_, name)| *name).collect()
}

/// Who sends a message: everybody the emergency stop, one participant any other.
fn senders(message: &DbMessage) -> Vec<&'static str> {
    participants(|role| message.from == Role::Any || role == message.from)
}

fn receivers(message: &DbMessage) -> String {
    participants(|role| if message.to == Role::Any { role != message.from } else { role == message.to }).join(",")
}

fn signal_line(out: &mut String, message: &DbMessage, s: &DbSignal) -> std::fmt::Result {
    let mux = match s.mux {
        Mux::Always => String::new(),
        Mux::Selector => "M ".to_owned(),
        Mux::Page(page) => format!("m{page} "),
    };
    let sign = if s.number == Number::Unsigned { '+' } else { '-' };
    let (lo, hi) = s.limits.unwrap_or((0.0, 0.0)); // both zero: no limits
    writeln!(
        out,
        " SG_ {} {mux}: {}|{}@1{sign} ({},{}) [{lo}|{hi}] \"{}\" {}",
        s.name,
        s.start,
        s.bits,
        s.factor,
        s.offset,
        plain(&s.unit),
        receivers(message)
    )
}

fn comments(out: &mut String, db: &Database) -> std::fmt::Result {
    let plant = if db.environment.is_empty() { "a plant" } else { &db.environment };
    writeln!(
        out,
        "CM_ \"Made by gadm-sim dbc from a policy for {}: profile {}, node {}, interface {:016x}. \
         Every signal is little endian.\";",
        plain(plant),
        db.profile.name(),
        db.node,
        db.interface_hash
    )?;
    for message in &db.messages {
        writeln!(out, "CM_ BO_ {} \"{}\";", message.id, plain(&message.doc))?;
        for signal in message.signals.iter().filter(|s| !s.doc.is_empty()) {
            writeln!(out, "CM_ SG_ {} {} \"{}\";", message.id, signal.name, plain(&signal.doc))?;
        }
    }
    writeln!(out)
}

fn attributes(out: &mut String, db: &Database) -> std::fmt::Result {
    let formats = FRAME_FORMATS.map(|f| format!("\"{f}\"")).join(",");
    let definitions = [
        ("", "BusType", "STRING".to_owned(), "\"CAN\""),
        ("", "GadmInterfaceHash", "STRING".to_owned(), "\"\""),
        ("", "GadmProfile", "STRING".to_owned(), "\"\""),
        ("", "GadmEnvironment", "STRING".to_owned(), "\"\""),
        ("", "GadmNode", "INT 1 63".to_owned(), "1"),
        ("", "GadmControlPeriodUs", "INT 0 2147483647".to_owned(), "0"),
        ("BO_ ", "VFrameFormat", format!("ENUM {formats}"), "\"StandardCAN\""),
        ("BO_ ", "CANFD_BRS", "ENUM \"0\",\"1\"".to_owned(), "\"0\""),
        ("BO_ ", "GenMsgCycleTime", "INT 0 65535".to_owned(), "0"),
        ("BO_ ", "GadmCycleTimeUs", "INT 0 2147483647".to_owned(), "0"),
        ("SG_ ", "GadmName", "STRING".to_owned(), "\"\""),
        ("SG_ ", "GadmIndex", "INT 0 65535".to_owned(), "0"),
        ("SG_ ", "GadmSafeValue", "FLOAT -3.4e38 3.4e38".to_owned(), "0"),
    ];
    for (of, name, kind, _) in &definitions {
        writeln!(out, "BA_DEF_ {of}\"{name}\" {kind};")?;
    }
    for (_, name, _, default) in &definitions {
        writeln!(out, "BA_DEF_DEF_ \"{name}\" {default};")?;
    }
    let bus = if db.profile == Profile::FdF32 { "CAN FD" } else { "CAN" };
    writeln!(out, "BA_ \"BusType\" \"{bus}\";")?;
    writeln!(out, "BA_ \"GadmInterfaceHash\" \"{:016x}\";", db.interface_hash)?;
    writeln!(out, "BA_ \"GadmProfile\" \"{}\";", db.profile.name())?;
    writeln!(out, "BA_ \"GadmEnvironment\" \"{}\";", plain(&db.environment))?;
    writeln!(out, "BA_ \"GadmNode\" {};", db.node)?;
    writeln!(out, "BA_ \"GadmControlPeriodUs\" {};", db.control_period_us)?;
    for message in &db.messages {
        let id = message.id;
        writeln!(out, "BA_ \"VFrameFormat\" BO_ {id} {};", if message.fd { 14 } else { 0 })?;
        if message.fd {
            writeln!(out, "BA_ \"CANFD_BRS\" BO_ {id} 1;")?;
        }
        if let Some(us) = message.cycle_us {
            // Whole milliseconds are all that the usual attribute can say; at least one, since 0 means "no cycle".
            writeln!(out, "BA_ \"GenMsgCycleTime\" BO_ {id} {};", us.div_ceil(1000))?;
            writeln!(out, "BA_ \"GadmCycleTimeUs\" BO_ {id} {us};")?;
        }
        for signal in &message.signals {
            let Some(slot) = &signal.interface else { continue };
            writeln!(out, "BA_ \"GadmName\" SG_ {id} {} \"{}\";", signal.name, plain(&slot.name))?;
            writeln!(out, "BA_ \"GadmIndex\" SG_ {id} {} {};", signal.name, slot.index)?;
            if let Some(safe) = slot.safe {
                writeln!(out, "BA_ \"GadmSafeValue\" SG_ {id} {} {safe};", signal.name)?;
            }
        }
    }
    writeln!(out)
}

/// ` 0 "A" 1 "B" `, as value tables are written.
fn values(rows: &[(i64, String)]) -> String {
    let mut text = String::new();
    for (number, name) in rows {
        let _ = write!(text, " {number} \"{}\"", plain(name));
    }
    text.push(' ');
    text
}

/// Text for between two quotation marks, in ASCII: readers of DBC files do not agree on an encoding.
fn plain(text: &str) -> String {
    let mut out = String::new();
    for c in text.chars() {
        match c {
            '"' => out.push('\''),
            '\\' => out.push('/'),
            '·' | '×' => out.push('*'),
            '°' => out.push_str("deg"),
            '²' => out.push_str("^2"),
            '³' => out.push_str("^3"),
            'µ' | 'μ' => out.push('u'),
            '–' | '—' | '−' => out.push('-'),
            c if c.is_ascii_graphic() || c == ' ' => out.push(c),
            _ => out.push('?'),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::plain;

    #[test]
    fn text_is_ascii_without_quotation_marks() {
        assert_eq!(plain("N·m"), "N*m");
        assert_eq!(plain("°/s²"), "deg/s^2");
        assert_eq!(plain("a \"b\" \\ \n é"), "a 'b' / ? ?");
    }
}
