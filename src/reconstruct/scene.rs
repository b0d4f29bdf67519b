//! What the scan shows: where the tube is, and what lies around it.
//!
//! First in `reconstruct`: a moderate cloud ([`moderate`](super::moderate)); planar faces out of the way
//! ([`find_planes`]); radii that tubes may have ([`radius`]); for each a centre line ([`mls`], [`crust`]); of the tubes
//! found the one that is wanted; and which points are its own ([`owner`](super::owner)).

use nalgebra::Point3;
use rayon::prelude::*;

use super::crust;
use super::error::ReconstructError;
use super::mls::{self, SPINE_SPACING_RADII, SpinePoint, WORK_CELL_RADII};
use super::moderate::{Moderate, any_share, moderate};
use super::owner::Surroundings;
use super::radius::{self, Candidate};
use super::reach;
use crate::cloud::PointCloud;
use crate::recognize::{Face, find_planes};
use crate::tube::Nominal;

/// The tube that is to be measured, and what else was seen.
#[derive(Debug, Clone)]
pub struct Scene {
    /// Tube radius, good to about a hundredth.
    pub radius_mm: f64,
    /// Vertices along the centre line, about 0.3 tube radii apart except across gaps.
    pub polygon: Vec<Point3<f64>>,
    /// Ends of it beyond which points go on behind a stretch without.
    pub hidden: Vec<Point3<f64>>,
    /// The tube's points: all, or so many that they lie 0.2 tube radii apart or closer.
    pub thin: PointCloud,
    /// Indices of the cloud's points that are the tube's, ascending; None when nothing else was seen: all are.
    pub own: Option<Vec<u32>>,
    /// Planar faces around the tube.
    pub faces: Vec<Face>,
    /// What the user should know.
    pub warnings: Vec<String>,
}

/// Another chain with this share of the largest one's surface is another tube, not debris.
const SECOND_TUBE_SHARE: f64 = 0.15;

/// More tubes than this and the longest is no better than another.
const MOST_TUBES: usize = 8;

/// A tube is at least this many radii long.
const LEAST_LENGTH_RADII: f64 = 3.0;

/// Share of the points around a centre line that must lie on the tube's surface, and how near.
const LEAST_ON_SURFACE: f64 = 0.5;
const SURFACE_SHARE: f64 = 0.15;

/// Of two radii for one tube that one stays which has more points within so many times the noise of cylinders.
const EXACT: f64 = 3.0;

/// Candidates of the radius that are followed up, with this share of the best one's support.
const CANDIDATES: usize = 3;
const LEAST_OF_BEST: f64 = 0.25;

/// With this support a radius is a tube's, even where its points are too few for a centre line.
const SURE_SUPPORT: f64 = 0.3;

/// Less than this share of the cloud away from the tube is flying points.
const STRAY_SHARE: f64 = 0.06;
const SOME_POINTS: usize = 10_000;

/// A cloud with points farther apart than this many tube radii is taken anew.
const COARSEST_RADII: f64 = 0.2;

/// Points looked at to take it anew.
const MOST_LOOKED_AT: usize = 2_000_000;

/// A centre line with the radius that it was found with.
#[derive(Debug, Clone)]
struct Tube {
    radius_mm: f64,
    polygon: Vec<Point3<f64>>,
    around: Surroundings,
    /// Length without bridges.
    solid_mm: f64,
    /// Area of the surface seen, about.
    area_mm2: f64,
    closed: bool,
}

/// Finds the tube: with a nominal the one most like it, otherwise the largest.
pub fn look(cloud: &PointCloud, nominal: Option<&Nominal>) -> Result<Scene, ReconstructError> {
    let whole = moderate(cloud);
    let faces = planes(&whole);
    let rest = without(cloud, &whole, &faces);
    let no_tube =
        || ReconstructError::NoTube { points: cloud.len(), faces: faces.len(), spacing_mm: rest.spacing_mm };
    let candidates = radius::candidates(&rest.cloud, rest.spacing_mm);
    let best = candidates.first().ok_or_else(no_tube)?.support;
    let exact_mm = EXACT * candidates.iter().map(|c| c.rms_mm).fold(f64::INFINITY, f64::min);
    let mut tubes: Vec<Tube> = Vec::new();
    let mut reason = None;
    for candidate in candidates.iter().take(CANDIDATES).filter(|c| c.support >= LEAST_OF_BEST * best) {
        let radius_mm = candidate.radius_mm;
        let work = at_radius(cloud, &rest, &faces, candidate);
        let spine = mls::spine_cloud(&work, radius_mm);
        let chains = chains(&spine, radius_mm);
        let found = tubes_of(&work, &chains, radius_mm);
        if found.is_empty() && candidate.support > SURE_SUPPORT {
            reason = reason.or_else(|| too_little(&work, &spine, &chains, rest.spacing_mm, radius_mm));
        }
        found.into_iter().for_each(|t| keep_apart(&mut tubes, t, &rest.cloud, exact_mm));
    }
    if tubes.is_empty() {
        return Err(reason.unwrap_or_else(no_tube));
    }
    let (tube, warnings) = choose(tubes, nominal)?;
    if tube.closed {
        return Err(ReconstructError::Ring { length_mm: tube.solid_mm });
    }
    Ok(finish(cloud, &rest, tube, faces, warnings))
}

/// Planar faces of the moderate cloud.
fn planes(whole: &Moderate) -> Vec<Face> {
    let points: Vec<Point3<f64>> = whole.cloud.iter().collect();
    find_planes(&points, whole.spacing_mm)
}

/// The moderate cloud without the faces; taken anew from the whole cloud when they were most of it.
fn without(cloud: &PointCloud, whole: &Moderate, faces: &[Face]) -> Moderate {
    if faces.is_empty() {
        return whole.clone();
    }
    let mut on_face = vec![false; whole.cloud.len()];
    faces.iter().flat_map(|f| &f.points).for_each(|&i| on_face[i as usize] = true);
    let kept: Vec<usize> = (0..on_face.len()).filter(|&i| !on_face[i]).collect();
    if 2 * kept.len() < whole.cloud.len() && whole.cloud.len() < cloud.len() {
        return moderate(&off_faces(cloud, faces));
    }
    Moderate { cloud: whole.cloud.select(&kept), spacing_mm: whole.spacing_mm }
}

/// The points that lie on none of the faces' planes.
fn off_faces(cloud: &PointCloud, faces: &[Face]) -> PointCloud {
    let share = any_share(cloud, MOST_LOOKED_AT);
    let kept: Vec<usize> =
        (0..share.len()).filter(|&i| !faces.iter().any(|f| f.holds(&share.point(i)))).collect();
    share.select(&kept)
}

/// The cloud without faces as the spine's reconstruction wants it for a radius.
fn at_radius(cloud: &PointCloud, rest: &Moderate, faces: &[Face], candidate: &Candidate) -> PointCloud {
    let cell = WORK_CELL_RADII * candidate.radius_mm;
    let coarse = rest.spacing_mm > COARSEST_RADII * candidate.radius_mm && rest.cloud.len() < cloud.len() / 2;
    if coarse { off_faces(cloud, faces).thinned(cell) } else { rest.cloud.thinned(cell) }
}

/// Centre lines of one radius, the longest first.
fn chains(spine: &[SpinePoint], radius_mm: f64) -> Vec<Vec<Point3<f64>>> {
    let spacing = SPINE_SPACING_RADII * radius_mm;
    let chains = crust::connect(&mls::condense(spine, spacing), spacing, radius_mm);
    let sound = |chain| {
        let trimmed = |chain| crust::trimmed(chain, spacing, radius_mm);
        let chain = trimmed(crust::without_scraps(chain, spacing, radius_mm));
        // What was within may now be a scrap at an end.
        trimmed(crust::opened(chain, spacing, radius_mm))
    };
    chains.into_iter().map(sound).collect()
}

/// What is missing where a radius is sure and no tube was found with it.
fn too_little(
    work: &PointCloud,
    spine: &[SpinePoint],
    chains: &[Vec<Point3<f64>>],
    spacing_mm: f64,
    radius_mm: f64,
) -> Option<ReconstructError> {
    let wanted_mm = COARSEST_RADII * radius_mm;
    if spacing_mm > wanted_mm {
        let (found, points) = (spine.len(), work.len());
        return Some(ReconstructError::TooSparse { found, points, radius_mm, wanted_mm });
    }
    let lengths_mm = chains.iter().map(|c| crust::solid_length_mm(c, SPINE_SPACING_RADII * radius_mm));
    let seen_mm = lengths_mm.fold(0.0, f64::max);
    let wanted_mm = LEAST_LENGTH_RADII * radius_mm;
    // Less than a radius is any curved corner.
    (radius_mm..wanted_mm).contains(&seen_mm).then_some(ReconstructError::TooShort {
        seen_mm,
        radius_mm,
        wanted_mm,
    })
}

/// The tubes that have these centre lines.
fn tubes_of(work: &PointCloud, chains: &[Vec<Point3<f64>>], radius_mm: f64) -> Vec<Tube> {
    let spacing = SPINE_SPACING_RADII * radius_mm;
    chains
        .iter()
        .filter(|c| crust::solid_length_mm(c, spacing) >= LEAST_LENGTH_RADII * radius_mm)
        .filter_map(|polygon| {
            let around = Surroundings::new(polygon, radius_mm);
            let on = on_surface(&around, radius_mm, work)?;
            Some(Tube {
                radius_mm,
                around,
                solid_mm: crust::solid_length_mm(polygon, spacing),
                area_mm2: on as f64 * (WORK_CELL_RADII * radius_mm).powi(2),
                closed: crust::is_closed(polygon, spacing, radius_mm),
                polygon: polygon.clone(),
            })
        })
        .collect()
}

/// Points that lie on the tube's surface; None when too many around the centre line do not.
fn on_surface(around: &Surroundings, radius_mm: f64, work: &PointCloud) -> Option<usize> {
    let distance = |i: usize| around.distance_mm(&work.point(i));
    let distances: Vec<f64> = all_of(work).filter_map(distance).collect();
    let near = distances.iter().filter(|d| **d < 1.5 * radius_mm).count();
    let on = distances.iter().filter(|d| (**d - radius_mm).abs() < SURFACE_SHARE * radius_mm).count();
    (on as f64 >= LEAST_ON_SURFACE * near as f64).then_some(on)
}

/// Adds a tube. Where it is one that was found with another radius, the better one stays: a narrow view of a tube also
/// looks like one of another radius, but with fewer points exactly on its surface.
fn keep_apart(tubes: &mut Vec<Tube>, tube: Tube, cloud: &PointCloud, exact_mm: f64) {
    let same = |t: &Tube| {
        let inside = tube.polygon.iter().filter(|p| t.around.is_near(p)).count();
        2 * inside > tube.polygon.len()
    };
    match tubes.iter_mut().find(|t| same(t)) {
        None => tubes.push(tube),
        Some(known) if exactly_on(&tube, cloud, exact_mm) > exactly_on(known, cloud, exact_mm) => {
            *known = tube
        }
        Some(_) => (),
    }
}

/// Number of the cloud's points that lie on a tube's surface to about their noise.
fn exactly_on(tube: &Tube, cloud: &PointCloud, exact_mm: f64) -> usize {
    let on = |i: &usize| {
        let distance = tube.around.distance_mm(&cloud.point(*i));
        distance.is_some_and(|d| (d - tube.radius_mm).abs() < exact_mm)
    };
    all_of(cloud).filter(on).count()
}

/// The indices of a cloud's points, for several threads to look at.
fn all_of(cloud: &PointCloud) -> impl IndexedParallelIterator<Item = usize> {
    (0..cloud.len()).into_par_iter().with_min_len(512)
}

/// The tube that is wanted, and a warning when there are others.
fn choose(mut tubes: Vec<Tube>, nominal: Option<&Nominal>) -> Result<(Tube, Vec<String>), ReconstructError> {
    tubes.sort_by(|a, b| b.area_mm2.total_cmp(&a.area_mm2));
    let largest = tubes[0].area_mm2;
    tubes.retain(|t| t.area_mm2 >= SECOND_TUBE_SHARE * largest);
    let lengths_mm: Vec<f64> = tubes.iter().map(|t| t.solid_mm).collect();
    if tubes.len() > MOST_TUBES && nominal.is_none() {
        return Err(ReconstructError::SeveralTubes { lengths_mm });
    }
    let wanted = nominal.map_or(0, |part| {
        let unlike = |t: &Tube| {
            let other = if part.is_other_tube(t.radius_mm) { 10.0 } else { 0.0 };
            other + (t.solid_mm / part.lra.developed_length_mm()).ln().abs()
        };
        (0..tubes.len()).min_by(|&a, &b| unlike(&tubes[a]).total_cmp(&unlike(&tubes[b]))).unwrap_or(0)
    });
    let mut warnings = Vec::new();
    if lengths_mm.len() > 1 {
        let list: Vec<String> = lengths_mm.iter().map(|l| format!("{l:.0} mm")).collect();
        let which = if nominal.is_some() { "most like the nominal" } else { "largest" };
        warnings.push(format!(
            "the scan shows {} separate tubes (centre lines of {}), or one with long stretches hidden; measured \
            is the {which}, of {:.0} mm",
            list.len(),
            list.join(", "),
            lengths_mm[wanted]
        ));
    }
    Ok((tubes.swap_remove(wanted), warnings))
}

/// Tells the tube's points from the others.
fn finish(cloud: &PointCloud, rest: &Moderate, tube: Tube, faces: Vec<Face>, warnings: Vec<String>) -> Scene {
    let Tube { radius_mm, polygon, around, .. } = tube;
    let vertices = polygon.len();
    let (polygon, hidden) = reach::drawn_on(polygon, SPINE_SPACING_RADII * radius_mm, radius_mm, &rest.cloud);
    let same = polygon.len() == vertices;
    let around = if same { around } else { Surroundings::new(&polygon, radius_mm) };
    let near: Vec<usize> = all_of(&rest.cloud).filter(|&i| around.is_near(&rest.cloud.point(i))).collect();
    // Thinning makes strays many: their share is that among any points.
    let some = any_share(cloud, SOME_POINTS);
    let strays = all_of(&some).filter(|&i| !around.is_near(&some.point(i))).count();
    let alone = faces.is_empty() && strays as f64 <= STRAY_SHARE * some.len() as f64;
    let own = (!alone).then(|| around.own_points(cloud, &faces));
    let coarse = rest.spacing_mm > COARSEST_RADII * radius_mm;
    let thin = match &own {
        Some(own) if coarse || !faces.is_empty() => {
            let run = own.len().div_ceil(MOST_LOOKED_AT / 5).max(1);
            let own: Vec<usize> = own.iter().step_by(run).map(|&i| i as usize).collect();
            cloud.select(&own)
        }
        _ => rest.cloud.select(&near),
    };
    Scene { radius_mm, polygon, hidden, thin, own, faces, warnings }
}
