//! Levenberg-Marquardt on the signed distance to the tube's surface (paper 000, section 6), with robust weights,
//! bounds and covariance, on the moment form of `moments`.

use nalgebra::{DMatrix, DVector};

use super::model::{Flattening, Parameter, TubeModel};
use super::moments::{Moment, Pass, Sample};
use super::normal::equations;
use crate::recognize::MEDIAN_TO_SIGMA;

/// Cut-off of the biweight in standard deviations: at 6 it keeps 98 % of the efficiency of plain least squares.
pub const CUTOFF_SIGMAS: f64 = 6.0;

/// Why the solver stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stop {
    /// The step became smaller than the data resolves.
    Converged,
    /// No step improved the cost.
    Stalled,
    /// The given number of iterations was used up.
    Iterations,
    /// The goal is out of reach.
    Hopeless,
}

/// A fitted tube.
#[derive(Debug, Clone)]
pub struct Fit {
    /// The fitted model.
    pub model: TubeModel,
    /// Its free values.
    pub parameters: Vec<Parameter>,
    /// Normal matrix over the residual variance, in the order of `parameters`.
    pub information: DMatrix<f64>,
    /// Its inverse.
    pub covariance: DMatrix<f64>,
    /// Robust standard deviation of the residuals.
    pub sigma_mm: f64,
    /// Robust cost at cut-off `cutoff_mm`.
    pub cost: f64,
    /// Residuals beyond this do not count.
    pub cutoff_mm: f64,
    /// Points that count.
    pub used: usize,
    /// Median size of their residuals.
    pub median_mm: f64,
    /// Root mean square of each straight's, see [`Pass::straight_rms_mm`].
    pub straight_rms_mm: Vec<Option<f64>>,
    /// Passes over the points.
    pub passes: usize,
    /// Why it stopped.
    pub stop: Stop,
}

/// What a tube can be fitted to.
pub trait Data {
    /// Cost and moments of the model; residuals beyond `cutoff_mm` do not count.
    fn pass(&mut self, model: &TubeModel, cutoff_mm: f64) -> Pass;
}

impl Data for Sample {
    fn pass(&mut self, model: &TubeModel, cutoff_mm: f64) -> Pass {
        Sample::pass(self, model, cutoff_mm)
    }
}

/// How far to go.
#[derive(Debug, Clone, Copy)]
pub struct Effort {
    /// First cut-off of the residuals.
    pub cutoff_mm: f64,
    /// Rounds in which the cut-off follows the residuals' own scale; 0 keeps it.
    pub rounds: usize,
    /// Steps per round.
    pub steps: usize,
    /// What bend radii are expected, for bends too shallow to know their own.
    pub prior: Option<RadiusPrior>,
}

/// A weak expectation of the bend radii. It keeps shallow bends from running away and counts as nothing in the
/// covariance: a radius that the data does not carry stays unknown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RadiusPrior {
    /// Expected CLR.
    pub radius_mm: f64,
    /// Its standard deviation.
    pub spread_mm: f64,
}

/// Fits the model to the sample. The cut-off shrinks from `effort.cutoff_mm` to six standard deviations.
pub fn fit(sample: &mut impl Data, start: &TubeModel, effort: Effort) -> Fit {
    let parameters = start.parameters();
    let mut cutoff = effort.cutoff_mm;
    let mut passes = 0;
    let way = |cutoff_mm| Way {
        cutoff_mm,
        noise_mm: cutoff_mm / CUTOFF_SIGMAS,
        steps: effort.steps,
        goal: f64::INFINITY,
        resolved: RESOLVED,
    };
    let mut state = descend(sample, start.clone(), &parameters, effort.prior, way(cutoff));
    passes += state.passes;
    for _ in 0..effort.rounds {
        let sigma = robust_sigma(&state.pass, cutoff);
        let next = (CUTOFF_SIGMAS * sigma).min(cutoff);
        if next > 0.95 * cutoff {
            break;
        }
        cutoff = next;
        state = descend(sample, state.model, &parameters, effort.prior, way(cutoff));
        passes += state.passes;
    }
    let sigma_mm = robust_sigma(&state.pass, cutoff);
    let (normal, _) = equations(&state.pass.moments, &state.model, &parameters);
    let information = normal / state.pass.variance_mm2(parameters.len());
    Fit {
        cost: state.pass.cost,
        used: state.pass.used(),
        median_mm: state.pass.median_mm(cutoff).unwrap_or(0.0),
        straight_rms_mm: state.pass.straight_rms_mm(),
        model: state.model,
        stop: state.stop,
        parameters,
        covariance: invert(&information),
        information,
        sigma_mm,
        cutoff_mm: cutoff,
        passes,
    }
}

/// After a step this small, in standard deviations of the estimate (of all values together), what is left is none.
const LAST_STEP_SIGMAS: f64 = 1.0;

/// A step along a direction that the points tell badly may be so long that it bends away from where it leads; the next, longer in
/// standard deviations of what the points tell well, brings it back. (Shorter steps bend as much, and take more of them.)
/// From this pass on steps shrink.
const SHRINKING: usize = 5;

/// A step that leaves less than this share of the points on the tube leads astray.
const LEAST_KEPT: f64 = 0.95;

/// Takes a model that is nearly there to all points: Newton's steps, cut-off and all, until what is left is nothing beside
/// the estimate's own uncertainty. Two passes as a rule; None when the steps do not shrink or lead astray. Values that
/// the linear equations leave open are kept within their own standard deviations (`held`).
pub fn polish(
    data: &mut impl Data,
    start: &TubeModel,
    effort: Effort,
    held: &[(Parameter, f64)],
) -> Option<Fit> {
    let parameters = start.parameters();
    let mut model = start.clone();
    let mut cutoff_mm = effort.cutoff_mm;
    let (mut before, mut cost, mut used) = (f64::INFINITY, f64::INFINITY, 0.0);
    for passes in 1..=effort.steps {
        let pass = data.pass(&model, cutoff_mm);
        if (pass.used() as f64) < LEAST_KEPT * used {
            return None;
        }
        used = pass.used() as f64;
        let sigma_mm = robust_sigma(&pass, cutoff_mm);
        let all = expectant_equations(&model, &pass.moments, &parameters, &effort.prior, sigma_mm);
        let (mut normal, gradient, step) = held_at_bounds(&model, &parameters, all);
        let is_free = held.is_empty();
        for (parameter, spread) in held {
            let at = parameters.iter().position(|p| p == parameter);
            at.into_iter().for_each(|j| normal[(j, j)] += (sigma_mm / spread).powi(2));
        }
        let step = if is_free { step } else { damped_step(&normal, &gradient, NO_DAMPING) };
        let step = step? * pass.shortfall();
        let variance = pass.variance_mm2(parameters.len());
        let size = -gradient.dot(&step) / variance.max(1e-300);
        let next_cutoff_mm = (CUTOFF_SIGMAS * sigma_mm).min(cutoff_mm);
        if size < LAST_STEP_SIGMAS.powi(2) && next_cutoff_mm > 0.95 * cutoff_mm {
            let (normal, _) = equations(&pass.moments, &model, &parameters);
            let information = normal / variance;
            return Some(Fit {
                covariance: invert(&information),
                information,
                cost: pass.cost,
                used: pass.used(),
                median_mm: pass.median_mm(cutoff_mm).unwrap_or(0.0),
                straight_rms_mm: pass.straight_rms_mm(),
                stop: Stop::Converged,
                model: model.stepped(&parameters, &step),
                parameters,
                sigma_mm,
                cutoff_mm,
                passes,
            });
        }
        if passes >= SHRINKING && (size > 0.5 * before || pass.cost > cost) {
            return None;
        }
        (before, cost) = (size, pass.cost);
        cutoff_mm = next_cutoff_mm;
        model = model.stepped(&parameters, &step);
    }
    None
}

/// Standard deviation of the residuals within the cut-off from the median of their size.
fn robust_sigma(pass: &Pass, cutoff_mm: f64) -> f64 {
    pass.median_mm(cutoff_mm).map_or(cutoff_mm, |m| (m * MEDIAN_TO_SIGMA).max(1e-6))
}

/// Where a descent ended.
#[derive(Debug, Clone)]
pub struct Descent {
    /// The model reached.
    pub model: TubeModel,
    /// The data's sums there.
    pub pass: Pass,
    /// Passes over the data.
    pub passes: usize,
    /// Why it stopped.
    pub stop: Stop,
}

/// One descent's limits.
#[derive(Debug, Clone, Copy)]
pub struct Way {
    /// Residuals beyond this do not count.
    pub cutoff_mm: f64,
    /// Standard deviation of the data, by which expectations are weighed.
    pub noise_mm: f64,
    /// Most steps.
    pub steps: usize,
    /// A descent that is far from getting below this cost is given up.
    pub goal: f64,
    /// Share of a value's standard deviation that is not worth another step.
    pub resolved: f64,
}

/// The usual one.
pub const RESOLVED: f64 = 0.03;

/// Steps after which a descent may be given up, and what it may still gain, in gains of its last step.
const PATIENCE: usize = 8;
const HOPE: f64 = 10.0;

/// Damping of a step that is as good as undamped, which the first is: beside shallow bends the weakest directions have a
/// curvature of 1e-11 (rotations that undo each other), and any more damping would leave them as they are. And damping from
/// which on no step will help.
const NO_DAMPING: f64 = 1e-12;
const MOST_DAMPING: f64 = 1e6;

/// A step that gains less than this share of what an undamped one promises leads nowhere.
const LEAST_SHARE: f64 = 5e-3;

/// Steps beyond a place where none leads down, and times that they are tried.
const LEAP_STEPS: usize = 6;
const LEAPS: usize = 3;

/// What a descent goes over.
struct Ground<'a, D: Data> {
    data: &'a mut D,
    parameters: &'a [Parameter],
    prior: Option<RadiusPrior>,
    way: Way,
    passes: usize,
}

/// Normal matrix and gradient of what is free to step, and the undamped step.
type Equations = (DMatrix<f64>, DVector<f64>, Option<DVector<f64>>);

/// A place on the way.
struct Stand {
    model: TubeModel,
    pass: Pass,
    /// The data's and the expectations' together.
    cost: f64,
}

impl<D: Data> Ground<'_, D> {
    fn stand(&mut self, model: TubeModel) -> Stand {
        self.passes += 1;
        let pass = self.data.pass(&model, self.way.cutoff_mm);
        let off =
            expectations(&model, self.parameters, &self.prior).map(|(_, off, spread)| (off / spread).powi(2));
        let cost = pass.cost + 0.5 * self.way.noise_mm * self.way.noise_mm * off.sum::<f64>();
        Stand { model, pass, cost }
    }

    fn equations(&self, at: &Stand) -> Equations {
        let (model, noise_mm) = (&at.model, self.way.noise_mm);
        let all = expectant_equations(model, &at.pass.moments, self.parameters, &self.prior, noise_mm);
        held_at_bounds(model, self.parameters, all)
    }

    /// A gain that is not worth a step.
    fn nothing(&self) -> f64 {
        (self.way.resolved * self.way.noise_mm).powi(2)
    }

    /// The first step of rising damping that leads down; none once so damped a step promises nothing.
    fn downhill(
        &mut self,
        at: &Stand,
        (normal, gradient, undamped): &Equations,
        damping: &mut f64,
    ) -> Option<Stand> {
        while *damping < MOST_DAMPING {
            let is_undamped = *damping <= NO_DAMPING;
            let step = if is_undamped { undamped.clone() } else { damped_step(normal, gradient, *damping) };
            if let Some(step) = step {
                if -gradient.dot(&step) < self.nothing() {
                    return None;
                }
                let next = self.stand(at.model.stepped(self.parameters, &step));
                if next.cost < at.cost {
                    *damping = (*damping * 0.1).max(NO_DAMPING);
                    return Some(next);
                }
            }
            *damping *= 10.0;
        }
        None
    }

    /// Undamped steps, up or down, until one stands lower than where no step led down: a sample's derivatives leave out how a
    /// section's ovality grows along the tube, and so point a little past the way that the cost takes.
    fn leap(&mut self, from: &Stand) -> Option<Stand> {
        let mut at = None::<Stand>;
        for _ in 0..LEAP_STEPS {
            let here = at.as_ref().unwrap_or(from);
            let step = self.equations(here).2?;
            let next = self.stand(here.model.stepped(self.parameters, &step));
            if next.cost < from.cost {
                return Some(next);
            }
            at = Some(next);
        }
        None
    }
}

/// Levenberg-Marquardt from a starting model.
pub fn descend(
    data: &mut impl Data,
    start: TubeModel,
    parameters: &[Parameter],
    prior: Option<RadiusPrior>,
    way: Way,
) -> Descent {
    let mut ground = Ground { data, parameters, prior, way, passes: 0 };
    let mut at = ground.stand(start);
    let (mut damping, mut leaps, mut stop) = (NO_DAMPING, 0, Stop::Iterations);
    for taken in 0..way.steps {
        let equations = ground.equations(&at);
        // What an undamped step would still gain: nothing that the data resolves. The gain of the last step says less,
        // since in a narrow valley damped steps are short.
        let left = equations.2.as_ref().map_or(f64::INFINITY, |step| -equations.1.dot(step));
        if left < ground.nothing() {
            stop = Stop::Converged;
            break;
        }
        let next = ground.downhill(&at, &equations, &mut damping);
        let gain = next.as_ref().map_or(0.0, |next| at.cost - next.cost);
        at = next.unwrap_or(at);
        let promised = if left.is_finite() { left } else { 0.0 };
        if gain <= LEAST_SHARE * promised {
            let leapt = if leaps < LEAPS { ground.leap(&at) } else { None };
            let Some(leapt) = leapt else {
                stop = Stop::Stalled;
                break;
            };
            (at, damping, leaps) = (leapt, NO_DAMPING, leaps + 1);
        } else if taken >= PATIENCE && at.cost - HOPE * gain > way.goal {
            stop = Stop::Hopeless;
            break;
        }
    }
    Descent { model: at.model, pass: at.pass, passes: ground.passes, stop }
}

/// Normal equations with what is expected.
pub fn expectant_equations(
    model: &TubeModel,
    moments: &[Moment],
    parameters: &[Parameter],
    prior: &Option<RadiusPrior>,
    noise_mm: f64,
) -> (DMatrix<f64>, DVector<f64>) {
    let (mut normal, mut gradient) = equations(moments, model, parameters);
    for (j, off, spread) in expectations(model, parameters, prior) {
        let weight = (noise_mm / spread).powi(2);
        normal[(j, j)] += weight;
        gradient[j] += weight * off;
    }
    (normal, gradient)
}

/// Sections of bends are expected to be this oval at most, in tube radii.
const OVALITY_SPREAD: f64 = 0.03;

/// What is expected of values that the data may not carry: value, expectation, spread. Weak, and not in the
/// covariance.
fn expectations<'a>(
    model: &'a TubeModel,
    parameters: &'a [Parameter],
    prior: &'a Option<RadiusPrior>,
) -> impl Iterator<Item = (usize, f64, f64)> + 'a {
    parameters.iter().enumerate().filter_map(move |(j, parameter)| match *parameter {
        Parameter::Ovality(i) => Some((j, model.ovality_mm[i], OVALITY_SPREAD * model.tube_radius_mm)),
        Parameter::Flattening(i) => match &model.flattening {
            Flattening::Free { bends_mm, spread_mm } => Some((j, bends_mm[i], *spread_mm)),
            Flattening::Known(_) => None,
        },
        Parameter::BendRadius(i) => {
            prior.map(|p| (j, model.lra.bends[i].radius_mm - p.radius_mm, p.spread_mm))
        }
        _ => None,
    })
}

/// Whether a value stands at the lower bound of what a tube can have.
fn is_at_bound(model: &TubeModel, parameter: Parameter) -> bool {
    match parameter {
        Parameter::Length(i) => model.lra.bends[i].length_mm <= 0.0,
        Parameter::Angle(i) => model.lra.bends[i].angle_rad <= 0.0,
        Parameter::BendRadius(i) => model.lra.bends[i].radius_mm <= model.tube_radius_mm,
        _ => false,
    }
}

/// The equations without those values that stand at a bound and would cross it in the step that the others take with them
/// (each by itself may pull the other way). With that step.
fn held_at_bounds(
    model: &TubeModel,
    parameters: &[Parameter],
    (mut normal, mut gradient): (DMatrix<f64>, DVector<f64>),
) -> Equations {
    let mut standing: Vec<usize> =
        (0..parameters.len()).filter(|&j| is_at_bound(model, parameters[j])).collect();
    loop {
        let Some(step) = damped_step(&normal, &gradient, NO_DAMPING) else { return (normal, gradient, None) };
        let (crossing, inside): (Vec<usize>, Vec<usize>) = standing.into_iter().partition(|&j| step[j] < 0.0);
        for &j in &crossing {
            let diagonal = normal[(j, j)].max(1e-300);
            normal.row_mut(j).fill(0.0);
            normal.column_mut(j).fill(0.0);
            normal[(j, j)] = diagonal;
            gradient[j] = 0.0;
        }
        if crossing.is_empty() {
            return (normal, gradient, Some(step));
        }
        standing = inside;
    }
}

/// Marquardt's step: damping in proportion to each parameter's own curvature.
fn damped_step(normal: &DMatrix<f64>, gradient: &DVector<f64>, damping: f64) -> Option<DVector<f64>> {
    let (scaled, scale) = unit_diagonal(normal);
    let damped = scaled + DMatrix::identity(scale.len(), scale.len()) * damping;
    let right = -gradient.component_mul(&scale);
    Some(damped.cholesky()?.solve(&right).component_mul(&scale))
}

/// The matrix scaled to a unit diagonal, and the scale: units of millimetres and radians drop out.
fn unit_diagonal(matrix: &DMatrix<f64>) -> (DMatrix<f64>, DVector<f64>) {
    let largest = matrix.diagonal().max().max(1e-300);
    let scale = matrix.diagonal().map(|d| 1.0 / d.max(1e-14 * largest).sqrt());
    let scaled = DMatrix::from_fn(scale.len(), scale.len(), |i, j| matrix[(i, j)] * scale[i] * scale[j]);
    (scaled, scale)
}

/// Inverse of a normal matrix; directions that the data does not see get a huge, finite variance.
pub fn invert(matrix: &DMatrix<f64>) -> DMatrix<f64> {
    let (mut scaled, scale) = unit_diagonal(matrix);
    let n = scale.len();
    for exponent in -15..0 {
        if let Some(cholesky) = scaled.clone().cholesky() {
            let inverse = cholesky.inverse();
            return DMatrix::from_fn(n, n, |i, j| inverse[(i, j)] * scale[i] * scale[j]);
        }
        scaled += DMatrix::identity(n, n) * 10f64.powi(exponent);
    }
    DMatrix::from_diagonal(&scale.map(|s| s * s * 1e12))
}
