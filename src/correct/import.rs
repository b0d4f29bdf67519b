//! What others know of spring-back as records that the estimator reads: another knowledge file, a controller's pair, a
//! shop's overbend list, a bent test.
//!
//! A table is told, not measured: it is a record of no tubes. Like every record it may be off by the batch's common factor and by
//! each bend's own besides (`estimate`), and by the sigmas here.

use sha2::{Digest, Sha256};

use super::Knowledge;
use super::estimate::BEND_SCATTER_RAD;
use super::knowledge::{BendPoint, JobRecord};
use crate::tube::deg::to_degrees_clean;
use crate::tube::{SpringbackForm, SpringbackTable};

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// What a table's row is worth: small controllers keep whole degrees, which are off by 1/sqrt(12) of one.
const TABLE_SIGMA_RAD: f64 = 0.3 * DEGREE;
/// A whole table counts as this many rows: they were made together, and most of them by drawing a line.
const TABLE_ROWS: f64 = 2.0;
/// A test tube's bend measured by a protractor in the hand.
const PROTRACTOR_SIGMA_RAD: f64 = 0.15 * DEGREE;

/// What became of the jobs of another knowledge file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Merged {
    /// Jobs that were not known.
    pub new: usize,
    /// Jobs that were known with fewer tubes.
    pub longer: usize,
    /// Jobs that were known already.
    pub known: usize,
}

/// Takes the jobs of another file in, by their ids. Of the same job the record with more tubes stays.
pub fn merge(into: &mut Knowledge, other: &Knowledge) -> Merged {
    let mut out = Merged::default();
    for record in &other.keys {
        for job in &record.jobs {
            let own = into.of_others(&record.key, None).into_iter().find(|own| own.id == job.id);
            match own {
                Some(own) if own.parts >= job.parts => {
                    out.known += 1;
                    continue;
                }
                Some(_) => out.longer += 1,
                None => out.new += 1,
            }
            into.put(&record.key, job.clone());
        }
    }
    out
}

/// The record of a table on a die of this radius. A table takes the place of the one of its kind that was told before; every test
/// is a tube of its own.
pub fn record(table: &SpringbackTable, radius_mm: f64, batch: Option<&str>) -> JobRecord {
    let rows = table.rows_rad.len() as f64;
    let told_rad = TABLE_SIGMA_RAD * (rows / TABLE_ROWS).sqrt().max(1.0);
    let (id, part, parts, sigma_rad) = match table.form {
        SpringbackForm::Designed | SpringbackForm::Commanded => {
            ("pair".to_owned(), "controller's pair", 0, told_rad)
        }
        SpringbackForm::Overbend => ("overbend".to_owned(), "overbend list", 0, told_rad),
        SpringbackForm::Test => {
            (test_id(table, batch), "bent test", 1, PROTRACTOR_SIGMA_RAD.hypot(BEND_SCATTER_RAD))
        }
    };
    // As the file will hold them, so that the same import again is the same record.
    let kept = |rad: f64| to_degrees_clean(rad).to_radians();
    let point = |(commanded_rad, springback_rad): (f64, f64)| BendPoint {
        commanded_rad: kept(commanded_rad),
        radius_mm,
        springback_rad: kept(springback_rad),
        sigma_rad: kept(sigma_rad),
    };
    JobRecord {
        id,
        part: part.to_owned(),
        batch: batch.map(str::to_owned),
        parts,
        bends: table.points().map(point).collect(),
        straights: Vec::new(),
        turns: Vec::new(),
    }
}

fn test_id(table: &SpringbackTable, batch: Option<&str>) -> String {
    let rows: String = table.rows_rad.iter().map(|[c, m]| format!("{c:.9} {m:.9} ")).collect();
    let digest = Sha256::digest(format!("bent test\n{}\n{rows}", batch.unwrap_or("")));
    digest.iter().take(8).map(|b| format!("{b:02x}")).collect()
}
