//! The paper's online figures as data: environments × variants, each a training configuration.
//!
//! A run starts from the configuration that comes with the program for its algorithm and environment (`trainer/configs`), else
//! from the documented defaults; what stands here is only what a figure changes. Runs that two figures share (GADM+DQN on
//! HalfCheetah, say) are the same run.

use super::state::ASSUMED_STEPS_PER_S;
use super::toy;

/// A figure: what is compared, on what.
#[derive(Debug)]
pub struct Figure {
    /// Name on the command line.
    pub id: &'static str,
    /// Heading of figure and table.
    pub title: &'static str,
    /// What the paper's figure of that number shows, or what this one is for.
    pub about: &'static str,
    /// Panels, in order.
    pub tasks: &'static [Task],
    /// Curves of every panel, in order.
    pub variants: &'static [Variant],
    /// Environment steps of a run unless `--steps` says otherwise.
    pub steps: u64,
    /// Seeds unless `--seeds` says otherwise: 0 to `seeds - 1`.
    pub seeds: u64,
    /// Whether returns of all panels have one scale, so that a row over all of them means something.
    pub one_scale: bool,
    /// Where the variants that need recorded actions get them.
    pub data: Option<Source>,
    /// What is drawn of the runs.
    pub view: View,
}

impl Figure {
    /// The run whose policy gives actions to others.
    pub fn expert(&self) -> Option<&Expert> {
        match &self.data {
            Some(Source::Expert(expert)) => Some(expert),
            _ => None,
        }
    }
}

/// Recorded actions.
#[derive(Debug)]
pub enum Source {
    /// Those of a trained policy.
    Expert(Expert),
    /// ToyDataset: uniform draws from a square of each state, with the seed of the run.
    Toy {
        /// Actions of a state.
        per_state: usize,
    },
}

/// What is drawn of the runs of a figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum View {
    /// Returns over environment steps.
    Returns,
    /// The same, and the share of no-ops of LunarLander's snapshots.
    NoOps,
    /// Where LunarLander's snapshots fly.
    Paths,
    /// The latents of LunarLander in one state.
    Landing,
    /// The latents of ToyEnv in a state, 0 to 3.
    Toy {
        /// The state.
        state: usize,
    },
}

/// An environment, with how its runs are tracked; none of it changes what is learned.
#[derive(Debug)]
pub struct Task {
    /// Environment id.
    pub env: &'static str,
    /// Title of the panel.
    pub label: &'static str,
    /// Environment steps between evaluations.
    pub eval_every: u64,
    /// Episodes of an evaluation.
    pub eval_episodes: usize,
    /// Environment steps between checkpoints, which is what a killed run loses at most.
    pub checkpoint_every: u64,
    /// Environment steps at which the networks are kept, for figures of how a policy came to be; those beyond a run's end never come.
    pub snapshots: &'static [u64],
    /// Environment steps per second that a cost is reckoned with where nothing has been measured.
    pub assumed_steps_per_s: f64,
}

/// A way to learn.
#[derive(Debug)]
pub struct Variant {
    /// Name in paths and tables.
    pub id: &'static str,
    /// Name in the legend.
    pub label: &'static str,
    /// Algorithm (`gadm train --algo`).
    pub algo: &'static str,
    /// What it changes, as `--set` takes it.
    pub settings: &'static [&'static str],
    /// The setting that takes the file with an expert's actions, where it needs one.
    pub data: Option<&'static str>,
}

/// A run whose policy gives actions to others.
#[derive(Debug)]
pub struct Expert {
    /// Who learns, with seed 0 in the figure's first environment.
    pub variant: &'static Variant,
    /// Environment steps that it trains at least, whatever `--steps` says of the others.
    pub steps: u64,
    /// Episodes that its best policy plays.
    pub episodes: usize,
    /// How many of them are kept, those of the highest return.
    pub keep: usize,
}

const fn task(env: &'static str, label: &'static str) -> Task {
    Task {
        env,
        label,
        eval_every: 25_000,
        eval_episodes: 10,
        checkpoint_every: 50_000,
        snapshots: &[],
        assumed_steps_per_s: ASSUMED_STEPS_PER_S,
    }
}

/// A success rate of 10 episodes has steps of 10 %: 50 of these short ones cost less than 10 of a MuJoCo body.
const fn hybrid(env: &'static str, label: &'static str) -> Task {
    Task { eval_episodes: 50, ..task(env, label) }
}

/// A checkpoint with a full replay buffer has gigabytes there.
const fn wide(env: &'static str, label: &'static str) -> Task {
    Task { checkpoint_every: 250_000, ..task(env, label) }
}

const fn variant(
    id: &'static str,
    label: &'static str,
    algo: &'static str,
    settings: &'static [&'static str],
) -> Variant {
    Variant { id, label, algo, settings, data: None }
}

/// Snapshots: specification 8.7.
const LANDER: Task = Task {
    snapshots: &[0, 100_000, 200_000, 500_000, 1_000_000, 3_000_000],
    ..task("lunar-lander-continuous", "LunarLanderContinuous")
};

/// Nothing is learned after the warm-up: one step ends the run.
const TOY_TASK: Task = Task { eval_every: 1, eval_episodes: 1, assumed_steps_per_s: 0.02, ..task("toy-env", "ToyEnv") };

const GADM: Variant = variant("gadm-dqn", "GADM+DQN", "gadm-dqn", &[]);
const TD3: Variant = variant("td3", "TD3", "td3", &[]);
const DQN_MANUAL: Variant = variant("dqn-manual", "DQN, 3 bins a dimension", "dqn-manual", &[]);
const EXPERT_UPDATES: &[&str] = &["warmup.updates=10_500"];

/// GADM on a fixed set of ToyEnv's actions, with a focal exponent.
macro_rules! toy {
    ($gamma:literal) => {
        Variant {
            data: Some("warmup.data"),
            ..variant(
                concat!("gadm-focal", $gamma),
                concat!("γ_f = ", $gamma),
                "gadm-dqn",
                &[
                    "action_model.latents=4",
                    // A quarter of the specification's "ample" width, for a tenth of the time: four states are few.
                    "action_model.hidden=64",
                    "confidence.hidden=[64, 64]",
                    // With the defaults (product, 0.25, 3e-4) every state gets one latent, and no exponent makes a difference.
                    "action_model.fusion=\"film-state-to-latent\"",
                    "action_model.commitment=0.01",
                    "action_model.adam.learning_rate=3e-3",
                    "warmup.updates=5_000",
                    concat!("confidence.focal_gamma=", $gamma, ".0"),
                    "collect.envs=1",
                    "collect.steps_per_round=1",
                    "round.action_updates=0",
                    "round.confidence_updates=0",
                    "round.q_updates=0",
                    "replay.ar_capacity=20_000",
                    "replay.rl_capacity=512",
                ],
            )
        }
    };
}

/// What the figures of ToyEnv share.
const TOY: Figure = Figure {
    id: "",
    title: "",
    about: "",
    tasks: &[TOY_TASK],
    variants: &[toy!("0"), toy!("1"), toy!("2"), toy!("5"), toy!("10"), toy!("50")],
    steps: 1,
    seeds: 3,
    one_scale: false,
    data: Some(Source::Toy { per_state: toy::PER_STATE }),
    view: View::Toy { state: 0 },
};

/// What the figures of LunarLander share.
const LUNAR: Figure = Figure {
    id: "",
    title: "",
    about: "",
    tasks: &[LANDER],
    variants: &[
        TD3,
        GADM,
        Variant {
            data: Some("dqn_cluster.data"),
            ..variant("dqn-cluster", "DQN on an expert's clusters", "dqn-cluster", &[])
        },
    ],
    steps: 500_000,
    seeds: 3,
    one_scale: false,
    data: Some(Source::Expert(Expert { variant: &TD3, steps: 500_000, episodes: 20, keep: 20 })),
    view: View::NoOps,
};

/// Every figure there is.
pub const FIGURES: &[Figure] = &[
    Figure {
        id: "fig4",
        title: "Hybrid actions",
        about: "GADM+DQN against MPDQN and HPPO on Moving, Sliding and HardMove n=10 (the paper: 10 seeds × 3M steps, and GoBigger, which is not here)",
        tasks: &[hybrid("moving", "Moving"), hybrid("sliding", "Sliding"), hybrid("hard-move-10", "HardMove n=10")],
        variants: &[GADM, variant("mpdqn", "MPDQN", "mpdqn", &[]), variant("hppo", "HPPO", "hppo", &[])],
        steps: 1_000_000,
        seeds: 5,
        one_scale: true,
        data: None,
        view: View::Returns,
    },
    Figure {
        id: "fig5",
        title: "Without remapping, without warm-up",
        about: "ablations on HardMove n=10 and HalfCheetah: latents as chosen when the transition was collected, and no pre-training of the action model",
        tasks: &[hybrid("hard-move-10", "HardMove n=10"), task("half-cheetah-v5", "HalfCheetah-v5")],
        variants: &[
            GADM,
            variant(
                "gadm-dqn-no-remap",
                "without remapping",
                "gadm-dqn",
                &["round.remap=false", "explore.random=\"latent\""],
            ),
            variant("gadm-dqn-no-warmup", "without warm-up", "gadm-dqn", &["warmup.enabled=false"]),
        ],
        steps: 500_000,
        seeds: 3,
        one_scale: false,
        data: None,
        view: View::Returns,
    },
    Figure {
        id: "fig9",
        title: "Continuous actions",
        about: "GADM+DQN against TD3 and DQN on hand-made bins on Hopper, HalfCheetah, Ant and Humanoid (the paper: 10 seeds × 3M steps, v3 of the bodies)",
        tasks: &[
            task("hopper-v5", "Hopper-v5"),
            task("half-cheetah-v5", "HalfCheetah-v5"),
            wide("ant-v5", "Ant-v5"),
            wide("humanoid-v5", "Humanoid-v5"),
        ],
        variants: &[GADM, TD3, DQN_MANUAL],
        steps: 1_000_000,
        seeds: 2,
        one_scale: false,
        data: None,
        view: View::Returns,
    },
    Figure {
        id: "fig10",
        title: "Expert warm-up",
        about: "Hopper: the action model pre-trained on an expert's actions, with and without E.A.R. (extreme action regression), beside the random warm-up",
        tasks: &[task("hopper-v5", "Hopper-v5")],
        variants: &[
            GADM,
            Variant {
                data: Some("warmup.data"),
                ..variant("gadm-dqn-expert", "expert warm-up", "gadm-dqn", EXPERT_UPDATES)
            },
            Variant {
                data: Some("warmup.data"),
                ..variant(
                    "gadm-dqn-expert-no-ear",
                    "expert warm-up, without E.A.R.",
                    "gadm-dqn",
                    &["warmup.updates=10_500", "action_model.head={ kind = \"tanh\" }"],
                )
            },
        ],
        steps: 500_000,
        seeds: 3,
        one_scale: false,
        // The paper keeps those of 1,000 episodes that return more than 3,500: about 270 by their number of transitions.
        data: Some(Source::Expert(Expert { variant: &TD3, steps: 1_000_000, episodes: 1_000, keep: 270 })),
        view: View::Returns,
    },
    Figure {
        id: "fig11",
        title: "Extreme noise and extreme action regression",
        about: "HalfCheetah: extreme against Gaussian noise on the executed action, with and without E.A.R.",
        tasks: &[task("half-cheetah-v5", "HalfCheetah-v5")],
        variants: &[
            Variant { label: "extreme noise, E.A.R.", ..GADM },
            variant(
                "gadm-dqn-gaussian",
                "Gaussian noise, E.A.R.",
                "gadm-dqn",
                &["explore.extreme_noise=0.0", "explore.gaussian_noise=0.1"],
            ),
            variant(
                "gadm-dqn-no-ear",
                "extreme noise, without E.A.R.",
                "gadm-dqn",
                &["action_model.head={ kind = \"tanh\" }"],
            ),
        ],
        steps: 500_000,
        seeds: 3,
        one_scale: false,
        data: None,
        view: View::Returns,
    },
    Figure {
        id: "fig12",
        title: "Latents of ToyEnv, state 1",
        about: "which actions share a latent, where latents decode to, and the confidence in each by the focal exponent; the training is the warm-up on 5,000 actions a state, so steps do not count",
        view: View::Toy { state: 0 },
        ..TOY
    },
    Figure {
        id: "fig13",
        title: "Latents of ToyEnv, state 2",
        about: "the same runs in another state",
        view: View::Toy { state: 1 },
        ..TOY
    },
    Figure {
        id: "fig14",
        title: "LunarLander",
        about: "GADM+DQN, TD3, and DQN on the cluster centres of an expert's actions on LunarLanderContinuous: returns, and the share of steps without any engine",
        view: View::NoOps,
        ..LUNAR
    },
    Figure {
        id: "fig15",
        title: "Landing paths",
        about: "where the policies of figure 14 fly on their way, seed 0 of each, coloured by the episode's return",
        seeds: 1,
        view: View::Paths,
        ..LUNAR
    },
    Figure {
        id: "fig16",
        title: "Latents of LunarLander before it lands",
        about: "a state of the best GADM+DQN run of figure 14: the frame, which actions share a latent, and what latents decode to",
        variants: &[GADM],
        data: None,
        view: View::Landing,
        ..LUNAR
    },
    Figure {
        id: "demo",
        title: "Pendulum",
        about: "no figure of the paper: small networks on Pendulum, to try this command in a few minutes",
        tasks: &[Task { eval_every: 1_000, eval_episodes: 5, checkpoint_every: 1_000, ..task("pendulum", "Pendulum") }],
        variants: &[
            variant("gadm-dqn-small", "GADM+DQN", "gadm-dqn", SMALL_GADM),
            SMALL_TD3_VARIANT,
            Variant {
                data: Some("dqn_cluster.data"),
                ..variant("dqn-cluster-small", "DQN on an expert's clusters", "dqn-cluster", SMALL_CLUSTER)
            },
        ],
        steps: 10_000,
        seeds: 2,
        one_scale: false,
        data: Some(Source::Expert(Expert { variant: &SMALL_TD3_VARIANT, steps: 4_000, episodes: 10, keep: 5 })),
        view: View::Returns,
    },
];

const SMALL_GADM: &[&str] = &[
    "collect.steps_per_round=64",
    "warmup.steps=500",
    "warmup.updates=200",
    "warmup.confidence_updates=100",
    "round.batch=64",
    "round.action_updates=4",
    "round.confidence_updates=2",
    "round.q_updates=20",
    "explore.epsilon_decay=2_000.0",
    "replay.rl_capacity=20_000",
    "replay.ar_capacity=20_000",
    "action_model.latents=16",
    "action_model.hidden=32",
    "confidence.hidden=[32]",
    "confidence.start_after=100",
    "dqn.hidden=[64, 64]",
    "dqn.heads=4",
    "dqn.target={ kind = \"soft\", tau = 0.01 }",
    "dqn.adam.learning_rate=1e-3",
];

const SMALL_TD3: &[&str] =
    &["td3.hidden=[64, 64]", "td3.schedule.batch=64", "td3.schedule.random_steps=500", "td3.schedule.capacity=20_000"];

const SMALL_TD3_VARIANT: Variant = variant("td3-small", "TD3", "td3", SMALL_TD3);

const SMALL_CLUSTER: &[&str] = &[
    "dqn_cluster.clusters=8",
    "dqn_cluster.schedule.steps_per_round=64",
    "dqn_cluster.schedule.batch=64",
    "dqn_cluster.schedule.capacity=20_000",
    "dqn_cluster.epsilon.decay=2_000.0",
    "dqn_cluster.dqn.hidden=[64, 64]",
];

/// The figure of that name.
pub fn figure(id: &str) -> Option<&'static Figure> {
    FIGURES.iter().find(|figure| figure.id == id)
}
