//! The tube as a parameter vector: pose, LRA rows, bend radii and the tube's radius, and how a small change
//! of each moves the tube (its twist), which is all that the least-squares fit needs.
//!
//! Representation after paper 000, section 5.3. The first straight's length shares its gauge with the pose and
//! is therefore no parameter; nor is the last one's, which the surface does not know (see `ends`).

use nalgebra::{DVector, Point3, Translation3, UnitQuaternion, Vector3, Vector6};

use super::moments::{FLATTENING, OVALITY, OWN_ANGLE, OWN_RADIUS, TUBE_RADIUS};
use crate::recognize::median;
use crate::tube::{Frame, Lra, SegmentKind, Spine, wrap_angle};

/// A tube in space.
#[derive(Debug, Clone, PartialEq)]
pub struct TubeModel {
    /// Pose at the start of the first straight.
    pub start: Frame,
    /// Straights, rotations, angles, radii. The first row's rotation is 0: the pose holds it.
    pub lra: Lra,
    /// Outer radius of the tube.
    pub tube_radius_mm: f64,
    /// How oval each bend's section is: its radius is the tube's plus this times cos 2 psi, psi from the outside of the
    /// bend; negative where the bend is flattened, as is usual.
    pub ovality_mm: Vec<f64>,
    /// How flat the outer walls of the bends are.
    pub flattening: Flattening,
    /// One radius for all bends (one die) instead of one each.
    pub common_radius: bool,
}

/// Flattened outer walls: the section's radius has a bend's value times cos 3 psi more, psi from the outside of the bend;
/// negative where the outer wall lies within the oval section and its two shoulders without.
#[derive(Debug, Clone, PartialEq)]
pub enum Flattening {
    /// No free values: each bend has that of the wall that was seen nearest to it; 0 as long as none was.
    Known(Vec<Wall>),
    /// Each bend's own, and free.
    Free {
        /// The bends' values.
        bends_mm: Vec<f64>,
        /// Standard deviation that is expected of them: a bend that does not tell its own is taken to be about as flat as those
        /// that do.
        spread_mm: f64,
    },
}

/// A flattened outer wall that was seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wall {
    /// Middle of the bend.
    pub at: Point3<f64>,
    /// Its value.
    pub flat_mm: f64,
}

impl Flattening {
    /// Outer walls as round as the section.
    pub const NONE: Flattening = Flattening::Known(Vec::new());

    /// Whether each bend has its own value.
    pub fn is_free(&self) -> bool {
        matches!(self, Flattening::Free { .. })
    }
}

/// One free value of the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Parameter {
    /// Shift (0, 1, 2) or turn (3, 4, 5) of the whole along or about the start frame's axes.
    Pose(usize),
    /// Straight before bend i, i >= 1.
    Length(usize),
    /// Rotation of bend i, i >= 1.
    Rotation(usize),
    /// Angle of bend i.
    Angle(usize),
    /// CLR of bend i.
    BendRadius(usize),
    /// CLR of all bends.
    CommonRadius,
    /// Ovality of bend i.
    Ovality(usize),
    /// Flattening of bend i.
    Flattening(usize),
    /// Outer radius of the tube.
    TubeRadius,
}

/// One way in which a parameter moves the tube's surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Motion {
    /// Everything from segment `from` on moves rigidly, by this twist (velocity, angular velocity) in the start frame.
    Twist {
        /// First segment that moves.
        from: usize,
        /// The twist when the parameter grows by one.
        twist: Vector6<f64>,
    },
    /// One arc changes by itself: a row of its moment.
    Own {
        /// The arc.
        segment: usize,
        /// Row of the moment.
        row: usize,
    },
    /// All segments change alike: a row of every moment.
    Everywhere {
        /// Row of the moments.
        row: usize,
    },
}

/// A motion and whose it is. A parameter may have several, which add up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Column {
    /// Index of the parameter.
    pub parameter: usize,
    /// What it does.
    pub motion: Motion,
}

/// A bend whose arc is shorter than this, in tube radii, is not long enough to become oval: between its ramps nothing is left.
const SHORTEST_OVAL_RADII: f64 = 0.25;

/// Ovality beyond this share of the radius is no bent tube's any more.
const MOST_OVAL: f64 = 0.15;

impl TubeModel {
    /// A tube of round section with a radius for every bend.
    pub fn round(start: Frame, lra: Lra, tube_radius_mm: f64) -> TubeModel {
        let ovality_mm = vec![0.0; lra.bends.len()];
        TubeModel {
            start,
            lra,
            tube_radius_mm,
            ovality_mm,
            flattening: Flattening::NONE,
            common_radius: false,
        }
    }

    /// The free values in their order.
    pub fn parameters(&self) -> Vec<Parameter> {
        let n = self.lra.bends.len();
        // A straight tube knows neither where along its axis nor how turned about it it is.
        let pose = (0..6).filter(|k| n > 0 || (*k != 0 && *k != 3)).map(Parameter::Pose);
        let mut all: Vec<Parameter> = pose.collect();
        for i in 0..n {
            if i > 0 {
                all.extend([Parameter::Length(i), Parameter::Rotation(i)]);
            }
            all.push(Parameter::Angle(i));
            if !self.common_radius {
                all.push(Parameter::BendRadius(i));
            }
            if self.may_be_oval(i) {
                all.push(Parameter::Ovality(i));
                all.extend(self.flattening.is_free().then_some(Parameter::Flattening(i)));
            }
        }
        if self.common_radius && n > 0 {
            all.push(Parameter::CommonRadius);
        }
        all.push(Parameter::TubeRadius);
        all
    }

    /// Whether a bend is long enough for an oval section; where it is not its ovality is no free value, and 0 by rule.
    pub fn may_be_oval(&self, i: usize) -> bool {
        let bend = &self.lra.bends[i];
        self.is_arc_oval(bend.radius_mm * bend.angle_rad)
    }

    /// The same of an arc of some length.
    pub fn is_arc_oval(&self, length_mm: f64) -> bool {
        length_mm >= SHORTEST_OVAL_RADII * self.tube_radius_mm
    }

    /// The model with what is 0 by rule at 0, and one CLR where there is to be one: a change may have given a bend its own.
    pub fn settled(mut self) -> TubeModel {
        let mut radii_mm: Vec<f64> = self.lra.bends.iter().map(|b| b.radius_mm).collect();
        if let Some(one) = median(&mut radii_mm).filter(|_| self.common_radius) {
            self.lra.bends.iter_mut().for_each(|b| b.radius_mm = one);
        }
        for i in 0..self.ovality_mm.len() {
            if !self.may_be_oval(i) {
                self.ovality_mm[i] = 0.0;
            }
        }
        self
    }

    /// The centre line.
    pub fn spine(&self) -> Spine {
        Spine::from_lra(&self.lra, self.start)
    }

    /// How flat the outer walls of all bends are: their values of [`Flattening`].
    pub fn flattenings_mm(&self) -> Vec<f64> {
        let walls = match &self.flattening {
            Flattening::Free { bends_mm, .. } => return bends_mm.clone(),
            Flattening::Known(walls) if walls.is_empty() => return vec![0.0; self.lra.bends.len()],
            Flattening::Known(walls) => walls,
        };
        let nearest = |(i, middle): (usize, &Point3<f64>)| {
            let away = |wall: &Wall| (wall.at - middle).norm_squared();
            let nearest = walls.iter().min_by(|a, b| away(a).total_cmp(&away(b)));
            nearest.filter(|_| self.may_be_oval(i)).map_or(0.0, |wall| wall.flat_mm)
        };
        self.middles().iter().enumerate().map(nearest).collect()
    }

    /// The middles of all bends.
    pub fn middles(&self) -> Vec<Point3<f64>> {
        let spine = self.spine();
        let arcs = spine.segments().iter().skip(1).step_by(2);
        arcs.map(|arc| arc.frame_at(0.5 * arc.length_mm).translation.vector.into()).collect()
    }

    /// How the parameters move the tube. The segments are the spine's: line, arc, ..., line.
    pub fn columns(&self, parameters: &[Parameter]) -> Vec<Column> {
        // In the start frame: its axes carry the pose parameters.
        let spine = Spine::from_lra(&self.lra, Frame::identity());
        let of = |(parameter, p): (usize, &Parameter)| {
            motions(p, &spine).into_iter().map(move |motion| Column { parameter, motion })
        };
        parameters.iter().enumerate().flat_map(of).collect()
    }

    /// The model after a step, brought back into what a tube can be (lengths >= 0, angles 0 to 355 degrees, bend
    /// radius no smaller than the tube's).
    pub fn stepped(&self, parameters: &[Parameter], step: &DVector<f64>) -> TubeModel {
        let mut out = self.moved(parameters, step);
        out.tube_radius_mm = out.tube_radius_mm.clamp(0.5 * self.tube_radius_mm, 2.0 * self.tube_radius_mm);
        let most_oval = MOST_OVAL * out.tube_radius_mm;
        out.ovality_mm.iter_mut().for_each(|e| *e = e.clamp(-most_oval, most_oval));
        if let Flattening::Free { bends_mm, .. } = &mut out.flattening {
            bends_mm.iter_mut().for_each(|g| *g = g.clamp(-most_oval, most_oval));
        }
        for b in &mut out.lra.bends {
            b.length_mm = b.length_mm.max(0.0);
            b.rotation_rad = wrap_angle(b.rotation_rad);
            b.angle_rad = b.angle_rad.clamp(0.0, 355.0_f64.to_radians());
            b.radius_mm = b.radius_mm.clamp(out.tube_radius_mm, 1e5);
        }
        out
    }

    /// The model after a step, wherever that leads.
    pub fn moved(&self, parameters: &[Parameter], step: &DVector<f64>) -> TubeModel {
        let mut out = self.clone();
        let mut pose = Vector6::zeros();
        for (p, &d) in parameters.iter().zip(step.iter()) {
            match *p {
                Parameter::Pose(k) => pose[k] = d,
                Parameter::Length(i) => out.lra.bends[i].length_mm += d,
                Parameter::Rotation(i) => out.lra.bends[i].rotation_rad += d,
                Parameter::Angle(i) => out.lra.bends[i].angle_rad += d,
                Parameter::BendRadius(i) => out.lra.bends[i].radius_mm += d,
                Parameter::CommonRadius => out.lra.bends.iter_mut().for_each(|b| b.radius_mm += d),
                Parameter::Ovality(i) => out.ovality_mm[i] += d,
                Parameter::Flattening(i) => {
                    if let Flattening::Free { bends_mm, .. } = &mut out.flattening {
                        bends_mm[i] += d;
                    }
                }
                Parameter::TubeRadius => out.tube_radius_mm += d,
            }
        }
        let shift = Translation3::new(pose[0], pose[1], pose[2]);
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(pose[3], pose[4], pose[5]));
        out.start = self.start * Frame::from_parts(shift, turn);
        out.start.rotation.renormalize();
        out
    }
}

/// What one parameter does.
fn motions(parameter: &Parameter, spine: &Spine) -> Vec<Motion> {
    let segments = spine.segments();
    let turn = |axis: Vector3<f64>, through: Point3<f64>| join(through.coords.cross(&axis), axis);
    let twist = |from, twist| vec![Motion::Twist { from, twist }];
    match *parameter {
        Parameter::Pose(k) => {
            let mut axis = Vector6::zeros();
            axis[k] = 1.0;
            twist(0, axis)
        }
        Parameter::Length(i) => {
            let tangent = segments[2 * i].start.rotation * Vector3::x();
            twist(2 * i + 1, join(tangent, Vector3::zeros()))
        }
        Parameter::Rotation(i) => {
            let line = &segments[2 * i];
            let through = line.start.translation.vector.into();
            twist(2 * i, turn(line.start.rotation * Vector3::x(), through))
        }
        Parameter::Angle(i) => {
            let arc = &segments[2 * i + 1];
            let centre = arc.centre().unwrap_or_else(|| arc.start.translation.vector.into());
            let behind = turn(arc.start.rotation * Vector3::z(), centre);
            let own = Motion::Own { segment: 2 * i + 1, row: OWN_ANGLE };
            vec![Motion::Twist { from: 2 * i + 2, twist: behind }, own]
        }
        Parameter::BendRadius(i) => bend_radius(spine, i).into(),
        Parameter::CommonRadius => (0..segments.len() / 2).flat_map(|i| bend_radius(spine, i)).collect(),
        Parameter::Ovality(i) => vec![Motion::Own { segment: 2 * i + 1, row: OVALITY }],
        Parameter::Flattening(i) => vec![Motion::Own { segment: 2 * i + 1, row: FLATTENING }],
        Parameter::TubeRadius => vec![Motion::Everywhere { row: TUBE_RADIUS }],
    }
}

/// A bend whose CLR grows by one at fixed start and angle: it changes by itself, and all that follows is shifted.
fn bend_radius(spine: &Spine, i: usize) -> [Motion; 2] {
    let arc = &spine.segments()[2 * i + 1];
    let angle = match arc.kind {
        SegmentKind::Arc { angle_rad, .. } => angle_rad,
        SegmentKind::Line => 0.0,
    };
    let shift = arc.start.rotation * Vector3::new(angle.sin(), 1.0 - angle.cos(), 0.0);
    [
        Motion::Own { segment: 2 * i + 1, row: OWN_RADIUS },
        Motion::Twist { from: 2 * i + 2, twist: join(shift, Vector3::zeros()) },
    ]
}

fn join(velocity: Vector3<f64>, angular: Vector3<f64>) -> Vector6<f64> {
    Vector6::new(velocity.x, velocity.y, velocity.z, angular.x, angular.y, angular.z)
}

/// The same twist seen from `frame`.
pub fn in_frame(twist: &Vector6<f64>, frame: &Frame) -> Vector6<f64> {
    let (velocity, angular) = (twist.fixed_rows::<3>(0).into_owned(), twist.fixed_rows::<3>(3).into_owned());
    let at_origin = velocity + angular.cross(&frame.translation.vector);
    join(frame.rotation.inverse() * at_origin, frame.rotation.inverse() * angular)
}
