//! How long one step of the correction takes for a part of fifteen bends, by the number of parts in its history:
//! `cargo bench --bench correct`. The aim is less than a millisecond.

use std::time::Duration;

use criterion::{BenchmarkId, Criterion};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use benderd::correct::{History, Knowledge, Limits, learn, step};
use benderd::sim::forming::Plant;
use benderd::trial::production::stand::Stand;
use benderd::tube::{Bend, Lra, Nominal};

const BENDS: u32 = 15;
/// Parts in the history.
const PARTS: [usize; 4] = [0, 1, 5, 20];
/// Jobs on the same key before, where something is known.
const JOBS: u64 = 20;

fn part() -> Nominal {
    let bend = |i: u32| Bend {
        length_mm: 60.0 + f64::from(i * 37 % 90),
        rotation_rad: f64::from(i * 77 % 300).to_radians() - 2.6,
        angle_rad: f64::from(20 + i * 29 % 95).to_radians(),
        radius_mm: 50.8,
    };
    let lra = Lra { bends: (0..BENDS).map(bend).collect(), last_length_mm: 150.0 };
    Nominal::of_table(lra, 25.4, 1.65)
}

/// A job of so many parts, each bent with the table of the step before.
fn job(nominal: &Nominal, parts: usize, knowledge: &Knowledge, seed: u64) -> History {
    let (plant, rng) = (Plant::new(nominal, seed), ChaCha8Rng::seed_from_u64(seed));
    let begun = History { batch: Some(format!("batch {}", seed % 3)), ..History::default() };
    Stand { plant, rng }.job(&seed.to_string(), nominal, knowledge, begun, parts)
}

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    let (nominal, limits) = (part(), Limits::default());
    let nothing = Knowledge::default();
    let known = (1..=JOBS).fold(Knowledge::default(), |known, seed| {
        learn(&nominal, &job(&nominal, 3, &nothing, seed), &known, &limits)
    });
    let mut group = criterion.benchmark_group("correct");
    group.warm_up_time(Duration::from_millis(500)).measurement_time(Duration::from_secs(2));
    for parts in PARTS {
        for (name, knowledge) in [("new key", &nothing), ("key of 20 jobs", &known)] {
            let history = job(&nominal, parts, knowledge, 100);
            group.bench_function(BenchmarkId::new(name, parts), |b| {
                b.iter(|| step(&nominal, &history, knowledge, &limits))
            });
        }
    }
    group.finish();
    criterion.final_summary();
}
