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

    /// Lets all unknowns move together along a direction, by so many of it (one sigma).
    pub fn loosen_along(&mut self, direction: &DVector<f64>, sigma: f64) {
        self.covariance += direction * direction.transpose() * (sigma * sigma);
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

    /// For each measurement what the belief and all others let expect of it, with the sigma of finding another: its own noise
    /// included. (The inverse of the whole covariance gives both at once.)
    pub fn leave_one_out(&self, rows: &[DVector<f64>], values: &[f64], noise: &DMatrix<f64>) -> Vec<Known> {
        let surprise = self.surprise(rows, values, noise);
        let Some(inverse) = surprise.spread.cholesky().map(|factor| factor.inverse()) else {
            return values.iter().map(|&value| Known { value, sigma: f64::INFINITY }).collect();
        };
        let weighed = &inverse * surprise.innovation;
        let one = |(i, value): (usize, &f64)| Known {
            value: value - weighed[i] / inverse[(i, i)],
            sigma: inverse[(i, i)].sqrt().recip(),
        };
        values.iter().enumerate().map(one).collect()
    }

    /// By which factor of these all measurements are off together, with the sigma that it would have by chance.
    pub fn common_factor(
        &self,
        rows: &[DVector<f64>],
        per_factor: &[f64],
        values: &[f64],
        noise: &DMatrix<f64>,
    ) -> Option<Known> {
        let surprise = self.surprise(rows, values, noise);
        let per_factor = DVector::from_column_slice(per_factor);
        let solved = surprise.spread.cholesky()?.solve(&per_factor);
        let weight = solved.dot(&per_factor);
        let value = solved.dot(&surprise.innovation) / weight;
        (weight > 0.0).then(|| Known { value, sigma: weight.sqrt().recip() })
    }

    /// Takes measurements in: one row, value each, and the noise's covariance. A noise that leaves nothing to
    /// invert (all zero on a settled belief) changes nothing.
    pub fn update(&mut self, rows: &[DVector<f64>], values: &[f64], noise: &DMatrix<f64>) {
        if rows.is_empty() {
            return;
        }
        let Surprise { cross, innovation, spread } = self.surprise(rows, values, noise);
        let Some(factor) = spread.cholesky() else { return };
        self.mean += &cross * factor.solve(&innovation);
        self.covariance -= &cross * factor.solve(&cross.transpose());
        // Rounding must not make it lopsided over many parts.
        self.covariance = (&self.covariance + self.covariance.transpose()) * 0.5;
    }

    /// The normal distribution with mean and covariance of a mixture: this one, or the other with this chance.
    pub fn mixed(&self, other: &Belief, chance: f64) -> Belief {
        let apart = &other.mean - &self.mean;
        Belief {
            mean: &self.mean + &apart * chance,
            covariance: &self.covariance * (1.0 - chance)
                + &other.covariance * chance
                + &apart * apart.transpose() * (chance * (1.0 - chance)),
        }
    }

    fn surprise(&self, rows: &[DVector<f64>], values: &[f64], noise: &DMatrix<f64>) -> Surprise {
        let h = DMatrix::from_fn(rows.len(), self.len(), |i, k| rows[i][k]);
        let cross = &self.covariance * h.transpose();
        Surprise {
            innovation: DVector::from_column_slice(values) - &h * &self.mean,
            spread: &h * &cross + noise,
            cross,
        }
    }
}

/// What measurements say beyond the belief.
struct Surprise {
    /// Covariance of the unknowns with what is measured.
    cross: DMatrix<f64>,
    /// Measured less expected.
    innovation: DVector<f64>,
    /// Its covariance.
    spread: DMatrix<f64>,
}
