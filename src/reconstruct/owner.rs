//! Which points of the scan are the tube's: those near its centre line that no planar face explains better.
//!
//! Where a face touches the tube its points and the tube's are told apart by the tube's own surface, once that is known:
//! a point is the face's only when it lies on the face and clearly off the tube.

use nalgebra::Point3;
use rayon::prelude::*;

use super::mls::SPINE_SPACING_RADII;
use crate::cloud::PointCloud;
use crate::recognize::Face;

/// Points farther from the centre line than this many tube radii are not the tube's.
const REACH_RADII: f64 = 1.5;

/// Within this share of the radius of its surface a point may be the tube's, whatever else it lies on: the
/// polygon is about as far from the true centre line.
const SURFACE_SHARE: f64 = 0.06;

/// Cells of the grid at most, and their size in tube radii at least.
const MOST_CELLS: f64 = 1.0e6;
const CELL_RADII: f64 = 0.5;

/// No place of the centre line is near.
const NOWHERE: u32 = u32::MAX;

/// The space around a centre line, in cells that know their nearest place of it.
#[derive(Debug, Clone)]
pub struct Surroundings {
    radius_mm: f64,
    /// The centre line in steps of about half a cell, drawn out a radius at both ends.
    places: Vec<Point3<f64>>,
    /// Those of the centre line itself.
    own_places: std::ops::Range<usize>,
    low: Point3<f64>,
    cell_mm: f64,
    size: [usize; 3],
    nearest: Vec<u32>,
    /// Places to either side of a cell's own that may be nearer to a point in it.
    window: usize,
}

impl Surroundings {
    /// Around a polygon of at least two vertices; where it bridges a gap it may be far from the tube, so its surroundings
    /// are wider there.
    pub fn new(polygon: &[Point3<f64>], radius_mm: f64) -> Surroundings {
        let drawn_out = drawn_out(polygon, radius_mm);
        let widest = drawn_out.windows(2).map(|w| reach_mm(w, radius_mm)).fold(0.0, f64::max);
        let first = drawn_out[0];
        let (low, high) = drawn_out.iter().fold((first, first), |(a, b), p| (a.inf(p), b.sup(p)));
        let low = low.map(|v| v - widest);
        let extent = high.map(|v| v + widest) - low;
        let cell_mm = (CELL_RADII * radius_mm).max((extent.product() / MOST_CELLS).cbrt());
        let size: [usize; 3] = extent.map(|v| (v / cell_mm) as usize + 1).into();
        let step = 0.5 * cell_mm;
        let mut around = Surroundings {
            radius_mm,
            places: Vec::new(),
            own_places: 0..0,
            low,
            cell_mm,
            size,
            nearest: vec![NOWHERE; size.iter().product()],
            window: 6,
        };
        let mut squares = vec![f32::INFINITY; around.nearest.len()];
        let last = drawn_out.len() - 2;
        for (k, edge) in drawn_out.windows(2).enumerate() {
            match k {
                1 => around.own_places.start = around.places.len(),
                _ if k == last => around.own_places.end = around.places.len(),
                _ => {}
            }
            let steps = ((edge[1] - edge[0]).norm() / step).ceil().max(1.0);
            for k in 0..steps as usize {
                let place = edge[0] + (edge[1] - edge[0]) * (k as f64 / steps);
                around.mark(&place, reach_mm(edge, radius_mm), &mut squares);
            }
        }
        around.places.extend(drawn_out.last());
        around
    }

    /// Enters a place into the cells within its reach.
    fn mark(&mut self, place: &Point3<f64>, reach_mm: f64, squares: &mut [f32]) {
        let index = self.places.len() as u32;
        self.places.push(*place);
        // A cell counts when any of its points may.
        let reach = reach_mm + 0.87 * self.cell_mm;
        let at = (place - self.low) / self.cell_mm;
        let cells = reach / self.cell_mm;
        let range = |k: usize| {
            let from = (at[k] - cells).floor().max(0.0) as usize;
            from..((at[k] + cells).ceil().max(0.0) as usize).min(self.size[k])
        };
        let off = |cell: usize, k: usize| (cell as f64 + 0.5 - at[k]).powi(2);
        for z in range(2) {
            for y in range(1) {
                let beside = off(z, 2) + off(y, 1);
                if beside > cells * cells {
                    continue;
                }
                let row = (z * self.size[1] + y) * self.size[0];
                for x in range(0) {
                    let square = beside + off(x, 0);
                    if square <= cells * cells && (square as f32) < squares[row + x] {
                        squares[row + x] = square as f32;
                        self.nearest[row + x] = index;
                    }
                }
            }
        }
    }

    /// The place of the centre line nearest to a point's cell; None where none is near.
    fn place(&self, p: &Point3<f64>) -> Option<usize> {
        let at = (p - self.low) / self.cell_mm;
        let inside = (0..3).all(|k| at[k] >= 0.0 && (at[k] as usize) < self.size[k]);
        if !inside {
            return None;
        }
        let cell = (at.z as usize * self.size[1] + at.y as usize) * self.size[0] + at.x as usize;
        let place = self.nearest[cell];
        (place != NOWHERE).then_some(place as usize)
    }

    /// Whether a point is near the centre line, to a cell's size.
    pub fn is_near(&self, p: &Point3<f64>) -> bool {
        self.place(p).is_some()
    }

    /// Distance of a point from the centre line; None where that is not near.
    pub fn distance_mm(&self, p: &Point3<f64>) -> Option<f64> {
        Some(self.nearest_edge(p)?.1.sqrt())
    }

    /// The edge between places that is nearest to a point, and the square of its distance; None where none is near.
    fn nearest_edge(&self, p: &Point3<f64>) -> Option<(usize, f64)> {
        let place = self.place(p)?;
        let from = place.saturating_sub(self.window);
        let to = (place + self.window).min(self.places.len() - 1);
        let squares = self.places[from..=to].windows(2).map(|edge| square_from(edge, p));
        squares.enumerate().map(|(k, square)| (from + k, square)).min_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// Whether a point is the tube's, beside faces that may be there. On a face that goes on beyond the tube's end there is
    /// no tube, however near to it.
    pub fn owns(&self, p: &Point3<f64>, faces: &[Face]) -> bool {
        let on_tube = |(edge, square): (usize, f64)| {
            let off = (square.sqrt() - self.radius_mm).abs();
            off < SURFACE_SHARE * self.radius_mm && self.own_places.contains(&edge)
        };
        if faces.iter().any(|f| f.holds(p)) {
            self.nearest_edge(p).is_some_and(on_tube)
        } else {
            self.is_near(p)
        }
    }

    /// The points of the cloud that are the tube's, ascending.
    pub fn own_points(&self, cloud: &PointCloud, faces: &[Face]) -> Vec<u32> {
        let own = |i: &u32| self.owns(&cloud.point(*i as usize), faces);
        (0..cloud.len() as u32).into_par_iter().filter(own).collect()
    }
}

/// The polygon with a radius more at both ends: the first and last vertices lie a little within the tube.
fn drawn_out(polygon: &[Point3<f64>], radius_mm: f64) -> Vec<Point3<f64>> {
    let beyond = |end: &Point3<f64>, inner: &Point3<f64>| {
        let out = (end - inner).try_normalize(1e-12).unwrap_or_default();
        end + out * radius_mm
    };
    let n = polygon.len();
    // A direction over a few vertices: the last one alone may be off.
    let inner = 3.min(n - 1);
    let mut out = vec![beyond(&polygon[0], &polygon[inner])];
    out.extend(polygon);
    out.push(beyond(&polygon[n - 1], &polygon[n - 1 - inner]));
    out
}

/// How far from an edge of the polygon the tube's points may lie.
fn reach_mm(edge: &[Point3<f64>], radius_mm: f64) -> f64 {
    let length = (edge[1] - edge[0]).norm();
    let gap = (length - 4.0 * SPINE_SPACING_RADII * radius_mm).clamp(0.0, 10.0 * radius_mm);
    REACH_RADII * radius_mm + 0.5 * gap
}

fn square_from(edge: &[Point3<f64>], p: &Point3<f64>) -> f64 {
    let along = edge[1] - edge[0];
    let share = ((p - edge[0]).dot(&along) / along.norm_squared().max(1e-300)).clamp(0.0, 1.0);
    (edge[0] + along * share - p).norm_squared()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn distances_are_those_from_the_polygon() {
        let polygon: Vec<Point3<f64>> = (0..60)
            .map(|i| f64::from(i) * 0.1)
            .map(|t| Point3::new(60.0 * t.cos(), 60.0 * t.sin(), 20.0 * t))
            .collect();
        let around = Surroundings::new(&polygon, 10.0);
        let exact = |p: &Point3<f64>| {
            let all = drawn_out(&polygon, 10.0);
            all.windows(2).map(|e| square_from(e, p)).fold(f64::INFINITY, f64::min).sqrt()
        };
        for i in 0..20_000 {
            let part = |k: f64| (f64::from(i) * k).fract() * 200.0 - 100.0;
            let p = Point3::new(part(0.618_034), part(0.414_214), part(0.732_051) + 50.0);
            match around.distance_mm(&p) {
                Some(found) => assert!((found - exact(&p)).abs() < 1e-9 || exact(&p) > 14.0),
                None => assert!(exact(&p) > 14.0, "{p} is {} away", exact(&p)),
            }
        }
    }

    #[test]
    fn a_face_keeps_its_points_but_not_the_tubes() {
        let polygon: Vec<Point3<f64>> = (0..40).map(|i| Point3::new(f64::from(i) * 3.0, 0.0, 0.0)).collect();
        let around = Surroundings::new(&polygon, 10.0);
        let table = Face { normal: Vector3::z(), offset_mm: -10.0, sigma_mm: 0.03, points: Vec::new() };
        let faces = [table];
        assert!(around.owns(&Point3::new(50.0, 0.0, -10.02), &faces), "at the line of contact");
        assert!(around.owns(&Point3::new(50.0, 8.0, 6.0), &faces), "on the tube");
        assert!(!around.owns(&Point3::new(123.0, 0.0, -10.02), &faces), "on the table beyond the end");
        assert!(around.owns(&Point3::new(123.0, 0.0, -10.02), &[]), "the end itself lies a little beyond");
        assert!(!around.owns(&Point3::new(50.0, 6.0, -10.02), &faces), "beside the tube on the table");
        assert!(around.owns(&Point3::new(50.0, 6.0, -10.02), &[]), "nothing is known of a table");
        assert!(!around.owns(&Point3::new(50.0, 30.0, 0.0), &[]), "far away");
    }
}
