//! Planar faces of a cloud: a table, the flanks of V-blocks, clamp jaws (paper 002, section 3).
//!
//! The cloud is cut into patches; each patch's regression plane is a point in the space of planes, where the patches of
//! one face lie together. The distance of two planes is measured over a domain of interest by point masses (paper
//! 002, equation 5): here over the patch's own points, so that it does not depend on where a plane would run
//! far from its data. A cluster grows from a patch, its domain doubling with each round.

use nalgebra::{Matrix3, Point3, SymmetricEigen, Vector3};
use rayon::prelude::*;

use super::robust::{MEDIAN_TO_SIGMA, median};

/// A planar face.
#[derive(Debug, Clone, PartialEq)]
pub struct Face {
    /// Unit normal, of either sign.
    pub normal: Vector3<f64>,
    /// `normal . p` of its points p, millimetres.
    pub offset_mm: f64,
    /// Root mean square distance of its points.
    pub sigma_mm: f64,
    /// Its points, ascending indices into the cloud.
    pub points: Vec<u32>,
}

impl Face {
    /// Signed distance of a point from the face's plane.
    pub fn distance_mm(&self, p: &Point3<f64>) -> f64 {
        self.normal.dot(&p.coords) - self.offset_mm
    }

    /// Whether a point lies on the plane as far as noise tells.
    pub fn holds(&self, p: &Point3<f64>) -> bool {
        self.distance_mm(p).abs() < TOLERANCE_SIGMAS * self.sigma_mm
    }
}

/// Points farther from a plane than this many sigmas are not its own.
const TOLERANCE_SIGMAS: f64 = 4.0;

/// Edge of a patch in spacings of the points: about forty points.
const PATCH_SPACINGS: f64 = 6.0;

/// Fewest points of a patch that tell a plane.
const MIN_POINTS: usize = 8;

/// A patch belongs to a cluster up to this many times the noise.
const CLUSTER_SIGMAS: f64 = 2.5;

/// Points of a patch farther from its plane are left out of it, so many times at most.
const TRIM_SIGMAS: f64 = 3.0;
const TRIMS: usize = 6;

/// Share of all points, those of the flattest patches, that tells the noise.
const FLAT_SHARE: f64 = 0.2;

/// Patches from which clusters are grown.
const SEEDS: usize = 48;

/// Faces are at least this many patches wide: narrower ones do no harm.
const MIN_WIDTH: f64 = 2.0;

/// A slab four times as thick holds twice the points of a cylinder (square root of four) and as many of a plane.
const MOST_GROWTH: f64 = 1.6;

/// Sagitta across a face's narrow side in sigmas: a plane has none.
const MOST_SAGITTA: f64 = 1.0;

/// A uniform width reaches so many root mean squares to either side.
const SIDE_WIDTHS: f64 = 1.732;

/// Radius of what bends so, in root mean square lengths of the face, from which on it is no tube.
const ROUND_LENGTHS: f64 = 4.0;

/// Doming of a face's patches that is no chance.
const DOME_SIGMAS: f64 = 4.0;

/// More faces than this are not looked for.
const MOST_FACES: usize = 24;

/// Points of one voxel and their moments about `anchor`.
#[derive(Debug, Clone)]
struct Patch {
    key: [i32; 3],
    members: Vec<u32>,
    moments: Moments,
    centre: Point3<f64>,
    rms_mm: f64,
}

/// Zeroth, first and second moments.
#[derive(Debug, Clone, Copy, Default)]
struct Moments {
    count: f64,
    first: Vector3<f64>,
    second: Matrix3<f64>,
}

/// A plane of regression.
#[derive(Debug, Clone, Copy)]
struct Plane {
    normal: Vector3<f64>,
    offset_mm: f64,
    rms_mm: f64,
    /// Direction of the smaller extent within the plane, root mean square extent there and along the larger one.
    narrow: Vector3<f64>,
    width_mm: f64,
    length_mm: f64,
}

impl Moments {
    fn add(&mut self, p: &Vector3<f64>) {
        self.count += 1.0;
        self.first += p;
        self.second += p * p.transpose();
    }

    fn merge(&mut self, other: &Moments) {
        self.count += other.count;
        self.first += other.first;
        self.second += other.second;
    }

    /// Plane of regression (least squares of the orthogonal distances).
    fn plane(&self) -> Plane {
        let mean = self.first / self.count;
        let eigen = SymmetricEigen::new(self.second / self.count - mean * mean.transpose());
        let mut order = [0, 1, 2];
        order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
        let extent = |k: usize| eigen.eigenvalues[order[k]].max(0.0).sqrt();
        let axis = |k: usize| eigen.eigenvectors.column(order[k]).into_owned();
        let normal = axis(0);
        Plane {
            normal,
            offset_mm: normal.dot(&mean),
            rms_mm: extent(0),
            narrow: axis(1),
            width_mm: extent(1),
            length_mm: extent(2),
        }
    }

    /// Root mean square distance of the points from a plane: the distance in the space of planes, over the
    /// patch, with the patch's own noise.
    fn distance_mm(&self, plane: &Plane) -> f64 {
        let n = &plane.normal;
        let square = n.dot(&(self.second * n)) - 2.0 * plane.offset_mm * n.dot(&self.first);
        (square / self.count + plane.offset_mm * plane.offset_mm).max(0.0).sqrt()
    }
}

/// Finds the planar faces of a cloud whose points lie about `spacing_mm` apart, the one with most points first. A point
/// belongs to one face at most.
pub fn find_planes(points: &[Point3<f64>], spacing_mm: f64) -> Vec<Face> {
    let cell_mm = PATCH_SPACINGS * spacing_mm;
    if points.is_empty() || !cell_mm.is_normal() {
        return Vec::new();
    }
    // Moments about the cloud's own place: coordinates far from the origin would cancel.
    let anchor = points[points.len() / 2];
    let local: Vec<Vector3<f64>> = points.iter().map(|p| p - anchor).collect();
    let patches = cut(&local, cell_mm);
    let Some(noise_mm) = noise(&patches) else { return Vec::new() };
    let mut search = Search { points: &local, taken: vec![false; local.len()], patches, noise_mm, cell_mm };
    let mut faces = Vec::new();
    while faces.len() < MOST_FACES {
        let Some(mut face) = search.largest() else { break };
        face.offset_mm += face.normal.dot(&anchor.coords);
        faces.push(face);
    }
    faces.sort_by_key(|f| std::cmp::Reverse(f.points.len()));
    faces
}

/// The cloud cut into voxels, in the order of their keys.
fn cut(points: &[Vector3<f64>], cell_mm: f64) -> Vec<Patch> {
    let key = |p: &Vector3<f64>| -> [i32; 3] { p.map(|v| (v / cell_mm).floor() as i32).into() };
    // Voxel and index as one number, which sorts faster than four.
    let number = |(p, i): (&Vector3<f64>, u32)| {
        let [x, y, z] = key(p).map(|v| v as u32 ^ 1 << 31);
        [x, y, z, i].iter().fold(0, |number, &v| number << 32 | u128::from(v))
    };
    let mut order: Vec<u128> = points.iter().zip(0..).map(number).collect();
    order.sort_unstable();
    let patch = |run: &&[u128]| {
        let members: Vec<u32> = run.iter().map(|&number| number as u32).collect();
        let (moments, plane) = robust(&members, points);
        // A sliver at a voxel's corner is flat whatever it belongs to.
        let tells = members.len() >= MIN_POINTS && plane.width_mm > 0.12 * cell_mm;
        let rms_mm = if tells { plane.rms_mm } else { f64::INFINITY };
        Patch {
            key: key(&points[members[0] as usize]),
            members,
            moments,
            centre: Point3::from(moments.first / moments.count),
            rms_mm,
        }
    };
    let runs: Vec<&[u128]> = order.chunk_by(|a, b| a >> 32 == b >> 32).collect();
    runs.par_iter().map(patch).collect()
}

/// Moments and plane of a patch's points without those that stand off it: flying points fill many cells of a thinned
/// cloud, and a few make a table look as rough as a tube is round.
fn robust(members: &[u32], points: &[Vector3<f64>]) -> (Moments, Plane) {
    let mut moments = Moments::default();
    members.iter().for_each(|&i| moments.add(&points[i as usize]));
    let mut plane = moments.plane();
    let off = |plane: &Plane, i: u32| (points[i as usize].dot(&plane.normal) - plane.offset_mm).abs();
    for _ in 0..TRIMS {
        let mut distances: Vec<f64> = members.iter().map(|&i| off(&plane, i)).collect();
        let sigma_mm = MEDIAN_TO_SIGMA * median(&mut distances).unwrap_or(0.0);
        let kept = |i: &&u32| off(&plane, **i) <= TRIM_SIGMAS * sigma_mm;
        let mut trimmed = Moments::default();
        members.iter().filter(kept).for_each(|&i| trimmed.add(&points[i as usize]));
        if trimmed.count == moments.count {
            break;
        }
        moments = trimmed;
        plane = moments.plane();
    }
    (moments, plane)
}

/// Noise of the flattest patches.
fn noise(patches: &[Patch]) -> Option<f64> {
    let mut flat: Vec<&Patch> = patches.iter().filter(|p| p.rms_mm.is_finite()).collect();
    flat.sort_by(|a, b| a.rms_mm.total_cmp(&b.rms_mm));
    let all: usize = patches.iter().map(|p| p.members.len()).sum();
    let mut seen = 0;
    let enough = flat.iter().find(|p| {
        seen += p.members.len();
        seen as f64 >= FLAT_SHARE * all as f64
    });
    enough.or(flat.last()).map(|p| p.rms_mm)
}

/// How the patches of a face are domed: regression of height over squared distance from the patch's middle, each
/// patch about its own means. The tops of a tube that lies in a plane have a common tangent plane, wide enough for
/// a face, but each patch of them is round.
#[derive(Debug, Default)]
struct Dome {
    product: f64,
    square: f64,
}

impl Dome {
    fn add(&mut self, patch: &Patch, points: &[Vector3<f64>], normal: &Vector3<f64>) {
        let (mut h, mut s, mut hs, mut ss) = (0.0, 0.0, 0.0, 0.0);
        for &k in &patch.members {
            let from = points[k as usize] - patch.centre.coords;
            let height = from.dot(normal);
            let square = from.norm_squared() - height * height;
            h += height;
            s += square;
            hs += height * square;
            ss += square * square;
        }
        let n = patch.members.len() as f64;
        self.product += hs - h * s / n;
        self.square += ss - s * s / n;
    }

    /// Whether the doming is beyond chance and its radius (a cylinder's: height falls by square / 4 r) smaller than the
    /// face.
    fn is_round(&self, sigma_mm: f64, length_mm: f64) -> bool {
        let slope = (self.product / self.square.max(f64::MIN_POSITIVE)).abs();
        let chance = sigma_mm / self.square.max(f64::MIN_POSITIVE).sqrt();
        slope > DOME_SIGMAS * chance && 1.0 < 4.0 * slope * length_mm
    }
}

/// What is left to be searched.
struct Search<'a> {
    points: &'a [Vector3<f64>],
    taken: Vec<bool>,
    patches: Vec<Patch>,
    noise_mm: f64,
    cell_mm: f64,
}

impl Search<'_> {
    /// The largest face that is left; its patches are gone afterwards.
    fn largest(&mut self) -> Option<Face> {
        let flat = |p: &Patch| p.rms_mm < 1.5 * self.noise_mm;
        let seeds: Vec<usize> = (0..self.patches.len()).filter(|&i| flat(&self.patches[i])).collect();
        let stride = seeds.len().div_ceil(SEEDS).max(1);
        let mut clusters: Vec<Vec<usize>> =
            seeds.iter().step_by(stride).filter_map(|&s| self.grow(s)).collect();
        let size = |c: &Vec<usize>| c.iter().map(|&i| self.patches[i].members.len()).sum::<usize>();
        clusters.sort_by(|a, b| size(b).cmp(&size(a)).then_with(|| a.cmp(b)));
        clusters.dedup();
        let (cluster, face) =
            clusters.into_iter().find_map(|c| Some((self.face(&c)?, c)).map(|(f, c)| (c, f)))?;
        for &i in &face.points {
            self.taken[i as usize] = true;
        }
        let mut index = 0;
        self.patches.retain(|_| {
            index += 1;
            cluster.binary_search(&(index - 1)).is_err()
        });
        Some(face)
    }

    /// The patches around `seed` that lie on one plane with it, ascending; None when its own surroundings do not.
    fn grow(&self, seed: usize) -> Option<Vec<usize>> {
        let at = self.patches[seed].centre;
        let mut plane = self.patches[seed].moments.plane();
        let mut reach = 1.8 * self.cell_mm;
        let mut cluster = Vec::new();
        for round in 0.. {
            let mut near = 0;
            let mut found = Vec::new();
            for (i, patch) in self.patches.iter().enumerate() {
                if patch.rms_mm.is_finite() && (patch.centre - at).norm_squared() < reach * reach {
                    near += 1;
                    if patch.moments.distance_mm(&plane) < CLUSTER_SIGMAS * self.noise_mm {
                        found.push(i);
                    }
                }
            }
            if round == 0 && (found.len() < 4 || 2 * found.len() < near) {
                return None;
            }
            let settled = found.len() == cluster.len();
            cluster = found;
            if cluster.len() < 4 {
                return None;
            }
            plane = self.regression(&cluster);
            if (settled && round > 2) || round == 14 {
                break;
            }
            reach *= 2.0;
        }
        Some(cluster)
    }

    fn regression(&self, cluster: &[usize]) -> Plane {
        let mut sum = Moments::default();
        cluster.iter().for_each(|&i| sum.merge(&self.patches[i].moments));
        sum.plane()
    }

    /// The face of a cluster, with the points of the patches beside it that lie on its plane; None when it is narrow or
    /// curved.
    fn face(&self, cluster: &[usize]) -> Option<Face> {
        let plane = self.regression(cluster);
        if plane.width_mm * 12f64.sqrt() < MIN_WIDTH * self.cell_mm {
            return None;
        }
        let sigma_mm = plane.rms_mm.max(1e-6 * self.cell_mm);
        let (mut points, mut wider, mut core) = (Vec::new(), 0, 0);
        let (mut bow, mut inner) = ([0.0; 5], [0.0; 3]);
        let mut dome = Dome::default();
        let middle = self.regression_centre(cluster);
        for (i, patch) in self.patches.iter().enumerate() {
            let own = cluster.binary_search(&i).is_ok();
            if !own && !self.is_beside(patch, cluster) {
                continue;
            }
            if own {
                dome.add(patch, self.points, &plane.normal);
            }
            for &k in &patch.members {
                let p = &self.points[k as usize];
                let off = p.dot(&plane.normal) - plane.offset_mm;
                if self.taken[k as usize] {
                    continue;
                }
                wider += usize::from(off.abs() < 12.0 * sigma_mm);
                core += usize::from(off.abs() < 3.0 * sigma_mm);
                if off.abs() < TOLERANCE_SIGMAS * sigma_mm {
                    points.push(k);
                    let u = (p - middle).dot(&plane.narrow) / plane.width_mm;
                    accumulate(&mut bow, &mut inner, u, off);
                }
            }
        }
        points.sort_unstable();
        let bow_mm = sagitta(&bow, &inner).abs();
        // Passes that drift bow a table a little; what is round for a tube is so within its own length.
        let round = (SIDE_WIDTHS * plane.width_mm).powi(2) < 2.0 * bow_mm * ROUND_LENGTHS * plane.length_mm;
        let bowed = bow_mm > MOST_SAGITTA * sigma_mm && round;
        let curved = bowed || dome.is_round(sigma_mm, plane.length_mm);
        let grows = wider as f64 > MOST_GROWTH * core as f64;
        let face = Face { normal: plane.normal, offset_mm: plane.offset_mm, sigma_mm, points };
        (!curved && !grows).then_some(face)
    }

    fn regression_centre(&self, cluster: &[usize]) -> Vector3<f64> {
        let mut sum = Moments::default();
        cluster.iter().for_each(|&i| sum.merge(&self.patches[i].moments));
        sum.first / sum.count
    }

    /// Whether a patch touches one of the cluster's.
    fn is_beside(&self, patch: &Patch, cluster: &[usize]) -> bool {
        let touches = |key: [i32; 3]| {
            let at = self.patches.binary_search_by(|p| p.key.cmp(&key));
            at.is_ok_and(|i| cluster.binary_search(&i).is_ok())
        };
        let [x, y, z] = patch.key;
        (-1..=1).any(|a| (-1..=1).any(|b| (-1..=1).any(|c| touches([x + a, y + b, z + c]))))
    }
}

/// Sums for the parabola `off = a + b u^2` (u in units of the width): powers of u, and `off` times them.
fn accumulate(powers: &mut [f64; 5], right: &mut [f64; 3], u: f64, off: f64) {
    let mut power = 1.0;
    for k in 0..5 {
        powers[k] += power;
        if k < 3 {
            right[k] += power * off;
        }
        power *= u;
    }
}

/// Height of the parabola from the face's middle to its sides.
fn sagitta(powers: &[f64; 5], right: &[f64; 3]) -> f64 {
    let [s0, s1, s2, s3, s4] = *powers;
    let normal = Matrix3::new(s0, s1, s2, s1, s2, s3, s2, s3, s4);
    let solved = normal.cholesky().map(|c| c.solve(&Vector3::from(*right)));
    solved.map_or(0.0, |c| c[2] * SIDE_WIDTHS * SIDE_WIDTHS)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reproducible numbers from -0.5 to 0.5.
    fn numbers(mut state: u64) -> impl FnMut() -> f64 {
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        }
    }

    /// `n` points on a rectangle about `middle`, with noise of standard deviation `sigma` across.
    fn sheet(
        n: usize,
        middle: Point3<f64>,
        sides: [Vector3<f64>; 2],
        sigma: f64,
        seed: u64,
    ) -> Vec<Point3<f64>> {
        let mut next = numbers(seed);
        let normal = sides[0].cross(&sides[1]).normalize();
        // The sum of twelve uniform numbers has variance one.
        let point = |_| {
            let at = middle + sides[0] * next() + sides[1] * next();
            at + normal * (sigma * (0..12).map(|_| next()).sum::<f64>())
        };
        (0..n).map(point).collect()
    }

    fn cylinder(n: usize, r: f64, length: f64, sigma: f64) -> Vec<Point3<f64>> {
        let mut next = numbers(7);
        let point = |_| {
            let (turn, along) = (3.0 * next(), length * next());
            let radius = r + sigma * (0..12).map(|_| next()).sum::<f64>();
            Point3::new(along, radius * turn.cos(), radius * turn.sin())
        };
        (0..n).map(point).collect()
    }

    #[test]
    fn a_sheet_comes_out_with_its_normal_and_offset_to_within_noise() {
        let sides = [Vector3::new(100.0, 20.0, 5.0), Vector3::new(-10.0, 70.0, 30.0)];
        let normal = sides[0].cross(&sides[1]).normalize();
        // Far from the origin: nothing may cancel.
        let middle = Point3::new(5_000.0, -3_000.0, 800.0);
        let faces = find_planes(&sheet(8_000, middle, sides, 0.05, 1), 1.0);
        assert_eq!(faces.len(), 1);
        let face = &faces[0];
        assert!(face.points.len() > 7_900, "{}", face.points.len());
        assert!((face.sigma_mm - 0.05).abs() < 0.005, "{}", face.sigma_mm);
        assert!(face.normal.cross(&normal).norm() < 1e-4, "{}", face.normal.cross(&normal).norm());
        assert!(face.distance_mm(&middle).abs() < 0.005, "{}", face.distance_mm(&middle));
    }

    #[test]
    fn parallel_sheets_are_two_and_each_point_is_one_face_s() {
        let sides = [Vector3::x() * 80.0, Vector3::y() * 60.0];
        let mut points = sheet(5_000, Point3::origin(), sides, 0.03, 2);
        points.extend(sheet(4_000, Point3::new(20.0, 10.0, 20.0), sides, 0.03, 3));
        let faces = find_planes(&points, 1.0);
        assert_eq!(faces.len(), 2, "{:?}", faces.iter().map(|f| f.points.len()).collect::<Vec<_>>());
        let mut all: Vec<u32> = faces.iter().flat_map(|f| f.points.clone()).collect();
        let many = all.len();
        all.sort_unstable();
        all.dedup();
        assert!(all.len() == many && many > 8_700, "{many}");
    }

    #[test]
    fn a_cylinder_has_no_planes_whatever_its_radius_and_noise() {
        for r in [2.0, 5.0, 12.0, 50.0] {
            for sigma in [0.0, 0.01, 0.03, 0.1] {
                let points = cylinder(12_000, r, 20.0 * r, sigma);
                let spacing = (3.0 * r * 20.0 * r / 12_000.0_f64).sqrt();
                let faces = find_planes(&points, spacing);
                assert!(faces.is_empty(), "radius {r}, noise {sigma}: {}", faces[0].points.len());
            }
        }
    }

    #[test]
    fn a_sheet_beside_a_cylinder_keeps_off_it() {
        let mut points = cylinder(6_000, 12.0, 300.0, 0.03);
        let of_tube = points.len() as u32;
        let sides = [Vector3::x() * 300.0, Vector3::y() * 80.0];
        points.extend(sheet(6_000, Point3::new(0.0, 0.0, -12.0), sides, 0.03, 4));
        let faces = find_planes(&points, 1.5);
        assert_eq!(faces.len(), 1);
        let taken = faces[0].points.iter().filter(|&&i| i < of_tube).count();
        // What lies within four sigmas of the tangent plane: a strip of 2 sqrt(2 r 0.12) = 3.4 mm.
        assert!(taken < 500, "{taken} points of the tube");
        assert!(faces[0].points.len() - taken > 5_900);
    }

    #[test]
    fn nothing_and_next_to_nothing() {
        assert!(find_planes(&[], 1.0).is_empty());
        assert!(find_planes(&[Point3::origin(); 100], 1.0).is_empty());
        assert!(find_planes(&cylinder(500, 5.0, 50.0, 0.0), 0.0).is_empty());
        assert!(find_planes(&cylinder(5, 5.0, 50.0, 0.0), 3.0).is_empty());
    }

    /// A table of 300 x 200 mm with a share of flying points above it; its height by `height_mm`.
    fn table(flying: usize, height_mm: impl Fn(f64) -> f64) -> Vec<Point3<f64>> {
        let sides = [Vector3::x() * 300.0, Vector3::y() * 200.0];
        let mut points = sheet(6000, Point3::origin(), sides, 0.03, 5);
        points.iter_mut().for_each(|p| p.z += height_mm(p.x));
        let mut next = numbers(9);
        points.extend((0..flying).map(|_| Point3::new(300.0 * next(), 200.0 * next(), 40.0 + 90.0 * next())));
        points
    }

    #[test]
    fn flying_points_do_not_make_a_table_rough() {
        let faces = find_planes(&table(3000, |_| 0.0), 3.2);
        assert_eq!(faces.len(), 1);
        assert!((0.025..0.04).contains(&faces[0].sigma_mm), "{}", faces[0].sigma_mm);
        let on_it = faces[0].points.iter().filter(|i| **i < 6000).count();
        assert!(on_it > 5900, "{on_it}");
    }

    #[test]
    fn a_table_that_passes_bow_by_twice_the_noise_is_a_face() {
        let faces = find_planes(&table(0, |x| 0.06 * (x / 150.0).powi(2)), 3.2);
        assert_eq!(faces.len(), 1);
        assert!(faces[0].points.len() > 5800);
    }
}
