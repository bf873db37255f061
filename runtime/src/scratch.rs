//! Work memory that the caller owns.

use crate::schema::padded;

/// Work memory of a step. One scratch serves any number of policies one after the other; nothing is kept between steps.
///
/// The memory is `u32` so that it is 4-byte aligned; its length must be at least
/// [`PolicySpec::scratch_words`](crate::PolicySpec::scratch_words).
#[derive(Debug)]
pub struct Scratch<'m> {
    pub(crate) memory: &'m mut [u32],
}

impl<'m> Scratch<'m> {
    /// Wraps `memory`. Its content does not matter.
    #[must_use]
    pub fn new(memory: &'m mut [u32]) -> Self {
        Self { memory }
    }

    /// Number of words.
    #[must_use]
    pub fn words(&self) -> usize {
        self.memory.len()
    }
}

/// Words that an int8 policy of these dimensions needs, for static arrays:
/// `static mut WORK: [u32; scratch_words(11, 256, 64, true, 153)]`.
///
/// `hidden_width` is the widest hidden layer of all networks (0 without hidden layers), `head_rows` the rows of the
/// decoder's last layer (0 for a table decoder).
#[must_use]
pub const fn scratch_words(
    obs_dim: usize,
    hidden_width: usize,
    num_latents: usize,
    confidence: bool,
    head_rows: usize,
) -> usize {
    let input = padded(obs_dim, 16) / 2;
    let hidden = padded(hidden_width, 16) / 2;
    let latents = padded(num_latents, 4);
    let select = if confidence { latents * 2 } else { latents };
    let head = padded(head_rows, 4);
    input + 2 * hidden + if select > head { select } else { head }
}

/// As [`scratch_words`], for a policy with `f32` weights.
#[must_use]
pub const fn scratch_words_float(
    obs_dim: usize,
    hidden_width: usize,
    num_latents: usize,
    confidence: bool,
    head_rows: usize,
) -> usize {
    let select = if confidence { num_latents * 2 } else { num_latents };
    obs_dim + 2 * hidden_width + if select > head_rows { select } else { head_rows }
}

#[cfg(test)]
mod tests {
    use super::{scratch_words, scratch_words_float};

    #[test]
    fn the_hopper_networks_fit_in_1680_bytes() {
        assert_eq!(scratch_words(11, 256, 64, true, 153) * 4, 1680);
        assert_eq!(scratch_words_float(11, 256, 64, true, 153) * 4, 2704);
    }
}
