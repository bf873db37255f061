//! The policy: a validated view of the image, and one control step.

use crate::argmax::masked_argmax;
use crate::decision::Decision;
use crate::decoder::emit;
use crate::error::{ActError, LoadError, SelfTestError};
use crate::fields::f32_at;
use crate::image::{INPUT_LEN, Image};
use crate::interface::{ActionSignal, ObservationSignal};
use crate::kernels::layer;
use crate::load::load;
use crate::mask::{LatentMask, MaskRule};
use crate::net::{LINEAR_BITS, Layer, Net};
use crate::provenance::Provenance;
use crate::quant::{input_max, quantise_input};
use crate::schema::{Header, PolicySpec, Section, WeightKind, padded};
use crate::scratch::Scratch;
use crate::self_test::self_test_vectors;
use crate::sizes::{LayerShape, SectionSizes, layer_shapes};

/// How one observation becomes an integer: `round((x - offset) * scale)`, clamped to `-max - 1..=max`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InputQuantiser {
    /// Value that becomes 0, in the unit of the signal.
    pub offset: f32,
    /// Steps per unit of the signal.
    pub scale: f32,
    /// Largest integer; the smallest is one below its negative.
    pub max: i16,
}

impl InputQuantiser {
    /// The integer of a finite value, and whether it was clamped.
    #[must_use]
    pub fn quantise(self, x: f32) -> (i16, bool) {
        quantise_input(x, self.offset, self.scale, self.max)
    }
}

/// A validated policy. Weights stay where they are, in the image.
#[derive(Clone, Copy)]
pub struct Policy<'a> {
    image: Image<'a>,
}

impl core::fmt::Debug for Policy<'_> {
    /// Dimensions, not weights.
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let hash = self.interface_hash();
        f.debug_struct("Policy").field("spec", self.spec()).field("interface_hash", &hash).finish_non_exhaustive()
    }
}

/// The scratch memory of a step, divided.
struct Work<'m> {
    input: &'m mut [u32],
    first: &'m mut [u32],
    second: &'m mut [u32],
    logits: &'m mut [u32],
}

impl<'a> Policy<'a> {
    /// Validates an image: checksums, versions, lengths, shapes, ranges, and from the actual weights that no sum of a
    /// step can leave its range. The slice may be longer than the file, as a flash slot is; it must start at a multiple
    /// of 4 bytes in memory.
    ///
    /// # Errors
    /// [`LoadError`] says what is wrong and where.
    pub fn load(image: &'a [u8]) -> Result<Self, LoadError> {
        load::<true>(image, WeightKind::Int8).map(|image| Self { image })
    }

    /// As [`load`](Self::load), of a file from an exporter that is trusted: checksums, versions, lengths, shapes and the ranges
    /// of the actions, but not the proof from the weights, nor texts, numbers and padding that a step does not depend on. In
    /// less than half of the code; `docs/src/porting.md` lists what is checked.
    ///
    /// From a file that [`load`](Self::load) accepts it is the same policy. With any other bytes a step cannot panic, stays
    /// within file and scratch memory, and gives an action within the ranges of the file, but which one is not promised.
    ///
    /// # Errors
    /// [`LoadError`] says what is wrong and where.
    pub fn load_trusted(image: &'a [u8]) -> Result<Self, LoadError> {
        load::<false>(image, WeightKind::Int8).map(|image| Self { image })
    }

    #[cfg(feature = "encode")]
    pub(crate) fn image(&self) -> &Image<'a> {
        &self.image
    }

    /// Dimensions and needs.
    #[must_use]
    pub fn spec(&self) -> &PolicySpec {
        &self.image.spec
    }

    /// The header of the file.
    #[must_use]
    pub fn header(&self) -> Header {
        self.image.header()
    }

    /// Hash of names, units, ranges and order of the signals and of the control period: two policies with the same hash
    /// can stand in for each other on a bus. FNV-1a, 64 bits; `docs/src/policy-format.md` has the byte stream.
    #[must_use]
    pub fn interface_hash(&self) -> u64 {
        self.image.interface_hash()
    }

    /// Observation signals, in order.
    pub fn observation_signals(&self) -> impl Iterator<Item = ObservationSignal<'a>> + Clone + use<'a> {
        self.image.interface().observation_signals()
    }

    /// Action slots, in order.
    pub fn action_signals(&self) -> impl Iterator<Item = ActionSignal<'a>> + Clone + use<'a> {
        self.image.interface().action_signals()
    }

    /// Quantisers of the observations, in order; what [`act_q`](Self::act_q) expects.
    pub fn input_quantisers(&self) -> impl Iterator<Item = InputQuantiser> + Clone + use<'a> {
        let (bits, records) = self.image.input();
        let max = input_max(bits);
        records.iter().map(move |&record| quantiser(max, record))
    }

    /// Where the policy comes from.
    #[must_use]
    pub fn provenance(&self) -> Provenance<'a> {
        Provenance::decode(self.image.section(Section::Provenance))
    }

    /// Optional records after the payload: kind and content.
    pub fn trailer(&self) -> impl Iterator<Item = (u16, &'a [u8])> + use<'a> {
        self.image.trailer_records()
    }

    /// Bytes of each part of the file.
    #[must_use]
    pub fn section_sizes(&self) -> SectionSizes {
        SectionSizes::of(&self.image)
    }

    /// Layers of all networks, in file order.
    pub fn layers(&self) -> impl Iterator<Item = LayerShape> + use<'a> {
        layer_shapes(&self.image)
    }

    /// Threshold of the mask as a fraction, when the policy has a confidence network.
    #[must_use]
    pub fn mask_threshold(&self) -> Option<(u32, u32)> {
        self.image.threshold()
    }

    /// Whether the confidence network reads the Q-network's last hidden layer instead of the observation.
    #[must_use]
    pub fn shared_trunk(&self) -> bool {
        self.image.shared_trunk()
    }

    /// Value of one unit of [`Decision::q`].
    #[must_use]
    pub fn q_scale(&self) -> f32 {
        self.image.logit_scale(Section::Q)
    }

    /// One control step: observation in the units of the interface, action in the units of the interface.
    ///
    /// # Errors
    /// A non-finite or wrong-length observation, or a buffer that is too short. `action` is untouched then.
    pub fn act(&self, obs: &[f32], scratch: &mut Scratch, action: &mut [f32]) -> Result<Decision, ActError> {
        self.check_lengths(obs.len(), action.len())?;
        if let Some(index) = obs.iter().position(|x| !x.is_finite()) {
            return Err(ActError::NonFinite { index });
        }
        let clipped = self.quantise(scratch, 0, obs);
        self.step(scratch, clipped, &mut Output { action, ..Output::default() })
    }

    /// As [`act`](Self::act), with an observation that is already quantised by
    /// [`input_quantisers`](Self::input_quantisers); values beyond its range are clamped and flagged.
    ///
    /// # Errors
    /// A wrong-length observation, or a buffer that is too short. `action` is untouched then.
    pub fn act_q(&self, obs: &[i16], scratch: &mut Scratch, action: &mut [f32]) -> Result<Decision, ActError> {
        self.check_lengths(obs.len(), action.len())?;
        let max = input_max(self.image.input().0);
        let least = max.wrapping_neg().wrapping_sub(1);
        let words = self.clear(scratch);
        let mut clipped = false;
        for (index, &x) in obs.iter().enumerate() {
            let inside = if x > max { max } else { x.max(least) };
            clipped |= inside != x;
            put(words, index, inside);
        }
        self.step(scratch, clipped, &mut Output { action, ..Output::default() })
    }

    /// Runs the vectors of the file: latent and every bit of the action must be as stored. A policy that fails must not
    /// be run.
    ///
    /// # Errors
    /// The first difference, or scratch memory that is too short.
    pub fn self_test(&self, scratch: &mut Scratch) -> Result<(), SelfTestError> {
        let (obs_dim, slots) = (usize::from(self.image.spec.obs_dim), usize::from(self.image.spec.action_dim));
        for (vector, case) in self_test_vectors(self.image.self_tests(), obs_dim, slots).enumerate() {
            for (index, &x) in case.observation.iter().enumerate() {
                self.quantise(scratch, index, &[f32::from_le_bytes(x)]);
            }
            let mut output = Output { expected: case.actions, ..Output::default() };
            let decision = self.step(scratch, false, &mut output)?;
            if decision.latent != case.latent {
                return Err(SelfTestError::Latent { vector, expected: case.latent, found: decision.latent });
            }
            if let Some((slot, expected, found)) = output.difference {
                return Err(SelfTestError::Action { vector, slot, expected, found });
            }
        }
        Ok(())
    }

    fn check_lengths(&self, obs: usize, action: usize) -> Result<(), ActError> {
        let (obs_dim, slots) = (usize::from(self.image.spec.obs_dim), usize::from(self.image.spec.action_dim));
        if obs != obs_dim {
            return Err(ActError::ObservationLength { expected: obs_dim, found: obs });
        }
        if action < slots {
            return Err(ActError::ActionLength { expected: slots, found: action });
        }
        Ok(())
    }

    /// Divides the scratch memory; the shares are those of `scratch_words`.
    fn divide<'m>(&self, scratch: &'m mut Scratch) -> Result<Work<'m>, ActError> {
        let error = ActError::ScratchLength { expected: self.image.spec.scratch_words, found: scratch.words() };
        if scratch.words() < self.image.spec.scratch_words {
            return Err(error);
        }
        let input = self.input_words();
        let hidden = padded(self.image.hidden_width.into(), 16) / 2;
        let (input, rest) = scratch.memory.split_at_mut_checked(input).ok_or(error)?;
        let (first, rest) = rest.split_at_mut_checked(hidden).ok_or(error)?;
        let (second, logits) = rest.split_at_mut_checked(hidden).ok_or(error)?;
        Ok(Work { input, first, second, logits })
    }

    /// Quantises values of the observation, the first of which is its value `first`, into the front of the scratch memory;
    /// whether one was out of range.
    #[inline(never)]
    fn quantise(&self, scratch: &mut Scratch, first: usize, values: &[f32]) -> bool {
        let (bits, records) = self.image.input();
        let words = if first == 0 { self.clear(scratch) } else { &mut *scratch.memory };
        let max = input_max(bits);
        let mut clipped = false;
        for ((&x, record), index) in values.iter().zip(records.get(first..).unwrap_or_default()).zip(first..) {
            let (value, outside) = quantiser(max, *record).quantise(x);
            clipped |= outside;
            put(words, index, value);
        }
        clipped
    }

    /// Where the quantised observation goes, as far as there is memory for it: zeros.
    fn clear<'m>(&self, scratch: &'m mut Scratch) -> &'m mut [u32] {
        let len = self.input_words().min(scratch.memory.len());
        let words = scratch.memory.get_mut(..len).unwrap_or_default();
        words.fill(0);
        words
    }

    fn input_words(&self) -> usize {
        padded(self.image.spec.obs_dim.into(), 16) / 2
    }

    /// From the quantised observation, at the front of the scratch memory, to the action.
    #[inline(never)]
    fn step(&self, scratch: &mut Scratch, clipped: bool, output: &mut Output<'_>) -> Result<Decision, ActError> {
        let mut work = self.divide(scratch)?;
        let latents = usize::from(self.image.spec.num_latents);
        let second = padded(latents, 4);
        let net = self.image.net(Section::Q);
        run(&net, None, &mut work, 0, None);
        let trunk = self.image.shared_trunk().then_some(net.layers.len());
        let net = self.image.net(Section::Confidence);
        let (mut allowed, mut fallback) = (LatentMask::full(self.image.spec.num_latents), false);
        if !net.layers.is_empty() {
            run(&net, None, &mut work, second, trunk);
            let [num, den] = net.threshold;
            let rule = MaskRule { num, den, frac_bits: net.frac_bits };
            fallback = rule.restrict(part(work.logits, second, latents), &mut allowed);
        }
        let (latent, q) = masked_argmax(part(work.logits, 0, latents), &allowed);
        let decoder = self.image.net(Section::Decoder);
        if !decoder.layers.is_empty() {
            run(&decoder, Some(latent_table(&decoder, latent)), &mut work, 0, None);
        }
        emit(&decoder, self.image.actions(), latent, work.logits, |slot, value| output.put(slot, value));
        Ok(Decision { latent, allowed, fallback, clipped, q })
    }
}

/// Two values to a word, the first in the low half.
#[inline(always)]
fn put(words: &mut [u32], index: usize, value: i16) {
    if let Some(word) = words.get_mut(index / 2) {
        *word |= u32::from(value.cast_unsigned()) << (index % 2 * 16);
    }
}

fn quantiser(max: i16, record: [u8; INPUT_LEN]) -> InputQuantiser {
    InputQuantiser {
        offset: f32_at(&record, 0).unwrap_or_default(),
        scale: f32_at(&record, 4).unwrap_or_default(),
        max,
    }
}

/// Where the action of a step goes, or what it must be.
#[derive(Default)]
struct Output<'o> {
    action: &'o mut [f32],
    expected: &'o [[u8; 4]],
    /// The first slot that is not as expected, what was, and what was found.
    difference: Option<(usize, f32, f32)>,
}

impl Output<'_> {
    fn put(&mut self, slot: usize, found: f32) {
        if let Some(place) = self.action.get_mut(slot) {
            *place = found;
        } else if let Some(&expected) = self.expected.get(slot) {
            let expected = f32::from_le_bytes(expected);
            if expected.to_bits() != found.to_bits() && self.difference.is_none() {
                self.difference = Some((slot, expected, found));
            }
        }
    }
}

/// The multipliers and offsets of one latent.
pub(crate) fn latent_table<'a>(decoder: &Net<'a>, latent: u16) -> &'a [u8] {
    let len = padded(decoder.first_rows().into(), 4).wrapping_mul(8);
    decoder.table.get(len.wrapping_mul(usize::from(latent))..).and_then(|rest| rest.get(..len)).unwrap_or_default()
}

/// `len` words from `at` on.
fn part(words: &mut [u32], at: usize, len: usize) -> &mut [u32] {
    words.get_mut(at..at.wrapping_add(len)).unwrap_or_default()
}

/// One network; the logits of its last layer go to `at` in `work.logits`, rows padded to 4. With `trunk` it reads what a network
/// of so many layers has left of its last hidden one: its first hidden layer went to the second buffer, the next to the first.
#[inline(never)]
fn run(net: &Net<'_>, modulation: Option<&[u8]>, work: &mut Work, at: usize, trunk: Option<usize>) {
    let mut modulation = modulation;
    let mut input = Some(&*work.input);
    let (mut from, mut to) = (&mut *work.first, &mut *work.second);
    if let Some(layers) = trunk {
        input = None;
        if layers.is_multiple_of(2) {
            core::mem::swap(&mut from, &mut to);
        }
    }
    for Layer { rows, cols, bits, stream } in net.layers() {
        let rows = padded(rows.into(), 4);
        let x = input.take().unwrap_or(from);
        let y =
            if bits == LINEAR_BITS { part(work.logits, at, rows) } else { to.get_mut(..rows / 2).unwrap_or_default() };
        layer(stream, cols, bits.into(), modulation.take(), x, y);
        core::mem::swap(&mut from, &mut to);
    }
}
