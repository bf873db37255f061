//! What a report shows of the first episode: the plant's film, rewards and actions, and the frames of the bus.

use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gadm_envs::render::{Camera, Shot};
use gadm_envs::{Env, Step, Watched, Watcher};
use gadm_node::protocol::{Function, NO_LATENT, address};
use gadm_node::service::{Heartbeat, Tick};
use gadm_node::{Flags, Frame, State};
use gadm_runtime::Policy;

use crate::SimError;
use crate::bus::loopback::Tap;
use crate::decode::profile_of;
use crate::sil::policy_layout;

/// Width of the film in a report, pixels.
pub const FILM_WIDTH: u32 = 420;
/// Most frames of the bus that are kept; an episode of Hopper in `classic-i16` has 10,000.
const BUS_FRAMES: usize = 500_000;

/// Watches a run for its report. Clones are the same recording.
#[derive(Clone, Debug)]
pub struct Recording {
    film_width: u32,
    tape: Arc<Mutex<Tape>>,
}

impl Default for Recording {
    fn default() -> Self {
        Self::new(FILM_WIDTH)
    }
}

impl PartialEq for Recording {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.tape, &other.tape)
    }
}

#[derive(Debug, Default)]
struct Tape {
    /// The first episode ended.
    ended: bool,
    rewards: Vec<f64>,
    actions: Vec<Vec<f32>>,
    camera: Option<Camera>,
    frames: Vec<(u64, Frame)>,
}

/// One episode as it was watched.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Episode {
    /// Reward of each control period.
    pub rewards: Vec<f64>,
    /// What the actuators did in each control period, in the order of the plant's action slots.
    pub actions: Vec<Vec<f32>>,
    /// The plant as it moved; `None` where it does not draw itself.
    pub film: Option<Shot>,
    /// Frames on the bus with their times, microseconds.
    pub frames: Vec<(u64, Frame)>,
}

/// What the node told about each control period of an episode.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Decisions {
    /// Latent chosen in each period; `None` where none was, or its frame was lost.
    pub latents: Vec<Option<u16>>,
    /// Flags of each period's action set; `None` where no set came.
    pub flags: Vec<Option<Flags>>,
    /// State of the node in each period, by its last heartbeat.
    pub states: Vec<Option<State>>,
}

impl Recording {
    /// A recording whose film is so many pixels wide.
    #[must_use]
    pub fn new(film_width: u32) -> Self {
        Self { film_width, tape: Arc::default() }
    }

    fn tape(&self) -> MutexGuard<'_, Tape> {
        // A poisoned tape is still a tape.
        self.tape.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Puts the recording between a plant and whoever drives it.
    #[must_use]
    pub fn watch_env(&self, env: Box<dyn Env>) -> Box<dyn Env> {
        let camera = Camera::new(self.film_width);
        let env = camera.before(env);
        self.tape().camera = Some(camera);
        Box::new(Watched::new(env, self.clone()))
    }

    /// Puts the recording before a tap, or where none is.
    #[must_use]
    pub fn watch_bus(&self, tap: Option<Box<dyn Tap>>) -> Box<dyn Tap> {
        Box::new(WatchedBus { tap, recording: self.clone() })
    }

    /// Ends the recording and gives the first episode.
    #[must_use]
    pub fn finish(&self) -> Episode {
        let tape = std::mem::take(&mut *self.tape());
        let film = tape.camera.and_then(|camera| camera.finish());
        Episode { rewards: tape.rewards, actions: tape.actions, film, frames: tape.frames }
    }
}

impl Episode {
    /// What the node told about each period.
    ///
    /// # Errors
    /// [`SimError::Layout`] where the frames cannot be those of this policy.
    pub fn decisions(&self, policy: &Policy) -> Result<Decisions, SimError> {
        let n = self.rewards.len();
        let mut all = Decisions { latents: vec![None; n], flags: vec![None; n], states: vec![None; n] };
        let Some(profile) = profile_of(self.frames.iter().map(|(_, f)| f)) else { return Ok(all) };
        let layout = policy_layout(policy, profile)?;
        let mut first_tick = None;
        let mut period = None;
        let mut state = None;
        for (_, frame) in &self.frames {
            let Some(to) = frame.standard_id().and_then(address) else { continue };
            match to.message.function {
                Function::Tick => {
                    let Some(tick) = Tick::parse(frame) else { continue };
                    let first = *first_tick.get_or_insert(tick.tick);
                    period = Some(tick.tick.wrapping_sub(first) as usize).filter(|p| *p < n);
                }
                Function::Heartbeat => {
                    state = Heartbeat::parse(frame).and_then(|h| State::from_code(h.state)).or(state);
                }
                Function::Action | Function::Decision => {
                    let header = match layout.action_part(frame) {
                        Ok((header, _)) if to.part == 0 => Some((header.latent, header.flags)),
                        _ => layout.decision(frame).ok().map(|d| (d.header.latent, d.header.flags)),
                    };
                    if let (Some(p), Some((latent, flags))) = (period, header) {
                        // In `classic-i16` latent and flags are in DECISION alone, and ACT has neither.
                        let before = all.flags[p].unwrap_or_default().bits();
                        all.flags[p] = Some(Flags::from_bits(before | flags.bits()));
                        let told = latent != NO_LATENT && !flags.contains(Flags::HELD) && !flags.contains(Flags::SAFE);
                        all.latents[p] = if told { Some(latent) } else { all.latents[p] };
                    }
                }
                _ => {}
            }
            if let Some(p) = period {
                all.states[p] = state;
            }
        }
        Ok(all)
    }
}

impl Watcher for Recording {
    fn step(&mut self, _env: &dyn Env, action: &[f32], step: &Step) {
        let mut tape = self.tape();
        tape.rewards.push(step.reward);
        tape.actions.push(action.to_vec());
    }

    fn end(&mut self) {
        self.tape().ended = true;
    }
}

struct WatchedBus {
    tap: Option<Box<dyn Tap>>,
    recording: Recording,
}

impl Tap for WatchedBus {
    fn frame(&mut self, time_us: u64, frame: &Frame) -> io::Result<()> {
        let mut tape = self.recording.tape();
        if !tape.ended && tape.frames.len() < BUS_FRAMES {
            tape.frames.push((time_us, *frame));
        }
        drop(tape);
        self.tap.as_mut().map_or(Ok(()), |tap| tap.frame(time_us, frame))
    }
}
