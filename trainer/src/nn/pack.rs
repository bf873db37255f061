//! Matrices as the register tiles of [`super::kernel`] read them: forward only.

/// Columns of a panel.
pub const PANEL: usize = 16;
/// Rows of a tile.
pub const TILE: usize = 6;

/// Length of a matrix of `rows x cols` in panels.
pub fn panels_len(rows: usize, cols: usize) -> usize {
    cols.div_ceil(PANEL) * PANEL * rows
}

/// Length of the groups of a matrix of `m x k`.
pub fn groups_len(m: usize, k: usize) -> usize {
    m.div_ceil(TILE) * TILE * k
}

/// Writes row-major `x` (`rows x cols`) in panels of its columns; columns that are not there are zero.
pub fn pack_panels(x: &[f32], rows: usize, cols: usize, out: &mut [f32]) {
    for (p, panel) in out.chunks_exact_mut(PANEL * rows).enumerate().take(cols.div_ceil(PANEL)) {
        pack_panel(x, cols, p * PANEL, panel);
    }
}

/// Writes the panel of row-major `x` (`rows x cols`) that starts with the column `at`.
#[inline(always)]
pub fn pack_panel(x: &[f32], cols: usize, at: usize, panel: &mut [f32]) {
    let width = (cols - at).min(PANEL);
    let rows = x.chunks_exact(cols).zip(panel.as_chunks_mut::<PANEL>().0);
    if width == PANEL {
        rows.for_each(|(row, to)| to.copy_from_slice(&row[at..at + PANEL]));
    } else {
        for (row, to) in rows {
            to[..width].copy_from_slice(&row[at..]);
            to[width..].fill(0.0);
        }
    }
}

/// Writes the transpose of row-major `x` (`cols x rows`) in panels of its columns (rows of `x`).
pub fn pack_panels_transposed(x: &[f32], rows: usize, cols: usize, out: &mut [f32]) {
    for (p, panel) in out.chunks_exact_mut(PANEL * rows).enumerate().take(cols.div_ceil(PANEL)) {
        let at = p * PANEL;
        let width = (cols - at).min(PANEL);
        if width < PANEL {
            panel.fill(0.0);
        }
        // Eight numbers of a row at a time: each line of `x` is read once, and eight lines of the panel stay in the cache.
        for start in (0..rows).step_by(8) {
            let n = (rows - start).min(8);
            let block = &mut panel[start * PANEL..(start + n) * PANEL];
            for j in 0..width {
                let from = &x[(at + j) * rows + start..][..n];
                for (to, &v) in block.chunks_exact_mut(PANEL).zip(from) {
                    to[j] = v;
                }
            }
        }
    }
}

/// Groups that are packed side by side: three whole lines of the cache of each row.
const SIDE_BY_SIDE: usize = 8;

/// Writes the transpose of row-major `x` (`k x m`) in groups of [`TILE`] of its columns; columns that are not there are zero.
/// Sets `sums` (`m`) to the sum of each column on the way, rows in turn.
#[inline(always)]
pub fn pack_groups_and_sum(x: &[f32], m: usize, k: usize, out: &mut [f32], sums: &mut [f32]) {
    const WIDE: usize = SIDE_BY_SIDE * TILE;
    let whole = m / WIDE * WIDE;
    let (wide, out) = out.split_at_mut(whole * k);
    let (wide_sums, sums) = sums[..m].split_at_mut(whole);
    for ((i, out), sums) in wide.chunks_exact_mut(WIDE * k).enumerate().zip(wide_sums.as_chunks_mut::<WIDE>().0) {
        let mut groups = out.chunks_exact_mut(TILE * k).map(|group| group.as_chunks_mut::<TILE>().0);
        let mut groups: [_; SIDE_BY_SIDE] = std::array::from_fn(|_| groups.next().expect("as many groups"));
        let mut total = [0.0; WIDE];
        for (b, row) in x.chunks_exact(m).enumerate().take(k) {
            let row = &row[i * WIDE..][..WIDE];
            for (group, columns) in groups.iter_mut().zip(row.as_chunks().0) {
                group[b] = *columns;
            }
            total.iter_mut().zip(row).for_each(|(t, v)| *t += v);
        }
        *sums = total;
    }
    for ((g, group), sums) in out.chunks_exact_mut(TILE * k).enumerate().zip(sums.chunks_mut(TILE)) {
        let at = whole + g * TILE;
        let rows = x.chunks_exact(m).zip(group.as_chunks_mut::<TILE>().0);
        let mut total = [0.0; TILE];
        if sums.len() == TILE {
            for (row, to) in rows {
                to.copy_from_slice(&row[at..at + TILE]);
                total.iter_mut().zip(&*to).for_each(|(t, v)| *t += v);
            }
        } else {
            for (row, to) in rows {
                to[sums.len()..].fill(0.0);
                to[..sums.len()].copy_from_slice(&row[at..]);
                total.iter_mut().zip(&*to).for_each(|(t, v)| *t += v);
            }
        }
        sums.copy_from_slice(&total[..sums.len()]);
    }
}
