//! Normal equations of the whole tube from one moment matrix per segment.
//!
//! Between `moments` or `sections` (the sums over the data) and `fit` or `evidence` (the solvers). A parameter moves
//! rigidly all that lies downstream of it, so the moments are needed only as their sums from each segment to the end:
//! the cost is quadratic in the number of parameters with a small factor, and does not depend on the points.

use nalgebra::{DMatrix, DVector, Matrix6, SMatrix, Vector6};

use super::model::{Motion, Parameter, TubeModel, in_frame};
use super::moments::{Moment, RESIDUAL, SQUARE};
use crate::tube::{Frame, Spine};

/// Sums over a part of the tube, twists seen from the start frame.
#[derive(Debug, Clone)]
pub struct Part {
    /// Twist against twist.
    pub square: Matrix6<f64>,
    /// Twist against every column of the moment that is none (its own values, tube radius, residual).
    pub mixed: SMatrix<f64, 6, NO_TWIST>,
}

/// First of the columns of a moment that are no twist.
const OWN: usize = 6;
const NO_TWIST: usize = SQUARE - OWN;

impl Part {
    /// Nothing yet.
    pub fn empty() -> Part {
        Part { square: Matrix6::zeros(), mixed: SMatrix::zeros() }
    }

    /// A full (symmetric) moment of a segment that has twists `seen` so ([`to_segment`]).
    pub fn of(moment: &Moment, seen: &Matrix6<f64>) -> Part {
        Part {
            square: seen.transpose() * moment.fixed_view::<6, 6>(0, 0) * seen,
            mixed: seen.transpose() * moment.fixed_view::<6, NO_TWIST>(0, OWN),
        }
    }

    /// Adds another part.
    pub fn add(&mut self, other: &Part) {
        self.square += other.square;
        self.mixed += other.mixed;
    }

    /// Twist against the residual.
    pub fn gradient(&self) -> Vector6<f64> {
        self.against(RESIDUAL)
    }

    /// Twist against a row of the moment that is no twist.
    pub fn against(&self, row: usize) -> Vector6<f64> {
        self.mixed.column(row - OWN).into_owned()
    }
}

/// Normal matrix J^T W J and gradient J^T W r of all parameters. `moments`: lower triangles, one per segment.
pub fn equations(
    moments: &[Moment],
    model: &TubeModel,
    parameters: &[Parameter],
) -> (DMatrix<f64>, DVector<f64>) {
    let spine = Spine::from_lra(&model.lra, Frame::identity());
    let full: Vec<Moment> = moments.iter().map(symmetric).collect();
    let parts: Vec<Part> =
        full.iter().zip(spine.segments()).map(|(m, s)| Part::of(m, &to_segment(&s.start))).collect();
    let mut downstream = parts.clone();
    for k in (0..parts.len().saturating_sub(1)).rev() {
        let after = downstream[k + 1].clone();
        downstream[k].add(&after);
    }
    let columns = model.columns(parameters);
    // What follows a twist feels of it, as seen by any twist further upstream.
    let felt: Vec<Vector6<f64>> = columns
        .iter()
        .map(|c| match c.motion {
            Motion::Twist { from, twist } => downstream[from].square * twist,
            _ => Vector6::zeros(),
        })
        .collect();
    let product = |a: usize, b: usize| match (columns[a].motion, columns[b].motion) {
        (Motion::Twist { from, twist }, Motion::Twist { from: other_from, twist: other }) => {
            if from <= other_from { twist.dot(&felt[b]) } else { other.dot(&felt[a]) }
        }
        (Motion::Twist { from, twist }, Motion::Own { segment, row })
        | (Motion::Own { segment, row }, Motion::Twist { from, twist }) => {
            if from <= segment {
                twist.dot(&parts[segment].against(row))
            } else {
                0.0
            }
        }
        (Motion::Twist { from, twist }, Motion::Everywhere { row })
        | (Motion::Everywhere { row }, Motion::Twist { from, twist }) => {
            twist.dot(&downstream[from].against(row))
        }
        (Motion::Own { segment, row }, Motion::Own { segment: other, row: other_row }) => {
            if segment == other { full[segment][(row, other_row)] } else { 0.0 }
        }
        (Motion::Own { segment, row }, Motion::Everywhere { row: other })
        | (Motion::Everywhere { row: other }, Motion::Own { segment, row }) => full[segment][(row, other)],
        (Motion::Everywhere { row }, Motion::Everywhere { row: other }) => {
            full.iter().map(|m| m[(row, other)]).sum()
        }
    };
    let n = parameters.len();
    let (mut matrix, mut gradient) = (DMatrix::zeros(n, n), DVector::zeros(n));
    for (a, column) in columns.iter().enumerate() {
        let i = column.parameter;
        gradient[i] += match column.motion {
            Motion::Twist { from, twist } => twist.dot(&downstream[from].gradient()),
            Motion::Own { segment, row } => full[segment][(row, RESIDUAL)],
            Motion::Everywhere { row } => full.iter().map(|m| m[(row, RESIDUAL)]).sum(),
        };
        matrix[(i, i)] += product(a, a);
        for (b, other) in columns.iter().enumerate().skip(a + 1) {
            let value = product(a, b);
            matrix[(i, other.parameter)] += value;
            matrix[(other.parameter, i)] += value;
        }
    }
    (matrix, gradient)
}

/// The whole matrix of a lower triangle.
pub fn symmetric(moment: &Moment) -> Moment {
    let mut full = *moment;
    full.fill_upper_triangle_with_lower_triangle();
    full
}

/// Matrix that takes a twist to how `frame` sees it.
pub fn to_segment(frame: &Frame) -> Matrix6<f64> {
    let column = |k: usize| {
        let mut twist = Vector6::zeros();
        twist[k] = 1.0;
        in_frame(&twist, frame)
    };
    Matrix6::from_columns(&[0, 1, 2, 3, 4, 5].map(column))
}
