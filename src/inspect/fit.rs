//! Which way round, which hand, which part: how well a measurement fits a table, value by value.
//!
//! Compared are the values and not points, because the hand shows in rotations alone and the direction in the
//! order of the rest. Each difference is weighed by the scan's sigma and by what bending itself scatters on an
//! uncorrected part, so that only clear evidence counts.

use super::laid::{corners, distances, rotation, table_distances};
use crate::tube::{Lra, MeasuredTube, wrap_angle};

/// What uncorrected bending leaves in an angle once the common spring-back is taken out.
const ANGLE_SCATTER_RAD: f64 = 0.7 * std::f64::consts::PI / 180.0;
/// The same for the turn between planes.
const ROTATION_SCATTER_RAD: f64 = 1.0 * std::f64::consts::PI / 180.0;
/// The same for the distance of corners, besides radius growth.
const LENGTH_SCATTER_MM: f64 = 1.0;
/// End lengths depend on cut and trim.
const END_SCATTER_MM: f64 = 3.0;
/// Growth of the radius moves a corner by this share of its tangent length.
const GROWTH_SCATTER: f64 = 0.05;
/// A single gross error must not decide alone: ten sigmas are as good as a hundred.
const MOST_PER_VALUE: f64 = 100.0;
/// Difference in chi-square that counts as clear: a likelihood ratio of e^10.
const CLEAR: f64 = 20.0;

/// Beyond these a tube is another part, not a badly bent one.
const FAR_ANGLE_RAD: f64 = 10.0 * std::f64::consts::PI / 180.0;
const FAR_ROTATION_RAD: f64 = 15.0 * std::f64::consts::PI / 180.0;
const FAR_LENGTH_MM: f64 = 15.0;

/// How a measurement fits one table as it stands.
#[derive(Debug, Clone, PartialEq)]
pub struct Misfit {
    /// Sum of squared differences in units of their scatter.
    pub chi_square: f64,
    /// Differences too large for bending errors, in words.
    pub far: Vec<String>,
}

/// The reading of a measurement that fits best.
#[derive(Debug, Clone, PartialEq)]
pub struct Reading {
    /// The tube was measured from the other end.
    pub reversed: bool,
    /// The other direction fits clearly worse (or is ruled out beforehand).
    pub clear: bool,
    /// The mirror image fits clearly better.
    pub wrong_hand: bool,
    /// The fit in the best direction.
    pub misfit: Misfit,
}

/// Compares with a table of as many bends.
pub fn misfit(measured: &MeasuredTube, expected: &Lra) -> Misfit {
    let corner = corners(measured, expected);
    let mut out = Misfit { chi_square: 0.0, far: Vec::new() };
    let mut add = |difference: f64, scatter: f64| {
        out.chi_square += (difference / scatter).powi(2).min(MOST_PER_VALUE);
    };
    let common = common_springback(measured, expected);
    for (i, (m, e)) in measured.bends.iter().zip(&expected.bends).enumerate() {
        let difference = m.angle_rad - e.angle_rad * (1.0 + common);
        add(difference, m.angle_sigma_rad.hypot(ANGLE_SCATTER_RAD));
        if difference.abs() > FAR_ANGLE_RAD {
            let (found, wanted) = (m.angle_rad.to_degrees(), e.angle_rad.to_degrees());
            out.far.push(format!("bend {}: {found:.1} degrees instead of {wanted:.1}", i + 1));
        }
        let Some(turn) = rotation(measured, i) else { continue };
        let difference = wrap_angle(turn.value - e.rotation_rad);
        add(difference, turn.sigma.hypot(ROTATION_SCATTER_RAD));
        if difference.abs() > FAR_ROTATION_RAD + 3.0 * turn.sigma {
            let (found, wanted) = (turn.value.to_degrees(), e.rotation_rad.to_degrees());
            out.far.push(format!("rotation {}: {found:.1} degrees instead of {wanted:.1}", i + 1));
        }
    }
    let wanted = table_distances(expected, &corner);
    let plain: Vec<f64> = straight_lengths(expected);
    for (j, found) in distances(measured, &corner).iter().enumerate() {
        let Some(found) = found else { continue };
        let end = j == 0 || j == wanted.len() - 1;
        let growth = GROWTH_SCATTER * (wanted[j] - plain[j]);
        let base = if end { END_SCATTER_MM } else { LENGTH_SCATTER_MM };
        let difference = found.value - wanted[j];
        add(difference, (base + growth).hypot(found.sigma));
        // Ends may be trimmed: they tell no part from another.
        if !end && difference.abs() > FAR_LENGTH_MM + growth + 3.0 * found.sigma {
            out.far.push(format!(
                "distance of corners {} and {}: {:.1} mm instead of {:.1}",
                j,
                j + 1,
                found.value,
                wanted[j]
            ));
        }
    }
    out
}

/// The reading that fits `expected` best; `settled` keeps the direction as it is. Needs equal bend counts.
pub fn reading(measured: &MeasuredTube, expected: &Lra, settled: bool) -> Reading {
    let turned = measured.reversed();
    let mirror = expected.mirrored();
    let best = |table: &Lra| {
        let (forward, backward) = (misfit(measured, table), misfit(&turned, table));
        let reversed = !settled && backward.chi_square < forward.chi_square;
        let (fit, other) = if reversed { (backward, forward) } else { (forward, backward) };
        (reversed, settled || other.chi_square - fit.chi_square > CLEAR, fit)
    };
    let (reversed, clear, fit) = best(expected);
    let (_, _, other_hand) = best(&mirror);
    Reading { reversed, clear, wrong_hand: fit.chi_square - other_hand.chi_square > CLEAR, misfit: fit }
}

/// When one bend is missing or too many: which one (counted from 1), if the rest tells.
pub fn odd_bend(measured: &MeasuredTube, nominal: &Lra, settled: bool) -> Option<usize> {
    let (found, wanted) = (measured.bends.len(), nominal.bends.len());
    let mut fits: Vec<(f64, usize)> = Vec::new();
    if found + 1 == wanted {
        for i in 0..wanted {
            let mut without = nominal.clone();
            without.bends[i].angle_rad = 0.0;
            fits.push((reading(measured, &without.merged(), settled).misfit.chi_square, i + 1));
        }
    } else if found == wanted + 1 && all_known(measured) {
        let all = measured.lra_or(None);
        for i in 0..found {
            let mut less = all.clone();
            less.bends[i].angle_rad = 0.0;
            let plain = as_measured(&less.merged());
            fits.push((reading(&plain, nominal, settled).misfit.chi_square, i + 1));
        }
    }
    fits.sort_by(|a, b| a.0.total_cmp(&b.0));
    match fits[..] {
        [(_, only)] => Some(only),
        [(best, which), (second, _), ..] if second - best > CLEAR => Some(which),
        _ => None,
    }
}

/// The share by which all angles spring back alike, within what materials do.
fn common_springback(measured: &MeasuredTube, expected: &Lra) -> f64 {
    let both = || measured.bends.iter().zip(&expected.bends);
    let square: f64 = both().map(|(_, e)| e.angle_rad.powi(2)).sum();
    let product: f64 = both().map(|(m, e)| e.angle_rad * (m.angle_rad - e.angle_rad)).sum();
    if square > 0.0 { (product / square).clamp(-0.12, 0.04) } else { 0.0 }
}

fn all_known(measured: &MeasuredTube) -> bool {
    let bend = |b: &crate::tube::MeasuredBend| {
        b.length_mm.is_some() && b.rotation_rad.is_some() && b.radius_mm.is_some()
    };
    measured.last_length_mm.is_some() && measured.bends.iter().skip(1).all(bend)
}

fn straight_lengths(lra: &Lra) -> Vec<f64> {
    lra.bends.iter().map(|b| b.length_mm).chain([lra.last_length_mm]).collect()
}

/// A table as if measured exactly: for trying what a tube would look like with a bend less.
fn as_measured(lra: &Lra) -> MeasuredTube {
    let bend = |b: &crate::tube::Bend| crate::tube::MeasuredBend {
        length_mm: Some(b.length_mm),
        length_sigma_mm: Some(0.1),
        rotation_rad: Some(b.rotation_rad),
        rotation_sigma_rad: None,
        angle_rad: b.angle_rad,
        angle_sigma_rad: 0.0,
        radius_mm: Some(b.radius_mm),
        radius_sigma_mm: None,
        ovality: None,
        ovality_sigma: None,
        flattening: None,
        flattening_sigma: None,
    };
    MeasuredTube {
        last_length_sigma_mm: Some(0.1),
        bends: lra.bends.iter().map(bend).collect(),
        intersection_mm: Vec::new(),
        intersection_sigma_mm: Vec::new(),
        ..MeasuredTube::exact(lra, 0.0)
    }
}
