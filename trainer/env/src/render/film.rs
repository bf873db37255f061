//! An episode as an animated GIF.

use std::collections::HashMap;

use gif::{DisposalMethod, Encoder, Frame, Repeat};

use super::scene::{Paint, Scene};
use crate::EnvSpec;

/// Shortest time between two frames that viewers keep to, hundredths of a second.
const LEAST_DELAY_CS: u32 = 4;
/// Time that one step is shown for where the environment's own time says little, hundredths of a second.
const SLOW_CS: u32 = 8;
/// How long the last frame stands before the film starts again, hundredths of a second.
const LAST_CS: u16 = 150;
/// Pixel value that leaves what was there.
const TRANSPARENT: u8 = 255;

/// Which steps become frames, and for how long each is shown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pace {
    /// Every so many steps a frame.
    pub every: u32,
    /// Time of a frame, hundredths of a second.
    pub delay_cs: u32,
    /// How much slower than the environment's own time the film runs; 1 is real time.
    pub slowed: f64,
}

impl Pace {
    /// At most 25 frames a second in real time. Tasks that end at a goal after few short steps are slowed down, a frame
    /// a step.
    pub fn of(spec: &EnvSpec) -> Self {
        let period_cs = f64::from(spec.control_period_us) / 1e4;
        let (every, delay_cs) = if spec.goal_terminal {
            (1, SLOW_CS.max(period_cs.round() as u32))
        } else {
            let every = (f64::from(LEAST_DELAY_CS) / period_cs).ceil().max(1.0);
            (every as u32, ((every * period_cs).round() as u32).max(LEAST_DELAY_CS))
        };
        Self { every, delay_cs, slowed: f64::from(delay_cs) / (f64::from(every) * period_cs) }
    }

    /// The pace in words, for captions.
    pub fn text(&self) -> String {
        if (self.slowed - 1.0).abs() < 0.02 {
            "in real time".to_owned()
        } else if self.slowed > 1.0 {
            format!("{:.0} times slower than real time", self.slowed)
        } else {
            format!("{:.1} times faster than real time", 1.0 / self.slowed)
        }
    }
}

/// Takes the scenes of an episode, and makes an animated GIF of them.
///
/// Colours are those of [`Paint`] and mixtures of two of them; a frame holds what changed since the last.
///
/// ```
/// # fn main() -> Result<(), gadm_envs::EnvError> {
/// use gadm_envs::render::{Film, Pace};
/// let mut env = gadm_envs::make("moving")?;
/// let mut film = Film::new(160, Pace::of(env.spec()), 100);
/// let mut obs = vec![0.0; env.spec().obs_dim()];
/// env.reset(1, &mut obs);
/// for _ in 0..5 {
///     film.step(&env.scene().expect("every environment of the registry draws itself"));
///     env.step(&[0.0, 1.0, 0.0], &mut obs);
/// }
/// assert_eq!(&film.finish()[..6], b"GIF89a");
/// # Ok(())
/// # }
/// ```
pub struct Film {
    width: u32,
    pace: Pace,
    limit: usize,
    frames: usize,
    steps: u64,
    palette: Palette,
    shown: Vec<u8>,
    /// A frame is written when the next one comes: only then it is known not to be the last.
    waiting: Option<Frame<'static>>,
    encoder: Option<Encoder<Vec<u8>>>,
}

impl std::fmt::Debug for Film {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Film").field("width", &self.width).field("frames", &self.frames).finish_non_exhaustive()
    }
}

impl Film {
    /// A film of this width in pixels (1 to 2048) with at most `limit` frames; what comes later is left out.
    pub fn new(width: u32, pace: Pace, limit: usize) -> Self {
        let (width, palette) = (width.clamp(1, 2048), Palette::new());
        let (waiting, encoder) = (None, None);
        Self { width, pace, limit, frames: 0, steps: 0, palette, shown: Vec::new(), waiting, encoder }
    }

    /// Whether the next [`step`](Self::step) would become a frame; drawing can be spared where not.
    pub fn wants_next(&self) -> bool {
        self.frames < self.limit && self.steps.is_multiple_of(u64::from(self.pace.every))
    }

    /// The state at a step, beginning with the reset.
    pub fn step(&mut self, scene: &Scene) {
        if self.wants_next() {
            self.add(scene);
        }
        self.steps += 1;
    }

    /// A step that is not drawn, where [`wants_next`](Self::wants_next) says no.
    pub fn skip(&mut self) {
        self.steps += 1;
    }

    /// Frames so far.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Whether steps were left out at the end.
    pub fn is_cut(&self) -> bool {
        self.frames >= self.limit && self.steps > self.limit as u64 * u64::from(self.pace.every)
    }

    /// Which steps become frames.
    pub fn pace(&self) -> Pace {
        self.pace
    }

    fn add(&mut self, scene: &Scene) {
        let pixels = scene.to_pixels(self.width);
        let (width, height) = (pixels.width as u16, pixels.height as u16);
        let colours: Vec<u8> = pixels.rgb.as_chunks::<3>().0.iter().map(|rgb| self.palette.nearest(*rgb)).collect();
        let encoder = self.encoder.get_or_insert_with(|| {
            let mut encoder = Encoder::new(Vec::new(), width, height, &self.palette.bytes)
                .expect("writing to memory with a palette of at most 256 colours does not fail");
            encoder.set_repeat(Repeat::Infinite).expect("writing to memory does not fail");
            encoder
        });
        let first = self.shown.len() != colours.len(); // another size is another picture: cut to the first one's
        if first && !self.shown.is_empty() {
            return;
        }
        let (left, top, w, h) =
            if first { (0, 0, width, height) } else { changed(&self.shown, &colours, usize::from(width)) };
        let mut buffer = Vec::with_capacity(usize::from(w) * usize::from(h));
        for y in usize::from(top)..usize::from(top + h) {
            for x in usize::from(left)..usize::from(left + w) {
                let i = y * usize::from(width) + x;
                let same = !first && self.shown[i] == colours[i];
                buffer.push(if same { TRANSPARENT } else { colours[i] });
            }
        }
        let frame = Frame {
            delay: self.pace.delay_cs as u16,
            dispose: DisposalMethod::Keep,
            transparent: Some(TRANSPARENT),
            left,
            top,
            width: w,
            height: h,
            buffer: buffer.into(),
            ..Frame::default()
        };
        if let Some(done) = self.waiting.replace(frame) {
            encoder.write_frame(&done).expect("writing to memory does not fail");
        }
        self.shown = colours;
        self.frames += 1;
    }

    /// The GIF file; empty where there was no frame. The last frame stands for a while.
    pub fn finish(mut self) -> Vec<u8> {
        let Some(mut encoder) = self.encoder.take() else { return Vec::new() };
        if let Some(mut last) = self.waiting.take() {
            last.delay = LAST_CS;
            encoder.write_frame(&last).expect("writing to memory does not fail");
        }
        encoder.into_inner().expect("writing to memory does not fail")
    }
}

/// The smallest rectangle (left, top, width, height) around what differs; one pixel where nothing does.
fn changed(before: &[u8], after: &[u8], width: usize) -> (u16, u16, u16, u16) {
    let differing = || (0..after.len()).filter(|&i| before[i] != after[i]);
    let Some(first) = differing().next() else { return (0, 0, 1, 1) };
    let last = differing().next_back().unwrap_or(first);
    let (left, right) = differing().fold((width, 0), |(l, r), i| (l.min(i % width), r.max(i % width)));
    let (top, bottom) = (first / width, last / width);
    (left as u16, top as u16, (right - left + 1) as u16, (bottom - top + 1) as u16)
}

/// The colours of a film, the same for every film: the paints, and three mixtures of each two of them for smooth edges.
struct Palette {
    bytes: Vec<u8>,
    known: HashMap<[u8; 3], u8>,
}

impl Palette {
    fn new() -> Self {
        let paints = Paint::ALL.map(Paint::rgb);
        let mut colours = paints.to_vec();
        for (i, a) in paints.iter().enumerate() {
            for b in &paints[i + 1..] {
                for share in [1, 2, 3] {
                    let mix = |k: usize| ((u16::from(a[k]) * (4 - share) + u16::from(b[k]) * share) / 4) as u8;
                    colours.push([mix(0), mix(1), mix(2)]);
                }
            }
        }
        let mut bytes: Vec<u8> = colours.into_iter().flatten().collect();
        bytes.resize(3 * 256, 0); // so that the transparent value is in the table
        Self { bytes, known: HashMap::new() }
    }

    fn nearest(&mut self, rgb: [u8; 3]) -> u8 {
        let bytes = &self.bytes;
        *self.known.entry(rgb).or_insert_with(|| {
            let distance =
                |c: &[u8; 3]| -> i32 { c.iter().zip(&rgb).map(|(a, b)| (i32::from(*a) - i32::from(*b)).pow(2)).sum() };
            let colours = bytes.as_chunks::<3>().0.iter().take(usize::from(TRANSPARENT)).enumerate();
            colours.min_by_key(|(_, c)| distance(c)).map_or(0, |(i, _)| i as u8)
        })
    }
}
