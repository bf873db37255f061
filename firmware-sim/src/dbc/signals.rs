//! Payload fields as DBC signals.

use std::collections::BTreeSet;

use gadm_node::codec::{INVALID_I16, Layout, Profile};
use gadm_node::protocol::{Field, FieldKind, Function, NO_LATENT};
use gadm_node::reason::Reason;
use gadm_node::service::{
    ModeCommand, OP_ACTIVATE, OP_BARRIER, OP_BEGIN, OP_BLOCK, OP_COMMIT, OP_CONFIRM, OP_END, OP_LENGTH, OP_READ,
    OP_REFUSED, OP_START, Page,
};
use gadm_node::slots::SlotState;
use gadm_node::{Fault, Flags, State};
use gadm_runtime::{ActionHead, Policy};

use super::{DbSignal, Mux, NAME_LIMIT, Number, Slot};

/// Names that frames use for other things than observations and actions.
const TAKEN: [&str; 12] =
    ["seq", "part", "first", "last", "invalid", "latent", "crc", "safe", "fallback", "clipped", "held", "late"];
/// Names of the bits of `flags` in an FD observation.
const OBSERVATION_FLAGS: [&str; 3] = ["first", "last", "invalid"];
/// Bits of a latent number.
const LATENT_BITS: usize = NO_LATENT.trailing_ones() as usize;

/// The signals of the interface by the names they have in the database.
pub(super) struct Names {
    observations: Vec<String>,
    actions: Vec<String>,
}

impl Names {
    /// A C identifier for every signal, unique among all.
    pub(super) fn new(policy: &Policy) -> Self {
        let mut taken: BTreeSet<String> = TAKEN.iter().map(|&n| n.to_owned()).collect();
        let mut name = |text: &str| {
            let unique = unique_name(text, &taken);
            taken.insert(unique.clone());
            unique
        };
        Self {
            observations: policy.observation_signals().map(|s| name(s.name)).collect(),
            actions: policy.action_signals().map(|s| name(s.name)).collect(),
        }
    }
}

/// `text` as a C identifier of at most [`NAME_LIMIT`] characters that is not in `taken`.
fn unique_name(text: &str, taken: &BTreeSet<String>) -> String {
    let mut plain: String = text.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
    if plain.starts_with(|c: char| c.is_ascii_digit()) || plain.is_empty() {
        plain.insert(0, '_');
    }
    plain.truncate(NAME_LIMIT);
    let free = |name: &String| !taken.contains(name);
    if free(&plain) {
        return plain;
    }
    (2..=u32::MAX)
        .map(|n| {
            let end = format!("_{n}");
            let room = NAME_LIMIT - end.len();
            format!("{}{end}", plain.get(..room).unwrap_or(&plain))
        })
        .find(free)
        .unwrap_or(plain)
}

fn integer(name: impl Into<String>, start: usize, bits: usize) -> DbSignal {
    let top = (1_u64 << bits) - 1;
    DbSignal {
        name: name.into(),
        start,
        bits,
        number: Number::Unsigned,
        factor: 1.0,
        offset: 0.0,
        limits: Some((0.0, top as f64)),
        unit: String::new(),
        mux: Mux::Always,
        values: Vec::new(),
        doc: String::new(),
        interface: None,
    }
}

/// The signals of one frame, and its length in bytes.
pub(super) fn of(
    function: Function,
    fields: &[Field],
    part: usize,
    layout: &Layout,
    policy: &Policy,
    names: &Names,
) -> (Vec<DbSignal>, usize) {
    let in_set = matches!(function, Function::Observation | Function::Action);
    let total = if function == Function::Observation { layout.obs_dim() } else { layout.action_dim() };
    let dim = total.saturating_sub(part * layout.profile().values()).min(layout.profile().values());
    let len = if in_set { layout.payload_len(dim) } else { fields.iter().map(|f| f.kind.bytes()).sum() };
    let mut signals = Vec::new();
    let mut at = 0;
    for field in fields {
        match field.kind {
            FieldKind::I16(_) | FieldKind::F32(_) => {
                signals.extend((0..dim).map(|i| {
                    let index = part * layout.profile().values() + i;
                    let start = at + i * 8 * field.kind.bytes() / field.kind.count();
                    value(function, index, start, layout.profile(), policy, names)
                }));
            }
            FieldKind::Crc8 | FieldKind::Crc32 => {
                let bits = 8 * field.kind.bytes();
                let doc = format!("{} over identifier, interface hash and the bytes before", field.doc);
                signals.push(DbSignal { doc, ..integer(field.name, 8 * len - bits, bits) });
            }
            FieldKind::Bytes(n) => {
                signals.extend((0..usize::from(n)).map(|i| integer(format!("{}_{i}", field.name), at + 8 * i, 8)));
            }
            FieldKind::U8 | FieldKind::U16 | FieldKind::U32 => {
                signals.extend(plain(function, field, at));
            }
        }
        at += 8 * field.kind.bytes();
    }
    (signals, len)
}

/// An integer field, cut into the signals it is made of.
fn plain(function: Function, field: &Field, at: usize) -> Vec<DbSignal> {
    let bits = 8 * field.kind.bytes();
    // As the decoder names it: with the unit, where a time has one.
    let name = if field.unit == "us" { format!("{}_us", field.name) } else { field.name.to_owned() };
    let unit = if field.unit.starts_with("of the") { "" } else { field.unit };
    let whole = DbSignal { unit: unit.to_owned(), doc: field.doc.to_owned(), ..integer(name, at, bits) };
    let flags = |at: usize| -> Vec<DbSignal> {
        Flags::NAMES.iter().enumerate().map(|(i, &name)| integer(name, at + i, 1)).collect()
    };
    let latent = |bits| DbSignal {
        values: vec![(i64::from(NO_LATENT), "none".to_owned())],
        limits: Some((0.0, f64::from(NO_LATENT))),
        doc: "latent number that the policy chose".to_owned(),
        ..integer("latent", at, bits)
    };
    match (function, field.name) {
        (Function::Action, "latent") => [vec![latent(LATENT_BITS)], flags(at + LATENT_BITS)].concat(),
        (Function::Decision, "latent") => vec![latent(bits)],
        (Function::Decision, "flags") => flags(at),
        (Function::Observation, "flags") => {
            OBSERVATION_FLAGS.iter().enumerate().map(|(i, &name)| integer(name, at + i, 1)).collect()
        }
        (Function::Mode, "command") => {
            vec![DbSignal { values: names(ModeCommand::ALL, ModeCommand::code, ModeCommand::name), ..whole }]
        }
        (Function::Heartbeat, "state") => {
            vec![DbSignal { values: names(State::ALL, State::code, State::name), ..whole }]
        }
        (Function::Heartbeat, "fault") => {
            vec![DbSignal { values: names(Fault::ALL, Fault::code, Fault::name), ..whole }]
        }
        (Function::Heartbeat, "page") => vec![DbSignal { values: page_names(), mux: Mux::Selector, ..whole }],
        (Function::Heartbeat, "value") => Page::ALL.iter().flat_map(|&page| page_signals(page, at)).collect(),
        // Of a refused operation, REPLY has the reason there.
        (Function::Request, "page") => vec![DbSignal { values: page_names(), ..whole }],
        (Function::Request, "op") => vec![DbSignal { values: operations(), ..whole }],
        (Function::Reply, "op") => {
            let refused = (i64::from(OP_REFUSED), "refused".to_owned());
            vec![DbSignal { values: [operations(), vec![refused]].concat(), ..whole }]
        }
        _ => vec![whole],
    }
}

/// Operations of REQUEST.
fn operations() -> Vec<(i64, String)> {
    let known = [
        (OP_READ, "read"),
        (OP_LENGTH, "length"),
        (OP_BEGIN, "begin"),
        (OP_BLOCK, "block"),
        (OP_COMMIT, "commit"),
        (OP_END, "end"),
        (OP_ACTIVATE, "activate"),
        (OP_CONFIRM, "confirm"),
        (OP_START, "start"),
        (OP_BARRIER, "barrier"),
    ];
    known.map(|(code, name)| (i64::from(code), name.to_owned())).to_vec()
}

/// Numbers and names of an enumeration.
pub(super) fn names<T: Copy>(all: &[T], code: fn(T) -> u8, name: fn(T) -> &'static str) -> Vec<(i64, String)> {
    all.iter().map(|&value| (i64::from(code(value)), name(value).to_owned())).collect()
}

fn page_names() -> Vec<(i64, String)> {
    names(Page::ALL, Page::code, Page::name)
}

/// The four bytes of a heartbeat as the page says.
fn page_signals(page: Page, at: usize) -> Vec<DbSignal> {
    let mux = Mux::Page(page.code());
    let part = |name: &str, from, bits| DbSignal { mux, ..integer(name, at + from, bits) };
    let permille = |name, from| DbSignal { unit: "permille".to_owned(), ..part(name, from, 16) };
    let slot_states = || names(SlotState::ALL, SlotState::code, SlotState::name);
    match page {
        Page::Jitter => vec![
            DbSignal {
                doc: "largest deviation of the last 64 control periods".to_owned(),
                ..permille("jitter_permille", 0)
            },
            DbSignal {
                number: Number::Signed,
                limits: Some((-32768.0, 32767.0)),
                doc: "mean deviation of the last 64 control periods".to_owned(),
                ..permille("bias_permille", 16)
            },
        ],
        Page::PolicyError => vec![
            DbSignal {
                values: names(Reason::ALL, Reason::code, Reason::name),
                doc: "why an image was not run".to_owned(),
                ..part("reason", 0, 8)
            },
            DbSignal { doc: "slot of that image".to_owned(), ..part("reason_slot", 8, 8) },
        ],
        Page::Slots => vec![
            DbSignal { values: slot_states(), ..part("slot0_state", 0, 8) },
            DbSignal { values: slot_states(), ..part("slot1_state", 8, 8) },
            DbSignal { doc: "slot whose policy runs".to_owned(), ..part("running_slot", 16, 8) },
            DbSignal { doc: "1 where it runs on trial".to_owned(), ..part("on_trial", 24, 8) },
        ],
        Page::InferenceUs => vec![DbSignal { unit: "us".to_owned(), ..part(page.name(), 0, 32) }],
        _ => vec![part(page.name(), 0, 32)],
    }
}

/// One observation or action.
fn value(function: Function, index: usize, start: usize, profile: Profile, policy: &Policy, names: &Names) -> DbSignal {
    let (name, original, unit, head, safe) = if function == Function::Observation {
        let signal = policy.observation_signals().nth(index);
        let (original, unit, lo, hi) = signal.map_or(("", "", 0.0, 0.0), |s| (s.name, s.unit, s.lo, s.hi));
        (names.observations.get(index), original, unit, ActionHead::Continuous { lo, hi }, None)
    } else {
        let signal = policy.action_signals().nth(index);
        let (original, unit, head, safe) =
            signal.map_or(("", "", ActionHead::Binary, None), |s| (s.name, s.unit, s.head, Some(s.safe)));
        (names.actions.get(index), original, unit, head, safe)
    };
    let (limits, (factor, offset)) = match head {
        ActionHead::Continuous { lo, hi } => {
            // Source: gadm_node::codec, `Scale`: the middle and half of the range in single precision.
            let (mid, half) = (lo * 0.5 + hi * 0.5, hi * 0.5 - lo * 0.5);
            let limits = (lo.is_finite() && hi.is_finite() && lo < hi).then(|| (decimal(lo), decimal(hi)));
            (limits, (f64::from(half) / 32767.0, f64::from(mid)))
        }
        ActionHead::Discrete { n } => (Some((0.0, f64::from(n.saturating_sub(1)))), (1.0, 0.0)),
        ActionHead::Binary => (Some((0.0, 1.0)), (1.0, 0.0)),
    };
    let mut values = Vec::new();
    let (number, bits, factor, offset) = match profile {
        Profile::FdF32 => (Number::Float, 32, 1.0, 0.0),
        Profile::ClassicI16 => {
            values.push((i64::from(INVALID_I16), "invalid".to_owned()));
            (Number::Signed, 16, factor, offset)
        }
    };
    if profile == Profile::ClassicI16 && head == ActionHead::Binary {
        values.extend([(0, "off".to_owned()), (1, "on".to_owned())]);
    }
    let what = if function == Function::Observation { "observation" } else { "action" };
    DbSignal {
        name: name.cloned().unwrap_or_default(),
        start,
        bits,
        number,
        factor,
        offset,
        limits,
        unit: unit.to_owned(),
        mux: Mux::Always,
        values,
        doc: format!("{what} {index}: {original}"),
        interface: Some(Slot { name: original.to_owned(), index, safe }),
    }
}

/// The number that the shortest decimal of `value` reads as: 0.1, and not what single precision makes of it.
fn decimal(value: f32) -> f64 {
    value.to_string().parse().unwrap_or_else(|_| f64::from(value))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_identifiers_short_and_unique() {
        let mut taken: BTreeSet<String> = BTreeSet::new();
        let mut name = |text: &str| {
            let n = unique_name(text, &taken);
            taken.insert(n.clone());
            n
        };
        assert_eq!(name("velocity_x"), "velocity_x");
        assert_eq!(name("velocity x"), "velocity_x_2");
        assert_eq!(name("Drehmoment Ø"), "Drehmoment__");
        assert_eq!(name("4th"), "_4th");
        assert_eq!(name(""), "_");
        let long = "a".repeat(40);
        assert_eq!(name(&long), "a".repeat(32));
        assert_eq!(name(&long), format!("{}_2", "a".repeat(30)));
    }

    #[test]
    fn limits_are_the_decimals_that_people_wrote() {
        assert_eq!(decimal(0.1), 0.1);
        assert_eq!(decimal(-2.7), -2.7);
    }
}
