//! Why a policy acts as it does: its latents, masks, decoded actions and values along episodes, and what its integers cost.
//!
//! [`Subject`] is a policy file with a float model to compare it with, and the action model behind it where a run is at hand.
//! [`fly`] drives the environment with the file and keeps what the decisions were made of; [`page()`] shows it.

mod layers;
mod page;
mod regions;

pub use layers::{LayerError, LayerErrors};
pub use page::page;
pub use regions::{Grid, Region, plane, regions};

use std::path::Path;

use gadm_envs::{EnvOptions, EnvSpec, make_with};
use gadm_runtime::encode::{
    AlignedImage, FileOptions, FloatModel, QuantiseOptions, QuantisedModel, Trace, quantise, write_int8,
};
use gadm_runtime::{Policy, Scratch, WeightKind};

use crate::error::TrainError;
use crate::export::float_model;
use crate::runner::check_fit;
use crate::runner::checkpoint::{Networks, Trained, load_trained};

/// A policy to look into.
pub struct Subject {
    /// Run folder or file, as it was given.
    pub name: String,
    /// The policy as a device has it: int8.
    pub bytes: Vec<u8>,
    /// What the integers stand for: the networks of the run, or the weights of the file as floats.
    pub float: FloatModel,
    /// What a policy file does not hold.
    pub run: Option<OwnRun>,
    /// Environment.
    pub env: String,
    /// Settings of the environment.
    pub options: EnvOptions,
}

impl Subject {
    /// A run folder, of which `networks` are looked into, or a policy file; `env` overrides the environment that it was trained in.
    ///
    /// # Errors
    /// [`TrainError::Policy`] for a file that does not load or has no integers; those of loading and exporting a run.
    pub fn open(path: &Path, networks: Networks, env: Option<&str>) -> Result<Self, TrainError> {
        let name = path.display().to_string();
        if path.is_dir() {
            return Self::of_run(load_trained(path, networks)?, name, env);
        }
        let bytes = std::fs::read(path).map_err(TrainError::io("read", path))?;
        let image = AlignedImage::new(&bytes);
        let policy = Policy::load(&image).map_err(|e| TrainError::Policy(format!("{name}: {e}")))?;
        if policy.spec().weights == WeightKind::Float32 {
            return Err(TrainError::Policy(format!(
                "{name} holds f32 weights; expected an int8 file: export the run without --float, or name the run folder"
            )));
        }
        let float = QuantisedModel::read(&policy).dequantised();
        let env = env.unwrap_or(policy.provenance().environment).to_owned();
        Ok(Self { name, bytes, float, run: None, env, options: EnvOptions::default() })
    }

    fn of_run(mut trained: Trained, name: String, env: Option<&str>) -> Result<Self, TrainError> {
        let options = trained.config.env_options;
        let spec = make_with(&trained.config.env, &options)?.spec().clone();
        let float = float_model(&mut trained, &spec)?;
        let calibration = &trained.calibration;
        if calibration.is_empty() {
            return Err(TrainError::Export(format!(
                "{name} has collected no observation to calibrate with: train longer"
            )));
        }
        let encode = |e: gadm_runtime::encode::EncodeError| TrainError::Export(e.to_string());
        let int = quantise(&float, calibration, &QuantiseOptions::default()).map_err(encode)?;
        let bytes = write_int8(&int, &calibration[..spec.obs_dim()], &FileOptions::default()).map_err(encode)?;
        let env = env.unwrap_or(&trained.config.env).to_owned();
        let orders = int.report.layers.into_iter().map(|layer| layer.order).collect();
        Ok(Self { name, bytes, float, run: Some(OwnRun { trained, orders }), env, options })
    }
}

/// The run behind a policy.
pub struct OwnRun {
    /// Its networks, the encoder among them.
    pub trained: Trained,
    /// For each layer of the file, which row of the run's layer a row is.
    pub orders: Vec<Vec<usize>>,
}

impl OwnRun {
    /// Puts the rows of the layers in the order of the file.
    fn in_file_order(&self, trace: &mut Trace) {
        for (layer, order) in trace.layers.iter_mut().zip(&self.orders) {
            layer.outputs = order.iter().map(|&row| layer.outputs[row]).collect();
        }
    }
}

/// What is kept of every decision.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Choice {
    /// Chosen latent.
    pub latent: u16,
    /// Latents that were allowed.
    pub allowed: u16,
    /// The mask was empty, and the rule for it made the set.
    pub fallback: bool,
    /// An observation lay outside of the range of the input quantiser.
    pub clipped: bool,
}

/// An episode.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Flown {
    /// Sum of its rewards.
    pub total: f64,
    /// Its decisions.
    pub choices: Vec<Choice>,
}

/// One step of the episode that is shown in full.
#[derive(Clone, Debug, PartialEq)]
pub struct Shown {
    /// What the policy saw.
    pub obs: Vec<f32>,
    /// What it did, in the units of the interface.
    pub action: Vec<f32>,
    /// What the file computed.
    pub trace: Trace,
}

/// Episodes of a policy, the first one in full.
pub struct Flight {
    /// The environment.
    pub spec: EnvSpec,
    /// All episodes.
    pub episodes: Vec<Flown>,
    /// Steps of the first episode.
    pub shown: Vec<Shown>,
    /// Errors by layer on the first episode.
    pub layers: LayerErrors,
    /// Times that each latent was allowed, of all episodes.
    pub allowed: Vec<u64>,
    /// Latents of the policy.
    pub latents: usize,
    /// First seed of the episodes.
    pub seed: u64,
}

impl Flight {
    /// Times that each latent was chosen.
    pub fn chosen(&self) -> Vec<u64> {
        let mut counts = vec![0; self.latents];
        for choice in self.choices() {
            counts[usize::from(choice.latent)] += 1;
        }
        counts
    }

    /// Decisions of all episodes.
    pub fn choices(&self) -> impl Iterator<Item = &Choice> {
        self.episodes.iter().flat_map(|episode| &episode.choices)
    }
}

/// Flies `episodes` episodes from `seed` with the file; `tick` is told after each.
///
/// # Errors
/// [`TrainError::Policy`] for a policy that does not fit the environment.
pub fn fly(subject: &Subject, episodes: usize, seed: u64, mut tick: impl FnMut(usize)) -> Result<Flight, TrainError> {
    let refused = |e: &dyn std::fmt::Display| TrainError::Policy(e.to_string());
    let image = AlignedImage::new(&subject.bytes);
    let policy = Policy::load(&image).map_err(|e| refused(&e))?;
    let mut env = make_with(&subject.env, &subject.options)?;
    let spec = env.spec().clone();
    check_fit(&policy, &spec)?;
    let latents = usize::from(policy.spec().num_latents);
    let dequantised = QuantisedModel::read(&policy).dequantised();
    let mut memory = vec![0; policy.spec().scratch_words];
    let mut scratch = Scratch::new(&mut memory);
    let (mut obs, mut action) = (vec![0.0; spec.obs_dim()], vec![0.0; spec.action_dim()]);
    let mut flight = Flight {
        spec,
        episodes: Vec::new(),
        shown: Vec::new(),
        layers: LayerErrors::default(),
        allowed: vec![0; latents],
        latents,
        seed,
    };
    for episode in 0..episodes {
        env.reset(gadm_envs::episode_seed(seed, episode as u64), &mut obs);
        let mut flown = Flown::default();
        loop {
            let decision = policy.act(&obs, &mut scratch, &mut action).map_err(|e| refused(&e))?;
            flown.choices.push(Choice {
                latent: decision.latent,
                allowed: decision.allowed.len() as u16,
                fallback: decision.fallback,
                clipped: decision.clipped,
            });
            for latent in decision.allowed.iter() {
                flight.allowed[usize::from(latent)] += 1;
            }
            if episode == 0 {
                let trace = policy.trace(&obs).map_err(|e| refused(&e))?;
                let own = subject.run.as_ref().map(|run| {
                    let mut trace = subject.float.trace(&obs);
                    run.in_file_order(&mut trace);
                    trace
                });
                flight.layers.add(&trace, &dequantised.trace(&obs), own.as_ref());
                flight.shown.push(Shown { obs: obs.clone(), action: action.clone(), trace });
            }
            let step = env.step(&action, &mut obs);
            flown.total += step.reward;
            if step.terminated || step.truncated {
                break;
            }
        }
        flight.episodes.push(flown);
        tick(episode + 1);
    }
    Ok(flight)
}
