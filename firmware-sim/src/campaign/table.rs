//! Results for programs: CSV and JSON.

use serde_json::json;

use super::{Campaign, Record};

/// Columns of the CSV file.
const COLUMNS: &str = "fault,layer,kind,intensity,seed,passed,injected,episodes,hit,detected,time_to_detect,made_safe,\
time_to_safe,worst_action_error,max_action_age,out_of_bounds,safe_periods,mean_return,return_ratio,missed,error";

/// One line a run, as RFC 4180 has it.
pub(super) fn csv(records: &[Record]) -> String {
    let mut text = format!("{COLUMNS}\n");
    let optional = |v: Option<u64>| v.map_or_else(String::new, |v| v.to_string());
    for r in records {
        let cells = [
            quoted(&r.fault),
            r.layer.clone(),
            r.kind.clone(),
            quoted(&r.intensity),
            r.seed.to_string(),
            r.passed.to_string(),
            r.injected.to_string(),
            r.episodes.to_string(),
            r.hit.to_string(),
            r.detected.to_string(),
            optional(r.time_to_detect),
            r.made_safe.to_string(),
            optional(r.time_to_safe),
            r.worst_action_error.to_string(),
            r.max_action_age.to_string(),
            r.out_of_bounds.to_string(),
            r.safe_periods.to_string(),
            r.mean_return.to_string(),
            r.return_ratio.map_or_else(String::new, |v| v.to_string()),
            quoted(&r.missed.join("; ")),
            quoted(r.error.as_deref().unwrap_or("")),
        ];
        text.push_str(&cells.join(","));
        text.push('\n');
    }
    text
}

fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.to_owned() }
}

/// Everything.
pub(super) fn json(found: &Campaign) -> String {
    let value = json!({
        "version": 1,
        "name": found.name,
        "passed": found.passed(),
        "runs": found.records.len(),
        "missed": found.records.iter().filter(|r| !r.passed).count(),
        "tallies": found.tallies,
        "records": found.records,
    });
    format!("{value:#}\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_quoted_where_they_must_be() {
        assert_eq!(quoted("a b"), "a b");
        assert_eq!(quoted("a,\"b\""), "\"a,\"\"b\"\"\"");
        assert_eq!(csv(&[]).trim_end().split(',').count(), 21);
    }
}
