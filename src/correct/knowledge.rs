//! What was learned about keys: per job the points measured, so that a better model can read them again.
//!
//! A job's record replaces its own earlier one: the same history twice changes nothing.

use serde::{Deserialize, Serialize};

use super::estimate::BEND_SCATTER_RAD;
use super::history::{History, SetUp};
use super::lengths::{Side, grown};
use super::replay::Used;
use super::rotations::{TurnPoint, turned};
use crate::tube::{Nominal, deg};

/// Of the form that is read and written.
pub const VERSION: u32 = 2;

/// Jobs kept per key; the oldest go first.
pub const MAX_JOBS: usize = 200;

/// All keys. Its JSON form is the file of `--knowledge`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Knowledge {
    /// Version of the form; this program reads and writes [`VERSION`].
    pub version: u32,
    /// One record per key.
    pub keys: Vec<KeyRecord>,
}

impl Default for Knowledge {
    fn default() -> Knowledge {
        Knowledge { version: VERSION, keys: Vec::new() }
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
    /// Tubes behind the points; none where a table was told ([`super::import`]).
    pub parts: usize,
    /// One point per bend: the mean over the job's tubes.
    pub bends: Vec<BendPoint>,
    /// One point per fed straight.
    pub straights: Vec<StraightPoint>,
    /// One point per turn that was known well.
    pub turns: Vec<TurnPoint>,
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StraightPoint {
    /// The bends at its sides whose corners count.
    pub sides: Vec<Side>,
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
        let mut mean = Mean::<2>::default();
        for u in used.iter().filter(|u| !u.outliers.contains(&i)) {
            let (c, m) = (u.commanded.bends[i].angle_rad, &u.measured.bends[i]);
            mean.add([c, c - m.angle_rad], m.angle_sigma_rad.hypot(BEND_SCATTER_RAD));
        }
        let (values, sigma_rad) = mean.finish()?;
        let radius_mm = nominal.lra.bends[i].radius_mm;
        Some(BendPoint { commanded_rad: values[0], radius_mm, springback_rad: values[1], sigma_rad })
    };
    let straight = |j: usize| straight_point(nominal, used, j);
    let n = nominal.lra.bends.len();
    Some(JobRecord {
        id,
        part: nominal.name.clone(),
        batch: history.batch.clone(),
        parts: used.len(),
        bends: (0..n).filter_map(bend).collect(),
        straights: (0..n).filter_map(straight).collect(),
        turns: (1..n).filter_map(|i| turn_point(nominal, used, i)).collect(),
    })
}

/// The mean over the tubes in which it was measured between the same corners.
fn straight_point(nominal: &Nominal, used: &[Used], straight: usize) -> Option<StraightPoint> {
    let all = used.iter().flat_map(|u| grown(&nominal.lra, &u.commanded, &u.measured));
    let of_it: Vec<_> = all.filter(|g| g.straight == straight).collect();
    let corners = of_it.last()?.sides.len();
    let mut mean = Mean::<5>::default();
    for g in of_it.iter().filter(|g| g.sides.len() == corners) {
        let mut values = [g.growth_mm, 0.0, 0.0, 0.0, 0.0];
        for (k, side) in g.sides.iter().enumerate() {
            (values[1 + 2 * k], values[2 + 2 * k]) = (side.commanded_rad, side.formed_rad);
        }
        mean.add(values, g.sigma_mm);
    }
    let (values, sigma_mm) = mean.finish()?;
    let side = |(k, side): (usize, &Side)| Side {
        commanded_rad: values[1 + 2 * k],
        formed_rad: values[2 + 2 * k],
        ..*side
    };
    let sides = of_it.last()?.sides.iter().enumerate().map(side).collect();
    Some(StraightPoint { sides, growth_mm: values[0], sigma_mm })
}

/// The mean over the tubes that were turned the same way.
fn turn_point(nominal: &Nominal, used: &[Used], bend: usize) -> Option<TurnPoint> {
    let tolerance_rad = nominal.tolerance.rotation_rad;
    let all = used.iter().flat_map(|u| turned(&u.commanded, &u.measured, tolerance_rad));
    let of_it: Vec<TurnPoint> = all.filter(|(i, _)| *i == bend).map(|(_, point)| point).collect();
    let per_backlash = of_it.last()?.per_backlash;
    let mut mean = Mean::<1>::default();
    for point in of_it.iter().filter(|point| point.per_backlash == per_backlash) {
        mean.add([point.off_rad], point.sigma_rad);
    }
    let ([off_rad], sigma_rad) = mean.finish()?;
    Some(TurnPoint { per_backlash, off_rad, sigma_rad })
}

/// Mean of some values with common weights 1 / sigma^2.
struct Mean<const N: usize> {
    weight: f64,
    sum: [f64; N],
}

impl<const N: usize> Default for Mean<N> {
    fn default() -> Mean<N> {
        Mean { weight: 0.0, sum: [0.0; N] }
    }
}

impl<const N: usize> Mean<N> {
    fn add(&mut self, values: [f64; N], sigma: f64) {
        let weight = 1.0 / sigma.powi(2);
        self.weight += weight;
        self.sum.iter_mut().zip(values).for_each(|(s, v)| *s += weight * v);
    }

    fn finish(self) -> Option<([f64; N], f64)> {
        (self.weight > 0.0).then(|| (self.sum.map(|s| s / self.weight), self.weight.sqrt().recip()))
    }
}
