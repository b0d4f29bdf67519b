//! The last part of the reconstruction: the structure that a sample has shown, fitted to all points and measured.
//!
//! After `structure`, which leaves the fit near its end: one step on all points takes it there, another pass
//! the rest of the way. All passes are walks over the cloud as it lies in memory (`whole`).

use nalgebra::Point3;

use super::error::ReconstructError;
use super::fit::{CUTOFF_SIGMAS, Effort, Fit, fit, polish};
use super::flattening::{self, freed};
use super::measure::{self, EndPoints, RadiusDoubt};
use super::model::Flattening;
use super::moments::Sample;
use super::moves::{joined, without_bend};
use super::outline::solid_start;
use super::profile;
use super::realign;
use super::search::UNSURE;
use super::shade;
use super::stretches::{Correlation, correlation};
use super::structure::{Shown, Structure};
use super::undecided::{self, widened};
use super::whole::{Whole, end_frames};
use super::{Reconstruction, TubeModel};
use crate::tube::{Frame, MeasuredTube};

/// Half of a scan's points usually lie no farther off than this, or than this share of the tube's radius.
const USUAL_ROUGHNESS_MM: f64 = 0.1;
const USUAL_ROUGHNESS_RADII: f64 = 0.02;

/// An angle is never left open: a tube with one less certain than this was not measured.
const MAX_ANGLE_SIGMA_RAD: f64 = 10.0 * std::f64::consts::PI / 180.0;

/// Share of the points that must lie on the tube.
const LEAST_USED_SHARE: f64 = 0.5;

/// A straight beyond which the tube goes on unseen is no shorter, in tube radii: or the bend before it may go on, too.
const LEAST_STRAIGHT_RADII: f64 = 0.5;

/// Where a centre line ends the tube does, within so many tube radii.
const HIDDEN_RADII: f64 = 4.0;

/// Of larger clouds only so much of the end straights is looked at for the ends, in tube radii: a little more than the
/// ends ask for at most, less where that holds more points than tell the scan's pattern.
const MANY_POINTS: usize = 100_000;
const END_RADII: std::ops::RangeInclusive<f64> = 2.5..=8.5;
const END_POINTS: f64 = 60_000.0;

/// Fits and measures the tube. A bend at one of its ends whose angle the points do not tell is a few points of
/// something that touches the tube there, a jaw or a lip: it is left out, and that end's length is not known. One that touches another
/// and whose angle the points do not tell from that one's is one with it.
pub fn finish(
    shown: &Shown,
    warnings: &[String],
    chosen: &Structure,
) -> Result<Reconstruction, ReconstructError> {
    let found = finish_as_chosen(shown, warnings, chosen);
    let Err(ReconstructError::Undetermined { bend, .. }) = &found else { return found };
    let bends = chosen.model.lra.bends.len();
    let (first, last) = (*bend == 1, *bend == bends);
    if bends > 1 && !(first || last) {
        let one = joined(&chosen.model, bend - 1).map(|model| chosen.with_fewer_bends(model));
        return one.map_or(found, |one| finish_as_chosen(shown, warnings, &one));
    }
    if bends < 2 {
        return found;
    }
    let less = chosen.with_fewer_bends(without_bend(&chosen.model, bend - 1));
    let mut trimmed = finish_as_chosen(shown, warnings, &less)?;
    forget_end(&mut trimmed.measured, first);
    Ok(trimmed)
}

/// An end beyond which something else than the tube was scanned.
fn forget_end(tube: &mut MeasuredTube, first: bool) {
    let end = if first { tube.bends.first_mut() } else { None };
    let (length, sigma) = match end {
        Some(bend) => (&mut bend.length_mm, &mut bend.length_sigma_mm),
        None => (&mut tube.last_length_mm, &mut tube.last_length_sigma_mm),
    };
    (*length, *sigma) = (None, None);
    let corner = if first { 0 } else { tube.intersection_mm.len().saturating_sub(1) };
    if let (Some(value), Some(sigma)) =
        (tube.intersection_mm.get_mut(corner), tube.intersection_sigma_mm.get_mut(corner))
    {
        (*value, *sigma) = (None, None);
    }
    let (cut, cut_sigma) = if first {
        (&mut tube.first_cut_rad, &mut tube.first_cut_sigma_rad)
    } else {
        (&mut tube.last_cut_rad, &mut tube.last_cut_sigma_rad)
    };
    (*cut, *cut_sigma) = (None, None);
    let which = if first { "first" } else { "last" };
    tube.warnings.push(format!(
        "the tube's {which} end is not known: something that touches it there was scanned with it, or a bend too little \
         seen; its length is not given"
    ));
}

fn finish_as_chosen(
    shown: &Shown,
    warnings: &[String],
    chosen: &Structure,
) -> Result<Reconstruction, ReconstructError> {
    let mut whole = shown.whole;
    let points = whole.len();
    let mut best = fit_to_all(&mut whole, chosen);
    if (best.used as f64) < LEAST_USED_SHARE * points as f64 {
        let (radius_mm, bends) = (shown.radius_mm, best.model.lra.bends.len());
        return Err(ReconstructError::PoorFit { used: best.used, points, radius_mm, bends });
    }
    let correlation;
    (best, correlation) = with_flattening(&mut whole, best, chosen);
    // Sigmas by what the points say together, not by their number; what is held was found so already.
    if whole.passes().len() > 1 {
        best.information = realign::information(&whole, &best);
    }
    let information = flattening::expected(&best.information / correlation.near, &best);
    let held = profile::tightened(&information, &best.parameters, &chosen.held);
    best.covariance = widened(held, &best.parameters, &chosen.undecided);
    let ends = end_points(&whole, shown, &best);
    let moved_mm = realign::moved_mm(whole.passes(), &best.model);
    let radius_doubt = (correlation.along_arc / correlation.near).sqrt();
    let doubt = |bend| undecided::radius_doubt_mm(&chosen.undecided, bend);
    let radii =
        RadiusDoubt { times: radius_doubt, besides_mm: (0..best.model.lra.bends.len()).map(doubt).collect() };
    let mut measured = measure::measure(&mut best, ends, &radii, moved_mm);
    if let Some(bend) = measured.bends.iter().position(|b| b.angle_sigma_rad > MAX_ANGLE_SIGMA_RAD) {
        let sigma_deg = measured.bends[bend].angle_sigma_rad.to_degrees();
        return Err(ReconstructError::Undetermined { bend: bend + 1, sigma_deg });
    }
    if let Some(bend) = unsure_end(&measured) {
        let sigma_deg = measured.bends[bend].angle_sigma_rad.to_degrees();
        return Err(ReconstructError::Undetermined { bend: bend + 1, sigma_deg });
    }
    if let Some(bend) = ends_in_bend(&best.model, &measured) {
        return Err(ReconstructError::EndsInBend { bend });
    }
    measured.residual_median_mm = best.median_mm;
    measured.straight_rms_mm.clone_from(&best.straight_rms_mm);
    measured.decisions.clone_from(&chosen.decisions);
    measured.decisions.extend(flattening::decision(&best, correlation.near));
    measured.points_total = whole.file_len();
    measured.warnings.splice(0..0, warnings.iter().cloned());
    measured.warnings.extend(roughness(best.median_mm, best.model.tube_radius_mm));
    let (spine, TubeModel { lra, ovality_mm, flattening, .. }) = (best.model.spine(), best.model);
    let flattening_mm = match flattening {
        Flattening::Free { bends_mm, .. } => bends_mm,
        Flattening::Known(_) => Vec::new(),
    };
    Ok(Reconstruction { measured, spine, lra, ovality_mm, flattening_mm })
}

/// A warning where the points leave a round tube's surface by more than tubes and scanners do.
fn roughness(median_mm: f64, radius_mm: f64) -> Option<String> {
    let usual_mm = USUAL_ROUGHNESS_MM.max(USUAL_ROUGHNESS_RADII * radius_mm);
    (median_mm > usual_mm).then(|| {
        format!(
            "half of the points lie more than {median_mm:.2} mm off the surface, {:.1} % of the tube's radius (usual is up to \
             {usual_mm:.2} mm): not round, not smooth or not one tube; take its values for rough ones and look at \
             --export report.html",
            100.0 * median_mm / radius_mm
        )
    })
}

/// A bend at an end of a tube with others, whose angle is not known from none.
fn unsure_end(measured: &MeasuredTube) -> Option<usize> {
    let bends = &measured.bends;
    let last = bends.len().checked_sub(1).filter(|last| *last > 0)?;
    [0, last].into_iter().find(|&i| bends[i].angle_rad < UNSURE * bends[i].angle_sigma_rad)
}

/// The bend, counted from 1, behind which the points show no straight; or too short a one where they stop before the tube does:
/// what hides the rest has touched its points.
fn ends_in_bend(model: &TubeModel, measured: &MeasuredTube) -> Option<usize> {
    let bends = &model.lra.bends;
    let shown_mm = LEAST_STRAIGHT_RADII * model.tube_radius_mm;
    let least_mm = |is_known: bool| if is_known { 0.0 } else { shown_mm };
    let first = bends.first()?.length_mm < least_mm(measured.bends.first()?.length_mm.is_some());
    let last = model.lra.last_length_mm < least_mm(measured.last_length_mm.is_some());
    if first { Some(1) } else { last.then_some(bends.len()) }
}

/// The sample's fit taken to all points.
fn fit_to_all(whole: &mut Whole, chosen: &Structure) -> Fit {
    let mut start = chosen.model.clone();
    if start.flattening != Flattening::NONE {
        start.flattening = freed(&start);
    }
    fit_from(whole, &start, CUTOFF_SIGMAS * chosen.noise_mm, chosen)
}

fn fit_from(whole: &mut Whole, start: &TubeModel, cutoff_mm: f64, chosen: &Structure) -> Fit {
    let effort = Effort { cutoff_mm, rounds: 2, steps: 20, prior: chosen.prior };
    polish(whole, start, effort, &chosen.held).unwrap_or_else(|| fit(whole, start, effort))
}

/// The fit, with flattened outer walls where the points ask for them, and how they correlate about it: what is left of a wall
/// that the fit lacks would pass for correlation, so the last word is had with the walls fitted.
fn with_flattening(whole: &mut Whole, round: Fit, chosen: &Structure) -> (Fit, Correlation) {
    let known = round.model.flattening.is_free();
    let told = if known { None } else { flattening::told(whole, &round.model, round.cutoff_mm) };
    if let Some(told) = told {
        let start = TubeModel { flattening: told.flattening.clone(), ..round.model.clone() };
        let flattened = fit_from(whole, &start, round.cutoff_mm, chosen);
        let correlation = correlation(whole, &flattened);
        if told.stands_out(correlation.near) {
            return (flattened, correlation);
        }
    }
    let correlation = correlation(whole, &round);
    (round, correlation)
}

/// What shows the tube's ends.
fn end_points(whole: &Whole, shown: &Shown, fit: &Fit) -> EndPoints {
    let reach_mm = HIDDEN_RADII * fit.model.tube_radius_mm;
    let is_hidden = |end: Frame| shown.hidden.iter().any(|p| (end.inverse() * p).coords.norm() < reach_mm);
    let hidden = end_frames(&fit.model.spine()).map(is_hidden);
    let sight = shade::sight(shown.sample, &fit.model);
    EndPoints { points: points_at_ends(whole, shown.sample, fit), hidden, sight }
}

/// See [`Whole::ends`].
fn points_at_ends(whole: &Whole, sample: &[Point3<f64>], fit: &Fit) -> [Vec<Point3<f64>>; 2] {
    if whole.len() <= MANY_POINTS {
        return whole.ends(&fit.model, fit.cutoff_mm, f64::INFINITY, f64::INFINITY);
    }
    let mut sample = Sample::new(sample.to_vec(), &fit.model);
    let per_radius = whole.len() as f64 * fit.model.tube_radius_mm / fit.model.spine().length_mm();
    let radii = (END_POINTS / per_radius).clamp(*END_RADII.start(), *END_RADII.end());
    let (first_mm, last_mm) = reaches(&mut sample, &fit.model, radii * fit.model.tube_radius_mm);
    whole.ends(&fit.model, fit.cutoff_mm, first_mm, last_mm)
}

/// How far along the end straights, from the model's ends, points show the tube's ends: `reach_mm` beyond the first of them.
fn reaches(sample: &mut Sample, model: &TubeModel, reach_mm: f64) -> (f64, f64) {
    let spine = model.spine();
    let last = spine.segments().len() - 1;
    let reach = |segment: usize, along: &dyn Fn(f64) -> f64| {
        let inverse = spine.segments()[segment].start.inverse();
        let mine = sample.points.iter().zip(sample.segments()).filter(|(_, s)| **s as usize == segment);
        let mut places: Vec<f64> = mine.map(|(p, _)| along((inverse * p).x)).collect();
        places.sort_by(f64::total_cmp);
        let first = solid_start(&places, 2.0 * model.tube_radius_mm);
        first.map_or(f64::INFINITY, |at| at + reach_mm)
    };
    let length_mm = spine.segments()[last].length_mm;
    (reach(0, &|x| x), reach(last, &|x| length_mm - x))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_no_scanner_leaves_of_a_round_tube_is_said() {
        assert_eq!(roughness(0.1, 3.0), None);
        assert_eq!(roughness(0.4, 20.0), None);
        let said = roughness(1.302, 22.606).unwrap();
        assert!(said.contains("1.30 mm") && said.contains("5.8 %") && said.contains("0.45 mm"), "{said}");
    }
}
