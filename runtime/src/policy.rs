//! The policy: a validated view of the image, and one control step.

use crate::argmax::masked_argmax;
use crate::decision::Decision;
use crate::decoder::emit_heads;
use crate::error::{ActError, LoadError, SelfTestError};
use crate::fields::f32_at;
use crate::interface::{ActionSignal, ObservationSignal, action_head};
use crate::kernels::{hidden_layer, linear_layer, modulated_layer};
use crate::load::{Image, limit, trailer_records};
use crate::load_net::{Nets, constants};
use crate::mask::{LatentMask, MaskRule};
use crate::net::{Decoder, Net};
use crate::provenance::Provenance;
use crate::quant::{input_max, quantise_input};
use crate::schema::{Header, PolicySpec, WeightKind};
use crate::scratch::Scratch;
use crate::self_test::{self_test_vectors, slot_differs};
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
    nets: Nets<'a>,
    spec: PolicySpec,
}

impl core::fmt::Debug for Policy<'_> {
    /// Dimensions, not weights.
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let hash = self.image.header.interface_hash;
        f.debug_struct("Policy").field("spec", &self.spec).field("interface_hash", &hash).finish_non_exhaustive()
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
        let image = Image::load(image, WeightKind::Int8)?;
        let nets = Nets::load(&image)?;
        let spec = spec_of(&image, &nets);
        Ok(Self { image, nets, spec })
    }

    #[cfg(feature = "encode")]
    pub(crate) fn nets(&self) -> &Nets<'a> {
        &self.nets
    }

    #[cfg(feature = "encode")]
    pub(crate) fn image(&self) -> &Image<'a> {
        &self.image
    }

    /// Dimensions and needs.
    #[must_use]
    pub fn spec(&self) -> &PolicySpec {
        &self.spec
    }

    /// The header of the file.
    #[must_use]
    pub fn header(&self) -> &Header {
        &self.image.header
    }

    /// Hash of names, units, ranges and order of the signals and of the control period: two policies with the same hash
    /// can stand in for each other on a bus. FNV-1a, 64 bits; `docs/src/policy-format.md` has the byte stream.
    #[must_use]
    pub fn interface_hash(&self) -> u64 {
        self.image.header.interface_hash
    }

    /// Observation signals, in order.
    pub fn observation_signals(&self) -> impl Iterator<Item = ObservationSignal<'a>> + Clone + use<'a> {
        self.image.interface.observation_signals()
    }

    /// Action slots, in order.
    pub fn action_signals(&self) -> impl Iterator<Item = ActionSignal<'a>> + Clone + use<'a> {
        self.image.interface.action_signals()
    }

    /// Quantisers of the observations, in order; what [`act_q`](Self::act_q) expects.
    pub fn input_quantisers(&self) -> impl Iterator<Item = InputQuantiser> + Clone + use<'a> {
        let max = input_max(self.image.input_bits);
        self.image.input.iter().map(move |record| InputQuantiser {
            max,
            offset: f32_at(record, 0).unwrap_or_default(),
            scale: f32_at(record, 4).unwrap_or_default(),
        })
    }

    /// Where the policy comes from.
    #[must_use]
    pub fn provenance(&self) -> Provenance<'a> {
        Provenance::decode(self.image.provenance)
    }

    /// Optional records after the payload: kind and content.
    pub fn trailer(&self) -> impl Iterator<Item = (u16, &'a [u8])> + use<'a> {
        trailer_records(self.image.trailer)
    }

    /// Bytes of each part of the file.
    #[must_use]
    pub fn section_sizes(&self) -> SectionSizes {
        SectionSizes::of(&self.image, &self.nets.decoder)
    }

    /// Layers of all networks, in file order.
    pub fn layers(&self) -> impl Iterator<Item = LayerShape> + use<'a> {
        layer_shapes(&self.nets)
    }

    /// Threshold of the mask as a fraction, when the policy has a confidence network.
    #[must_use]
    pub fn mask_threshold(&self) -> Option<(u32, u32)> {
        self.nets.confidence.as_ref().map(|(_, threshold)| (threshold.num, threshold.den))
    }

    /// Value of one unit of [`Decision::q`].
    #[must_use]
    pub fn q_scale(&self) -> f32 {
        self.nets.q.scale
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
        let mut work = self.divide(scratch)?;
        let clipped = self.quantise(&mut work, obs.iter().copied());
        Ok(self.step(work, clipped, &mut |slot, value| store(action, slot, value)))
    }

    /// As [`act`](Self::act), with an observation that is already quantised by
    /// [`input_quantisers`](Self::input_quantisers); values beyond its range are clamped and flagged.
    ///
    /// # Errors
    /// A wrong-length observation, or a buffer that is too short. `action` is untouched then.
    pub fn act_q(&self, obs: &[i16], scratch: &mut Scratch, action: &mut [f32]) -> Result<Decision, ActError> {
        self.check_lengths(obs.len(), action.len())?;
        let work = self.divide(scratch)?;
        let max = input_max(self.image.input_bits);
        let least = max.wrapping_neg().wrapping_sub(1);
        let mut clipped = false;
        let clamped = obs.iter().map(|&x| {
            let inside = if x > max { max } else { x.max(least) };
            clipped |= inside != x;
            inside
        });
        pack_input(work.input, clamped);
        Ok(self.step(work, clipped, &mut |slot, value| store(action, slot, value)))
    }

    /// Runs the vectors of the file: latent and every bit of the action must be as stored. A policy that fails must not
    /// be run.
    ///
    /// # Errors
    /// The first difference, or scratch memory that is too short.
    pub fn self_test(&self, scratch: &mut Scratch) -> Result<(), SelfTestError> {
        let (obs_dim, slots) = (usize::from(self.spec.obs_dim), usize::from(self.spec.action_dim));
        for (vector, case) in self_test_vectors(self.image.self_tests, obs_dim, slots).enumerate() {
            let mut work = self.divide(scratch)?;
            let clipped = self.quantise(&mut work, case.observation());
            let mut first = None;
            let decision = self.step(work, clipped, &mut |slot, found| {
                let expected = case.action(slot);
                if slot_differs(expected, found) && first.is_none() {
                    first = Some(SelfTestError::Action { vector, slot, expected, found });
                }
            });
            if decision.latent != case.latent {
                return Err(SelfTestError::Latent { vector, expected: case.latent, found: decision.latent });
            }
            if let Some(error) = first {
                return Err(error);
            }
        }
        Ok(())
    }

    fn check_lengths(&self, obs: usize, action: usize) -> Result<(), ActError> {
        let (obs_dim, slots) = (usize::from(self.spec.obs_dim), usize::from(self.spec.action_dim));
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
        let error = ActError::ScratchLength { expected: self.spec.scratch_words, found: scratch.words() };
        if scratch.words() < self.spec.scratch_words {
            return Err(error);
        }
        let input = usize::from(self.spec.obs_dim).next_multiple_of(16) / 2;
        let hidden = self.nets.hidden_width().next_multiple_of(16) / 2;
        let (input, rest) = scratch.memory.split_at_mut_checked(input).ok_or(error)?;
        let (first, rest) = rest.split_at_mut_checked(hidden).ok_or(error)?;
        let (second, logits) = rest.split_at_mut_checked(hidden).ok_or(error)?;
        Ok(Work { input, first, second, logits })
    }

    fn quantise(&self, work: &mut Work, obs: impl Iterator<Item = f32>) -> bool {
        let mut clipped = false;
        let quantised = obs.zip(self.input_quantisers()).map(|(x, quantiser)| {
            let (value, outside) = quantiser.quantise(x);
            clipped |= outside;
            value
        });
        pack_input(work.input, quantised);
        clipped
    }

    /// From the quantised observation to the action.
    fn step(&self, work: Work, clipped: bool, sink: &mut dyn FnMut(usize, f32)) -> Decision {
        let Work { input, first, second, logits } = work;
        let (input, latents) = (&*input, usize::from(self.spec.num_latents));
        let padded = latents.next_multiple_of(4);
        let (q, rest) = logits.split_at_mut_checked(padded).unwrap_or_default();
        run(&self.nets.q, None, input, first, second, q);
        let (allowed, fallback) = match &self.nets.confidence {
            None => (LatentMask::full(self.spec.num_latents), false),
            Some((net, threshold)) => {
                let confidence = rest.get_mut(..padded).unwrap_or_default();
                run(net, None, input, first, second, confidence);
                let rule = MaskRule { num: threshold.num, den: threshold.den, frac_bits: net.frac_bits };
                rule.allowed(confidence.get_mut(..latents).unwrap_or_default())
            }
        };
        let (latent, q) = masked_argmax(q.get(..latents).unwrap_or_default(), &allowed);
        let actions = self.image.interface.actions;
        match &self.nets.decoder {
            Decoder::Modulated { net, modulation, heads } => {
                let rows = usize::from(net.outputs()).next_multiple_of(4);
                let out = logits.get_mut(..rows).unwrap_or_default();
                run(net, Some(latent_table(net, modulation, latent)), input, first, second, out);
                emit_heads(heads, actions, net.frac_bits, out, sink);
            }
            Decoder::Table { actions: table } => {
                let values = constants(table, latent, actions.len()).zip(actions).enumerate();
                for (slot, (value, record)) in values {
                    sink(slot, action_head(record).denormalise(value));
                }
            }
        }
        Decision { latent, allowed, fallback, clipped, q }
    }
}

/// What a caller needs to know.
pub(crate) fn spec_of(image: &Image<'_>, nets: &Nets<'_>) -> PolicySpec {
    PolicySpec {
        obs_dim: limit(image.interface.observations.len()),
        action_dim: limit(image.interface.actions.len()),
        num_latents: nets.q.outputs(),
        control_period_us: image.interface.control_period_us,
        scratch_words: image.header.scratch_words as usize,
        macs: nets.macs(),
        weights: image.header.weights,
    }
}

fn store(action: &mut [f32], slot: usize, value: f32) {
    if let Some(place) = action.get_mut(slot) {
        *place = value;
    }
}

/// Two values to a word, the first in the low half; the rest of the words is zero.
fn pack_input(words: &mut [u32], values: impl Iterator<Item = i16>) {
    let mut values = values;
    for word in words {
        let low = values.next().unwrap_or(0).cast_unsigned();
        let high = values.next().unwrap_or(0).cast_unsigned();
        *word = u32::from(low) | (u32::from(high) << 16);
    }
}

/// The multipliers and offsets of one latent.
fn latent_table<'a>(net: &Net<'a>, modulation: &'a [u8], latent: u16) -> &'a [u8] {
    let rows = net.layers().next().map_or(0, |layer| usize::from(layer.rows).next_multiple_of(4));
    let len = rows.wrapping_mul(8);
    modulation.get(len.wrapping_mul(usize::from(latent))..).and_then(|rest| rest.get(..len)).unwrap_or_default()
}

/// One network; `out` takes the logits of the last layer, rows padded to 4.
fn run(
    net: &Net<'_>,
    modulation: Option<&[u8]>,
    input: &[u32],
    first: &mut [u32],
    second: &mut [u32],
    out: &mut [u32],
) {
    let (mut from, mut to) = (first, second);
    let hidden = net.count.saturating_sub(1);
    for (index, layer) in net.layers().enumerate() {
        let x = if index == 0 { input } else { &*from };
        if index == hidden {
            linear_layer(layer.stream, layer.cols, x, out);
            return;
        }
        let words = usize::from(layer.rows).next_multiple_of(4) / 2;
        let y = to.get_mut(..words).unwrap_or_default();
        match modulation {
            Some(table) if index == 0 => {
                modulated_layer(layer.stream, layer.cols, u32::from(layer.bits), table, x, y);
            }
            _ => hidden_layer(layer.stream, layer.cols, u32::from(layer.bits), x, y),
        }
        core::mem::swap(&mut from, &mut to);
    }
}
