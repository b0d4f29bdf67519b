//! What the residuals say about the structure: whether they hang together, and where a loose joint in the tube would take
//! them away. White noise says nothing; a bend that the model lacks shows as a joint.

use nalgebra::{
    DMatrix, DVector, Matrix4, Matrix6, Matrix6x4, SymmetricEigen, Vector2, Vector3, Vector4, Vector6,
};

use super::fit::{Fit, invert};
use super::model::{TubeModel, in_frame};
use super::moments::{Moment, ROWS, Sample};
use super::radius::median;
use crate::tube::{Frame, Spine};

/// A joint's freedom that has less than this share of its worth left is no news to the model.
const NO_NEWS: f64 = 1e-5;

/// What a loose joint at one place of the tube would be worth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Joint {
    /// Arc length of the place.
    pub at_mm: f64,
    /// Gain in squared residuals over the noise's variance, all other values adjusted: about the number of the
    /// joint's freedoms where nothing is missing.
    pub gain: f64,
    /// Shift along the tube of all that follows.
    pub shift_mm: f64,
    /// Turn of all that follows, in the spine's frame there: roll about the tangent, then about y and z.
    pub turn_rad: Vector3<f64>,
}

/// Sectors around the tube that make patches with the stations along it.
const SECTORS: usize = 8;

/// Fewest points of a patch that tell its mean.
const MIN_PATCH: usize = 5;

/// Median of a squared standard normal variable.
const MEDIAN_CHI2: f64 = 0.4549;

/// A point as its place on the tube sees it.
struct Seen {
    station: usize,
    /// Unit normal across the tube: y, z of the spine's frame.
    normal: Vector2<f64>,
    residual_mm: f64,
}

/// All points within the cut-off, by station.
fn seen<'a>(
    sample: &'a Sample,
    model: &TubeModel,
    spine: &'a Spine,
    station_mm: f64,
    cutoff_mm: f64,
) -> impl Iterator<Item = Seen> + 'a {
    let radius = model.tube_radius_mm;
    sample.points.iter().zip(sample.segments()).filter_map(move |(p, segment)| {
        let segment = &spine.segments()[*segment as usize];
        let along = segment.closest_along_mm(p);
        let local = segment.frame_at(along).inverse_transform_point(p);
        let distance = local.y.hypot(local.z);
        let residual_mm = distance - radius;
        let station = ((segment.start_mm + along) / station_mm) as usize;
        let normal = Vector2::new(local.y, local.z) / distance.max(1e-12);
        (residual_mm.abs() <= cutoff_mm).then_some(Seen { station, normal, residual_mm })
    })
}

/// By how much the residuals of a patch hang together: 1 for independent noise; n when a patch's mean varies n times
/// more than its points' scatter explains, as it does where the tube is not quite round or straight or passes of the
/// scanner disagree. A median, so that a local misfit does not count.
pub fn correlation(
    sample: &Sample,
    model: &TubeModel,
    station_mm: f64,
    cutoff_mm: f64,
    sigma_mm: f64,
) -> f64 {
    let spine = model.spine();
    let count = (spine.length_mm() / station_mm) as usize + 1;
    let mut patches = vec![(0usize, 0.0f64); count * SECTORS];
    for point in seen(sample, model, &spine, station_mm, cutoff_mm) {
        let turn = point.normal.y.atan2(point.normal.x) / std::f64::consts::TAU + 0.5;
        let sector = ((turn * SECTORS as f64) as usize).min(SECTORS - 1);
        let (n, sum) = &mut patches[point.station.min(count - 1) * SECTORS + sector];
        *n += 1;
        *sum += point.residual_mm;
    }
    let filled = patches.iter().filter(|(n, _)| *n >= MIN_PATCH);
    let mut chi2: Vec<f64> = filled.map(|(n, sum)| sum * sum / (*n as f64 * sigma_mm * sigma_mm)).collect();
    median(&mut chi2).map_or(1.0, |m| (m / MEDIAN_CHI2).max(1.0))
}

/// Tests a joint at every station: the score test of a model with four values more (shift and roll along the tube, bend
/// about both directions across it). A bend that the model lacks is such a joint; where a joint is no news to the
/// model (a shift in the middle of a straight) it gains nothing.
pub fn joints(sample: &mut Sample, fit: &Fit, station_mm: f64, cutoff_mm: f64, sigma_mm: f64) -> Vec<Joint> {
    let (model, parameters) = (&fit.model, &fit.parameters);
    let stations = sample.pass_by_station(model, cutoff_mm, station_mm);
    let motions = model.motions(parameters);
    // In the start frame, as the motions are.
    let spine = Spine::from_lra(&model.lra, Frame::identity());
    let n = parameters.len();
    let mut normal = DMatrix::zeros(n, n);
    let mut gradient = DVector::zeros(n);
    let mut after = Downstream::empty(n);
    let mut sums = Vec::with_capacity(stations.len());
    for station in stations.iter().rev() {
        sums.push((station.end_mm, after.clone()));
        let mut moment = station.moment;
        moment.fill_upper_triangle_with_lower_triangle();
        let basis = motions[station.segment].basis(parameters);
        let rows = moment.fixed_view::<ROWS, ROWS>(0, 0) * &basis;
        normal += basis.transpose() * &rows;
        gradient += basis.transpose() * moment.fixed_view::<ROWS, 1>(0, ROWS);
        after.add(&moment, &basis, &to_segment(&spine.segments()[station.segment].start));
    }
    let inverse = invert(&normal);
    let test = |(at_mm, after): &(f64, Downstream)| {
        let frame = spine.frame_at(*at_mm);
        after.test(*at_mm, &frame, &inverse, &gradient, sigma_mm)
    };
    sums.iter().rev().filter(|(at, _)| *at < spine.length_mm()).map(test).collect()
}

/// Sums over all that lies downstream of a place.
#[derive(Clone)]
struct Downstream {
    /// Parameters against twists of the downstream part (in the start frame).
    mixed: DMatrix<f64>,
    square: Matrix6<f64>,
    gradient: Vector6<f64>,
}

impl Downstream {
    fn empty(parameters: usize) -> Downstream {
        let mixed = DMatrix::zeros(parameters, 6);
        Downstream { mixed, square: Matrix6::zeros(), gradient: Vector6::zeros() }
    }

    fn add(&mut self, moment: &Moment, basis: &DMatrix<f64>, to_segment: &Matrix6<f64>) {
        self.mixed += basis.transpose() * (moment.fixed_view::<ROWS, 6>(0, 0) * to_segment);
        self.square += to_segment.transpose() * moment.fixed_view::<6, 6>(0, 0) * to_segment;
        self.gradient += to_segment.transpose() * moment.fixed_view::<6, 1>(0, ROWS);
    }

    fn test(
        &self,
        at_mm: f64,
        frame: &Frame,
        inverse: &DMatrix<f64>,
        gradient: &DVector<f64>,
        sigma_mm: f64,
    ) -> Joint {
        // Shift along x; turns about x, y, z; seen from the start frame.
        let back = to_segment(&frame.inverse());
        let free = Matrix6x4::from_columns(&[0, 3, 4, 5].map(|k| back.column(k).into_owned()));
        let mixed = &self.mixed * free;
        let solved = inverse * &mixed;
        let square: Matrix4<f64> = free.transpose() * self.square * free;
        let left = square - Matrix4::from_iterator((mixed.transpose() * &solved).iter().copied());
        let right = free.transpose() * self.gradient
            - Vector4::from_iterator((solved.transpose() * gradient).iter().copied());
        // In units of what each freedom would be worth alone; what the model has already has no worth left.
        let scale = square.diagonal().map(|d| 1.0 / d.max(1e-12).sqrt());
        let scaled = Matrix4::from_fn(|i, j| left[(i, j)] * scale[i] * scale[j]);
        let eigen = SymmetricEigen::new((scaled + scaled.transpose()) * 0.5);
        let (mut step, mut gain) = (Vector4::zeros(), 0.0);
        for (value, direction) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
            if *value > NO_NEWS {
                let along = direction.dot(&right.component_mul(&scale));
                step -= direction * (along / value);
                gain += along * along / value;
            }
        }
        let step = step.component_mul(&scale);
        Joint {
            at_mm,
            gain: gain / (sigma_mm * sigma_mm),
            shift_mm: step[0],
            turn_rad: Vector3::new(step[1], step[2], step[3]),
        }
    }
}

/// Matrix that takes a twist to how `frame` sees it.
fn to_segment(frame: &Frame) -> Matrix6<f64> {
    let column = |k: usize| {
        let mut twist = Vector6::zeros();
        twist[k] = 1.0;
        in_frame(&twist, frame)
    };
    Matrix6::from_columns(&[0, 1, 2, 3, 4, 5].map(column))
}
