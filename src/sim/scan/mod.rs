//! The simulated scan arm: a hand-guided laser line sweeping over a bent tube.
//!
//! Stripes of light cross the tube; along each stripe, rays are cast at regular steps against the exact surface
//! (`solid`), so a point before noise lies on the ideal tube to the last digit, and whatever stands in front hides
//! what is behind. `sweep` adds what spoils real scans: noise that grows at grazing incidence, dropouts, flying
//! points, patches without data, passes that disagree, a tube that was not scanned to its end; `props` a table,
//! V-blocks and clamp jaws. Shares no code with the estimators.

mod end;
mod props;
mod solid;
mod sweep;

#[cfg(test)]
mod tests;

use std::str::FromStr;

use nalgebra::{Isometry3, Point3, Quaternion, Translation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use crate::cloud::PointCloud;
use crate::tube::{Frame, Lra, Spine};

pub use end::{Burr, EndShape};
use props::Prop;
use solid::Solid;

/// The tube as it came out of the bender.
#[derive(Debug, Clone, PartialEq)]
pub struct TubeShape {
    /// Its centre line.
    pub lra: Lra,
    /// Outer diameter.
    pub od_mm: f64,
    /// Per bend, (largest - smallest diameter) / nominal diameter: 0 is round, missing ones are 0. The tube flattens
    /// in the plane of the bend.
    pub ovality: Vec<f64>,
    /// Per bend, how far the outer wall lies within the ellipse over the nominal diameter: 0 is none, missing ones are 0. Its
    /// shoulders, 60 degrees to either side, bulge as far.
    pub flattening: Vec<f64>,
    /// Thickness of the wall: light returns from the end faces and from the bore close to them. 0 is a tube whose open
    /// ends return nothing.
    pub wall_mm: f64,
    /// How the first and the last end were cut.
    pub ends: [EndShape; 2],
}

impl TubeShape {
    /// A tube with round sections throughout and clean, square, dark ends.
    pub fn round(lra: Lra, od_mm: f64) -> TubeShape {
        let ends = [EndShape::default(); 2];
        TubeShape { lra, od_mm, ovality: Vec::new(), flattening: Vec::new(), wall_mm: 0.0, ends }
    }
}

/// How close the points lie.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Density {
    /// About this many points on the tube (all passes together); what surrounds it comes on top.
    Points(usize),
    /// Steps along a stripe and between stripes.
    Spacing {
        /// Between points of one stripe.
        along_mm: f64,
        /// Between stripes, on average.
        between_mm: f64,
    },
}

/// How the tube is scanned. The default is a single pass from one side.
#[derive(Debug, Clone, PartialEq)]
pub struct ScanSettings {
    /// How close the points lie.
    pub density: Density,
    /// Number of passes from different sides, merged into one cloud.
    pub views: usize,
    /// Direction of sight of the first pass in the tube's own coordinates (first straight along +x); None looks
    /// at its broad side, as it would lie on a table.
    pub sight: Option<Vector3<f64>>,
    /// Whether the scan's coordinate system is turned and shifted at random; otherwise it is the tube's own.
    pub random_pose: bool,
    /// Standard deviation along the ray at normal incidence.
    pub noise_mm: f64,
    /// Share of the points that fly off along their ray.
    pub outlier_share: f64,
    /// Angle between ray and surface normal beyond which nothing returns.
    pub incidence_limit_rad: f64,
    /// Discs of the surface without data (oil, gloss).
    pub missing_patches: usize,
    /// A table under the tube.
    pub table: bool,
    /// V-blocks under its long straights.
    pub v_blocks: bool,
    /// Clamp jaws on up to two of its straights.
    pub jaws: Option<Jaws>,
    /// An end that was not scanned.
    pub unseen_end: Option<UnseenEnd>,
    /// Standard deviation of the rigid displacement of every pass after the first.
    pub pass_drift_mm: f64,
}

/// How clamp jaws touch the tube.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Jaws {
    /// A V from either side.
    Grip,
    /// A flat face from one side.
    Flat,
}

impl FromStr for Jaws {
    type Err = String;

    fn from_str(word: &str) -> Result<Jaws, String> {
        match word {
            "grip" => Ok(Jaws::Grip),
            "flat" => Ok(Jaws::Flat),
            _ => Err("allowed is grip or flat".to_owned()),
        }
    }
}

/// Where a scan stops short of the tube's end: at a plane across the end straight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UnseenEnd {
    /// The last end; otherwise the first.
    pub last: bool,
    /// How much of the tube is not seen, along its centre line. No more than the end straight.
    pub unseen_mm: f64,
    /// How oblique the plane is; 0 is square to the tube.
    pub tilt_rad: f64,
}

impl Default for ScanSettings {
    fn default() -> ScanSettings {
        ScanSettings {
            density: Density::Points(50_000),
            views: 1,
            sight: None,
            random_pose: true,
            noise_mm: 0.03,
            outlier_share: 0.005,
            incidence_limit_rad: 78f64.to_radians(),
            missing_patches: 0,
            table: false,
            v_blocks: false,
            jaws: None,
            unseen_end: None,
            pass_drift_mm: 0.0,
        }
    }
}

/// What a simulated point is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PointKind {
    /// On the tube, but for noise.
    Tube,
    /// On the table, a V-block or a jaw, but for noise.
    Surroundings,
    /// A flying point.
    Outlier,
}

/// A scan and the truth behind it.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedScan {
    /// The points in the order of scanning.
    pub points: Vec<Point3<f64>>,
    /// What each point is.
    pub kinds: Vec<PointKind>,
    /// The true centre line in the scan's coordinates.
    pub spine: Spine,
}

impl SimulatedScan {
    /// The points as a cloud.
    pub fn cloud(&self) -> PointCloud {
        PointCloud::from_points(&self.points)
    }

    /// Number of points of one kind.
    pub fn count(&self, kind: PointKind) -> usize {
        self.kinds.iter().filter(|k| **k == kind).count()
    }
}

/// Everything that light can meet, in the tube's own coordinates, and its extent.
struct Scene {
    solid: Solid,
    props: Vec<Prop>,
    /// Middle of the tube.
    centre: Point3<f64>,
    /// Radius of a ball about the middle that holds the tube.
    reach_mm: f64,
    /// Direction of the tube's greatest extent.
    long: Vector3<f64>,
    /// Away from the table, towards the first pass's scanner.
    up: Vector3<f64>,
}

impl Scene {
    fn new(shape: &TubeShape, spine: &Spine, settings: &ScanSettings) -> Scene {
        let solid = Solid::new(shape, spine);
        let r = solid.radius_mm();
        let points = spine.sampled((spine.length_mm() / 2000.0).max(r / 4.0));
        let (long, broad) = axes(&points);
        let given = settings.sight.and_then(|s| s.try_normalize(1e-12));
        let up = given.map_or(broad, |s| -s);
        let (min, max) = points.iter().fold((points[0], points[0]), |(a, b), p| (a.inf(p), b.sup(p)));
        let props = props::around(spine, &points, r, &up, settings);
        let reach_mm = (max - min).norm() / 2.0 + 2.0 * r;
        Scene { solid, props, centre: nalgebra::center(&min, &max), reach_mm, long, up }
    }
}

/// Directions of the greatest and the smallest extent of some points.
fn axes(points: &[Point3<f64>]) -> (Vector3<f64>, Vector3<f64>) {
    let mean = points.iter().map(|p| p.coords).sum::<Vector3<f64>>() / points.len() as f64;
    let spread = points.iter().map(|p| (p.coords - mean) * (p.coords - mean).transpose()).sum();
    let eigen = nalgebra::SymmetricEigen::<f64, nalgebra::Const<3>>::new(spread);
    let axis = |i: usize| {
        let v = eigen.eigenvectors.column(i).into_owned();
        if v[v.iamax()] < 0.0 { -v } else { v }
    };
    (axis(eigen.eigenvalues.imax()), axis(eigen.eigenvalues.imin()))
}

/// Scans a tube. The same seed gives the same points, whatever the number of threads.
pub fn scan(shape: &TubeShape, settings: &ScanSettings, seed: u64) -> SimulatedScan {
    let own = Spine::from_lra(&shape.lra, Frame::identity());
    let scene = Scene::new(shape, &own, settings);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let pose = if settings.random_pose { random_pose(&mut rng) } else { Isometry3::identity() };
    let hits = sweep::all_passes(&scene, settings, &own, &mut rng);
    SimulatedScan {
        points: hits.iter().map(|h| pose * h.0).collect(),
        kinds: hits.iter().map(|h| h.1).collect(),
        spine: own.moved(&pose),
    }
}

/// Any orientation, within half a metre of the origin along each axis.
fn random_pose(rng: &mut ChaCha8Rng) -> Isometry3<f64> {
    let mut normal = || rng.sample::<f64, _>(StandardNormal);
    let turn = UnitQuaternion::from_quaternion(Quaternion::new(normal(), normal(), normal(), normal()));
    let mut shift = || rng.random_range(-500.0..500.0);
    Isometry3::from_parts(Translation3::new(shift(), shift(), shift()), turn)
}
