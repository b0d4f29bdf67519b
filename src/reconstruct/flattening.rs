//! Whether the bends' outer walls are flattened: a section that is not oval but three-sided. Where a scan shows one side of a
//! tube only, such a wall passes for a bend that lies elsewhere: it biases CLR and angle, and looks like more bends.
//!
//! Beside `structure`, which is asked again once walls are known to be flat, and under `finish`, after the fit of all points
//! without: values that a round tube has not would only make its others less certain, so they are free where the points
//! ask for them. The test is the score test of one value more: what its gradient would gain with all others adjusted,
//! without fitting it.

use nalgebra::{DMatrix, Point3};

use super::fit::{CUTOFF_SIGMAS, Data, Effort, Fit, fit, invert};
use super::model::{Flattening, Parameter, TubeModel, Wall};
use super::moments::Sample;
use super::normal::equations;
use super::structure::Structure;
use crate::tube::Decision;

/// So many standard deviations from 0 is flattened: by chance one tube of two hundred with ten bends.
const TOLD_SIGMAS: f64 = 3.5;

/// A bend whose other values can do all of its flattening but this share tells nothing of it.
const LEAST_OWN: f64 = 1e-6;

/// No scanner and no noise's mean is true to less than this share of the tube's radius. And how oval a bend becomes at its ends
/// may look like so much flattening of it, in a bend that is a radius long.
const SLIGHT: f64 = 3e-4;
const OF_OVALITY: f64 = 0.1;

/// Bends differ from the usual by about this share of it.
const UNLIKE: f64 = 0.5;

/// Steps of a fit to the sample.
const STEPS: usize = 20;

/// What points say of the outer walls.
#[derive(Debug, Clone, PartialEq)]
pub struct Told {
    /// Free values to begin with: all 0, expected to be about as large as the largest that stands out.
    pub flattening: Flattening,
    /// By how many standard deviations of independent noise the bend stands out that does so most.
    sigmas: f64,
}

impl Told {
    /// Whether it stands out when so many points (`correlation`) say one thing.
    pub fn stands_out(&self, correlation: f64) -> bool {
        self.sigmas > TOLD_SIGMAS * correlation.sqrt()
    }
}

/// What the points say of the outer walls at a fit without; None where none stands out of independent noise.
pub fn told(data: &mut impl Data, model: &TubeModel, cutoff_mm: f64) -> Option<Told> {
    let bends_mm = vec![0.0; model.lra.bends.len()];
    let flattening = Flattening::Free { bends_mm: bends_mm.clone(), spread_mm: f64::INFINITY };
    let model = TubeModel { flattening, ..model.clone() };
    let parameters = model.parameters();
    let pass = data.pass(&model, cutoff_mm);
    let (normal, gradient) = equations(&pass.moments, &model, &parameters);
    let variance = pass.variance_mm2(parameters.len());
    let own: Vec<(usize, usize)> = own(&parameters).collect();
    let others: Vec<usize> = (0..parameters.len()).filter(|j| own.iter().all(|(o, _)| o != j)).collect();
    let inverse = invert(&normal.select_rows(&others).select_columns(&others));
    let (mut sigmas, mut largest_mm) = (0.0_f64, 0.0_f64);
    for (j, bend) in own {
        let follows = &inverse * normal.column(j).select_rows(&others);
        let curvature = normal[(j, j)] - follows.dot(&normal.column(j).select_rows(&others));
        let slope = gradient[j] - follows.dot(&gradient.select_rows(&others));
        let out = slope.abs() / (curvature * variance).sqrt();
        let size_mm = slope.abs() / curvature;
        if curvature > LEAST_OWN * normal[(j, j)] && out > TOLD_SIGMAS && size_mm > least_mm(&model, bend) {
            sigmas = sigmas.max(out);
            largest_mm = largest_mm.max(size_mm);
        }
    }
    let flattening = Flattening::Free { bends_mm, spread_mm: largest_mm };
    (sigmas > 0.0).then_some(Told { flattening, sigmas })
}

/// The flattenings among a tube's values: which value, and of which bend.
fn own(parameters: &[Parameter]) -> impl Iterator<Item = (usize, usize)> {
    parameters.iter().enumerate().filter_map(|(j, parameter)| match parameter {
        Parameter::Flattening(bend) => Some((j, *bend)),
        _ => None,
    })
}

/// The wall of bend i is flattened by no less than this.
fn least_mm(model: &TubeModel, i: usize) -> f64 {
    let (radius_mm, bend) = (model.tube_radius_mm, &model.lra.bends[i]);
    let length_mm = (bend.angle_rad * bend.radius_mm).max(radius_mm);
    SLIGHT * radius_mm + OF_OVALITY * model.ovality_mm[i].abs() * radius_mm / length_mm
}

/// How flat the sample shows the outer walls of a tube with this structure: each bend's own as far as it tells, the usual one
/// where it does not. None where the search knew that, or there is no more to know than the noise lets pass.
pub fn walls(sample: &[Point3<f64>], found: &Structure) -> Option<Vec<Wall>> {
    let (model, noise_mm) = (&found.model, found.noise_mm);
    let cutoff_mm = CUTOFF_SIGMAS * noise_mm;
    let mut sample = Sample::new(sample.to_vec(), model);
    if model.flattening == Flattening::NONE {
        told(&mut sample, model, cutoff_mm)?;
    }
    let start = TubeModel { flattening: freed(model), ..model.clone() };
    let free = fit(&mut sample, &start, Effort { cutoff_mm, rounds: 0, steps: STEPS, prior: found.prior });
    let (known_mm, found_mm, middles) =
        (model.flattenings_mm(), free.model.flattenings_mm(), free.model.middles());
    let bends: Vec<(usize, f64)> =
        own(&free.parameters).map(|(j, i)| (i, free.covariance[(j, j)].max(1e-300))).collect();
    let weight: f64 = bends.iter().map(|(_, variance)| variance.recip()).sum();
    let usual_mm = bends.iter().map(|(i, variance)| found_mm[*i] / variance).sum::<f64>() / weight;
    let spread_mm2 = (UNLIKE * usual_mm).powi(2);
    let wall = |&(i, variance): &(usize, f64)| {
        let trust = spread_mm2 / (spread_mm2 + variance);
        Wall { at: middles[i], flat_mm: usual_mm + trust * (found_mm[i] - usual_mm) }
    };
    let walls: Vec<Wall> = bends.iter().map(wall).collect();
    let is_news = |(wall, (i, _)): (&Wall, &(usize, f64))| (wall.flat_mm - known_mm[*i]).abs() > noise_mm;
    walls.iter().zip(&bends).any(is_news).then_some(walls)
}

/// The model's flattening as each bend's own, expected to be about as large as it is.
pub fn freed(model: &TubeModel) -> Flattening {
    let bends_mm = model.flattenings_mm();
    let largest_mm = bends_mm.iter().fold(0.0_f64, |most, g| most.max(g.abs()));
    Flattening::Free { bends_mm, spread_mm: if largest_mm > 0.0 { largest_mm } else { f64::INFINITY } }
}

/// What speaks for the outer walls of a fit with its last covariance, where they are free; `correlation`: points that say one
/// thing.
pub fn decision(fit: &Fit, correlation: f64) -> Option<Decision> {
    let (price, bends_mm) = ((fit.used as f64 / correlation).max(2.0).ln(), fit.model.flattenings_mm());
    let worth = |(j, i): (usize, usize)| bends_mm[i].powi(2) / fit.covariance[(j, j)].max(1e-300) - price;
    let gain = own(&fit.parameters).map(worth).sum();
    let largest_mm = bends_mm.iter().fold(0.0_f64, |most, g| most.max(g.abs()));
    let what = format!("outer walls flattened by up to {largest_mm:.3} mm");
    fit.model.flattening.is_free().then_some(Decision { what, bend: None, gain, kept: true })
}

/// The information on a fit's values with what is expected of the outer walls: unlike other expectations this one counts, since
/// walls that points tell badly are known to be about as flat as the others.
pub fn expected(mut information: DMatrix<f64>, fit: &Fit) -> DMatrix<f64> {
    if let Flattening::Free { spread_mm, .. } = fit.model.flattening {
        own(&fit.parameters).for_each(|(j, _)| information[(j, j)] += spread_mm.powi(-2));
    }
    information
}
