//! The pure rooms in a row: what a cell's driver does with a scan, cloud to answer.

use std::path::Path;
use std::time::Instant;

use super::driver::Craft;
use super::event::Decision;
use super::machine::Part;
use crate::arm::ScanFile;
use crate::cloud::{PointCloud, Unit, read_scan};
use crate::correct::{self, History, Knowledge, Limits, SetUp, step};
use crate::inspect::inspect;
use crate::reconstruct::{Options, Reconstruction, Stage, reconstruct_watched};
use crate::tube::{MachineLimits, MeasuredTube, Nominal};

/// A scan and what it says.
#[derive(Debug, Clone)]
pub struct MeasuredScan {
    /// The points.
    pub cloud: PointCloud,
    /// The tube in them.
    pub found: Reconstruction,
}

/// Reads and reconstructs a scan, in the nominal's direction of travel where one is given. The error is for the
/// operator: it names the file, what is wrong with it and what to do.
pub fn measure(path: &Path, unit: Unit, nominal: Option<&Nominal>) -> Result<MeasuredTube, String> {
    measure_scan(path, unit, nominal, &mut |_| ()).map(|scan| scan.found.measured)
}

/// The same with all that was found, telling each stage after reading as it begins.
pub fn measure_scan(
    path: &Path,
    unit: Unit,
    nominal: Option<&Nominal>,
    begins: &mut dyn FnMut(Stage),
) -> Result<MeasuredScan, String> {
    let begin = Instant::now();
    let scan = read_scan(path, unit).map_err(|e| e.to_string())?;
    let found = reconstruct_watched(&scan.cloud, &Options { nominal }, begins);
    let mut found = found.map_err(|e| format!("{}: {e}", path.display()))?;
    found.measured.scan_sha256 = scan.sha256;
    found.measured.elapsed_ms = (begin.elapsed().as_secs_f64() * 1e4).round() / 10.0;
    found.measured.warnings.extend(scan.notes);
    Ok(MeasuredScan { cloud: scan.cloud, found })
}

/// Measures and decides for one part on one machine.
#[derive(Debug, Clone)]
pub struct Chain {
    nominal: Nominal,
    unit: Unit,
    limits: Limits,
    key: SetUp,
}

impl Chain {
    /// For a part on the machine called `bender`, with scans in this unit.
    pub fn new(bender: &str, nominal: Nominal, unit: Unit, machine: MachineLimits) -> Chain {
        let key = SetUp { bender: bender.to_owned(), ..SetUp::default() };
        Chain { nominal, unit, limits: Limits { machine, ..Limits::default() }, key }
    }

    /// The part.
    pub fn nominal(&self) -> &Nominal {
        &self.nominal
    }
}

impl Craft for Chain {
    fn measure(&self, scan: &ScanFile) -> Result<MeasuredTube, String> {
        measure(&scan.path, self.unit, Some(&self.nominal))
    }

    fn decide(&self, parts: &[Part]) -> Decision {
        let part = |p: &Part| correct::Part {
            revision: Some(u64::from(p.in_force.id.revision)),
            rescan: p.rescan,
            changed: p.changed,
            approved: p.approved,
            ..correct::Part::new(p.in_force.table.clone(), p.measured.clone())
        };
        let history = History { key: self.key.clone(), batch: None, parts: parts.iter().map(part).collect() };
        let inspection = parts.last().and_then(|p| inspect(&p.measured, &self.nominal).ok());
        Decision {
            answer: step(&self.nominal, &history, &Knowledge::default(), &self.limits),
            inspection: inspection.map(Box::new),
        }
    }
}
