//! A scan without a cloud: the true tube with the errors of a good arm, and the sigmas that a reconstruction would give.

use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::tube::{Bend, Lra, MeasuredBend, MeasuredTube};

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// Errors of a scan, one sigma each.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scanner {
    /// Bend angles.
    pub angle_rad: f64,
    /// Direction of a straight; what a rotation is uncertain by follows from the shallower bend beside it.
    pub axis_rad: f64,
    /// Distances between corners.
    pub distance_mm: f64,
    /// Centre-line radii. Lengths beside a bend are off by what keeps the corners in place.
    pub radius_mm: f64,
}

impl Scanner {
    /// What a good arm and this reconstruction reach.
    pub fn good() -> Scanner {
        Scanner { angle_rad: 0.05 * DEGREE, axis_rad: 0.05 * DEGREE, distance_mm: 0.04, radius_mm: 0.3 }
    }

    /// One scan of a tube.
    pub fn scan(&self, tube: &Lra, tube_radius_mm: f64, rng: &mut ChaCha8Rng) -> MeasuredTube {
        let mut draw = |sigma: f64| -> f64 {
            let unit: f64 = StandardNormal.sample(rng);
            sigma * unit
        };
        let limit = MeasuredTube::INTERSECTION_LIMIT_RAD;
        let bends: Vec<MeasuredBend> = tube
            .bends
            .iter()
            .enumerate()
            .map(|(i, b)| {
                let turn_rad = self.turn_rad(tube, i);
                MeasuredBend {
                    length_mm: None,
                    length_sigma_mm: Some(self.distance_mm),
                    rotation_rad: Some(if i == 0 { 0.0 } else { b.rotation_rad + draw(turn_rad) }),
                    rotation_sigma_rad: Some(turn_rad),
                    angle_rad: (b.angle_rad + draw(self.angle_rad)).max(0.0),
                    angle_sigma_rad: self.angle_rad,
                    radius_mm: Some(b.radius_mm + draw(self.radius_mm)),
                    radius_sigma_mm: Some(self.radius_mm),
                    ovality: None,
                    ovality_sigma: None,
                    flattening: None,
                    flattening_sigma: None,
                }
            })
            .collect();
        let corner = |i: usize| tube.bends[i].angle_rad < limit;
        let true_mm = marks(&tube.bends, corner, |j| straight(tube, j));
        let seen: Vec<f64> = true_mm.iter().map(|mm| mm + draw(self.distance_mm)).collect();
        let found: Vec<Bend> = bends.iter().map(as_bend).collect();
        let tangents = marks(&found, corner, |_| 0.0);
        let n = bends.len();
        let known = |j: usize| [j.checked_sub(1), (j < n).then_some(j)].into_iter().flatten().all(corner);
        let mut out = MeasuredTube {
            points_total: 200_000,
            points_used: 190_000,
            residual_median_mm: 0.03,
            bends,
            intersection_mm: (0..=n).map(|j| known(j).then_some(seen[j])).collect(),
            intersection_sigma_mm: (0..=n).map(|j| known(j).then_some(self.distance_mm)).collect(),
            last_length_mm: Some(seen[n] - tangents[n]),
            last_length_sigma_mm: Some(self.distance_mm),
            ..MeasuredTube::exact(tube, tube_radius_mm)
        };
        for (j, bend) in out.bends.iter_mut().enumerate() {
            bend.length_mm = Some(seen[j] - tangents[j]);
        }
        out
    }

    /// What the rotation of a bend is uncertain by; nothing for the first, which has none.
    fn turn_rad(&self, tube: &Lra, i: usize) -> f64 {
        let Some(before) = i.checked_sub(1) else { return 0.0 };
        let shallower = tube.bends[before].angle_rad.min(tube.bends[i].angle_rad);
        self.axis_rad / shallower.clamp(0.01, std::f64::consts::FRAC_PI_2).sin()
    }
}

fn as_bend(bend: &MeasuredBend) -> Bend {
    Bend {
        length_mm: 0.0,
        rotation_rad: 0.0,
        angle_rad: bend.angle_rad,
        radius_mm: bend.radius_mm.unwrap_or(0.0),
    }
}

fn straight(tube: &Lra, j: usize) -> f64 {
    tube.bends.get(j).map_or(tube.last_length_mm, |b| b.length_mm)
}

/// Lengths from mark to mark: a bend's corner, or its tangent point where it has none.
fn marks(bends: &[Bend], corner: impl Fn(usize) -> bool, length_mm: impl Fn(usize) -> f64) -> Vec<f64> {
    let tangent = |i: usize| {
        if corner(i) { bends[i].radius_mm * (bends[i].angle_rad / 2.0).tan() } else { 0.0 }
    };
    let sides = |j: usize| [j.checked_sub(1), (j < bends.len()).then_some(j)].into_iter().flatten();
    (0..=bends.len()).map(|j| length_mm(j) + sides(j).map(tangent).sum::<f64>()).collect()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    /// Errors over their sigmas are of size 1; lengths are off by what keeps the corners in place.
    #[test]
    fn errors_are_as_large_as_they_are_said_to_be() {
        let bend = |length_mm, angle: f64| Bend {
            length_mm,
            rotation_rad: 0.5,
            angle_rad: angle.to_radians(),
            radius_mm: 50.0,
        };
        let tube =
            Lra { bends: vec![bend(100.0, 90.0), bend(80.0, 20.0), bend(60.0, 120.0)], last_length_mm: 70.0 };
        let corners = tube.intersection_distances_mm(MeasuredTube::INTERSECTION_LIMIT_RAD);
        let (scanner, mut rng) = (Scanner::good(), ChaCha8Rng::seed_from_u64(1));
        let (mut angle, mut turn, mut distance, mut length) = (0.0, 0.0, 0.0, 0.0);
        const SCANS: u32 = 2000;
        for _ in 0..SCANS {
            let seen = scanner.scan(&tube, 12.7, &mut rng);
            let b = &seen.bends[1];
            angle += ((b.angle_rad - tube.bends[1].angle_rad) / b.angle_sigma_rad).powi(2);
            turn += ((b.rotation_rad.unwrap() - 0.5) / b.rotation_sigma_rad.unwrap()).powi(2);
            distance += ((seen.intersection_mm[1].unwrap() - corners[1].unwrap()) / 0.04).powi(2);
            length += (b.length_mm.unwrap() - 80.0).powi(2);
            let tangent = |i: usize| seen.bends[i].radius_mm.unwrap() * (seen.bends[i].angle_rad / 2.0).tan();
            let by_length = b.length_mm.unwrap() + tangent(0) + tangent(1);
            assert!((by_length - seen.intersection_mm[1].unwrap()).abs() < 1e-9);
        }
        for (what, sum) in [("angle", angle), ("turn", turn), ("distance", distance)] {
            let size = (sum / f64::from(SCANS)).sqrt();
            assert!((0.95..1.05).contains(&size), "{what}: {size}");
        }
        assert!((length / f64::from(SCANS)).sqrt() > 0.2, "CLRs are off by 0.3 mm, and lengths with them");
    }
}
