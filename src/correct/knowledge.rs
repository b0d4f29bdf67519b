//! What was learned about keys: per job the points measured, so that a better model can read them again.
//!
//! A job's record replaces its own earlier one: the same history twice changes nothing.

use serde::{Deserialize, Serialize};

use super::history::{History, SetUp};
use super::lengths::{Sides, grown};
use super::replay::Used;
use crate::tube::{Nominal, deg};

/// Jobs kept per key; the oldest go first.
const MAX_JOBS: usize = 200;

/// All keys. Its JSON form is the file of `--knowledge`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Knowledge {
    /// Version of the form; this program reads and writes 1.
    pub version: u32,
    /// One record per key.
    pub keys: Vec<KeyRecord>,
}

impl Default for Knowledge {
    fn default() -> Knowledge {
        Knowledge { version: 1, keys: Vec::new() }
    }
}

/// What spring-back depends on, besides the batch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Key {
    /// Name of the bender.
    pub bender: String,
    /// Lubrication set-up.
    pub lubrication: String,
    /// Outer diameter.
    pub od_mm: f64,
    /// Wall thickness.
    pub wall_mm: f64,
    /// Key of the material, temper included.
    pub material: String,
    /// The die's centre-line radius.
    pub clr_mm: f64,
}

/// The jobs of one key.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeyRecord {
    /// The key.
    pub key: Key,
    /// Oldest first.
    pub jobs: Vec<JobRecord>,
}

/// What one job showed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JobRecord {
    /// Identity of the job.
    pub id: String,
    /// Name of the part.
    pub part: String,
    /// Batch of the material, where known.
    pub batch: Option<String>,
    /// Tubes behind the points.
    pub parts: usize,
    /// One point per bend: the mean over the job's tubes.
    pub bends: Vec<BendPoint>,
    /// One point per fed straight.
    pub straights: Vec<StraightPoint>,
}

/// Spring-back of one bend.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BendPoint {
    /// Commanded angle.
    #[serde(rename = "commanded_deg", with = "deg")]
    pub commanded_rad: f64,
    /// Radius of the die there.
    pub radius_mm: f64,
    /// Commanded minus formed angle.
    #[serde(rename = "springback_deg", with = "deg")]
    pub springback_rad: f64,
    /// Sigma of that mean.
    #[serde(rename = "sigma_deg", with = "deg")]
    pub sigma_rad: f64,
}

/// Growth of one straight between its corners.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StraightPoint {
    /// What the bends at its sides bring.
    pub sides: Sides,
    /// Distance measured less length fed and the die's tangent lengths.
    pub growth_mm: f64,
    /// Sigma of that mean.
    pub sigma_mm: f64,
}

impl Key {
    /// The key of a part on a set-up.
    pub fn of(nominal: &Nominal, set_up: &SetUp) -> Key {
        Key {
            bender: set_up.bender.clone(),
            lubrication: set_up.lubrication.clone(),
            od_mm: nominal.od_mm,
            wall_mm: nominal.wall_mm,
            material: nominal.material.key.clone(),
            clr_mm: nominal.die_clr_mm,
        }
    }
}

impl Knowledge {
    /// Records of a key, without the job's own.
    pub fn of_others(&self, key: &Key, own_job: Option<&str>) -> Vec<&JobRecord> {
        let of_key = self.keys.iter().filter(|k| k.key == *key);
        of_key.flat_map(|k| &k.jobs).filter(|j| Some(j.id.as_str()) != own_job).collect()
    }

    /// Puts a job's record in the place of its earlier one.
    pub fn put(&mut self, key: &Key, record: JobRecord) {
        let index = self.keys.iter().position(|k| k.key == *key).unwrap_or_else(|| {
            self.keys.push(KeyRecord { key: key.clone(), jobs: Vec::new() });
            self.keys.len() - 1
        });
        let jobs = &mut self.keys[index].jobs;
        match jobs.iter_mut().find(|j| j.id == record.id) {
            Some(earlier) => *earlier = record,
            None => jobs.push(record),
        }
        let surplus = jobs.len().saturating_sub(MAX_JOBS);
        jobs.drain(..surplus);
    }
}

/// The record of a job from its usable parts; None when there are none.
pub fn record(nominal: &Nominal, history: &History, used: &[Used]) -> Option<JobRecord> {
    let id = history.job_id(nominal).filter(|_| !used.is_empty())?;
    let bend = |i: usize| {
        let mut mean = Mean::default();
        for u in used.iter().filter(|u| !u.outliers.contains(&i)) {
            let (c, m) = (u.commanded.bends[i].angle_rad, &u.measured.bends[i]);
            mean.add([c, c - m.angle_rad, 0.0], m.angle_sigma_rad.hypot(BEND_SCATTER_RAD));
        }
        let (values, sigma_rad) = mean.finish()?;
        let radius_mm = nominal.lra.bends[i].radius_mm;
        Some(BendPoint { commanded_rad: values[0], radius_mm, springback_rad: values[1], sigma_rad })
    };
    let straight = |j: usize| {
        let mut mean = Mean::default();
        for u in used {
            for g in grown(&nominal.lra, &u.commanded, &u.measured).iter().filter(|g| g.straight == j) {
                mean.add([g.sides.plain_mm, g.sides.sprung_mm, g.growth_mm], g.sigma_mm);
            }
        }
        let ([plain_mm, sprung_mm, growth_mm], sigma_mm) = mean.finish()?;
        Some(StraightPoint { sides: Sides { plain_mm, sprung_mm }, growth_mm, sigma_mm })
    };
    let n = nominal.lra.bends.len();
    Some(JobRecord {
        id,
        part: nominal.name.clone(),
        batch: history.batch.clone(),
        parts: used.len(),
        bends: (0..n).filter_map(bend).collect(),
        straights: (0..n).filter_map(straight).collect(),
    })
}

/// Scatter of the single bend around its mean, for weighing.
const BEND_SCATTER_RAD: f64 = 0.08 * std::f64::consts::PI / 180.0;

/// Mean of three values with common weights 1 / sigma^2.
#[derive(Default)]
struct Mean {
    weight: f64,
    sum: [f64; 3],
}

impl Mean {
    fn add(&mut self, values: [f64; 3], sigma: f64) {
        let weight = 1.0 / sigma.powi(2);
        self.weight += weight;
        self.sum.iter_mut().zip(values).for_each(|(s, v)| *s += weight * v);
    }

    fn finish(self) -> Option<([f64; 3], f64)> {
        (self.weight > 0.0).then(|| (self.sum.map(|s| s / self.weight), self.weight.sqrt().recip()))
    }
}
