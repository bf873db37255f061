//! Small runs that end within a second, and what a test reads of their folders.
#![allow(dead_code, reason = "every test binary uses its own part")]
#![allow(clippy::unwrap_used, reason = "tests")]
#![allow(clippy::result_large_err, reason = "the library's error")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use gadm_trainer::TrainError;
use gadm_trainer::algo::dqn::TargetUpdate;
use gadm_trainer::config::TrainConfig;
use gadm_trainer::nn::Engine;
use gadm_trainer::runner::progress::Style;
use gadm_trainer::runner::{Outcome, TrainOptions, checkpoint, new_run, train};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};

/// Every part of the algorithm with a few hundred updates; both buffers wrap around.
pub fn small(env: &str) -> TrainConfig {
    let mut c = TrainConfig { env: env.to_owned(), seed: 3, steps: 1024, ..TrainConfig::default() };
    (c.collect.envs, c.collect.steps_per_round) = (4, 32);
    (c.warmup.steps, c.warmup.updates, c.warmup.confidence_updates) = (256, 100, 100);
    (c.round.action_updates, c.round.confidence_updates, c.round.q_updates, c.round.batch) = (3, 2, 4, 32);
    (c.replay.rl_capacity, c.replay.ar_capacity) = (500, 700);
    (c.action_model.latents, c.action_model.hidden) = (8, 16);
    (c.confidence.hidden, c.confidence.start_after) = (vec![16], 64);
    (c.dqn.hidden, c.dqn.heads, c.dqn.target) = (vec![16, 16], 3, TargetUpdate::Hard { every: 7 });
    c.explore.extreme_noise = 0.1;
    (c.track.log_every, c.track.eval_every, c.track.eval_episodes, c.track.checkpoint_every) = (128, 256, 2, 0);
    c
}

static GO: AtomicBool = AtomicBool::new(false);

pub fn options<'a>(dir: &Path, config: Option<&TrainConfig>, resume: bool, stop: &'a AtomicBool) -> TrainOptions<'a> {
    TrainOptions { config: config.cloned(), dir: dir.to_path_buf(), resume, style: Style::Quiet, stop }
}

/// A run from the start to its end.
pub fn start(dir: &Path, config: &TrainConfig) -> Result<Outcome, TrainError> {
    train(&options(dir, Some(config), false, &GO))
}

/// A run continued to its end.
pub fn resume(dir: &Path, config: Option<&TrainConfig>) -> Result<Outcome, TrainError> {
    train(&options(dir, config, true, &GO))
}

/// A run that is stopped before its first round.
pub fn start_and_stop(dir: &Path, config: &TrainConfig) -> Outcome {
    train(&options(dir, Some(config), false, &AtomicBool::new(true))).unwrap()
}

pub fn metrics(dir: &Path) -> String {
    std::fs::read_to_string(dir.join("metrics.jsonl")).unwrap()
}

pub fn last(dir: &Path) -> PathBuf {
    checkpoint::path(dir, checkpoint::LAST)
}

/// Arrays by name as shape and bits.
pub type Arrays = BTreeMap<String, (Vec<usize>, Vec<u32>)>;

/// The arrays of a safetensors file, and the text that the program put into its header.
pub fn arrays(path: &Path) -> (Arrays, String) {
    let bytes = std::fs::read(path).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let bits = |data: &[u8]| data.chunks_exact(4).map(|c| u32::from_le_bytes([c[0], c[1], c[2], c[3]])).collect();
    let arrays = file.tensors().into_iter().map(|(name, v)| (name, (v.shape().to_vec(), bits(v.data())))).collect();
    let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
    let state = header.metadata().as_ref().and_then(|m| m.get("gadm")).cloned().unwrap_or_default();
    (arrays, state)
}

/// Asserts that two run folders hold the same run: metrics byte for byte, newest checkpoint bit for bit.
pub fn assert_same_run(a: &Path, b: &Path) {
    assert_eq!(metrics(a), metrics(b), "metrics.jsonl");
    assert!(metrics(a).lines().count() > 3, "there is something to compare");
    let ((left, left_state), (right, right_state)) = (arrays(&last(a)), arrays(&last(b)));
    assert_eq!(left.keys().collect::<Vec<_>>(), right.keys().collect::<Vec<_>>());
    for (name, array) in &left {
        assert!(*array == right[name], "array `{name}` differs");
    }
    assert_eq!(left_state, right_state, "counters, random streams, environments");
}

/// Asserts that the run does the same whether the fused layers evaluate its networks or candle: first moments of the optimisers after
/// the first update of each network, up to rounding.
pub fn assert_same_update(config: &TrainConfig) {
    let moments = |engine: Engine| {
        let dir = tempfile::tempdir().unwrap();
        engine.start().unwrap();
        let mut run = new_run(config.clone()).unwrap();
        Engine::Fused.start().unwrap();
        run.prepare().unwrap();
        while run.counters().q_updates == 0 {
            run.round().unwrap().unwrap();
        }
        std::fs::create_dir_all(last(dir.path()).parent().unwrap()).unwrap();
        run.save(dir.path()).unwrap();
        let (arrays, _) = arrays(&last(dir.path()));
        let moments = arrays.into_iter().filter(|(name, _)| name.ends_with("adam.m"));
        moments.map(|(name, (_, bits))| (name, bits.into_iter().map(f32::from_bits).collect())).collect()
    };
    let [fused, candle]: [BTreeMap<String, Vec<f32>>; 2] = [Engine::Fused, Engine::Candle].map(moments);
    assert!(!fused.is_empty() && fused.keys().eq(candle.keys()));
    for (name, fused) in &fused {
        let largest = fused.iter().fold(0.0_f32, |m, v| m.max(v.abs()));
        let apart = fused.iter().zip(&candle[name]).fold(0.0_f32, |m, (a, b)| m.max((a - b).abs()));
        assert!(largest > 0.0, "{name}: nothing was learnt");
        assert!(apart <= 1e-5 * largest, "{} {name}: apart by {apart}, largest {largest}", config.algo.name().id());
    }
}

/// Writes a safetensors file of f32 arrays.
pub fn write_arrays(path: &Path, arrays: &[(&str, &[usize], &[f32])]) {
    let bytes: Vec<Vec<u8>> = arrays.iter().map(|(_, _, v)| v.iter().flat_map(|x| x.to_le_bytes()).collect()).collect();
    let views = arrays
        .iter()
        .zip(&bytes)
        .map(|((name, shape, _), bytes)| (*name, TensorView::new(Dtype::F32, shape.to_vec(), bytes).unwrap()));
    std::fs::write(path, safetensors::serialize(views, None).unwrap()).unwrap();
}
