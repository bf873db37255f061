//! Tests of [`super`]: every kind of layer, every error with its place.

use super::*;
use serde::Deserialize;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Config {
    seed: u32,
    env: String,
    mask_threshold: Option<f64>,
    hidden: Vec<usize>,
    optimiser: Optimiser,
    algo: Algo,
    probe: Option<Probe>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Optimiser {
    learning_rate: f64,
    clip: bool,
    fusion: Fusion,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Fusion {
    Mul,
    LatentToState,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
enum Algo {
    Dqn(Dqn),
    Search(Search),
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Dqn {
    gamma: f64,
    heads: usize,
    polyak: Option<f64>,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Search {
    simulations: usize,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Probe {
    period: u32,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            seed: 0,
            env: "moving".into(),
            mask_threshold: None,
            hidden: vec![64, 64],
            optimiser: Optimiser::default(),
            algo: Algo::Dqn(Dqn::default()),
            probe: None,
        }
    }
}

impl Default for Optimiser {
    fn default() -> Self {
        Self { learning_rate: 3e-4, clip: true, fusion: Fusion::Mul }
    }
}

impl Default for Dqn {
    fn default() -> Self {
        Self { gamma: 0.99, heads: 1, polyak: None }
    }
}

fn file(text: &str) -> Layer {
    Layer::Toml { origin: "pendulum.toml".into(), text: text.into() }
}

fn set(text: &str) -> Layer {
    Layer::Set(text.into())
}

fn ok(layers: &[Layer]) -> Config {
    resolve(layers).unwrap_or_else(|error| panic!("{error}"))
}

fn error_of(layers: &[Layer]) -> String {
    resolve::<Config>(layers).unwrap_err().to_string()
}

#[test]
fn no_layer_gives_the_defaults() {
    assert_eq!(ok(&[]), Config::default());
}

#[test]
fn later_layers_win_and_touch_nothing_else() {
    let config = ok(&[
        file("seed = 1\nhidden = [32]\n[optimiser]\nlearning_rate = 1e-3\n"),
        file("seed = 2\n"),
        set("optimiser.clip=false"),
    ]);
    let optimiser = Optimiser { learning_rate: 1e-3, clip: false, fusion: Fusion::Mul };
    assert_eq!(config, Config { seed: 2, hidden: vec![32], optimiser, ..Config::default() });
}

#[test]
fn assignments_take_toml_values_and_bare_words() {
    let config = ok(&[
        set("env = Hopper-v5"),
        set("hidden=[8, 8, 8]"),
        set("optimiser.fusion=latent_to_state"),
        set("optimiser.learning_rate=1"),
        set("mask_threshold=0.125"),
    ]);
    assert_eq!(config.env, "Hopper-v5");
    assert_eq!(config.hidden, [8, 8, 8]);
    assert_eq!((config.optimiser.fusion, config.optimiser.learning_rate), (Fusion::LatentToState, 1.0));
    assert_eq!(config.mask_threshold, Some(0.125));
}

#[test]
fn numbers_in_every_notation_of_toml() {
    assert_eq!(ok(&[file("seed = 0x1_F\nhidden = [1_000, 0b11]")]).seed, 31);
    assert_eq!(ok(&[file("[optimiser]\nlearning_rate = 1_0.5e-1")]).optimiser.learning_rate, 1.05);
}

#[test]
fn an_unknown_key_is_named_with_place_suggestion_and_the_known_ones() {
    assert_eq!(
        error_of(&[file("seed = 1\n\n[optimiser]\nclip = true\nlearning_rte = 1e-3\n")]),
        "pendulum.toml:5: unknown key `optimiser.learning_rte`; did you mean `learning_rate`? \
         (known keys of [optimiser]: learning_rate, clip, fusion)"
    );
}

#[test]
fn an_unknown_key_of_the_top_level_lists_optional_keys_too() {
    let text = error_of(&[set("mask_treshold=0.1")]);
    assert!(text.starts_with("--set mask_treshold=0.1: unknown key `mask_treshold`"), "{text}");
    assert!(text.contains("did you mean `mask_threshold`?") && text.contains("probe"), "{text}");
}

#[test]
fn a_key_in_the_wrong_table_is_pointed_to_the_right_one() {
    let text = error_of(&[file("gamma = 0.9")]);
    assert!(text.contains("did you mean `algo.gamma`?"), "{text}");
}

#[test]
fn a_key_like_no_other_gets_no_suggestion() {
    let text = error_of(&[file("xyzzy = 1")]);
    assert!(text.contains("unknown key `xyzzy`") && !text.contains("did you mean"), "{text}");
    assert!(text.contains("known keys of the top level: seed, env"), "{text}");
}

#[test]
fn wrong_types_are_named_with_expected_and_found() {
    assert_eq!(error_of(&[file("\nseed = 1.5")]), "pendulum.toml:2: `seed` must be an integer, found the float 1.5");
    assert_eq!(
        error_of(&[set("optimiser.clip=yes")]),
        "--set optimiser.clip=yes: `optimiser.clip` must be true or false, found the string \"yes\""
    );
    assert_eq!(error_of(&[file("optimiser = 3")]), "pendulum.toml:1: `optimiser` must be a table, found the integer 3");
    assert_eq!(error_of(&[file("[seed]\na = 1")]), "pendulum.toml:1: `seed` must be an integer, found a table");
}

#[test]
fn values_out_of_range_and_wrong_elements_are_attributed_to_their_key() {
    let text = error_of(&[file("env = \"moving\"\nseed = -1")]);
    assert!(text.starts_with("pendulum.toml:2: `seed` is not valid: ") && text.contains("-1"), "{text}");
    let text = error_of(&[file("hidden = [8, \"x\"]")]);
    assert!(text.starts_with("pendulum.toml:1: `hidden` is not valid: ") && text.contains("\"x\""), "{text}");
    let text = error_of(&[file("mask_threshold = \"low\"")]);
    assert!(text.starts_with("pendulum.toml:1: `mask_threshold` is not valid: "), "{text}");
    let text = error_of(&[file("seed = 99999999999999999999")]);
    assert!(text.contains("`seed`") && text.contains("99999999999999999999"), "{text}");
}

#[test]
fn an_unknown_variant_is_named_with_suggestion() {
    let text = error_of(&[set("optimiser.fusion=mull")]);
    assert!(text.contains("unknown variant `mull`") && text.contains("did you mean `mul`?"), "{text}");
    let text = error_of(&[set("algo.kind=serch")]);
    assert!(text.contains("`algo.kind`") && text.contains("did you mean `search`?"), "{text}");
    let text = error_of(&[set("algo.kind=3")]);
    assert!(text.contains("`algo.kind` must be a string, found the integer 3"), "{text}");
}

#[test]
fn an_enum_with_data_changes_its_known_keys_with_its_kind() {
    let config = ok(&[file("[algo]\nsimulations = 20\nkind = \"search\"")]);
    assert_eq!(config.algo, Algo::Search(Search { simulations: 20 }));
    let text = error_of(&[file("[algo]\nkind = \"search\"\nheads = 4")]);
    assert!(
        text.contains("unknown key `algo.heads`") && text.contains("known keys of [algo]: kind, simulations"),
        "{text}"
    );
}

#[test]
fn naming_the_present_kind_keeps_what_was_set() {
    let config = ok(&[file("[algo]\nheads = 4\npolyak = 0.005"), set("algo.kind=dqn")]);
    assert_eq!(config.algo, Algo::Dqn(Dqn { heads: 4, polyak: Some(0.005), ..Dqn::default() }));
}

#[test]
fn an_optional_table_starts_from_its_own_defaults_and_is_checked_inside() {
    assert_eq!(ok(&[set("probe.period=5")]).probe, Some(Probe { period: 5 }));
    let text = error_of(&[file("[probe]\nperiod = 5\nperiods = 6")]);
    assert!(text.starts_with("pendulum.toml:3: unknown key `probe.periods`; did you mean `period`?"), "{text}");
}

#[test]
fn a_struct_that_accepts_unknown_fields_is_still_checked() {
    #[derive(Debug, Default, Serialize, Deserialize)]
    #[serde(default)]
    struct Lax {
        seed: u32,
        note: Option<String>,
    }
    assert!(matches!(resolve::<Lax>(&[set("sed=1")]), Err(ConfigError::UnknownKey { .. })));
    assert!(matches!(resolve::<Lax>(&[set("note=x")]), Err(ConfigError::UnknownKey { .. })));
    let lax: Lax = resolve_with_optional(&[set("note=x")], &["note"]).unwrap();
    assert_eq!(lax.note.as_deref(), Some("x"));
}

#[test]
fn defaults_that_do_not_read_back_are_not_blamed_on_a_setting() {
    #[derive(Debug, Default, Serialize, Deserialize)]
    struct Broken {
        seed: u32,
        #[serde(skip_serializing)]
        hidden: u32,
    }
    let error = resolve::<Broken>(&[set("seed=1")]).unwrap_err();
    assert!(matches!(error, ConfigError::Defaults(_)), "{error}");
    assert_eq!(Broken::default().hidden, 0);
}

#[test]
fn bad_syntax_is_said_with_its_place() {
    let text = error_of(&[file("seed = 1\nenv = \n")]);
    assert!(text.starts_with("pendulum.toml: not valid TOML") && text.contains("line 2"), "{text}");
    for assignment in ["seed", "=3", "a b=3", "seed=1\nenv=2"] {
        assert!(matches!(resolve::<Config>(&[set(assignment)]), Err(ConfigError::Assignment { .. })), "{assignment}");
    }
}

#[test]
fn the_written_form_resolves_to_the_same_configuration() {
    let config = ok(&[set("algo.kind=search"), set("probe.period=3"), set("mask_threshold=0.1")]);
    let text = to_toml(&config).unwrap();
    assert_eq!(ok(&[file(&text)]), config);
    assert_eq!(to_toml(&ok(&[file(&text)])).unwrap(), text);
}

#[test]
fn the_hash_is_of_the_sorted_toml() {
    #[derive(Serialize)]
    struct Forward {
        a: u8,
        b: f64,
    }
    #[derive(Serialize)]
    struct Backward {
        b: f64,
        a: u8,
    }
    let hash = config_hash(&Forward { a: 1, b: 0.5 }).unwrap();
    // `printf 'a = 1\nb = 0.5\n' | sha256sum`
    assert_eq!(hash, "5e7fff65f08d7d45");
    assert_eq!(config_hash(&Backward { a: 1, b: 0.5 }).unwrap(), hash);
    assert_ne!(config_hash(&Forward { a: 2, b: 0.5 }).unwrap(), hash);
}
