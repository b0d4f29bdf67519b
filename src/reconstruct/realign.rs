//! The passes of a scan moved onto each other. An arm drifts by some hundredths of a millimetre from pass to pass; no file
//! says where one ends, but consecutive points are nearly always of one pass.
//!
//! Between a first structure and the one that counts: `realigned` finds where in the file's order the scan moved, and how.
//! Every short stretch of the tube ([section](super::section)) has values of its own, which are eliminated: asked are only
//! places that several passes saw, and nothing of the tube's shape is taken for drift.

mod blocks;
mod cut;
mod known;

use std::collections::BTreeMap;

use nalgebra::{DVector, Point3, SVector, UnitQuaternion, Vector3};
use rayon::prelude::*;

use blocks::{Blocks, MOTION, Sum};
pub use known::{information, moved_mm};

use super::SAMPLE_CELL_RADII;
use super::fit::CUTOFF_SIGMAS;
use super::local::{Local, prepare};
use super::model::TubeModel;
use super::section::{Bins, oval_doubt_mm};
use super::seen::FIRST_CUTOFF;
use super::strangers::Crowded;
use super::stripes;
use super::structure::Structure;
use super::whole::{ScanPass, Whole};
use crate::cloud::PointCloud;
use crate::tube::Frame;

/// Points looked at, in runs of so many as they lie in the file.
const MOST_POINTS: usize = 50_000;
const RUN: usize = 100;

/// The file's order is cut into so many chunks; those beside a boundary, once found, into so many again, so many times at most
/// and down to chunks of so few points.
const CHUNKS: usize = 48;
const FINER: usize = 12;
const LEVELS: usize = 5;
const FEW_POINTS: usize = 2;

/// How far about a boundary the scan's jumps are looked for, in halves of a chunk of the first cut.
const JUMP_REACHES: [usize; 3] = [4, 2, 1];

/// So much less may a boundary explain where the scan jumps than where it explains the most.
const MUCH: f64 = 50.0;

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

/// Points that the sample is thinned from.
const MOST_DRAWN: usize = 100_000;

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
    bins: Bins,
    crowded: &'a Crowded,
}

/// Consecutive points of the file.
struct Chunk {
    /// Index of the first.
    from: u32,
    /// Points of it that were looked at.
    points: usize,
    /// By section.
    sums: BTreeMap<usize, Sum>,
}

impl Chunk {
    /// Nothing yet, from an index on.
    fn from(from: u32) -> Chunk {
        Chunk { from, points: 0, sums: BTreeMap::new() }
    }

    /// Adds the chunk that follows.
    fn add(&mut self, next: Chunk) {
        self.points += next.points;
        for (section, sum) in next.sums {
            *self.sums.entry(section).or_insert_with(Sum::zeros) += sum;
        }
    }
}

/// The passes that a scan was made in and how each must move to lie on the others, of a tube whose structure is about known;
/// and by how much the squared residuals fall, over the variance of a point. Empty where nothing says that there are several.
pub fn realigned(whole: &Whole, chosen: &Structure) -> (Vec<ScanPass>, f64) {
    let (model, noise_mm) = (&chosen.model, chosen.noise_mm);
    let passes_mm = stripes::disagreement_mm(whole, model, noise_mm);
    if passes_mm <= 0.0 && chosen.correlation < STRUCTURED {
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
        bins: Bins::new(&model.spine(), model.tube_radius_mm, whole.len().min(MOST_POINTS)),
        crowded: &chosen.crowded,
    };
    asked.passes().unwrap_or_default()
}

/// The points that decide a tube's structure, of a scan with its passes where they belong.
pub fn sample(whole: &Whole, model: &TubeModel) -> Vec<Point3<f64>> {
    let (spine, radius_mm) = (model.spine(), model.tube_radius_mm);
    let is_near =
        |p: &Point3<f64>| (spine.closest(p).distance_mm - radius_mm).abs() < FIRST_CUTOFF * radius_mm;
    let near: Vec<Point3<f64>> = whole.share(MOST_DRAWN).into_par_iter().filter(is_near).collect();
    PointCloud::from_points(&near).thinned_without_strays(SAMPLE_CELL_RADII * radius_mm).iter().collect()
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
        let points = self.whole.runs(RUN, MOST_POINTS).len() as f64;
        let price = SURELY * (MOTION as f64 * points.max(2.0).ln() + 2.0 * (CHUNKS as f64).ln());
        let mut chunks = self.chunks(&[(0, u32::MAX)], CHUNKS);
        let mut found = cut::boundaries(&self.blocks(&chunks), price)?;
        for _ in 0..LEVELS {
            let widest = found.iter().map(|&b| chunks[b].points.max(chunks[b - 1].points)).max();
            if widest.unwrap_or(0) <= FEW_POINTS {
                break;
            }
            (chunks, found) = self.finer(chunks, &found);
            let blocks = self.blocks(&chunks);
            found = cut::needed(&blocks, cut::settled(&blocks, found, FINER), FINER, price);
        }
        let likeliest: Vec<u32> = found.iter().map(|&b| chunks[b].from).collect();
        let jumps: Vec<Vec<u32>> = likeliest.iter().map(|&b| self.jumps_near(b)).collect();
        let (boundaries, motions) = self.at_jumps(likeliest, &jumps)?;
        self.confirmed(&boundaries, &motions, price)
    }

    /// The passes between boundaries with their motions.
    fn scan_passes(&self, boundaries: &[u32], motions: &DVector<f64>) -> Vec<ScanPass> {
        let ends = boundaries.iter().copied().chain([u32::MAX]);
        ends.enumerate().map(|(k, end)| ScanPass { end, motion: self.motion(motions, k) }).collect()
    }

    /// The passes without those that are not needed once all are moved, each as its points ask for from there: what a linear step
    /// leaves of a large motion of a thin tube passes for more passes.
    fn confirmed(
        &self,
        boundaries: &[u32],
        motions: &DVector<f64>,
        price: f64,
    ) -> Option<(Vec<ScanPass>, f64)> {
        let mut chunks: Vec<Chunk> = [0].iter().chain(boundaries).map(|&from| Chunk::from(from)).collect();
        let moved = self.scan_passes(boundaries, motions);
        self.sum_up_moved(&mut chunks, &self.whole.runs(RUN, MOST_POINTS), &moved);
        let blocks = self.unsummed(&chunks).about(motions).summed();
        let found = cut::needed(&blocks, (1..chunks.len()).collect(), 0, price);
        let (gain, motions) = blocks.gain(&found)?;
        let needed: Vec<u32> = found.into_iter().map(|b| chunks[b].from).collect();
        Some((self.scan_passes(&needed, &motions), gain))
    }

    /// Indices of the points that are the farthest from the one before them of those about an index, the widest surroundings first:
    /// where the next pass may have begun.
    fn jumps_near(&self, index: u32) -> Vec<u32> {
        let farthest = |reach: &usize| {
            let near = self.whole.around(index, reach * self.whole.len() / (2 * CHUNKS));
            let places: Vec<Point3<f64>> = near.iter().map(|&i| self.whole.point(i)).collect();
            let jumps = places.windows(2).map(|w| (w[1] - w[0]).norm_squared()).zip(&near[1..]);
            jumps.max_by(|a, b| a.0.total_cmp(&b.0)).map_or(index, |(_, i)| *i)
        };
        JUMP_REACHES.iter().map(farthest).collect()
    }

    /// Each boundary at the widest jump near it that not much speaks against: the last points of a pass may lie where nothing tells
    /// how it moved. With the motions then.
    fn at_jumps(&self, likeliest: Vec<u32>, jumps: &[Vec<u32>]) -> Option<(Vec<u32>, DVector<f64>)> {
        let mut cuts: Vec<u32> = likeliest.iter().chain(jumps.iter().flatten()).copied().chain([0]).collect();
        cuts.sort_unstable();
        cuts.dedup();
        let place = |index: &u32| cuts.binary_search(index).unwrap_or(0);
        let mut chunks: Vec<Chunk> = cuts.iter().map(|&from| Chunk::from(from)).collect();
        self.sum_up(&mut chunks, &self.whole.runs(RUN, MOST_POINTS));
        let blocks = self.blocks(&chunks);
        let mut found: Vec<usize> = likeliest.iter().map(place).collect();
        let (mut gain, mut motions) = blocks.gain(&found)?;
        for (k, jumps) in jumps.iter().enumerate() {
            let at = |jump: &u32| {
                let mut other = found.clone();
                other[k] = place(jump);
                let is_order = other.windows(2).all(|w| w[0] < w[1]) && other[0] > 0;
                let at_jump = blocks.gain(&other).filter(|g| is_order && g.0 > gain - MUCH);
                at_jump.map(|g| (other, g))
            };
            if let Some((other, at_jump)) = jumps.iter().find_map(at) {
                found = other;
                (gain, motions) = at_jump;
            }
        }
        Some((found.into_iter().map(|b| cuts[b]).collect(), motions))
    }

    /// The chunks beside boundaries cut finer, the others between boundaries as one; and where the boundaries are among them.
    fn finer(&self, chunks: Vec<Chunk>, found: &[usize]) -> (Vec<Chunk>, Vec<usize>) {
        let mut beside: Vec<usize> = found.iter().flat_map(|&b| [b - 1, b]).collect();
        beside.dedup();
        let end = |k: usize| chunks.get(k + 1).map_or(u32::MAX, |next| next.from);
        let ranges: Vec<(u32, u32)> = beside.iter().map(|&k| (chunks[k].from, end(k))).collect();
        let boundaries: Vec<u32> = found.iter().map(|&b| chunks[b].from).collect();
        let mut out: Vec<Chunk> = Vec::new();
        let mut fine = self.chunks(&ranges, FINER).into_iter().peekable();
        let mut open = false;
        for (k, chunk) in chunks.into_iter().enumerate() {
            if beside.contains(&k) {
                let next = ranges.iter().find(|r| r.0 == chunk.from).map_or(u32::MAX, |r| r.1);
                while let Some(part) = fine.next_if(|f| f.from < next) {
                    out.push(part);
                }
                open = false;
            } else if let Some(last) = out.last_mut().filter(|_| open) {
                last.add(chunk);
            } else {
                out.push(chunk);
                open = true;
            }
        }
        let place = |from: &u32| out.iter().position(|c| c.from == *from);
        let found = boundaries.iter().filter_map(place).collect();
        (out, found)
    }

    fn motion(&self, motions: &DVector<f64>, pass: usize) -> Frame {
        let part = motions.fixed_rows::<MOTION>(MOTION * pass);
        let shift = Vector3::new(part[0], part[1], part[2]);
        let turn = Vector3::new(part[3], part[4], part[5]) / self.reach_mm;
        let about = Frame::rotation_wrt_point(UnitQuaternion::from_scaled_axis(turn), self.centre);
        Frame::translation(shift.x, shift.y, shift.z) * about
    }

    /// The sums of each range of the file, cut into so many chunks.
    fn chunks(&self, ranges: &[(u32, u32)], each: usize) -> Vec<Chunk> {
        let mut order = Vec::new();
        let mut chunks: Vec<Chunk> = Vec::new();
        for &(from, end) in ranges {
            let points = self.whole.runs_within(from, end, RUN, MOST_POINTS);
            let each = each.min(points.len()).max(1);
            for k in 0..each {
                let (at, next) = (k * points.len() / each, (k + 1) * points.len() / each);
                let from = if k == 0 { from } else { points[at] };
                chunks.push(Chunk { points: next - at, ..Chunk::from(from) });
            }
            order.extend(points);
        }
        self.sum_up(&mut chunks, &order);
        chunks
    }

    /// Sums points of the file, in its order, into the chunks that they are of.
    fn sum_up(&self, chunks: &mut [Chunk], order: &[u32]) {
        let end = |k: usize| chunks.get(k + 1).map_or(u32::MAX, |next| next.from);
        let still: Vec<ScanPass> =
            (0..chunks.len()).map(|k| ScanPass { end: end(k), motion: Frame::identity() }).collect();
        self.sum_up_moved(chunks, order, &still);
    }

    /// The same, each chunk moved as a pass is.
    fn sum_up_moved(&self, chunks: &mut [Chunk], order: &[u32], moved: &[ScanPass]) {
        let locals = prepare(self.model);
        let starts: Vec<Frame> = self.model.spine().segments().iter().map(|s| s.start).collect();
        let add = |sums: &mut BTreeMap<(usize, usize), Sum>, chunk: usize, k: usize, p: [f64; 3]| {
            if let Some((weight, row)) = self.row(&locals[k], &starts[k], p) {
                let section = self.bins.of(k, locals[k].share_along(p));
                sums.entry((chunk, section)).or_insert_with(Sum::zeros).ger(weight, &row, &row, 1.0);
            }
        };
        let parts =
            self.whole.only(order).moved(moved).walk_passes(self.model, self.cutoff_mm, BTreeMap::new, add);
        for ((chunk, section), sum) in parts.into_iter().flatten() {
            *chunks[chunk].sums.entry(section).or_insert_with(Sum::zeros) += sum;
        }
    }

    /// The equations of the chunks' motions, the sections' values eliminated.
    fn blocks(&self, chunks: &[Chunk]) -> Blocks {
        self.unsummed(chunks).summed()
    }

    fn unsummed(&self, chunks: &[Chunk]) -> Blocks {
        let (model, radius_mm) = (self.model, self.model.tube_radius_mm);
        let spine = model.spine();
        let mut blocks = Blocks::empty(chunks.len(), self.noise_mm, self.spread_mm);
        for (section, (segment, at_mm)) in self.bins.places().zip(self.bins.places_mm()).enumerate() {
            let least = if segment % 2 == 1 { ARC_OVALITY * radius_mm } else { 0.0 };
            let oval_mm = oval_doubt_mm(model, &spine, at_mm).max(least);
            let (own, place) = (OWN_RADIUS * radius_mm, ANYWHERE * radius_mm);
            let stiff = [own, place, place, oval_mm, oval_mm].map(|s| (self.noise_mm / s).powi(2));
            let of = |(k, chunk): (usize, &Chunk)| Some((k, *chunk.sums.get(&section)?));
            let sums: Vec<(usize, Sum)> = chunks.iter().enumerate().filter_map(of).collect();
            blocks.add(&sums, &stiff);
        }
        blocks
    }

    /// Weight and derivatives of a point; None when it is not on the tube.
    fn row(&self, local: &Local, start: &Frame, p: [f64; 3]) -> Option<(f64, Row)> {
        let residual_mm = local.residual_mm(p, self.model.tube_radius_mm);
        let keep = 1.0 - (residual_mm / self.cutoff_mm).powi(2);
        if keep <= 0.0 {
            return None;
        }
        let place = start * Point3::from(p);
        if self.crowded.holds(&place) {
            return None;
        }
        let (u, v) = local.across(p);
        let size = u.hypot(v).max(1e-12);
        let (c, s) = (u / size, v / size);
        let normal = start.rotation * local.outward(p);
        let arm = (place - self.centre) / self.reach_mm;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tube::Lra;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    const RADIUS: f64 = 10.0;
    const NOISE: f64 = 0.03;

    /// A straight tube of 200 mm in stripes, scanned once from each side; the second pass lies off by `drift`.
    fn two_passes(drift: &Frame) -> Vec<Point3<f64>> {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut points = Vec::new();
        for (side, motion) in [(0.0, Frame::identity()), (2.0, *drift)] {
            for stripe in 0..160 {
                for k in 0..50 {
                    let turn = side - 1.4 + 0.056 * f64::from(k);
                    let r = RADIUS + NOISE * rng.sample::<f64, _>(StandardNormal);
                    points
                        .push(motion * Point3::new(1.25 * f64::from(stripe), r * turn.cos(), r * turn.sin()));
                }
            }
        }
        points
    }

    fn found(points: &[Point3<f64>]) -> Vec<ScanPass> {
        let cloud = PointCloud::from_points(points);
        let lra = Lra { bends: Vec::new(), last_length_mm: 200.0 };
        let chosen = Structure {
            model: TubeModel::round(Frame::identity(), lra, RADIUS),
            noise_mm: 1.2 * NOISE,
            correlation: 3.0,
            crowded: Crowded::default(),
            prior: None,
            held: Vec::new(),
            undecided: Vec::new(),
            decisions: Vec::new(),
        };
        realigned(&Whole::new(&cloud, None), &chosen).0
    }

    #[test]
    fn a_pass_is_found_to_the_point_and_moved_back() {
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.0, 2e-4, -3e-4));
        let drift = Frame::from_parts(nalgebra::Translation3::new(0.0, 0.06, -0.04), turn);
        let passes = found(&two_passes(&drift));
        let ends: Vec<u32> = passes.iter().map(|p| p.end).collect();
        assert_eq!(ends, [8000, u32::MAX]);
        // They see little in common: across that some micrometres are left.
        for x in [0.0, 100.0, 200.0] {
            let place = Point3::new(x, 0.0, 0.0);
            let off: Vector3<f64> = passes[1].motion * drift * place - passes[0].motion * place;
            assert!(off.yz().norm() < 0.012, "{off:?} at {x}: {passes:?}");
        }
    }

    #[test]
    fn one_pass_is_left_where_it_is() {
        assert!(found(&two_passes(&Frame::identity())).is_empty());
        assert!(found(&two_passes(&Frame::identity())[..8000]).is_empty());
    }
}
