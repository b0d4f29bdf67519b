//! Hard scans: random tubes with all that spoils real scans, each nuisance drawn by itself: passes that disagree,
//! flying points, patches without data, table, V-blocks, jaws, oval bends, walls, oblique ends, burrs, an end that was
//! not scanned, few and many points, every kind of file.
//!
//! Left out, besides what `random_tube` leaves out, is what no data could tell (see [`random_scene`]).

use std::f64::consts::PI;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{SHALLOW_RAD, Specimen, log_uniform, random_tube};
use crate::sim::scan::{Burr, Density, EndShape, Jaws, PointKind, ScanSettings, TubeShape, UnseenEnd, scan};
use crate::sim::scan_file::ScanFile;
use crate::tube::Lra;

/// A tube, how it is scanned, and the file that the scan comes in.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// The tube and how it is scanned.
    pub tube: Specimen,
    /// The kind of scan file; None where the scan is taken from memory.
    pub file: Option<ScanFile>,
}

/// Points of the largest scans.
const MOST_POINTS: f64 = 2e6;
/// Around the tube come so many times its points from a table.
const TABLE_SHARE: f64 = 3.0;
/// The coarsest spacing of one pass, in tube radii.
const COARSEST: f64 = 0.2;
/// What is left of an end straight that was not scanned to its end, at least, in tube radii.
const LEAST_STUB_RADII: f64 = 3.2;
/// The most oblique cut.
const MOST_OBLIQUE_RAD: f64 = 15.0 * PI / 180.0;
/// The highest burr.
const MOST_BURR_MM: f64 = 0.5;
/// A shallow bend must move its straights by so many times the passes' disagreement.
const ABOVE_DRIFT: f64 = 2.0;

/// Draws one scene; `scan` it with the same seed. Drawn again is what no data could tell:
///
/// - a stretch of a diameter along the tube without any point, a bend of which less than half is seen, or an end
///   without points (but for the one that was not scanned): hidden by table, blocks, jaws, patches, other legs;
/// - a bend below [`SHALLOW_RAD`] that bends its straights by less than twice the passes' disagreement.
///
/// Patches keep clear of the ends, points lie no farther apart than 0.2 radii in each pass, and of an end straight that
/// was not scanned to its end 1.6 diameters are left.
pub fn random_scene(seed: u64) -> Scene {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    // Not the tubes of `random_tube` once more.
    rng.set_stream(1);
    loop {
        let scene = draw(&mut rng);
        if stands_out(&scene.tube) && is_seen(&scene.tube, seed) {
            return scene;
        }
    }
}

fn draw(rng: &mut ChaCha8Rng) -> Scene {
    let Specimen { shape, settings, common_clr } = random_tube(rng.random());
    let oval = rng.random_bool(0.5);
    let bends = shape.lra.bends.len();
    let ovality = (0..bends).map(|_| if oval { rng.random_range(0.0..0.05) } else { 0.0 }).collect();
    let wall_mm = if rng.random_bool(0.7) { shape.od_mm * rng.random_range(0.03..0.12) } else { 0.0 };
    let ends = [end_shape(rng, shape.od_mm), end_shape(rng, shape.od_mm)];
    let shape = TubeShape { ovality, wall_mm, ends, ..shape };
    let views = rng.random_range(1..=4);
    let table = rng.random_bool(0.5);
    let drift = rng.random_range(0.02..0.08);
    let many_outliers = rng.random_bool(0.5);
    let patches = rng.random_bool(0.5);
    let settings = ScanSettings {
        density: Density::Points(points(rng, &shape, views, table)),
        views,
        pass_drift_mm: if views > 1 { drift } else { 0.0 },
        outlier_share: rng.random_range(0.0..if many_outliers { 0.05 } else { 0.01 }),
        missing_patches: if patches { rng.random_range(1..=6) } else { 0 },
        table,
        v_blocks: rng.random_bool(0.3),
        jaws: [None, None, Some(Jaws::Grip), Some(Jaws::Flat)][rng.random_range(0..4)],
        unseen_end: rng.random_bool(0.25).then(|| unseen_end(rng, &shape)).flatten(),
        ..settings
    };
    let file = Some(ScanFile::ALL[rng.random_range(0..ScanFile::ALL.len())]);
    Scene { tube: Specimen { shape, settings, common_clr }, file }
}

/// Half are cut square; the others up to 15 degrees off. One in four has a burr, of 0.5 mm at most.
fn end_shape(rng: &mut ChaCha8Rng, od_mm: f64) -> EndShape {
    let (oblique, cut_rad, longest_rad) =
        (rng.random_bool(0.5), rng.random_range(0.0..MOST_OBLIQUE_RAD), rng.random_range(-PI..PI));
    let burr = rng.random_bool(0.25).then(|| Burr {
        height_mm: (od_mm * rng.random_range(0.005..0.03)).min(MOST_BURR_MM),
        from_rad: rng.random_range(-PI..PI),
        over_rad: rng.random_range(0.5..4.0),
    });
    EndShape { cut_rad: if oblique { cut_rad } else { 0.0 }, longest_rad, burr }
}

/// 3 000 to 200 000 points, of one scan in twenty up to two million; never so few that they lie too far apart.
fn points(rng: &mut ChaCha8Rng, shape: &TubeShape, views: usize, table: bool) -> usize {
    let wanted = match rng.random_bool(0.05) {
        true => log_uniform(rng, 2e5, MOST_POINTS),
        false => log_uniform(rng, 3e3, 2e5),
    };
    let least = 2.0 * shape.lra.developed_length_mm() / (shape.od_mm / 2.0 * COARSEST * COARSEST);
    let most = if table { MOST_POINTS / (1.0 + TABLE_SHARE) } else { MOST_POINTS };
    wanted.max(least * views as f64).min(most) as usize
}

/// A window that ends before the tube does; None where neither end straight is long enough.
fn unseen_end(rng: &mut ChaCha8Rng, shape: &TubeShape) -> Option<UnseenEnd> {
    let ends = [shape.lra.bends.first().map_or(0.0, |b| b.length_mm), shape.lra.last_length_mm];
    let last = rng.random_bool(0.5);
    let (share, tilt, oblique) =
        (rng.random_range(0.2..0.6), rng.random_range(-0.7..0.7), rng.random_bool(0.5));
    let fits = |last: bool| ends[usize::from(last)] * 0.4 > LEAST_STUB_RADII * shape.od_mm / 2.0;
    let last = [last, !last].into_iter().find(|l| fits(*l))?;
    let unseen_mm = share * ends[usize::from(last)];
    Some(UnseenEnd { last, unseen_mm, tilt_rad: if oblique { tilt } else { 0.0 } })
}

/// Whether every shallow bend shows above the passes' disagreement.
fn stands_out(tube: &Specimen) -> bool {
    let Lra { bends, last_length_mm } = &tube.shape.lra;
    bends.iter().enumerate().filter(|(_, b)| b.angle_rad < SHALLOW_RAD).all(|(i, b)| {
        let after = bends.get(i + 1).map_or(*last_length_mm, |next| next.length_mm);
        // Both straights against the line that lies closest to them.
        b.angle_rad * b.length_mm.min(after) / 4.0 >= ABOVE_DRIFT * tube.settings.pass_drift_mm
    })
}

/// Whether the scan shows enough of the tube: a coarse scan of the same scene tells.
fn is_seen(tube: &Specimen, seed: u64) -> bool {
    let r = tube.shape.od_mm / 2.0;
    let bins_per_radius = 2.0;
    let length_mm = tube.shape.lra.developed_length_mm();
    let wanted = 60.0 * length_mm / r * tube.settings.views as f64;
    let Density::Points(points) = tube.settings.density else { return true };
    let density = Density::Points(points.min(wanted as usize));
    let got = scan(&tube.shape, &ScanSettings { density, pass_drift_mm: 0.0, ..tube.settings.clone() }, seed);
    let count = (bins_per_radius * length_mm / r).ceil() as usize;
    let bin = |mm: f64| ((mm / length_mm * count as f64) as usize).min(count - 1);
    let mut seen = vec![false; count];
    for (p, _) in got.points.iter().zip(&got.kinds).filter(|(_, kind)| **kind == PointKind::Tube) {
        seen[bin(got.spine.closest(p).arc_length_mm)] = true;
    }
    let (mut from, mut to) = (0.0, length_mm);
    match tube.settings.unseen_end {
        Some(UnseenEnd { last: true, unseen_mm, .. }) => to -= unseen_mm + r,
        Some(UnseenEnd { last: false, unseen_mm, .. }) => from += unseen_mm + r,
        None => {}
    }
    let scanned = &seen[bin(from)..=bin(to)];
    let hidden = scanned.split(|s| *s).map(<[bool]>::len).max().unwrap_or(0);
    let bends_seen = got.spine.segments().iter().skip(1).step_by(2).all(|arc| {
        let bend = &seen[bin(arc.start_mm)..=bin(arc.start_mm + arc.length_mm)];
        2 * bend.iter().filter(|s| **s).count() >= bend.len()
    });
    let ends_seen = scanned.first() == Some(&true) && scanned.last() == Some(&true);
    hidden as f64 <= 2.0 * bins_per_radius && bends_seen && ends_seen
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tube::Bend;
    use nalgebra::Vector3;

    #[test]
    fn the_hard_population_is_as_described() {
        let all: Vec<Scene> = (0..60).map(random_scene).collect();
        let share = |wanted: fn(&ScanSettings) -> bool| {
            all.iter().filter(|s| wanted(&s.tube.settings)).count() as f64 / all.len() as f64
        };
        assert!((0.3..0.7).contains(&share(|s| s.table)), "table {}", share(|s| s.table));
        assert!((0.1..0.5).contains(&share(|s| s.v_blocks)), "V-blocks {}", share(|s| s.v_blocks));
        assert!(share(|s| s.jaws == Some(Jaws::Grip)) > 0.1 && share(|s| s.jaws == Some(Jaws::Flat)) > 0.1);
        assert!(share(|s| s.outlier_share > 0.02) > 0.1 && share(|s| s.missing_patches > 2) > 0.1);
        assert!(share(|s| s.unseen_end.is_some()) > 0.05, "{}", share(|s| s.unseen_end.is_some()));
        for views in 1..=4 {
            let of = |s: &&Scene| s.tube.settings.views == views;
            assert!(all.iter().filter(of).count() > 5, "{views} views");
        }
        for file in ScanFile::ALL {
            assert!(all.iter().any(|s| s.file == Some(file)), "{file:?}");
        }
        let with = |wanted: fn(&TubeShape) -> bool| all.iter().filter(|s| wanted(&s.tube.shape)).count();
        assert!(with(|s| s.wall_mm > 0.0) > 25 && with(|s| s.wall_mm == 0.0) > 5);
        assert!(with(|s| s.ends.iter().any(|e| e.burr.is_some())) > 10, "burrs");
        assert!(with(|s| s.ends.iter().any(|e| e.cut_rad > 0.05)) > 10, "oblique ends");
        let mut large = 0;
        for Specimen { shape, settings, .. } in all.iter().map(|s| &s.tube) {
            let Density::Points(points) = settings.density else { panic!("points expected") };
            assert!((3_000..=2_000_000).contains(&points));
            large += usize::from(points > 200_000);
            assert!(shape.ovality.iter().all(|o| (0.0..0.05).contains(o)));
            assert!(settings.outlier_share < 0.05);
            let drifting = if settings.views > 1 { 0.02..0.08 } else { 0.0..f64::MIN_POSITIVE };
            assert!(drifting.contains(&settings.pass_drift_mm));
            if let Some(end) = settings.unseen_end {
                let first = shape.lra.bends[0].length_mm;
                let straight = if end.last { shape.lra.last_length_mm } else { first };
                assert!(straight - end.unseen_mm > 1.5 * shape.od_mm);
            }
        }
        assert!((1..15).contains(&large), "{large} large scans");
    }

    #[test]
    fn a_seed_is_a_scene_and_not_a_tube_of_the_other_population() {
        assert_eq!(random_scene(3), random_scene(3));
        assert_ne!(random_scene(3), random_scene(4));
        assert_ne!(random_scene(3).tube.shape.lra, random_tube(3).shape.lra);
    }

    /// A hairpin whose legs lie 100 mm apart in y, and a shallow bend after it.
    fn hairpin(sight: Vector3<f64>) -> Specimen {
        let bend = |length_mm, angle_rad| Bend { length_mm, rotation_rad: 0.0, angle_rad, radius_mm: 50.0 };
        let lra = Lra { bends: vec![bend(200.0, PI), bend(100.0, 0.05)], last_length_mm: 80.0 };
        let settings = ScanSettings { sight: Some(sight), ..ScanSettings::default() };
        Specimen { shape: TubeShape::round(lra, 20.0), settings, common_clr: true }
    }

    #[test]
    fn what_hides_a_part_of_the_tube_is_drawn_again() {
        let broad = hairpin(Vector3::z());
        assert!(is_seen(&broad, 1));
        assert!(!is_seen(&hairpin(Vector3::y()), 1), "one leg behind the other");
        let with = |settings: ScanSettings| Specimen { settings, ..broad.clone() };
        let grip = ScanSettings { jaws: Some(Jaws::Grip), ..broad.settings.clone() };
        assert!(is_seen(&with(grip), 1), "jaws leave a gap");
        // An end that is meant to be unseen does not count as hidden, more than that does.
        let end = |unseen_mm| {
            let unseen_end = Some(UnseenEnd { last: true, unseen_mm, tilt_rad: 0.0 });
            ScanSettings { unseen_end, ..broad.settings.clone() }
        };
        assert!(is_seen(&with(end(40.0)), 1));
    }

    #[test]
    fn a_shallow_bend_stands_out_of_the_drift() {
        let mut tube = hairpin(Vector3::z());
        // 0.05 rad beside 80 mm: 1 mm.
        for (drift, expected) in [(0.0, true), (0.499, true), (0.501, false)] {
            tube.settings.pass_drift_mm = drift;
            assert_eq!(stands_out(&tube), expected, "{drift}");
        }
    }
}
