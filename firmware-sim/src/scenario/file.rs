//! The text of a scenario.

use std::path::Path;

use serde::Deserialize;
use toml::{Spanned, Table, Value};

use super::{Criteria, Entry, Scenario};
use crate::fault::{self, Fault};
use crate::{BitRate, Profile, SimError};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    /// Name in reports [default: the name of the file].
    name: Option<String>,
    /// What it is about.
    #[serde(default)]
    description: String,
    /// Policy file, relative to the scenario.
    policy: String,
    /// Registry id of the plant [default: what the policy was trained for].
    plant: Option<String>,
    /// Episodes, at least 1.
    #[serde(default = "episodes")]
    episodes: Spanned<u64>,
    /// Seed of the run.
    #[serde(default)]
    seed: u64,
    /// `fd-f32` or `classic-i16`.
    #[serde(default = "profile")]
    profile: Spanned<String>,
    /// Bit rate of classic frames and of the arbitration of FD frames, bit/s, 10,000 to 1,000,000.
    #[serde(default = "bitrate")]
    bitrate: Spanned<u32>,
    /// Bit rate of the data of FD frames, bit/s, 10,000 to 8,000,000.
    #[serde(default = "data_bitrate")]
    data_bitrate: Spanned<u32>,
    /// What goes wrong.
    #[serde(default)]
    faults: Vec<Spanned<Table>>,
    /// What must hold.
    #[serde(default)]
    criteria: Criteria,
    /// How often a campaign runs each.
    #[serde(default)]
    campaign: Campaign,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Campaign {
    /// Seeds per fault and intensity, at least 1.
    seeds: u64,
}

impl Default for Campaign {
    fn default() -> Self {
        Self { seeds: 3 }
    }
}

fn episodes() -> Spanned<u64> {
    Spanned::new(0..0, 5)
}

fn profile() -> Spanned<String> {
    Spanned::new(0..0, Profile::FdF32.name().to_owned())
}

fn bitrate() -> Spanned<u32> {
    Spanned::new(0..0, BitRate::default().nominal)
}

fn data_bitrate() -> Spanned<u32> {
    Spanned::new(0..0, BitRate::default().data)
}

pub(super) fn parse(text: &str, path: &Path) -> Result<Scenario, SimError> {
    let wrong = |at: Option<usize>, what: String| {
        let line = at.map(|at| text.get(..at).unwrap_or(text).lines().count().max(1));
        SimError::Scenario { path: path.to_owned(), line, what }
    };
    let file: File =
        toml::from_str(text).map_err(|e| wrong(e.span().map(|s| s.start + 1), fault::explain(e.message())))?;
    let start = |span: std::ops::Range<usize>| Some(span.start + 1);
    let Some(profile) = Profile::ALL.into_iter().find(|p| p.name() == file.profile.get_ref()) else {
        let known = Profile::ALL.map(Profile::name).join("` or `");
        let what = format!("`profile`: expected `{known}`, found `{}`", file.profile.get_ref());
        return Err(wrong(start(file.profile.span()), what));
    };
    for (name, value, hi) in [("bitrate", &file.bitrate, 1_000_000), ("data_bitrate", &file.data_bitrate, 8_000_000)] {
        if !(10_000..=hi).contains(value.get_ref()) {
            let what = format!("`{name}`: expected 10000 to {hi} bit/s, found {}", value.get_ref());
            return Err(wrong(start(value.span()), what));
        }
    }
    if *file.episodes.get_ref() == 0 || file.campaign.seeds == 0 {
        return Err(wrong(start(file.episodes.span()), "`episodes` and `campaign.seeds`: expected at least 1".into()));
    }
    let mut faults = Vec::new();
    for (i, table) in file.faults.into_iter().enumerate() {
        let span = table.span();
        let name = format!("faults[{i}]");
        let entry = entry(table.into_inner(), &file.criteria)
            .map_err(|what| wrong(start(span), format!("`{name}`: {what}")))?;
        if faults.iter().any(|e: &Entry| e.fault.name == entry.fault.name) {
            let what = format!("`{name}`: a second fault named `{}`; give it a `name`", entry.fault.name);
            return Err(wrong(None, what));
        }
        faults.push(entry);
    }
    let stem = path.file_stem().map_or_else(|| "scenario".into(), |s| s.to_string_lossy().into_owned());
    let folder = path.parent().unwrap_or(Path::new(""));
    Ok(Scenario {
        path: path.to_owned(),
        name: file.name.unwrap_or(stem),
        description: file.description,
        policy: folder.join(file.policy),
        plant: file.plant,
        episodes: file.episodes.into_inner(),
        seed: file.seed,
        profile,
        bit_rate: BitRate { nominal: file.bitrate.into_inner(), data: file.data_bitrate.into_inner() },
        faults,
        criteria: file.criteria,
        seeds: file.campaign.seeds,
    })
}

fn entry(mut table: Table, base: &Criteria) -> Result<Entry, String> {
    let values = match table.remove("sweep") {
        None => Vec::new(),
        Some(Value::Array(values)) if !values.is_empty() => values,
        Some(other) => return Err(format!("`sweep`: expected a list of values, found {other}")),
    };
    let criteria = match table.remove("criteria") {
        None => *base,
        Some(own) => {
            let own: Criteria = own.try_into().map_err(|e: toml::de::Error| fault::explain(e.message()))?;
            own.or(base)
        }
    };
    let fault = fault::parse(table.clone())?;
    let intensity = fault.row().intensity;
    let mut sweep: Vec<(String, Fault)> = Vec::new();
    for value in values {
        if intensity.is_empty() {
            return Err(format!("`sweep`: `{}` has nothing to vary", fault.row().kind));
        }
        let mut with = table.clone();
        let label = value.to_string();
        with.insert(intensity.to_owned(), value);
        let varied = fault::parse(with).map_err(|what| format!("`sweep`: {what}"))?;
        if sweep.iter().any(|(known, _)| *known == label) {
            return Err(format!("`sweep`: {label} twice"));
        }
        sweep.push((label, varied));
    }
    if sweep.is_empty() {
        let label = table.get(intensity).map_or_else(|| "–".to_owned(), ToString::to_string);
        sweep.push((label, fault.clone()));
    }
    Ok(Entry { fault, sweep, criteria })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fault::Kind;
    use crate::fault::frame::FrameFault;

    fn scenario(text: &str) -> Result<Scenario, String> {
        parse(text, Path::new("some/where/hop.toml")).map_err(|e| e.to_string())
    }

    const WHOLE: &str = r#"
policy = "../policy.bin"
episodes = 2
profile = "classic-i16"
bitrate = 1000000

[[faults]]
layer = "frame"
kind = "drop"
p = 0.1
sweep = [0.1, 0.5]
criteria = { min_return = 3.0 }

[[faults]]
layer = "sensor"
kind = "freeze"

[criteria]
min_return = 10.0
max_action_age = 3

[campaign]
seeds = 7
"#;

    #[test]
    fn a_whole_scenario() {
        let s = scenario(WHOLE).unwrap();
        assert_eq!((s.name.as_str(), s.episodes, s.seeds, s.profile), ("hop", 2, 7, Profile::ClassicI16));
        assert_eq!(s.policy, Path::new("some/where/../policy.bin"));
        assert_eq!(s.bit_rate, BitRate { nominal: 1_000_000, data: 2_000_000 });
        let [a, b] = &s.faults[..] else { panic!("two faults") };
        assert_eq!((a.criteria.min_return, a.criteria.max_action_age), (Some(3.0), Some(3)));
        assert_eq!((b.criteria.min_return, b.sweep.len(), b.sweep[0].0.as_str()), (Some(10.0), 1, "–"));
        assert_eq!(a.sweep[1].0, "0.5");
        assert_eq!(a.sweep[1].1.kind, Kind::Frame(FrameFault::Drop { p: 0.5 }));
        assert_eq!(s.run_options().faults.len(), 2);
        assert!(!s.needs_nominal());
    }

    #[test]
    fn mistakes_name_file_line_and_the_nearest_name() {
        for (text, expected) in [
            ("polcy = 'p'", "some/where/hop.toml:1: unknown field `polcy`"),
            ("policy = 'p'\nepisods = 2", "hop.toml:2: "),
            ("policy = 'p'\nepisods = 2", "did you mean `episodes`?"),
            ("policy = 'p'\n[criteria]\nmin_retrun = 1.0", "did you mean `min_return`?"),
            ("policy = 'p'\nprofile = 'fd'", "hop.toml:2: `profile`: expected `fd-f32` or `classic-i16`, found `fd`"),
            ("policy = 'p'\nbitrate = 5", "`bitrate`: expected 10000 to 1000000 bit/s, found 5"),
            ("policy = 'p'\nepisodes = 0", "at least 1"),
            ("policy = 'p'\n\n[[faults]]\nlayer = 'frame'\nkind = 'drop'\nq = 1.0", "hop.toml:3: `faults[0]`: "),
            ("policy = 'p'\n[[faults]]\nlayer = 'sensor'\nkind = 'freeze'\nsweep = [1]", "has nothing to vary"),
            ("policy = 'p'\n[[faults]]\nlayer = 'node'\nkind = 'hang'\nticks = 1\nsweep = [0]", "`sweep`: `ticks`"),
            ("policy = 'p'\n[[faults]]\nlayer = 'node'\nkind = 'hang'\nticks = 1\nsweep = []", "a list of values"),
            (
                "policy = 'p'\nfaults = [{layer = 'sensor', kind = 'freeze'}, {layer = 'sensor', kind = 'freeze'}]",
                "give it a `name`",
            ),
            ("policy = 'p'\nplant = ", "hop.toml:2: "),
            ("episodes = 2", "missing field `policy`"),
        ] {
            let error = scenario(text).unwrap_err();
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
