//! Results for continuous integration: JUnit XML, a suite for each fault, a case for each run.

use std::fmt::Write as _;

use super::{Campaign, Record};
use crate::report::svg::escape;

pub(super) fn xml(found: &Campaign) -> String {
    let count = |records: &[&Record]| {
        let errors = records.iter().filter(|r| r.error.is_some()).count();
        let failures = records.iter().filter(|r| r.error.is_none() && !r.passed).count();
        format!("tests=\"{}\" failures=\"{failures}\" errors=\"{errors}\"", records.len())
    };
    let all: Vec<&Record> = found.records.iter().collect();
    let mut suites: Vec<&str> = Vec::new();
    for r in &all {
        if !suites.contains(&r.fault.as_str()) {
            suites.push(&r.fault);
        }
    }
    let mut text = format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<testsuites name=\"{}\" {}>\n",
        escape(&found.name),
        count(&all)
    );
    for suite in suites {
        let records: Vec<&Record> = all.iter().copied().filter(|r| r.fault == suite).collect();
        // Writing to a String cannot fail.
        let _ = writeln!(text, "  <testsuite name=\"{}\" {}>", escape(suite), count(&records));
        for r in records {
            let (class, name) = (format!("{}.{}", found.name, r.fault), format!("{} seed {}", r.intensity, r.seed));
            let _ = write!(text, "    <testcase classname=\"{}\" name=\"{}\"", escape(&class), escape(&name));
            let body = match &r.error {
                Some(error) => format!("<error message=\"{}\"/>", escape(error)),
                None if !r.passed => format!("<failure message=\"{}\"/>", escape(&r.missed.join("; "))),
                None => String::new(),
            };
            let out = format!(
                "<system-out>injected {}, return {}, time to detect {:?}, time to safe {:?}</system-out>",
                r.injected, r.mean_return, r.time_to_detect, r.time_to_safe
            );
            let _ = writeln!(text, ">{body}{out}</testcase>");
        }
        text.push_str("  </testsuite>\n");
    }
    text.push_str("</testsuites>\n");
    text
}
