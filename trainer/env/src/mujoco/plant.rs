//! The physics alone: one MuJoCo model and its state.

use std::{
    collections::BTreeMap,
    sync::{
        Arc, LazyLock, Mutex, Once, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
};

use mujoco_rs::{
    logging::set_log_handler,
    wrappers::{
        mj_data::MjData,
        mj_logging::{MjLogMessage, MjtLogLevel},
        mj_model::{MjModel, MjtDisableBit},
    },
};

use crate::{Disturbance, EnvError};

/// A model file, compiled into the program, so that nothing depends on the current folder.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ModelFile {
    /// File name in `assets`.
    pub(crate) name: &'static str,
    pub(crate) xml: &'static str,
}

macro_rules! models {
    ($($constant:ident = $file:literal;)*) => {
        $(pub(crate) const $constant: ModelFile =
            ModelFile { name: $file, xml: include_str!(concat!("../../assets/", $file)) };)*
        #[cfg(test)]
        const MODELS: &[ModelFile] = &[$($constant),*];
    };
}

models! {
    ANT = "ant.xml";
    HALF_CHEETAH = "half_cheetah.xml";
    HOPPER = "hopper.xml";
    HUMANOID = "humanoid.xml";
    INVERTED_PENDULUM = "inverted_pendulum.xml";
    WALKER2D_V4 = "walker2d.xml";
    WALKER2D_V5 = "walker2d_v5.xml";
}

static WARNINGS: AtomicU64 = AtomicU64::new(0);

/// Number of warnings that MuJoCo gave in this process, e.g. that a simulation became unstable and was reset.
pub fn warning_count() -> u64 {
    WARNINGS.load(Ordering::Relaxed)
}

/// Counts warnings (the default handler would print each and append it to `MUJOCO_LOG.TXT` in the current folder);
/// an error ends the process after this, so its text is printed.
fn on_message(message: &MjLogMessage) {
    match message.level() {
        MjtLogLevel::mjLOG_ERROR => eprintln!("MuJoCo error: {}", message.subject()),
        MjtLogLevel::mjLOG_WARNING => {
            WARNINGS.fetch_add(1, Ordering::Relaxed);
        }
        MjtLogLevel::mjLOG_DEBUG | MjtLogLevel::mjLOG_INFO => {}
    }
}

#[expect(unsafe_code, reason = "MuJoCo's only way to keep its warnings out of a file in the current folder")]
fn install_message_handler() {
    static INSTALLED: Once = Once::new();
    // SAFETY: the call must not overlap with another use of MuJoCo. All use in this crate begins with `load`, which
    // calls this first, and `Once` lets every caller wait until the handler is set.
    INSTALLED.call_once(|| unsafe { set_log_handler(on_message) });
}

/// The compiled model, shared by all environments that use it.
fn load(id: &str, file: ModelFile) -> Result<Arc<MjModel>, EnvError> {
    static MODELS: LazyLock<Mutex<BTreeMap<&'static str, Arc<MjModel>>>> = LazyLock::new(Mutex::default);
    install_message_handler();
    // A poisoned lock still holds a sound map: entries are inserted whole.
    let mut models = MODELS.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(model) = models.get(file.name) {
        return Ok(Arc::clone(model));
    }
    let mut model = MjModel::from_xml_string(file.xml)
        .map_err(|error| EnvError::Model { id: id.to_owned(), message: format!("{}: {error}", file.name) })?;
    skip_islands(&mut model);
    let model = Arc::new(model);
    models.insert(file.name, Arc::clone(&model));
    Ok(model)
}

/// A model of one kinematic tree is one island: looking for others at every step costs time and changes no bit.
fn skip_islands(model: &mut MjModel) {
    if model.ntree() == 1 {
        model.opt_mut().disableflags |= MjtDisableBit::mjDSBL_ISLAND as i32;
    }
}

/// The first body after the world: the trunk, or the cart.
const FIRST_BODY: usize = 1;

/// What differs from the model file.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Changes {
    mass: f64,
    friction: f64,
    gravity: f64,
}

impl Changes {
    const NONE: Self = Self { mass: 1.0, friction: 1.0, gravity: 1.0 };

    /// A copy of `model` with these changes and everything that MuJoCo derives from them.
    fn of(self, model: &MjModel) -> MjModel {
        let mut model = model.clone();
        model.body_mass_mut().iter_mut().for_each(|m| *m *= self.mass);
        model.body_inertia_mut().iter_mut().flatten().for_each(|i| *i *= self.mass);
        model.geom_friction_mut().iter_mut().flatten().for_each(|f| *f *= self.friction);
        model.opt_mut().gravity.iter_mut().for_each(|g| *g *= self.gravity);
        let mut data = MjData::new(Box::new(model));
        data.set_const();
        data.model().clone()
    }
}

/// One simulated body.
pub(crate) struct Plant {
    pub(crate) data: MjData<Arc<MjModel>>,
    frame_skip: usize,
    /// The model of the file, where the one in use differs from it.
    original: Option<Arc<MjModel>>,
    changes: Changes,
    push_n: [f64; 3],
}

impl Plant {
    /// Loads the model; `frame_skip` internal steps make one control period.
    pub(crate) fn new(id: &str, file: ModelFile, frame_skip: usize) -> Result<Self, EnvError> {
        let data = MjData::try_new(load(id, file)?)
            .map_err(|error| EnvError::Model { id: id.to_owned(), message: format!("{}: {error}", file.name) })?;
        Ok(Self { data, frame_skip, original: None, changes: Changes::NONE, push_n: [0.0; 3] })
    }

    /// Changes the body from the next step on; see [`Disturbance`].
    pub(crate) fn disturb(&mut self, id: &str, disturbance: Disturbance) -> Result<(), EnvError> {
        let mut changes = self.changes;
        match disturbance {
            Disturbance::Mass { factor } => changes.mass = factor,
            Disturbance::Friction { factor } => changes.friction = factor,
            Disturbance::Gravity { factor } => changes.gravity = factor,
            Disturbance::Push { force_n } => self.push_n = force_n,
        }
        if changes == self.changes {
            return Ok(());
        }
        let original = self.original.take();
        let back = changes == Changes::NONE;
        let model = match &original {
            Some(file) if back => Arc::clone(file),
            Some(file) => Arc::new(changes.of(file)),
            None => Arc::new(changes.of(self.data.model())),
        };
        let before = self
            .data
            .try_swap_model(model)
            .map_err(|error| EnvError::Disturbance { id: id.to_owned(), message: error.to_string() })?;
        self.original = if back { None } else { Some(original.unwrap_or(before)) };
        self.changes = changes;
        Ok(())
    }

    /// Control period, s.
    pub(crate) fn dt(&self) -> f64 {
        self.data.model().opt().timestep * self.frame_skip as f64
    }

    pub(crate) fn nq(&self) -> usize {
        self.data.qpos().len()
    }

    pub(crate) fn nv(&self) -> usize {
        self.data.qvel().len()
    }

    /// Initial positions of the model.
    pub(crate) fn initial_qpos(&self) -> &[f64] {
        self.data.model().qpos0()
    }

    /// Starts from a position and velocity; everything derived from them is computed.
    pub(crate) fn place(&mut self, qpos: &[f64], qvel: &[f64], qacc_warmstart: &[f64]) {
        self.data.reset();
        self.data.qpos_mut().copy_from_slice(qpos);
        self.data.qvel_mut().copy_from_slice(qvel);
        self.data.forward();
        self.data.qacc_warmstart_mut().copy_from_slice(qacc_warmstart);
    }

    /// One control period. Body positions and contact forces stay as the last internal step computed them, before its
    /// integration: that is what the reference's rewards and observations read.
    pub(crate) fn step(&mut self, ctrl: &[f64]) {
        self.data.ctrl_mut().copy_from_slice(ctrl);
        if let Some(applied) = self.data.xfrc_applied_mut().get_mut(FIRST_BODY) {
            applied[..3].copy_from_slice(&self.push_n);
        }
        for _ in 0..self.frame_skip {
            self.data.step();
        }
        self.data.rne_post_constraint();
    }

    /// Appends what a later [`load_state`](Self::load_state) needs to go on, bit for bit.
    pub(crate) fn save_state(&self, out: &mut Vec<f64>) {
        out.extend_from_slice(self.data.qpos());
        out.extend_from_slice(self.data.qvel());
        out.extend_from_slice(self.data.qacc_warmstart());
        out.push(self.data.time());
    }

    /// Length of what [`save_state`](Self::save_state) appends.
    pub(crate) fn state_len(&self) -> usize {
        self.nq() + 2 * self.nv() + 1
    }

    /// Takes over what [`save_state`](Self::save_state) gave.
    pub(crate) fn load_state(&mut self, state: &[f64]) {
        let (nq, nv) = (self.nq(), self.nv());
        self.data.reset();
        self.data.qpos_mut().copy_from_slice(&state[..nq]);
        self.data.qvel_mut().copy_from_slice(&state[nq..nq + nv]);
        self.data.qacc_warmstart_mut().copy_from_slice(&state[nq + nv..nq + 2 * nv]);
        self.data.set_time(state[nq + 2 * nv]);
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// Everything that an observation or a reward reads of the engine, and where it goes on from.
    fn bits(data: &MjData<Box<MjModel>>) -> Vec<u64> {
        let forces = data.cfrc_ext().as_flattened().iter().chain(data.cinert().as_flattened());
        let state = data.qpos().iter().chain(data.qvel()).chain(data.qacc_warmstart()).chain(data.qfrc_actuator());
        state.chain(forces).map(|x| x.to_bits()).collect()
    }

    #[test]
    fn a_single_tree_moves_the_same_without_a_search_for_islands() {
        install_message_handler();
        for file in MODELS {
            let searched = MjModel::from_xml_string(file.xml).unwrap();
            let mut skipped = searched.clone();
            skip_islands(&mut skipped);
            assert_ne!(skipped.opt().disableflags, searched.opt().disableflags, "{}", file.name);
            let mut both = [searched, skipped].map(|model| MjData::new(Box::new(model)));
            let mut rng = ChaCha8Rng::seed_from_u64(7);
            let mut contacts = 0;
            for step in 0..1_000 {
                let ctrl: Vec<f64> = both[0].ctrl().iter().map(|_| rng.random_range(-1.0..1.0)).collect();
                for data in &mut both {
                    if step % 200 == 0 {
                        data.reset();
                    }
                    data.ctrl_mut().copy_from_slice(&ctrl);
                    data.step();
                    data.rne_post_constraint();
                }
                contacts += both[0].ncon();
                assert_eq!(bits(&both[0]), bits(&both[1]), "{} at step {step}", file.name);
            }
            assert!(contacts > 0 || file.name == INVERTED_PENDULUM.name, "{} never touched anything", file.name);
        }
    }
}
