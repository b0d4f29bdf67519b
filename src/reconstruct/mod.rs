//! Cloud to measured tube: spine, arc-line spline, least-squares fit, uncertainty.
//!
//! Between `cloud` and `inspect`. The way of paper 000, stage by stage: the tube among what lies around it ([`scene`]: a
//! [`moderate`] cloud, tube [`radius`] from jets, points onto the spine by [`mls`] with [`cylinder`]s, polygon by
//! [`crust`], its points by [`owner`]), fewest vertices ([`simplify`]), fewest arcs ([`arcline`], [`apollonius`]), least
//! squares on all points ([`fit`], [`moments`]), ends and sigmas ([`measure`]).

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
mod guided;
mod likeness;
mod local;
mod measure;
pub mod mls;
pub mod model;
pub mod moderate;
pub mod moments;
mod moves;
mod normal;
mod outline;
pub mod owner;
mod places;
mod profile;
pub mod radius;
pub mod scene;
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
    /// The part that the scan should show: the fit starts from its bends (see `guided`), and its direction of travel
    /// becomes the measurement's.
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

/// Cell of the sample that decides the structure, in tube radii.
const SAMPLE_CELL_RADII: f64 = 0.2;

/// An angle is never left open: a tube with one less certain than this was not measured.
const MAX_ANGLE_SIGMA_RAD: f64 = 10.0 * std::f64::consts::PI / 180.0;

/// Share of the points that must lie on the tube.
const LEAST_USED_SHARE: f64 = 0.5;

/// What [`reconstruct_watched`] begins, for those who wait.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// What of the scan is the tube, and its centre line.
    CentreLine,
    /// Number and kind of the bends.
    Structure,
    /// Least squares on all points, ends, sigmas.
    Fit,
}

/// Reconstructs the tube that the cloud shows.
pub fn reconstruct(cloud: &PointCloud, options: &Options) -> Result<Reconstruction, ReconstructError> {
    reconstruct_watched(cloud, options, &mut |_| ())
}

/// The same, telling each stage as it begins.
pub fn reconstruct_watched(
    cloud: &PointCloud,
    options: &Options,
    begins: &mut dyn FnMut(Stage),
) -> Result<Reconstruction, ReconstructError> {
    use ReconstructError::{NotBent, PoorFit, Undetermined};
    match by(cloud, options, options.nominal, begins) {
        // Knowing the nominal never makes it worse.
        Err(NotBent { .. } | PoorFit { .. } | Undetermined { .. }) if options.nominal.is_some() => {
            by(cloud, options, None, begins)
        }
        found => found,
    }
}

/// Reconstructs with the structure by `guide`, or freely.
fn by(
    cloud: &PointCloud,
    options: &Options,
    guide: Option<&Nominal>,
    begins: &mut dyn FnMut(Stage),
) -> Result<Reconstruction, ReconstructError> {
    begins(Stage::CentreLine);
    let scene = scene::look(cloud, options.nominal)?;
    let (radius_mm, polygon) = (scene.radius_mm, scene.polygon);
    let own: Vec<Point3<f64>> = match &scene.own {
        Some(own) => own.iter().map(|&i| cloud.point(i as usize)).collect(),
        None => cloud.iter().collect(),
    };
    let points = own.len();
    let sample: Vec<Point3<f64>> = scene.thin.thinned(SAMPLE_CELL_RADII * radius_mm).iter().collect();
    let not_bent = || ReconstructError::NotBent {
        length_mm: crust::length_mm(&polygon),
        radius_mm,
        most: structure::MOST_BENDS,
    };
    begins(Stage::Structure);
    let chosen = match guide {
        Some(nominal) => guided::choose(&polygon, &sample, radius_mm, nominal),
        None => structure::choose(&polygon, &sample, radius_mm).map(|s| (s, Vec::new())),
    };
    let (chosen, notes) = chosen.ok_or_else(not_bent)?;
    let model = chosen.model;
    if moves::is_free_form(&model.lra, radius_mm) {
        return Err(not_bent());
    }
    begins(Stage::Fit);
    let mut all = Sample::new(own, &model);
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
    best.covariance = profile::tightened(&best.covariance, &best.parameters, &chosen.held);
    best.covariance *= CentreLine::measure(&all.points, &best.model, true).correlation(&best.model);
    let mut measured = measure::measure(&mut best, &mut all);
    if let Some(bend) = measured.bends.iter().position(|b| b.angle_sigma_rad > MAX_ANGLE_SIGMA_RAD) {
        let sigma_deg = measured.bends[bend].angle_sigma_rad.to_degrees();
        return Err(ReconstructError::Undetermined { bend: bend + 1, sigma_deg });
    }
    let own_residuals_mm = all.residuals(&best.model);
    let mut used: Vec<f64> =
        own_residuals_mm.iter().map(|r| r.abs()).filter(|r| *r < best.cutoff_mm).collect();
    measured.residual_median_mm = radius::median(&mut used).unwrap_or(0.0);
    measured.decisions = chosen.decisions;
    measured.points_total = cloud.len();
    measured.warnings.splice(0..0, scene.warnings.into_iter().chain(notes));
    // The points of the surroundings have a distance from the tube too.
    let residuals_mm = match scene.own {
        Some(_) => Sample::new(cloud.iter().collect(), &best.model).residuals(&best.model),
        None => own_residuals_mm,
    };
    let found = Reconstruction { measured, spine: best.model.spine(), lra: best.model.lra, residuals_mm };
    Ok(match options.nominal {
        Some(nominal) => direction::as_nominal(found, nominal),
        None => found,
    })
}
