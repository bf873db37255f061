//! Updates per second of the networks, and rounds of the whole algorithm.

use rand::RngExt as _;

use super::{Label, Timing, repeat};
use crate::action_space::{ActionSpace, ContinuousHead, SnapRule};
use crate::algo::dqn::{Dqn, DqnConfig, TargetUpdate};
use crate::algo::td3::{Td3, Td3Config};
use crate::algo::{Learner as _, Report};
use crate::config::{Algorithm, RoundConfig, TrainConfig, WarmupConfig};
use crate::discretizer::gadm::{ActionModel, ActionModelConfig, Confidence, ConfidenceConfig};
use crate::error::TrainError;
use crate::nn::AdamConfig;
use crate::nn::kernel::{Epilogue, Left, Product, Right, product};
use crate::nn::pack::{pack_panels, panels_len};
use crate::nn::parallel;
use crate::replay::RlBatch;
use crate::runner::{AnyRun, BaselineRun, Run};
use crate::seed::{Rng, SeedTree};

/// A piece of work of the table in `docs/src/performance.md`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Case {
    /// Matrix product 512 x 256 x 256: the practical peak.
    Sgemm,
    /// Double DQN, 11-256-256-128-64, batch 512, clip 10.
    Dqn,
    /// The Q-network of Algorithm 1: trunk 256-256-128, two streams, 20 heads, masks, batch 512.
    DqnDueling,
    /// Encoder, code, decoder, categorical head of 3 x 51 outputs, batch 512.
    ActionModel,
    /// Confidence predictor 256-256, batch 512.
    Confidence,
    /// Double DQN, 3-64-64-8, batch 100.
    DqnSmall,
    /// TD3, actor 3-64-64-1, critics 4-64-64-1, batch 100, policy delay 2.
    Td3Small,
    /// TD3, actor 3-256-256-1, critics 4-256-256-1, batch 256, policy delay 2.
    Td3,
    /// Whole steps of TD3 on Pendulum, 64-64, batch 100: environment, replay and one update each.
    Td3Loop,
    /// Rounds of Algorithm 1 on Hopper-v5.
    Round,
}

/// All cases with their names.
pub const CASES: [(&str, Case); 10] = [
    ("sgemm", Case::Sgemm),
    ("dqn", Case::Dqn),
    ("dqn-dueling", Case::DqnDueling),
    ("action-model", Case::ActionModel),
    ("confidence", Case::Confidence),
    ("dqn-small", Case::DqnSmall),
    ("td3-small", Case::Td3Small),
    ("td3", Case::Td3),
    ("td3-loop", Case::Td3Loop),
    ("round", Case::Round),
];

const OBS: usize = 11;
const SLOTS: usize = 3;
const LATENTS: usize = 64;
const BATCH: usize = 512;

fn random(rng: &mut Rng, n: usize) -> Vec<f32> {
    (0..n).map(|_| rng.random_range(-1.0_f32..1.0)).collect()
}

/// A random batch with the codes of its actions.
fn transitions(rng: &mut Rng, batch: usize, obs: usize, latents: usize) -> (RlBatch, Vec<u32>) {
    let data = RlBatch {
        obs: random(rng, batch * obs),
        actions: random(rng, batch * SLOTS),
        codes: vec![0.0; batch],
        returns: random(rng, batch),
        bootstrap: vec![0.97; batch],
        next_obs: random(rng, batch * obs),
    };
    (data, (0..batch).map(|_| rng.random_range(0..latents as u32)).collect())
}

/// Multiplications and additions of dense layers of these widths, per row and pass.
fn dense_flop(widths: &[usize]) -> f64 {
    widths.windows(2).map(|w| 2.0 * (w[0] * w[1]) as f64).sum()
}

/// Forward and backward pass without the gradient of the input.
fn trained_flop(widths: &[usize]) -> f64 {
    3.0 * dense_flop(widths) - 2.0 * (widths[0] * widths[1]) as f64
}

fn dqn_config(hidden: &[usize]) -> DqnConfig {
    DqnConfig {
        hidden: hidden.to_vec(),
        heads: 1,
        dueling: false,
        target: TargetUpdate::Hard { every: 500 },
        adam: AdamConfig { grad_clip: 10.0, ..Default::default() },
        ..Default::default()
    }
}

/// Runs one case for about `seconds` on `threads` threads.
///
/// # Errors
/// Where a network or the environment cannot be made.
pub fn run(case: Case, threads: usize, seconds: f64) -> Result<Timing, TrainError> {
    let mut rng = SeedTree::new(1).stream("bench");
    let rng = &mut rng;
    parallel::start(threads);
    match case {
        Case::Sgemm => Ok(sgemm(rng, threads, seconds)),
        Case::Dqn => {
            let (data, codes) = transitions(rng, BATCH, OBS, LATENTS);
            let mut dqn = Dqn::plain(dqn_config(&[256, 256, 128]), OBS, LATENTS, BATCH, rng)?;
            let widths = [OBS, 256, 256, 128, LATENTS];
            let label = Label {
                case: "dqn",
                what: "double DQN 11-256-256-128-64, batch 512, clip, Adam".to_owned(),
                unit: "updates",
                flop: BATCH as f64 * (2.0 * dense_flop(&widths) + trained_flop(&widths)),
            };
            Ok(repeat(&label, threads, seconds, || {
                dqn.update(&data, &codes, &[]);
                1
            }))
        }
        Case::DqnDueling => {
            let (data, codes) = transitions(rng, BATCH, OBS, LATENTS);
            let allowed: Vec<bool> = (0..BATCH * LATENTS).map(|i| i % LATENTS == 0 || rng.random_bool(0.5)).collect();
            let mut dqn = Dqn::new(DqnConfig::default(), OBS, LATENTS, BATCH, rng)?;
            let label = Label {
                case: "dqn-dueling",
                what: "the same, dueling streams, 20 heads, masks".to_owned(),
                unit: "updates",
                flop: 0.0,
            };
            Ok(repeat(&label, threads, seconds, || {
                dqn.update(&data, &codes, &allowed);
                1
            }))
        }
        Case::ActionModel => action_model(rng, threads, seconds),
        Case::Confidence => {
            let config = ConfidenceConfig::default();
            let mut confidence = Confidence::new(config, OBS, LATENTS, BATCH, rng)?;
            let (data, codes) = transitions(rng, BATCH, OBS, LATENTS);
            let label = Label {
                case: "confidence",
                what: "confidence predictor 11-256-256-64, focal loss, batch 512".to_owned(),
                unit: "updates",
                flop: BATCH as f64 * trained_flop(&[OBS, 256, 256, LATENTS]),
            };
            Ok(repeat(&label, threads, seconds, || {
                confidence.update(&data.obs, &codes);
                1
            }))
        }
        Case::DqnSmall => {
            let (obs, batch, latents) = (3, 100, 8);
            let (data, codes) = transitions(rng, batch, obs, latents);
            let mut dqn = Dqn::plain(dqn_config(&[64, 64]), obs, latents, batch, rng)?;
            let widths = [obs, 64, 64, latents];
            let label = Label {
                case: "dqn-small",
                what: "double DQN 3-64-64-8, batch 100".to_owned(),
                unit: "updates",
                flop: batch as f64 * (2.0 * dense_flop(&widths) + trained_flop(&widths)),
            };
            Ok(repeat(&label, threads, seconds, || {
                dqn.update(&data, &codes, &[]);
                1
            }))
        }
        Case::Td3Small => td3(rng, "td3-small", 64, 100, threads, seconds),
        Case::Td3 => td3(rng, "td3", 256, 256, threads, seconds),
        Case::Td3Loop => td3_loop(threads, seconds),
        Case::Round => round(threads, seconds),
    }
}

/// Updates of TD3 on the sizes of Pendulum, noise on the target actions included.
fn td3(
    rng: &mut Rng,
    case: &'static str,
    hidden: usize,
    batch: usize,
    threads: usize,
    seconds: f64,
) -> Result<Timing, TrainError> {
    let spec = gadm_envs::make("pendulum")?.spec().clone();
    let (o, a) = (spec.obs_dim(), spec.action_dim());
    let mut config = Td3Config { hidden: vec![hidden; 2], ..Default::default() };
    config.schedule.batch = batch;
    let delay = config.policy_delay as f64;
    let mut learner = Td3::new(config, &spec, SeedTree::new(1))?;
    let (mut data, _) = transitions(rng, batch, o, 1);
    data.actions.truncate(batch * a);
    let (actor, critic) = (dense_flop(&[o, hidden, hidden, a]), dense_flop(&[o + a, hidden, hidden, 1]));
    let critics = actor + 2.0 * critic + 2.0 * trained_flop(&[o + a, hidden, hidden, 1]);
    // The policy's gradient goes through the first critic, whose weights need none then.
    let policy = trained_flop(&[o, hidden, hidden, a]) + 2.0 * critic;
    let label = Label {
        case,
        what: format!("TD3 {o}-{hidden}-{hidden}-{a}, batch {batch}, policy delay {delay}"),
        unit: "updates",
        flop: batch as f64 * (critics + policy / delay),
    };
    let mut report = Report::new();
    Ok(repeat(&label, threads, seconds, || {
        learner.update(&data, rng, &mut report);
        1
    }))
}

fn sgemm(rng: &mut Rng, threads: usize, seconds: f64) -> Timing {
    let (m, n, k) = (BATCH, 256, 256);
    let (a, b) = (random(rng, m * k), random(rng, n * k));
    let mut right = vec![0.0; panels_len(k, n)];
    pack_panels(&b, k, n, &mut right);
    let mut c = vec![vec![0.0; m * n]; threads];
    let label = Label {
        case: "sgemm",
        what: "matrix product 512 x 256 x 256, one per thread".to_owned(),
        unit: "products",
        flop: 2.0 * (m * n * k) as f64,
    };
    repeat(&label, threads, seconds, || {
        // Long enough that starting the threads does not count.
        let each = 64;
        std::thread::scope(|scope| {
            for c in &mut c {
                let (left, right) = (Left::Rows(&a), &right);
                scope.spawn(move || {
                    (0..each).for_each(|_| {
                        let right = Right::Panels(right);
                        product(Product { m, n, k, left, right, c, end: Epilogue::Store });
                    });
                });
            }
        });
        each * threads as u64
    })
}

fn action_model(rng: &mut Rng, threads: usize, seconds: f64) -> Result<Timing, TrainError> {
    let head = ContinuousHead::Categorical { atoms: 51, snap: SnapRule::Edges };
    let config = ActionModelConfig { head, ..Default::default() };
    let spec = gadm_envs::make("hopper-v5")?.spec().clone();
    let space = ActionSpace::new(&spec, head, true);
    let h = config.hidden;
    let (common, out) = (config.encoder_layers + config.decoder_layers, space.output_width());
    let widths = 2 * (SLOTS * h + OBS * h + common * h * h + h * LATENTS + LATENTS * h + h * out);
    let inputs = 2 * (SLOTS * h + OBS * h);
    let mut model = ActionModel::new(config, OBS, space, BATCH, rng)?;
    let (obs, actions) = (random(rng, BATCH * OBS), random(rng, BATCH * SLOTS));
    let label = Label {
        case: "action-model",
        what: "action model, K = D = 64, hidden 256, head 3 x 51, batch 512".to_owned(),
        unit: "updates",
        flop: BATCH as f64 * (3 * widths - inputs) as f64,
    };
    Ok(repeat(&label, threads, seconds, || {
        model.update(&obs, &actions);
        1
    }))
}

/// The configuration of [`Case::Round`]: the defaults of Algorithm 1, with a categorical head as Hopper uses it.
pub fn round_config() -> TrainConfig {
    let mut config = TrainConfig {
        env: "hopper-v5".to_owned(),
        warmup: WarmupConfig { enabled: false, ..Default::default() },
        round: RoundConfig { action_updates: 50, confidence_updates: 10, q_updates: 50, ..Default::default() },
        ..Default::default()
    };
    config.action_model.head = ContinuousHead::Categorical { atoms: 51, snap: SnapRule::Edges };
    config.confidence.start_after = 0;
    config
}

fn round(threads: usize, seconds: f64) -> Result<Timing, TrainError> {
    let config = round_config();
    let steps = config.collect.steps_per_round as u64;
    let label = Label {
        case: "round",
        what: "Algorithm 1 on Hopper-v5, rounds of 256 steps + 50 action-model + 10 confidence + 50 Q updates"
            .to_owned(),
        unit: "steps",
        flop: 0.0,
    };
    rounds(&mut Run::new(config)?, steps, &label, threads, seconds)
}

fn td3_loop(threads: usize, seconds: f64) -> Result<Timing, TrainError> {
    let mut own = Td3Config { hidden: vec![64; 2], ..Default::default() };
    (own.schedule.batch, own.schedule.random_steps) = (100, 100);
    let config =
        TrainConfig { env: "pendulum".to_owned(), algo: Algorithm::Td3(own), steps: u64::MAX, ..Default::default() };
    let label = Label {
        case: "td3-loop",
        what: "TD3 on Pendulum, 64-64, batch 100: a step of the environment and an update".to_owned(),
        unit: "steps",
        flop: 0.0,
    };
    rounds(&mut BaselineRun::new(config)?, 1, &label, threads, seconds)
}

/// Rounds of a run, each of `steps` environment steps, from its first update on.
fn rounds(run: &mut dyn AnyRun, steps: u64, label: &Label, threads: usize, seconds: f64) -> Result<Timing, TrainError> {
    let mut failed = None;
    while run.counters().q_updates == 0 && failed.is_none() {
        one_round(run, &mut failed);
    }
    let timing = repeat(label, threads, seconds, || {
        one_round(run, &mut failed);
        steps
    });
    failed.map_or(Ok(timing), Err)
}

fn one_round(run: &mut dyn AnyRun, failed: &mut Option<TrainError>) {
    match run.round() {
        Ok(Ok(())) => {}
        Ok(Err(bad)) => *failed = Some(TrainError::config("bench", "finite numbers", bad.what)),
        Err(error) => *failed = Some(error),
    }
}
