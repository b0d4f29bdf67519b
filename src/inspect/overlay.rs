//! A tube whose values are all known (a predicted one) laid over the nominal: how far its check points are off, and how each value
//! moves them.
//!
//! A length moves what lies behind it along its straight, a turn about the straight, an angle about the bend's centre. The
//! alignment takes back what is one motion of the whole: of the weighted points' movements the nearest rigid one (linear in its
//! shift and turn) is taken out. Exact where the tube lies on the nominal, near it elsewhere.

use nalgebra::{DMatrix, Matrix3, Point3, Vector3};

use super::deviation::{Place, aligned, weights};
use super::laid::points_of;
use crate::tube::{Alignment, Frame, Lra, Spine};

/// A tube laid over the nominal by a named alignment.
#[derive(Debug, Clone)]
pub struct Overlay {
    /// From the nominal's check points to the tube's: start, middle and end of each straight in feed order.
    pub off_mm: Vec<Vector3<f64>>,
    points: Vec<Point3<f64>>,
    weights: Vec<f64>,
    spine: Spine,
}

/// Straight, counted from 1, and place on it of the check point at an index of [`Overlay::off_mm`].
pub fn check_point(index: usize) -> (usize, Place) {
    (index / 3 + 1, [Place::Start, Place::Middle, Place::End][index % 3])
}

impl Overlay {
    /// Lays a tube of as many bends over the nominal; None where no motion does (values that are no numbers).
    pub fn new(tube: &Lra, nominal: &Lra, alignment: Alignment) -> Option<Overlay> {
        let wanted = points_of(nominal);
        let weights = weights(&vec![[true; 3]; wanted.len()], &wanted, alignment);
        let spine = Spine::from_lra(tube, Frame::identity());
        let points = spine.straights().iter().map(|s| [s.start, s.middle, s.end]).collect();
        let laid = aligned(points, &wanted, &weights)?;
        let points: Vec<Point3<f64>> = laid.points.into_flattened();
        Some(Overlay {
            off_mm: points.iter().zip(wanted.iter().flatten()).map(|(p, w)| p - w).collect(),
            points,
            weights: weights.into_flattened(),
            spine: spine.moved(&laid.motion),
        })
    }

    /// Movements of the check points, three rows each, per millimetre or radian of each value: the columns are length,
    /// rotation and angle of the first bend, then of the next.
    pub fn moves(&self) -> DMatrix<f64> {
        let bends = self.spine.segments().len() / 2;
        let mut out = DMatrix::zeros(3 * self.points.len(), 3 * bends);
        let absorbed = Absorbed::new(self);
        for i in 0..bends {
            let (straight, arc) = (&self.spine.segments()[2 * i], &self.spine.segments()[2 * i + 1]);
            let (along, axis) = (straight.start * Vector3::x(), arc.start * Vector3::z());
            let (begin, centre) =
                (straight.start.translation.vector, arc.centre().unwrap_or_default().coords);
            // Of its own straight a length moves the middle by half, a turn and an angle nothing.
            let own = [0.0, 0.5, 1.0];
            let mut column = |kind: usize, of: &dyn Fn(usize, &Vector3<f64>) -> Vector3<f64>| {
                let moved = self.points.iter().enumerate().map(|(k, p)| match k / 3 {
                    j if j < i => Vector3::zeros(),
                    j if j == i && kind > 0 => Vector3::zeros(),
                    _ => of(k, &p.coords),
                });
                let moved = absorbed.without(self, moved.collect());
                for (k, m) in moved.iter().enumerate() {
                    out.fixed_view_mut::<3, 1>(3 * k, 3 * i + kind).copy_from(m);
                }
            };
            column(0, &|k, _| if k / 3 == i { along * own[k % 3] } else { along });
            column(1, &|_, p| along.cross(&(p - begin)));
            column(2, &|_, p| axis.cross(&(p - centre)));
        }
        out
    }
}

/// What an alignment takes back.
struct Absorbed {
    total: f64,
    centre: Vector3<f64>,
    /// From the points' moment to the turn.
    turn: Matrix3<f64>,
}

impl Absorbed {
    fn new(overlay: &Overlay) -> Absorbed {
        let weighted = || overlay.points.iter().zip(&overlay.weights);
        let total: f64 = overlay.weights.iter().sum();
        let centre = weighted().map(|(p, w)| p.coords * *w).sum::<Vector3<f64>>() / total;
        let inertia: Matrix3<f64> = weighted()
            .map(|(p, w)| (p.coords - centre, *w))
            .map(|(q, w)| (Matrix3::identity() * q.norm_squared() - q * q.transpose()) * w)
            .sum();
        // Points on one line leave the turn about it open: it is not made.
        let turn = inertia.pseudo_inverse(1e-13 * inertia.trace()).unwrap_or_else(|_| Matrix3::zeros());
        Absorbed { total, centre, turn }
    }

    fn without(&self, overlay: &Overlay, moved: Vec<Vector3<f64>>) -> Vec<Vector3<f64>> {
        let (mut shift, mut moment) = (Vector3::zeros(), Vector3::zeros());
        for ((m, p), w) in moved.iter().zip(&overlay.points).zip(&overlay.weights) {
            shift += m * *w;
            moment += (p.coords - self.centre).cross(m) * *w;
        }
        shift /= self.total;
        let turn = self.turn * moment;
        let rest = |(m, p): (&Vector3<f64>, &Point3<f64>)| m - shift - turn.cross(&(p.coords - self.centre));
        moved.iter().zip(&overlay.points).map(rest).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tube::Bend;

    const ALL: [Alignment; 5] =
        [Alignment::BestFit, Alignment::AEnd, Alignment::BEnd, Alignment::Weighted, Alignment::Fixture];

    fn tube() -> Lra {
        let bend = |length_mm, rotation: f64, angle: f64| Bend {
            length_mm,
            rotation_rad: rotation.to_radians(),
            angle_rad: angle.to_radians(),
            radius_mm: 50.8,
        };
        let bends = vec![
            bend(120.0, 0.0, 90.0),
            bend(150.0, 90.0, 45.0),
            bend(80.0, -60.0, 170.0),
            bend(140.0, 180.0, 30.0),
        ];
        Lra { bends, last_length_mm: 300.0 }
    }

    /// Moves one value: column as in `moves`.
    fn moved(lra: &Lra, column: usize, by: f64) -> Lra {
        let mut out = lra.clone();
        let bend = &mut out.bends[column / 3];
        *[&mut bend.length_mm, &mut bend.rotation_rad, &mut bend.angle_rad][column % 3] += by;
        out
    }

    #[test]
    fn movements_are_those_of_tubes_laid_over_anew() {
        let nominal = tube();
        for alignment in ALL {
            let moves = Overlay::new(&nominal, &nominal, alignment).unwrap().moves();
            for column in 0..3 * nominal.bends.len() {
                let step = if column % 3 == 0 { 0.1 } else { 1e-3 };
                let off =
                    |by| Overlay::new(&moved(&nominal, column, by), &nominal, alignment).unwrap().off_mm;
                for (k, (more, less)) in off(step).iter().zip(off(-step)).enumerate() {
                    let found = (more - less) / (2.0 * step);
                    let said = moves.fixed_view::<3, 1>(3 * k, column);
                    assert!(
                        (found - said).norm() < 3e-3 * (1.0 + found.norm()),
                        "{alignment:?}, column {column}, point {k}: {found} {said}"
                    );
                }
            }
        }
    }

    #[test]
    fn the_nominal_lies_on_itself() {
        for alignment in ALL {
            let overlay = Overlay::new(&tube(), &tube(), alignment).unwrap();
            assert!(overlay.off_mm.len() == 15 && overlay.off_mm.iter().all(|d| d.norm() < 1e-6));
        }
        assert_eq!((check_point(0), check_point(14)), ((1, Place::Start), (5, Place::End)));
    }
}
