//! The runs of a figure: name, folder, configuration, and what one needs of another.

use std::path::{Path, PathBuf};

use super::PaperError;
use super::figure::{Figure, Source, Task, Variant};
use crate::config::builtin::builtin;
use crate::config::resolve::resolve;
use crate::config::{Algorithm, Layer, TrackConfig, TrainConfig};

/// What a person may choose of a figure. The list of runs is a function of figure and options, so that an index into it
/// means the same run in every process.
#[derive(Clone, Debug)]
pub struct Options {
    /// Seeds 0 to this, exclusive.
    pub seeds: Option<u64>,
    /// Environment steps of every run.
    pub steps: Option<u64>,
    /// Folder of runs and results.
    pub out: PathBuf,
    /// Only runs with this in their name.
    pub only: Option<String>,
}

/// One run of a figure.
#[derive(Clone, Debug)]
pub struct PlannedRun {
    /// `ENV/VARIANT-seedN`, unique over all figures but for the number of steps.
    pub name: String,
    /// Its environment.
    pub task: &'static Task,
    /// How it learns.
    pub variant: &'static Variant,
    /// Its seed.
    pub seed: u64,
    /// Environment steps.
    pub steps: u64,
    /// Its folder.
    pub dir: PathBuf,
    /// Its whole configuration.
    pub config: TrainConfig,
    /// The expert's actions that it starts from.
    pub data: Option<PathBuf>,
    /// Whether the figure shows it; an expert that is none of the curves is not.
    pub shown: bool,
}

/// All runs of a figure. An expert comes before those that need it.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The figure.
    pub figure: &'static Figure,
    /// Folder of runs and results.
    pub out: PathBuf,
    /// The runs; by seed first, so that a picture of everything is there early.
    pub runs: Vec<PlannedRun>,
    /// Index of the expert's run, where a run needs one.
    pub expert: Option<usize>,
}

impl Plan {
    /// The runs of `figure`.
    ///
    /// # Errors
    /// [`PaperError::TooShort`], [`PaperError::NothingPicked`], or a configuration that does not resolve.
    pub fn new(figure: &'static Figure, options: &Options) -> Result<Self, PaperError> {
        let steps = options.steps.unwrap_or(figure.steps);
        let mut runs = Vec::new();
        for seed in 0..options.seeds.unwrap_or(figure.seeds) {
            for task in figure.tasks {
                for variant in figure.variants {
                    runs.push(planned(figure, task, variant, seed, steps, &options.out)?);
                }
            }
        }
        if let Some(pattern) = &options.only {
            let example = runs.first().map_or_else(String::new, |run| run.name.clone());
            runs.retain(|run| run.name.contains(pattern.as_str()));
            if runs.is_empty() {
                return Err(PaperError::NothingPicked { pattern: pattern.clone(), figure: figure.id, example });
            }
        }
        let mut expert = None;
        if let Some(by) = figure.expert().filter(|_| runs.iter().any(|run| run.data.is_some())) {
            let mut own = planned(figure, &figure.tasks[0], by.variant, 0, by.steps, &options.out)?;
            let at = runs.iter().position(|run| run.name == own.name);
            if let Some(at) = at {
                (runs[at].steps, runs[at].config.steps) = (steps.max(by.steps), steps.max(by.steps));
            } else {
                own.shown = false;
                runs.insert(0, own);
            }
            expert = at.or(Some(0));
        }
        Ok(Self { figure, out: options.out.clone(), runs, expert })
    }

    /// The run of that index.
    ///
    /// # Errors
    /// [`PaperError::NoSuchRun`].
    pub fn run(&self, index: usize) -> Result<&PlannedRun, PaperError> {
        let figure = self.figure.id;
        self.runs.get(index).ok_or(PaperError::NoSuchRun { figure, runs: self.runs.len(), index })
    }

    /// The run whose policy gives `run` its actions.
    pub fn expert_of(&self, run: &PlannedRun) -> Option<usize> {
        self.expert.filter(|_| run.data.is_some())
    }

    /// Whether every environment can be made here.
    ///
    /// # Errors
    /// [`PaperError::Environment`] with the first that cannot.
    pub fn check_environments(&self) -> Result<(), PaperError> {
        let tasks = self.figure.tasks.iter().filter(|task| self.runs.iter().any(|run| run.task.env == task.env));
        for task in tasks {
            gadm_envs::make(task.env).map_err(|e| PaperError::Environment {
                figure: self.figure.id,
                env: task.env,
                reason: e.to_string(),
            })?;
        }
        Ok(())
    }
}

/// Folder of a run below the folder of runs and results.
fn folder(out: &Path, name: &str) -> PathBuf {
    out.join("runs").join(name)
}

fn planned(
    figure: &'static Figure,
    task: &'static Task,
    variant: &'static Variant,
    seed: u64,
    steps: u64,
    out: &Path,
) -> Result<PlannedRun, PaperError> {
    let name = format!("{}/{}-seed{seed}", task.env, variant.id);
    let data = variant.data.and(figure.data.as_ref()).map(|source| {
        let file = match source {
            // Without `--steps` in it: a run that is continued beyond its end keeps what it started from.
            Source::Expert(by) => format!("{}-{}-{}of{}", by.variant.id, by.steps, by.keep, by.episodes),
            Source::Toy { per_state } => format!("{per_state}-seed{seed}"),
        };
        out.join("data").join(format!("{}-{file}.safetensors", task.env))
    });
    let mut layers = Vec::new();
    if let Some(text) = builtin(variant.algo, task.env) {
        let origin = format!("built-in configuration of {} on {}", variant.algo, task.env);
        layers.push(Layer::Toml { origin, text: text.to_owned() });
    }
    let own = [format!("algo={}", variant.algo), format!("env={}", task.env), format!("seed={seed}")];
    layers.extend(own.into_iter().map(Layer::Set));
    layers.push(Layer::Set(format!("steps={steps}")));
    layers.extend(variant.settings.iter().map(|set| Layer::Set((*set).to_owned())));
    if let (Some(key), Some(path)) = (variant.data, &data) {
        layers.push(Layer::Set(format!("{key}={}", toml::Value::String(path.display().to_string()))));
    }
    let mut config: TrainConfig = resolve(&layers).map_err(Box::new)?;
    // The same for every curve of a panel, whatever a built-in configuration has; and every run goes to its end.
    config.track = TrackConfig {
        eval_every: task.eval_every,
        eval_episodes: task.eval_episodes,
        log_every: task.eval_every.min(5_000),
        checkpoint_every: task.checkpoint_every,
        stop_at_return: None,
        snapshots: task.snapshots.to_vec(),
        average: config.track.average,
    };
    config.validate()?;
    let warmup = random_steps(&config);
    if steps <= warmup {
        return Err(PaperError::TooShort { run: name, steps, warmup });
    }
    Ok(PlannedRun { dir: folder(out, &name), name, task, variant, seed, steps, config, data, shown: true })
}

/// Steps before anything is learned.
fn random_steps(config: &TrainConfig) -> u64 {
    match &config.algo {
        Algorithm::GadmDqn if config.warmup.enabled && config.warmup.data.is_none() => config.warmup.steps,
        Algorithm::GadmDqn | Algorithm::Hppo(_) => 0,
        Algorithm::Td3(c) => c.schedule.random_steps,
        Algorithm::DqnManual(c) => c.schedule.random_steps,
        Algorithm::DqnCluster(c) => c.schedule.random_steps,
        Algorithm::Pdqn(c) => c.schedule.random_steps,
        Algorithm::Mpdqn(c) => c.pdqn.schedule.random_steps,
    }
}

#[cfg(test)]
mod tests {
    use super::super::figure::{FIGURES, figure};
    use super::*;

    fn options() -> Options {
        Options { seeds: None, steps: None, out: PathBuf::from("out"), only: None }
    }

    #[test]
    fn every_figure_resolves_and_its_runs_have_names_of_their_own() {
        for figure in FIGURES {
            let plan = Plan::new(figure, &options()).unwrap();
            let shown = plan.runs.iter().filter(|run| run.shown).count();
            assert_eq!(shown as u64, figure.seeds * (figure.tasks.len() * figure.variants.len()) as u64);
            for (i, run) in plan.runs.iter().enumerate() {
                assert!(plan.runs[..i].iter().all(|other| other.dir != run.dir), "{}", run.name);
                assert!(plan.expert_of(run).is_none_or(|expert| expert < i), "{}: its expert comes first", run.name);
                assert_eq!(run.config.track.stop_at_return, None);
            }
        }
    }

    /// Folders are shared by figures: the same name must be the same run.
    #[test]
    fn runs_of_the_same_name_are_the_same_in_all_figures() {
        let at = Options { steps: Some(300_000), ..options() };
        let all: Vec<_> = FIGURES.iter().flat_map(|figure| Plan::new(figure, &at).unwrap().runs).collect();
        for run in &all {
            for other in all.iter().filter(|other| other.name == run.name) {
                // An expert trains for as long as those need it that use its actions.
                let config = TrainConfig { steps: run.steps, ..other.config.clone() };
                assert_eq!(run.config, config, "{}", run.name);
            }
        }
    }

    #[test]
    fn ablations_change_what_they_are_named_for_and_nothing_else() {
        let config = |figure_id: &str, variant: &str, env: &str| {
            let plan = Plan::new(figure(figure_id).unwrap(), &options()).unwrap();
            plan.runs.iter().find(|r| r.variant.id == variant && r.task.env == env).unwrap().config.clone()
        };
        let whole = config("fig5", "gadm-dqn", "half-cheetah-v5");
        let mut without = config("fig5", "gadm-dqn-no-remap", "half-cheetah-v5");
        assert!(whole.round.remap && !without.round.remap);
        without.round.remap = true;
        without.explore.random = whole.explore.random;
        assert_eq!(without, whole);
        let mut without = config("fig5", "gadm-dqn-no-warmup", "half-cheetah-v5");
        assert!(whole.warmup.enabled && !without.warmup.enabled);
        without.warmup.enabled = true;
        assert_eq!(without, whole);
        let mut gaussian = config("fig11", "gadm-dqn-gaussian", "half-cheetah-v5");
        let whole = config("fig11", "gadm-dqn", "half-cheetah-v5");
        assert_eq!((gaussian.explore.extreme_noise, gaussian.explore.gaussian_noise), (0.0, 0.1));
        assert_eq!((whole.explore.extreme_noise, whole.explore.gaussian_noise), (0.1, 0.0));
        gaussian.explore = whole.explore.clone();
        assert_eq!(gaussian, whole);
        let mut tanh = config("fig11", "gadm-dqn-no-ear", "half-cheetah-v5");
        assert_ne!(tanh.action_model.head, whole.action_model.head);
        tanh.action_model.head = whole.action_model.head;
        assert_eq!(tanh, whole);
    }

    #[test]
    fn an_expert_that_is_no_curve_is_added_once_and_comes_first() {
        let plan = Plan::new(figure("fig10").unwrap(), &options()).unwrap();
        assert_eq!((plan.expert, plan.runs[0].name.as_str()), (Some(0), "hopper-v5/td3-seed0"));
        assert!(!plan.runs[0].shown && plan.runs[1..].iter().all(|run| run.shown));
        let only = Options { only: Some("gadm-dqn-seed".to_owned()), ..options() };
        assert_eq!(Plan::new(figure("fig10").unwrap(), &only).unwrap().expert, None, "nothing needs it");
        let only = Options { only: Some("cluster".to_owned()), ..options() };
        let plan = Plan::new(figure("demo").unwrap(), &only).unwrap();
        assert_eq!(plan.runs.iter().filter(|run| !run.shown).count(), 1, "needed, and not picked");
    }

    #[test]
    fn options_out_of_range_are_refused_with_what_to_give() {
        let short = Options { steps: Some(400), ..options() };
        let text = Plan::new(figure("demo").unwrap(), &short).unwrap_err().to_string();
        assert!(text.contains("--steps 400") && text.contains("500 random steps"), "{text}");
        let only = Options { only: Some("hoper".to_owned()), ..options() };
        let text = Plan::new(figure("fig9").unwrap(), &only).unwrap_err().to_string();
        assert!(text.contains("hoper") && text.contains("hopper-v5/gadm-dqn-seed0"), "{text}");
        let plan = Plan::new(figure("demo").unwrap(), &options()).unwrap();
        let text = plan.run(99).unwrap_err().to_string();
        assert!(text.contains("0 to 5"), "{text}");
    }
}
