//! Where the tube ends: the surface knows the end straights' axes but not their ends, the scanned extent does.

use nalgebra::Point3;

use super::radius::median;

/// An end along its straight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct End {
    /// Coordinate along the axis.
    pub at_mm: f64,
    /// Standard deviation from the spacing of the points.
    pub sigma_mm: f64,
}

/// Strips around the tube; each finds the end by itself.
const STRIPS: usize = 36;

/// Fewest points of a strip and fewest strips.
const MIN_POINTS: usize = 3;
const MIN_STRIPS: usize = 3;

/// The end of a tube that lies along +x from it: `points` of its surface in a frame whose x axis is the tube's.
/// Looks at the first `reach_mm` of the points. None when too little was scanned there.
pub fn find(points: &[Point3<f64>], reach_mm: f64) -> Option<End> {
    let mut along: Vec<f64> = points.iter().map(|p| p.x).collect();
    along.sort_by(f64::total_cmp);
    let first = solid_start(&along, reach_mm)?;
    let mut strips: Vec<Vec<f64>> = vec![Vec::new(); STRIPS];
    for p in points.iter().filter(|p| p.x >= first && p.x < first + reach_mm) {
        let turn = p.z.atan2(p.y) / std::f64::consts::TAU + 0.5;
        strips[((turn * STRIPS as f64) as usize).min(STRIPS - 1)].push(p.x);
    }
    let mut ends = Vec::new();
    let mut gaps = Vec::new();
    for strip in strips.iter_mut().filter(|s| s.len() >= MIN_POINTS) {
        strip.sort_by(f64::total_cmp);
        let gap = (strip[strip.len() - 1] - strip[0]) / (strip.len() - 1) as f64;
        // The end lies somewhere within one spacing before the first point.
        ends.push(strip[0] - 0.5 * gap);
        gaps.push(gap);
    }
    if ends.len() < MIN_STRIPS {
        return None;
    }
    let (at_mm, gap) = (median(&mut ends)?, median(&mut gaps)?);
    let mut off: Vec<f64> = ends.iter().map(|e| (e - at_mm).abs()).collect();
    let scatter = 1.4826 * median(&mut off)? / (ends.len() as f64).sqrt();
    Some(End { at_mm, sigma_mm: scatter.max(gap / 12f64.sqrt()) })
}

/// First coordinate from which on the points come as densely as usual: stray points before it do not count.
fn solid_start(sorted: &[f64], reach_mm: f64) -> Option<f64> {
    let last = *sorted.last()?;
    let window = 0.1 * reach_mm;
    let count_from = |i: usize| sorted[i..].iter().take_while(|x| **x < sorted[i] + window).count();
    let span = (last - sorted[0]).min(3.0 * reach_mm).max(window);
    let within = sorted.iter().take_while(|x| **x <= sorted[0] + span).count();
    let usual = within as f64 * window / span;
    (0..sorted.len()).find(|&i| count_from(i) as f64 >= 0.3 * usual).map(|i| sorted[i])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn half_tube(spacing: f64, from: f64) -> Vec<Point3<f64>> {
        let mut points = Vec::new();
        for i in 0..60 {
            for k in 0..20 {
                let turn = k as f64 * 0.12;
                points.push(Point3::new(from + i as f64 * spacing, 10.0 * turn.cos(), 10.0 * turn.sin()));
            }
        }
        points
    }

    #[test]
    fn within_half_a_spacing_and_says_so() {
        let end = find(&half_tube(1.0, 3.5), 20.0).unwrap();
        assert!((end.at_mm - 3.0).abs() < 1e-9);
        assert!((end.sigma_mm - 1.0 / 12f64.sqrt()).abs() < 1e-9);
    }

    #[test]
    fn stray_points_before_the_end_do_not_move_it() {
        let mut points = half_tube(1.0, 3.5);
        points.extend([-30.0, -12.0, -4.0].map(|x| Point3::new(x, 10.0, 0.1)));
        assert!((find(&points, 20.0).unwrap().at_mm - 3.0).abs() < 1e-9);
    }

    #[test]
    fn an_end_that_was_not_scanned_is_unknown() {
        assert_eq!(find(&[], 20.0), None);
        assert_eq!(find(&half_tube(1.0, 0.0)[..2], 20.0), None);
    }
}
