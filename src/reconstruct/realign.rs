//! The passes of a scan moved onto each other. An arm drifts by some hundredths of a millimetre from pass to pass; no file
//! says where one ends, but consecutive points are nearly always of one pass.
//!
//! Between a first structure and the one that counts: `realigned` finds where in the file's order the scan moved, and how.
//! Every short stretch of the tube ([section](super::section)) has values of its own, which are eliminated: asked are only
//! places that several passes saw, and nothing of the tube's shape is taken for drift.

mod blocks;
mod known;

use std::collections::BTreeMap;

use nalgebra::{Cholesky, DVector, Point3, SVector, UnitQuaternion, Vector3};

use blocks::{Blocks, MOTION, Sum};
pub use known::information;

use super::fit::CUTOFF_SIGMAS;
use super::local::{Local, prepare};
use super::model::TubeModel;
use super::section::{Bins, oval_doubt_mm};
use super::stripes;
use super::whole::{ScanPass, Whole};
use crate::tube::Frame;

/// Points looked at, in runs of so many as they lie in the file.
const MOST_POINTS: usize = 50_000;
const RUN: usize = 200;

/// The file's order is cut into so many chunks; those beside a boundary, once found, into so many again.
const CHUNKS: usize = 48;
const FINER: usize = 12;

/// Passes of a scan at most.
const MOST_PASSES: usize = 16;

/// Times that every boundary is looked for anew beside the others.
const ROUNDS: usize = 2;

/// A further pass must explain this many times what its six values and its boundary cost.
const SURELY: f64 = 2.0;

/// When so many points say one thing, passes may disagree though no two saw one place: one lies on the tube's other side.
const STRUCTURED: f64 = 1.1;

/// Drift is expected to be so many times the disagreement seen or the noise: what is left once a tube was fitted to all passes.
const MORE_THAN_SEEN: f64 = 3.0;

/// How far a section's radius may differ from the tube's, in tube radii, and an arc's ovality from the model's.
const OWN_RADIUS: f64 = 3e-4;
const ARC_OVALITY: f64 = 0.004;
/// Where a section lies is not known beforehand, in tube radii.
const ANYWHERE: f64 = 0.3;

/// Derivatives of a point's residual by its section's values and by its pass's motion, and the residual.
type Row = SVector<f64, 12>;

/// What a scan says of its passes.
struct Asked<'a> {
    whole: &'a Whole<'a>,
    model: &'a TubeModel,
    /// Standard deviation of a point about its own pass.
    noise_mm: f64,
    cutoff_mm: f64,
    /// Expected drift.
    spread_mm: f64,
    /// Turns are about here, in units that move a point so far away by a millimetre.
    centre: Point3<f64>,
    reach_mm: f64,
}

/// The passes that a scan was made in and how each must move to lie on the others, of points that scatter by `noise_mm`
/// about their sections, so many (`correlation`) that say one thing; and by how much the squared residuals fall, over the variance of a point. Empty where nothing says
/// that there are several.
pub fn realigned(whole: &Whole, model: &TubeModel, noise_mm: f64, correlation: f64) -> (Vec<ScanPass>, f64) {
    let passes_mm = stripes::disagreement_mm(whole, model, noise_mm);
    if passes_mm <= 0.0 && correlation < STRUCTURED {
        return (Vec::new(), 0.0);
    }
    let own_mm = (noise_mm * noise_mm - passes_mm * passes_mm).max(0.0).sqrt().max(1e-6);
    let (centre, reach_mm) = middle(model);
    let asked = Asked {
        whole,
        model,
        noise_mm: own_mm,
        cutoff_mm: CUTOFF_SIGMAS * noise_mm,
        spread_mm: MORE_THAN_SEEN * passes_mm.max(noise_mm),
        centre,
        reach_mm,
    };
    asked.passes().unwrap_or_default()
}

/// The middle of a tube, and how far it reaches from there.
fn middle(model: &TubeModel) -> (Point3<f64>, f64) {
    let spine = model.spine();
    let place = |share: f64| spine.frame_at(share * spine.length_mm()).translation.vector;
    let places = [0.0, 0.25, 0.5, 0.75, 1.0].map(place);
    let centre = places.iter().sum::<Vector3<f64>>() / places.len() as f64;
    let reach_mm = places.iter().map(|p| (p - centre).norm()).fold(model.tube_radius_mm, f64::max);
    (centre.into(), reach_mm)
}

impl Asked<'_> {
    /// None when there is one pass only.
    fn passes(&self) -> Option<(Vec<ScanPass>, f64)> {
        let order = self.whole.runs(RUN, MOST_POINTS);
        let coarse: Vec<usize> = (0..=CHUNKS).map(|k| k * order.len() / CHUNKS).collect();
        let blocks = self.blocks(&order, &coarse);
        let price = SURELY * (MOTION as f64 * (order.len() as f64).ln() + 2.0 * (CHUNKS as f64).ln());
        let found = self.boundaries(&blocks, price)?;
        let (fine, found) = finer(&coarse, &found);
        let blocks = self.blocks(&order, &fine);
        let found = self.needed(&blocks, self.settled(&blocks, found, FINER), price);
        let (gain, motions) = self.gain(&blocks, &found)?;
        let ends = found.iter().map(|&b| order[fine[b]]).chain([u32::MAX]);
        let pass = |(k, end): (usize, u32)| ScanPass { end, motion: self.motion(&motions, k) };
        Some((ends.enumerate().map(pass).collect(), gain))
    }

    /// Boundaries added one by one as long as each is worth its price, the best first.
    fn boundaries(&self, blocks: &Blocks, price: f64) -> Option<Vec<usize>> {
        let mut found = Vec::new();
        let (mut gain, _) = self.gain(blocks, &found)?;
        while found.len() + 1 < MOST_PASSES {
            let with = |b: usize| {
                let mut more: Vec<usize> = found.iter().copied().chain([b]).collect();
                more.sort_unstable();
                more
            };
            let tried = (1..blocks.chunks).filter(|b| !found.contains(b));
            let tried = tried.filter_map(|b| Some((self.gain(blocks, &with(b))?.0, b)));
            let Some((best, b)) = tried.max_by(|a, b| a.0.total_cmp(&b.0)) else { break };
            let more = self.settled(blocks, with(b), blocks.chunks);
            let best = self.gain(blocks, &more)?.0.max(best);
            if best - gain < price {
                break;
            }
            (found, gain) = (more, best);
        }
        (!found.is_empty()).then_some(found)
    }

    /// Every boundary where it is worth the most, no farther from where it was than `reach`.
    fn settled(&self, blocks: &Blocks, mut found: Vec<usize>, reach: usize) -> Vec<usize> {
        for _ in 0..ROUNDS {
            for k in 0..found.len() {
                let least = found[k].saturating_sub(reach).max(if k > 0 { found[k - 1] + 1 } else { 1 });
                let most = (found[k] + reach).min(found.get(k + 1).map_or(blocks.chunks, |next| *next) - 1);
                let at = |b: usize| {
                    let mut other = found.clone();
                    other[k] = b;
                    self.gain(blocks, &other).map(|g| (g.0, b))
                };
                let best = (least..=most).filter_map(at).max_by(|a, b| a.0.total_cmp(&b.0));
                found[k] = best.map_or(found[k], |b| b.1);
            }
        }
        found
    }

    /// The boundaries without those that are not worth their price beside the others: two may have stood for one inside a chunk.
    fn needed(&self, blocks: &Blocks, mut found: Vec<usize>, price: f64) -> Vec<usize> {
        while found.len() > 1 {
            let less = |k: usize| {
                let mut other = found.clone();
                other.remove(k);
                let other = self.settled(blocks, other, FINER);
                Some((self.gain(blocks, &other)?.0, other))
            };
            let best = (0..found.len()).filter_map(less).max_by(|a, b| a.0.total_cmp(&b.0));
            let all = self.gain(blocks, &found).map_or(0.0, |g| g.0);
            match best {
                Some((gain, fewer)) if all - gain < price => found = fewer,
                _ => break,
            }
        }
        found
    }

    /// By how much the squared residuals fall, over the noise's variance, when the chunks between boundaries move together; and
    /// how they move.
    fn gain(&self, blocks: &Blocks, boundaries: &[usize]) -> Option<(f64, DVector<f64>)> {
        let (mut square, right) = blocks.together(boundaries);
        let last = right.len() - 1;
        let stiffness = (self.noise_mm / self.spread_mm).powi(2);
        (0..last).for_each(|k| square[(k, k)] += stiffness);
        square[(last, last)] += 1e-9 * (1.0 + square[(last, last)]);
        let motions = Cholesky::new(square)?.solve(&right);
        Some((motions.dot(&right) / (self.noise_mm * self.noise_mm), motions))
    }

    fn motion(&self, motions: &DVector<f64>, pass: usize) -> Frame {
        let part = motions.fixed_rows::<MOTION>(MOTION * pass);
        let shift = Vector3::new(part[0], part[1], part[2]);
        let turn = Vector3::new(part[3], part[4], part[5]) / self.reach_mm;
        let about = Frame::rotation_wrt_point(UnitQuaternion::from_scaled_axis(turn), self.centre);
        Frame::translation(shift.x, shift.y, shift.z) * about
    }

    /// The sums of the chunks of the file's order between `edges`, the sections' values eliminated.
    fn blocks(&self, order: &[u32], edges: &[usize]) -> Blocks {
        let chunk = |e: &usize| ScanPass {
            end: order.get(*e).copied().unwrap_or(u32::MAX),
            motion: Frame::identity(),
        };
        let chunks: Vec<ScanPass> = edges.iter().skip(1).map(chunk).collect();
        let model = self.model;
        let spine = model.spine();
        let bins = Bins::new(&spine, model.tube_radius_mm, order.len());
        let locals = prepare(model);
        let starts: Vec<Frame> = spine.segments().iter().map(|s| s.start).collect();
        let of_chunks = self.whole.only(order);
        let parts = of_chunks.moved(&chunks).walk_passes(
            model,
            self.cutoff_mm,
            BTreeMap::<(usize, usize), Sum>::new,
            |sums, chunk, k, p| {
                let (local, start) = (&locals[k], &starts[k]);
                if let Some((weight, row)) = self.row(local, start, p) {
                    let section = bins.of(k, local.share_along(p));
                    let sum = sums.entry((section, chunk)).or_insert_with(Sum::zeros);
                    sum.ger(weight, &row, &row, 1.0);
                }
            },
        );
        let mut sections: Vec<BTreeMap<usize, Sum>> = vec![BTreeMap::new(); bins.total];
        for ((section, chunk), sum) in parts.into_iter().flatten() {
            *sections[section].entry(chunk).or_insert_with(Sum::zeros) += sum;
        }
        let mut blocks = Blocks::empty(chunks.len());
        for ((sums, segment), at_mm) in sections.iter().zip(bins.places()).zip(bins.places_mm()) {
            let radius_mm = model.tube_radius_mm;
            let least = if segment % 2 == 1 { ARC_OVALITY * radius_mm } else { 0.0 };
            let oval_mm = oval_doubt_mm(model, &spine, at_mm).max(least);
            let (own, place) = (OWN_RADIUS * radius_mm, ANYWHERE * radius_mm);
            let stiff = [own, place, place, oval_mm, oval_mm].map(|s| (self.noise_mm / s).powi(2));
            blocks.add(sums, &stiff);
        }
        blocks.summed()
    }

    /// Weight and derivatives of a point; None when it is not on the tube.
    fn row(&self, local: &Local, start: &Frame, p: [f64; 3]) -> Option<(f64, Row)> {
        let residual_mm = local.residual_mm(p, self.model.tube_radius_mm);
        let keep = 1.0 - (residual_mm / self.cutoff_mm).powi(2);
        if keep <= 0.0 {
            return None;
        }
        let (u, v) = local.across(p);
        let size = u.hypot(v).max(1e-12);
        let (c, s) = (u / size, v / size);
        let normal = start.rotation * local.outward(p);
        let arm = (start * Point3::from(p) - self.centre) / self.reach_mm;
        let lever = arm.cross(&normal);
        let row = [
            -1.0,
            -c,
            -s,
            s * s - c * c,
            -2.0 * s * c,
            normal.x,
            normal.y,
            normal.z,
            lever.x,
            lever.y,
            lever.z,
            residual_mm,
        ];
        Some((keep * keep, Row::from(row)))
    }
}

/// The chunks beside boundaries cut finer, the others between boundaries as one; and where the boundaries are among them.
fn finer(coarse: &[usize], found: &[usize]) -> (Vec<usize>, Vec<usize>) {
    let mut edges = vec![coarse[0], coarse[coarse.len() - 1]];
    for &b in found {
        for (from, to) in [(coarse[b - 1], coarse[b]), (coarse[b], coarse[b + 1])] {
            edges.extend((0..=FINER).map(|k| from + k * (to - from) / FINER));
        }
    }
    edges.sort_unstable();
    edges.dedup();
    let places = found.iter().filter_map(|&b| edges.binary_search(&coarse[b]).ok()).collect();
    (edges, places)
}
