//! The shipped policies: each is the file of its card, loads, and gives the answers of its own test vectors.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::fs;
use std::path::PathBuf;

use gadm_integration_tests::{check_page, read, root};
use gadm_runtime::encode::AlignedImage;
use gadm_runtime::{Policy, Scratch};
use gadm_trainer::card::{Card, ReturnStats, verify};

/// Folders of `models`, by name.
fn models() -> Vec<(String, PathBuf)> {
    let entries = fs::read_dir(root().join("models")).expect("the folder models is there");
    let mut models: Vec<_> = entries
        .map(|entry| entry.expect("an entry of the folder can be read"))
        .filter(|entry| entry.path().is_dir())
        .map(|entry| (entry.file_name().into_string().expect("names are UTF-8"), entry.path()))
        .collect();
    models.sort();
    models
}

fn card(name: &str) -> Card {
    Card::from_toml(&read(format!("models/{name}/card.toml"))).unwrap_or_else(|error| panic!("{name}: {error}"))
}

#[test]
fn the_promised_models_are_there() {
    let there: BTreeSet<String> = models().into_iter().map(|(name, _)| name).collect();
    for name in [
        "half-cheetah-v5",
        "hard-move-10",
        "hopper-v5",
        "inverted-pendulum-v5",
        "lunar-lander-continuous",
        "moving",
        "sliding",
    ] {
        assert!(there.contains(name), "models/{name} is missing; there are {there:?}");
    }
}

#[test]
fn cards_belong_to_their_files() {
    for (name, folder) in models() {
        let card = card(&name);
        let file = fs::read(folder.join(&card.policy.file)).unwrap_or_else(|error| panic!("{name}: {error}"));
        verify(&card, &file).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert_eq!(
            read(format!("models/{name}/card.md")),
            card.to_markdown(),
            "{name}: card.md is not that of card.toml"
        );
        assert!(name.starts_with(&card.environment), "{name} is the folder of a policy for {}", card.environment);
        let parts: u64 = card.policy.parts.iter().map(|part| part.bytes).sum();
        assert_eq!(parts, card.policy.bytes, "{name}: the parts do not sum up to the file");
    }
}

#[test]
fn policies_pass_their_own_test() {
    for (name, folder) in models() {
        let card = card(&name);
        let bytes = fs::read(folder.join(&card.policy.file)).unwrap();
        let image = AlignedImage::new(&bytes);
        let policy = Policy::load(&image).unwrap_or_else(|error| panic!("{name}: {error}"));
        let mut memory = vec![0; policy.spec().scratch_words];
        policy.self_test(&mut Scratch::new(&mut memory)).unwrap_or_else(|error| panic!("{name}: {error}"));
        let provenance = policy.provenance();
        assert_eq!(provenance.environment, card.environment, "{name}");
        assert_eq!(provenance.commit, card.training.commit, "{name}");
        assert_eq!(u32::from(policy.spec().num_latents), card.policy.latents, "{name}");
    }
}

#[test]
fn the_index_is_made_from_the_cards() {
    let mut page = String::from(
        "# Models\n\nMade from the cards; a test fails where they differ (`UPDATE_DOCS=1 cargo test -p \
         gadm-integration-tests` writes it again).\nReturns are mean ± standard deviation; how each was made is in \
         its card.\n\n| model | environment | algorithm | float | int8 | over the bus | bytes |\n| --- | --- | --- | ---: \
         | ---: | ---: | ---: |\n",
    );
    let stats = |stats: Option<ReturnStats>| stats.map_or("–".into(), |s| format!("{:.2} ± {:.2}", s.mean, s.sd));
    for (name, _) in models() {
        let Card { environment, algorithm, policy, returns, .. } = card(&name);
        let [float, int8, sil] = [returns.float, returns.int8, returns.sil].map(stats);
        writeln!(
            page,
            "| [{name}]({name}/card.md) | {environment} | {algorithm} | {float} | {int8} | {sil} | {} |",
            policy.bytes
        )
        .unwrap();
    }
    check_page("models/README.md", &page);
}
