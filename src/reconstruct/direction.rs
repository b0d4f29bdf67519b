//! Which way the scanned tube is travelled: the nominal's, when there is one.

use nalgebra::{Point3, Vector3};

use super::Reconstruction;
use super::likeness::{self, measured_rows, rows, unlikeness};
use crate::tube::align::{Pair, register};
use crate::tube::{Frame, Nominal, Spine};

/// Places along the tube that are compared.
const PLACES: usize = 100;

/// A difference in unlikeness that decides nothing.
const UNDECIDED: f64 = 0.5;

/// The reconstruction in the direction in which it lies closer to the nominal.
pub fn as_nominal(found: Reconstruction, nominal: &Nominal) -> Reconstruction {
    let reversed = is_against(&found, nominal);
    let mut out = if reversed { turn_round(found) } else { found };
    out.measured.reversed = Some(reversed);
    out.measured.warnings.extend(doubts(&out, nominal));
    out
}

/// Whether the tube lies closer to the nominal when it is travelled the other way: bend by bend where it has as many,
/// so that a missing end piece does not matter; otherwise place by place.
fn is_against(found: &Reconstruction, nominal: &Nominal) -> bool {
    let part = nominal.lra.merged();
    if found.lra.bends.len() == part.bends.len() && !part.bends.is_empty() {
        let wanted = rows(&part);
        let radius_mm = found.measured.tube_radius_mm;
        let as_is = unlikeness(&measured_rows(&found.measured, &found.lra), &wanted, radius_mm);
        let turned = measured_rows(&found.measured.reversed(), &found.lra.reversed());
        let turned = unlikeness(&turned, &wanted, radius_mm);
        // Alike from both ends, the end straights decide.
        if (as_is - turned).abs() > UNDECIDED {
            return turned < as_is;
        }
    }
    let wanted = places(&Spine::from_lra(&part, Frame::identity()));
    let as_is = places(&found.spine);
    let turned: Vec<Point3<f64>> = as_is.iter().rev().copied().collect();
    distance(&turned, &wanted) < distance(&as_is, &wanted)
}

/// What speaks against this being the nominal's tube at all.
fn doubts(found: &Reconstruction, nominal: &Nominal) -> Vec<String> {
    let (radius, wanted) = (found.measured.tube_radius_mm, nominal.od_mm / 2.0);
    let mut out = Vec::new();
    if nominal.is_other_tube(radius) {
        out.push(format!(
            "tube radius {radius:.2} mm, the nominal's is {wanted} mm: is this the part, in this unit?"
        ));
    }
    let rows = measured_rows(&found.measured, &found.lra);
    out.extend(likeness::doubts(&rows, &nominal.lra.merged(), radius));
    out
}

fn places(spine: &Spine) -> Vec<Point3<f64>> {
    (0..=PLACES).map(|k| spine.point_at(spine.length_mm() * k as f64 / PLACES as f64)).collect()
}

fn distance(from: &[Point3<f64>], to: &[Point3<f64>]) -> f64 {
    let pairs: Vec<Pair> = from.iter().zip(to).map(|(&from, &to)| Pair { from, to, weight: 1.0 }).collect();
    register(&pairs).map_or(f64::INFINITY, |r| r.rms_mm)
}

fn turn_round(found: Reconstruction) -> Reconstruction {
    let end = found.spine.frame_at(found.spine.length_mm());
    // Looking back the tangent and the plane's normal change sign.
    let start = end * Frame::rotation(Vector3::new(0.0, std::f64::consts::PI, 0.0));
    let lra = found.lra.reversed();
    let turned = |bends: Vec<f64>| bends.into_iter().rev().collect();
    Reconstruction {
        measured: found.measured.reversed(),
        spine: Spine::from_lra(&lra, start),
        lra,
        ovality_mm: turned(found.ovality_mm),
        flattening_mm: turned(found.flattening_mm),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tube::{Bend, Lra, MeasuredTube};

    #[test]
    fn a_tube_scanned_from_its_other_end_is_turned_round() {
        let bend =
            |length_mm, rotation_rad, angle_rad| Bend { length_mm, rotation_rad, angle_rad, radius_mm: 30.0 };
        let nominal = Lra {
            bends: vec![bend(50.0, 0.0, 1.0), bend(80.0, 1.2, 2.0), bend(20.0, -0.4, 0.5)],
            last_length_mm: 120.0,
        };
        let lra = nominal.reversed();
        let start = Frame::new(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.1, 0.2, 0.3));
        let spine = Spine::from_lra(&lra, start);
        let measured = MeasuredTube::exact(&lra, 10.0);
        let found = Reconstruction {
            measured,
            spine: spine.clone(),
            lra,
            ovality_mm: vec![-0.1, -0.2, -0.3],
            flattening_mm: vec![-0.01, -0.02, -0.03],
        };
        let part = Nominal::of_table(nominal.clone(), 25.0, 1.0);
        let turned = as_nominal(found, &part);
        assert_eq!(turned.measured.warnings.len(), 1, "the bracket's radius is another: {turned:?}");
        assert_eq!(turned.measured.reversed, Some(true));
        assert_eq!(turned.lra, nominal);
        assert_eq!(turned.ovality_mm, [-0.3, -0.2, -0.1]);
        assert_eq!(turned.flattening_mm, [-0.03, -0.02, -0.01]);
        for k in 0..=20 {
            let at = turned.spine.length_mm() * k as f64 / 20.0;
            let same = spine.point_at(spine.length_mm() - at);
            assert!((turned.spine.point_at(at) - same).norm() < 1e-9);
        }
    }
}
