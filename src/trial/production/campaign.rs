//! Many jobs of one part, each on a bender, a key and a batch of its own: how soon tubes are good, what is scrapped, what is stopped.

use std::collections::BTreeMap;

use rayon::prelude::*;
use serde::Serialize;

use super::controllers::Who;
use super::job::{Scenario, Shop, Tube};
use super::scanner::Scanner;
use crate::correct::Verdict;
use crate::sim::forming::World;
use crate::tube::Nominal;

/// Tubes of each job.
pub const TUBES: usize = 8;

/// The result, as `--json` prints it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Campaign {
    /// Name of the part.
    pub part: String,
    /// Key of the material.
    pub material: String,
    /// Jobs.
    pub jobs: u64,
    /// Seed of the first.
    pub seed: u64,
    /// By number of the tube in its job.
    pub tubes: Vec<Share>,
    /// How many tubes a job needed to the first good one, its own included: how many jobs for each number; the last for more.
    pub tubes_to_good: Vec<u64>,
    /// Tubes that were not good, in all jobs, before the first good one.
    pub scrap: u64,
    /// Tubes held though nothing was wrong, in percent.
    pub false_holds_percent: f64,
    /// Things mixed up, by name: how often, and how often not met rightly.
    pub mix_ups: BTreeMap<&'static str, Met>,
}

/// What became of one tube of all jobs, in percent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Share {
    /// Number in the job, from 1.
    pub tube: usize,
    /// Truly in tolerance, all angles and check points (the last end is the cut's).
    pub good_percent: f64,
    /// Called in tolerance.
    pub in_tolerance_percent: f64,
    /// After which the table was corrected.
    pub corrected_percent: f64,
    /// Held.
    pub held_percent: f64,
    /// Scanned more than once.
    pub scanned_again_percent: f64,
}

/// How one kind of mix-up was met.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Met {
    /// How often it was put in.
    pub injected: u64,
    /// How often benderd did not stop for it, or stopped where it should have read it.
    pub missed: u64,
}

/// Runs the jobs; `faults` puts one mix-up into each.
pub fn run(part: &Nominal, world: &World, jobs: u64, seed: u64, faults: bool) -> Campaign {
    let scenario = if faults { Scenario::MixUps } else { Scenario::Cold };
    let shop = Shop { world: world.clone(), scanner: Scanner::good(), scenario, parts: TUBES };
    let done: Vec<Vec<Tube>> =
        (0..jobs).into_par_iter().map(|k| shop.run(Who::Benderd, part, part, seed + k)).collect();
    let mut mix_ups: BTreeMap<&'static str, Met> = BTreeMap::new();
    for (which, met) in done.iter().flatten().filter_map(|tube| tube.mix_up) {
        let entry = mix_ups.entry(which.name()).or_default();
        entry.injected += 1;
        entry.missed += u64::from(!met);
    }
    let mut tubes_to_good = vec![0; TUBES + 1];
    for job in &done {
        tubes_to_good[job.iter().position(|tube| tube.good).unwrap_or(TUBES)] += 1;
    }
    let scrap = tubes_to_good.iter().zip(0..).map(|(jobs, tubes): (&u64, u64)| jobs * tubes).sum();
    let all: Vec<&Tube> = done.iter().flatten().collect();
    Campaign {
        part: part.name.clone(),
        material: part.material.key.clone(),
        jobs,
        seed,
        tubes: (0..TUBES)
            .map(|k| share(k + 1, &done.iter().map(|job| &job[k]).collect::<Vec<_>>()))
            .collect(),
        tubes_to_good,
        scrap,
        false_holds_percent: percent(&all, |tube| tube.held_falsely),
        mix_ups,
    }
}

fn share(tube: usize, all: &[&Tube]) -> Share {
    let said = |verdict| percent(all, |t: &Tube| t.verdict == Some(verdict));
    Share {
        tube,
        good_percent: percent(all, |t| t.good),
        in_tolerance_percent: said(Verdict::InTolerance),
        corrected_percent: said(Verdict::Correct),
        held_percent: said(Verdict::Hold),
        scanned_again_percent: percent(all, |t| t.scans > 1),
    }
}

fn percent(all: &[&Tube], is: impl Fn(&Tube) -> bool) -> f64 {
    100.0 * all.iter().filter(|tube| is(tube)).count() as f64 / all.len().max(1) as f64
}
