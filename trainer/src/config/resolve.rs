//! Resolves a configuration from layers: defaults, files, `--set` assignments, later ones over earlier ones.
//!
//! The known keys are those of the serialised defaults plus, for structs with `deny_unknown_fields`, the optional ones
//! that serde itself names (an `Option` that is `None` does not appear in TOML). A table may be an enum with data, tagged
//! with [`TAG`]: naming another variant replaces the table by that variant's own defaults, which must therefore exist
//! (`#[serde(default)]` on the variant's struct). Maps with free keys are not supported.
//!
//! Settings are applied and checked one by one, so that a refusal names its line; relations between settings are to be
//! checked on the resolved configuration.

use serde::Serialize;
use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};
use std::fmt::Write as _;
use std::ops::Range;
use toml::de::{DeTable, DeValue};
use toml::{Spanned, Table, Value};

/// The key that names the variant of an enum with data.
pub const TAG: &str = "kind";

/// The key that names the algorithm of a configuration: choosing another one drops the tables that it does not have.
pub const ALGORITHM: &str = "algo";

/// A key that no configuration has; serde's refusal of it lists the keys it knows.
const PROBE: &str = "__no_such_key__";

/// One source of settings.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Layer {
    /// A TOML text and where it is from, such as the file's name.
    Toml {
        /// Shown in errors.
        origin: String,
        /// The document.
        text: String,
    },
    /// An assignment `a.b=c` of the command line. The value is TOML; what is not valid TOML is taken as a string.
    Set(String),
}

/// Where a setting was written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// File name, or the assignment.
    pub origin: String,
    /// Line from 1; `None` for an assignment.
    pub line: Option<usize>,
}

impl std::fmt::Display for Place {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.origin)?;
        self.line.map_or(Ok(()), |line| write!(f, ":{line}"))
    }
}

/// A configuration could not be resolved or written.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// A layer is not TOML.
    #[error("{origin}: not valid TOML: {message}")]
    Syntax {
        /// The layer.
        origin: String,
        /// The parser's message with line and column.
        message: String,
    },
    /// An assignment has no `=`, no key, or more than one key.
    #[error("`--set {text}`: expected `key=value` such as `--set seed=3` ({reason})")]
    Assignment {
        /// The assignment.
        text: String,
        /// What is wrong.
        reason: String,
    },
    /// A key that the configuration does not have.
    #[error(
        "{place}: unknown key `{key}`{} (known keys of {}: {})",
        did_you_mean(suggestion.as_ref()),
        table_name(key),
        list(known)
    )]
    UnknownKey {
        /// Dotted path of the key.
        key: String,
        /// Where it was written.
        place: Place,
        /// The nearest known key: its name in the same table, or its dotted path in another one.
        suggestion: Option<String>,
        /// All keys of the table that it was written in.
        known: Vec<String>,
    },
    /// A value of the wrong type.
    #[error("{place}: `{key}` must be {expected}, found {found}")]
    TypeMismatch {
        /// Dotted path of the key.
        key: String,
        /// Where it was written.
        place: Place,
        /// The type of the default.
        expected: &'static str,
        /// The type and value found.
        found: String,
    },
    /// A value of the right type that the configuration refuses, such as an unknown name of a variant.
    #[error("{place}: `{key}` is not valid: {message}{}", did_you_mean(suggestion.as_ref()))]
    InvalidValue {
        /// Dotted path of the key.
        key: String,
        /// Where it was written.
        place: Place,
        /// Why it was refused.
        message: String,
        /// The nearest accepted value.
        suggestion: Option<String>,
    },
    /// The defaults, once written as TOML, are not a configuration: an error of the program.
    #[error("the default configuration cannot be read back: {0}")]
    Defaults(String),
    /// The configuration cannot be expressed in TOML, such as an integer beyond 63 bits.
    #[error("the configuration cannot be written as TOML: {0}")]
    Serialise(#[from] toml::ser::Error),
}

fn did_you_mean(suggestion: Option<&String>) -> String {
    suggestion.map_or(String::new(), |name| format!("; did you mean `{name}`?"))
}

fn table_name(key: &str) -> String {
    key.rsplit_once('.').map_or("the top level".to_owned(), |(table, _)| format!("[{table}]"))
}

fn list(names: &[String]) -> String {
    names.join(", ")
}

/// Applies `layers` over `T::default()`.
///
/// # Errors
/// The first problem found, in the order of the layers: see [`ConfigError`].
///
/// # Examples
/// ```
/// use gadm_trainer::config::resolve::{Layer, resolve};
/// #[derive(serde::Serialize, serde::Deserialize)]
/// #[serde(default, deny_unknown_fields)]
/// struct Config { learning_rate: f64, seed: u32 }
/// impl Default for Config {
///     fn default() -> Self { Self { learning_rate: 3e-4, seed: 0 } }
/// }
/// let config: Config = resolve(&[Layer::Set("seed=7".into())])?;
/// assert_eq!((config.seed, config.learning_rate), (7, 3e-4));
/// let error = resolve::<Config>(&[Layer::Set("learning_rte=1e-3".into())]).err().expect("a typing error");
/// assert!(error.to_string().contains("did you mean `learning_rate`?"));
/// # Ok::<(), gadm_trainer::config::resolve::ConfigError>(())
/// ```
pub fn resolve<T: Serialize + DeserializeOwned + Default>(layers: &[Layer]) -> Result<T, ConfigError> {
    resolve_with_optional(layers, &[])
}

/// [`resolve`] with the dotted paths of optional keys that serde cannot name, because their struct lacks
/// `deny_unknown_fields`.
///
/// # Errors
/// As [`resolve`].
pub fn resolve_with_optional<T: Serialize + DeserializeOwned + Default>(
    layers: &[Layer],
    optional_keys: &[&str],
) -> Result<T, ConfigError> {
    let mut resolver =
        Resolver { tree: Table::try_from(T::default())?, optional_keys, check: check::<T>, normalise: normalise::<T> };
    // A later refusal would be blamed on the setting that is being applied.
    (resolver.check)(&resolver.tree).map_err(ConfigError::Defaults)?;
    for layer in layers {
        match layer {
            Layer::Toml { origin, text } => {
                let document = DeTable::parse(text).map_err(|error| ConfigError::Syntax {
                    origin: origin.clone(),
                    message: error.to_string().trim_end().to_owned(),
                })?;
                resolver.merge(document.get_ref(), &mut Vec::new(), &Source { origin, text: Some(text) })?;
            }
            Layer::Set(assignment) => {
                let text = assignment_document(assignment)?;
                let document = DeTable::parse(&text).map_err(|error| ConfigError::Assignment {
                    text: assignment.clone(),
                    reason: error.message().to_owned(),
                })?;
                let origin = format!("--set {assignment}");
                resolver.merge(document.get_ref(), &mut Vec::new(), &Source { origin: &origin, text: None })?;
            }
        }
    }
    T::deserialize(resolver.tree).map_err(|error| ConfigError::Defaults(message_of(&error)))
}

/// The configuration as a TOML document that [`resolve`] reads back.
///
/// # Errors
/// [`ConfigError::Serialise`].
pub fn to_toml<T: Serialize>(config: &T) -> Result<String, ConfigError> {
    Ok(toml::to_string_pretty(config)?)
}

/// The first 16 hexadecimal digits of the SHA-256 of the canonical TOML, whose keys are sorted, so that reordering the
/// fields of a struct changes no hash.
///
/// # Errors
/// [`ConfigError::Serialise`].
pub fn config_hash<T: Serialize>(config: &T) -> Result<String, ConfigError> {
    let canonical = toml::to_string(&sorted(Value::try_from(config)?))?;
    let mut digits = String::with_capacity(16);
    for byte in &Sha256::digest(canonical.as_bytes())[..8] {
        // Writing into a `String` cannot fail.
        let _ = write!(digits, "{byte:02x}");
    }
    Ok(digits)
}

fn sorted(value: Value) -> Value {
    match value {
        Value::Table(table) => {
            let mut entries: Vec<(String, Value)> =
                table.into_iter().map(|(key, value)| (key, sorted(value))).collect();
            entries.sort_by(|(a, _), (b, _)| a.cmp(b));
            Value::Table(entries.into_iter().collect())
        }
        Value::Array(array) => Value::Array(array.into_iter().map(sorted).collect()),
        other => other,
    }
}

/// An assignment as a TOML document of one line.
fn assignment_document(assignment: &str) -> Result<String, ConfigError> {
    let refused = |reason: &str| ConfigError::Assignment { text: assignment.to_owned(), reason: reason.to_owned() };
    let (key, value) = assignment.split_once('=').ok_or_else(|| refused("there is no `=`"))?;
    let (key, value) = (key.trim(), value.trim());
    if key.is_empty() {
        return Err(refused("there is no key before `=`"));
    }
    if assignment.contains('\n') {
        return Err(refused("it has more than one line"));
    }
    let document = format!("{key} = {value}");
    if DeTable::parse(&document).is_ok() {
        return Ok(document);
    }
    Ok(format!("{key} = {}", Value::String(value.to_owned())))
}

/// A layer as errors need it; `text` for line numbers.
struct Source<'a> {
    origin: &'a str,
    text: Option<&'a str>,
}

impl Source<'_> {
    fn place(&self, span: &Range<usize>) -> Place {
        let line = self.text.map(|text| 1 + text.bytes().take(span.start).filter(|&byte| byte == b'\n').count());
        Place { origin: self.origin.to_owned(), line }
    }
}

/// The configuration under construction. `tree` is always valid: `check(tree)` is `Ok`.
struct Resolver<'a> {
    tree: Table,
    optional_keys: &'a [&'a str],
    /// Whether a tree is a configuration, else why not.
    check: fn(&Table) -> Result<(), String>,
    /// A tree with everything that it leaves out filled in from the defaults.
    normalise: fn(&Table) -> Option<Table>,
}

/// Whether `tree` is a `T`, else serde's sentence about why not.
fn check<T: DeserializeOwned>(tree: &Table) -> Result<(), String> {
    T::deserialize(tree.clone()).map(drop).map_err(|error| message_of(&error))
}

/// `tree` read as a `T` and written again.
fn normalise<T: Serialize + DeserializeOwned>(tree: &Table) -> Option<Table> {
    Table::try_from(T::deserialize(tree.clone()).ok()?).ok()
}

impl Resolver<'_> {
    /// Applies one table of a layer at `path`.
    fn merge(&mut self, layer: &DeTable<'_>, path: &mut Vec<String>, source: &Source<'_>) -> Result<(), ConfigError> {
        // The variant first: it decides which other keys there are.
        let chooses = |key: &str| key == TAG || path.is_empty() && key == ALGORITHM;
        let (tag, others): (Vec<_>, Vec<_>) = layer.iter().partition(|(key, _)| chooses(key.get_ref()));
        for (key, value) in tag.into_iter().chain(others) {
            path.push(key.get_ref().to_string());
            self.merge_entry(key.span(), value, path, source)?;
            path.pop();
        }
        Ok(())
    }

    fn merge_entry(
        &mut self,
        key_span: Range<usize>,
        value: &Spanned<DeValue<'_>>,
        path: &mut Vec<String>,
        source: &Source<'_>,
    ) -> Result<(), ConfigError> {
        let place = source.place(&key_span);
        let default = at(&self.tree, path).cloned();
        if default.is_none() && !self.is_optional(path) {
            return Err(self.unknown_key(path, place));
        }
        if path.last().is_some_and(|key| key == TAG) {
            return self.choose_variant(&owned(value.get_ref()), path, place);
        }
        if let DeValue::Table(table) = value.get_ref() {
            let is_table = match &default {
                Some(default) => default.is_table(),
                None => self.replace_by_defaults(path, Table::new()),
            };
            if is_table {
                return self.merge(table, path, source);
            }
        }
        let value = owned(value.get_ref());
        if path.len() == 1 && path[0] == ALGORITHM {
            self.drop_tables_of_other_algorithms(&value);
        }
        let value = match &default {
            Some(default) => coerce(value, default).map_err(|found| ConfigError::TypeMismatch {
                key: path.join("."),
                place: place.clone(),
                expected: type_name(default),
                found,
            })?,
            None => value,
        };
        self.assign(path, value, place)
    }

    /// Prepares the tree for the algorithm `name`: what that does not accept goes, and its own tables come with their defaults.
    /// No change where the algorithm is the present one, or not known.
    fn drop_tables_of_other_algorithms(&mut self, name: &Value) {
        if self.tree.get(ALGORITHM) == Some(name) {
            return;
        }
        let mut tree: Table = [(ALGORITHM.to_owned(), name.clone())].into_iter().collect();
        if (self.check)(&tree).is_err() {
            return;
        }
        for (key, value) in &self.tree {
            let alone = [(ALGORITHM, name), (key.as_str(), value)].map(|(k, v)| (k.to_owned(), v.clone()));
            if key != ALGORITHM && (self.check)(&alone.into_iter().collect()).is_ok() {
                tree.insert(key.clone(), value.clone());
            }
        }
        if let Some(tree) = (self.normalise)(&tree) {
            self.tree = tree;
        }
    }

    /// Writes a value and attributes a refusal to it.
    fn assign(&mut self, path: &[String], value: Value, place: Place) -> Result<(), ConfigError> {
        let before = self.tree.clone();
        insert(&mut self.tree, path, value);
        match (self.check)(&self.tree) {
            Ok(()) => Ok(()),
            Err(message) => {
                self.tree = before;
                Err(invalid_value(path.join("."), place, message))
            }
        }
    }

    /// Sets the tag at `path`; another variant than the present one starts from its own defaults.
    fn choose_variant(&mut self, tag: &Value, path: &[String], place: Place) -> Result<(), ConfigError> {
        let Some(name) = tag.as_str() else {
            let (key, found) = (path.join("."), describe(tag));
            return Err(ConfigError::TypeMismatch { key, place, expected: "a string", found });
        };
        if at(&self.tree, path).and_then(Value::as_str) == Some(name) {
            return Ok(());
        }
        let table = &path[..path.len() - 1];
        let variant: Table = [(TAG.to_owned(), tag.clone())].into_iter().collect();
        if table.is_empty() || !self.replace_by_defaults(table, variant.clone()) {
            // The whole configuration as an enum, or a variant that has no defaults: let serde say what is wrong.
            let mut tree = self.tree.clone();
            if table.is_empty() {
                tree = variant;
            } else {
                insert(&mut tree, table, Value::Table(variant));
            }
            match ((self.check)(&tree), (self.normalise)(&tree)) {
                (Ok(()), Some(tree)) => self.tree = tree,
                (Err(message), _) => return Err(invalid_value(path.join("."), place, message)),
                (Ok(()), None) => {
                    let message = "this variant cannot be written as TOML".to_owned();
                    return Err(invalid_value(path.join("."), place, message));
                }
            }
        }
        Ok(())
    }

    /// Puts `seed`, completed by serde's defaults, at `path`; `false`, and no change, if that is no configuration.
    fn replace_by_defaults(&mut self, path: &[String], seed: Table) -> bool {
        let mut tree = self.tree.clone();
        insert(&mut tree, path, Value::Table(seed));
        match (self.normalise)(&tree) {
            Some(tree) if at(&tree, path).is_some() => {
                self.tree = tree;
                true
            }
            _ => false,
        }
    }

    /// Whether `path` is a key that the defaults leave out: declared, or named by serde.
    fn is_optional(&self, path: &[String]) -> bool {
        self.optional_keys.contains(&path.join(".").as_str())
            || path.split_last().is_some_and(|(key, table)| self.fields_known_to_serde(table).contains(key))
    }

    /// The fields that serde lists when it refuses [`PROBE`] in `table`; none if it does not refuse it.
    fn fields_known_to_serde(&self, table: &[String]) -> Vec<String> {
        let mut tree = self.tree.clone();
        let mut path = table.to_vec();
        path.push(PROBE.to_owned());
        insert(&mut tree, &path, Value::Boolean(true));
        match (self.check)(&tree) {
            Err(message) if message.starts_with(&format!("unknown field `{PROBE}`")) => {
                quoted(&message).skip(1).collect()
            }
            _ => Vec::new(),
        }
    }

    fn unknown_key(&self, path: &[String], place: Place) -> ConfigError {
        let key = path.last().map_or("", String::as_str);
        let table = &path[..path.len() - 1];
        let mut known: Vec<String> = match at(&self.tree, table) {
            Some(Value::Table(entries)) => entries.keys().cloned().collect(),
            _ if table.is_empty() => self.tree.keys().cloned().collect(),
            _ => Vec::new(),
        };
        let prefix = table.iter().fold(String::new(), |prefix, part| prefix + part + ".");
        let declared =
            self.optional_keys.iter().filter_map(|key| key.strip_prefix(&prefix).filter(|key| !key.contains('.')));
        for extra in self.fields_known_to_serde(table).into_iter().chain(declared.map(str::to_owned)) {
            if !known.contains(&extra) {
                known.push(extra);
            }
        }
        let suggestion = elsewhere(&self.tree, key).or_else(|| nearest(key, &known));
        ConfigError::UnknownKey { key: path.join("."), place, suggestion, known }
    }
}

fn invalid_value(key: String, place: Place, message: String) -> ConfigError {
    let names: Vec<String> = quoted(&message).collect();
    let suggestion = match names.split_first() {
        Some((found, accepted)) if message.starts_with("unknown variant") => nearest(found, accepted),
        Some((found, accepted)) if message.starts_with("unknown field") => nearest(found, accepted),
        _ => None,
    };
    ConfigError::InvalidValue { key, place, message, suggestion }
}

/// serde's sentence without the location that `toml` adds on further lines.
fn message_of(error: &toml::de::Error) -> String {
    error.message().trim().to_owned()
}

/// The names in back quotes, in order: serde writes refused and accepted names so.
fn quoted(message: &str) -> impl Iterator<Item = String> + '_ {
    message.split('`').skip(1).step_by(2).map(str::to_owned)
}

/// The candidate most like `name`, if one is like it at all.
fn nearest(name: &str, candidates: &[String]) -> Option<String> {
    let (similarity, candidate) = candidates
        .iter()
        .map(|candidate| (strsim::damerau_levenshtein(name, candidate), candidate))
        .map(|(edits, candidate)| (1.0 - edits as f64 / name.len().max(candidate.len()).max(1) as f64, candidate))
        .max_by(|(a, _), (b, _)| a.total_cmp(b))?;
    (similarity >= 0.5).then(|| candidate.clone())
}

/// The dotted path of a key named `name` in whichever table has one.
fn elsewhere(tree: &Table, name: &str) -> Option<String> {
    tree.iter().find_map(|(key, value)| {
        let table = value.as_table()?;
        if table.contains_key(name) && name != TAG {
            return Some(format!("{key}.{name}"));
        }
        elsewhere(table, name).map(|path| format!("{key}.{path}"))
    })
}

fn at<'t>(tree: &'t Table, path: &[String]) -> Option<&'t Value> {
    let (first, rest) = path.split_first()?;
    rest.iter().try_fold(tree.get(first)?, |value, key| value.as_table()?.get(key))
}

/// Writes `value` at `path`, making tables on the way.
fn insert(tree: &mut Table, path: &[String], value: Value) {
    match path {
        [] => {}
        [key] => drop(tree.insert(key.clone(), value)),
        [key, rest @ ..] => {
            let entry = tree.entry(key.clone()).or_insert_with(|| Value::Table(Table::new()));
            if !entry.is_table() {
                *entry = Value::Table(Table::new());
            }
            if let Value::Table(table) = entry {
                insert(table, rest, value);
            }
        }
    }
}

/// `value` in the type of `default`; whole numbers become floats where a float is expected. `Err` describes `value`.
fn coerce(value: Value, default: &Value) -> Result<Value, String> {
    match (&value, default) {
        (Value::Integer(integer), Value::Float(_)) => Ok(Value::Float(*integer as f64)),
        _ if value.same_type(default) => Ok(value),
        _ => Err(describe(&value)),
    }
}

fn type_name(value: &Value) -> &'static str {
    match value {
        Value::String(_) => "a string",
        Value::Integer(_) => "an integer",
        Value::Float(_) => "a number",
        Value::Boolean(_) => "true or false",
        Value::Datetime(_) => "a date or time",
        Value::Array(_) => "an array",
        Value::Table(_) => "a table",
    }
}

fn describe(value: &Value) -> String {
    match value {
        Value::Table(_) => "a table".to_owned(),
        Value::Boolean(boolean) => format!("the boolean {boolean}"),
        Value::Float(_) => format!("the float {value}"),
        Value::Integer(_) => format!("the integer {value}"),
        Value::String(_) => format!("the string {value}"),
        _ => format!("{} {value}", type_name(value)),
    }
}

/// A parsed value without its spans.
fn owned(value: &DeValue<'_>) -> Value {
    match value {
        DeValue::String(text) => Value::String(text.to_string()),
        // The parser has checked the digits; a number too large is kept as text, so that its type is refused.
        DeValue::Integer(integer) => i64::from_str_radix(integer.as_str(), integer.radix())
            .map_or_else(|_| Value::String(integer.to_string()), Value::Integer),
        DeValue::Float(float) => float.as_str().parse().map_or_else(|_| Value::String(float.to_string()), Value::Float),
        DeValue::Boolean(boolean) => Value::Boolean(*boolean),
        DeValue::Datetime(datetime) => Value::Datetime(*datetime),
        DeValue::Array(array) => Value::Array(array.iter().map(|item| owned(item.get_ref())).collect()),
        DeValue::Table(table) => {
            Value::Table(table.iter().map(|(key, value)| (key.get_ref().to_string(), owned(value.get_ref()))).collect())
        }
    }
}

#[cfg(test)]
#[path = "resolve_tests.rs"]
mod tests;
