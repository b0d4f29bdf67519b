//! Where the nominal's bends lie along the spine's polygon, without any initial pose: a shortest path over the places at
//! which the polygon turns as the bends do, in their order, as far apart, in such planes. Formed angles and lengths may
//! be off and pieces of the ends missing. Under [`guided`](super::guided), which fits the tube laid out here.

use nalgebra::{Matrix3, Point3, Rotation3, Unit, UnitQuaternion, Vector3};

use super::model::TubeModel;
use crate::tube::align::{Pair, register};
use crate::tube::{Bend, Frame, Lra, Spine, any_normal, wrap_angle};

/// Distance of the places looked at and half the chord that gives a direction there, in tube radii.
const STEP_RADII: f64 = 0.5;
const CHORD_RADII: f64 = 0.75;

/// Bends below this leave no clear trace in the polygon: they are placed between their neighbours.
pub const SHALLOW_RAD: f64 = 8.0 * DEGREE;
const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// How far a turn, its balance before and after the middle, and a plane are usually off; and the worst of each, in
/// these units, squared.
const TURN_RAD: f64 = 5.0 * DEGREE;
const BALANCE_RAD: f64 = 10.0 * DEGREE;
const PLANE_RAD: f64 = 8.0 * DEGREE;
const MOST_TURN: f64 = 16.0;
const MOST_PLANE: f64 = 16.0;

/// How far the distance of two bends is usually off: in tube radii, as a share, and per CLR (an angle that is off takes
/// arc away); and the worst.
const APART_RADII: f64 = 0.7;
const APART_SHARE: f64 = 0.02;
const APART_CLR: f64 = 0.1;
const MOST_APART: f64 = 9.0;

/// An end piece may be missing; this is the most that it costs.
const END_SHARE: f64 = 0.05;
const MOST_END: f64 = 2.0;

/// From this angle on a bend's plane and turn come from its middle too.
const WIDE_RAD: f64 = 150.0 * DEGREE;

/// The polygon by arc length.
pub struct Course {
    points: Vec<Point3<f64>>,
    at_mm: Vec<f64>,
    step_mm: f64,
    radius_mm: f64,
    tangents: Vec<Vector3<f64>>,
}

impl Course {
    /// Of two vertices at least.
    pub fn new(polygon: &[Point3<f64>], radius_mm: f64) -> Option<Course> {
        let mut at_mm = vec![0.0];
        for pair in polygon.windows(2) {
            at_mm.push(at_mm[at_mm.len() - 1] + (pair[1] - pair[0]).norm());
        }
        let step_mm = STEP_RADII * radius_mm;
        let mut course = Course { points: polygon.to_vec(), at_mm, step_mm, radius_mm, tangents: Vec::new() };
        let count = (course.length_mm() / step_mm) as usize + 1;
        if polygon.len() < 2 || count < 2 {
            return None;
        }
        let half = CHORD_RADII * radius_mm;
        course.tangents =
            (0..count).map(|k| course.chord(k as f64 * step_mm - half, k as f64 * step_mm + half)).collect();
        Some(course)
    }

    /// Its length.
    pub fn length_mm(&self) -> f64 {
        self.at_mm[self.at_mm.len() - 1]
    }

    fn point_at(&self, at_mm: f64) -> Point3<f64> {
        let at = at_mm.clamp(0.0, self.length_mm());
        let k = self.at_mm.partition_point(|a| *a <= at).clamp(1, self.points.len() - 1);
        let share = (at - self.at_mm[k - 1]) / (self.at_mm[k] - self.at_mm[k - 1]).max(1e-12);
        self.points[k - 1] + (self.points[k] - self.points[k - 1]) * share
    }

    /// Direction from one place to another.
    fn chord(&self, from_mm: f64, to_mm: f64) -> Vector3<f64> {
        (self.point_at(to_mm) - self.point_at(from_mm)).try_normalize(1e-9).unwrap_or(Vector3::x())
    }

    fn tangent(&self, at_mm: f64) -> Vector3<f64> {
        let k = (at_mm / self.step_mm).round().clamp(0.0, (self.tangents.len() - 1) as f64);
        self.tangents[k as usize]
    }

    /// Direction of a straight that should lie between two places; from its surroundings where it is short.
    fn straight(&self, from_mm: f64, to_mm: f64) -> Vector3<f64> {
        let half = (0.5 * (to_mm - from_mm)).max(0.5 * self.radius_mm);
        let middle =
            (0.5 * (from_mm + to_mm)).clamp(0.5 * self.radius_mm, self.length_mm() - 0.5 * self.radius_mm);
        self.chord(middle - half, middle + half)
    }
}

/// A place at which the polygon turns about as a bend does.
#[derive(Debug, Clone, Copy)]
struct Turn {
    at_mm: f64,
    before: Vector3<f64>,
    after: Vector3<f64>,
    normal: Vector3<f64>,
    cost: f64,
}

/// A clear bend of the part.
struct Clear {
    index: usize,
    middle_mm: f64,
    /// Rotation since the clear bend before.
    rotation_rad: f64,
    bend: Bend,
    /// Straights before and after.
    beside_mm: [f64; 2],
}

/// The middles of all bends along the part.
fn middles_mm(part: &Lra) -> Vec<f64> {
    let mut at = 0.0;
    let middle = |b: &Bend| {
        let arc = b.radius_mm * b.angle_rad;
        at += b.length_mm + arc;
        at - 0.5 * arc
    };
    part.bends.iter().map(middle).collect()
}

fn clear_bends(part: &Lra, middles_mm: &[f64]) -> Vec<Clear> {
    let mut rotation = 0.0;
    let mut out = Vec::new();
    for (index, bend) in part.bends.iter().enumerate() {
        rotation += bend.rotation_rad;
        if bend.angle_rad >= SHALLOW_RAD {
            let after = part.bends.get(index + 1).map_or(part.last_length_mm, |b| b.length_mm);
            let (middle_mm, beside_mm) = (middles_mm[index], [bend.length_mm, after]);
            out.push(Clear { index, middle_mm, rotation_rad: rotation, bend: *bend, beside_mm });
            rotation = 0.0;
        }
    }
    out
}

/// All places at which the polygon turns about as the bend does.
fn turns(course: &Course, clear: &Clear) -> Vec<Turn> {
    let half = 0.5 * clear.bend.radius_mm * clear.bend.angle_rad;
    let [before_mm, after_mm] = clear.beside_mm.map(|b| half + (0.5 * b).min(CHORD_RADII * course.radius_mm));
    let at = |k: usize| {
        let at_mm = k as f64 * course.step_mm;
        let (before, middle) = (course.tangent(at_mm - before_mm), course.tangents[k]);
        let after = course.tangent(at_mm + after_mm);
        let (first, second) = (before.angle(&middle), middle.angle(&after));
        let off = (first + second - clear.bend.angle_rad) / TURN_RAD;
        let balance = first - second;
        let cost = off * off + (balance / BALANCE_RAD).powi(2);
        if off * off > MOST_TURN || cost > 2.0 * MOST_TURN {
            return None;
        }
        let normal = (before.cross(&middle) + middle.cross(&after)).try_normalize(1e-9)?;
        let at_mm = at_mm - 0.5 * balance * clear.bend.radius_mm;
        Some(Turn { at_mm, before, after, normal, cost })
    };
    (0..course.tangents.len()).filter_map(at).collect()
}

/// What it costs that one bend lies here and the next there; None when it cannot be.
fn between(radius_mm: f64, one: (&Clear, &Turn), next: (&Clear, &Turn)) -> Option<f64> {
    let wanted = next.0.middle_mm - one.0.middle_mm;
    let clr = one.0.bend.radius_mm + next.0.bend.radius_mm;
    let usual = APART_RADII * radius_mm + APART_SHARE * wanted + APART_CLR * clr;
    let apart = ((next.1.at_mm - one.1.at_mm - wanted) / usual).powi(2);
    if apart > MOST_APART {
        return None;
    }
    let about = (one.1.after + next.1.before).try_normalize(1e-9)?;
    let turned = one.1.normal.cross(&next.1.normal).dot(&about).atan2(one.1.normal.dot(&next.1.normal));
    let off = wrap_angle(turned - next.0.rotation_rad);
    // A small turn knows its plane less well.
    let known = one.0.bend.angle_rad.min(next.0.bend.angle_rad).min(1.0);
    Some(apart + (off * known / PLANE_RAD).powi(2).min(MOST_PLANE))
}

/// Cost of the distance to an end of the tube.
fn end(course: &Course, found_mm: f64, wanted_mm: f64) -> f64 {
    let usual = 2.0 * course.radius_mm + END_SHARE * course.length_mm();
    ((found_mm - wanted_mm) / usual).powi(2).min(MOST_END)
}

/// Where the middles of the part's bends lie on the polygon; None when they cannot lie there in this order.
fn places_mm(course: &Course, part: &Lra) -> Option<Vec<f64>> {
    let middles = middles_mm(part);
    let clear = clear_bends(part, &middles);
    let (length, wanted) = (course.length_mm(), part.developed_length_mm());
    if clear.is_empty() {
        let shift = 0.5 * (length - wanted);
        return Some(middles.iter().map(|m| m + shift).collect());
    }
    let found: Vec<Vec<Turn>> = clear.iter().map(|c| turns(course, c)).collect();
    // Best cost of every place and the place before it.
    let first = found[0].iter().map(|t| (t.cost + end(course, t.at_mm, clear[0].middle_mm), 0));
    let mut best: Vec<Vec<(f64, usize)>> = vec![first.collect()];
    for k in 1..clear.len() {
        let reach = |turn: &Turn| {
            let ways =
                found[k - 1].iter().zip(&best[k - 1]).enumerate().filter(|(_, (_, b))| b.0.is_finite());
            let costs = ways.filter_map(|(j, (t, b))| {
                Some((b.0 + between(course.radius_mm, (&clear[k - 1], t), (&clear[k], turn))?, j))
            });
            let (cost, j) = costs.min_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((f64::INFINITY, 0));
            (cost + turn.cost, j)
        };
        best.push(found[k].iter().map(reach).collect());
    }
    let last = clear.len() - 1;
    let tail = wanted - clear[last].middle_mm;
    let ends = found[last].iter().zip(&best[last]).enumerate();
    let costs = ends.map(|(j, (t, b))| (b.0 + end(course, length - t.at_mm, tail), j));
    let (cost, mut j) = costs.min_by(|a, b| a.0.total_cmp(&b.0))?;
    if !cost.is_finite() {
        return None;
    }
    let mut known = vec![0.0; clear.len()];
    for k in (0..clear.len()).rev() {
        known[k] = found[k][j].at_mm;
        j = best[k][j].1;
    }
    Some(filled(&middles, &clear, &known))
}

/// Places of all bends from those of the clear ones.
fn filled(middles_mm: &[f64], clear: &[Clear], known_mm: &[f64]) -> Vec<f64> {
    let place = |(i, middle): (usize, &f64)| {
        let k = clear.partition_point(|c| c.index <= i);
        match (k.checked_sub(1), clear.get(k)) {
            (Some(a), Some(next)) => {
                let span = (next.middle_mm - clear[a].middle_mm).max(1e-9);
                let share = (middle - clear[a].middle_mm) / span;
                known_mm[a] + share * (known_mm[k] - known_mm[a])
            }
            (Some(a), None) => known_mm[a] + middle - clear[a].middle_mm,
            (None, Some(next)) => known_mm[k] + middle - next.middle_mm,
            (None, None) => *middle,
        }
    };
    middles_mm.iter().enumerate().map(place).collect()
}

/// The part laid onto the polygon in the polygon's direction, with the angles and planes that the polygon shows.
pub fn lay(course: &Course, part: &Lra) -> Option<TubeModel> {
    let places = places_mm(course, part)?;
    let n = part.bends.len();
    let half = |b: &Bend| 0.5 * b.radius_mm * b.angle_rad;
    let directions: Vec<Vector3<f64>> = (0..=n)
        .map(|k| {
            let from = if k == 0 { 0.0 } else { places[k - 1] + half(&part.bends[k - 1]) };
            let to = if k == n { course.length_mm() } else { places[k] - half(&part.bends[k]) };
            course.straight(from, to)
        })
        .collect();
    let mut axes = first_axes(part, &directions);
    let mut lra = Lra::default();
    let mut reached = 0.0;
    for (i, bend) in part.bends.iter().enumerate() {
        let (x, z) = (axes * Vector3::x(), axes * Vector3::z());
        let (mut roll, mut angle_rad) = (if i == 0 { 0.0 } else { bend.rotation_rad }, bend.angle_rad);
        if bend.angle_rad >= SHALLOW_RAD {
            let middle = course.tangent(places[i]);
            let after = directions[i + 1];
            let wide = bend.angle_rad >= WIDE_RAD;
            let normal = if wide { x.cross(&middle) + middle.cross(&after) } else { x.cross(&after) };
            angle_rad = if wide { x.angle(&middle) + middle.angle(&after) } else { x.angle(&after) };
            roll = z.cross(&normal).dot(&x).atan2(z.dot(&normal));
        }
        let turn =
            |axis: Vector3<f64>, angle| UnitQuaternion::from_axis_angle(&Unit::new_normalize(axis), angle);
        axes = axes * turn(Vector3::x(), roll) * turn(Vector3::z(), angle_rad);
        let half = 0.5 * bend.radius_mm * angle_rad;
        let length_mm = (places[i] - half - reached).max(0.0);
        reached = places[i] + half;
        lra.bends.push(Bend {
            length_mm,
            rotation_rad: wrap_angle(roll),
            angle_rad,
            radius_mm: bend.radius_mm,
        });
    }
    lra.last_length_mm = (course.length_mm() - reached).max(0.0);
    let start = pose(course, &mut lra)?;
    Some(TubeModel::round(start, lra, course.radius_mm))
}

/// Axes along the first straight, z normal to the first bend: by the first clear bend and the part's rotations up to it.
fn first_axes(part: &Lra, directions: &[Vector3<f64>]) -> UnitQuaternion<f64> {
    let x = directions[0];
    let clear = part.bends.iter().position(|b| b.angle_rad >= SHALLOW_RAD);
    let normal = clear.and_then(|m| {
        let normal = directions[m].cross(&directions[m + 1]).try_normalize(1e-6)?;
        let rotation: f64 = part.bends[1..=m].iter().map(|b| b.rotation_rad).sum();
        Some(UnitQuaternion::from_axis_angle(&Unit::new_normalize(x), -rotation) * normal)
    });
    let z = normal.unwrap_or_else(|| any_normal(&x));
    let y = z.cross(&x).try_normalize(1e-6).unwrap_or_else(|| any_normal(&x));
    let axes = Matrix3::from_columns(&[x, y, x.cross(&y)]);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes))
}

/// The pose that lays the table onto the polygon, place by place. The first rotation goes into it.
fn pose(course: &Course, lra: &mut Lra) -> Option<Frame> {
    let spine = Spine::from_lra(lra, Frame::identity());
    let pairs: Vec<Pair> = (0..course.tangents.len())
        .map(|k| {
            let at = k as f64 * course.step_mm;
            Pair { from: spine.point_at(at), to: course.point_at(at), weight: 1.0 }
        })
        .collect();
    let motion = register(&pairs)?.motion;
    let first = lra.bends.first_mut()?;
    let roll = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), first.rotation_rad);
    first.rotation_rad = 0.0;
    Some(motion * roll)
}
