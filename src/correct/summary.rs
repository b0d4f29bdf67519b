//! A key as it is told: its jobs, the law with its band, the measurements. The JSON of `benderd knowledge list` and `show`.

use serde::Serialize;

use super::knowledge::{BendPoint, JobRecord, Key, KeyRecord};
use super::learned::{Learned, Pair};
use crate::inspect::Known;
use crate::tube::deg::to_degrees_clean;
use crate::tube::{Material, deg};

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// Angles at which a list tells spring-back.
const LISTED_DEG: [f64; 3] = [20.0, 90.0, 120.0];

/// A value and one standard deviation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Sure {
    /// The value.
    pub value: f64,
    /// One standard deviation.
    pub sigma: f64,
}

/// Spring-back at an angle.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct At {
    /// Commanded angle.
    pub commanded_deg: f64,
    /// Commanded less formed angle, by the law.
    pub springback_deg: f64,
    /// One standard deviation of the law.
    pub sigma_deg: f64,
    /// Of the next bend: its own and all scatter included.
    pub next_sigma_deg: f64,
}

/// One key in a list.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Listed<'a> {
    /// By which it is asked for.
    pub number: usize,
    /// What it is.
    pub key: &'a Key,
    /// Number of jobs.
    pub jobs: usize,
    /// Tubes measured in them.
    pub tubes: usize,
    /// Names of the parts, without repetition.
    pub parts: Vec<&'a str>,
    /// Names of the batches, oldest first.
    pub batches: Vec<&'a str>,
    /// Whose tubes the spring-back is told for: the newest batch; null where none is named.
    pub batch: Option<&'a str>,
    /// Spring-back at 20, 90 and 120 degrees; null where the materials file does not have the material.
    pub springback: Option<Vec<At>>,
}

/// One key with all that is known of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Shown<'a> {
    /// As in the list.
    #[serde(flatten)]
    pub listed: Listed<'a>,
    /// Unit of the coefficients: the usual spring-back of a 90 degree bend on this die.
    pub usual_springback_deg: f64,
    /// x1, x2, x3 of the law.
    pub coefficients: [Sure; 3],
    /// The law along the angle.
    pub law: Vec<At>,
    /// The same for tubes of a batch that was never bent.
    pub new_batch: Vec<At>,
    /// Share of the spring-back that opens the arc.
    pub opening_share: Sure,
    /// What the arc grows without spring-back, as a share of its radius.
    pub constant_growth: Sure,
    /// Radius that a 90 degree bend forms.
    pub formed_radius_mm: f64,
    /// Backlash of the head that turns the tube.
    pub backlash_deg: Sure,
    /// Every bend of every job.
    pub measurements: Vec<Measurement<'a>>,
}

/// What one bend of a job showed on average.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Measurement<'a> {
    /// Name of the part, or what was told.
    pub part: &'a str,
    /// Batch, where known.
    pub batch: Option<&'a str>,
    /// Tubes behind it; 0 for what was told, not measured.
    pub tubes: usize,
    /// Commanded angle.
    #[serde(rename = "commanded_deg", serialize_with = "deg::serialize")]
    pub commanded_rad: f64,
    /// Radius of the die there.
    pub radius_mm: f64,
    /// Commanded less formed angle.
    #[serde(rename = "springback_deg", serialize_with = "deg::serialize")]
    pub springback_rad: f64,
    /// One standard deviation.
    #[serde(rename = "sigma_deg", serialize_with = "deg::serialize")]
    pub sigma_rad: f64,
}

/// The pair that controllers keep, by either angle.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Pairs<'a> {
    /// What it is of.
    pub key: &'a Key,
    /// Whose tubes.
    pub batch: Option<&'a str>,
    /// For a controller that looks it up with the drawing's angle.
    pub designed: PairDeg,
    /// For one that looks it up with the angle it bends to.
    pub commanded: PairDeg,
}

/// A pair and the line through it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PairDeg {
    /// At 20 degrees.
    pub springback_at_20_deg: f64,
    /// At 120 degrees.
    pub springback_at_120_deg: f64,
    /// The line at 0 degrees.
    pub constant_deg: f64,
    /// What it adds per degree.
    pub per_degree: f64,
    /// By how much the line is off the law at most between 20 and 120 degrees.
    pub off_law_deg: f64,
}

impl<'a> Listed<'a> {
    /// A key, without its material where the materials file does not have it.
    pub fn of(number: usize, record: &'a KeyRecord, material: Option<&Material>) -> Listed<'a> {
        let batch = record.newest_batch();
        let learned = material.map(|material| Learned::of(record, material, batch));
        let jobs = || record.jobs.iter();
        Listed {
            number,
            key: &record.key,
            jobs: record.jobs.len(),
            tubes: jobs().map(|job| job.parts).sum(),
            parts: once_each(jobs().map(|job| job.part.as_str())),
            batches: once_each(jobs().filter_map(|job| job.batch.as_deref())),
            batch,
            springback: learned.map(|learned| along(&learned, &LISTED_DEG)),
        }
    }
}

impl<'a> Shown<'a> {
    /// A key in full.
    pub fn of(number: usize, record: &'a KeyRecord, material: &Material) -> Shown<'a> {
        let learned = Learned::of(record, material, record.newest_batch());
        let in_degrees =
            |known: Known| Sure { value: known.value.to_degrees(), sigma: known.sigma.to_degrees() };
        let quarter = 90.0 * DEGREE;
        let opened = learned.share().value * learned.law(quarter).value;
        let grown = 1.0 + learned.constant_growth().value;
        let every_ten: Vec<f64> = (1..=18).map(|k| 10.0 * f64::from(k)).collect();
        Shown {
            usual_springback_deg: to_degrees_clean(learned.usual_rad()),
            coefficients: learned.coefficients().map(sure),
            law: along(&learned, &every_ten),
            new_batch: along(&Learned::of(record, material, None), &LISTED_DEG),
            opening_share: sure(learned.share()),
            constant_growth: sure(learned.constant_growth()),
            formed_radius_mm: record.key.clr_mm * grown * quarter / (quarter - opened),
            backlash_deg: in_degrees(learned.backlash()),
            measurements: record.jobs.iter().flat_map(measurements).collect(),
            listed: Listed::of(number, record, Some(material)),
        }
    }
}

impl<'a> Pairs<'a> {
    /// A key's pair, for tubes of its newest batch.
    pub fn of(record: &'a KeyRecord, material: &Material) -> Pairs<'a> {
        let batch = record.newest_batch();
        let learned = Learned::of(record, material, batch);
        Pairs {
            key: &record.key,
            batch,
            designed: PairDeg::of(&learned.designed_pair()),
            commanded: PairDeg::of(&learned.commanded_pair()),
        }
    }
}

impl PairDeg {
    fn of(pair: &Pair) -> PairDeg {
        let [at_20, at_120] = pair.springback_rad.map(to_degrees_clean);
        PairDeg {
            springback_at_20_deg: at_20,
            springback_at_120_deg: at_120,
            constant_deg: to_degrees_clean(pair.at(0.0)),
            per_degree: pair.slope(),
            off_law_deg: to_degrees_clean(pair.off_rad),
        }
    }
}

fn sure(known: Known) -> Sure {
    Sure { value: known.value, sigma: known.sigma }
}

fn along(learned: &Learned, angles_deg: &[f64]) -> Vec<At> {
    let at = |&commanded_deg: &f64| {
        let (law, next) = (learned.law(commanded_deg * DEGREE), learned.next(commanded_deg * DEGREE));
        At {
            commanded_deg,
            springback_deg: to_degrees_clean(law.value),
            sigma_deg: to_degrees_clean(law.sigma),
            next_sigma_deg: to_degrees_clean(next.sigma),
        }
    };
    angles_deg.iter().map(at).collect()
}

fn measurements(job: &JobRecord) -> impl Iterator<Item = Measurement<'_>> {
    job.bends.iter().map(|point: &BendPoint| Measurement {
        part: &job.part,
        batch: job.batch.as_deref(),
        tubes: job.parts,
        commanded_rad: point.commanded_rad,
        radius_mm: point.radius_mm,
        springback_rad: point.springback_rad,
        sigma_rad: point.sigma_rad,
    })
}

fn once_each<'a>(names: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    let mut out = Vec::new();
    for name in names {
        if !out.contains(&name) {
            out.push(name);
        }
    }
    out
}
