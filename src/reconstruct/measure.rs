//! From the fit to measured values: ends, sigmas from the full covariance, unknown where the data is silent.

use nalgebra::{DMatrix, Point3, Vector3};

use super::ends::{self, End};
use super::fit::Fit;
use super::model::{Parameter, TubeModel};
use super::moments::Sample;
use crate::tube::{Frame, MeasuredBend, MeasuredTube, Spine};

/// Above these a value is not given (design: null with a warning, never a guess).
const MAX_LENGTH_SIGMA_MM: f64 = 5.0;
const MAX_ROTATION_SIGMA_RAD: f64 = 45.0 * std::f64::consts::PI / 180.0;
const MAX_RADIUS_SIGMA_SHARE: f64 = 0.5;

/// How far from an end its points are looked at, in tube radii.
const END_RADII: f64 = 2.0;

/// Both ends found on the scan, in space.
struct Ends {
    first: Option<(Point3<f64>, f64)>,
    last: Option<(Point3<f64>, f64)>,
}

/// All values of the tube as functions of its parameters, with the ends fixed in space.
struct Values {
    lengths: Vec<f64>,
    rotations: Vec<f64>,
    angles: Vec<f64>,
    radii: Vec<f64>,
    corners: Vec<f64>,
    tube_radius: f64,
}

/// Sets the end straights' lengths from the scanned extent and puts sigmas beside all values.
pub fn measure(fit: &mut Fit, sample: &mut Sample) -> MeasuredTube {
    let ends = set_ends(fit, sample);
    let at = values(&fit.model, &ends);
    let jacobian = jacobian(&fit.model, &fit.parameters, &ends);
    let covariance = &jacobian * &fit.covariance * jacobian.transpose();
    let sigma = |row: usize| covariance[(row, row)].max(0.0).sqrt();
    let n = fit.model.lra.bends.len();
    let mut warnings = Vec::new();
    let end_sigma = |i: usize| match i {
        0 => ends.first.map(|(_, s)| s),
        i if i == n => ends.last.map(|(_, s)| s),
        _ => Some(0.0),
    };
    // A straight tube has both ends in one length.
    let length = |i: usize, row: usize| {
        let ends_sigma = if n == 0 { end_sigma(0)?.hypot(ends.last?.1) } else { end_sigma(i)? };
        Some(sigma(row).hypot(ends_sigma))
    };
    let known_length = |value: f64, sigma: Option<f64>, what: String, warnings: &mut Vec<String>| match sigma
    {
        Some(s) if s <= MAX_LENGTH_SIGMA_MM => (Some(value), Some(s)),
        Some(s) => {
            warnings.push(format!("{what} is not known: its sigma would be {s:.1} mm"));
            (None, None)
        }
        None => {
            warnings.push(format!("{what} is not known: that end of the tube was not scanned"));
            (None, None)
        }
    };
    let mut bends = Vec::new();
    for i in 0..n {
        let what = format!("length before bend {}", i + 1);
        let (length_mm, length_sigma_mm) = known_length(at.lengths[i], length(i, i), what, &mut warnings);
        let rotation_sigma = if i == 0 { 0.0 } else { sigma(n + 1 + i) };
        let rotation_known = rotation_sigma <= MAX_ROTATION_SIGMA_RAD;
        if !rotation_known {
            let deg = rotation_sigma.to_degrees();
            warnings
                .push(format!("rotation of bend {} is not known: its sigma would be {deg:.0} deg", i + 1));
        }
        let radius_sigma = sigma(3 * n + 1 + i);
        let radius_known = radius_sigma <= MAX_RADIUS_SIGMA_SHARE * at.radii[i];
        if !radius_known {
            let (r, s) = (at.radii[i], radius_sigma);
            warnings.push(format!(
                "CLR of bend {} is not known: its sigma would be {s:.1} mm at {r:.1} mm",
                i + 1
            ));
        }
        bends.push(MeasuredBend {
            length_mm,
            length_sigma_mm,
            rotation_rad: rotation_known.then_some(at.rotations[i]),
            rotation_sigma_rad: rotation_known.then_some(rotation_sigma),
            angle_rad: at.angles[i],
            angle_sigma_rad: sigma(2 * n + 1 + i),
            radius_mm: radius_known.then_some(at.radii[i]),
            radius_sigma_mm: radius_known.then_some(radius_sigma),
        });
    }
    let what = "length after the last bend".to_owned();
    let (last_length_mm, last_length_sigma_mm) =
        known_length(at.lengths[n], length(n, n), what, &mut warnings);
    let corners: Vec<Option<(f64, f64)>> = (0..=n)
        .map(|i| {
            let away =
                |k: usize| at.angles.get(k).is_some_and(|a| *a >= MeasuredTube::INTERSECTION_LIMIT_RAD);
            if away(i) || (i > 0 && away(i - 1)) {
                return None;
            }
            let s = length(i, 4 * n + 1 + i)?;
            (s <= MAX_LENGTH_SIGMA_MM).then_some((at.corners[i], s))
        })
        .collect();
    MeasuredTube {
        tube_radius_mm: at.tube_radius,
        points_total: sample.points.len(),
        points_used: fit.used,
        residual_median_mm: 0.0,
        elapsed_ms: 0.0,
        scan_sha256: String::new(),
        last_length_mm,
        last_length_sigma_mm,
        bends,
        intersection_mm: corners.iter().map(|c| c.map(|c| c.0)).collect(),
        intersection_sigma_mm: corners.iter().map(|c| c.map(|c| c.1)).collect(),
        reversed: None,
        warnings,
    }
}

/// Finds both ends and lets the model's end straights reach them.
fn set_ends(fit: &mut Fit, sample: &mut Sample) -> Ends {
    let residuals = sample.residuals(&fit.model);
    let spine = fit.model.spine();
    let last = spine.segments().len() - 1;
    let reach = END_RADII * fit.model.tube_radius_mm;
    let look = |segment: usize, frame: &Frame| -> Option<End> {
        let inverse = frame.inverse();
        let mine = sample.points.iter().zip(sample.segments()).zip(&residuals);
        let points: Vec<Point3<f64>> = mine
            .filter(|((_, s), r)| **s as usize == segment && r.abs() < fit.cutoff_mm)
            .map(|((p, _), _)| inverse * p)
            .collect();
        ends::find(&points, reach)
    };
    // Both looked at along the way into the tube.
    let first_frame = spine.segments()[0].start;
    let end_frame = spine.frame_at(spine.length_mm());
    let back = Frame::rotation(Vector3::new(0.0, std::f64::consts::PI, 0.0));
    let last_frame = end_frame * back;
    let (first, final_end) = (look(0, &first_frame), look(last, &last_frame));
    let model = &mut fit.model;
    if let Some(end) = final_end {
        model.lra.last_length_mm -= end.at_mm;
    }
    if let Some(end) = first {
        model.start *= Frame::translation(end.at_mm, 0.0, 0.0);
        match model.lra.bends.first_mut() {
            Some(bend) => bend.length_mm -= end.at_mm,
            None => model.lra.last_length_mm -= end.at_mm,
        }
    }
    let place =
        |frame: &Frame, end: Option<End>| end.map(|e| (frame * Point3::new(e.at_mm, 0.0, 0.0), e.sigma_mm));
    Ends { first: place(&first_frame, first), last: place(&last_frame, final_end) }
}

fn values(model: &TubeModel, ends: &Ends) -> Values {
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
        tube_radius: model.tube_radius_mm,
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
        let parts = [&self.lengths, &self.rotations, &self.angles, &self.radii, &self.corners];
        parts.into_iter().flatten().copied().chain([self.tube_radius]).collect()
    }
}

/// Derivatives of all values by all parameters (central differences of closed formulas).
fn jacobian(model: &TubeModel, parameters: &[Parameter], ends: &Ends) -> DMatrix<f64> {
    let rows = values(model, ends).flat().len();
    let mut out = DMatrix::zeros(rows, parameters.len());
    let h = 1e-6;
    for j in 0..parameters.len() {
        let at = |d: f64| {
            let mut step = nalgebra::DVector::zeros(parameters.len());
            step[j] = d;
            values(&model.moved(parameters, &step), ends).flat()
        };
        let (plus, minus) = (at(h), at(-h));
        for row in 0..rows {
            let difference = plus[row] - minus[row];
            // Rotations wrap.
            let n = model.lra.bends.len();
            let wraps = (n + 1..2 * n + 1).contains(&row);
            let difference = if wraps { crate::tube::wrap_angle(difference) } else { difference };
            out[(row, j)] = difference / (2.0 * h);
        }
    }
    out
}
