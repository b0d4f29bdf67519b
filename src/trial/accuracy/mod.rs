//! How right and how accurate the reconstruction is: populations of simulated scans measured against their truth and
//! against the Cramér-Rao bound. `examples/accuracy.rs` prints it.
//!
//! ```text
//! judge     one scan: every value's error, reported sigma and bound; right, silently wrong, refused
//! tally     many scans: medians and extremes, error over bound, coverage of the sigmas, targets
//! text      rows and tables
//! ```

mod judge;
mod tally;
mod text;

#[cfg(test)]
mod tests;

use std::ops::RangeInclusive;
use std::path::Path;
use std::str::FromStr;
use std::time::Instant;

use super::TrialError;
use crate::reconstruct::{Options, reconstruct};
use crate::sim::population::{Specimen, papers_tube, random_tube};
use crate::sim::scan::scan;

pub use judge::{Judgement, Kind, Value, Verdict, judge, refused};
pub use tally::{Coverage, Errors, Tally, coverage, errors, rms_over_bound};
pub use text::{heading, markdown, row, totals};

/// A set of simulated scans, one per seed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Set {
    /// Tubes like the benchmark of paper 000, section 8, and harder; one view each.
    Thirty,
    /// The tube of paper 000's Results: radius 4 mm, 268 mm, 5 bends, 6005 points (there 50 s on a 2 GHz PC); seeds
    /// differ in pose and noise.
    Paper,
}

impl FromStr for Set {
    type Err = String;

    fn from_str(word: &str) -> Result<Set, String> {
        match word {
            "thirty" => Ok(Set::Thirty),
            "paper" => Ok(Set::Paper),
            _ => Err(format!("no set {word:?}: one of thirty, paper")),
        }
    }
}

impl Set {
    /// Cases that the target speaks of.
    pub fn usual_count(self) -> u64 {
        match self {
            Set::Thirty => 30,
            Set::Paper => 1,
        }
    }

    /// One case in so many may be wrong.
    fn one_wrong_in(self) -> usize {
        match self {
            Set::Thirty | Set::Paper => usize::MAX,
        }
    }

    /// Whether this kind of value must come near its bound: where nothing but white noise spoils the scan.
    fn has_bound_target(self, kind: Kind) -> bool {
        matches!(self, Set::Thirty | Set::Paper)
            && matches!(kind, Kind::Angle | Kind::Rotation | Kind::Intersection)
    }

    /// Shares of errors that must lie within one and two reported sigmas.
    fn coverage_target(self) -> (RangeInclusive<f64>, RangeInclusive<f64>) {
        match self {
            Set::Thirty | Set::Paper => (0.66..=0.70, 0.945..=0.965),
        }
    }
}

/// One scan, what became of it, and how long that took.
#[derive(Debug, Clone, PartialEq)]
pub struct Case {
    /// Seed within the set.
    pub seed: u64,
    /// True outer radius.
    pub tube_radius_mm: f64,
    /// True number of bends.
    pub bends: usize,
    /// Whether all sections are truly round.
    pub round: bool,
    /// Points in the scan.
    pub points: usize,
    /// From cloud (or file, where the set writes files) to result.
    pub elapsed_ms: f64,
    /// What became of it.
    pub judgement: Judgement,
}

/// Simulates and reconstructs one case. `folder` takes its scan file where the set writes files.
pub fn run(set: Set, seed: u64, _folder: &Path) -> Result<Case, TrialError> {
    let specimen: Specimen = match set {
        Set::Thirty => random_tube(seed),
        Set::Paper => papers_tube(),
    };
    let (shape, settings) = (&specimen.shape, &specimen.settings);
    let scanned = scan(shape, settings, seed);
    let cloud = scanned.cloud();
    let started = Instant::now();
    let found = reconstruct(&cloud, &Options::default());
    let elapsed_ms = started.elapsed().as_secs_f64() * 1e3;
    let judgement = match found {
        Ok(found) => judge(&found, shape, settings, &scanned),
        Err(error) => refused(error.to_string()),
    };
    Ok(Case {
        seed,
        tube_radius_mm: shape.od_mm / 2.0,
        bends: shape.lra.bends.len(),
        round: shape.ovality.iter().all(|o| *o == 0.0),
        points: cloud.len(),
        elapsed_ms,
        judgement,
    })
}
