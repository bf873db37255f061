//! Films the first episode of whatever drives an environment.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::{Film, Pace};
use crate::{Env, Step, Watched, Watcher};

/// Most frames of a film; 16 s at 25 a second.
const FRAMES: usize = 400;

/// Films an episode without changing it. Clones are the same camera.
///
/// ```
/// # fn main() -> Result<(), gadm_envs::EnvError> {
/// use gadm_envs::render::Camera;
/// let camera = Camera::new(200);
/// let mut env = camera.before(gadm_envs::make("moving")?);
/// let mut obs = vec![0.0; env.spec().obs_dim()];
/// env.reset(1, &mut obs);
/// env.step(&[0.0, 1.0, 0.0], &mut obs);
/// let shot = camera.finish().expect("the reset and a step were filmed");
/// assert_eq!((&shot.gif[..3], &shot.png[1..4]), (&b"GIF"[..], &b"PNG"[..]));
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug)]
pub struct Camera(Arc<Mutex<Reel>>);

#[derive(Debug)]
struct Reel {
    width: u32,
    film: Option<Film>,
    still: Vec<u8>,
}

/// A finished film.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Shot {
    /// Animated GIF.
    pub gif: Vec<u8>,
    /// Its first picture as PNG.
    pub png: Vec<u8>,
    /// How its time runs, in words.
    pub pace: String,
    /// It ends before the episode does.
    pub cut: bool,
}

impl Camera {
    /// A camera whose pictures are `width` pixels wide.
    pub fn new(width: u32) -> Self {
        Self(Arc::new(Mutex::new(Reel { width, film: None, still: Vec::new() })))
    }

    /// Puts the camera before an environment: it films from the first reset to the end of that episode.
    pub fn before(&self, env: Box<dyn Env>) -> Box<dyn Env> {
        let mut reel = self.reel();
        reel.film = Some(Film::new(reel.width, Pace::of(env.spec()), FRAMES));
        drop(reel);
        Box::new(Watched::new(env, self.clone()))
    }

    /// The film; `None` where nothing was filmed.
    pub fn finish(&self) -> Option<Shot> {
        let mut reel = self.reel();
        let film = reel.film.take().filter(|film| film.frames() > 0)?;
        let (pace, cut) = (film.pace().text(), film.is_cut());
        Some(Shot { gif: film.finish(), png: std::mem::take(&mut reel.still), pace, cut })
    }

    fn reel(&self) -> MutexGuard<'_, Reel> {
        // A poisoned reel is still a reel.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Reel {
    fn shoot(&mut self, env: &dyn Env) {
        let Some(film) = &mut self.film else { return };
        if !film.wants_next() {
            film.skip();
        } else if let Some(scene) = env.scene() {
            if film.frames() == 0 {
                self.still = scene.to_png(self.width);
            }
            film.step(&scene);
        }
    }
}

impl Watcher for Camera {
    fn begin(&mut self, env: &dyn Env) {
        self.reel().shoot(env);
    }

    fn step(&mut self, env: &dyn Env, _action: &[f32], _step: &Step) {
        self.reel().shoot(env);
    }
}
