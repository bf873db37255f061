//! Configurations that come with the program: what `gadm train --env ENV` uses without `--config`.

/// Environment id and configuration text.
pub const BUILTIN: &[(&str, &str)] = &[
    ("inverted-pendulum-v5", include_str!("../../configs/gadm-dqn-inverted-pendulum-v5.toml")),
    ("moving", include_str!("../../configs/gadm-dqn-moving.toml")),
    ("sliding", include_str!("../../configs/gadm-dqn-sliding.toml")),
    ("hopper-v5", include_str!("../../configs/gadm-dqn-hopper-v5.toml")),
];

/// The built-in configuration of an environment.
pub fn builtin(env: &str) -> Option<&'static str> {
    BUILTIN.iter().find(|(id, _)| *id == env).map(|(_, text)| *text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Layer, TrainConfig, resolve::resolve};

    #[test]
    fn every_builtin_configuration_is_valid_and_names_its_environment() {
        for (id, text) in BUILTIN {
            let layer = Layer::Toml { origin: (*id).to_owned(), text: (*text).to_owned() };
            let config: TrainConfig = resolve(&[layer]).unwrap();
            config.validate().unwrap();
            assert_eq!(config.env, *id);
        }
    }
}
