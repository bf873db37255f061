//! How far the integers of each layer are from what they stand for.

use gadm_runtime::encode::Trace;

/// Sums of one output of a layer: reference, measured, and their product.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Row {
    xx: f64,
    yy: f64,
    xy: f64,
}

impl Row {
    fn add(&mut self, reference: f32, measured: f32) {
        let (x, y) = (f64::from(reference), f64::from(measured));
        self.xx += x * x;
        self.yy += y * y;
        self.xy += x * y;
    }

    /// Squares of what is left of `measured` after the multiple of `reference` that fits best, since the units of a hidden layer
    /// are free; and those of `measured`.
    fn rest(&self) -> (f64, f64) {
        let explained = if self.xx > 0.0 { self.xy * self.xy / self.xx } else { 0.0 };
        ((self.yy - explained).max(0.0), self.yy)
    }
}

/// Differences of one layer between two forms of a policy.
#[derive(Clone, Debug, Default, PartialEq)]
struct Comparison {
    rows: Vec<Row>,
}

impl Comparison {
    fn add(&mut self, reference: &[f32], measured: &[f32]) {
        self.rows.resize(measured.len(), Row::default());
        for (row, (&x, &y)) in self.rows.iter_mut().zip(reference.iter().zip(measured)) {
            row.add(x, y);
        }
    }

    fn error(&self) -> f64 {
        let (rest, all) = self.rows.iter().map(Row::rest).fold((0.0, 0.0), |sum, row| (sum.0 + row.0, sum.1 + row.1));
        if all > 0.0 { (rest / all).sqrt() } else { 0.0 }
    }
}

/// Root-mean-square errors of one layer's outputs, as a share of their root mean square. What came into the layer was off already,
/// so errors add up from layer to layer.
#[derive(Clone, Debug, PartialEq)]
pub struct LayerError {
    /// `q.0`, `confidence.1`, `decoder.2`, ...
    pub layer: String,
    /// Rounding of weights: the file's weights as floats against the networks of the run; `None` without them.
    pub weights: Option<f64>,
    /// Rounding of inputs and activations: integers against the file's weights as floats.
    pub activations: f64,
    /// Integers against the networks of the run; `None` without them.
    pub all: Option<f64>,
}

/// Collects [`LayerError`]s over observations.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LayerErrors {
    layers: Vec<(String, [Comparison; 3])>,
    own: bool,
}

impl LayerErrors {
    /// Adds an observation: the file in integers, its weights as floats, and the networks of the run with their rows in the order of
    /// the file. A decoder counts where the latents are the same, for it answers to another question otherwise.
    pub fn add(&mut self, int: &Trace, dequantised: &Trace, own: Option<&Trace>) {
        if self.layers.is_empty() {
            self.layers = int.layers.iter().map(|layer| (layer.layer.clone(), Default::default())).collect();
        }
        self.own |= own.is_some();
        for (index, (name, [weights, activations, all])) in self.layers.iter_mut().enumerate() {
            let decoder = name.starts_with("decoder");
            let comparable = |a: &Trace, b: &Trace| !decoder || a.latent == b.latent;
            if comparable(dequantised, int) {
                activations.add(&dequantised.layers[index].outputs, &int.layers[index].outputs);
            }
            let Some(own) = own else { continue };
            if comparable(own, dequantised) {
                weights.add(&own.layers[index].outputs, &dequantised.layers[index].outputs);
            }
            if comparable(own, int) {
                all.add(&own.layers[index].outputs, &int.layers[index].outputs);
            }
        }
    }

    /// The errors by layer, in file order.
    pub fn errors(&self) -> Vec<LayerError> {
        let of = |comparison: &Comparison| self.own.then(|| comparison.error());
        self.layers
            .iter()
            .map(|(layer, [weights, activations, all])| LayerError {
                layer: layer.clone(),
                weights: of(weights),
                activations: activations.error(),
                all: of(all),
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gadm_runtime::LatentMask;
    use gadm_runtime::encode::LayerTrace;

    fn trace(latent: u16, q: &[f32], decoder: &[f32]) -> Trace {
        let layer = |name: &str, outputs: &[f32]| LayerTrace { layer: name.into(), outputs: outputs.to_vec() };
        Trace {
            latent,
            allowed: LatentMask::full(2),
            fallback: false,
            q: vec![0.0; 2],
            confidence: None,
            actions: Vec::new(),
            layers: vec![layer("q.0", q), layer("decoder.0", decoder)],
        }
    }

    #[test]
    fn the_unit_of_a_row_does_not_count() {
        let mut errors = LayerErrors::default();
        for x in [1.0, 2.0, -3.0] {
            errors.add(&trace(0, &[10.0 * x, -x], &[x]), &trace(0, &[x, 7.0 * x], &[x]), None);
        }
        let errors = errors.errors();
        assert_eq!(errors[0].layer, "q.0");
        assert!(errors[0].activations < 1e-7, "{errors:?}");
        assert_eq!((errors[0].weights, errors[0].all), (None, None));
    }

    #[test]
    fn the_error_is_the_rest_after_the_best_multiple() {
        // Reference (1, 1), measured (1, 0): the multiple 1/2 leaves (1/2, -1/2), a half of the squares of (1, 0).
        let mut errors = LayerErrors::default();
        let own = trace(0, &[1.0], &[1.0]);
        errors.add(&trace(0, &[1.0], &[1.0]), &own, Some(&own));
        errors.add(&trace(0, &[0.0], &[1.0]), &own, Some(&own));
        let q = &errors.errors()[0];
        assert!((q.activations - 0.5f64.sqrt()).abs() < 1e-9 && (q.all.unwrap_or(9.0) - 0.5f64.sqrt()).abs() < 1e-9);
        assert_eq!(q.weights, Some(0.0));
    }

    #[test]
    fn decoders_of_different_latents_are_not_compared() {
        let mut errors = LayerErrors::default();
        errors.add(&trace(0, &[1.0], &[1.0]), &trace(0, &[1.0], &[1.0]), None);
        errors.add(&trace(0, &[1.0], &[-5.0]), &trace(1, &[1.0], &[5.0]), None);
        assert_eq!(errors.errors()[1].activations, 0.0);
    }
}
