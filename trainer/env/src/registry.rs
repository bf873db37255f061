//! From an id to an environment. A new environment is one line here.

use crate::{
    Env, EnvError, ExtraDims, TimeLimit,
    classic::{
        pendulum::Pendulum,
        toy_env::{ToyEnv, ToyOptions},
    },
    hybrid::{
        hard_move::HardMove,
        moving::{Motion, Moving},
    },
    task::{Task, TaskEnv},
};

/// What a caller may change about an environment; the defaults are the reference's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EnvOptions {
    /// Step limit instead of the default one; at least 1. Where the environment has its own, observed limit (Moving,
    /// Sliding, HardMove) this adds a truncating one.
    pub time_limit: Option<u32>,
    /// Number of action slots in -1..=1 to append that change nothing; default 0. Only with continuous actions alone.
    pub extra_dims: usize,
    /// ToyEnv's open points.
    pub toy: ToyOptions,
}

#[derive(Clone, Copy)]
enum Kind {
    Toy,
    Moving(Motion),
    HardMove(usize),
    Pendulum,
    Box2d,
    Mujoco,
}

const REGISTRY: [(&str, Kind); 26] = [
    ("toy-env", Kind::Toy),
    ("moving", Kind::Moving(Motion::Moving)),
    ("sliding", Kind::Moving(Motion::Sliding)),
    ("hard-move-4", Kind::HardMove(4)),
    ("hard-move-5", Kind::HardMove(5)),
    ("hard-move-6", Kind::HardMove(6)),
    ("hard-move-7", Kind::HardMove(7)),
    ("hard-move-8", Kind::HardMove(8)),
    ("hard-move-9", Kind::HardMove(9)),
    ("hard-move-10", Kind::HardMove(10)),
    ("pendulum", Kind::Pendulum),
    ("lunar-lander", Kind::Box2d),
    ("lunar-lander-continuous", Kind::Box2d),
    ("hopper-v4", Kind::Mujoco),
    ("hopper-v5", Kind::Mujoco),
    ("half-cheetah-v4", Kind::Mujoco),
    ("half-cheetah-v5", Kind::Mujoco),
    ("walker2d-v4", Kind::Mujoco),
    ("walker2d-v5", Kind::Mujoco),
    ("ant-v4", Kind::Mujoco),
    ("ant-v4-contact", Kind::Mujoco),
    ("ant-v5", Kind::Mujoco),
    ("humanoid-v4", Kind::Mujoco),
    ("humanoid-v5", Kind::Mujoco),
    ("inverted-pendulum-v4", Kind::Mujoco),
    ("inverted-pendulum-v5", Kind::Mujoco),
];

/// All ids, also of environments that this build leaves out.
pub fn ids() -> impl Iterator<Item = &'static str> {
    REGISTRY.iter().map(|(id, _)| *id)
}

/// Makes the environment of that registry id, its time limit included.
///
/// # Errors
/// [`EnvError::Unknown`] with the list of known ids (and the nearest one) where there is none;
/// [`EnvError::Feature`] where the build leaves it out; [`EnvError::Model`] where MuJoCo refuses its model.
pub fn make(id: &str) -> Result<Box<dyn Env>, EnvError> {
    make_with(id, &EnvOptions::default())
}

/// Like [`make`], with options.
///
/// # Errors
/// As [`make`], and [`EnvError::Option`] where an option does not fit.
pub fn make_with(id: &str, options: &EnvOptions) -> Result<Box<dyn Env>, EnvError> {
    let task = task(id, options.toy)?;
    let limit = options.time_limit.or(task.spec().time_limit);
    let mut env: Box<dyn Env> = Box::new(TaskEnv::new(task));
    if let Some(limit) = limit {
        if limit == 0 {
            let message = "expected at least 1, found 0".to_owned();
            return Err(EnvError::Option { id: id.to_owned(), option: "time_limit", message });
        }
        env = Box::new(TimeLimit::new(env, limit));
    }
    if options.extra_dims > 0 {
        env = Box::new(ExtraDims::new(env, options.extra_dims)?);
    }
    Ok(env)
}

/// The bare task, without a time limit.
pub(crate) fn task(id: &str, toy: ToyOptions) -> Result<Box<dyn Task>, EnvError> {
    match REGISTRY.iter().find(|(known, _)| *known == id) {
        Some((_, Kind::Toy)) => Ok(Box::new(ToyEnv::new(id, toy))),
        Some((_, Kind::Moving(motion))) => Ok(Box::new(Moving::new(id, *motion))),
        Some((_, Kind::HardMove(n))) => Ok(Box::new(HardMove::new(id, *n))),
        Some((_, Kind::Pendulum)) => Ok(Box::new(Pendulum::new(id))),
        Some((_, Kind::Box2d)) => box2d_task(id),
        Some((_, Kind::Mujoco)) => mujoco_task(id),
        None => Err(unknown(id)),
    }
}

#[cfg(feature = "box2d")]
fn box2d_task(id: &str) -> Result<Box<dyn Task>, EnvError> {
    use crate::lunar::lander::{Engines, LunarLander};
    match id {
        "lunar-lander" => Ok(Box::new(LunarLander::new(id, Engines::OneAtATime))),
        "lunar-lander-continuous" => Ok(Box::new(LunarLander::new(id, Engines::Continuous))),
        _ => Err(unknown(id)),
    }
}

#[cfg(not(feature = "box2d"))]
fn box2d_task(id: &str) -> Result<Box<dyn Task>, EnvError> {
    Err(EnvError::Feature { id: id.to_owned(), feature: "box2d" })
}

#[cfg(feature = "mujoco")]
fn mujoco_task(id: &str) -> Result<Box<dyn Task>, EnvError> {
    use crate::mujoco::{
        ant::{Ant, Contact},
        body::Version::{V4, V5},
        half_cheetah::HalfCheetah,
        hopper::Hopper,
        humanoid::Humanoid,
        inverted_pendulum::InvertedPendulum,
        walker2d::Walker2d,
    };
    Ok(match id {
        "hopper-v4" => Box::new(Hopper::task(id, V4)?),
        "hopper-v5" => Box::new(Hopper::task(id, V5)?),
        "half-cheetah-v4" | "half-cheetah-v5" => Box::new(HalfCheetah::task(id)?),
        "walker2d-v4" => Box::new(Walker2d::task(id, V4)?),
        "walker2d-v5" => Box::new(Walker2d::task(id, V5)?),
        "ant-v4" => Box::new(Ant::task(id, V4, Contact::Ignored)?),
        "ant-v4-contact" => Box::new(Ant::task(id, V4, Contact::AllBodies)?),
        "ant-v5" => Box::new(Ant::task(id, V5, Contact::ButWorld)?),
        "humanoid-v4" => Box::new(Humanoid::task(id, V4)?),
        "humanoid-v5" => Box::new(Humanoid::task(id, V5)?),
        "inverted-pendulum-v4" => Box::new(InvertedPendulum::task(id, V4)?),
        "inverted-pendulum-v5" => Box::new(InvertedPendulum::task(id, V5)?),
        _ => return Err(unknown(id)),
    })
}

#[cfg(not(feature = "mujoco"))]
fn mujoco_task(id: &str) -> Result<Box<dyn Task>, EnvError> {
    Err(EnvError::Feature { id: id.to_owned(), feature: "mujoco" })
}

/// Names the nearest id when it is near: a few letters wrong, a missing version, or another spelling.
fn unknown(id: &str) -> EnvError {
    let plain = |name: &str| name.to_lowercase().replace(['-', '_', ' '], "");
    let given = plain(id);
    let nearest = ids()
        .map(|known| (strsim::damerau_levenshtein(&given, &plain(known)), known))
        .min_by_key(|(distance, _)| *distance)
        .filter(|(distance, known)| *distance <= 2.max(known.len() / 3))
        .map(|(_, known)| known.to_owned());
    EnvError::Unknown { id: id.to_owned(), nearest, known: ids().collect::<Vec<_>>().join(", ") }
}
