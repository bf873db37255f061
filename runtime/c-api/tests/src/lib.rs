//! What the tests of the C library share: the built library, observations, and the lines that the example must print.
#![allow(clippy::missing_panics_doc, clippy::unwrap_used, reason = "only tests depend on this crate")]

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use gadm_runtime::encode::AlignedImage;
use gadm_runtime::{ActError, Decision, Policy, Scratch};

/// The folder `runtime/c-api`.
#[must_use]
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_path_buf()
}

/// The library as C firmware links it, for the host or a target.
#[must_use]
pub fn library(target: Option<&str>) -> PathBuf {
    // The tests lie in <target>/<profile>/deps; the library is built in a folder of its own beside the profile.
    let test = std::env::current_exe().unwrap();
    let folder = test.ancestors().nth(3).unwrap().join("library");
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(cargo);
    command.args(["build", "--quiet", "--release", "--locked", "--target-dir"]).arg(&folder);
    command.arg("--manifest-path").arg(root().join("Cargo.toml"));
    let mut made = folder;
    if let Some(target) = target {
        command.args(["--target", target]);
        made.push(target);
    }
    assert!(command.status().unwrap().success(), "the C library does not build");
    made.join("release/libgadm.a")
}

/// Runs a program that has to succeed, and gives what it printed.
#[track_caller]
pub fn run(command: &mut Command) -> String {
    let out = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}; `make setup` brings it"));
    let (said, complained) = (String::from_utf8_lossy(&out.stdout), String::from_utf8_lossy(&out.stderr));
    assert!(out.status.success(), "{command:?}: {}\n{said}{complained}", out.status);
    said.into_owned()
}

/// Policies that the tests run: name and file.
#[must_use]
pub fn policies() -> Vec<(&'static str, Vec<u8>)> {
    let runtime = root().parent().unwrap().to_path_buf();
    let models = runtime.parent().unwrap().join("models");
    [
        ("golden", runtime.join("tests/data/format-1.bin")),
        ("moving", models.join("moving/policy.bin")),
        ("hopper-v5", models.join("hopper-v5/policy.bin")),
    ]
    .map(|(name, path)| (name, std::fs::read(path).unwrap()))
    .to_vec()
}

/// Observations for one policy, as floats and as integers.
pub struct Observations {
    obs_dim: usize,
    floats: Vec<f32>,
    integers: Vec<i16>,
}

/// Random within and beyond the range, extremes, and values that must be refused; `steps` of each kind.
#[must_use]
pub fn observations(policy: &Policy<'_>, steps: usize) -> Observations {
    let mut state = 0x9E37_79B9_7F4A_7C15u64;
    let mut next = move || {
        // xorshift64, Marsaglia 2003.
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state >> 16
    };
    let special = [f32::MAX, f32::MIN, f32::MIN_POSITIVE, 1e-42, -0.0, 0.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    let mut floats = Vec::new();
    for step in 0..steps {
        for signal in policy.observation_signals() {
            #[allow(clippy::cast_precision_loss, reason = "16 bits")]
            let share = (next() & 0xFFFF) as f32 / 65536.0;
            floats.push(match step % 10 {
                0 => [signal.lo, signal.hi][(next() & 1) as usize],
                // Few rows hold a special value, and in one place only, so that most of them are run.
                1 if next() % 4 == 0 => special[usize::try_from(next() % 9).unwrap()],
                2 => signal.lo + (signal.hi - signal.lo) * (4.0 * share - 1.5),
                _ => signal.lo + (signal.hi - signal.lo) * share,
            });
        }
    }
    let obs_dim = usize::from(policy.spec().obs_dim);
    let integers = (0..steps * obs_dim).map(|_| (next() & 0xFFFF) as u16).map(|word| {
        // Three of four within 12 bits, the others beyond.
        if word.is_multiple_of(4) { word.cast_signed() } else { word.cast_signed() >> 4 }
    });
    Observations { obs_dim, integers: integers.collect(), floats }
}

impl Observations {
    /// The file that the example reads.
    #[must_use]
    pub fn file(&self) -> Vec<u8> {
        let counts = [self.floats.len() / self.obs_dim, self.integers.len() / self.obs_dim, self.obs_dim];
        let mut bytes: Vec<u8> = counts.iter().flat_map(|n| u32::try_from(*n).unwrap().to_le_bytes()).collect();
        bytes.extend(self.floats.iter().flat_map(|x| x.to_le_bytes()));
        bytes.extend(self.integers.iter().flat_map(|x| x.to_le_bytes()));
        bytes
    }
}

/// What the example must print: the same steps in the Rust runtime.
#[must_use]
pub fn expected(image: &[u8], observations: &Observations) -> String {
    let image = AlignedImage::new(image);
    let policy = Policy::load(&image).unwrap();
    let spec = policy.spec();
    let mut memory = vec![0; spec.scratch_words];
    let mut action = vec![0.0; usize::from(spec.action_dim)];
    let hash = policy.interface_hash();
    let mut text = String::from("policy");
    let scratch_words = u32::try_from(spec.scratch_words).unwrap();
    let head = [spec.obs_dim.into(), spec.action_dim.into(), spec.num_latents.into(), scratch_words];
    #[allow(clippy::cast_possible_truncation, reason = "the two halves of the hash")]
    let halves = [(hash >> 32) as u32, hash as u32];
    words(&mut text, halves.into_iter().chain(head));
    for row in observations.floats.chunks(observations.obs_dim) {
        let done = policy.act(row, &mut Scratch::new(&mut memory), &mut action);
        step(&mut text, done, &action);
    }
    for row in observations.integers.chunks(observations.obs_dim) {
        let done = policy.act_q(row, &mut Scratch::new(&mut memory), &mut action);
        step(&mut text, done, &action);
    }
    text + "end\n"
}

fn step(text: &mut String, done: Result<Decision, ActError>, action: &[f32]) {
    match done {
        Ok(decision) => {
            let mut allowed = [0u32; 8];
            decision.allowed.iter().for_each(|latent| allowed[usize::from(latent / 32)] |= 1 << (latent % 32));
            let flags = u32::from(decision.fallback) * 2 + u32::from(decision.clipped);
            let head = [decision.latent.into(), decision.q.cast_unsigned(), flags];
            text.push_str("step");
            words(text, head.into_iter().chain(allowed).chain(action.iter().map(|value| value.to_bits())));
        }
        Err(ActError::NonFinite { index }) => {
            text.push_str(
                "step: an observation is NaN or infinite: hold the last action and check the sensor\nrefused",
            );
            words(text, [49, u32::try_from(index).unwrap(), 0, 0]);
        }
        Err(error) => panic!("{error}"),
    }
}

fn words(text: &mut String, words: impl IntoIterator<Item = u32>) {
    for word in words {
        write!(text, " {word:08x}").unwrap();
    }
    text.push('\n');
}

/// Fails with the first line that differs.
#[track_caller]
pub fn same_lines(what: &str, found: &str, expected: &str) {
    for (number, (found, expected)) in found.lines().zip(expected.lines()).enumerate() {
        assert!(found == expected, "{what}, line {number}:\nfound    {found}\nexpected {expected}");
    }
    assert_eq!(found.lines().count(), expected.lines().count(), "{what}: number of lines");
}
