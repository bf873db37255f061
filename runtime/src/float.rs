//! The same policy with `f32` weights: oracle of the integer policy, and for targets with an FPU.
//!
//! Weights are borrowed from the image as nalgebra views. The result is that of `FloatModel::act` but for the order of
//! sums; unlike the integer policy it is not promised to be the same bits on every target.

use crate::decision::FloatDecision;
use crate::error::{ActError, LoadError, SelfTestError};
use crate::fields::f32_at;
use crate::float_heads::{allowed, argmax, emit};
use crate::image::Image;
use crate::interface::{ACTION_LEN, ActionSignal, ObservationSignal, action_head};
use crate::load::load;
use crate::mask::LatentMask;
use crate::net::{Layer, Net};
use crate::provenance::Provenance;
use crate::schema::{Header, PolicySpec, Section, WeightKind};
use crate::scratch::Scratch;
use crate::self_test::self_test_vectors;
use crate::sizes::{LayerShape, SectionSizes, layer_shapes};
use crate::space::ActionHead;
use nalgebra::{DMatrixView, DVectorView, DVectorViewMut};

#[cfg(target_endian = "big")]
compile_error!("feature `float` borrows little-endian weights from the image and needs a little-endian target");

/// Share of a continuous slot's range that a self-test may be off.
const SELF_TEST_TOLERANCE: f32 = 1e-4;

/// A validated policy with `f32` weights, which stay where they are, in the image.
#[derive(Clone, Copy)]
pub struct FloatPolicy<'a> {
    image: Image<'a>,
}

impl core::fmt::Debug for FloatPolicy<'_> {
    /// Dimensions, not weights.
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let hash = self.interface_hash();
        f.debug_struct("FloatPolicy").field("spec", self.spec()).field("interface_hash", &hash).finish_non_exhaustive()
    }
}

/// The scratch memory of a step, divided.
struct Work<'m> {
    input: &'m mut [f32],
    first: &'m mut [f32],
    second: &'m mut [f32],
    logits: &'m mut [f32],
}

impl<'a> FloatPolicy<'a> {
    /// Validates an image with `f32` weights; see [`Policy::load`](crate::Policy::load).
    ///
    /// # Errors
    /// [`LoadError`] says what is wrong and where.
    pub fn load(image: &'a [u8]) -> Result<Self, LoadError> {
        load::<true>(image, WeightKind::Float32).map(|image| Self { image })
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

    /// Hash of the interface; see [`Policy::interface_hash`](crate::Policy::interface_hash).
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

    /// One control step: observation in the units of the interface, action in the units of the interface.
    ///
    /// # Errors
    /// A non-finite or wrong-length observation, or a buffer that is too short. `action` is untouched then.
    pub fn act(&self, obs: &[f32], scratch: &mut Scratch, action: &mut [f32]) -> Result<FloatDecision, ActError> {
        let (obs_dim, slots) = (usize::from(self.image.spec.obs_dim), usize::from(self.image.spec.action_dim));
        if obs.len() != obs_dim {
            return Err(ActError::ObservationLength { expected: obs_dim, found: obs.len() });
        }
        if action.len() < slots {
            return Err(ActError::ActionLength { expected: slots, found: action.len() });
        }
        if let Some(index) = obs.iter().position(|x| !x.is_finite()) {
            return Err(ActError::NonFinite { index });
        }
        let work = self.divide(scratch)?;
        self.normalise(work.input, obs.iter().copied());
        Ok(self.step(work, &mut |slot, value| {
            if let Some(place) = action.get_mut(slot) {
                *place = value;
            }
        }))
    }

    /// Runs the vectors of the file: the latent as stored, actions within 1e-4 of the slot's range.
    ///
    /// # Errors
    /// The first difference, or scratch memory that is too short.
    pub fn self_test(&self, scratch: &mut Scratch) -> Result<(), SelfTestError> {
        let (obs_dim, slots) = (usize::from(self.image.spec.obs_dim), usize::from(self.image.spec.action_dim));
        for (vector, case) in self_test_vectors(self.image.self_tests(), obs_dim, slots).enumerate() {
            let work = self.divide(scratch)?;
            self.normalise(work.input, case.observation.iter().map(|&bytes| f32::from_le_bytes(bytes)));
            let mut first = None;
            let decision = self.step(work, &mut |slot, found| {
                let expected = case.actions.get(slot).copied().map_or(0.0, f32::from_le_bytes);
                let tolerance = self.image.actions().get(slot).map_or(0.0, tolerance);
                let close = (expected - found).abs() <= tolerance;
                if !close && first.is_none() {
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

    /// Divides the scratch memory; the shares are those of `scratch_words_float`.
    fn divide<'m>(&self, scratch: &'m mut Scratch) -> Result<Work<'m>, ActError> {
        let error = ActError::ScratchLength { expected: self.image.spec.scratch_words, found: scratch.words() };
        if scratch.words() < self.image.spec.scratch_words {
            return Err(error);
        }
        let memory: &'m mut [f32] = bytemuck::cast_slice_mut(scratch.memory);
        let hidden = usize::from(self.image.hidden_width);
        let (input, rest) = memory.split_at_mut_checked(usize::from(self.image.spec.obs_dim)).ok_or(error)?;
        let (first, rest) = rest.split_at_mut_checked(hidden).ok_or(error)?;
        let (second, logits) = rest.split_at_mut_checked(hidden).ok_or(error)?;
        Ok(Work { input, first, second, logits })
    }

    fn normalise(&self, input: &mut [f32], obs: impl Iterator<Item = f32>) {
        for ((place, x), record) in input.iter_mut().zip(obs).zip(self.image.input().1) {
            let (offset, scale) = (f32_at(record, 0).unwrap_or_default(), f32_at(record, 4).unwrap_or_default());
            *place = (x - offset) * scale;
        }
    }

    fn step(&self, work: Work, sink: &mut dyn FnMut(usize, f32)) -> FloatDecision {
        let Work { input, first, second, logits } = work;
        let (input, latents) = (&*input, usize::from(self.image.spec.num_latents));
        let (values, rest) = logits.split_at_mut_checked(latents).unwrap_or_default();
        run(&self.image.net(Section::Q), None, input, first, second, values);
        let (allowed, fallback) = match self.image.threshold() {
            None => (LatentMask::full(self.image.spec.num_latents), false),
            Some(threshold) => {
                let net = self.image.net(Section::Confidence);
                let confidence = rest.get_mut(..latents).unwrap_or_default();
                let (x, from, to) = match self.image.shared_trunk().then_some(self.image.net(Section::Q).layers.len()) {
                    None => (input, &mut *first, &mut *second),
                    // One hidden layer at most, so no second buffer is needed.
                    Some(layers) if layers.is_multiple_of(2) => (&*second, <&mut [_]>::default(), &mut *first),
                    Some(_) => (&*first, <&mut [_]>::default(), &mut *second),
                };
                run(&net, None, x, from, to, confidence);
                allowed(threshold, confidence)
            }
        };
        let candidates = (0u16..).zip(values.iter().copied()).filter(|(latent, _)| allowed.contains(*latent));
        let (latent, q) = argmax(candidates);
        let actions = self.image.actions();
        let decoder = self.image.net(Section::Decoder);
        let out = logits.get_mut(..usize::from(decoder.outputs())).unwrap_or_default();
        run(&decoder, Some(latent_table(&decoder, latent)), input, first, second, out);
        emit(&decoder, actions, latent, out, sink);
        FloatDecision { latent, allowed, fallback, q }
    }
}

/// How far a self-test value may be off.
fn tolerance(record: &[u8; ACTION_LEN]) -> f32 {
    match action_head(record) {
        ActionHead::Continuous { lo, hi } => (hi - lo) * SELF_TEST_TOLERANCE,
        ActionHead::Discrete { .. } | ActionHead::Binary => 0.0,
    }
}

/// Little-endian `f32`s in place. The image lies at a multiple of 4 bytes and streams at multiples of 16 in it.
fn floats(bytes: &[u8]) -> &[f32] {
    bytemuck::try_cast_slice(bytes).unwrap_or_default()
}

/// Scale and shift of one latent, one after the other.
fn latent_table<'a>(decoder: &Net<'a>, latent: u16) -> &'a [f32] {
    let len = usize::from(decoder.first_rows()).wrapping_mul(2);
    let start = len.wrapping_mul(usize::from(latent));
    floats(decoder.table).get(start..).and_then(|rest| rest.get(..len)).unwrap_or_default()
}

/// `y = W x + b`.
fn affine(layer: &Layer<'_>, x: &[f32], y: &mut [f32]) {
    let (rows, cols) = (usize::from(layer.rows), usize::from(layer.cols));
    let split = floats(layer.stream).split_at_checked(rows.wrapping_mul(cols));
    let (Some((weights, bias)), Some(x)) = (split, x.get(..cols)) else { return };
    for (y, bias) in y.iter_mut().zip(bias) {
        *y = *bias;
    }
    // Row-major rows x cols is column-major cols x rows, so the product is with the transpose.
    let transposed = DMatrixView::from_slice(weights, cols, rows);
    DVectorViewMut::from_slice(y, rows).gemv_tr(1.0, &transposed, &DVectorView::from_slice(x, cols), 1.0);
}

/// One network; `out` takes the logits. The first hidden layer goes to `second`, the next to `first`, and so on.
fn run(
    net: &Net<'_>,
    modulation: Option<&[f32]>,
    input: &[f32],
    first: &mut [f32],
    second: &mut [f32],
    out: &mut [f32],
) {
    let (mut from, mut to) = (first, second);
    let hidden = net.layers.len().saturating_sub(1);
    for (index, layer) in net.layers().enumerate() {
        let x = if index == 0 { input } else { &*from };
        if index == hidden {
            affine(&layer, x, out);
            return;
        }
        let rows = usize::from(layer.rows);
        let y = to.get_mut(..rows).unwrap_or_default();
        affine(&layer, x, y);
        if let (0, Some((scale, shift))) = (index, modulation.and_then(|table| table.split_at_checked(rows))) {
            for ((y, scale), shift) in y.iter_mut().zip(scale).zip(shift) {
                *y = scale * *y + shift;
            }
        }
        for y in y.iter_mut().filter(|y| **y < 0.0) {
            *y = 0.0;
        }
        core::mem::swap(&mut from, &mut to);
    }
}
