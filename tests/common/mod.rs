//! Shared by the tests of inspect and correct: a tube as a scan would report it.

use benderd::tube::{Bend, Lra, MeasuredBend, MeasuredTube};

/// A table as measured without error: lengths to 0.03 mm, radii to 0.08 mm, angles to `angle_sigma_deg`,
/// corner distances to 0.02 mm.
pub fn measured(lra: &Lra, angle_sigma_deg: f64) -> MeasuredTube {
    let sigma = angle_sigma_deg.to_radians();
    let bend = |(i, b): (usize, &Bend)| {
        let before = if i > 0 { lra.bends[i - 1].angle_rad } else { b.angle_rad };
        let sine = before.min(b.angle_rad).clamp(0.01, std::f64::consts::FRAC_PI_2).sin();
        MeasuredBend {
            length_mm: Some(b.length_mm),
            length_sigma_mm: Some(0.03),
            rotation_rad: Some(if i == 0 { 0.0 } else { b.rotation_rad }),
            rotation_sigma_rad: Some(if i == 0 { 0.0 } else { sigma / sine }),
            angle_rad: b.angle_rad,
            angle_sigma_rad: sigma,
            radius_mm: Some(b.radius_mm),
            radius_sigma_mm: Some(0.08),
            ovality: None,
            ovality_sigma: None,
            flattening: None,
            flattening_sigma: None,
        }
    };
    let intersection_mm = lra.intersection_distances_mm(MeasuredTube::INTERSECTION_LIMIT_RAD);
    MeasuredTube {
        points_total: 200_000,
        points_used: 190_000,
        residual_median_mm: 0.03,
        elapsed_ms: 200.0,
        last_length_sigma_mm: Some(0.03),
        bends: lra.bends.iter().enumerate().map(bend).collect(),
        intersection_sigma_mm: intersection_mm.iter().map(|d| d.map(|_| 0.02)).collect(),
        intersection_mm,
        ..MeasuredTube::exact(lra, 12.7)
    }
}
