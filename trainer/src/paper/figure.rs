//! The paper's online figures as data: environments × variants, each a training configuration.
//!
//! A run starts from the configuration that comes with the program for its algorithm and environment (`trainer/configs`), else
//! from the documented defaults; what stands here is only what a figure changes. Runs that two figures share (GADM+DQN on
//! HalfCheetah, say) are the same run.

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
    /// Who gives the recorded actions to the variants that need some.
    pub expert: Option<Expert>,
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
    Task { env, label, eval_every: 25_000, eval_episodes: 10, checkpoint_every: 50_000, snapshots: &[] }
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
const GADM: Variant = variant("gadm-dqn", "GADM+DQN", "gadm-dqn", &[]);
const TD3: Variant = variant("td3", "TD3", "td3", &[]);
const DQN_MANUAL: Variant = variant("dqn-manual", "DQN, 3 bins a dimension", "dqn-manual", &[]);
const EXPERT_UPDATES: &[&str] = &["warmup.updates=10_500"];

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
        expert: None,
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
        expert: None,
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
        expert: None,
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
        expert: Some(Expert { variant: &TD3, steps: 1_000_000, episodes: 1_000, keep: 270 }),
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
        expert: None,
    },
    Figure {
        id: "fig14",
        title: "LunarLander",
        about: "returns of GADM+DQN, TD3, and DQN on the cluster centres of an expert's actions on LunarLanderContinuous (the share of no-ops is not drawn)",
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
        expert: Some(Expert { variant: &TD3, steps: 500_000, episodes: 20, keep: 20 }),
    },
    Figure {
        id: "demo",
        title: "Pendulum",
        about: "no figure of the paper: small networks on Pendulum, to try this command in a few minutes",
        tasks: &[Task {
            env: "pendulum",
            label: "Pendulum",
            eval_every: 1_000,
            eval_episodes: 5,
            checkpoint_every: 1_000,
            snapshots: &[],
        }],
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
        expert: Some(Expert { variant: &SMALL_TD3_VARIANT, steps: 4_000, episodes: 10, keep: 5 }),
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
