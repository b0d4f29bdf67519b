//! Sweeping the laser line: passes, stripes, rays, and what spoils them.
//!
//! A pass looks in one direction (wavering a little, as a hand does); its stripes lie across the tube's long
//! direction at irregular distances. Each stripe draws from a random stream of its own, so threads change nothing.

use std::f64::consts::PI;

use nalgebra::{Isometry3, Point3, Rotation3, Translation3, Unit, UnitQuaternion, Vector3};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use rayon::prelude::*;

use super::solid::{Cast, Chunk, Ray};
use super::{Density, PointKind, ScanSettings, Scene, UnseenEnd};
use crate::tube::Spine;

/// Stripes lie wider apart than the points of one stripe.
const BETWEEN_PER_ALONG: f64 = 1.5;
/// Share of a tube's silhouette that is steep enough to the light to be kept, on average.
const KEPT_SHARE: f64 = 0.93;
/// The hand wavers by this angle about each axis.
const WAVER_RAD: f64 = 0.05;
/// Noise at grazing incidence is capped at this many times that at normal incidence.
const MOST_NOISE: f64 = 3.0;
/// With a table, passes tilt by no more than this from upright.
const STEEPEST_PASS_RAD: f64 = 0.96;
/// Points around the tube that are scanned with it, in tube radii.
const MARGIN_RADII: f64 = 1.5;
/// Radius of the largest patch without data, in tube radii.
const LARGEST_PATCH_RADII: f64 = 1.5;

/// A point and what it is.
pub(super) type Hit = (Point3<f64>, PointKind);

/// One pass of the arm.
struct Pass {
    /// Direction of sight.
    sight: Vector3<f64>,
    /// Along the stripes.
    across: Vector3<f64>,
    /// From stripe to stripe.
    advance: Vector3<f64>,
    /// Phases of the hand's wavering.
    phases: [f64; 4],
    /// Displacement of the whole pass.
    drift: Isometry3<f64>,
    seed: [u8; 32],
}

/// A disc of the surface without data.
struct Patch {
    centre: Point3<f64>,
    radius_mm: f64,
}

/// The plane across an end straight beyond which nothing was scanned.
struct Window<'a> {
    spine: &'a Spine,
    segment: usize,
    at: Point3<f64>,
    outward: Vector3<f64>,
}

impl<'a> Window<'a> {
    fn new(end: &UnseenEnd, spine: &'a Spine) -> Window<'a> {
        let length_mm = spine.length_mm();
        let (mm, sign, segment) = match end.last {
            true => (length_mm - end.unseen_mm, 1.0, spine.segments().len() - 1),
            false => (end.unseen_mm, -1.0, 0),
        };
        let frame = spine.frame_at(mm);
        let tilted = Rotation3::from_axis_angle(&Vector3::z_axis(), end.tilt_rad) * Vector3::x();
        let outward = frame.rotation * tilted * sign;
        Window { spine, segment, at: frame.translation.vector.into(), outward }
    }

    /// Whether a point is beyond it. Other legs may reach beyond the plane.
    fn hides(&self, p: &Point3<f64>) -> bool {
        (p - self.at).dot(&self.outward) > 0.0 && self.spine.closest(p).segment == self.segment
    }
}

/// Where a chunk of the tube is met by a stripe: from, to, and the piece it belongs to.
type Span = (f64, f64, usize);

/// What all stripes of a scan share.
struct Sweep<'a> {
    scene: &'a Scene,
    settings: &'a ScanSettings,
    chunks: Vec<Chunk>,
    patches: Vec<Patch>,
    window: Option<Window<'a>>,
    along_mm: f64,
    between_mm: f64,
}

/// All passes one after the other, in the tube's own coordinates.
pub(super) fn all_passes(
    scene: &Scene,
    settings: &ScanSettings,
    spine: &Spine,
    rng: &mut ChaCha8Rng,
) -> Vec<Hit> {
    let passes: Vec<Pass> = (0..settings.views).map(|k| pass(scene, settings, k, rng)).collect();
    let patches = (0..settings.missing_patches).map(|_| patch(scene, spine, rng)).collect();
    let (along_mm, between_mm) = spacing(scene, settings, spine, &passes);
    let chunks = scene.solid.chunks(spine);
    if chunks.is_empty() || !(along_mm * between_mm).is_normal() {
        return Vec::new();
    }
    let window = settings.unseen_end.as_ref().map(|end| Window::new(end, spine));
    let sweep = Sweep { scene, settings, chunks, patches, window, along_mm, between_mm };
    passes.iter().flat_map(|p| sweep.pass(p)).collect()
}

fn pass(scene: &Scene, settings: &ScanSettings, k: usize, rng: &mut ChaCha8Rng) -> Pass {
    let turn = match settings.views {
        1 => 0.0,
        n if settings.table => STEEPEST_PASS_RAD * (2.0 * k as f64 / (n - 1) as f64 - 1.0),
        n => 2.0 * PI * k as f64 / n as f64,
    };
    let sight = Rotation3::from_axis_angle(&Unit::new_normalize(scene.long), turn) * -scene.up;
    let level = scene.long - sight * sight.dot(&scene.long);
    // Looking along the tube: any direction across the sight will do.
    let level = level.try_normalize(1e-6).unwrap_or_else(|| any_across(&sight));
    let yaw = rng.random_range(-0.35..0.35);
    let advance = Rotation3::from_axis_angle(&Unit::new_normalize(sight), yaw) * level;
    let mut normal = || rng.sample::<f64, _>(StandardNormal) * settings.pass_drift_mm;
    let shift = Translation3::new(normal(), normal(), normal());
    // A turn that moves the tube's ends about as far as the shift does.
    let turn = UnitQuaternion::new(Vector3::new(normal(), normal(), normal()) / scene.reach_mm);
    let about = Isometry3::rotation_wrt_point(turn, scene.centre);
    let drift = if k == 0 { Isometry3::identity() } else { shift * about };
    let phases = std::array::from_fn(|_| rng.random_range(0.0..2.0 * PI));
    Pass { sight, across: sight.cross(&advance), advance, phases, drift, seed: rng.random() }
}

/// A unit vector at right angles to a unit vector.
fn any_across(v: &Vector3<f64>) -> Vector3<f64> {
    let least = if v.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() };
    v.cross(&least).normalize()
}

/// A patch on the side that faces the first pass.
fn patch(scene: &Scene, spine: &Spine, rng: &mut ChaCha8Rng) -> Patch {
    let r = scene.solid.radius_mm();
    // Clear of the ends: where the tube ends must not be hidden.
    let margin_mm = (LARGEST_PATCH_RADII * r).min(spine.length_mm() / 2.0);
    let room_mm = spine.length_mm() - 2.0 * margin_mm;
    let frame = spine.frame_at(margin_mm + rng.random_range(0.0..=1.0) * room_mm);
    let tangent = frame.rotation * Vector3::x_axis();
    let facing = scene.up - *tangent * tangent.dot(&scene.up);
    let facing = facing.try_normalize(1e-6).unwrap_or_else(|| any_across(&tangent));
    let turned = Rotation3::from_axis_angle(&tangent, rng.random_range(-1.0..1.0)) * facing;
    let centre = Point3::from(frame.translation.vector) + turned * r;
    Patch { centre, radius_mm: r * rng.random_range(0.4..LARGEST_PATCH_RADII) }
}

/// Steps along and between stripes.
fn spacing(scene: &Scene, settings: &ScanSettings, spine: &Spine, passes: &[Pass]) -> (f64, f64) {
    match settings.density {
        Density::Spacing { along_mm, between_mm } => (along_mm, between_mm),
        Density::Points(wanted) => {
            let r = scene.solid.radius_mm();
            let steps = spine.sampled(r);
            let length = |pass: &Pass| -> f64 {
                steps.windows(2).map(|w| (w[1] - w[0]).cross(&pass.sight).norm()).sum()
            };
            // Seen end on, a tube still shows something.
            let area = passes.iter().map(|p| 2.0 * r * (length(p) + r)).sum::<f64>() * KEPT_SHARE;
            let along_mm = (area / wanted.max(1) as f64 / BETWEEN_PER_ALONG).sqrt();
            (along_mm, along_mm * BETWEEN_PER_ALONG)
        }
    }
}

impl Sweep<'_> {
    fn pass(&self, pass: &Pass) -> Vec<Hit> {
        let mut rng = ChaCha8Rng::from_seed(pass.seed);
        let reach = self.scene.reach_mm + self.margin_mm();
        let mut stripes = Vec::new();
        let mut at = -reach + self.between_mm * rng.random::<f64>();
        while at < reach {
            stripes.push(at);
            at += self.between_mm * rng.random_range(0.6..1.4);
        }
        let hits: Vec<Vec<Hit>> = stripes
            .par_iter()
            .enumerate()
            .map(|(k, at)| {
                let mut rng = ChaCha8Rng::from_seed(pass.seed);
                rng.set_stream(k as u64 + 1);
                self.stripe(pass, *at, &mut rng)
            })
            .collect();
        hits.into_iter().flatten().map(|(p, kind)| (pass.drift * p, kind)).collect()
    }

    /// How far around the tube the light goes: only with something to meet there.
    fn margin_mm(&self) -> f64 {
        if self.scene.props.is_empty() { 0.0 } else { MARGIN_RADII * self.scene.solid.radius_mm() }
    }

    fn stripe(&self, pass: &Pass, at: f64, rng: &mut ChaCha8Rng) -> Vec<Hit> {
        let direction = self.wavering(pass, at);
        let mut spans = self.spans(pass, at, &direction);
        spans.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.2.cmp(&b.2)));
        let base = self.scene.centre + pass.advance * at - direction * (4.0 * self.scene.reach_mm);
        let phase = rng.random::<f64>();
        let mut hits = Vec::new();
        let mut pieces = Vec::new();
        // The grid's next free place: overlapping spans share their rays.
        let mut next = f64::NEG_INFINITY;
        for (i, &(from, to, _)) in spans.iter().enumerate() {
            let mut place = (from / self.along_mm - phase).ceil().max(next);
            while (place + phase) * self.along_mm <= to {
                let s = (place + phase + 0.1 * (rng.random::<f64>() - 0.5)) * self.along_mm;
                pieces_at(&spans, i, s, &mut pieces);
                let ray = Ray { origin: base + pass.across * s, direction };
                hits.extend(self.measure(&ray, &pieces, rng));
                place += 1.0;
            }
            next = next.max(place);
        }
        hits
    }

    /// The direction of light of the stripe at `at`: smooth along the pass.
    fn wavering(&self, pass: &Pass, at: f64) -> Vector3<f64> {
        let x = at / self.scene.reach_mm;
        let wave = |i: usize| (2.3 * x + pass.phases[i]).sin() + 0.5 * (7.1 * x + pass.phases[i + 1]).sin();
        let sideways = (pass.across * wave(0) + pass.advance * wave(2)) * (WAVER_RAD / 1.5);
        (pass.sight + sideways).normalize()
    }

    /// Where the stripe meets the chunks' balls, seen along the light.
    fn spans(&self, pass: &Pass, at: f64, direction: &Vector3<f64>) -> Vec<Span> {
        let stretch = 1.0 / direction.dot(&pass.sight);
        let span = |chunk: &Chunk| {
            let from = chunk.centre - self.scene.centre;
            let seen = from - direction * (from.dot(&pass.sight) * stretch);
            let reach = (chunk.radius_mm + self.margin_mm()) * stretch;
            let off = seen.dot(&pass.advance) - at;
            let half = (reach * reach - off * off).max(0.0).sqrt();
            let middle = seen.dot(&pass.across);
            (half > 0.0).then_some((middle - half, middle + half, chunk.piece))
        };
        self.chunks.iter().filter_map(span).collect()
    }

    /// One ray: the point that the scanner reports, if any.
    fn measure(&self, ray: &Ray, pieces: &[usize], rng: &mut ChaCha8Rng) -> Option<Hit> {
        let prop = self.scene.props.iter().filter_map(|p| p.entry(ray)).min_by(|a, b| a.0.total_cmp(&b.0));
        let limit = prop.map_or(8.0 * self.scene.reach_mm, |p| p.0);
        let (t, cosine, kind) = match self.scene.solid.cast(ray, pieces, limit) {
            Cast::Outside { t, cosine } if t < limit => (t, cosine, PointKind::Tube),
            Cast::Blocked(_) => return None,
            _ => prop.map(|(t, cosine)| (t, cosine, PointKind::Surroundings))?,
        };
        let ideal = ray.at(t);
        let on_patch = |p: &Patch| (ideal - p.centre).norm() < p.radius_mm;
        let patched = kind == PointKind::Tube && self.patches.iter().any(on_patch);
        let hidden = self.window.as_ref().is_some_and(|w| w.hides(&ideal));
        if patched || hidden || rng.random::<f64>() < self.lost_share(cosine) {
            return None;
        }
        if rng.random::<f64>() < self.settings.outlier_share {
            return Some((ray.at(t + self.flight_mm(rng)), PointKind::Outlier));
        }
        let noise_mm = self.settings.noise_mm * (1.0 / cosine).min(MOST_NOISE);
        Some((ray.at(t + noise_mm * rng.sample::<f64, _>(StandardNormal)), kind))
    }

    /// Share of light lost at a cosine of incidence: none up to three quarters of the limit, all from it on.
    fn lost_share(&self, cosine: f64) -> f64 {
        let incidence = (1.0 - cosine * cosine).max(0.0).sqrt().atan2(cosine);
        let limit = self.settings.incidence_limit_rad;
        let x = ((incidence / limit - 0.75) / 0.25).max(0.0);
        if incidence > limit { 1.0 } else { x * x }
    }

    /// How far a flying point is off along its ray: mostly about a tube radius, some far away.
    fn flight_mm(&self, rng: &mut impl Rng) -> f64 {
        if rng.random::<f64>() < 0.1 {
            return self.scene.reach_mm * rng.random_range(-1.0..1.0);
        }
        let away = -self.scene.solid.radius_mm() * (1.0 - rng.random::<f64>()).ln();
        if rng.random() { away } else { -away }
    }
}

/// The pieces whose spans hold `s`, each once. Spans are sorted by their beginning and `from` is one that
/// holds `s`; earlier ones may too.
fn pieces_at(spans: &[Span], from: usize, s: f64, out: &mut Vec<usize>) {
    out.clear();
    let near = |span: &&Span| span.0 <= s && s <= span.1;
    let later = spans[from..].iter().take_while(|span| span.0 <= s);
    for span in spans[..from].iter().chain(later).filter(near) {
        if !out.contains(&span.2) {
            out.push(span.2);
        }
    }
}
