//! A checked file, whose parts are looked up when they are needed: a policy is a few words, and the rest stays in flash.

use crate::fields::{f32_at, slice_at, slice_of, u16_at, u32_at, u64_at};
use crate::interface::{ACTION_LEN, INTERFACE_HEAD, InterfaceView, OBSERVATION_LEN};
use crate::net::{Layer, NET_HEAD, Net};
use crate::schema::{HEADER_LEN, Header, PolicySpec, RUNTIME_ABI_SHARED_TRUNK, Section, TRAILER_HEAD, WeightKind};

/// Bytes before the first input record.
pub(crate) const INPUT_HEAD: usize = 16;
/// Bytes of an input record: offset and scale.
pub(crate) const INPUT_LEN: usize = 8;
/// Bytes before the first self-test vector.
pub(crate) const SELF_TEST_HEAD: usize = 16;

/// What integer and float policies have in common: `load` gives one whose every byte was checked.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Image<'a> {
    /// The whole file, without what follows it in its slot.
    pub(crate) file: &'a [u8],
    pub(crate) spec: PolicySpec,
    /// Widest hidden layer of all networks.
    pub(crate) hidden_width: u16,
}

impl<'a> Image<'a> {
    /// A file whose dimensions are not known yet.
    pub(crate) fn new(file: &'a [u8], weights: WeightKind) -> Self {
        let spec = PolicySpec {
            obs_dim: 0,
            action_dim: 0,
            num_latents: 0,
            control_period_us: 0,
            scratch_words: 0,
            macs: 0,
            weights,
        };
        Self { file, spec, hidden_width: 0 }
    }

    /// A `u32` of the header.
    pub(crate) fn word(&self, at: usize) -> u32 {
        u32_at(self.file, at).unwrap_or_default()
    }

    /// The header of the file.
    pub(crate) fn header(&self) -> Header {
        Header {
            format: u16_at(self.file, 8).unwrap_or_default(),
            numerics: u16_at(self.file, 10).unwrap_or_default(),
            total_len: self.word(12),
            payload_len: self.word(16),
            payload_crc32: self.word(20),
            interface_hash: self.interface_hash(),
            policy_seq: self.word(32),
            scratch_words: self.word(36),
            runtime_abi: self.word(40),
            weights: self.spec.weights,
        }
    }

    pub(crate) fn interface_hash(&self) -> u64 {
        u64_at(self.file, 24).unwrap_or_default()
    }

    /// A section of the table.
    #[inline(never)]
    pub(crate) fn section(&self, section: Section) -> &'a [u8] {
        slice_at(self.file, section.entry())
    }

    pub(crate) fn interface(&self) -> InterfaceView<'a> {
        let section = self.section(Section::Interface);
        let observations_len = usize::from(self.spec.obs_dim).wrapping_mul(OBSERVATION_LEN);
        let records = section.get(INTERFACE_HEAD..).unwrap_or_default();
        let (observations, rest) = records.split_at_checked(observations_len).unwrap_or_default();
        let actions_len = usize::from(self.spec.action_dim).wrapping_mul(ACTION_LEN);
        let (actions, text) = rest.split_at_checked(actions_len).unwrap_or_default();
        InterfaceView { observations: observations.as_chunks().0, actions: actions.as_chunks().0, text }
    }

    /// The records of the action slots.
    #[inline(never)]
    pub(crate) fn actions(&self) -> &'a [[u8; ACTION_LEN]] {
        let at = usize::from(self.spec.obs_dim).wrapping_mul(OBSERVATION_LEN).wrapping_add(INTERFACE_HEAD);
        let end = usize::from(self.spec.action_dim).wrapping_mul(ACTION_LEN).wrapping_add(at);
        self.section(Section::Interface).get(at..end).unwrap_or_default().as_chunks().0
    }

    /// Bits of a quantised observation, and the records of offset and scale.
    pub(crate) fn input(&self) -> (u16, &'a [[u8; INPUT_LEN]]) {
        let section = self.section(Section::Input);
        let bits = u16_at(section, 0).unwrap_or_default();
        (bits, section.get(INPUT_HEAD..).unwrap_or_default().as_chunks().0)
    }

    /// A network or decoder; without layers where there is none.
    #[inline(never)]
    pub(crate) fn net(&self, section: Section) -> Net<'a> {
        let (head, rest) = self.section(section).split_first_chunk().unwrap_or((&[0; NET_HEAD], &[]));
        let half = |at| u16_at(head, at).unwrap_or_default();
        let word = |at| u32_at(head, at).unwrap_or_default();
        let threshold = [word(8), word(12)];
        let (mut count, mut frac_bits, mut slots, mut table) = (half(0), half(2), 0, &[][..]);
        if section == Section::Decoder {
            // A decoder has its kind before the number of layers.
            (count, frac_bits, slots) = (half(2), half(4), self.spec.action_dim);
            table = slice_of(self.file, word(8), word(12));
        }
        let layers = rest.as_chunks().0.get(..count.into()).unwrap_or_default();
        let heads = rest.get(layers.as_flattened().len()..).unwrap_or_default().as_chunks().0;
        let heads = heads.get(..slots.into()).unwrap_or_default();
        Net { file: self.file, layers, heads, table, frac_bits: frac_bits.into(), threshold }
    }

    /// The confidence network reads the Q-network's last hidden layer, not the observation.
    pub(crate) fn shared_trunk(&self) -> bool {
        self.word(40) == RUNTIME_ABI_SHARED_TRUNK
    }

    /// The Q-network's last hidden layer, where the confidence network reads it.
    pub(crate) fn trunk(&self) -> Option<Layer<'a>> {
        let net = self.net(Section::Q);
        let hidden = net.layers.len().checked_sub(2).filter(|_| self.shared_trunk())?;
        net.layer(hidden)
    }

    /// Value of one unit of the logits of the Q-network or the confidence network.
    pub(crate) fn logit_scale(&self, section: Section) -> f32 {
        f32_at(self.section(section), 4).unwrap_or_default()
    }

    /// Numerator and denominator of the mask's threshold, where there is a confidence network.
    pub(crate) fn threshold(&self) -> Option<(u32, u32)> {
        let net = self.net(Section::Confidence);
        let [num, den] = net.threshold;
        (!net.layers.is_empty()).then_some((num, den))
    }

    /// The self-test vectors.
    pub(crate) fn self_tests(&self) -> &'a [u8] {
        self.section(Section::SelfTest).get(SELF_TEST_HEAD..).unwrap_or_default()
    }

    /// What follows the payload.
    pub(crate) fn trailer(&self) -> &'a [u8] {
        self.file.get((self.word(16) as usize).wrapping_add(HEADER_LEN)..).unwrap_or_default()
    }

    /// The optional records of the trailer: kind and content.
    pub(crate) fn trailer_records(&self) -> impl Iterator<Item = (u16, &'a [u8])> + use<'a> {
        let mut rest = self.trailer();
        core::iter::from_fn(move || {
            let kind = u16_at(rest, 0)?;
            let len = u32_at(rest, 4)? as usize;
            let data = rest.get(TRAILER_HEAD..)?.get(..len)?;
            let next = len.checked_next_multiple_of(crate::schema::SECTION_ALIGN)?.checked_add(TRAILER_HEAD)?;
            rest = rest.get(next..)?;
            Some((kind, data))
        })
    }
}
