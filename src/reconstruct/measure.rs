//! From the fit to measured values: ends, sigmas from the full covariance, unknown where the data is silent.

use std::ops::Range;

use nalgebra::{DMatrix, DVector, Point3, Vector3};

use super::ends::{self, End};
use super::fit::Fit;
use super::model::{Parameter, TubeModel};
use super::passes;
use super::shade;
use super::whole::end_frames;
use crate::tube::{Frame, MeasuredBend, MeasuredTube, Spine};

/// Above these a value is not given (design: null with a warning, never a guess).
const MAX_LENGTH_SIGMA_MM: f64 = 5.0;
const MAX_ROTATION_SIGMA_RAD: f64 = 45.0 * std::f64::consts::PI / 180.0;
const MAX_RADIUS_SIGMA_SHARE: f64 = 0.5;
const MAX_OVALITY_SIGMA: f64 = 0.02;

/// Both ends found on the scan, in space.
#[derive(Default)]
pub(super) struct Ends {
    first: Option<(Point3<f64>, f64)>,
    last: Option<(Point3<f64>, f64)>,
}

/// What was scanned of the ends; None where there was too little.
struct Scanned {
    ends: Ends,
    first: Option<End>,
    last: Option<End>,
}

/// All values of the tube as functions of its parameters, with the ends fixed in space.
pub(super) struct Values {
    pub lengths: Vec<f64>,
    pub rotations: Vec<f64>,
    pub angles: Vec<f64>,
    pub radii: Vec<f64>,
    pub corners: Vec<f64>,
    /// Largest less smallest diameter over the nominal one, positive where flattened in the bend's plane.
    pub ovalities: Vec<f64>,
    /// How far the outer wall lies within the oval section over the nominal diameter.
    pub flattenings: Vec<f64>,
    pub tube_radius: Vec<f64>,
}

/// What was scanned at the ends.
pub struct EndPoints {
    /// The points of both [ends](super::whole::Whole::ends).
    pub points: [Vec<Point3<f64>>; 2],
    /// Whether more may be behind a stretch that was not scanned.
    pub hidden: [bool; 2],
    /// The direction to the scanner, where the tube was scanned from one side only.
    pub sight: Option<Vector3<f64>>,
}

/// How much less sure the bends' CLRs are than the covariance says.
pub struct RadiusDoubt {
    /// Standard deviations over the covariance's.
    pub times: f64,
    /// Each bend's own, besides.
    pub besides_mm: Vec<f64>,
}

/// Sets the end straights' lengths from the points at both ends and puts sigmas beside all
/// values. The scan's passes were moved by about `moved_mm`.
pub fn measure(fit: &mut Fit, end_points: EndPoints, doubt: &RadiusDoubt, moved_mm: f64) -> MeasuredTube {
    let Scanned { ends, first, last } = set_ends(fit, end_points, moved_mm);
    let (first_cut, last_cut) = (cut(first), cut(last));
    let at = values(&fit.model, &ends);
    let jacobian = jacobian(&fit.model, &fit.parameters, &ends);
    let covariance = &jacobian * &fit.covariance * jacobian.transpose();
    let sigmas = covariance.diagonal().iter().map(|v| v.max(0.0).sqrt()).collect();
    let mut sigma = at.like(sigmas);
    sigma.radii.iter_mut().zip(&doubt.besides_mm).for_each(|(s, more)| *s = (*s * doubt.times).hypot(*more));
    let n = fit.model.lra.bends.len();
    let oval = (0..n).map(|i| fit.model.may_be_oval(i)).collect();
    let flattened = fit.model.flattening.is_free();
    let mut report = Report { sigma, at, oval, flattened, ends, first, last, warnings: Vec::new() };
    let bends = (0..n).map(|i| report.bend(i)).collect();
    let last_length = report.length(n);
    let corners: Vec<Option<(f64, f64)>> = (0..=n).map(|i| report.corner(i)).collect();
    MeasuredTube {
        tube_radius_mm: report.at.tube_radius[0],
        tube_radius_sigma_mm: Some(report.sigma.tube_radius[0]),
        points_total: 0,
        points_used: fit.used,
        residual_median_mm: 0.0,
        elapsed_ms: 0.0,
        scan_sha256: String::new(),
        last_length_mm: last_length.map(|l| l.0),
        last_length_sigma_mm: last_length.map(|l| l.1),
        bends,
        intersection_mm: corners.iter().map(|c| c.map(|c| c.0)).collect(),
        intersection_sigma_mm: corners.iter().map(|c| c.map(|c| c.1)).collect(),
        straight_rms_mm: Vec::new(),
        nearest_pass_mm: Vec::new(),
        first_cut_rad: first_cut.map(|c| c.0),
        first_cut_sigma_rad: first_cut.map(|c| c.1),
        last_cut_rad: last_cut.map(|c| c.0),
        last_cut_sigma_rad: last_cut.map(|c| c.1),
        reversed: None,
        decisions: Vec::new(),
        warnings: report.warnings,
    }
}

/// Angle of the cut from square with its sigma, where it was seen.
fn cut(end: Option<End>) -> Option<(f64, f64)> {
    match end {
        Some(End::Found(place)) => place.cut_rad,
        _ => None,
    }
}

/// Values and their sigmas on the way to the measured tube; collects what is not known.
struct Report {
    at: Values,
    sigma: Values,
    /// Whether a bend is long enough to tell how oval it is.
    oval: Vec<bool>,
    /// Whether outer walls are flattened.
    flattened: bool,
    ends: Ends,
    first: Option<End>,
    last: Option<End>,
    warnings: Vec<String>,
}

impl Report {
    fn bend(&mut self, i: usize) -> MeasuredBend {
        let length = self.length(i);
        let rotation = self.rotation(i);
        let radius = self.radius(i);
        // Less certain than this it says nothing of the bend's quality; no warning, since nothing else depends on it.
        let ovality = Some((self.at.ovalities[i], self.sigma.ovalities[i]));
        let ovality = ovality.filter(|(_, sigma)| *sigma < MAX_OVALITY_SIGMA && self.oval[i]);
        let flattening = Some((self.at.flattenings[i], self.sigma.flattenings[i]));
        let told = self.oval[i] && self.flattened;
        let flattening = flattening.filter(|(_, sigma)| *sigma < MAX_OVALITY_SIGMA && told);
        MeasuredBend {
            length_mm: length.map(|l| l.0),
            length_sigma_mm: length.map(|l| l.1),
            rotation_rad: rotation.map(|r| r.0),
            rotation_sigma_rad: rotation.map(|r| r.1),
            angle_rad: self.at.angles[i],
            angle_sigma_rad: self.sigma.angles[i],
            radius_mm: radius.map(|r| r.0),
            radius_sigma_mm: radius.map(|r| r.1),
            ovality: ovality.map(|o| o.0),
            ovality_sigma: ovality.map(|o| o.1),
            flattening: flattening.map(|f| f.0),
            flattening_sigma: flattening.map(|f| f.1),
        }
    }

    /// Sigma of where leg `i` ends outside the tube; None when such an end was not scanned.
    fn end_sigma(&self, i: usize) -> Option<f64> {
        let last = self.at.lengths.len() - 1;
        let first_sigma = if i == 0 { self.ends.first?.1 } else { 0.0 };
        let last_sigma = if i == last { self.ends.last?.1 } else { 0.0 };
        Some(first_sigma.hypot(last_sigma))
    }

    /// Why an end of leg `i` has no place.
    fn why_no_end(&self, i: usize) -> String {
        let end = if i == 0 && self.ends.first.is_none() { self.first } else { self.last };
        let least = self.at.lengths[i];
        match end {
            Some(End::CutOff { slope_rad, .. }) => format!(
                "the scan stops before the tube does ({:.0} degrees from square, no saw cuts so); at least {least:.1} mm",
                slope_rad.to_degrees()
            ),
            Some(End::Ragged { .. }) => {
                format!(
                    "the points stop here and there, about {least:.1} mm from the bend; scan past that end"
                )
            }
            Some(End::Shaded { .. }) => {
                format!(
                    "another leg of the tube hides what may follow; at least {least:.1} mm; scan from another side too"
                )
            }
            _ => "that end of the tube was not scanned".to_owned(),
        }
    }

    /// Straight `i` with its sigma.
    fn length(&mut self, i: usize) -> Option<(f64, f64)> {
        let what = if i + 1 == self.at.lengths.len() {
            "the length after the last bend".to_owned()
        } else {
            format!("the length before bend {}", i + 1)
        };
        let Some(end) = self.end_sigma(i) else {
            let why = self.why_no_end(i);
            self.warnings.push(format!("{what} is not known: {why}"));
            return None;
        };
        let sigma = self.sigma.lengths[i].hypot(end);
        if sigma > MAX_LENGTH_SIGMA_MM {
            self.warnings.push(format!("{what} is not known: its sigma would be {sigma:.1} mm"));
            return None;
        }
        Some((self.at.lengths[i], sigma))
    }

    fn rotation(&mut self, i: usize) -> Option<(f64, f64)> {
        if i == 0 {
            return Some((0.0, 0.0));
        }
        let sigma = self.sigma.rotations[i];
        if sigma > MAX_ROTATION_SIGMA_RAD {
            let deg = sigma.to_degrees();
            self.warnings.push(format!(
                "the rotation of bend {} is not known: its sigma would be {deg:.0} degrees",
                i + 1
            ));
            return None;
        }
        Some((self.at.rotations[i], sigma))
    }

    fn radius(&mut self, i: usize) -> Option<(f64, f64)> {
        let (radius, sigma) = (self.at.radii[i], self.sigma.radii[i]);
        if sigma > MAX_RADIUS_SIGMA_SHARE * radius {
            self.warnings.push(format!(
                "the CLR of bend {} is not known: its sigma would be {sigma:.1} mm at {radius:.1} mm",
                i + 1
            ));
            return None;
        }
        Some((radius, sigma))
    }

    /// Distance from the corner before leg `i` to the one after it; None beside a bend whose corner runs away.
    fn corner(&self, i: usize) -> Option<(f64, f64)> {
        let away =
            |k: usize| self.at.angles.get(k).is_some_and(|a| *a >= MeasuredTube::INTERSECTION_LIMIT_RAD);
        if away(i) || (i > 0 && away(i - 1)) {
            return None;
        }
        let sigma = self.sigma.corners[i].hypot(self.end_sigma(i)?);
        (sigma <= MAX_LENGTH_SIGMA_MM).then_some((self.at.corners[i], sigma))
    }
}

/// Finds both ends and lets the model's end straights reach them.
fn set_ends(fit: &mut Fit, EndPoints { points, hidden, sight }: EndPoints, moved_mm: f64) -> Scanned {
    let [first_points, last_points] = points;
    let (radius, noise) = (fit.model.tube_radius_mm, fit.sigma_mm);
    let spine = fit.model.spine();
    let [first_frame, last_frame] = end_frames(&spine);
    // Along the tube passes are known to lie on each other no better than they did across it before.
    let passes_mm = passes::disagreement_mm([&first_points, &last_points], radius, noise).max(moved_mm);
    let is_shaded = |frame: &Frame, legs: &Range<f64>, at_mm: f64| {
        let end = frame * Frame::translation(at_mm, 0.0, 0.0);
        sight.is_some_and(|sight| shade::is_shaded(&sight, &spine, legs.clone(), &end, radius))
    };
    let find = |points, hidden, frame, legs| match ends::find(points, radius, noise, passes_mm) {
        Some(End::Found(e)) if hidden && e.by_outline => Some(End::Ragged { at_mm: e.at_mm }),
        Some(End::Found(e)) if e.by_outline && is_shaded(frame, legs, e.at_mm) => {
            Some(End::Shaded { at_mm: e.at_mm })
        }
        found => found,
    };
    let segments = spine.segments();
    let behind_first = segments[0].length_mm..spine.length_mm();
    let before_last = 0.0..segments[segments.len() - 1].start_mm;
    let (first, last) = rayon::join(
        || find(first_points, hidden[0], &first_frame, &behind_first),
        || find(last_points, hidden[1], &last_frame, &before_last),
    );
    let model = &mut fit.model;
    if let Some(end) = last {
        model.lra.last_length_mm -= end.at_mm();
    }
    if let Some(end) = first {
        model.start *= Frame::translation(end.at_mm(), 0.0, 0.0);
        match model.lra.bends.first_mut() {
            Some(bend) => bend.length_mm -= end.at_mm(),
            None => model.lra.last_length_mm -= end.at_mm(),
        }
    }
    let place = |frame: &Frame, end: Option<End>| match end {
        Some(End::Found(e)) => Some((frame * Point3::new(e.at_mm, 0.0, 0.0), e.sigma_mm)),
        _ => None,
    };
    let ends = Ends { first: place(&first_frame, first), last: place(&last_frame, last) };
    Scanned { ends, first, last }
}

pub(super) fn values(model: &TubeModel, ends: &Ends) -> Values {
    let spine = model.spine();
    let n = model.lra.bends.len();
    let mut lengths: Vec<f64> = model.lra.bends.iter().map(|b| b.length_mm).collect();
    lengths.push(model.lra.last_length_mm);
    if let Some((end, _)) = ends.first.filter(|_| n > 0) {
        lengths[0] = along(&spine, 1, &end, -1.0);
    }
    if let Some((end, _)) = ends.last.filter(|_| n > 0) {
        lengths[n] = along(&spine, 2 * n, &end, 1.0);
    }
    // Beyond 180 degrees the corner is meaningless and not asked for.
    let tangent = |i: usize| model.lra.bends[i].radius_mm * (model.lra.bends[i].angle_rad / 2.0).tan();
    let corner = |i: usize| {
        lengths[i] + if i > 0 { tangent(i - 1) } else { 0.0 } + if i < n { tangent(i) } else { 0.0 }
    };
    Values {
        corners: (0..=n).map(corner).collect(),
        rotations: model.lra.bends.iter().map(|b| b.rotation_rad).collect(),
        angles: model.lra.bends.iter().map(|b| b.angle_rad).collect(),
        radii: model.lra.bends.iter().map(|b| b.radius_mm).collect(),
        ovalities: model.ovality_mm.iter().map(|e| -2.0 * e / model.tube_radius_mm).collect(),
        flattenings: model.flattenings_mm().iter().map(|g| -0.5 * g / model.tube_radius_mm).collect(),
        tube_radius: vec![model.tube_radius_mm],
        lengths,
    }
}

/// Distance of a fixed end from where segment `index` starts, along the tube.
fn along(spine: &Spine, index: usize, end: &Point3<f64>, sign: f64) -> f64 {
    let start = &spine.segments()[index].start;
    sign * start.inverse_transform_point(end).x
}

impl Values {
    fn flat(&self) -> Vec<f64> {
        let parts = [
            &self.lengths,
            &self.rotations,
            &self.angles,
            &self.radii,
            &self.corners,
            &self.ovalities,
            &self.flattenings,
            &self.tube_radius,
        ];
        parts.into_iter().flatten().copied().collect()
    }

    /// Other numbers in the same order as [`Values::flat`].
    pub fn like(&self, flat: Vec<f64>) -> Values {
        let mut rest = flat.into_iter();
        let mut take = |like: &[f64]| rest.by_ref().take(like.len()).collect();
        Values {
            lengths: take(&self.lengths),
            rotations: take(&self.rotations),
            angles: take(&self.angles),
            radii: take(&self.radii),
            corners: take(&self.corners),
            ovalities: take(&self.ovalities),
            flattenings: take(&self.flattenings),
            tube_radius: take(&self.tube_radius),
        }
    }
}

/// Derivatives of all values by all parameters (central differences of closed formulas).
pub(super) fn jacobian(model: &TubeModel, parameters: &[Parameter], ends: &Ends) -> DMatrix<f64> {
    let base = values(model, ends);
    let mut out = DMatrix::zeros(base.flat().len(), parameters.len());
    let h = 1e-6;
    for j in 0..parameters.len() {
        let at = |d: f64| {
            let mut step = DVector::zeros(parameters.len());
            step[j] = d;
            DVector::from_vec(values(&model.moved(parameters, &step), ends).flat())
        };
        out.set_column(j, &((at(h) - at(-h)) / (2.0 * h)));
    }
    out
}
