//! What a bent tube really is, beside what it should be: no scan, no doubt. Its last end is the cut's matter and left out.

use crate::inspect::{self, PointDeviation};
use crate::tube::{Lra, MeasuredTube, Nominal};

/// How far one tube is off.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Truth {
    /// Largest error of an angle.
    pub angle_rad: f64,
    /// Median error of the distances between corners.
    pub median_length_mm: f64,
    /// Farthest check point, all of them.
    pub envelope_mm: f64,
    /// The same across the tube only.
    pub lateral_mm: f64,
}

impl Truth {
    /// Of a tube with as many bends as the part.
    pub fn of(tube: &Lra, nominal: &Nominal) -> Truth {
        let tube = trimmed(tube, &nominal.lra);
        let both = || tube.bends.iter().zip(&nominal.lra.bends);
        let angle_rad = both().map(|(t, n)| (t.angle_rad - n.angle_rad).abs()).fold(0.0, f64::max);
        let mut exact = MeasuredTube::exact(&tube, nominal.od_mm / 2.0);
        exact.reversed = Some(false);
        let corner = inspect::corners(&exact, &nominal.lra);
        let wanted = inspect::table_distances(&nominal.lra, &corner);
        let fed = inspect::distances(&exact, &corner).into_iter().zip(wanted).take(nominal.lra.bends.len());
        let mut lengths: Vec<f64> = fed.filter_map(|(d, w)| d.map(|d| (d.value - w).abs())).collect();
        lengths.sort_by(f64::total_cmp);
        // A tube without check points is another part altogether.
        let points = inspect::inspect(&exact, nominal).map_or(Vec::new(), |seen| seen.points);
        let lateral = |p: &PointDeviation| (p.deviation_mm.powi(2) - p.along_mm.powi(2)).max(0.0).sqrt();
        let none = if points.is_empty() { f64::INFINITY } else { 0.0 };
        Truth {
            angle_rad,
            median_length_mm: lengths.get(lengths.len() / 2).copied().unwrap_or(0.0),
            envelope_mm: points.iter().map(|p| p.deviation_mm).fold(none, f64::max),
            lateral_mm: points.iter().map(lateral).fold(none, f64::max),
        }
    }

    /// Whether the tube is good: every angle and every check point.
    pub fn is_good(&self, nominal: &Nominal) -> bool {
        self.angle_rad <= nominal.tolerance.angle_rad && self.envelope_mm <= nominal.tolerance.envelope_mm
    }
}

/// The tube with its last corner as far from its end as it should be.
fn trimmed(tube: &Lra, wanted: &Lra) -> Lra {
    let mut out = tube.clone();
    if let (Some(last), Some(want)) = (tube.bends.last(), wanted.bends.last())
        && last.angle_rad < MeasuredTube::INTERSECTION_LIMIT_RAD
    {
        let tangent = |radius_mm: f64, angle_rad: f64| radius_mm * (angle_rad / 2.0).tan();
        // As inspection lays a tube out: on the nominal's radius at the angle found.
        out.last_length_mm = wanted.last_length_mm + tangent(want.radius_mm, last.angle_rad)
            - tangent(last.radius_mm, last.angle_rad);
    } else {
        out.last_length_mm = wanted.last_length_mm;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Document, Materials, parse_part};

    #[test]
    fn a_tube_as_drawn_is_off_by_nothing_and_another_by_what_it_is() {
        let text = include_str!("../../../config/parts/bracket-17.toml");
        let nominal = parse_part(&Document::new("p.toml", text), &Materials::shipped().unwrap()).unwrap();
        let as_drawn = Truth::of(&nominal.lra, &nominal);
        assert!(as_drawn.angle_rad == 0.0 && as_drawn.envelope_mm < 1e-9 && as_drawn.is_good(&nominal));
        let mut tube = nominal.lra.clone();
        tube.last_length_mm += 5.0;
        assert!(Truth::of(&tube, &nominal).envelope_mm < 1e-9, "the last end is the cut's");
        tube.bends[1].length_mm += 0.6;
        let longer = Truth::of(&tube, &nominal);
        assert!((0.1..0.6).contains(&longer.envelope_mm) && longer.is_good(&nominal), "{longer:?}");
        assert!(longer.median_length_mm < 1e-9, "one of four");
        tube.bends[1].angle_rad += 0.51_f64.to_radians();
        let bent = Truth::of(&tube, &nominal);
        assert!((bent.angle_rad.to_degrees() - 0.51).abs() < 1e-9 && !bent.is_good(&nominal), "{bent:?}");
        assert!(bent.lateral_mm <= bent.envelope_mm && bent.lateral_mm > 0.1, "{bent:?}");
    }
}
