//! A configuration as files hold it: the tables of the chosen algorithm and no others.

use gadm_envs::EnvOptions;
use serde::{Deserialize, Serialize};

use super::{
    Algorithm, AlgorithmName, CollectConfig, ExploreConfig, ReplayConfig, RoundConfig, TrackConfig, TrainConfig,
    WarmupConfig,
};
use crate::algo::dqn::DqnConfig;
use crate::algo::hppo::HppoConfig;
use crate::algo::listed::{DqnClusterConfig, DqnManualConfig};
use crate::algo::pdqn::{MpdqnConfig, PdqnConfig};
use crate::algo::td3::Td3Config;
use crate::discretizer::gadm::{ActionModelConfig, ConfidenceConfig};

/// See the module; fields as in [`TrainConfig`], a table that is not the algorithm's is `None`.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Stored {
    env: String,
    algo: AlgorithmName,
    seed: u64,
    steps: u64,
    env_options: EnvOptions,
    #[serde(skip_serializing_if = "Option::is_none")]
    collect: Option<CollectConfig>,
    #[serde(skip_serializing_if = "Option::is_none")]
    warmup: Option<WarmupConfig>,
    #[serde(skip_serializing_if = "Option::is_none")]
    round: Option<RoundConfig>,
    #[serde(skip_serializing_if = "Option::is_none")]
    explore: Option<ExploreConfig>,
    #[serde(skip_serializing_if = "Option::is_none")]
    replay: Option<ReplayConfig>,
    #[serde(skip_serializing_if = "Option::is_none")]
    action_model: Option<ActionModelConfig>,
    #[serde(skip_serializing_if = "Option::is_none")]
    confidence: Option<ConfidenceConfig>,
    #[serde(skip_serializing_if = "Option::is_none")]
    dqn: Option<DqnConfig>,
    #[serde(skip_serializing_if = "Option::is_none")]
    td3: Option<Td3Config>,
    #[serde(skip_serializing_if = "Option::is_none")]
    dqn_manual: Option<DqnManualConfig>,
    #[serde(skip_serializing_if = "Option::is_none")]
    dqn_cluster: Option<DqnClusterConfig>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pdqn: Option<PdqnConfig>,
    #[serde(skip_serializing_if = "Option::is_none")]
    mpdqn: Option<MpdqnConfig>,
    #[serde(skip_serializing_if = "Option::is_none")]
    hppo: Option<HppoConfig>,
    track: TrackConfig,
}

impl Default for Stored {
    /// What a file without a key means; the tables of an algorithm stay open, for they depend on `algo`.
    fn default() -> Self {
        let TrainConfig { env, seed, steps, env_options, track, .. } = TrainConfig::default();
        Self {
            env,
            algo: AlgorithmName::GadmDqn,
            seed,
            steps,
            env_options,
            collect: None,
            warmup: None,
            round: None,
            explore: None,
            replay: None,
            action_model: None,
            confidence: None,
            dqn: None,
            td3: None,
            dqn_manual: None,
            dqn_cluster: None,
            pdqn: None,
            mpdqn: None,
            hppo: None,
            track,
        }
    }
}

impl From<TrainConfig> for Stored {
    fn from(c: TrainConfig) -> Self {
        let TrainConfig { env, seed, steps, env_options, track, .. } = c;
        let mut stored = Self { env, algo: c.algo.name(), seed, steps, env_options, track, ..Self::default() };
        match c.algo {
            Algorithm::GadmDqn => {
                stored.collect = Some(c.collect);
                stored.warmup = Some(c.warmup);
                stored.round = Some(c.round);
                stored.explore = Some(c.explore);
                stored.replay = Some(c.replay);
                stored.action_model = Some(c.action_model);
                stored.confidence = Some(c.confidence);
                stored.dqn = Some(c.dqn);
            }
            Algorithm::Td3(own) => stored.td3 = Some(own),
            Algorithm::DqnManual(own) => stored.dqn_manual = Some(own),
            Algorithm::DqnCluster(own) => stored.dqn_cluster = Some(own),
            Algorithm::Pdqn(own) => stored.pdqn = Some(own),
            Algorithm::Mpdqn(own) => stored.mpdqn = Some(own),
            Algorithm::Hppo(own) => stored.hppo = Some(own),
        }
        stored
    }
}

impl Stored {
    /// Names of the tables that are there and belong to an algorithm, with that algorithm.
    fn tables(&self) -> impl Iterator<Item = (&'static str, AlgorithmName)> {
        use AlgorithmName::{DqnCluster, DqnManual, GadmDqn, Hppo, Mpdqn, Pdqn, Td3};
        [
            ("collect", self.collect.is_some(), GadmDqn),
            ("warmup", self.warmup.is_some(), GadmDqn),
            ("round", self.round.is_some(), GadmDqn),
            ("explore", self.explore.is_some(), GadmDqn),
            ("replay", self.replay.is_some(), GadmDqn),
            ("action_model", self.action_model.is_some(), GadmDqn),
            ("confidence", self.confidence.is_some(), GadmDqn),
            ("dqn", self.dqn.is_some(), GadmDqn),
            ("td3", self.td3.is_some(), Td3),
            ("dqn_manual", self.dqn_manual.is_some(), DqnManual),
            ("dqn_cluster", self.dqn_cluster.is_some(), DqnCluster),
            ("pdqn", self.pdqn.is_some(), Pdqn),
            ("mpdqn", self.mpdqn.is_some(), Mpdqn),
            ("hppo", self.hppo.is_some(), Hppo),
        ]
        .into_iter()
        .filter_map(|(name, there, algo)| there.then_some((name, algo)))
    }
}

impl TryFrom<Stored> for TrainConfig {
    type Error = String;

    fn try_from(s: Stored) -> Result<Self, String> {
        if let Some((table, owner)) = s.tables().find(|(_, owner)| *owner != s.algo) {
            let (owner, chosen) = (owner.id(), s.algo.id());
            return Err(format!("table [{table}] belongs to algo \"{owner}\", and this is algo \"{chosen}\""));
        }
        let Stored { env, seed, steps, env_options, track, .. } = s;
        let algo = match s.algo {
            AlgorithmName::GadmDqn => Algorithm::GadmDqn,
            AlgorithmName::Td3 => Algorithm::Td3(s.td3.unwrap_or_default()),
            AlgorithmName::DqnManual => Algorithm::DqnManual(s.dqn_manual.unwrap_or_default()),
            AlgorithmName::DqnCluster => Algorithm::DqnCluster(s.dqn_cluster.unwrap_or_default()),
            AlgorithmName::Pdqn => Algorithm::Pdqn(s.pdqn.unwrap_or_default()),
            AlgorithmName::Mpdqn => Algorithm::Mpdqn(s.mpdqn.unwrap_or_default()),
            AlgorithmName::Hppo => Algorithm::Hppo(s.hppo.unwrap_or_default()),
        };
        Ok(Self {
            env,
            algo,
            seed,
            steps,
            env_options,
            collect: s.collect.unwrap_or_default(),
            warmup: s.warmup.unwrap_or_default(),
            round: s.round.unwrap_or_default(),
            explore: s.explore.unwrap_or_default(),
            replay: s.replay.unwrap_or_default(),
            action_model: s.action_model.unwrap_or_default(),
            confidence: s.confidence.unwrap_or_default(),
            dqn: s.dqn.unwrap_or_default(),
            track,
        })
    }
}
