//! A Gaussian belief over a few unknowns, updated by linear measurements (R. E. Kalman 1960, static form).

use nalgebra::{DMatrix, DVector};

use crate::inspect::Known;

/// Mean and covariance.
#[derive(Debug, Clone, PartialEq)]
pub struct Belief {
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
}

impl Belief {
    /// Independent unknowns.
    pub fn new(unknowns: &[Known]) -> Belief {
        let mean = DVector::from_iterator(unknowns.len(), unknowns.iter().map(|k| k.value));
        let variances = DVector::from_iterator(unknowns.len(), unknowns.iter().map(|k| k.sigma.powi(2)));
        Belief { mean, covariance: DMatrix::from_diagonal(&variances) }
    }

    /// Number of unknowns.
    pub fn len(&self) -> usize {
        self.mean.len()
    }

    /// Lets one unknown drift: its variance grows.
    pub fn loosen(&mut self, index: usize, sigma: f64) {
        self.covariance[(index, index)] += sigma * sigma;
    }

    /// What a row of coefficients would measure.
    pub fn predict(&self, row: &DVector<f64>) -> Known {
        let variance = (&self.covariance * row).dot(row);
        Known { value: self.mean.dot(row), sigma: variance.max(0.0).sqrt() }
    }

    /// Takes measurements in: one row, value each, and the noise's covariance. A noise that leaves nothing to
    /// invert (all zero on a settled belief) changes nothing.
    pub fn update(&mut self, rows: &[DVector<f64>], values: &[f64], noise: &DMatrix<f64>) {
        if rows.is_empty() {
            return;
        }
        let h = DMatrix::from_fn(rows.len(), self.len(), |i, k| rows[i][k]);
        let innovation = DVector::from_column_slice(values) - &h * &self.mean;
        let cross = &self.covariance * h.transpose();
        let Some(factor) = (&h * &cross + noise).cholesky() else { return };
        self.mean += &cross * factor.solve(&innovation);
        self.covariance -= &cross * factor.solve(&cross.transpose());
        // Rounding must not make it lopsided over many parts.
        self.covariance = (&self.covariance + self.covariance.transpose()) * 0.5;
    }
}
