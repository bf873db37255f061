//! Pictures of environments: what a person looks at to see what a policy does.
//!
//! An environment describes its state as a [`Scene`] of few flat shapes in its own units ([`Env::scene`]); the scene
//! becomes SVG text here, or, with feature `render`, pixels, a PNG file or a frame of an animated GIF. MuJoCo bodies are
//! drawn from the positions of their geoms, seen from the side with a camera that follows the torso: no window, graphics
//! card or off-screen driver is needed, and the same state gives the same picture on every machine.
//!
//! [`Env::scene`]: crate::Env::scene

#[cfg(feature = "mujoco")]
pub(crate) mod body;
#[cfg(feature = "render")]
mod camera;
pub(crate) mod classic;
pub(crate) mod field;
#[cfg(feature = "render")]
mod film;
#[cfg(feature = "box2d")]
pub(crate) mod lunar;
#[cfg(feature = "render")]
mod pixels;
mod scene;
mod svg;

#[cfg(feature = "render")]
pub use camera::{Camera, Shot};
#[cfg(feature = "render")]
pub use film::{Film, Pace};
#[cfg(feature = "render")]
pub use pixels::Pixels;
pub use scene::{Paint, Scene, Shape, View};
