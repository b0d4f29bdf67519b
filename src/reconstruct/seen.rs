//! The points of a scan as the sections of a base tube see them: which section each faces, in what direction it lies, and by how
//! much it misses the base's surface; and their robust sums.
//!
//! Under `sections`.

use nalgebra::{Cholesky, Matrix2, Point3, Vector2, Vector5};
use rayon::prelude::*;

use super::local::{Local, Outline, settle};
use super::model::TubeModel;
use super::section::{Bins, Sums, VALUES, Values};
use crate::recognize::{MEDIAN_TO_SIGMA, median};

/// Points farther than this from the base tube do not count, in tube radii.
pub const FIRST_CUTOFF: f64 = 0.4;
/// Noise over cut-off that is pretended while points are weighed.
pub const FIRMNESS: f64 = 1.0;
/// How steeply the tube may lean against the base tube.
const STEEPEST: f64 = 0.2;

/// Points that a thread looks at in one go.
const SEEN_TOGETHER: usize = 512;

/// A point as its section sees it.
#[derive(Debug, Clone, Copy)]
pub struct Seen {
    section: u32,
    along_mm: f64,
    cos: f64,
    sin: f64,
    residual_mm: f64,
}

impl Seen {
    /// Derivatives of the section's values.
    fn row(&self) -> Vector5<f64> {
        let (c, s) = (self.cos, self.sin);
        Vector5::new(1.0, c, s, c * c - s * s, 2.0 * s * c)
    }
}

/// All points near the base tube.
pub fn see(points: &[Point3<f64>], base: &TubeModel, locals: &[Local], bins: &Bins) -> Vec<Seen> {
    let spine = base.spine();
    let cutoff = FIRST_CUTOFF * base.tube_radius_mm;
    let part = |points: &[Point3<f64>]| {
        let mut segment = 0;
        let one = |p: &Point3<f64>| {
            let mut local = settle(p, &mut segment, locals);
            let mut off = locals[segment as usize].off_axis(&local);
            if (off.norm() - base.tube_radius_mm).abs() > cutoff {
                // The point before may have been on another leg.
                segment = spine.closest(p).segment as u32;
                local = settle(p, &mut segment, locals);
                off = locals[segment as usize].off_axis(&local);
            }
            let distance = off.norm();
            if (distance - base.tube_radius_mm).abs() >= cutoff {
                return None;
            }
            let k = segment as usize;
            let along_mm = locals[k].unclamped_along_mm(&local);
            let (cos, sin) = (off.x / distance, off.y / distance);
            let (oval_mm, flat_mm) = locals[k].uneven_mm(along_mm, base.tube_radius_mm);
            // From the outside of the bend, which is the other way.
            let outline = Outline::at(-cos, sin, base.tube_radius_mm, oval_mm, flat_mm);
            let residual_mm = distance - outline.radius_mm;
            let section = bins.of(k, along_mm / locals[k].length_mm.max(1e-12)) as u32;
            Some(Seen { section, along_mm, cos, sin, residual_mm })
        };
        points.iter().filter_map(one).collect::<Vec<Seen>>()
    };
    points.par_chunks(SEEN_TOGETHER).map(part).collect::<Vec<_>>().concat()
}

/// Points by their section.
pub fn group(seen: Vec<Seen>, sections: usize) -> Vec<Vec<Seen>> {
    let mut out = vec![Vec::new(); sections];
    seen.into_iter().for_each(|s| out[s.section as usize].push(s));
    out
}

/// Sums of a section's points, weighted by the biweight about its own fit.
pub fn sums(seen: &[Seen], fit: &Values, cutoff_mm: f64) -> Sums {
    // Both triangles: more products, but in rows that the compiler turns into vector instructions.
    let mut sums = [[0.0; VALUES + 1]; VALUES + 1];
    for point in seen {
        let row = point.row();
        let t = (point.residual_mm - row.dot(fit)) / cutoff_mm;
        let keep = 1.0 - t * t;
        if keep > 0.0 {
            let h = [row[0], row[1], row[2], row[3], row[4], point.residual_mm];
            let weighted = h.map(|v| keep * keep * v);
            for (sums, weighted) in sums.iter_mut().zip(weighted) {
                for (sum, value) in sums.iter_mut().zip(h) {
                    *sum += weighted * value;
                }
            }
        }
    }
    Sums::from(sums)
}

/// Where along its segment a section's points lie, on average.
pub fn middle_mm(seen: &[Seen]) -> f64 {
    seen.iter().map(|s| s.along_mm).sum::<f64>() / seen.len().max(1) as f64
}

/// Takes out of a section's residuals by how much the tube leans against the base tube there: where a bend is missing its points
/// would else not lie on one section.
pub fn straighten(seen: &mut [Seen], fit: &Values, cutoff_mm: f64, radius_mm: f64) {
    let middle_mm = middle_mm(seen);
    let row = |s: &Seen| Vector2::new(s.cos, s.sin) * ((s.along_mm - middle_mm) / radius_mm);
    let stiffness = (FIRMNESS * cutoff_mm / (STEEPEST * radius_mm)).powi(2);
    let (mut square, mut right) = (Matrix2::identity() * stiffness, Vector2::zeros());
    for point in seen.iter() {
        let off = point.residual_mm - point.row().dot(fit);
        let keep = 1.0 - (off / cutoff_mm).powi(2);
        if keep > 0.0 {
            let row = row(point);
            square += row * row.transpose() * (keep * keep);
            right += row * (keep * keep * off);
        }
    }
    let slopes = Cholesky::new(square).map_or(Vector2::zeros(), |c| c.solve(&right));
    seen.iter_mut().for_each(|s| s.residual_mm -= row(s).dot(&slopes));
}

/// By how much points lie outside a section's fit.
pub fn offs(seen: &[Seen], fit: &Values) -> impl Iterator<Item = f64> + Clone {
    seen.iter().map(move |s| s.residual_mm - s.row().dot(fit))
}

/// Robust standard deviation of the points about their sections' fits.
pub fn scatter(grouped: &[Vec<Seen>], fits: &[Values], cutoff_mm: f64) -> f64 {
    let mut sizes = Vec::new();
    let mut spent = 0.0;
    for (seen, fit) in grouped.iter().zip(fits) {
        let before = sizes.len();
        sizes.extend(offs(seen, fit).map(f64::abs).filter(|r| *r < cutoff_mm));
        spent += ((sizes.len() - before) as f64 * 0.5).min(VALUES as f64);
    }
    let n = sizes.len() as f64;
    let freedom = (n / (n - spent).max(1.0)).sqrt();
    median(&mut sizes).unwrap_or(cutoff_mm) * MEDIAN_TO_SIGMA * freedom
}
