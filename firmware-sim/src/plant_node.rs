//! A plant as CAN participant: starts each control period, sends its sensors, applies the actions it receives.

use gadm_envs::{Env, Step};
use gadm_node::assemble::{Assembler, Pushed};
use gadm_node::codec::{Decision, FrameError, Layout};
use gadm_node::protocol::{MAX_ACTIONS, NO_LATENT};
use gadm_node::safety::{HOLD_LIMIT, STALE_LIMIT};
use gadm_node::service::Tick;
use gadm_node::{Flags, Frame, Link, LinkError};
use gadm_runtime::ActionHead;

/// What the plant's actuators did in one control period.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Applied {
    /// An action set of this period came.
    pub fresh: bool,
    /// What the node said about it; for a missing set, nothing.
    pub flags: Flags,
    /// Latent; [`NO_LATENT`] for none.
    pub latent: u16,
    /// The actuators have the safe action or a step of the ramp to it: the node's, or by themselves.
    pub safe: bool,
    /// Periods since the actuators had a new decision or a safe action; 0 where they have one now.
    pub age: u64,
    /// The applied action is finite and within the bounds of its heads.
    pub legal: bool,
}

/// An environment on a bus.
pub struct PlantNode<L> {
    env: Box<dyn Env>,
    link: L,
    layout: Layout,
    obs: Vec<f32>,
    /// What was sent instead of `obs`.
    sensed: Vec<f32>,
    /// What the actuators were asked for, and what they do.
    action: Vec<f32>,
    applied: Vec<f32>,
    safe: Vec<f32>,
    period_us: u64,
    tick: u32,
    periods: u64,
    set: Assembler<MAX_ACTIONS>,
    header: Option<(Flags, u16)>,
    decision: Option<Decision>,
    silent: u32,
    age: u64,
    errors: u64,
}

impl<L: std::fmt::Debug> std::fmt::Debug for PlantNode<L> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("PlantNode")
            .field("env", &self.env.spec().id)
            .field("tick", &self.tick)
            .field("link", &self.link)
            .finish_non_exhaustive()
    }
}

impl<L: Link> PlantNode<L> {
    /// Puts `env` on the bus, with frames of `layout`.
    pub fn new(env: Box<dyn Env>, link: L, layout: Layout) -> Self {
        let spec = env.spec();
        let safe: Vec<f32> = spec.actions.iter().map(|a| a.safe).collect();
        Self {
            obs: vec![0.0; spec.obs_dim()],
            sensed: vec![0.0; spec.obs_dim()],
            action: safe.clone(),
            applied: safe.clone(),
            safe,
            period_us: u64::from(spec.control_period_us),
            env,
            link,
            layout,
            tick: 0,
            periods: 0,
            set: Assembler::default(),
            header: None,
            decision: None,
            silent: 0,
            age: 0,
            errors: 0,
        }
    }

    /// Starts an episode. Ticks and time go on.
    pub fn reset(&mut self, seed: u64) {
        self.env.reset(seed, &mut self.obs);
        self.action.clone_from(&self.safe);
        self.silent = 0;
        self.age = 0;
    }

    /// Virtual time at which the next control period starts, microseconds.
    pub fn now_us(&self) -> u64 {
        self.periods * self.period_us
    }

    /// Starts a control period: TICK, then the observation set as `sensors` leave it.
    ///
    /// # Errors
    /// Where the bus does not take a frame.
    pub fn sense(&mut self, sensors: impl FnOnce(&mut [f32])) -> Result<(), LinkError> {
        self.sensed.copy_from_slice(&self.obs);
        sensors(&mut self.sensed);
        let time_us = self.now_us() as u32; // modulo 2^32 by the protocol
        self.link.send(&Tick { tick: self.tick, time_us }.frame())?;
        let seq = self.layout.profile().seq(self.tick);
        for part in 0..self.layout.observation_parts() {
            if let Some(frame) = self.layout.observation_frame(part, seq, &self.sensed) {
                self.link.send(&frame)?;
            }
        }
        Ok(())
    }

    /// Applies the action set of this period for one period, as `actuators` do it. Without one, the last action is held,
    /// and from the third period in a row on the actuators take their safe values by themselves; so they do where nothing
    /// but repeated actions came for longer than a node may repeat one.
    ///
    /// # Errors
    /// Where the bus fails.
    pub fn drive(&mut self, actuators: impl FnOnce(&mut [f32])) -> Result<(Step, Applied), LinkError> {
        let seq = self.layout.profile().seq(self.tick);
        (self.header, self.decision) = (None, None);
        let mut frame = Frame::empty();
        while self.link.receive(&mut frame)? {
            self.take(&frame, seq);
        }
        let dim = self.action.len();
        let came = self.set.complete(seq, dim).filter(|v| v.iter().all(|x| x.is_finite()));
        let fresh = came.is_some();
        if let Some(values) = came {
            self.action.copy_from_slice(values);
            self.silent = 0;
        } else {
            self.silent += 1;
        }
        self.set.abandon();
        let (flags, latent) = match (fresh, self.decision, self.header) {
            (true, Some(d), _) => (d.header.flags, d.header.latent),
            (true, None, Some(h)) => h,
            _ => (Flags::default(), NO_LATENT),
        };
        let repeated = !fresh || flags.contains(Flags::HELD);
        self.age = if repeated { self.age + 1 } else { 0 };
        let alone = self.silent >= STALE_LIMIT || self.age > u64::from(HOLD_LIMIT);
        if alone {
            self.action.clone_from(&self.safe);
        }
        let safe = alone || (fresh && flags.contains(Flags::SAFE));
        if safe {
            self.age = 0;
        }
        self.applied.copy_from_slice(&self.action);
        actuators(&mut self.applied);
        let legal = self.applied.iter().zip(&self.env.spec().actions).all(|(v, a)| within(*v, a.head));
        let step = self.env.step(&self.applied, &mut self.obs);
        self.tick = self.tick.wrapping_add(1);
        self.periods += 1;
        Ok((step, Applied { fresh, flags, latent, safe, age: self.age, legal }))
    }

    fn take(&mut self, frame: &Frame, seq: u16) {
        match self.layout.action_part(frame) {
            Ok((header, part)) if header.seq == seq => {
                if self.set.push(&part, self.layout.action_parts()) == Pushed::Complete {
                    self.header = Some((header.flags, header.latent));
                }
            }
            Ok(_) => {}
            Err(FrameError::Foreign) => match self.layout.decision(frame) {
                Ok(decision) if decision.header.seq == seq => self.decision = Some(decision),
                Ok(_) | Err(FrameError::Foreign) => {}
                Err(_) => self.errors += 1,
            },
            Err(_) => self.errors += 1,
        }
    }

    /// The action that the actuators were asked for.
    pub fn action(&self) -> &[f32] {
        &self.action
    }

    /// The action that the actuators took.
    pub fn applied(&self) -> &[f32] {
        &self.applied
    }

    /// The environment, to disturb it.
    pub fn env_mut(&mut self) -> &mut dyn Env {
        self.env.as_mut()
    }

    /// The observation of the period to come.
    pub fn observation(&self) -> &[f32] {
        &self.obs
    }

    /// Frames of the node that were dropped for a wrong CRC, kind or length.
    pub fn errors(&self) -> u64 {
        self.errors
    }
}

/// Finite and within the bounds, with the half step that rounding in `classic-i16` may add.
fn within(value: f32, head: ActionHead) -> bool {
    match head {
        ActionHead::Continuous { lo, hi } => {
            let slack = (hi - lo) * 1e-6;
            value >= lo - slack && value <= hi + slack
        }
        ActionHead::Discrete { n } => value.fract() == 0.0 && value >= 0.0 && value < f32::from(n),
        ActionHead::Binary => value == 0.0 || value == 1.0,
    }
}
