//! How far a straight's length may really stray where the linear covariance cannot say: bend on bend the other way, both
//! angles and the straight between them can change together and leave nearly the same tube.
//!
//! Beside `structure`, for `fit`'s covariance: the length is moved and held, all else is fitted again to the sections, and
//! where that costs one unit of chi-squared is its standard deviation (profile likelihood).

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::evidence::Solved;
use super::fit::{RadiusPrior, Way, descend, invert};
use super::model::{Parameter, TubeModel};
use super::sections::CentreLine;

/// A straight that by the linear covariance may be off by more than this is looked at, and any shorter than this, in tube
/// radii: where it ends at 0 the linear covariance changes from one fit to the next.
const SUSPECT_RADII: f64 = 0.05;
const SHORT_RADII: f64 = 0.3;

/// The first step that is tried, in tube radii: about what it mostly comes to.
const FIRST_RADII: f64 = 0.25;

/// Halvings of the step, and steps of a fit.
const HALVINGS: usize = 10;
const STEPS: usize = 60;

/// From a step that costs no more than this one goes to one that costs 1 as if costs grew by squares.
const NEARLY_ONE: f64 = 5.0;

/// A fit is near enough its best when it lacks so little, as a share of a standard deviation.
const RESOLVED: f64 = 0.2;

/// A value with its standard deviation as found by moving it.
pub type Held = (Parameter, f64);

/// Standard deviations of the lengths that the linear covariance may overstate. `correlation`: points that say one thing.
pub fn lengths(
    line: &CentreLine,
    model: &TubeModel,
    correlation: f64,
    prior: Option<RadiusPrior>,
) -> Vec<Held> {
    let parameters = model.parameters();
    let solved = Solved::new(line, model, &parameters, None);
    let unit = line.noise_mm * line.noise_mm * correlation;
    let suspect = |(j, p): (usize, &Parameter)| {
        let Parameter::Length(i) = *p else { return None };
        let linear_mm = (solved.inverse[(j, j)] * unit).max(0.0).sqrt();
        let most_mm = 2.0 * model.tube_radius_mm;
        let unsure = linear_mm > SUSPECT_RADII * model.tube_radius_mm;
        let short = model.lra.bends[i].length_mm < SHORT_RADII * model.tube_radius_mm;
        (unsure || short).then_some((i, linear_mm.min(most_mm)))
    };
    let found: Vec<(usize, f64)> = parameters.iter().enumerate().filter_map(suspect).collect();
    if found.is_empty() {
        return Vec::new();
    }
    let fitted = |start: TubeModel, free: &[Parameter], goal: f64| {
        let (cutoff_mm, noise_mm) = (f64::INFINITY, line.noise_mm);
        let way = Way { cutoff_mm, noise_mm, steps: STEPS, goal, resolved: RESOLVED };
        descend(&mut &*line, start, free, prior, way)
    };
    let best = fitted(model.clone(), &parameters, f64::INFINITY);
    let (model, least) = (best.model, best.pass.cost);
    let dear = least + 0.5 * unit * NEARLY_ONE;
    let excess = |i: usize, length_mm: f64| {
        let mut moved = model.clone();
        let change = length_mm - moved.lra.bends[i].length_mm;
        // Both arcs give way to the straight, so that the start is near the valley.
        let arcs = moved.lra.bends[i - 1].radius_mm + moved.lra.bends[i].radius_mm;
        for bend in &mut moved.lra.bends[i - 1..=i] {
            bend.angle_rad = (bend.angle_rad - change / arcs).max(1e-4);
        }
        moved.lra.bends[i].length_mm = length_mm;
        let free: Vec<Parameter> =
            parameters.iter().copied().filter(|p| *p != Parameter::Length(i)).collect();
        2.0 * (fitted(moved, &free, dear).pass.cost - least) / unit
    };
    let first_mm = FIRST_RADII * model.tube_radius_mm;
    // To both sides: down to where the straight is none the tube may hardly change, and up it changes at once.
    let spread = |&(i, linear_mm): &(usize, f64)| {
        let at = model.lra.bends[i].length_mm;
        let side =
            |way_mm: f64| one_unit(way_mm.abs(), first_mm, |step| excess(i, at + step * way_mm.signum()));
        let down_mm = if at > 0.0 { side(-linear_mm.min(at)) } else { 0.0 };
        (Parameter::Length(i), side(linear_mm).max(down_mm))
    };
    found.par_iter().map(spread).collect()
}

/// The step, no larger than `most`, that costs one unit of chi-squared: `first`, doubled or halved until it costs about that.
/// (Large steps lead far from the valley, and back takes long.)
fn one_unit(most: f64, first: f64, excess: impl Fn(f64) -> f64) -> f64 {
    let mut step = first.min(most);
    let mut cost = excess(step);
    while cost < 1.0 && step < most {
        let wider = (2.0 * step).min(most);
        let dearer = excess(wider);
        if dearer > NEARLY_ONE {
            return step;
        }
        (step, cost) = (wider, dearer);
    }
    for _ in 0..HALVINGS {
        if cost <= NEARLY_ONE {
            return step / cost.max(1.0).sqrt();
        }
        step *= 0.5;
        cost = excess(step);
    }
    step
}

/// The covariance of this information with what was found of single values: as if each had been measured once more, so that
/// its own standard deviation becomes the one found. On the information, since a value that the linear covariance leaves
/// open altogether has nothing to be subtracted from.
pub fn tightened(information: &DMatrix<f64>, parameters: &[Parameter], held: &[Held]) -> DMatrix<f64> {
    let mut information = information.clone();
    let mut covariance = invert(&information);
    for (parameter, sigma) in held {
        let Some(j) = parameters.iter().position(|p| p == parameter) else { continue };
        let (own, wanted) = (covariance[(j, j)], sigma * sigma);
        if own > wanted {
            information[(j, j)] += 1.0 / wanted - 1.0 / own;
            covariance = invert(&information);
        }
    }
    covariance
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_held_takes_its_partners_along() {
        // Two values that differ surely by nothing, both unsure: holding one holds the other.
        let information = invert(&DMatrix::from_row_slice(2, 2, &[4.0, 4.0, 4.0, 4.01]));
        let parameters = [Parameter::Length(1), Parameter::Angle(1)];
        let held = tightened(&information, &parameters, &[(Parameter::Length(1), 0.1)]);
        assert!((held[(0, 0)] - 0.01).abs() < 1e-9);
        assert!((held[(1, 1)] - 0.02).abs() < 1e-9);
        // A wider one changes nothing.
        let same = tightened(&information, &parameters, &[(Parameter::Length(1), 3.0)]);
        assert_eq!(same, invert(&information));
    }

    #[test]
    fn a_value_that_was_open_altogether_is_held_too() {
        // Only the difference is known, as of two bends the other way with nothing between.
        let information = DMatrix::from_row_slice(2, 2, &[1e6, -1e6, -1e6, 1e6]);
        let parameters = [Parameter::Length(1), Parameter::Angle(1)];
        let held = tightened(&information, &parameters, &[(Parameter::Length(1), 0.5)]);
        assert!((held[(0, 0)] - 0.25).abs() < 1e-3 && (held[(1, 1)] - 0.25).abs() < 1e-3, "{held}");
    }
}
