//! What stands between the readers and the door: a file's content before it is judged.

use std::ops::{AddAssign, Mul};

use rayon::prelude::*;

use super::Unit;

/// A coordinate as a file holds it.
pub(super) trait Coordinate:
    Copy + Default + PartialOrd + Mul<Output = Self> + AddAssign + Into<f64> + Send + Sync
{
    /// Its bits, equal for equal numbers (0 and -0 are).
    fn bits(self) -> u64;

    /// Points turned into offsets.
    fn offsets(points: Vec<[Self; 3]>, offset: impl Fn([Self; 3]) -> [f32; 3] + Sync) -> Vec<[f32; 3]>;
}

impl Coordinate for f32 {
    /// In place: the cloud is large.
    fn offsets(mut points: Vec<[f32; 3]>, offset: impl Fn([f32; 3]) -> [f32; 3] + Sync) -> Vec<[f32; 3]> {
        points.par_chunks_mut(TASK).for_each(|task| task.iter_mut().for_each(|p| *p = offset(*p)));
        points
    }

    fn bits(self) -> u64 {
        u64::from((self + 0.0).to_bits())
    }
}

impl Coordinate for f64 {
    fn offsets(points: Vec<[f64; 3]>, offset: impl Fn([f64; 3]) -> [f32; 3] + Sync) -> Vec<[f32; 3]> {
        points.par_iter().with_min_len(TASK).map(|&p| offset(p)).collect()
    }

    fn bits(self) -> u64 {
        (self + 0.0).to_bits()
    }
}

/// Points in the file's unit, as precise as the file: single precision takes half the memory.
#[derive(Debug)]
pub(super) enum Points {
    Single(Vec<[f32; 3]>),
    Double(Vec<[f64; 3]>),
}

impl Default for Points {
    fn default() -> Points {
        Points::Single(Vec::new())
    }
}

/// What a reader hands to the door: points in the file's unit, normals where the file has them.
#[derive(Debug)]
pub(super) struct Raw {
    pub points: Points,
    pub normals: Option<Vec<[f32; 3]>>,
    pub notes: Vec<String>,
    /// Corners of facets: a point is there as often as facets meet in it, which is no fault.
    pub corners: bool,
    /// The unit that the format prescribes.
    pub unit: Option<Unit>,
}

impl Raw {
    /// Points without normals.
    pub fn new(points: Points) -> Raw {
        Raw { points, normals: None, notes: Vec::new(), corners: false, unit: None }
    }
}

/// Points per task: fixed, so that results do not depend on the number of threads.
pub(super) const TASK: usize = 1 << 15;

/// Smallest and largest coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Bounds<T> {
    pub min: [T; 3],
    pub max: [T; 3],
    /// Whether every coordinate is a finite number (the bounds mean nothing otherwise).
    pub finite: bool,
}

impl<T: Coordinate> Bounds<T> {
    /// None without points.
    pub fn of(points: &[[T; 3]]) -> Option<Bounds<T>> {
        if points.len() <= TASK {
            return Bounds::of_task(points);
        }
        points.par_chunks(TASK).filter_map(Bounds::of_task).reduce_with(Bounds::join)
    }

    /// Four points side by side, which the compiler turns into vector instructions.
    fn of_task(points: &[[T; 3]]) -> Option<Bounds<T>> {
        let first = *points.first()?;
        let mut low: [T; 12] = std::array::from_fn(|i| first[i % 3]);
        let mut high = low;
        // A number times 0 is 0, or NaN when it is not finite: NaN stays in a sum.
        let mut strange = [T::default(); 12];
        let (fours, rest) = points.as_chunks::<4>();
        for four in fours {
            for (i, &v) in four.as_flattened().iter().enumerate() {
                low[i] = if v < low[i] { v } else { low[i] };
                high[i] = if v > high[i] { v } else { high[i] };
                strange[i] += v * T::default();
            }
        }
        for (i, &v) in rest.as_flattened().iter().enumerate() {
            low[i] = if v < low[i] { v } else { low[i] };
            high[i] = if v > high[i] { v } else { high[i] };
            strange[i] += v * T::default();
        }
        let lane = |from: &[T; 12], k: usize| std::array::from_fn(|i| from[3 * k + i]);
        let finite = strange.iter().all(|&s| s == T::default());
        let part = |k| Bounds { min: lane(&low, k), max: lane(&high, k), finite };
        Some((1..4).fold(part(0), |b, k| b.join(part(k))))
    }

    fn join(self, other: Bounds<T>) -> Bounds<T> {
        let pick = |a: [T; 3], b: [T; 3], first: fn(&T, &T) -> bool| {
            std::array::from_fn(|i| if first(&a[i], &b[i]) { a[i] } else { b[i] })
        };
        Bounds {
            min: pick(self.min, other.min, T::lt),
            max: pick(self.max, other.max, T::gt),
            finite: self.finite && other.finite,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_see_every_point_and_every_number_that_is_none() {
        for n in [1, 2, 4, 5, 11, TASK + 3] {
            let points: Vec<[f32; 3]> = (0..n).map(|i| [i as f32, -(i as f32), 0.5]).collect();
            let last = (n - 1) as f32;
            let bounds = Bounds::of(&points).unwrap();
            assert_eq!((bounds.min, bounds.max, bounds.finite), ([0.0, -last, 0.5], [last, 0.0, 0.5], true));
            for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                for at in [0, n / 2, n - 1] {
                    let mut points = points.clone();
                    points[at][at % 3] = bad;
                    assert!(!Bounds::of(&points).unwrap().finite, "{bad} at {at} of {n}");
                }
            }
        }
        assert_eq!(Bounds::<f64>::of(&[]), None);
    }
}
