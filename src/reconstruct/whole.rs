//! All points of the tube, for the last part of the reconstruction: walked where they lie, in chunks on all cores.
//!
//! Between `finish` and the cloud. A point is looked for where the one before it was: in a file's order that is nearly
//! always the same segment, and the surface there tells. Only where it does not are all segments asked.

use nalgebra::{Point3, Vector3};

use super::fit::{CUTOFF_SIGMAS, Data};
use super::in_order::in_order;
use super::lanes::Adder;
use super::local::{Local, prepare, settle};
use super::model::TubeModel;
use super::moderate::drawn;
use super::moments::{CHUNK, Pass};
use super::ramps::Ramps;
use crate::cloud::PointCloud;
use crate::tube::{Frame, Spine};

/// Chunks at most: their sums take room.
const MOST_CHUNKS: usize = 64;

/// The tube is taken to go on this many radii beyond its first guess of the ends.
const BEYOND_RADII: f64 = 2.0;

/// A cloud's points, or those of them that are the tube's; as they lie, or pass by pass where they belong.
#[derive(Debug, Clone, Copy)]
pub struct Whole<'a> {
    cloud: &'a PointCloud,
    own: Option<&'a [u32]>,
    passes: &'a [ScanPass],
}

/// Consecutive points of a scan that moved as one, from where those of the pass before end: a pass of the arm.
#[derive(Debug, Clone, PartialEq)]
pub struct ScanPass {
    /// Index behind its last point; of the last pass no less than the cloud's length.
    pub end: u32,
    /// What takes its points to where they belong.
    pub motion: Frame,
}

/// A segment as the cloud's offsets see it.
struct View {
    turn: [[f64; 3]; 3],
    shift: [f64; 3],
}

/// A model ready for a walk.
struct Walk {
    locals: Vec<Local>,
    /// Of every pass the segments.
    views: Vec<Vec<View>>,
    /// Range along each straight.
    ranges_mm: Vec<(f64, f64)>,
    /// Squares of the distances from the axis between which a point is on the surface beyond doubt.
    on_surface: (f64, f64),
}

impl<'a> Whole<'a> {
    /// All points, or those with these indices.
    pub fn new(cloud: &'a PointCloud, own: Option<&'a [u32]>) -> Whole<'a> {
        Whole { cloud, own, passes: &[] }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.own.map_or(self.cloud.len(), <[u32]>::len)
    }

    /// Indices of at most about so many of the points, in runs of `run` as they lie in the file.
    pub fn runs(&self, run: usize, most: usize) -> Vec<u32> {
        self.runs_within(0, u32::MAX, run, most)
    }

    /// The same of the points whose indices are from `from` to before `end`.
    pub fn runs_within(&self, from: u32, end: u32, run: usize, most: usize) -> Vec<u32> {
        let (first, behind) = match self.own {
            None => (from as usize, (end as usize).min(self.cloud.len())),
            Some(own) => (own.partition_point(|i| *i < from), own.partition_point(|i| *i < end)),
        };
        let every = behind.saturating_sub(first).div_ceil(most).max(1);
        let kept = (first..behind).filter(|i| ((i - first) / run).is_multiple_of(every));
        kept.map(|i| self.index(i)).collect()
    }

    /// Indices of the points about one, `reach` to either side.
    pub fn around(&self, index: u32, reach: usize) -> Vec<u32> {
        let at = self.own.map_or(index as usize, |own| own.partition_point(|i| *i < index));
        let range = at.saturating_sub(reach)..(at + reach).min(self.len());
        range.map(|i| self.index(i)).collect()
    }

    /// The cloud's index of the tube's point `i`.
    fn index(&self, i: usize) -> u32 {
        self.own.map_or(i as u32, |own| own[i])
    }

    /// Those of the cloud's points that have these indices.
    pub fn only<'b>(&self, indices: &'b [u32]) -> Whole<'b>
    where
        'a: 'b,
    {
        Whole { own: Some(indices), ..*self }
    }

    /// The same points with each pass where it belongs; none are moved when there are no passes.
    pub fn moved<'b>(&self, passes: &'b [ScanPass]) -> Whole<'b>
    where
        'a: 'b,
    {
        Whole { passes, ..*self }
    }

    /// The passes that points are moved by.
    pub fn passes(&self) -> &'a [ScanPass] {
        self.passes
    }

    /// All that the file holds, the tube's or not.
    pub fn file_len(&self) -> usize {
        self.cloud.len()
    }

    /// One point, where it belongs.
    pub fn point(&self, index: u32) -> Point3<f64> {
        let point = self.cloud.point(index as usize);
        let pass = self.passes.iter().find(|p| index < p.end);
        pass.map_or(point, |pass| pass.motion * point)
    }

    /// At most so many of the points, where they belong, drawn from all of the file.
    pub fn share(&self, most: usize) -> Vec<Point3<f64>> {
        drawn(self.len(), most).into_iter().map(|i| self.point(self.index(i))).collect()
    }

    /// Walks all points. Each is given to `add` with its segment and its place in that segment's frame; one `new` per
    /// chunk, in order.
    pub fn walk<S: Send>(
        &self,
        model: &TubeModel,
        near_mm: f64,
        new: impl Fn() -> S + Sync,
        add: impl Fn(&mut S, usize, [f64; 3]) + Sync,
    ) -> Vec<S> {
        self.walk_passes(model, near_mm, new, |sums, _, segment, place| add(sums, segment, place))
    }

    /// The same; `add` is told the pass first, 0 where there are none.
    pub fn walk_passes<S: Send>(
        &self,
        model: &TubeModel,
        near_mm: f64,
        new: impl Fn() -> S + Sync,
        add: impl Fn(&mut S, usize, usize, [f64; 3]) + Sync,
    ) -> Vec<S> {
        let mut out = Vec::new();
        self.walk_in_order((model, near_mm), new, add, |part| part, |part| out.push(part));
        out
    }

    /// The same from `near_mm` of the model; each chunk's part is `done` with at once and given to `take` in order.
    fn walk_in_order<S, R: Send>(
        &self,
        (model, near_mm): (&TubeModel, f64),
        new: impl Fn() -> S + Sync,
        add: impl Fn(&mut S, usize, usize, [f64; 3]) + Sync,
        done: impl Fn(S) -> R + Sync,
        take: impl FnMut(R) + Send,
    ) {
        let walk = Walk::new(model, self.cloud.origin(), near_mm, self.passes);
        let chunk = self.len().div_ceil(MOST_CHUNKS).max(CHUNK);
        let all = self.cloud.offsets();
        let through = |k: usize| {
            let (mut sums, mut segment, mut pass) = (new(), 0, 0);
            for i in k * chunk..((k + 1) * chunk).min(self.len()) {
                let index = self.index(i);
                while self.passes.get(pass).is_some_and(|p| index >= p.end) && pass + 1 < self.passes.len() {
                    pass += 1;
                }
                let place = walk.find(all[index as usize], pass, &mut segment);
                add(&mut sums, pass, segment, place);
            }
            done(sums)
        };
        in_order(self.len().div_ceil(chunk), through, take);
    }

    /// The points of the first and of the last straight that lie no farther along it than `first_mm`, or no farther
    /// from its end than `last_mm`; each in the frame of its [end](end_frames).
    pub fn ends(
        &self,
        model: &TubeModel,
        near_mm: f64,
        first_mm: f64,
        last_mm: f64,
    ) -> [Vec<Point3<f64>>; 2] {
        let (spine, locals) = (model.spine(), prepare(model));
        let last = spine.segments().len() - 1;
        let from_last = spine.segments()[last].length_mm - last_mm;
        let into = end_frames(&spine).map(|frame| frame.inverse());
        let ends = [0, last].map(|k| (k as u32, spine.segments()[k].length_mm)).into_iter().zip(into);
        let parts = self.walk(model, near_mm, <[Vec<_>; 2]>::default, |kept, segment, p| {
            if (segment == 0 && p[0] <= first_mm) || (segment == last && p[0] >= from_last) {
                let point = spine.segments()[segment].start * Point3::from(p);
                let mut own = segment as u32;
                settle(&point, &mut own, &locals);
                for (kept, ((k, length_mm), into)) in kept.iter_mut().zip(ends.clone()) {
                    let point = into * point;
                    if own == k && point.x <= length_mm {
                        kept.push(point);
                    }
                }
            }
        });
        let (first, last) = parts.into_iter().map(|[first, last]| (first, last)).unzip();
        [joined(first), joined(last)]
    }
}

/// The frames of a tube's ends: x leads into the tube.
pub fn end_frames(spine: &Spine) -> [Frame; 2] {
    let back = Frame::rotation(Vector3::new(0.0, std::f64::consts::PI, 0.0));
    [spine.segments()[0].start, spine.frame_at(spine.length_mm()) * back]
}

/// All parts in one, each given back as soon as it is in there.
fn joined<T>(parts: Vec<Vec<T>>) -> Vec<T> {
    let mut all = Vec::with_capacity(parts.iter().map(Vec::len).sum());
    parts.into_iter().for_each(|part| all.extend(part));
    all
}

impl Data for Whole<'_> {
    fn pass(&mut self, model: &TubeModel, cutoff_mm: f64) -> Pass {
        let (locals, ramps) = (prepare(model), Ramps::of(model));
        let new = || Adder::new(&locals, &ramps, model, cutoff_mm);
        let add = |adder: &mut Adder, _: usize, segment: usize, p: [f64; 3]| adder.add(segment, p);
        let mut total = Pass::empty(locals.len());
        self.walk_in_order((model, cutoff_mm), new, add, Adder::finish, |part| total.merge(&part));
        total.doubting(&ramps, cutoff_mm / CUTOFF_SIGMAS)
    }
}

impl Whole<'_> {
    /// The sums of each pass by itself.
    pub fn by_pass(&self, model: &TubeModel, cutoff_mm: f64) -> Vec<Pass> {
        let (locals, ramps) = (prepare(model), Ramps::of(model));
        let count = self.passes.len().max(1);
        let new = || (0..count).map(|_| Adder::new(&locals, &ramps, model, cutoff_mm)).collect::<Vec<_>>();
        let add = |adders: &mut Vec<Adder>, pass: usize, segment: usize, p: [f64; 3]| {
            adders[pass].add(segment, p);
        };
        let done = |adders: Vec<Adder>| adders.into_iter().map(Adder::finish).collect::<Vec<_>>();
        let mut totals = vec![Pass::empty(locals.len()); count];
        let take =
            |parts: Vec<Pass>| totals.iter_mut().zip(&parts).for_each(|(total, part)| total.merge(part));
        self.walk_in_order((model, cutoff_mm), new, add, done, take);
        totals.into_iter().map(|total| total.doubting(&ramps, cutoff_mm / CUTOFF_SIGMAS)).collect()
    }
}

impl Walk {
    fn new(model: &TubeModel, origin: Point3<f64>, near_mm: f64, passes: &[ScanPass]) -> Walk {
        let locals = prepare(model);
        let last = locals.len() - 1;
        let radius = model.tube_radius_mm;
        let view = |motion: &Frame, local: &Local| {
            let to_local = local.to_local * motion;
            let turn = to_local.rotation.to_rotation_matrix();
            View {
                turn: std::array::from_fn(|row| std::array::from_fn(|column| turn[(row, column)])),
                shift: (to_local * origin).into(),
            }
        };
        let of = |motion: &Frame| locals.iter().map(|l| view(motion, l)).collect();
        let views = match passes {
            [] => vec![of(&Frame::identity())],
            passes => passes.iter().map(|p| of(&p.motion)).collect(),
        };
        let range = |(k, local): (usize, &Local)| {
            let beyond = |end: bool| if end { BEYOND_RADII * radius } else { 0.0 };
            (-beyond(k == 0), local.length_mm + beyond(k == last))
        };
        let ranges_mm = locals.iter().enumerate().map(range).collect();
        let on_surface = ((radius - near_mm).max(0.0).powi(2), (radius + near_mm).powi(2));
        Walk { locals, views, ranges_mm, on_surface }
    }

    /// Puts the segment that a point faces into `segment`; returns its place there.
    fn find(&self, offset: [f32; 3], pass: usize, segment: &mut usize) -> [f64; 3] {
        let offset = offset.map(f64::from);
        let views = &self.views[pass];
        let place = views[*segment].see(offset);
        if self.explains(*segment, place) {
            return place;
        }
        let beside = [*segment + 1, segment.wrapping_sub(1)];
        for k in beside.into_iter().filter(|k| *k < views.len()) {
            let place = views[k].see(offset);
            if self.explains(k, place) {
                *segment = k;
                return place;
            }
        }
        let distances = views.iter().zip(&self.locals).map(|(v, l)| l.square_from_axis(v.see(offset)));
        let nearest = distances.enumerate().min_by(|a, b| a.1.total_cmp(&b.1));
        *segment = nearest.map_or(0, |n| n.0);
        views[*segment].see(offset)
    }

    /// Whether a point lies on a segment's surface.
    fn explains(&self, segment: usize, p: [f64; 3]) -> bool {
        let square = match &self.locals[segment].arc {
            None => {
                let (from, to) = self.ranges_mm[segment];
                if p[0] < from || p[0] > to {
                    return false;
                }
                p[1] * p[1] + p[2] * p[2]
            }
            Some(_) => self.locals[segment].square_from_axis(p),
        };
        self.on_surface.0 <= square && square <= self.on_surface.1
    }
}

impl View {
    fn see(&self, p: [f64; 3]) -> [f64; 3] {
        let row = |k: usize| {
            let turn = &self.turn[k];
            turn[0] * p[0] + turn[1] * p[1] + turn[2] * p[2] + self.shift[k]
        };
        [row(0), row(1), row(2)]
    }
}

/// Signed distances of all points of a cloud from a model's surface, in the cloud's order.
pub fn residuals_mm(cloud: &PointCloud, model: &TubeModel) -> Vec<f64> {
    let locals = prepare(model);
    let radius = model.tube_radius_mm;
    // On the surface to a tenth of the radius: beyond doubt.
    let parts = Whole::new(cloud, None).walk(model, 0.1 * radius, Vec::new, |out, segment, p| {
        out.push(locals[segment].residual_mm(p, radius));
    });
    parts.concat()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reconstruct::fit::{Effort, fit};
    use crate::reconstruct::moments::Sample;
    use crate::tube::{Bend, Lra};

    /// A tube that comes back on itself, with points on, in and around it, in no order.
    fn case(points: usize) -> (TubeModel, PointCloud) {
        let bend = |length_mm, rotation_rad, angle_rad, radius_mm| Bend {
            length_mm,
            rotation_rad,
            angle_rad,
            radius_mm,
        };
        let bends = vec![bend(60.0, 0.0, 3.1, 25.0), bend(40.0, 2.0, 3.6, 31.0), bend(0.5, -0.7, 0.1, 28.0)];
        let mut model = TubeModel::round(
            Frame::new(Vector3::new(5.0, -7.0, 300.0), Vector3::new(0.4, -1.0, 0.3)),
            Lra { bends, last_length_mm: 50.0 },
            10.0,
        );
        model.ovality_mm = vec![-0.4, 0.3, -0.2];
        let spine = model.spine();
        let at = |i: usize| {
            let turn = 2.4 * i as f64;
            let radius = 10.0 + 0.05 * (1.7 * i as f64).sin() - if i.is_multiple_of(50) { 6.0 } else { 0.0 };
            let frame = spine.frame_at((0.618_034 * i as f64).fract() * spine.length_mm());
            frame * Point3::new(0.0, radius * turn.cos(), radius * turn.sin())
        };
        (model, PointCloud::from_points(&(0..points).map(at).collect::<Vec<_>>()))
    }

    #[test]
    fn every_point_finds_its_segment() {
        let (model, cloud) = case(5000);
        let found = residuals_mm(&cloud, &model);
        let expected = Sample::new(cloud.iter().collect(), &model).residuals(&model);
        for (i, (a, b)) in found.iter().zip(&expected).enumerate() {
            assert!((a - b).abs() < 1e-9, "point {i}: {a} {b}");
        }
    }

    /// Without ramps, which samples do not doubt.
    fn round_case(points: usize) -> (TubeModel, PointCloud) {
        let (model, cloud) = case(points);
        (TubeModel { ovality_mm: vec![0.0; 3], ..model }, cloud)
    }

    #[test]
    fn the_pass_is_the_samples() {
        let (model, cloud) = round_case(5000);
        let own: Vec<u32> = (0..cloud.len() as u32).filter(|i| !i.is_multiple_of(3)).collect();
        let points = own.iter().map(|&i| cloud.point(i as usize)).collect();
        let expected = Sample::new(points, &model).pass(&model, 0.2);
        let found = Whole::new(&cloud, Some(&own)).pass(&model, 0.2);
        assert_eq!(found.used(), expected.used());
        assert!((found.cost / expected.cost - 1.0).abs() < 1e-9);
        for (a, b) in found.moments.iter().zip(&expected.moments) {
            assert!((a - b).amax() <= 1e-9 * b.amax());
        }
    }

    /// Half the surface of an S whose sections turn oval evenly and late, and round again soon, not as the model has it.
    fn another_ramp(model: &TubeModel) -> PointCloud {
        let spine = model.spine();
        let oval_mm = |at: f64| {
            let bends = spine.segments().iter().enumerate().skip(1).step_by(2);
            let inside = bends.map(|(k, arc)| {
                let from_start = (at - arc.start_mm) / (1.4 * model.tube_radius_mm);
                let from_end = (arc.start_mm + arc.length_mm - at) / (0.6 * model.tube_radius_mm);
                from_start.min(from_end).clamp(0.0, 1.0) * model.ovality_mm[k / 2]
            });
            inside.sum::<f64>()
        };
        let place = |i: usize| {
            let at = (0.618_034 * i as f64).fract() * spine.length_mm();
            let turn = 3.0 * (0.414_214 * i as f64).fract();
            // The outside of a bend is at -y.
            let noise_mm = 0.04 * (1.7 * i as f64).sin();
            let radius = model.tube_radius_mm + oval_mm(at) * (2.0 * turn).cos() + noise_mm;
            spine.frame_at(at) * Point3::new(0.0, radius * turn.cos(), radius * turn.sin())
        };
        PointCloud::from_points(&(0..40_000).map(place).collect::<Vec<_>>())
    }

    #[test]
    fn how_sections_turn_oval_does_not_tell_where_the_bends_are() {
        let bend =
            |length_mm, rotation_rad, angle_rad| Bend { length_mm, rotation_rad, angle_rad, radius_mm: 30.0 };
        let bends = vec![bend(80.0, 0.0, 1.2), bend(15.0, std::f64::consts::PI, 1.1)];
        let mut model = TubeModel::round(Frame::identity(), Lra { bends, last_length_mm: 70.0 }, 10.0);
        model.ovality_mm = vec![-0.3, -0.25];
        let cloud = another_ramp(&model);
        let effort = Effort { cutoff_mm: 0.2, rounds: 0, steps: 30, prior: None };
        let off_mm = |found: &TubeModel| (found.lra.bends[1].length_mm - 15.0).abs();
        let exact = fit(&mut Sample::new(cloud.iter().collect(), &model), &model, effort);
        let doubting = fit(&mut Whole::new(&cloud, None), &model, effort);
        let (exact_mm, doubting_mm) = (off_mm(&exact.model), off_mm(&doubting.model));
        assert!(doubting_mm < 0.2 * exact_mm && exact_mm > 0.01, "{doubting_mm} {exact_mm}");
    }

    #[test]
    fn passes_are_walked_where_they_belong() {
        let (model, cloud) = round_case(5000);
        let motion = Frame::new(Vector3::new(0.1, -0.2, 0.05), Vector3::new(1e-3, 0.0, -2e-3));
        let passes = [
            ScanPass { end: 1500, motion: Frame::identity() },
            ScanPass { end: 3200, motion },
            ScanPass { end: u32::MAX, motion: motion.inverse() },
        ];
        let own: Vec<u32> = (0..cloud.len() as u32).filter(|i| !i.is_multiple_of(3)).collect();
        let moved = |i: &u32| passes.iter().find(|p| i < &p.end).unwrap().motion * cloud.point(*i as usize);
        let points: Vec<Point3<f64>> = own.iter().map(moved).collect();
        let expected = Sample::new(points.clone(), &model).pass(&model, 0.2);
        let whole = Whole::new(&cloud, Some(&own));
        let mut whole = whole.moved(&passes);
        assert_eq!(whole.share(own.len()), points);
        let found = whole.pass(&model, 0.2);
        let parts = whole.by_pass(&model, 0.2);
        let total = Pass::total(found.moments.len(), parts.iter().cloned());
        for pass in [&found, &total] {
            assert_eq!(pass.used(), expected.used());
            assert!((pass.cost / expected.cost - 1.0).abs() < 1e-6);
        }
        assert!(parts.len() == 3 && parts.iter().all(|p| p.used() > 100));
    }

    #[test]
    fn a_range_is_taken_in_runs() {
        let (_, cloud) = case(5000);
        let own: Vec<u32> = (0..5000).filter(|i| i % 2 == 0).collect();
        let whole = Whole::new(&cloud, Some(&own));
        assert_eq!(whole.runs_within(100, 110, 100, 10), [100, 102, 104, 106, 108]);
        assert_eq!(whole.around(100, 2), [96, 98, 100, 102]);
        let some = whole.runs_within(1000, 5000, 100, 1000);
        assert!(some.len() == 1000 && some[99] == 1198 && some[100] == 1400);
        assert!(whole.runs_within(4, 4, 100, 10).is_empty());
    }

    #[test]
    fn each_end_gets_the_points_of_its_straight_in_its_own_frame() {
        let (model, cloud) = case(5000);
        let spine = model.spine();
        let points: Vec<_> = cloud.iter().collect();
        let mut sample = Sample::new(points.clone(), &model);
        sample.residuals(&model);
        let all = Whole::new(&cloud, None);
        let found = all.ends(&model, 0.2, f64::INFINITY, f64::INFINITY);
        let segments = [0, spine.segments().len() - 1];
        for ((frame, segment), found) in end_frames(&spine).iter().zip(segments).zip(&found) {
            let mine = points.iter().zip(sample.segments()).filter(|(_, s)| **s as usize == segment);
            let mine: Vec<_> = mine.map(|(p, _)| frame.inverse() * p).collect();
            assert!(mine.len() > 500 && mine.len() == found.len());
            assert!(mine.iter().zip(found).all(|(a, b)| (a - b).norm() < 1e-9));
        }
        let some = all.ends(&model, 0.2, 10.0, 20.0);
        for ((some, found), reach_mm) in some.iter().zip(&found).zip([10.0, 20.0]) {
            let near: Vec<_> = found.iter().filter(|p| p.x <= reach_mm).copied().collect();
            assert_eq!(*some, near);
        }
    }

    #[test]
    fn sums_do_not_depend_on_the_number_of_threads() {
        let (model, cloud) = case(20_000);
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| Whole::new(&cloud, None).pass(&model, 0.2))
        };
        let (one, three) = (run(1), run(3));
        assert_eq!(one.cost.to_bits(), three.cost.to_bits());
        assert_eq!(one.moments, three.moments);
    }
}
