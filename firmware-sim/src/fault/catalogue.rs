//! All faults with their parameters, as the documentation shows them.

use super::actuator::ActuatorFault;
use super::bus::BusFault;
use super::frame::FrameFault;
use super::node::NodeFault;
use super::plant::PlantFault;
use super::sensor::SensorFault;
use super::spec::Kind;

/// One kind of fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Row {
    /// Where it sits.
    pub layer: &'static str,
    /// Name in scenarios.
    pub kind: &'static str,
    /// The parameter that a campaign varies; empty where there is none.
    pub intensity: &'static str,
    /// What is counted.
    pub counts: &'static str,
    /// Its parameters in a scenario, as an example.
    pub example: &'static str,
    /// What it does.
    pub meaning: &'static str,
}

macro_rules! rows {
    ($($layer:literal $kind:literal $intensity:literal $counts:literal $example:literal $meaning:literal;)*) => {
        &[$(Row { layer: $layer, kind: $kind, intensity: $intensity, counts: $counts, example: $example,
                  meaning: $meaning }),*]
    };
}

/// Every kind, by layer.
pub const CATALOGUE: &[Row] = rows! {
    "frame" "drop" "p" "frames" "p = 0.05" "the frame is lost with probability p";
    "frame" "drop-every" "n" "frames" "n = 10" "every n-th frame is lost";
    "frame" "burst" "enter" "frames" "enter = 0.02, exit = 0.3, loss = 1.0"
        "losses in bursts (Gilbert-Elliott): enter and exit per frame, loss within";
    "frame" "delay" "ticks" "frames" "ticks = 1, p = 0.1" "the frame comes so many ticks late";
    "frame" "jitter" "ticks" "frames" "ticks = 2" "late by 0 to so many ticks";
    "frame" "duplicate" "p" "frames" "p = 0.1" "the frame comes twice";
    "frame" "reorder" "p" "frames" "p = 0.1, within = 3" "1 to `within` later frames overtake it";
    "frame" "corrupt" "p" "frames" "p = 0.02" "one bit of the payload is wrong";
    "frame" "corrupt-id" "p" "frames" "p = 0.02" "one bit of the identifier is wrong";
    "frame" "truncate" "p" "frames" "p = 0.02, bytes = 1" "the last bytes are missing";
    "frame" "replay" "p" "frames" "p = 0.1, age = 8" "a frame of `age` frames ago comes once more";
    "frame" "babble" "frames" "frames" "frames = 20, id = 1"
        "a participant floods the bus with so many frames a tick; less urgent frames wait while it is full";
    "frame" "inversion" "p" "frames" "p = 0.5" "TICK, MODE, ESTOP and parts of sets come last in their tick";
    "bus" "bus-off" "ticks" "times" "ticks = 5, every = 100" "the controller leaves the bus, recovery takes so many ticks";
    "bus" "error-passive" "p" "failed attempts" "p = 0.3, attempts = 8"
        "attempts to send fail; error counter, error-passive and bus-off as in ISO 11898-1";
    "bus" "disconnect" "ticks" "frames" "ticks = 10" "the cable of the target is cut for so many ticks";
    "bus" "bit-rate" "ticks" "frames" "ticks = 10" "the node runs at another bit rate for so many ticks";
    "bus" "overflow" "capacity" "frames" "capacity = 1" "of the frames of a tick, the first so many are received";
    "node" "reset" "ticks" "times" "ticks = 1, every = 200" "no power for so many ticks, then a boot";
    "node" "hang" "ticks" "ticks" "ticks = 4" "the program stands still";
    "node" "clock-drift" "ppm" "ticks" "ppm = 100.0" "the node runs on its own timer, which is off";
    "node" "slow-inference" "ticks" "decisions" "ticks = 1, p = 0.1" "the answer is so many ticks late";
    "sensor" "freeze" "" "ticks" "" "stays at its value at the start of the window";
    "sensor" "nan" "p" "ticks" "p = 1.0" "dead: reads as invalid";
    "sensor" "garbage" "p" "ticks" "p = 0.1" "any value of the range";
    "sensor" "offset" "amount" "ticks" "amount = 0.05" "a constant is added";
    "sensor" "drift" "rate" "ticks" "rate = 0.001" "a growing offset is added";
    "sensor" "noise" "sd" "ticks" "sd = 0.02" "Gaussian noise is added";
    "sensor" "delay" "ticks" "ticks" "ticks = 2" "reads what was so many ticks ago";
    "sensor" "intermittent" "enter" "ticks" "enter = 0.05, exit = 0.5" "dead by turns";
    "sensor" "saturate" "level" "ticks" "level = 0.5" "cut to the middle part of the range";
    "actuator" "stuck" "at" "ticks" "at = 0.0" "stays where it is, or at a place (-1 to 1)";
    "actuator" "lag" "ticks" "ticks" "ticks = 2.0" "follows as a low pass of first order";
    "actuator" "dead-zone" "width" "ticks" "width = 0.1" "commands near the middle have no effect";
    "actuator" "gain" "factor" "ticks" "factor = 0.7" "weaker than it should be";
    "plant" "mass" "factor" "ticks" "factor = 1.2" "all masses and inertias";
    "plant" "friction" "factor" "ticks" "factor = 0.5" "all contact friction";
    "plant" "gravity" "factor" "ticks" "factor = 1.1" "gravity";
    "plant" "push" "force" "ticks" "force = 50.0, ticks = 5, every = 100" "a force on the trunk, N, forward";
};

/// Layer and name of a kind.
fn names(kind: &Kind) -> (&'static str, &'static str) {
    match kind {
        Kind::Frame(f) => (
            "frame",
            match f {
                FrameFault::Drop { .. } => "drop",
                FrameFault::DropEvery { .. } => "drop-every",
                FrameFault::Burst { .. } => "burst",
                FrameFault::Delay { .. } => "delay",
                FrameFault::Jitter { .. } => "jitter",
                FrameFault::Duplicate { .. } => "duplicate",
                FrameFault::Reorder { .. } => "reorder",
                FrameFault::Corrupt { .. } => "corrupt",
                FrameFault::CorruptId { .. } => "corrupt-id",
                FrameFault::Truncate { .. } => "truncate",
                FrameFault::Replay { .. } => "replay",
                FrameFault::Babble { .. } => "babble",
                FrameFault::Inversion { .. } => "inversion",
            },
        ),
        Kind::Bus(f) => (
            "bus",
            match f {
                BusFault::BusOff { .. } => "bus-off",
                BusFault::ErrorPassive { .. } => "error-passive",
                BusFault::Disconnect { .. } => "disconnect",
                BusFault::BitRate { .. } => "bit-rate",
                BusFault::Overflow { .. } => "overflow",
            },
        ),
        Kind::Node(f) => (
            "node",
            match f {
                NodeFault::Reset { .. } => "reset",
                NodeFault::Hang { .. } => "hang",
                NodeFault::ClockDrift { .. } => "clock-drift",
                NodeFault::SlowInference { .. } => "slow-inference",
            },
        ),
        Kind::Sensor(f) => (
            "sensor",
            match f {
                SensorFault::Freeze { .. } => "freeze",
                SensorFault::Nan { .. } => "nan",
                SensorFault::Garbage { .. } => "garbage",
                SensorFault::Offset { .. } => "offset",
                SensorFault::Drift { .. } => "drift",
                SensorFault::Noise { .. } => "noise",
                SensorFault::Delay { .. } => "delay",
                SensorFault::Intermittent { .. } => "intermittent",
                SensorFault::Saturate { .. } => "saturate",
            },
        ),
        Kind::Actuator(f) => (
            "actuator",
            match f {
                ActuatorFault::Stuck { .. } => "stuck",
                ActuatorFault::Lag { .. } => "lag",
                ActuatorFault::DeadZone { .. } => "dead-zone",
                ActuatorFault::Gain { .. } => "gain",
            },
        ),
        Kind::Plant(f) => (
            "plant",
            match f {
                PlantFault::Mass { .. } => "mass",
                PlantFault::Friction { .. } => "friction",
                PlantFault::Gravity { .. } => "gravity",
                PlantFault::Push { .. } => "push",
            },
        ),
    }
}

/// The row of a kind.
#[must_use]
pub fn row(kind: &Kind) -> &'static Row {
    let (layer, name) = names(kind);
    CATALOGUE.iter().find(|r| r.layer == layer && r.kind == name).expect("every kind has a row, which a test checks")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fault::spec::parse;

    #[test]
    fn every_row_is_a_kind_that_reads_its_example() {
        for r in CATALOGUE {
            let text = format!("layer = '{}'\nkind = '{}'\n{}", r.layer, r.kind, r.example.replace(", ", "\n"));
            let fault = parse(text.parse().unwrap()).unwrap_or_else(|e| panic!("{text}: {e}"));
            assert_eq!(names(&fault.kind), (r.layer, r.kind));
            assert_eq!(fault.row(), r);
            assert!(r.intensity.is_empty() || r.example.split(", ").any(|p| p.starts_with(r.intensity)), "{text}");
        }
    }

    #[test]
    fn all_kinds_of_the_names_have_a_row() {
        // serde names the variants of each layer in its message about an unknown one.
        let mut known = 0;
        for layer in ["frame", "bus", "node", "sensor", "actuator", "plant"] {
            let error = parse(format!("layer = '{layer}'\nkind = '?'").parse().unwrap()).unwrap_err();
            let list = error.split("; did").next().unwrap();
            for name in list.split('`').skip(3).step_by(2) {
                assert!(CATALOGUE.iter().any(|r| r.layer == layer && r.kind == name), "{layer} {name} has no row");
                known += 1;
            }
        }
        assert_eq!(known, CATALOGUE.len());
    }
}
