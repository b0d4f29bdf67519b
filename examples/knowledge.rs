//! A knowledge file of simulated jobs, for trying `benderd knowledge`:
//! `cargo run --release --example knowledge -- K.json 3 10` bends a job of three parts, and one of ten of another batch and program, on
//! one key.

#![allow(clippy::print_stdout)] // an example prints for people

use std::path::PathBuf;

use anyhow::{Context, bail};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use benderd::config::{Materials, load_part};
use benderd::correct::{History, Knowledge, Limits, SetUp, learn, store};
use benderd::sim::forming::Plant;
use benderd::trial::production::stand::Stand;

/// The plant's, so that the same arguments give the same file.
const SEED: u64 = 3;

fn main() -> anyhow::Result<()> {
    let mut words = std::env::args().skip(1);
    let path: PathBuf =
        words.next().context("which file is to be written, and of jobs of how many parts?")?.into();
    let jobs = words.map(|w| w.parse::<usize>().with_context(|| format!("{w}: not a number of parts")));
    let jobs = jobs.collect::<anyhow::Result<Vec<_>>>()?;
    if path.exists() {
        bail!("{}: exists already; name a new file", path.display());
    }
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
    let nominal = load_part(&root.join("config/parts/bracket-17.toml"), &Materials::shipped()?)?;
    let (limits, mut known) = (Limits::default(), Knowledge::default());
    let mut stand = Stand { plant: Plant::new(&nominal, SEED), rng: ChaCha8Rng::seed_from_u64(SEED) };
    for (number, parts) in (1..).zip(jobs) {
        let key = SetUp { bender: "b1".to_owned(), lubrication: "std".to_owned() };
        let begun = History { key, batch: Some(format!("h{}", 76 + number)), parts: Vec::new() };
        let history = stand.job(&format!("job {number}"), &nominal, &known, begun, parts);
        known = learn(&nominal, &history, &known, &limits);
        stand.plant.new_batch();
        stand.plant.new_program(&nominal);
    }
    store::save(&path, &known)?;
    println!("{}: {} jobs", path.display(), known.keys.iter().map(|k| k.jobs.len()).sum::<usize>());
    Ok(())
}
