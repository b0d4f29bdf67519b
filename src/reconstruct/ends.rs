//! Where the tube ends: the surface knows the end straights' axes but not their ends, the scanned extent does.
//!
//! Best is the end face itself ([`face`]); else the outside's outline ([`outline`]). An outline that is far from square
//! or that the sectors around the tube do not agree on is no tube's end but the scan's, and the length stays unknown.

use nalgebra::Point3;

use super::face::{self, Face, Search};
use super::outline::{self, Outline};

/// No saw cuts this far from square; the edge of a scan may (8 degrees).
const MOST_OBLIQUE: f64 = 0.1405;
/// Faces steeper than a good saw leaves them (7 and 16 degrees) are looked for only where the outline is that oblique too.
const STEEPEST_FACES: [f64; 2] = [0.1228, 0.2867];
/// A cut angle less certain than this is not given.
const MAX_CUT_SIGMA_RAD: f64 = std::f64::consts::PI / 180.0;
/// Share of the sectors around the tube that must end together.
const LEAST_AGREEING: f64 = 0.6;
/// Points this far from the outside, in standard deviations of the noise, show where it stops. Few are within it, where
/// the face's rim would pile up.
const OUTSIDE_SIGMAS: std::ops::Range<f64> = -1.0..3.5;
/// What differs by more than this many standard deviations is not the same.
const DIFFERENT_SIGMAS: f64 = 4.0;

/// What the points at an end are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum End {
    /// The tube's end.
    Found(Place),
    /// The scan stops here and the tube goes on: it ends with a slope (angle from square) that no saw leaves.
    CutOff {
        /// Where the scan stops, on the axis.
        at_mm: f64,
        /// Angle of the scan's edge from square.
        slope_rad: f64,
    },
    /// The points stop here and there; which is the tube's end cannot be told.
    Ragged {
        /// Where most of them begin.
        at_mm: f64,
    },
}

/// Where the end's plane meets the axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Coordinate along the axis.
    pub at_mm: f64,
    /// Its standard deviation.
    pub sigma_mm: f64,
    /// Angle of the cut from square and its standard deviation, where the scan shows it.
    pub cut_rad: Option<(f64, f64)>,
    /// Whether only the outside's outline was seen, not the end face.
    pub by_outline: bool,
}

impl End {
    /// Where the scanned tube stops.
    pub fn at_mm(&self) -> f64 {
        match self {
            End::Found(place) => place.at_mm,
            End::CutOff { at_mm, .. } | End::Ragged { at_mm } => *at_mm,
        }
    }
}

/// The end of a tube that lies along +x from it: `points` on and in the tube in a frame whose x axis is the tube's, of
/// whose outside they scatter by `noise_mm`. None when too little was scanned there.
pub fn find(points: &[Point3<f64>], radius_mm: f64, noise_mm: f64) -> Option<End> {
    let outside = |p: &&Point3<f64>| OUTSIDE_SIGMAS.contains(&((p.y.hypot(p.z) - radius_mm) / noise_mm));
    let surface: Vec<Point3<f64>> = points.iter().filter(outside).copied().collect();
    let outline = outline::find(&surface, radius_mm, noise_mm)?;
    let near_mm = DIFFERENT_SIGMAS * outline.sigma_mm + outline.step_mm.max(3.0 * noise_mm);
    let oblique = outline.loose_size() - DIFFERENT_SIGMAS * outline.loose_sigma > 0.5 * STEEPEST_FACES[0];
    let about =
        if oblique { (outline.loose_at_mm, outline.loose_slope) } else { (outline.at_mm, outline.slope) };
    let steepest = STEEPEST_FACES[usize::from(oblique)];
    let face = face::find(points, radius_mm, noise_mm, &Search { about_mm: about.0, near_mm, steepest });
    let same = |f: &Face| {
        let room = near_mm / radius_mm;
        let off = |k: usize, v: f64| {
            let sigma = (v + f.covariance[(k + 1, k + 1)]).sqrt();
            (f.slope[k] - about.1[k]).abs() < DIFFERENT_SIGMAS * sigma + 0.5 * room
        };
        off(0, outline.slope_variance[0]) && off(1, outline.slope_variance[2])
    };
    if let Some(face) = face.filter(same) {
        let sigma_mm = face.covariance[(0, 0)].sqrt();
        if sigma_mm < outline.sigma_mm {
            let variance = [face.covariance[(1, 1)], face.covariance[(1, 2)], face.covariance[(2, 2)]];
            let cut_rad = cut(&face.slope, &variance);
            return Some(End::Found(Place { at_mm: face.at_mm, sigma_mm, cut_rad, by_outline: false }));
        }
    }
    Some(by_outline(&outline))
}

fn by_outline(outline: &Outline) -> End {
    let at_mm = outline.at_mm;
    let slope = outline.loose_size();
    if slope - DIFFERENT_SIGMAS * outline.loose_sigma > MOST_OBLIQUE {
        return End::CutOff { at_mm: outline.loose_at_mm, slope_rad: slope.atan() };
    }
    if outline.agreeing < LEAST_AGREEING {
        return End::Ragged { at_mm };
    }
    let cut_rad = cut(&outline.slope, &outline.slope_variance);
    End::Found(Place { at_mm, sigma_mm: outline.sigma_mm, cut_rad, by_outline: true })
}

/// Angle from square of a plane with this slope, without what its uncertainty adds to it on average.
fn cut(slope: &[f64; 2], variance: &[f64; 3]) -> Option<(f64, f64)> {
    let size = slope[0].hypot(slope[1]);
    let (u, v) = if size > 0.0 { (slope[0] / size, slope[1] / size) } else { (1.0, 0.0) };
    let [yy, yz, zz] = *variance;
    let sigma = (u * u * yy + 2.0 * u * v * yz + v * v * zz).max(0.0).sqrt();
    let across = (v * v * yy - 2.0 * u * v * yz + u * u * zz).max(0.0).sqrt();
    let angle = (size * size - yy - zz).max(0.0).sqrt().atan();
    // Near square the direction is open, and so the worse of the two counts.
    let sigma = if size > 2.0 * across { sigma } else { sigma.max(across) };
    (sigma.atan() <= MAX_CUT_SIGMA_RAD).then_some((angle, sigma.atan()))
}
