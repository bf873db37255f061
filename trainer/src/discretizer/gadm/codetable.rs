//! The code table: K vectors of length D that stand for the latent actions (specification 2.4).

use serde::{Deserialize, Serialize};

/// How the table is made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Codetable {
    /// Fixed unit vectors (paper, section 3.2).
    #[default]
    OneHot,
    /// Fixed dyadic cell centres of the cube (paper, section 3.2; construction: specification 2.4 b).
    Bisection,
    /// `U(±1/K)` rows trained by the embedding loss (the predecessor's; ablation).
    Learned,
}

/// Rows of the bisection table, `k x d` row-major. Bit `i` of a code (lowest first) belongs to axis `i mod d`; an axis's bits,
/// first assigned most significant, select the centre of one of its equal cells of -1..=1.
pub fn bisection(k: usize, d: usize) -> Vec<f32> {
    let bits = k.next_power_of_two().trailing_zeros() as usize;
    let mut table = vec![0.0; k * d];
    for (code, row) in table.chunks_exact_mut(d).enumerate() {
        for (axis, value) in row.iter_mut().enumerate() {
            let own = (axis..bits).step_by(d);
            let count = own.clone().count();
            if count > 0 {
                let cell = own.fold(0, |cell, bit| cell << 1 | (code >> bit) & 1);
                *value = -1.0 + (2 * cell + 1) as f32 / (1_usize << count) as f32;
            }
        }
    }
    table
}

#[cfg(test)]
mod tests {
    use super::bisection;

    /// Specification, appendix A, item 2.
    #[test]
    fn bisection_tables_are_the_specified_ones() {
        let mut line = bisection(4, 1);
        line.sort_by(f32::total_cmp);
        assert_eq!(line, [-0.75, -0.25, 0.25, 0.75]);
        let cube = bisection(8, 3);
        assert!(cube.iter().all(|v| v.abs() == 0.5));
        let plane = bisection(8, 2);
        let axis = |a: usize| {
            let mut values: Vec<f32> = plane.iter().skip(a).step_by(2).copied().collect();
            values.sort_by(f32::total_cmp);
            values.dedup();
            values.len()
        };
        assert_eq!((axis(0), axis(1)), (4, 2));
        for (i, a) in plane.chunks(2).enumerate() {
            assert!(plane.chunks(2).skip(i + 1).all(|b| a != b), "rows are distinct");
        }
        assert_eq!(bisection(5, 3), bisection(8, 3)[..15]);
    }
}
