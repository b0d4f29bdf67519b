//! How right and how accurate the reconstruction is: populations of simulated scans measured against their truth and
//! against the Cramér-Rao bound. `examples/accuracy.rs` prints it.
//!
//! ```text
//! judge     one scan: every value's error, reported sigma and bound; right, silently wrong, refused
//! nominal   the part as drawn, and wrong ones
//! guidance  what knowing the nominal did
//! tally     many scans: medians and extremes, error over bound, coverage of the sigmas, targets
//! text      rows and tables
//! ```

mod guidance;
mod judge;
mod nominal;
mod tally;
mod text;

#[cfg(test)]
mod tests;

use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Instant;

use super::TrialError;
use crate::cloud::{PointCloud, Unit, read_scan};
use crate::reconstruct::{Options, Reconstruction, reconstruct};
use crate::sim::population::{Scene, flattened_tube, papers_tube, random_scene, random_tube};
use crate::sim::scan::{ScanSettings, SimulatedScan, TubeShape, UnseenEnd, scan};
use crate::sim::scan_file::ScanFile;
use crate::tube::Nominal;

pub use guidance::{Answer, Guidance, Taken};
pub use judge::{Judgement, Kind, Value, Verdict, judge, refused};
pub use nominal::{Drawn, Wrong, drawn};
pub use tally::{Coverage, Errors, Tally, coverage, errors, rms_over_bound};
pub use text::{heading, markdown, row, totals};

/// A set of simulated scans, one per seed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Set {
    /// Tubes like the benchmark of paper 000, section 8, and harder; one view each.
    Thirty,
    /// The same kind of tubes, scanned in every bad way and read from files of every kind.
    Hard,
    /// The first set's tubes with flattened outer walls.
    Flattened,
    /// The tube of paper 000's Results: radius 4 mm, 268 mm, 5 bends, 6005 points (there 50 s on a 2 GHz PC); seeds
    /// differ in pose and noise.
    Paper,
}

impl FromStr for Set {
    type Err = String;

    fn from_str(word: &str) -> Result<Set, String> {
        let known = || Set::ALL.map(Set::name).join(", ");
        Set::ALL.into_iter().find(|s| s.name() == word).ok_or_else(|| format!("one of {}", known()))
    }
}

impl Set {
    const ALL: [Set; 4] = [Set::Thirty, Set::Hard, Set::Flattened, Set::Paper];

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Set::Thirty => "thirty",
            Set::Hard => "hard",
            Set::Flattened => "flattened",
            Set::Paper => "paper",
        }
    }

    /// Cases that the target speaks of.
    pub fn usual_count(self) -> u64 {
        match self {
            Set::Thirty | Set::Flattened => 30,
            Set::Hard => 200,
            Set::Paper => 1,
        }
    }

    /// One case in so many may be wrong.
    fn one_wrong_in(self) -> usize {
        match self {
            Set::Thirty | Set::Flattened | Set::Paper => usize::MAX,
            Set::Hard => 200,
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
            Set::Hard => (0.60..=0.76, 0.90..=0.98),
            Set::Thirty | Set::Flattened | Set::Paper => (0.66..=0.70, 0.945..=0.965),
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
    /// What spoils the scan, for the reader.
    pub nuisances: String,
    /// From cloud (or file, where the set writes files) to result.
    pub elapsed_ms: f64,
    /// What became of it.
    pub judgement: Judgement,
    /// What knowing the nominal did, where one was given.
    pub guidance: Option<Guidance>,
}

/// What is known beforehand of each case.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Known {
    /// Nothing.
    Nothing,
    /// Its nominal; wrong ones are tried besides.
    Nominal,
}

/// Simulates and reconstructs one case. `folder` takes its scan file while the case lasts, where the set writes files.
pub fn run(set: Set, seed: u64, known: Known, folder: &Path) -> Result<Case, TrialError> {
    let Scene { tube, file } = match set {
        Set::Thirty => Scene { tube: random_tube(seed), file: None },
        Set::Flattened => Scene { tube: flattened_tube(seed), file: None },
        Set::Hard => random_scene(seed),
        Set::Paper => Scene { tube: papers_tube(), file: None },
    };
    let (shape, settings) = (&tube.shape, &tube.settings);
    let scanned = scan(shape, settings, seed);
    let shown = Shown::new(&scanned, file, folder)?;
    let drawn = (known == Known::Nominal).then(|| drawn(shape, seed));
    let started = Instant::now();
    let found = shown.measure(drawn.as_ref().map(|d| &d.nominal));
    let elapsed_ms = started.elapsed().as_secs_f64() * 1e3;
    let guidance = drawn.map(|d| {
        let wrong = |w: Wrong| {
            let found = shown.measure(Some(&w.of(&d.nominal, seed)?));
            Some((w, guidance::answer(found.as_ref(), w)))
        };
        let wrong = Wrong::ALL.into_iter().filter_map(wrong).collect();
        Guidance { wrong, ..Guidance::of(found.as_ref(), &d, &scanned.spine) }
    });
    shown.remove()?;
    let judgement = match found {
        Ok(found) => judge(&found, shape, settings, &scanned),
        Err(reason) => refused(reason),
    };
    Ok(Case {
        seed,
        tube_radius_mm: shape.od_mm / 2.0,
        bends: shape.lra.bends.len(),
        round: shape.ovality.iter().chain(&shape.flattening).all(|o| *o == 0.0),
        points: scanned.points.len(),
        nuisances: nuisances(shape, settings, file),
        elapsed_ms,
        judgement,
        guidance,
    })
}

/// A scan as the reconstruction gets it.
enum Shown {
    Cloud(PointCloud),
    File(PathBuf),
}

impl Shown {
    fn new(scanned: &SimulatedScan, file: Option<ScanFile>, folder: &Path) -> Result<Shown, TrialError> {
        let Some(file) = file else { return Ok(Shown::Cloud(scanned.cloud())) };
        let path = folder.join("scan").with_extension(file.extension());
        file.write(&path, &scanned.points)?;
        Ok(Shown::File(path))
    }

    fn measure(&self, nominal: Option<&Nominal>) -> Result<Reconstruction, String> {
        let measure =
            |cloud: &PointCloud| reconstruct(cloud, &Options { nominal }).map_err(|e| e.to_string());
        match self {
            Shown::Cloud(cloud) => measure(cloud),
            Shown::File(path) => {
                measure(&read_scan(path, Unit::Millimetre).map_err(|e| e.to_string())?.cloud)
            }
        }
    }

    fn remove(self) -> std::io::Result<()> {
        match self {
            Shown::Cloud(_) => Ok(()),
            Shown::File(path) => std::fs::remove_file(path),
        }
    }
}

/// What spoils a scan, in a few words.
fn nuisances(shape: &TubeShape, settings: &ScanSettings, file: Option<ScanFile>) -> String {
    let mut words = Vec::new();
    let mut add = |there: bool, word: String| words.extend(there.then_some(word));
    let (views, drift_um) = (settings.views, 1e3 * settings.pass_drift_mm);
    add(views > 1, format!("{views} passes {drift_um:.0} um apart"));
    add(settings.outlier_share > 0.01, format!("{:.1} % outliers", 100.0 * settings.outlier_share));
    add(settings.missing_patches > 0, format!("{} patches", settings.missing_patches));
    add(settings.table, "table".to_owned());
    add(settings.v_blocks, "V-blocks".to_owned());
    add(settings.jaws.is_some(), format!("jaws {:?}", settings.jaws).replace("Some", "").to_lowercase());
    if let Some(UnseenEnd { last, unseen_mm, tilt_rad }) = settings.unseen_end {
        let (which, tilt) = (if last { "last" } else { "first" }, tilt_rad.to_degrees());
        add(true, format!("{which} {unseen_mm:.0} mm unseen at {tilt:.0} deg"));
    }
    add(shape.ends.iter().any(|e| e.cut_rad > 0.0), "oblique cut".to_owned());
    add(shape.ends.iter().any(|e| e.burr.is_some()), "burr".to_owned());
    add(file.is_some(), file.map_or("", ScanFile::name).to_owned());
    words.join(", ")
}
