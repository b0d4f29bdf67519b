//! Work on all cores whose results are taken in order, each as soon as those before it are there: sums come out the same whatever
//! the threads, and no more than a few parts wait.
//!
//! Under `whole`.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Results on their way.
struct Line<T, F> {
    /// The one to be taken next.
    next: usize,
    waiting: BTreeMap<usize, T>,
    take: F,
}

/// Makes `count` parts on the pool's threads, and takes them in order on whichever has made the next one.
pub fn in_order<T: Send>(count: usize, make: impl Fn(usize) -> T + Sync, take: impl FnMut(T) + Send) {
    let begun = AtomicUsize::new(0);
    let line = Mutex::new(Line { next: 0, waiting: BTreeMap::new(), take });
    let work = || {
        loop {
            let part = begun.fetch_add(1, Ordering::Relaxed);
            if part >= count {
                return;
            }
            let made = make(part);
            let line = &mut *line.lock().unwrap_or_else(PoisonError::into_inner);
            line.waiting.insert(part, made);
            while let Some(made) = line.waiting.remove(&line.next) {
                (line.take)(made);
                line.next += 1;
            }
        }
    };
    let threads = rayon::current_num_threads().min(count);
    rayon::scope(|scope| (0..threads).for_each(|_| scope.spawn(|_| work())));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_taken_in_order_whatever_the_threads() {
        for threads in [1, 2, 5] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut taken = Vec::new();
            // Later parts are ready sooner.
            let slow = |k: usize| (0..(40 - k) * 2000).fold(k, |a, b| std::hint::black_box(a ^ b ^ b));
            pool.install(|| in_order(40, slow, |k| taken.push(k)));
            assert_eq!(taken, (0..40).collect::<Vec<_>>());
        }
        in_order(0, |k| k, |_| panic!("nothing was made"));
    }
}
