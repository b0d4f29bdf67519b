//! Where on the tube's surface the scanned points lie: along it, around it, and how far off.

use std::f64::consts::TAU;

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use super::Scale;
use crate::cloud::PointCloud;
use crate::reconstruct::Reconstruction;
use crate::tube::{Frame, Segment, Spine};

/// A scanned point on the tube.
#[derive(Debug, Clone, Copy)]
pub struct Spot {
    /// Where it is.
    pub point: Point3<f64>,
    /// Away from the centre line, length 1.
    pub outward: Vector3<f64>,
    /// Segment of the spine.
    pub segment: usize,
    /// Arc length from the spine's start.
    pub along_mm: f64,
    /// Angle around the tube in [-pi, pi), carried along it without twist; 0 is the inner side of the first bend, and seen in
    /// the direction of travel it grows clockwise.
    pub around_rad: f64,
    /// Signed distance from the fitted surface (its bends as oval as they were found), positive outside.
    pub deviation_mm: f64,
    /// Signed distance from a round tube of the same radius and centre line.
    pub from_round_mm: f64,
}

/// The scan as pictures need it: not more points than a picture can show.
pub struct Surface {
    /// Points on the tube.
    pub spots: Vec<Spot>,
    /// Points of the surroundings.
    pub others: Vec<Point3<f64>>,
    /// Per segment: how far its frame is turned against the one carried along without twist.
    pub turns_rad: Vec<f64>,
}

impl Surface {
    /// Looks at `most` points at most; `residuals_mm`: the deviations of all.
    pub fn of(
        found: &Reconstruction,
        cloud: &PointCloud,
        residuals_mm: &[f64],
        scale: &Scale,
        most: usize,
    ) -> Surface {
        let turns_rad = turns(&found.spine);
        let (near, far): (Vec<usize>, Vec<usize>) =
            thin(cloud.len(), most).partition(|&i| residuals_mm[i].abs() <= scale.near_mm);
        let radius_mm = found.measured.tube_radius_mm;
        let spot = |&i: &usize| Spot {
            deviation_mm: residuals_mm[i],
            ..Spot::of(&found.spine, &turns_rad, radius_mm, cloud.point(i))
        };
        let spots = near.par_iter().map(spot).collect();
        Surface { spots, others: far.into_iter().map(|i| cloud.point(i)).collect(), turns_rad }
    }
}

/// Some of `n` indices, spread evenly but not regularly: scan lines of equal length must not make stripes.
pub fn thin(n: usize, most: usize) -> impl Iterator<Item = usize> {
    let kept = n.min(most);
    let step = n as f64 / kept.max(1) as f64;
    // Multiples of the golden ratio fill the unit interval evenly.
    let shift = |k: usize| (k as f64 * 0.618_033_988_749_894_9).fract();
    (0..kept).map(move |k| if kept == n { k } else { (((k as f64 + shift(k)) * step) as usize).min(n - 1) })
}

/// Angle around the tube brought into [-pi, pi).
pub fn wrapped(rad: f64) -> f64 {
    (rad + TAU / 2.0).rem_euclid(TAU) - TAU / 2.0
}

fn turns(spine: &Spine) -> Vec<f64> {
    let mut turn = 0.0;
    let mut end: Option<Frame> = None;
    let mut at = |segment: &Segment| {
        if let Some(end) = end {
            let y = end.inverse() * segment.start * Vector3::y();
            turn += y.z.atan2(y.y);
        }
        end = Some(segment.frame_at(segment.length_mm));
        turn
    };
    spine.segments().iter().map(&mut at).collect()
}

impl Spot {
    /// As if the fitted surface were round.
    fn of(spine: &Spine, turns_rad: &[f64], radius_mm: f64, point: Point3<f64>) -> Spot {
        let foot = spine.closest(&point);
        let segment = &spine.segments()[foot.segment];
        let frame = segment.frame_at(foot.arc_length_mm - segment.start_mm);
        let local = frame.inverse_transform_point(&point).coords;
        let from_round_mm = foot.distance_mm - radius_mm;
        Spot {
            point,
            outward: (point - foot.point).try_normalize(0.0).unwrap_or_default(),
            segment: foot.segment,
            along_mm: foot.arc_length_mm,
            around_rad: wrapped(local.z.atan2(local.y) + turns_rad[foot.segment]),
            deviation_mm: from_round_mm,
            from_round_mm,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;
    use crate::tube::{Bend, Lra};

    #[test]
    fn a_line_along_the_tube_stays_at_its_angle() {
        // Two bends, the second plane turned by a right angle: what is carried along does not turn with it.
        let bend =
            |rotation_rad| Bend { length_mm: 40.0, rotation_rad, angle_rad: FRAC_PI_2, radius_mm: 30.0 };
        let lra = Lra { bends: vec![bend(0.0), bend(FRAC_PI_2)], last_length_mm: 40.0 };
        let spine = Spine::from_lra(&lra, Frame::identity());
        let turns = turns(&spine);
        let expected = [0.0, 0.0, FRAC_PI_2, FRAC_PI_2, FRAC_PI_2];
        assert!(turns.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9), "{turns:?}");
        // The inner side of the second bend lies a quarter round from that of the first.
        let arc = &spine.segments()[3];
        let inner = arc.frame_at(10.0) * Point3::new(0.0, 5.0, 0.0);
        let spot = Spot::of(&spine, &turns, 6.0, inner);
        assert_eq!(spot.segment, 3);
        assert!((spot.from_round_mm + 1.0).abs() < 1e-9, "a millimetre inside");
        assert!(
            (spot.around_rad - FRAC_PI_2).abs() < 1e-9 && (spot.along_mm - arc.start_mm - 10.0).abs() < 1e-9
        );
    }

    #[test]
    fn thinning_takes_each_point_once() {
        for (n, most) in [(0, 5), (5, 5), (7, 100), (1000, 300), (1000, 999)] {
            let kept: Vec<usize> = thin(n, most).collect();
            assert_eq!(kept.len(), n.min(most));
            assert!(kept.windows(2).all(|w| w[0] <= w[1]) && kept.iter().all(|i| *i < n));
        }
    }
}
