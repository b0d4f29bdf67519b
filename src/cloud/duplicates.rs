//! Duplicates among millions of points without sorting them.
//!
//! A first pass over all points sets bits in a table by each point's hash; a point whose bits were all set before
//! is suspect (a few in a thousand, and every repetition). A second pass collects all points with a suspect's
//! hash, and only those are sorted and compared. The table decides what is looked at, never what is found: the
//! answer is exact and does not depend on the order in which threads run.

use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;

use super::raw::{Coordinate, TASK};

/// Points per word of the table: 16 bits for each.
const SHARE: usize = 4;

/// Ascending indices of the points that equal an earlier one. Coordinates must be finite.
pub(super) fn repeated<T: Coordinate>(points: &[[T; 3]]) -> Vec<u32> {
    let suspects = suspects(points);
    if suspects.is_empty() {
        return Vec::new();
    }
    let looked_at = Marks::new(suspects.len() * 16);
    suspects.iter().for_each(|&hash| _ = looked_at.mark(hash));
    let mut alike: Vec<(u64, u32)> = collect(points, |hash| looked_at.has(hash), |hash, i| (hash, i));
    let key = |i: u32| points[i as usize].map(T::bits);
    alike.par_sort_unstable();
    let mut out = Vec::new();
    for group in alike.chunk_by_mut(|a, b| a.0 == b.0).filter(|g| g.len() > 1) {
        // Equal hashes are nearly always equal points; sorted all the same, so that no file can make this slow.
        group.sort_unstable_by_key(|&(_, i)| (key(i), i));
        out.extend(group.windows(2).filter(|w| key(w[0].1) == key(w[1].1)).map(|w| w[1].1));
    }
    out.par_sort_unstable();
    out
}

/// Hashes of all points that may be a repetition: of two equal points at least one.
fn suspects<T: Coordinate>(points: &[[T; 3]]) -> Vec<u64> {
    let seen = Marks::new(points.len() / SHARE);
    collect(points, |hash| seen.mark(hash), |hash, _| hash)
}

/// What `take` makes of the points whose hash is `wanted`, in order.
fn collect<T: Coordinate, R: Send>(
    points: &[[T; 3]],
    wanted: impl Fn(u64) -> bool + Sync,
    take: impl Fn(u64, u32) -> R + Sync,
) -> Vec<R> {
    let task = |(k, task): (usize, &[[T; 3]])| -> Vec<R> {
        let hashed = task.iter().zip((k * TASK) as u32..).map(|(p, i)| (hash(p), i));
        hashed.filter(|&(hash, _)| wanted(hash)).map(|(hash, i)| take(hash, i)).collect()
    };
    let parts: Vec<Vec<R>> = points.par_chunks(TASK).enumerate().map(task).collect();
    parts.into_iter().flatten().collect()
}

/// A set of hashes that may answer yes in error, never no.
struct Marks {
    words: Vec<AtomicU64>,
    shift: u32,
}

impl Marks {
    fn new(words: usize) -> Marks {
        let words = words.next_power_of_two().max(64);
        Marks { words: (0..words).map(|_| AtomicU64::new(0)).collect(), shift: 64 - words.ilog2() }
    }

    /// Word and bits of a hash: the word from its top bits, three bits from its lowest.
    fn place(&self, hash: u64) -> (&AtomicU64, u64) {
        let bit = |k: u32| 1u64 << (hash >> (6 * k) & 63);
        (&self.words[(hash >> self.shift) as usize], bit(0) | bit(1) | bit(2))
    }

    /// Adds a hash; true when it may have been there.
    fn mark(&self, hash: u64) -> bool {
        let (word, bits) = self.place(hash);
        word.fetch_or(bits, Ordering::Relaxed) & bits == bits
    }

    fn has(&self, hash: u64) -> bool {
        let (word, bits) = self.place(hash);
        word.load(Ordering::Relaxed) & bits == bits
    }
}

/// A 64-bit mixture of a point's bits: the halves of a 128-bit product, twice (the constants are odd and have no
/// structure).
fn hash<T: Coordinate>(p: &[T; 3]) -> u64 {
    let [x, y, z] = p.map(T::bits);
    let mix = |a: u64, b: u64| {
        let product = u128::from(a) * u128::from(b);
        product as u64 ^ (product >> 64) as u64
    };
    let xy = mix(x ^ 0x9e37_79b9_7f4a_7c15, y.rotate_left(32) ^ 0x243f_6a88_85a3_08d3);
    mix(xy ^ z.rotate_left(17), 0xa076_1d64_78bd_642f)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    fn brute(points: &[[f64; 3]]) -> Vec<u32> {
        let mut seen = BTreeSet::new();
        (0..points.len() as u32).filter(|&i| !seen.insert(points[i as usize].map(f64::bits))).collect()
    }

    #[test]
    fn the_first_of_each_stays() {
        let p = |x: f64| [x, 0.0, 1.0];
        assert_eq!(repeated(&[p(3.0), p(1.0), p(3.0), p(2.0), p(1.0), p(1.0)]), [2, 4, 5]);
        assert_eq!(repeated(&[p(0.0), p(-0.0)]), [1]);
        assert_eq!(repeated::<f32>(&[]), [0u32; 0]);
    }

    #[test]
    fn many_tasks_many_copies_and_nothing_but_copies() {
        let points: Vec<[f64; 3]> =
            (0..200_000).map(|i| [f64::from(i % 150_001), f64::from(i % 3), 0.25]).collect();
        assert_eq!(repeated(&points), brute(&points));
        assert_eq!(repeated(&vec![[1.0f32; 3]; 100_000]), (1..100_000).collect::<Vec<_>>());
    }

    #[test]
    fn few_points_of_a_lattice_are_suspect() {
        let points: Vec<[f32; 3]> =
            (0..100_000).map(|i| [(i % 100) as f32, (i / 100 % 100) as f32, (i / 10_000) as f32]).collect();
        assert!(suspects(&points).len() < 1500, "{}", suspects(&points).len());
        assert!(repeated(&points).is_empty());
    }

    proptest! {
        #[test]
        fn brute_force_agrees(coords in prop::collection::vec((-4i32..4, -4i32..4, -2i32..2), 0..300)) {
            let points: Vec<[f64; 3]> =
                coords.iter().map(|&(x, y, z)| [f64::from(x) * 0.1, f64::from(y), f64::from(z)]).collect();
            prop_assert_eq!(repeated(&points), brute(&points));
        }
    }
}
