//! One fault as a scenario names it: which, where, when.

use gadm_node::protocol::{Function, MESSAGES};
use serde::{Deserialize, Serialize, Serializer};
use toml::{Table, Value};

use super::actuator::ActuatorFault;
use super::bus::BusFault;
use super::catalogue::{Row, row};
use super::frame::FrameFault;
use super::node::NodeFault;
use super::plant::PlantFault;
use super::sensor::SensorFault;

/// Where a fault sits, and what it does.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "layer", rename_all = "kebab-case")]
pub enum Kind {
    /// Single frames.
    Frame(FrameFault),
    /// Controller and cable.
    Bus(BusFault),
    /// The node.
    Node(NodeFault),
    /// Sensors of the plant.
    Sensor(SensorFault),
    /// Actuators of the plant.
    Actuator(ActuatorFault),
    /// The plant's body.
    Plant(PlantFault),
}

/// Who suffers a fault of the frames or the bus.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Participant {
    /// The controller: what comes to it.
    #[default]
    Node,
    /// The plant: what comes to it from the node.
    Plant,
    /// The host: what comes to it from the node.
    Host,
}

/// When a fault acts, in ticks of the episode: from `from` on and before `to`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Window {
    /// First tick.
    pub from: u64,
    /// First tick after; `None` = to the end of the episode.
    pub to: Option<u64>,
}

impl Window {
    /// Whole episodes.
    pub const ALWAYS: Self = Self { from: 0, to: None };

    /// True at `tick` of the episode.
    #[must_use]
    pub fn contains(self, tick: u64) -> bool {
        tick >= self.from && self.to.is_none_or(|to| tick < to)
    }
}

/// One fault.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fault {
    /// Name in reports.
    pub name: String,
    /// What it does.
    #[serde(flatten)]
    pub kind: Kind,
    /// Who suffers it.
    pub target: Participant,
    /// Only frames of these functions; empty = all that come to the target.
    #[serde(serialize_with = "function_names")]
    pub only: Vec<Function>,
    /// Names of the signals concerned (sensors) or of the actions (actuators); empty = all.
    pub signals: Vec<String>,
    /// When it acts.
    pub window: Window,
}

fn function_names<S: Serializer>(functions: &[Function], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(functions.iter().map(|f| function_name(*f)))
}

fn function_name(function: Function) -> &'static str {
    MESSAGES.iter().find(|m| m.function == function).map_or("?", |m| m.name)
}

impl Fault {
    /// A fault of that kind for the node, in whole episodes, named by layer and kind.
    #[must_use]
    pub fn new(kind: Kind) -> Self {
        let row = row(&kind);
        Self {
            name: format!("{} {}", row.layer, row.kind),
            kind,
            target: Participant::Node,
            only: Vec::new(),
            signals: Vec::new(),
            window: Window::ALWAYS,
        }
    }

    /// Its row of the catalogue.
    #[must_use]
    pub fn row(&self) -> &'static Row {
        row(&self.kind)
    }
}

/// Collects what is wrong with the numbers of a fault.
#[derive(Debug, Default)]
pub(super) struct Check {
    wrong: Option<String>,
}

impl Check {
    pub(super) fn range(&mut self, name: &str, value: f64, lo: f64, hi: f64) {
        if !(lo..=hi).contains(&value) {
            self.wrong.get_or_insert(format!("`{name}`: expected a number from {lo} to {hi}, found {value}"));
        }
    }

    pub(super) fn probability(&mut self, name: &str, value: f64) {
        self.range(name, value, 0.0, 1.0);
    }

    pub(super) fn count(&mut self, name: &str, value: u32, lo: u32, hi: u32) {
        if !(lo..=hi).contains(&value) {
            self.wrong.get_or_insert(format!("`{name}`: expected a whole number from {lo} to {hi}, found {value}"));
        }
    }
}

/// Default of probabilities.
pub(super) fn one() -> f64 {
    1.0
}

/// The keys of a fault that do not belong to its kind.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Common {
    name: Option<String>,
    layer: String,
    #[serde(default)]
    target: Participant,
    #[serde(default)]
    only: Vec<String>,
    #[serde(default)]
    signals: Vec<String>,
    #[serde(default)]
    window: Vec<u64>,
}

const COMMON: [&str; 6] = ["name", "layer", "target", "only", "signals", "window"];
const LAYERS: [&str; 6] = ["frame", "bus", "node", "sensor", "actuator", "plant"];

/// Reads one `[[faults]]` table.
///
/// # Errors
/// What is wrong, with the key, what was expected and found, and the nearest known name.
pub fn parse(mut table: Table) -> Result<Fault, String> {
    let mut common = Table::new();
    for key in COMMON {
        if let Some(value) = table.remove(key) {
            common.insert(key.to_owned(), value);
        }
    }
    let common: Common = common.try_into().map_err(|e: toml::de::Error| explain(e.message()))?;
    let kind = match common.layer.as_str() {
        "frame" => Kind::Frame(of(table)?),
        "bus" => Kind::Bus(of(table)?),
        "node" => Kind::Node(of(table)?),
        "sensor" => Kind::Sensor(of(table)?),
        "actuator" => Kind::Actuator(of(table)?),
        "plant" => Kind::Plant(of(table)?),
        other => return Err(format!("unknown layer `{other}`{}", hint(other, &LAYERS))),
    };
    let mut check = Check::default();
    match &kind {
        Kind::Frame(f) => f.check(&mut check),
        Kind::Bus(f) => f.check(&mut check),
        Kind::Node(f) => f.check(&mut check),
        Kind::Sensor(f) => f.check(&mut check),
        Kind::Actuator(f) => f.check(&mut check),
        Kind::Plant(f) => f.check(&mut check),
    }
    if let Some(wrong) = check.wrong {
        return Err(wrong);
    }
    let window = match common.window[..] {
        [] => Window::ALWAYS,
        [from] => Window { from, to: None },
        [from, to] if from < to => Window { from, to: Some(to) },
        _ => return Err(format!("`window`: expected [from, to] with from < to, found {:?}", common.window)),
    };
    let mut only = Vec::new();
    for name in &common.only {
        let names: Vec<&str> = MESSAGES.iter().map(|m| m.name).collect();
        let known = MESSAGES.iter().find(|m| m.name == name);
        only.push(known.ok_or_else(|| format!("`only`: unknown message `{name}`{}", hint(name, &names)))?.function);
    }
    let framed = matches!(kind, Kind::Frame(_));
    let anyone = framed || matches!(kind, Kind::Bus(BusFault::Disconnect { .. }));
    if common.target != Participant::Node && !anyone {
        return Err("`target`: only faults of frames and `disconnect` have a target other than `node`".into());
    }
    if !only.is_empty() && !framed {
        return Err("`only`: for faults of frames only".into());
    }
    if !common.signals.is_empty() && !matches!(kind, Kind::Sensor(_) | Kind::Actuator(_)) {
        return Err("`signals`: for faults of sensors and actuators only".into());
    }
    let mut fault = Fault { target: common.target, only, signals: common.signals, window, ..Fault::new(kind) };
    if let Some(name) = common.name {
        fault.name = name;
    }
    Ok(fault)
}

fn of<T: for<'de> Deserialize<'de>>(table: Table) -> Result<T, String> {
    Value::Table(table).try_into().map_err(|e: toml::de::Error| explain(e.message()))
}

/// Adds the nearest known name to serde's message about an unknown one.
#[must_use]
pub fn explain(message: &str) -> String {
    let unknown = message.starts_with("unknown field") || message.starts_with("unknown variant");
    let mut names = message.split('`').skip(1).step_by(2);
    match names.next() {
        Some(found) if unknown => {
            let known: Vec<&str> = names.collect();
            match nearest(found, &known) {
                Some(name) => format!("{message}; did you mean `{name}`?"),
                None => message.to_owned(),
            }
        }
        _ => message.to_owned(),
    }
}

/// `; did you mean …?` where a known name is near, else all of them.
fn hint(found: &str, known: &[&str]) -> String {
    nearest(found, known)
        .map_or_else(|| format!("; known: {}", known.join(", ")), |name| format!("; did you mean `{name}`?"))
}

fn nearest<'a>(found: &str, known: &[&'a str]) -> Option<&'a str> {
    known
        .iter()
        .map(|k| (strsim::damerau_levenshtein(&found.to_lowercase(), &k.to_lowercase()), *k))
        .min()
        .filter(|(distance, k)| *distance <= 2.max(k.len() / 3))
        .map(|(_, k)| k)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fault(text: &str) -> Result<Fault, String> {
        parse(text.parse().unwrap())
    }

    #[test]
    fn a_fault_with_everything() {
        let f = fault("layer = 'frame'\nkind = 'drop'\np = 0.5\ntarget = 'plant'\nonly = ['ACT']\nwindow = [3, 9]");
        let f = f.unwrap();
        assert_eq!(f.kind, Kind::Frame(FrameFault::Drop { p: 0.5 }));
        assert_eq!((f.name.as_str(), f.target), ("frame drop", Participant::Plant));
        assert_eq!(f.only, [Function::Action]);
        assert_eq!([2, 3, 8, 9].map(|t| f.window.contains(t)), [false, true, true, false]);
    }

    #[test]
    fn mistakes_are_named_with_the_nearest_name() {
        for (text, expected) in [
            ("layer = 'fram'", "unknown layer `fram`; did you mean `frame`?"),
            ("layer = 'frame'\nkind = 'dorp'\np = 1", "did you mean `drop`?"),
            ("layer = 'frame'\nkind = 'burst'\nentr = 1.0\nexit = 1.0", "did you mean `enter`?"),
            ("layer = 'frame'\nkind = 'drop'", "missing field `p`"),
            ("layer = 'frame'\nkind = 'drop'\np = 1.5", "`p`: expected a number from 0 to 1, found 1.5"),
            ("layer = 'frame'\nkind = 'delay'\nticks = 0", "whole number from 1"),
            ("layer = 'frame'\nkind = 'drop'\np = 1\nonly = ['OBSS']", "did you mean `OBS`?"),
            ("layer = 'frame'\nkind = 'drop'\np = 1\nwindow = [4, 4]", "from < to"),
            ("layer = 'frame'\nkind = 'drop'\np = 1\ntarget = 'nod'", "did you mean `node`?"),
            ("layer = 'node'\nkind = 'hang'\nticks = 2\ntarget = 'plant'", "other than `node`"),
            ("layer = 'node'\nkind = 'hang'\nticks = 2\nonly = ['OBS']", "frames only"),
            ("layer = 'node'\nkind = 'hang'\nticks = 2\nsignals = ['x']", "sensors and actuators"),
        ] {
            let error = fault(text).unwrap_err();
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
