//! Cloud to measured tube: spine, arc-line spline, least-squares fit, uncertainty.
//!
//! Between `cloud` and `inspect`. The way of paper 000, stage by stage: the tube among what lies around it ([`scene`]: a
//! [`moderate`] cloud, tube [`radius`] from jets, points onto the spine by [`mls`] with [`cylinder`]s, those that
//! `follow` one another joined by [`crust`], its points by [`owner`]), fewest vertices ([`simplify`]), fewest arcs
//! ([`arcline`], [`apollonius`]), how many bends ([`structure`], by `search` on the centre line measured in `sections`; once
//! more where `realign` finds that the scan's passes disagree), least squares on all points, ends and sigmas ([`finish`]).
//! Both fits descend by `fit` on normal equations that `normal` assembles from a moment per segment.

pub mod apollonius;
pub mod arcline;
pub mod bound;
pub mod crust;
pub mod cylinder;
mod direction;
mod edge;
mod ends;
mod error;
mod evidence;
mod face;
pub mod finish;
pub mod fit;
mod flattening;
mod follow;
mod guided;
mod in_order;
mod lanes;
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
mod passes;
mod places;
mod profile;
pub mod radius;
mod ramps;
mod reach;
mod realign;
pub mod scene;
mod search;
#[cfg(test)]
mod search_tests;
mod section;
mod sections;
mod seen;
mod shade;
pub mod simplify;
mod square;
mod strangers;
mod stretches;
mod stripes;
pub mod structure;
mod undecided;
mod whole;

pub use error::ReconstructError;
use nalgebra::Point3;

use crate::cloud::PointCloud;
use crate::tube::{Decision, Lra, MeasuredTube, Nominal, Spine};
use model::{Flattening, TubeModel};
use scene::Scene;
use structure::{Shown, Structure};
use whole::ScanPass;

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
    /// How oval each bend's section is, see [`TubeModel::ovality_mm`].
    pub ovality_mm: Vec<f64>,
    /// How flat each bend's outer wall is, see [`model::Flattening`]; empty where none is.
    pub flattening_mm: Vec<f64>,
}

impl Reconstruction {
    /// Signed distance of every point of a cloud from the fitted surface, in the cloud's order.
    pub fn residuals_mm(&self, cloud: &PointCloud) -> Vec<f64> {
        let start = self.spine.frame_at(0.0);
        let mut model = TubeModel::round(start, self.lra.clone(), self.measured.tube_radius_mm);
        model.ovality_mm.clone_from(&self.ovality_mm);
        if !self.flattening_mm.is_empty() {
            model.flattening =
                Flattening::Free { bends_mm: self.flattening_mm.clone(), spread_mm: f64::INFINITY };
        }
        whole::residuals_mm(cloud, &model)
    }
}

/// Cell of the sample that decides the structure, in tube radii.
const SAMPLE_CELL_RADII: f64 = 0.12;

/// The points that decide the structure.
pub fn sample(scene: &Scene) -> Vec<Point3<f64>> {
    scene.thin.thinned(SAMPLE_CELL_RADII * scene.radius_mm).iter().collect()
}

/// Searches with flattened outer walls at most.
const FLATTENINGS: usize = 3;

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
    use ReconstructError::{EndsInBend, NotBent, PoorFit, Undetermined};
    match by(cloud, options, options.nominal, begins) {
        // Knowing the nominal never makes it worse.
        Err(NotBent { .. } | PoorFit { .. } | Undetermined { .. } | EndsInBend { .. })
            if options.nominal.is_some() =>
        {
            by(cloud, options, None, begins)
        }
        found => found,
    }
}

/// The structure by `guide`, or freely, and notes on it. Flattened outer walls look like other bends: where there are some the
/// structure is searched again with them known, from the polygon and from what was found.
fn choose(shown: &mut Shown, guide: Option<&Nominal>) -> Option<(Structure, Vec<String>)> {
    let once = |shown: &Shown| match guide {
        Some(nominal) => guided::choose(shown, nominal),
        None => structure::choose(shown).map(|s| (s, Vec::new())),
    };
    let mut found = once(shown)?;
    for _ in 0..FLATTENINGS {
        let Some(walls) = flattening::walls(shown.sample, &found.0) else { break };
        shown.flattening = Flattening::Known(walls);
        shown.before = Some(found.0.model);
        found = once(shown)?;
    }
    Some(found)
}

/// Works on one of the pool's threads: from outside each of hundreds of short parallel loops would wait to be taken up.
fn in_pool<R: Send>(work: impl FnOnce() -> R + Send) -> R {
    rayon::scope(|_| work())
}

/// A scan with its passes moved onto each other.
struct Moved {
    passes: Vec<ScanPass>,
    sample: Vec<Point3<f64>>,
    flattening: Flattening,
    /// Its structure, and notes on it.
    found: (Structure, Vec<String>),
}

/// The passes moved as a tube about as this one asked for, which scattered by `noise_mm` before. None where there is one pass only,
/// and where the tube scatters no less after: then they were moved by what was missing of its shape.
fn moved(
    shown: &Shown,
    about: &Structure,
    (passes, gain): (Vec<ScanPass>, f64),
    noise_mm: f64,
    guide: Option<&Nominal>,
) -> Option<Moved> {
    if passes.is_empty() {
        return None;
    }
    let whole = shown.whole.moved(&passes);
    let sample = in_pool(|| realign::sample(&whole, &about.model));
    // What was found must not be lost: the polygon, which begins anew, is of the passes as they were.
    let (flattening, before) = (Flattening::NONE, Some(about.model.clone()));
    let mut again = Shown { whole, sample: &sample, flattening, before, ..*shown };
    let mut found = in_pool(|| choose(&mut again, guide))?;
    let what = format!("{} passes of the scan moved onto each other", passes.len());
    found.0.decisions.push(Decision { what, bend: None, gain, kept: true });
    let flattening = again.flattening;
    (found.0.noise_mm < noise_mm).then_some(Moved { passes, sample, flattening, found })
}

/// Reconstructs with the structure by `guide`, or freely.
fn by(
    cloud: &PointCloud,
    options: &Options,
    guide: Option<&Nominal>,
    begins: &mut dyn FnMut(Stage),
) -> Result<Reconstruction, ReconstructError> {
    begins(Stage::CentreLine);
    let scene = in_pool(|| scene::look(cloud, options.nominal))?;
    let (radius_mm, polygon) = (scene.radius_mm, &scene.polygon);
    let sample = sample(&scene);
    let not_bent = || ReconstructError::NotBent {
        length_mm: crust::length_mm(polygon),
        radius_mm,
        most: structure::MOST_BENDS,
    };
    begins(Stage::Structure);
    let mut shown = Shown::new(cloud, &scene, &sample);
    let (mut chosen, mut notes) = in_pool(|| choose(&mut shown, guide)).ok_or_else(not_bent)?;
    let asked = |about: &Structure| in_pool(|| realign::realigned(&shown.whole, about));
    let first = asked(&chosen);
    let several = !first.0.is_empty();
    let moved = moved(&shown, &chosen, first, chosen.noise_mm, guide).or_else(|| {
        let closest = several.then(|| in_pool(|| structure::closest(&shown, &chosen)))??;
        moved(&shown, &closest, asked(&closest), chosen.noise_mm, guide)
    });
    if let Some(Moved { passes, sample, flattening, .. }) = &moved {
        let flattening = flattening.clone();
        shown = Shown { whole: shown.whole.moved(passes), sample, flattening, ..shown };
    }
    (chosen, notes) = moved.as_ref().map_or((chosen, notes), |m| m.found.clone());
    if moves::is_free_form(&chosen.model.lra, radius_mm) {
        return Err(not_bent());
    }
    begins(Stage::Fit);
    let mut found = in_pool(|| finish::finish(&shown, &scene.warnings, &chosen))?;
    found.measured.warnings.extend(notes);
    Ok(match options.nominal {
        Some(nominal) => direction::as_nominal(found, nominal),
        None => found,
    })
}
