//! Every metric name, once. A metric that is not in this table is refused by the sinks.

/// Declares the constants, [`ALL`] and [`TIMING`] from one table.
macro_rules! keys {
    (
        reproducible { $($key:ident = $name:literal, $unit:literal, $doc:literal;)* }
        timing { $($tkey:ident = $tname:literal, $tunit:literal, $tdoc:literal;)* }
    ) => {
        $(#[doc = concat!($doc, " Unit: ", $unit, ".")] pub const $key: &str = $name;)*
        $(#[doc = concat!($tdoc, " Unit: ", $tunit, ".")] pub const $tkey: &str = $tname;)*

        /// Every name with its explanation and unit, in the order of the documentation.
        pub const ALL: &[(&str, &str)] = &[
            $(($name, concat!($doc, " Unit: ", $unit, ".")),)*
            $(($tname, concat!($tdoc, " Unit: ", $tunit, ".")),)*
        ];

        /// The names whose values depend on the clock. They go to `timing.jsonl`, so that `metrics.jsonl` is a function
        /// of configuration and seed.
        pub const TIMING: &[&str] = &[$($tname),*];
    };
}

keys! {
    reproducible {
        ENV_STEPS = "env_steps", "steps", "Environment steps taken so far, over all parallel environments; the abscissa of every record.";
        UPDATES = "updates", "updates", "Gradient updates of the learner so far.";
        EPISODES = "episodes", "episodes", "Training episodes finished so far.";
        EPISODE_RETURN = "episode_return", "reward", "Undiscounted return of training episodes, with exploration; mean over the episodes finished since the last record.";
        EPISODE_LENGTH = "episode_length", "steps", "Length of training episodes; mean over the episodes finished since the last record.";
        EPSILON = "epsilon", "probability", "Probability of a random latent in the behaviour policy.";
        ACTION_NOISE = "action_noise", "probability", "Probability of replacing the decoded action by an extreme one.";
        EVAL_RETURN_MEAN = "eval_return_mean", "reward", "Mean undiscounted return of the evaluation episodes, greedy.";
        EVAL_RETURN_SD = "eval_return_sd", "reward", "Sample standard deviation of the return over the evaluation episodes.";
        EVAL_RETURN_MIN = "eval_return_min", "reward", "Lowest return among the evaluation episodes.";
        EVAL_RETURN_MAX = "eval_return_max", "reward", "Highest return among the evaluation episodes.";
        EVAL_LENGTH_MEAN = "eval_length_mean", "steps", "Mean length of the evaluation episodes.";
        EVAL_EPISODES = "eval_episodes", "episodes", "Number of evaluation episodes behind the mean.";
        EVAL_SUCCESS_RATE = "eval_success_rate", "fraction", "Share of evaluation episodes that reached the goal, where the environment has one.";
        EVAL_RETURN_BEST = "eval_return_best", "reward", "Best mean evaluation return of the run so far.";
        Q_LOSS = "q_loss", "squared return", "Temporal-difference loss of the Q-network; mean since the last record.";
        Q_MEAN = "q_mean", "return", "Mean value of the taken latents in the learner's batches.";
        Q_TARGET_MEAN = "q_target_mean", "return", "Mean bootstrap target in the learner's batches.";
        TD_ERROR_ABS = "td_error_abs", "return", "Mean absolute temporal-difference error.";
        GRAD_NORM = "grad_norm", "norm", "Global gradient norm of the learner before clipping.";
        AE_LOSS = "ae_loss", "loss", "Total loss of the action autoencoder; mean since the last record.";
        RECON_CONTINUOUS = "recon_continuous", "squared normalised action", "Reconstruction loss of the continuous action components.";
        RECON_TYPE = "recon_type", "nat", "Reconstruction loss (cross entropy) of the discrete action type.";
        COMMITMENT = "commitment", "squared code", "Distance of encoder outputs from their codes.";
        AE_GRAD_NORM = "ae_grad_norm", "norm", "Global gradient norm of the autoencoder before clipping.";
        CONFIDENCE_LOSS = "confidence_loss", "nat", "Focal loss of the latent action confidence predictor.";
        CODE_PERPLEXITY = "code_perplexity", "codes", "Exponential of the entropy of code use in the autoencoder's batches; 1 is collapse, K is uniform use.";
        CODES_USED = "codes_used", "codes", "Number of codes used at least once since the last record.";
        REMAPPED = "remapped", "fraction", "Share of stored transitions whose latent changed when it was encoded again.";
        MASK_SIZE = "mask_size", "codes", "Mean number of latents that the mask allows.";
        MASK_FALLBACK = "mask_fallback", "fraction", "Share of decisions for which the mask allowed no latent and the most confident one was taken.";
        REPLAY_SIZE = "replay_size", "transitions", "Transitions in the replay buffer.";
        REWARD_LOSS = "reward_loss", "nat", "Loss of a learned model's reward prediction.";
        VALUE_LOSS = "value_loss", "nat", "Loss of a value prediction, of a learned model or of an actor's critic.";
        POLICY_LOSS = "policy_loss", "nat, or return", "Loss of a policy: of its prediction, its ratio, or minus the value of its actions.";
        POLICY_ENTROPY = "policy_entropy", "nat", "Mean entropy of a stochastic policy's discrete choice.";
    }
    timing {
        WALL_S = "wall_s", "s", "Wall-clock time since the start of the run, pauses between resumptions excluded.";
        ENV_STEPS_PER_S = "env_steps_per_s", "steps/s", "Environment steps per second since the last record.";
        UPDATES_PER_S = "updates_per_s", "updates/s", "Gradient updates per second since the last record.";
        EVAL_S = "eval_s", "s", "Wall-clock time of the evaluation.";
        RSS_BYTES = "rss_bytes", "B", "Resident memory of the process.";
    }
}

/// Whether `name` is in [`ALL`].
pub fn is_known(name: &str) -> bool {
    ALL.iter().any(|(known, _)| *known == name)
}

/// Whether `name` is in [`TIMING`].
pub fn is_timing(name: &str) -> bool {
    TIMING.contains(&name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_in_snake_case() {
        for (i, (name, doc)) in ALL.iter().enumerate() {
            assert!(name.chars().all(|c| c.is_ascii_lowercase() || c == '_'), "{name}");
            assert!(ALL[..i].iter().all(|(other, _)| other != name), "{name} is there twice");
            assert!(doc.contains(" Unit: ") && !doc.contains('\n'), "{name}: {doc}");
        }
    }

    #[test]
    fn timing_names_are_known_and_marked() {
        assert!(TIMING.iter().all(|name| is_known(name) && is_timing(name)));
        assert!(is_known(Q_LOSS) && !is_timing(Q_LOSS) && !is_known("q_los"));
    }
}
