//! Configurations that come with the program: what `gadm train --algo ALGO --env ENV` uses without
//! `--config`.

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Layer, TrainConfig, resolve::resolve};

    #[test]
    fn every_builtin_configuration_is_valid_and_names_its_environment() {
        for (algo, id, text) in BUILTIN {
            let layer = Layer::Toml { origin: (*id).to_owned(), text: (*text).to_owned() };
            let config: TrainConfig = resolve(&[layer]).unwrap();
            config.validate().unwrap();
            assert_eq!((config.env.as_str(), config.algo.name().id()), (*id, *algo));
        }
    }
}
