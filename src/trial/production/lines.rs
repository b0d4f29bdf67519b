//! The lines of the campaign, and their figures.

use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::controllers::Who;
use super::job::{Scenario, Shop, Tube};
use super::parts::{Stock, part};
use super::scanner::Scanner;
use crate::correct::Verdict;
use crate::sim::forming::World;
use crate::sim::forming::curves::Curve;
use crate::tube::Material;

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// One question.
#[derive(Debug, Clone)]
pub struct Line {
    /// In words.
    pub name: String,
    /// Where.
    pub shop: Shop,
    /// What is bent.
    pub material: Material,
    /// Tubes and dies; jobs take turns.
    pub stocks: Vec<Stock>,
    /// Length of the parts, where it matters.
    pub length_mm: Option<f64>,
}

/// What became of the tubes with some numbers in all jobs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Figures {
    /// Percent with all angles within 0.3 degrees.
    pub within_03: f64,
    /// The same within 0.5.
    pub within_05: f64,
    /// Percent with all check points within 1 mm, across the tube.
    pub lateral_1: f64,
    /// The same in all directions.
    pub envelope_1: f64,
    /// Percent good by the part's tolerance.
    pub good: f64,
    /// Median of the tubes' median errors of the distances between corners.
    pub length_mm: f64,
    /// Median of their farthest check points.
    pub envelope_mm: f64,
    /// Percent that benderd called good.
    pub called_good: f64,
    /// Percent that it held though nothing was wrong.
    pub held: f64,
    /// Percent that it wanted to see again, once at least.
    pub scanned_again: f64,
}

impl Line {
    /// So many jobs under one controller.
    pub fn run(&self, who: Who, seed: u64, jobs: u64) -> Vec<Vec<Tube>> {
        let job = |k: u64| {
            let seed = seed + k;
            let stock = self.stocks[k as usize % self.stocks.len()];
            let world = World { curves: self.curves_of(stock), ..self.shop.world.clone() };
            let shop = Shop { world, ..self.shop.clone() };
            let wanted = part(&self.material, stock, self.length_mm, seed);
            let before = part(&self.material, stock, self.length_mm, seed ^ 0x00be_f04e);
            shop.run(who, &wanted, &before, seed)
        };
        (0..jobs).into_par_iter().map(job).collect()
    }

    /// What is told of its tubes: which, counted from 1, and the same from 0.
    pub fn told(&self) -> Vec<(String, Range<usize>)> {
        let one = |number: usize| (number.to_string(), number - 1..number);
        match self.shop.scenario {
            Scenario::Cold => (2..=self.shop.parts).map(one).collect(),
            Scenario::Known { .. } => (1..=self.shop.parts).map(one).collect(),
            // The first of the new tubes teaches, the next one is what counts.
            Scenario::Shift { at, .. } => [at, at + 1, at + 2].map(one).into(),
            Scenario::Gross { .. } | Scenario::MixUps => {
                vec![(format!("3 to {}", self.shop.parts), 2..self.shop.parts)]
            }
        }
    }

    /// Curves are of one tube and die each.
    fn curves_of(&self, stock: Stock) -> Vec<Arc<Curve>> {
        self.shop.world.curves.iter().filter(|curve| Stock::of(curve) == stock).cloned().collect()
    }
}

/// The figures of these tubes (from 0) over all jobs.
pub fn figures(jobs: &[Vec<Tube>], numbers: Range<usize>) -> Figures {
    let tubes: Vec<&Tube> = jobs.iter().flat_map(|job| &job[numbers.clone()]).collect();
    let count = tubes.len();
    let share = |is: &dyn Fn(&Tube) -> bool| {
        100.0 * tubes.iter().filter(|tube| is(tube)).count() as f64 / count.max(1) as f64
    };
    let median = |of: &dyn Fn(&Tube) -> f64| {
        let mut values: Vec<f64> = tubes.iter().map(|tube| of(tube)).collect();
        values.sort_by(f64::total_cmp);
        values.get(count / 2).copied().unwrap_or(0.0)
    };
    let is = |wanted| move |t: &Tube| t.verdict == Some(wanted);
    Figures {
        within_03: share(&|t| t.truth.angle_rad <= 0.3 * DEGREE),
        within_05: share(&|t| t.truth.angle_rad <= 0.5 * DEGREE),
        lateral_1: share(&|t| t.truth.lateral_mm <= 1.0),
        envelope_1: share(&|t| t.truth.envelope_mm <= 1.0),
        good: share(&|t| t.good),
        length_mm: median(&|t| t.truth.median_length_mm),
        envelope_mm: median(&|t| t.truth.envelope_mm),
        called_good: share(&is(Verdict::InTolerance)),
        held: share(&|t| t.held_falsely),
        scanned_again: share(&|t| t.scans > 1),
    }
}

/// All lines of a material on a plant.
pub fn of(name: &str, world: &World, material: &Material, stocks: &[Stock]) -> Vec<Line> {
    let line = |what: &str, scenario, parts, length_mm| Line {
        name: format!("{name}, {}: {what}", material.key),
        shop: Shop { world: world.clone(), scanner: Scanner::good(), scenario, parts },
        material: material.clone(),
        stocks: stocks.to_vec(),
        length_mm,
    };
    let known = |same_batch| Scenario::Known { learned: 3, same_batch };
    vec![
        line("from nothing", Scenario::Cold, 3, None),
        line("known key, same batch", known(true), 2, None),
        line("known key, new batch", known(false), 2, None),
        line("batch changes by 10 %", Scenario::Shift { at: 4, factor: 1.1 }, 6, None),
        line("2 % gross errors", Scenario::Gross { share: 0.02 }, 12, None),
        line("2 m tube", Scenario::Cold, 2, Some(2000.0)),
        line("mix-ups", Scenario::MixUps, 5, None),
    ]
}
