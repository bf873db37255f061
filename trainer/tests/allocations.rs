//! The update loop allocates nothing once it is warm: drawing a batch, encoding, masking, and the step of every network. What is
//! left is candle's: each write into a `Var` (three networks and a target) checks its layout in a short list.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use gadm_trainer::action_space::{ActionSpace, ContinuousHead, SnapRule};
use gadm_trainer::algo::dqn::{Dqn, DqnConfig};
use gadm_trainer::discretizer::gadm::{ActionModel, ActionModelConfig, Confidence, ConfidenceConfig};
use gadm_trainer::nn::parallel;
use gadm_trainer::replay::{ActionBuffer, RlBatch, RlBuffer, Transition};
use gadm_trainer::seed::SeedTree;
use rand::RngExt as _;

const OBS: usize = 10;

/// One update of everything, as a round of Algorithm 1 does them.
struct Loop {
    model: ActionModel,
    confidence: Confidence,
    dqn: Dqn,
    pairs: ActionBuffer,
    transitions: RlBuffer,
    batch: RlBatch,
    obs: Vec<f32>,
    actions: Vec<f32>,
    codes: Vec<u32>,
    scores: Vec<f32>,
    allowed: Vec<bool>,
    rng: gadm_trainer::seed::Rng,
}

impl Loop {
    fn new(rows: usize) -> Self {
        let mut rng = SeedTree::new(3).stream("loop");
        let head = ContinuousHead::Categorical { atoms: 11, snap: SnapRule::Edges };
        let config = ActionModelConfig { latents: 16, hidden: 32, head, ..Default::default() };
        let space = ActionSpace::new(gadm_envs::make("moving").unwrap().spec(), head, true);
        let slots = space.slots();
        let (mut pairs, mut transitions) = (ActionBuffer::new(64, OBS, slots), RlBuffer::new(64, OBS, slots));
        for _ in 0..100 {
            let mut action = vec![0.0; slots];
            space.random(&mut rng, &mut action);
            let mut draw = || (0..OBS).map(|_| rng.random_range(-1.0_f32..1.0)).collect::<Vec<_>>();
            let (obs, next_obs) = (draw(), draw());
            pairs.push(&obs, &action);
            transitions.push(&Transition { obs, action, code: 1, ret: 0.5, bootstrap: 0.9, next_obs });
        }
        let dqn = DqnConfig { hidden: vec![32, 16], heads: 3, ..Default::default() };
        let confidence = ConfidenceConfig { hidden: vec![32], ..Default::default() };
        Self {
            model: ActionModel::new(config, OBS, space, rows, &mut rng).unwrap(),
            confidence: Confidence::new(confidence, OBS, 16, rows, &mut rng).unwrap(),
            dqn: Dqn::new(dqn, OBS, 16, rows, &mut rng).unwrap(),
            pairs,
            transitions,
            batch: RlBatch::default(),
            obs: Vec::new(),
            actions: Vec::new(),
            codes: Vec::new(),
            scores: Vec::new(),
            allowed: Vec::new(),
            rng,
        }
    }

    fn once(&mut self, rows: usize) {
        self.pairs.sample(rows, &mut self.rng, &mut self.obs, &mut self.actions);
        self.model.update(&self.obs, &self.actions);
        self.model.encode(&self.obs, &self.actions, &mut self.codes);
        self.confidence.update(&self.obs, &self.codes);
        self.transitions.sample(rows, &mut self.rng, &mut self.batch);
        self.model.encode(&self.batch.obs, &self.batch.actions, &mut self.codes);
        self.confidence.masks(&self.batch.next_obs, rows, &mut self.scores, &mut self.allowed);
        self.dqn.update(&self.batch, &self.codes, &self.allowed);
    }
}

/// Writes into candle variables per [`Loop::once`], and the size of candle's list.
const WRITES: u64 = 4;
const LIST_BYTES: u64 = 64;

/// Allocations and bytes beyond candle's, in each of two stretches of twenty updates.
fn allocations(rows: usize) -> [(u64, u64); 2] {
    let mut work = Loop::new(rows);
    (0..3).for_each(|_| work.once(rows));
    [(); 2].map(|()| {
        let counted = allocation_counter::measure(|| (0..20).for_each(|_| work.once(rows)));
        (counted.count_total - 20 * WRITES, counted.bytes_total - 20 * WRITES * LIST_BYTES)
    })
}

#[test]
fn updates_allocate_nothing_in_one_part_or_two() {
    assert_eq!((allocations(32), allocations(200)), ([(0, 0); 2], [(0, 0); 2]));
}

#[test]
fn updates_shared_with_another_thread_allocate_nothing_on_the_calling_one() {
    // A thread of its own, since it keeps its worker.
    let counted = std::thread::spawn(|| {
        assert!(parallel::start(2));
        allocations(200)
    });
    // The first time that a thread of rayon looks into another's queue, at a moment of its own, it registers with the memory
    // reclamation of `crossbeam-epoch`: one allocation in a thread's life, so it can be in one stretch and not in both.
    let stretches = counted.join().unwrap();
    assert!(stretches.contains(&(0, 0)), "{stretches:?}");
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let run = || {
        let mut work = Loop::new(300);
        (0..10).for_each(|_| work.once(300));
        let bits = |p: &gadm_trainer::nn::Params| p.with(|p| p.iter().map(|v| v.to_bits()).collect::<Vec<_>>());
        [bits(&work.model.params), bits(&work.confidence.params), bits(&work.dqn.params), bits(&work.dqn.target)]
    };
    let alone = run();
    let shared = std::thread::spawn(move || {
        assert!(parallel::start(2));
        run()
    });
    assert!(shared.join().unwrap() == alone, "two threads give other weights than one");
}
