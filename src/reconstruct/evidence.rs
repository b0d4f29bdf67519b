//! What the residuals say about the structure: where a loose joint in the tube would take them away. White noise says
//! nothing; a bend that the model lacks shows as a joint.

use nalgebra::{DMatrix, DVector, Matrix4, Matrix6, Matrix6x4, SymmetricEigen, Vector3, Vector4, Vector6};
use rayon::prelude::*;

use super::fit::{RadiusPrior, expectant_equations, invert};
use super::model::{Motion, Parameter, TubeModel};
use super::moments::Moment;
use super::normal::{Part, symmetric, to_segment};
use super::sections::CentreLine;
use crate::tube::{Frame, Spine};

/// A joint's freedom that has less than this share of its worth left is no news to the model.
const NO_NEWS: f64 = 1e-5;

/// The shorter part of a tube is taken for no less than this share of the longer one's worth, or rounding would tell of bends.
const LEAST_PART: f64 = 1e-9;

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

/// The normal equations of a fitted model, solved.
#[derive(Debug, Clone)]
pub struct Solved {
    /// Inverse of the normal matrix: times the noise's variance the covariance.
    pub inverse: DMatrix<f64>,
    gradient: DVector<f64>,
    /// Per section: the segment that it faces and its moment.
    moments: Vec<(usize, Moment)>,
}

impl Solved {
    /// Sums the sections about a model; with what is expected of the radii, or a bend between two sections, whose CLR
    /// nothing tells, would leave nothing to be said of its surroundings.
    pub fn new(
        line: &CentreLine,
        model: &TubeModel,
        parameters: &[Parameter],
        prior: Option<RadiusPrior>,
    ) -> Solved {
        let moments = line.moments(model);
        let mut whole = vec![Moment::zeros(); 2 * model.lra.bends.len() + 1];
        moments.iter().for_each(|(k, m)| whole[*k] += m);
        let (normal, gradient) = expectant_equations(model, &whole, parameters, &prior, line.noise_mm);
        Solved { inverse: invert(&normal), gradient, moments }
    }

    /// Tests a joint between any two sections: the score test of a model with four values more (shift and roll along
    /// the tube, bend about both directions across it). A bend that the model lacks is such a joint; where a joint is
    /// no news to the model (a shift in the middle of a straight) it gains nothing.
    pub fn joints(
        &self,
        line: &CentreLine,
        model: &TubeModel,
        parameters: &[Parameter],
        noise_mm: f64,
    ) -> Vec<Joint> {
        // In the start frame, as the motions are.
        let spine = Spine::from_lra(&model.lra, Frame::identity());
        let places = line.places_mm(model);
        let columns = model.columns(parameters);
        let seen: Vec<Matrix6<f64>> = spine.segments().iter().map(|s| to_segment(&s.start)).collect();
        let mut after = Downstream::empty(spine.segments().len());
        let mut loose = Vec::with_capacity(places.len());
        for i in (1..self.moments.len()).rev() {
            let (segment, moment) = &self.moments[i];
            let part = Part::of(&symmetric(moment), &seen[*segment]);
            after.add(*segment, &part);
            let mut mixed = DMatrix::zeros(parameters.len(), 6);
            for column in &columns {
                let felt = after.felt(&column.motion);
                let mut row = mixed.row_mut(column.parameter);
                row += felt.transpose();
            }
            loose.push((0.5 * (places[i - 1] + places[i]), after.all.clone(), mixed));
        }
        if let Some((segment, moment)) = self.moments.first() {
            after.add(*segment, &Part::of(&symmetric(moment), &seen[*segment]));
        }
        let whole = after.all.square;
        let test = |(at_mm, after, mixed): &(f64, Part, DMatrix<f64>)| {
            let (gain, step) = self.test((after, &whole), mixed, &spine.frame_at(*at_mm));
            Joint {
                at_mm: *at_mm,
                gain: gain / (noise_mm * noise_mm),
                shift_mm: step[0],
                turn_rad: Vector3::new(step[1], step[2], step[3]),
            }
        };
        loose.par_iter().rev().map(test).collect()
    }

    /// Gain and best step of a joint's freedoms: shift along x and turns about x, y, z of `frame`. What lies `after` it moves, of
    /// all that there is; what lies before it might as well.
    fn test(
        &self,
        (after, whole): (&Part, &Matrix6<f64>),
        mixed: &DMatrix<f64>,
        frame: &Frame,
    ) -> (f64, Vector4<f64>) {
        let back: Matrix6<f64> = to_segment(&frame.inverse());
        let free = Matrix6x4::from_columns(&[0, 3, 4, 5].map(|k| back.column(k).into_owned()));
        let mixed = mixed * free;
        let solved = &self.inverse * &mixed;
        let square: Matrix4<f64> = free.transpose() * after.square * free;
        let left = square - Matrix4::from_iterator((mixed.transpose() * &solved).iter().copied());
        let right = free.transpose() * after.gradient()
            - Vector4::from_iterator((solved.transpose() * &self.gradient).iter().copied());
        // In units of what each freedom would be worth alone, by the shorter part: of a long tube a turn near its first end would
        // seem to be worth nothing. What the model has already has no worth left.
        let before = (free.transpose() * (whole - after.square) * free).diagonal();
        let worth =
            square.diagonal().zip_map(&before, |after, before| before.max(LEAST_PART * after).min(after));
        let scale = worth.map(|w| 1.0 / w.max(1e-12).sqrt());
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
        (gain, step.component_mul(&scale))
    }
}

/// Sums over all that lies downstream of a place that moves upstream.
struct Downstream {
    /// Segment of the place.
    current: usize,
    all: Part,
    /// The sums of one segment alone.
    own: Vec<Part>,
    /// From the start of a segment on, for those downstream of the place's.
    from: Vec<Part>,
}

impl Downstream {
    fn empty(segments: usize) -> Downstream {
        let none = vec![Part::empty(); segments];
        Downstream { current: segments - 1, all: Part::empty(), own: none.clone(), from: none }
    }

    /// Adds the next section upstream.
    fn add(&mut self, segment: usize, part: &Part) {
        while self.current > segment {
            self.from[self.current] = self.all.clone();
            self.current -= 1;
        }
        self.all.add(part);
        self.own[segment].add(part);
    }

    /// What a motion does to the downstream part, as twists of that part feel it.
    fn felt(&self, motion: &Motion) -> Vector6<f64> {
        match *motion {
            Motion::Twist { from, twist } if from <= self.current => self.all.square * twist,
            Motion::Twist { from, twist } => self.from[from].square * twist,
            Motion::Own { segment, row } => self.own[segment].against(row),
            Motion::Everywhere { row } => self.all.against(row),
        }
    }
}
