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

    /// One unknown by itself.
    pub fn unknown(&self, index: usize) -> Known {
        Known { value: self.mean[index], sigma: self.covariance[(index, index)].max(0.0).sqrt() }
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
        if let ([row], [value]) = (rows, values) {
            return self.update_one(row, *value, noise[(0, 0)]);
        }
        if rows.is_empty() {
            return;
        }
        let Surprise { cross, innovation, spread } = self.surprise(rows, values, noise);
        let Some(factor) = spread.cholesky() else { return };
        // Both in units of independent measurements, which spares half of the solving.
        let Some(cross) = factor.l_dirty().solve_lower_triangular(&cross.transpose()) else { return };
        let Some(innovation) = factor.l_dirty().solve_lower_triangular(&innovation) else { return };
        self.mean += cross.tr_mul(&innovation);
        self.covariance -= cross.tr_mul(&cross);
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

    /// The same for one measurement.
    fn update_one(&mut self, row: &DVector<f64>, value: f64, noise: f64) {
        let cross = &self.covariance * row;
        let spread = row.dot(&cross) + noise;
        if spread.is_nan() || spread <= 0.0 {
            return;
        }
        let independent = cross / spread.sqrt();
        let innovation = (value - row.dot(&self.mean)) / spread.sqrt();
        self.mean.axpy(innovation, &independent, 1.0);
        self.covariance.ger(-1.0, &independent, &independent, 1.0);
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

#[cfg(test)]
mod tests {
    use super::*;

    /// The shortcut and the way by matrices say the same; two independent measurements are one after the other.
    #[test]
    fn one_after_the_other_is_all_at_once() {
        let unknowns = [(1.0, 0.5), (-2.0, 0.3), (0.0, 2.0)].map(|(value, sigma)| Known { value, sigma });
        let rows = [[1.0, 0.5, 0.0], [0.3, -1.0, 2.0]].map(|row| DVector::from_row_slice(&row));
        let (values, variances) = ([0.7, 1.9], [0.04, 0.25]);
        let mut together = Belief::new(&unknowns);
        together.loosen_along(&DVector::from_row_slice(&[1.0, 1.0, -1.0]), 0.4);
        let mut singly = together.clone();
        let noise = DMatrix::from_diagonal(&DVector::from_row_slice(&variances));
        together.update(&rows, &values, &noise);
        for k in 0..2 {
            singly.update(&rows[k..=k], &values[k..=k], &DMatrix::from_element(1, 1, variances[k]));
        }
        assert!((&together.mean - &singly.mean).norm() < 1e-12);
        assert!((&together.covariance - &singly.covariance).norm() < 1e-12);
        assert_eq!(singly.covariance, singly.covariance.transpose());
    }
}
