//! A table of a figure beside that of its returns: the same cells as Markdown, CSV and JSON.

use std::fmt::Write as _;

use serde::Serialize;
use serde_json::Value;

/// A table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Columns {
    /// Name in the names of files.
    pub id: &'static str,
    /// What it shows and how its numbers came about.
    pub about: String,
    /// Names of the columns with their units.
    pub names: Vec<String>,
    /// The rows, a cell for each column; null where there is no number.
    pub rows: Vec<Vec<Value>>,
}

impl Columns {
    /// For people.
    pub fn to_markdown(&self) -> String {
        let number = |column: usize| self.rows.iter().all(|row| !row[column].is_string());
        let rules: Vec<&str> = (0..self.names.len()).map(|i| if number(i) { "---:" } else { "---" }).collect();
        let mut text = format!("{}\n\n| {} |\n| {} |\n", self.about, self.names.join(" | "), rules.join(" | "));
        for row in &self.rows {
            let cells: Vec<String> = row.iter().map(shown).collect();
            // Writing into a `String` cannot fail.
            let _ = writeln!(text, "| {} |", cells.join(" | "));
        }
        text
    }

    /// For spreadsheets. Names and texts hold neither commas nor quotes.
    pub fn to_csv(&self) -> String {
        let mut text = self.names.join(",") + "\n";
        for row in &self.rows {
            let plain = |cell: &Value| match cell {
                Value::Null => String::new(),
                Value::String(text) => text.clone(),
                other => other.to_string(),
            };
            let cells: Vec<String> = row.iter().map(plain).collect();
            text.push_str(&(cells.join(",") + "\n"));
        }
        text
    }
}

/// Three digits behind the point at most.
fn shown(cell: &Value) -> String {
    match cell {
        Value::Null => "–".to_owned(),
        Value::String(text) => text.clone(),
        Value::Number(number) if number.is_f64() => {
            let text = format!("{:.3}", number.as_f64().unwrap_or(f64::NAN));
            let short = text.trim_end_matches('0').trim_end_matches('.');
            if short == "-0" { "0".to_owned() } else { short.replace('-', "−") }
        }
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_same_cells_in_three_forms() {
        let table = Columns {
            id: "x",
            about: "What it is.".to_owned(),
            names: ["algorithm", "steps", "share"].map(str::to_owned).to_vec(),
            rows: vec![vec![json!("TD3"), json!(100_000), json!(-0.25)], vec![json!("DQN"), json!(0), json!(f64::NAN)]],
        };
        let expected = "What it is.\n\n| algorithm | steps | share |\n| --- | ---: | ---: |\n| TD3 | 100000 | −0.25 |\n\
                        | DQN | 0 | – |\n";
        assert_eq!(table.to_markdown(), expected);
        assert_eq!(table.to_csv(), "algorithm,steps,share\nTD3,100000,-0.25\nDQN,0,\n");
        assert!(serde_json::to_string(&table).unwrap().contains("[\"DQN\",0,null]"));
    }
}
