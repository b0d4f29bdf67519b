//! The measured centre line: what the points of every short stretch say of the tube's section there.
//!
//! Between the points and the search for the structure. The points of a section determine at most five values: the
//! radius, the centre's place across the tube and how oval the section is. A tube that lies within a fraction of its radius of the
//! base line predicts these five, so a structure can be fitted and judged on the sections alone, without its points: a
//! hundred times cheaper, and nothing is lost that a small change of the tube could show (the sums are sufficient
//! statistics of the linearised residuals). The noise comes out of the sections' own scatter, whatever the structure.

use nalgebra::{Matrix2, Matrix5, Point3, SMatrix, Vector2, Vector3};
use rayon::prelude::*;

use super::fit::Data;
use super::local::{Local, prepare, settle};
use super::model::TubeModel;
use super::moments::{Moment, OVALITY, OWN_RADIUS, Pass, RESIDUAL, ROWS, TUBE_RADIUS};
use super::section::{
    Bins, JUDGED_POINTS, MEDIAN_CHI2, SPREADS, Sums, VALUES, Values, cost, doubt_ovality, oval_doubt_mm,
    solve,
};
use super::seen::{FIRMNESS, FIRST_CUTOFF, group, middle_mm, offs, scatter, see, straighten, sums};
use super::strangers::{Crowded, Strangers, beset, is_at_an_end, is_oval_untold};
use crate::recognize::{MEDIAN_TO_SIGMA, median};
use crate::tube::{Spine, any_normal};

/// The same about a base that has been fitted, radius and ovality and all.
const FITTED_SPREADS: [f64; VALUES] = [0.002, 0.3, 0.3, 0.004, 0.004];

/// Rounds in which the cut-off comes down to the noise, no faster than by this factor.
const SHRINKS: usize = 6;
const SHRINK: f64 = 0.4;
/// So far from an end, in tube radii, burr, bore and face may reach; a section there that misses the tube's shape so many
/// times more than is usual has some of them; and what its radius and ovality may be off at most, in tube radii.
const DAMAGED_RADII: f64 = 2.0;
const DAMAGED: f64 = 5.0;
/// Before anything was fitted a section there is not the tube's when its radius is off the usual one by so many standard deviations of
/// all sections' radii, and by more than a radius is expected to be.
const OTHER_RADIUS: f64 = 5.0;
/// The outermost sections that hold less than this share of the usual points lie where the tube ends: most of theirs are not of its
/// outside.
const LEAST_FULL: f64 = 0.25;
const TUBES_OWN: f64 = 1e-4;
/// Cut-off of the biweight about the section's own fit, in standard deviations.
const CUTOFF_SIGMAS: f64 = 6.0;

/// Neighbouring sections are taken to follow each other no more than this.
const MOST_FOLLOWING: f64 = 0.9;

/// One short stretch of the tube.
#[derive(Debug, Clone)]
pub struct Section {
    /// A point of the base line.
    centre: Point3<f64>,
    /// Unit directions across the base line there.
    across: [Vector3<f64>; 2],
    sums: Sums,
    /// The base tube's ovality, about which the sums are taken.
    oval_mm: [f64; 2],
    /// Weight of its points.
    count: f64,
    /// Least cost that any values reach.
    least: f64,
}

/// Sections in order along the tube.
#[derive(Debug, Clone)]
pub struct CentreLine {
    sections: Vec<Section>,
    /// Radius of the base tube.
    radius_mm: f64,
    /// Standard deviation of a point about its section.
    pub noise_mm: f64,
    /// Weight of all points.
    pub count: f64,
    /// Where sections were left out because something else was scanned there.
    crowded: Crowded,
    /// Longest stretch between two sections where all were left out.
    silence_mm: f64,
}

impl CentreLine {
    /// A polygon taken as a measured centre line whose points are alike in every direction.
    pub fn of_polygon(polygon: &[Point3<f64>], radius_mm: f64) -> CentreLine {
        let last = polygon.len() - 1;
        let section = |i: usize| {
            let tangent = polygon[(i + 1).min(last)] - polygon[i.saturating_sub(1)];
            let first = any_normal(&tangent);
            let second = tangent.cross(&first).try_normalize(1e-12).unwrap_or(Vector3::z());
            let mut sums = Sums::identity();
            sums[(VALUES, VALUES)] = 0.0;
            Section {
                centre: polygon[i],
                across: [first, second],
                sums,
                oval_mm: [0.0; 2],
                count: 1.0,
                least: 0.0,
            }
        };
        let sections: Vec<Section> = (0..polygon.len()).map(section).collect();
        let count = sections.len() as f64;
        let crowded = Crowded::default();
        CentreLine { sections, radius_mm, noise_mm: 0.01 * radius_mm, count, crowded, silence_mm: 0.0 }
    }

    /// Measures the sections of a tube that lies near `base`: one that the polygon gave, or one that was fitted.
    pub fn measure(points: &[Point3<f64>], base: &TubeModel, fitted: bool) -> CentreLine {
        let spreads = if fitted { FITTED_SPREADS } else { SPREADS }.map(|s| s * base.tube_radius_mm);
        let spine = base.spine();
        let bins = Bins::new(&spine, base.tube_radius_mm, points.len());
        let locals = prepare(base);
        let seen = see(points, base, &locals, &bins);
        let mut grouped = group(seen, bins.total);
        // Near an end burr, bore and face lean, not the tube.
        let inside: Vec<bool> = bins.places_mm().map(|at| !may_be_damaged(base, &spine, at)).collect();
        let mut fits: Vec<Values> = vec![Values::zeros(); grouped.len()];
        let mut cutoff = FIRST_CUTOFF * base.tube_radius_mm;
        let mut noise = 0.1 * cutoff;
        for _ in 0..SHRINKS {
            fits.par_iter_mut().zip(&mut grouped).zip(&inside).for_each(|((fit, seen), inside)| {
                // Weighing, a section must not swing after a flying point where it sees nothing else: held more firmly
                // than the noise asks for.
                *fit = solve(&sums(seen, fit, cutoff), &spreads, FIRMNESS * cutoff);
                if *inside {
                    straighten(seen, fit, cutoff, base.tube_radius_mm);
                }
            });
            noise = scatter(&grouped, &fits, cutoff).max(1e-6);
            cutoff = (CUTOFF_SIGMAS * noise).max(SHRINK * cutoff).min(cutoff);
        }
        let strangers: Vec<Strangers> =
            grouped.iter().zip(&fits).map(|(s, f)| Strangers::among(offs(s, f), cutoff)).collect();
        let beset = beset(&strangers);
        let alone: Vec<bool> = strangers.iter().zip(&beset).map(|(s, b)| !s.are_a_crowd() && !b).collect();
        // What crowds one section reaches into the next, in however few points.
        let among = |i: usize| alone[i.saturating_sub(1)..(i + 2).min(alone.len())].iter().all(|a| *a);
        let nowhere_else = Values::zeros();
        let (mut sections, mut places) = (Vec::new(), Vec::new());
        let (mut heard_mm, mut is_silent, mut silence_mm) = (f64::INFINITY, false, 0.0_f64);
        for (i, ((place, seen), fit)) in bins.places().zip(&grouped).zip(&fits).enumerate() {
            // So few points lie on some section or other, a flying one among them too: that of the base tells which.
            let few = fitted && (seen.len() as f64) < JUDGED_POINTS;
            let mut sums = sums(seen, if few { &nowhere_else } else { fit }, cutoff);
            let count = sums[(0, 0)];
            if count < 1.0 {
                continue;
            }
            let along = middle_mm(seen);
            let segment = &spine.segments()[place];
            let frame = segment.frame_at(along);
            // Before the first fit the radius is a guess: all points may look like strangers.
            let at_mm = segment.start_mm + along;
            let silent = || {
                is_at_an_end(base, &spine, at_mm)
                    || !among(i)
                    || (strangers[i].are_several()
                        && is_oval_untold(base, &spine, (at_mm, bins.length_mm), cutoff))
            };
            if fitted && silent() {
                places.push(frame.translation.vector.into());
                is_silent = true;
                continue;
            }
            if std::mem::take(&mut is_silent) {
                silence_mm = silence_mm.max(at_mm - heard_mm);
            }
            heard_mm = at_mm;
            let across = [frame.rotation * Vector3::y(), frame.rotation * Vector3::z()];
            let oval_mm = [locals[place].uneven_mm(along, base.tube_radius_mm).0, 0.0];
            doubt_ovality(&mut sums, noise / oval_doubt_mm(base, &spine, at_mm));
            let best = solve(&sums, &SPREADS.map(|s| s * base.tube_radius_mm), noise);
            let least = cost(&sums, &best).max(0.0);
            sections.push(Section {
                centre: frame.translation.vector.into(),
                across,
                sums,
                oval_mm,
                count,
                least,
            });
        }
        if fitted {
            let (damaged, sound) = damaged_ends(sections, base, &spine, noise);
            places.extend(damaged.iter().map(|s| s.centre));
            sections = sound;
        } else {
            sections = of_one_radius(sections, base, &spine, noise);
        }
        let count = sections.iter().map(|s| s.count).sum();
        let crowded = Crowded { places, reach_mm: base.tube_radius_mm.hypot(0.5 * bins.length_mm) };
        CentreLine { sections, radius_mm: base.tube_radius_mm, noise_mm: noise, count, crowded, silence_mm }
    }

    /// Where it tells nothing because something else was scanned there.
    pub fn crowded(&self) -> &Crowded {
        &self.crowded
    }

    /// The longest stretch of the tube, ends aside, where sections were left out.
    pub fn silence_mm(&self) -> f64 {
        self.silence_mm
    }

    /// Sum of the points' squared residuals about a model.
    pub fn cost(&self, model: &TubeModel) -> f64 {
        let mut sum = 0.0;
        self.walk(model, |section, _, values, _| sum += cost(&section.sums, values));
        sum
    }

    /// The farthest that two tubes lie apart across the centre line.
    pub fn apart_mm(&self, one: &TubeModel, other: &TubeModel) -> f64 {
        let mut places = Vec::with_capacity(self.sections.len());
        self.walk(one, |_, _, values, _| places.push((values[1], values[2])));
        let (mut most, mut i) = (0.0_f64, 0);
        self.walk(other, |_, _, values, _| {
            most = most.max((values[1] - places[i].0).hypot(values[2] - places[i].1));
            i += 1;
        });
        most
    }

    /// How far a tube runs from the line that the sections were taken about, at most.
    pub fn farthest_mm(&self, model: &TubeModel) -> f64 {
        let mut most = 0.0_f64;
        self.walk(model, |_, _, values, _| most = most.max(values[1].hypot(values[2])));
        most
    }

    /// Places at which a bend could be.
    pub fn places(&self) -> usize {
        self.sections.len()
    }

    /// By how much the sections scatter about the model, over what their points' noise explains: 1 for independent noise
    /// about the right tube. A median, so that a local misfit does not count.
    pub fn correlation(&self, model: &TubeModel) -> f64 {
        let mut excess = Vec::new();
        self.walk(model, |section, _, values, _| {
            if section.count >= JUDGED_POINTS {
                excess.push(cost(&section.sums, values) - section.least);
            }
        });
        let usual = median(&mut excess).unwrap_or(0.0) / (self.noise_mm * self.noise_mm);
        1.0 + ((usual / MEDIAN_CHI2).max(1.0) - 1.0) * self.persistence(model)
    }

    /// How many neighbouring sections say one thing where they differ from the model: 1 when each lies off to a side of
    /// its own. From how often neighbours lie off to the same side, so that a local misfit counts little; as if each
    /// followed the one before (first-order autoregression). The sigmas sum correlations instead (`section::persistence`); here
    /// that would take slow drift for what bends compete with, and true bends were lost.
    fn persistence(&self, model: &TubeModel) -> f64 {
        let mut offs: Vec<Vector3<f64>> = Vec::new();
        self.walk(model, |section, _, values, _| {
            let best = solve(&section.sums, &SPREADS.map(|s| s * self.radius_mm), self.noise_mm);
            let off = best - values;
            offs.push(section.across[0] * off[1] + section.across[1] * off[2]);
        });
        let pairs = offs.len().saturating_sub(1).max(1) as f64;
        let alike = offs.windows(2).filter(|w| w[0].dot(&w[1]) > 0.0).count() as f64 / pairs;
        let follows = (std::f64::consts::PI * (alike - 0.5)).sin().clamp(0.0, MOST_FOLLOWING);
        (1.0 + follows) / (1.0 - follows)
    }

    /// Moments of every section with the segment that it faces, in order along the tube.
    pub fn moments(&self, model: &TubeModel) -> Vec<(usize, Moment)> {
        let mut out = Vec::with_capacity(self.sections.len());
        self.walk(model, |section, segment, values, derivatives| {
            let mut moment = Moment::zeros();
            add_moment(&mut moment, &section.sums, values, derivatives);
            out.push((segment, moment));
        });
        out
    }

    /// Where every section faces the model: arc length.
    pub fn places_mm(&self, model: &TubeModel) -> Vec<f64> {
        let spine = model.spine();
        let locals = prepare(model);
        let mut segment = 0;
        let place = |section: &Section| {
            let local = settle(&section.centre, &mut segment, &locals);
            let k = segment as usize;
            spine.segments()[k].start_mm + locals[k].along_mm(&local)
        };
        self.sections.iter().map(place).collect()
    }

    /// Visits every section with its segment, the values that the model predicts for it, and their derivatives.
    fn walk(
        &self,
        model: &TubeModel,
        mut visit: impl FnMut(&Section, usize, &Values, &SMatrix<f64, VALUES, ROWS>),
    ) {
        let locals = prepare(model);
        let mut segment = 0;
        for section in &self.sections {
            let local = settle(&section.centre, &mut segment, &locals);
            let k = segment as usize;
            let (mut values, derivatives) = predict(section, &local, &locals[k], model.tube_radius_mm);
            values[0] = model.tube_radius_mm - self.radius_mm;
            values[3] -= section.oval_mm[0];
            values[4] -= section.oval_mm[1];
            visit(section, k, &values, &derivatives);
        }
    }
}

impl Data for &CentreLine {
    fn pass(&mut self, model: &TubeModel, _cutoff_mm: f64) -> Pass {
        let mut pass = Pass::empty(2 * model.lra.bends.len() + 1);
        self.walk(model, |section, segment, values, derivatives| {
            pass.cost += 0.5 * add_moment(&mut pass.moments[segment], &section.sums, values, derivatives);
        });
        pass
    }
}

/// Where the model's centre line passes a section (`local`: its centre in the frame of the segment it faces), and how that
/// depends on the moment's rows.
fn predict(
    section: &Section,
    local: &Point3<f64>,
    segment: &Local,
    radius_mm: f64,
) -> (Values, SMatrix<f64, VALUES, ROWS>) {
    let mut values = Values::zeros();
    let mut derivatives = SMatrix::<f64, VALUES, ROWS>::zeros();
    derivatives[(0, TUBE_RADIUS)] = 1.0;
    let across = section.across.map(|a| segment.to_local.rotation * a);
    let (foot, tangent) = segment.foot(local);
    let off = foot - local;
    for (k, direction) in across.iter().enumerate() {
        values[1 + k] = off.dot(direction);
        // A slide along the tube is no shift across it.
        let direction = direction - tangent * direction.dot(&tangent);
        let lever = foot.coords.cross(&direction);
        for axis in 0..3 {
            derivatives[(1 + k, axis)] = direction[axis];
            derivatives[(1 + k, 3 + axis)] = lever[axis];
        }
    }
    if let Some(arc) = &segment.arc {
        let outward = Vector3::new(tangent.y, -tangent.x, 0.0);
        let [c, s] = across.map(|a| a.dot(&outward));
        // 1 - cos of the turn: the tangent's x is its cosine.
        derivatives[(1, OWN_RADIUS)] = (1.0 - tangent.x) * c;
        derivatives[(2, OWN_RADIUS)] = (1.0 - tangent.x) * s;
        let ramp = arc.ramp(tangent.y.atan2(tangent.x).rem_euclid(std::f64::consts::TAU), radius_mm);
        derivatives[(3, OVALITY)] = ramp * (c * c - s * s);
        derivatives[(4, OVALITY)] = ramp * 2.0 * s * c;
        values[3] = arc.ovality_mm * derivatives[(3, OVALITY)];
        values[4] = arc.ovality_mm * derivatives[(4, OVALITY)];
    }
    (values, derivatives)
}

/// Adds the moment of a section at the values that a model predicts (the lower triangle); returns their cost.
fn add_moment(
    out: &mut Moment,
    sums: &Sums,
    values: &Values,
    derivatives: &SMatrix<f64, VALUES, ROWS>,
) -> f64 {
    let square: Matrix5<f64> = sums.fixed_view::<VALUES, VALUES>(0, 0).into_owned();
    let mixed: Values = sums.fixed_view::<VALUES, 1>(0, VALUES).into_owned();
    // The residual falls as the values grow.
    let left = square * values - mixed;
    // Each row of the moment moves some of the values only: twists and CLR the place across, the others one value.
    let oval = Vector2::new(derivatives[(3, OVALITY)], derivatives[(4, OVALITY)]);
    let both: Matrix2<f64> = square.fixed_view::<2, 2>(1, 1).into_owned();
    let oval_seen: Vector2<f64> = square.fixed_view::<2, 2>(1, 3) * oval;
    for j in 0..OVALITY {
        let across = Vector2::new(derivatives[(1, j)], derivatives[(2, j)]);
        let seen = both * across;
        for i in j..OVALITY {
            out[(i, j)] += derivatives[(1, i)] * seen[0] + derivatives[(2, i)] * seen[1];
        }
        out[(OVALITY, j)] += oval_seen.dot(&across);
        out[(TUBE_RADIUS, j)] += square[(0, 1)] * across[0] + square[(0, 2)] * across[1];
        out[(RESIDUAL, j)] += left[1] * across[0] + left[2] * across[1];
    }
    out[(OVALITY, OVALITY)] += (square.fixed_view::<2, 2>(3, 3) * oval).dot(&oval);
    out[(TUBE_RADIUS, OVALITY)] += square[(0, 3)] * oval[0] + square[(0, 4)] * oval[1];
    out[(RESIDUAL, OVALITY)] += left[3] * oval[0] + left[4] * oval[1];
    out[(TUBE_RADIUS, TUBE_RADIUS)] += square[(0, 0)];
    out[(RESIDUAL, TUBE_RADIUS)] += left[0];
    let cost = cost(sums, values);
    out[(RESIDUAL, RESIDUAL)] += cost;
    cost
}

/// Whether burr, bore and face may reach a place.
fn may_be_damaged(base: &TubeModel, spine: &Spine, at_mm: f64) -> bool {
    at_mm.min(spine.length_mm() - at_mm) <= DAMAGED_RADII * base.tube_radius_mm
}

/// Without the sections near the ends that have another radius than the tube: face and bore outweigh its outside there, and one such
/// section may draw a whole tube off its way. Where an end straight reaches no farther than that, nothing else tells its direction.
fn of_one_radius(sections: Vec<Section>, base: &TubeModel, spine: &Spine, noise_mm: f64) -> Vec<Section> {
    let spreads_mm = SPREADS.map(|s| s * base.tube_radius_mm);
    let radii: Vec<f64> = sections.iter().map(|s| solve(&s.sums, &spreads_mm, noise_mm)[0]).collect();
    let usual = median(&mut radii.clone()).unwrap_or(0.0);
    let mut sizes: Vec<f64> = radii.iter().map(|r| (r - usual).abs()).collect();
    let scatter = MEDIAN_TO_SIGMA * median(&mut sizes).unwrap_or(0.0);
    let most = (OTHER_RADIUS * scatter).max(spreads_mm[0]);
    let reach_mm = DAMAGED_RADII * base.tube_radius_mm;
    let first_mm = base.lra.bends.first().map_or(spine.length_mm(), |b| b.length_mm);
    let may_go = |at_mm: f64| {
        (at_mm <= reach_mm && first_mm > reach_mm)
            || (spine.length_mm() - at_mm <= reach_mm && base.lra.last_length_mm > reach_mm)
    };
    let is_own = |(s, radius): &(Section, f64)| {
        (radius - usual).abs() <= most || !may_go(spine.closest(&s.centre).arc_length_mm)
    };
    sections.into_iter().zip(radii).filter(is_own).map(|(s, _)| s).collect()
}

/// The sections near the ends that have not the tube's shape, wherever they lie: a burr, a bore, a face is among their points, in
/// however few of them. And the others.
fn damaged_ends(
    sections: Vec<Section>,
    base: &TubeModel,
    spine: &Spine,
    noise_mm: f64,
) -> (Vec<Section>, Vec<Section>) {
    let [_, place, ..] = SPREADS;
    let shape = [TUBES_OWN, place, place, TUBES_OWN, TUBES_OWN].map(|s| s * base.tube_radius_mm);
    let misfit =
        |s: &Section| (cost(&s.sums, &solve(&s.sums, &shape, noise_mm)) - s.least) / (noise_mm * noise_mm);
    let usual = median(&mut sections.iter().map(misfit).collect::<Vec<_>>()).unwrap_or(0.0);
    let full = median(&mut sections.iter().map(|s| s.count).collect::<Vec<_>>()).unwrap_or(0.0);
    let is_full = |s: &Section| s.count >= LEAST_FULL * full;
    let (first, last) = (sections.iter().position(is_full), sections.iter().rposition(is_full));
    let seen = first.unwrap_or(0)..=last.unwrap_or(0);
    let is_damaged = |(i, s): &(usize, Section)| {
        let at_mm = spine.closest(&s.centre).arc_length_mm;
        may_be_damaged(base, spine, at_mm)
            && (!seen.contains(i) || misfit(s) > DAMAGED * usual.max(MEDIAN_CHI2))
    };
    let (damaged, sound): (Vec<_>, Vec<_>) = sections.into_iter().enumerate().partition(is_damaged);
    let alone = |sections: Vec<(usize, Section)>| sections.into_iter().map(|(_, s)| s).collect();
    (alone(damaged), alone(sound))
}
