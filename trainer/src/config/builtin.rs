//! Configurations that come with the program: what `gadm train --algo ALGO --env ENV` uses without
//! `--config`.

use super::resolve::resolve;
use super::{Layer, TrainConfig};

/// Algorithm, environment id and configuration text.
pub const BUILTIN: &[(&str, &str, &str)] = &[
    ("gadm-dqn", "inverted-pendulum-v5", include_str!("../../configs/gadm-dqn-inverted-pendulum-v5.toml")),
    ("gadm-dqn", "moving", include_str!("../../configs/gadm-dqn-moving.toml")),
    ("gadm-dqn", "sliding", include_str!("../../configs/gadm-dqn-sliding.toml")),
    ("gadm-dqn", "hopper-v5", include_str!("../../configs/gadm-dqn-hopper-v5.toml")),
    ("gadm-dqn", "hard-move-10", include_str!("../../configs/gadm-dqn-hard-move-10.toml")),
    ("gadm-dqn", "half-cheetah-v5", include_str!("../../configs/gadm-dqn-half-cheetah-v5.toml")),
    ("gadm-dqn", "ant-v5", include_str!("../../configs/gadm-dqn-ant-v5.toml")),
    ("gadm-dqn", "humanoid-v5", include_str!("../../configs/gadm-dqn-humanoid-v5.toml")),
    ("gadm-dqn", "lunar-lander-continuous", include_str!("../../configs/gadm-dqn-lunar-lander-continuous.toml")),
    ("td3", "lunar-lander-continuous", include_str!("../../configs/td3-lunar-lander-continuous.toml")),
    ("td3", "pendulum", include_str!("../../configs/td3-pendulum.toml")),
];

/// The built-in configuration of an algorithm for an environment.
pub fn builtin(algo: &str, env: &str) -> Option<&'static str> {
    BUILTIN.iter().find(|(a, e, _)| (*a, *e) == (algo, env)).map(|(.., text)| *text)
}

/// Whether `config` is the built-in one of its algorithm and environment, but for seed and steps.
pub fn is_builtin(config: &TrainConfig) -> bool {
    builtin(config.algo.name().id(), &config.env).is_some_and(|text| {
        let layers = [
            Layer::Toml { origin: config.env.clone(), text: text.to_owned() },
            Layer::Set(format!("seed={}", config.seed)),
            Layer::Set(format!("steps={}", config.steps)),
        ];
        resolve::<TrainConfig>(&layers).is_ok_and(|builtin| builtin == *config)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_builtin_configuration_is_valid_and_names_its_environment() {
        for (algo, id, text) in BUILTIN {
            let layer = Layer::Toml { origin: (*id).to_owned(), text: (*text).to_owned() };
            let config: TrainConfig = resolve(&[layer]).unwrap();
            config.validate().unwrap();
            assert_eq!((config.env.as_str(), config.algo.name().id()), (*id, *algo));
            let other = TrainConfig { seed: 7, steps: config.steps + 1, ..config.clone() };
            assert!(is_builtin(&config) && is_builtin(&other), "{algo} {id}: seed and steps do not count");
            let mut tuned = config;
            tuned.track.average += 0.25;
            assert!(!is_builtin(&tuned), "{algo} {id}: a setting that counts");
        }
        assert!(!is_builtin(&TrainConfig { env: "toy".to_owned(), ..TrainConfig::default() }), "has none");
    }
}
