//! Cloud to measured tube: spine, arc-line spline, least-squares fit, uncertainty.
//!
//! Between `cloud` and `inspect`. The way of paper 000, stage by stage: tube radius from jets ([`radius`]), points
//! onto the spine ([`mls`]), polygon ([`crust`]), fewest vertices ([`simplify`]), fewest arcs ([`arcline`],
//! [`apollonius`]), least squares on all points ([`fit`], [`moments`]), ends and sigmas ([`measure`]).

pub mod apollonius;
pub mod arcline;
pub mod bound;
pub mod crust;
pub mod cylinder;
mod direction;
mod ends;
mod error;
mod evidence;
mod face;
pub mod fit;
mod local;
mod measure;
pub mod mls;
pub mod model;
pub mod moments;
mod moves;
mod normal;
mod outline;
pub mod radius;
mod sections;
pub mod simplify;
pub mod structure;

pub use error::ReconstructError;
use nalgebra::Point3;

use crate::cloud::PointCloud;
use crate::tube::{Lra, MeasuredTube, Nominal, Spine};
use fit::{Effort, fit};
use moments::Sample;
use sections::CentreLine;

/// What may be known beforehand.
#[derive(Debug, Clone, Copy, Default)]
pub struct Options<'a> {
    /// The part that the scan should show: its direction of travel becomes the measurement's.
    pub nominal: Option<&'a Nominal>,
}

/// A reconstructed tube.
#[derive(Debug, Clone)]
pub struct Reconstruction {
    /// The measured values.
    pub measured: MeasuredTube,
    /// The fitted table, also those values that are too uncertain to be given as measured.
    pub lra: Lra,
    /// The centre line in the scan's coordinates, end to end.
    pub spine: Spine,
    /// Signed distance of every point of the cloud from the fitted surface, in the cloud's order.
    pub residuals_mm: Vec<f64>,
}

/// Spacing of the spine's polygon in tube radii.
const SPINE_SPACING_RADII: f64 = 0.3;

/// Cell of the sample that decides the structure, in tube radii.
const SAMPLE_CELL_RADII: f64 = 0.2;

/// Share of the places of the cloud that must find a spine.
const LEAST_SPINE_SHARE: f64 = 0.1;

/// A second chain of this share of the longest is another tube, not debris.
const SECOND_TUBE_SHARE: f64 = 0.15;

/// An angle is never left open: a tube with one less certain than this was not measured.
const MAX_ANGLE_SIGMA_RAD: f64 = 10.0 * std::f64::consts::PI / 180.0;

/// Share of the points that must lie on the tube.
const LEAST_USED_SHARE: f64 = 0.5;

/// Reconstructs the tube that the cloud shows.
pub fn reconstruct(cloud: &PointCloud, options: &Options) -> Result<Reconstruction, ReconstructError> {
    let points = cloud.len();
    let radius_mm = radius::estimate(cloud).ok_or(ReconstructError::NoTube { points })?;
    let polygon = centre_line(cloud, radius_mm)?;
    let sample: Vec<Point3<f64>> = cloud.thinned(SAMPLE_CELL_RADII * radius_mm).iter().collect();
    let not_bent = || ReconstructError::NotBent {
        length_mm: crust::length_mm(&polygon),
        radius_mm,
        most: structure::MOST_BENDS,
    };
    let chosen = structure::choose(&polygon, &sample, radius_mm).ok_or_else(not_bent)?;
    let model = chosen.model;
    if moves::is_free_form(&model.lra, radius_mm) {
        return Err(not_bent());
    }
    let mut all = Sample::new(cloud.iter().collect(), &model);
    let mut best = fit(
        &mut all,
        &model,
        Effort { cutoff_mm: 6.0 * chosen.noise_mm, rounds: 2, steps: 20, prior: chosen.prior },
    );
    if (best.used as f64) < LEAST_USED_SHARE * points as f64 {
        let bends = best.model.lra.bends.len();
        return Err(ReconstructError::PoorFit { used: best.used, points, radius_mm, bends });
    }
    // Sigmas by what the points say together, not by their number (see `CentreLine::correlation`).
    best.covariance *= CentreLine::measure(&all.points, &best.model).correlation(&best.model);
    let mut measured = measure::measure(&mut best, &mut all);
    if let Some(bend) = measured.bends.iter().position(|b| b.angle_sigma_rad > MAX_ANGLE_SIGMA_RAD) {
        let sigma_deg = measured.bends[bend].angle_sigma_rad.to_degrees();
        return Err(ReconstructError::Undetermined { bend: bend + 1, sigma_deg });
    }
    let residuals_mm = all.residuals(&best.model);
    let mut used: Vec<f64> = residuals_mm.iter().map(|r| r.abs()).filter(|r| *r < best.cutoff_mm).collect();
    measured.residual_median_mm = radius::median(&mut used).unwrap_or(0.0);
    let found = Reconstruction { measured, spine: best.model.spine(), lra: best.model.lra, residuals_mm };
    Ok(match options.nominal {
        Some(nominal) => direction::as_nominal(found, nominal),
        None => found,
    })
}

/// The spine's polygon through the whole tube.
fn centre_line(cloud: &PointCloud, radius_mm: f64) -> Result<Vec<Point3<f64>>, ReconstructError> {
    let spacing = SPINE_SPACING_RADII * radius_mm;
    let spine = mls::spine_cloud(cloud, radius_mm);
    let condensed = mls::condense(&spine, spacing);
    let mut found = crust::connect(&condensed, spacing, radius_mm);
    let lengths: Vec<f64> = found.chains.iter().map(|c| crust::solid_length_mm(c, spacing)).collect();
    let longest = lengths.first().copied().unwrap_or(0.0);
    if (spine.len() as f64) < LEAST_SPINE_SHARE * cloud.thinned(spacing).len() as f64 {
        return Err(ReconstructError::NoTube { points: cloud.len() });
    }
    if longest < 2.0 * radius_mm {
        let wanted_mm = 0.2 * radius_mm;
        return Err(ReconstructError::TooSparse {
            found: spine.len(),
            points: cloud.len(),
            radius_mm,
            wanted_mm,
        });
    }
    let tubes: Vec<f64> = lengths.into_iter().filter(|l| *l >= SECOND_TUBE_SHARE * longest).collect();
    if tubes.len() > 1 {
        return Err(ReconstructError::SeveralTubes { lengths_mm: tubes });
    }
    if found.closed {
        return Err(ReconstructError::Ring { length_mm: longest });
    }
    Ok(found.chains.swap_remove(0))
}
