//! The normal equations of how the parts of a scan lie on each other, what belongs to the tube's short stretches eliminated.
//!
//! Under `realign`: sums of many small chunks, from which the equations of any few passes follow without the points.

use std::ops::AddAssign;

use nalgebra::{Cholesky, DMatrix, DVector, Matrix5, SMatrix, SVector};

use super::super::section::VALUES;

/// Shift and turn of a pass.
pub const MOTION: usize = 6;

/// Products of a point's derivatives by its section's values, by its pass's motion, and of the residual.
pub type Sum = SMatrix<f64, 12, 12>;

/// Place of the residual among them.
const RESIDUAL: usize = VALUES + MOTION;

/// The normal equations of the chunks' motions and, last, of the tube's radius; block sums from the first chunk on.
pub struct Blocks {
    /// Their number.
    pub chunks: usize,
    square: DMatrix<f64>,
    right: DVector<f64>,
    /// Variance of a point's residual, and over that of a motion's expected millimetres.
    variance_mm2: f64,
    stiffness: f64,
}

impl Blocks {
    /// No points yet, of this noise; motions are expected to be about `spread_mm`.
    pub fn empty(chunks: usize, noise_mm: f64, spread_mm: f64) -> Blocks {
        let n = MOTION * chunks + 1;
        let (variance_mm2, stiffness) = (noise_mm * noise_mm, (noise_mm / spread_mm).powi(2));
        Blocks { chunks, square: DMatrix::zeros(n, n), right: DVector::zeros(n), variance_mm2, stiffness }
    }

    /// By how much the squared residuals fall, over the noise's variance, when the chunks between boundaries move together; and
    /// how they move.
    pub fn gain(&self, boundaries: &[usize]) -> Option<(f64, DVector<f64>)> {
        let (mut square, right) = self.together(boundaries);
        let last = right.len() - 1;
        (0..last).for_each(|k| square[(k, k)] += self.stiffness);
        square[(last, last)] += 1e-9 * (1.0 + square[(last, last)]);
        let motions = Cholesky::new(square)?.solve(&right);
        Some((motions.dot(&right) / self.variance_mm2, motions))
    }

    /// Adds a section: chunk by chunk its sums; its own values, as firm as `stiff`, are eliminated.
    pub fn add(&mut self, sums: &[(usize, Sum)], stiff: &[f64; VALUES]) {
        let all: Sum = sums.iter().map(|(_, sum)| sum).sum();
        let shared: Matrix5<f64> = all.fixed_view::<VALUES, VALUES>(0, 0).into_owned();
        let held = shared + Matrix5::from_diagonal(&SVector::from(*stiff));
        let Some(inverse) = Cholesky::new(held).map(|c| c.inverse()) else { return };
        let left: SVector<f64, VALUES> = all.fixed_view::<VALUES, 1>(0, RESIDUAL).into_owned();
        let radius = shared.column(0).into_owned();
        let last = self.right.len() - 1;
        self.square[(last, last)] += shared[(0, 0)] - radius.dot(&(inverse * radius));
        self.right[last] -= left[0] - radius.dot(&(inverse * left));
        for (c, sum) in sums {
            let at = MOTION * c;
            let mixed = sum.fixed_view::<VALUES, MOTION>(0, VALUES);
            let felt = inverse * mixed;
            let own = sum.fixed_view::<MOTION, MOTION>(VALUES, VALUES);
            let mut square = self.square.fixed_view_mut::<MOTION, MOTION>(at, at);
            square += own;
            for (other, sum) in sums {
                let mixed = sum.fixed_view::<VALUES, MOTION>(0, VALUES);
                let mut square = self.square.fixed_view_mut::<MOTION, MOTION>(at, MOTION * other);
                square -= felt.transpose() * mixed;
            }
            let with_radius = mixed.row(0).transpose() - felt.transpose() * radius;
            let mut column = self.square.fixed_view_mut::<MOTION, 1>(at, last);
            column += with_radius;
            let mut right = self.right.fixed_rows_mut::<MOTION>(at);
            right -= sum.fixed_view::<MOTION, 1>(VALUES, RESIDUAL) - felt.transpose() * left;
        }
    }

    /// The equations of chunks that were summed where these motions took them, for motions from where they lay before.
    pub fn about(mut self, motions: &DVector<f64>) -> Blocks {
        let n = MOTION * self.chunks;
        let taken = motions.rows(0, n);
        let right = self.square.view((0, 0), (n, n)) * taken;
        let radius = self.square.view((0, n), (n, 1)).dot(&taken);
        self.right.rows_mut(0, n).add_assign(&right);
        self.right[n] += radius;
        self
    }

    /// Every block with all blocks before it, so that those of consecutive chunks together are a few differences.
    pub fn summed(mut self) -> Blocks {
        let n = MOTION * self.chunks;
        for at in MOTION..n {
            self.right[at] += self.right[at - MOTION];
            for other in 0..n + 1 {
                self.square[(at, other)] += self.square[(at - MOTION, other)];
            }
        }
        for other in MOTION..n {
            for at in 0..n {
                self.square[(at, other)] += self.square[(at, other - MOTION)];
            }
        }
        self
    }

    /// The equations when all chunks between two boundaries move as one.
    fn together(&self, boundaries: &[usize]) -> (DMatrix<f64>, DVector<f64>) {
        let ends: Vec<usize> = boundaries.iter().copied().chain([self.chunks]).collect();
        let n = MOTION * ends.len() + 1;
        let last = MOTION * self.chunks;
        let (mut square, mut right) = (DMatrix::zeros(n, n), DVector::zeros(n));
        let before = |k: usize| if k == 0 { 0 } else { ends[k - 1] };
        // Of all chunks before an end, by the last of them.
        let upto = |end: usize, i: usize| end.checked_sub(1).map(|chunk| MOTION * chunk + i);
        let sum = |row: Option<usize>, column: Option<usize>| match (row, column) {
            (Some(row), Some(column)) => self.square[(row, column)],
            _ => 0.0,
        };
        for k in 0..ends.len() {
            for i in 0..MOTION {
                let (row, to, from) = (MOTION * k + i, upto(ends[k], i), upto(before(k), i));
                right[row] = to.map_or(0.0, |r| self.right[r]) - from.map_or(0.0, |r| self.right[r]);
                for m in 0..ends.len() {
                    for j in 0..MOTION {
                        let (until, since) = (upto(ends[m], j), upto(before(m), j));
                        square[(row, MOTION * m + j)] =
                            sum(to, until) - sum(from, until) - sum(to, since) + sum(from, since);
                    }
                }
                let with_radius = sum(to, Some(last)) - sum(from, Some(last));
                (square[(row, n - 1)], square[(n - 1, row)]) = (with_radius, with_radius);
            }
        }
        square[(n - 1, n - 1)] = self.square[(last, last)];
        right[n - 1] = self.right[last];
        (square, right)
    }
}
