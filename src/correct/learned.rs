//! What is believed of a key before its next job: the law with its band, what opens the arc, the backlash.

use super::Knowledge;
use super::estimate::{Springback, usual_springback};
use super::knowledge::{BendPoint, JobRecord, KeyRecord};
use super::lengths::Lengths;
use super::rotations::Rotations;
use crate::inspect::Known;
use crate::tube::{Bend, Lra, Material, Nominal};

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// The angles by which controllers keep spring-back.
pub const PAIR_RAD: [f64; 2] = [20.0 * DEGREE, 120.0 * DEGREE];

/// A straight line through spring-back at [`PAIR_RAD`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pair {
    /// Spring-back at either angle.
    pub springback_rad: [f64; 2],
    /// By how much the line is off the law at most between them.
    pub off_rad: f64,
}

impl Pair {
    fn of(springback: impl Fn(f64) -> f64) -> Pair {
        let mut pair = Pair { springback_rad: PAIR_RAD.map(&springback), off_rad: 0.0 };
        let steps = (0..=100).map(|k| PAIR_RAD[0] + f64::from(k) * DEGREE);
        pair.off_rad = steps.map(|angle| (springback(angle) - pair.at(angle)).abs()).fold(0.0, f64::max);
        pair
    }

    /// What it adds per angle.
    pub fn slope(&self) -> f64 {
        (self.springback_rad[1] - self.springback_rad[0]) / (PAIR_RAD[1] - PAIR_RAD[0])
    }

    /// The line at an angle; its constant at 0.
    pub fn at(&self, angle_rad: f64) -> f64 {
        self.springback_rad[0] + self.slope() * (angle_rad - PAIR_RAD[0])
    }
}

/// The belief about a key, for tubes of one batch.
#[derive(Debug, Clone)]
pub struct Learned {
    nominal: Nominal,
    springback: Springback,
    lengths: Lengths,
    rotations: Rotations,
}

impl Learned {
    /// Reads a key's records as the next job of that batch would.
    pub fn of(record: &KeyRecord, material: &Material, batch: Option<&str>) -> Learned {
        let key = &record.key;
        let bend = Bend { length_mm: 0.0, rotation_rad: 0.0, angle_rad: PAIR_RAD[1], radius_mm: key.clr_mm };
        let lra = Lra { bends: vec![bend], last_length_mm: 0.0 };
        let nominal =
            Nominal { material: material.clone(), ..Nominal::of_table(lra, key.od_mm, key.wall_mm) };
        let jobs: Vec<&JobRecord> = record.jobs.iter().collect();
        Learned {
            springback: Springback::prior(&nominal, &jobs, batch),
            lengths: Lengths::prior(&nominal.lra, &jobs),
            rotations: Rotations::prior(&nominal.lra, &jobs),
            nominal,
        }
    }

    /// Usual spring-back of a 90 degree bend on this die: the unit of the coefficients.
    pub fn usual_rad(&self) -> f64 {
        self.springback.usual_rad(0)
    }

    /// The law's coefficients.
    pub fn coefficients(&self) -> [Known; 3] {
        self.springback.coefficients()
    }

    /// Spring-back by the law.
    pub fn law(&self, commanded_rad: f64) -> Known {
        self.springback.law_at(0, commanded_rad)
    }

    /// Spring-back of the next bend of a new program: its own and the scatter in the sigma.
    pub fn next(&self, commanded_rad: f64) -> Known {
        self.springback.next_at(0, commanded_rad)
    }

    /// The pair by the angle that the machine bends to.
    pub fn commanded_pair(&self) -> Pair {
        Pair::of(|commanded_rad| self.law(commanded_rad).value)
    }

    /// The pair by the drawing's angle: what is to be commanded beyond it.
    pub fn designed_pair(&self) -> Pair {
        Pair::of(|wanted_rad| self.springback.command_for(0, wanted_rad) - wanted_rad)
    }

    /// Share of the spring-back that opens the arc.
    pub fn share(&self) -> Known {
        self.lengths.share()
    }

    /// What the arc grows without spring-back, as a share of its radius.
    pub fn constant_growth(&self) -> Known {
        self.lengths.constant_growth()
    }

    /// Backlash of the head that turns the tube.
    pub fn backlash(&self) -> Known {
        self.rotations.backlash()
    }

    /// A measured point as it would be on the key's die.
    pub fn on_the_die(&self, point: &BendPoint) -> f64 {
        let usual_rad = usual_springback(&self.nominal, point.radius_mm);
        point.springback_rad * self.usual_rad() / usual_rad
    }
}

impl KeyRecord {
    /// The batch of the newest job that names one: the tubes on the floor.
    pub fn newest_batch(&self) -> Option<&str> {
        self.jobs.iter().rev().find_map(|job| job.batch.as_deref())
    }

    /// The same key before its first job.
    pub fn unlearned(&self) -> KeyRecord {
        KeyRecord { key: self.key.clone(), jobs: Vec::new() }
    }
}

impl Knowledge {
    /// A key by its number, from 1; the only one needs none.
    pub fn numbered(&self, number: Option<usize>) -> Result<(usize, &KeyRecord), String> {
        let keys = self.keys.len();
        let number = match number {
            None if keys > 1 => return Err(format!("which of the {keys} keys? Say its number in `list`")),
            None => 1,
            Some(number) => number,
        };
        let found = number.checked_sub(1).and_then(|i| self.keys.get(i));
        let none = || format!("there is no key {number}: allowed is 1 to {keys}, the number in `list`");
        match (keys, found) {
            (0, _) => Err("nothing was learned yet".to_owned()),
            (_, found) => found.map(|record| (number, record)).ok_or_else(none),
        }
    }
}
