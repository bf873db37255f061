//! Models made from bytes, for the fuzz targets and their corpus.

use gadm_runtime::ActionHead;
use gadm_runtime::encode::{
    ActionSlot, AlignedImage, Dense, FileOptions, FloatDecoder, FloatModel, HeadEncoding, Interface, ObservationSlot,
    ProvenanceOwned, QuantiseOptions, Snap, quantise, write_int8,
};

/// Numbers from bytes; zero once they are used up.
pub struct Source<'a>(pub &'a [u8]);

impl Source<'_> {
    pub fn byte(&mut self) -> u8 {
        let (first, rest) = self.0.split_first().unwrap_or((&0, &[]));
        self.0 = rest;
        *first
    }

    /// In `min..=max`.
    pub fn between(&mut self, min: usize, max: usize) -> usize {
        min + usize::from(self.byte()) % (max - min + 1)
    }

    /// Mostly small, sometimes very large or very small.
    pub fn number(&mut self) -> f32 {
        let byte = self.byte();
        let value = (f32::from(byte & 0x3F) - 31.5) / 16.0;
        match byte >> 6 {
            0 | 1 => value,
            2 => value * 1e4,
            _ => value * 1e-4,
        }
    }

    pub fn numbers(&mut self, count: usize) -> Vec<f32> {
        (0..count).map(|_| self.number()).collect()
    }

    /// Any bit pattern.
    pub fn float(&mut self) -> f32 {
        f32::from_le_bytes(core::array::from_fn(|_| self.byte()))
    }

    fn dense(&mut self, rows: usize, cols: usize) -> Dense {
        Dense { rows, cols, weight: self.numbers(rows * cols), bias: self.numbers(rows) }
    }

    fn chain(&mut self, inputs: usize, outputs: usize) -> Vec<Dense> {
        let hidden = self.between(0, 2);
        let mut layers = vec![];
        let mut width = inputs;
        for _ in 0..hidden {
            let rows = self.between(1, 19);
            layers.push(self.dense(rows, width));
            width = rows;
        }
        layers.push(self.dense(outputs, width));
        layers
    }

    fn slot(&mut self, index: usize) -> (ActionSlot, HeadEncoding) {
        let (head, encoding, safe) = match self.between(0, 3) {
            0 => (ActionHead::Continuous { lo: -2.0, hi: 1.0 }, HeadEncoding::Tanh, 0.5),
            1 => {
                let snap = [Snap::None, Snap::Edges, Snap::Any][self.between(0, 2)];
                let atoms = self.between(2, 9);
                (ActionHead::Continuous { lo: 0.0, hi: 9.0 }, HeadEncoding::Categorical { atoms, snap }, 0.0)
            }
            2 => (ActionHead::Discrete { n: self.between(1, 5) as u16 }, HeadEncoding::Types, 0.0),
            _ => (ActionHead::Binary, HeadEncoding::Switch, 1.0),
        };
        (ActionSlot { name: format!("a{index}"), unit: "N".into(), head, safe }, encoding)
    }

    /// A model that the writer should take, unless its numbers are too wild.
    pub fn model(&mut self) -> FloatModel {
        let obs = self.between(1, 17);
        let latents = self.between(1, 9);
        let count = self.between(1, 3);
        let (actions, heads): (Vec<_>, Vec<_>) = (0..count).map(|index| self.slot(index)).unzip();
        let rows = heads.iter().zip(&actions).map(|(head, action)| head.rows(action.head)).sum();
        let q = self.chain(obs, latents);
        let kind = self.byte() % 6;
        let trunk = q.iter().nth_back(1).map_or(0, |layer: &Dense| layer.rows);
        let shared_trunk = latents > 1 && kind == 5 && trunk > 0;
        let mut confidence =
            (latents > 1 && kind % 3 != 0).then(|| self.chain(if shared_trunk { trunk } else { obs }, latents));
        if let Some(layers) = confidence.as_mut().filter(|layers| shared_trunk && layers.len() > 2) {
            *layers = vec![self.dense(latents, trunk)];
        }
        let decoder = if self.byte().is_multiple_of(4) {
            FloatDecoder::Table { actions: vec![vec![0.0; count]; latents] }
        } else {
            let width = self.between(1, 9);
            let state = self.dense(width, obs);
            let scale = (0..latents).map(|_| self.numbers(width)).collect();
            let shift = (0..latents).map(|_| self.numbers(width)).collect();
            let hidden = if self.byte().is_multiple_of(2) { vec![] } else { vec![self.dense(5, width)] };
            let last = hidden.last().map_or(width, |layer: &Dense| layer.rows);
            FloatDecoder::Modulated { state, scale, shift, hidden, head: self.dense(rows, last) }
        };
        FloatModel {
            interface: Interface {
                observations: (0..obs)
                    .map(|i| ObservationSlot { name: format!("o{i}"), unit: String::new(), lo: -1.0, hi: 1.0 })
                    .collect(),
                actions,
                control_period_us: 1000,
            },
            obs_mean: self.numbers(obs),
            obs_std: (0..obs).map(|_| self.number().abs().max(1e-5)).collect(),
            q,
            confidence,
            shared_trunk,
            beta: (f32::from(self.byte()) + 1.0) / 257.0,
            decoder,
            heads,
            provenance: ProvenanceOwned { environment: "fuzz".into(), ..ProvenanceOwned::default() },
        }
    }
}

/// The policies of sixteen fixed seeds.
pub fn policies() -> Vec<AlignedImage> {
    (1u32..=16)
        .filter_map(|seed| {
            let mut state = seed;
            let mut next = || {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 24) as u8 & 0x7F
            };
            let bytes: Vec<u8> = (0..3000).map(|_| next()).collect();
            let model = Source(&bytes).model();
            let obs = model.obs_mean.repeat(2);
            let quantised = quantise(&model, &obs, &QuantiseOptions::default()).ok()?;
            Some(AlignedImage::new(&write_int8(&quantised, &obs, &FileOptions::default()).ok()?))
        })
        .collect()
}
