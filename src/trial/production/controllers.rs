//! Who decides on the next table: benderd, the oracle, and what shops do by hand.

use super::oracle::angles::{Angles, Mishaps};
use super::oracle::feeds::Feeds;
use super::oracle::turns::Turns;
use crate::correct::{self, History, Knowledge, Limits, Part, Verdict};
use crate::inspect;
use crate::sim::forming::World;
use crate::tube::{CommandTable, MeasuredTube, Nominal, wrap_angle};

/// Which one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Who {
    /// This program.
    Benderd,
    /// Whoever knows the plant's laws.
    Oracle,
    /// Every value by its own error.
    Deadbeat,
    /// By half of it.
    HalfGain,
}

/// One bent and scanned tube.
#[derive(Debug, Clone)]
pub struct Scanned {
    /// What it was bent with.
    pub commanded: CommandTable,
    /// What the scan says.
    pub measured: MeasuredTube,
    /// Revision of the table.
    pub revision: u64,
    /// Differs from scan to scan.
    pub scan_id: String,
    /// Whether it is another scan of the same tube.
    pub rescan: bool,
}

/// What is said after a scan.
#[derive(Debug, Clone)]
pub struct Said {
    /// The next table, or the one in force.
    pub table: CommandTable,
    /// What only benderd gives.
    pub verdict: Option<Verdict>,
}

/// A controller in its job.
pub trait Controller {
    /// The first piece's table.
    fn first(&mut self) -> CommandTable;

    /// After one more scan.
    fn next(&mut self, scanned: Scanned) -> Said;

    /// The last scan was of something else: somebody has looked.
    fn withdraw(&mut self) {}

    /// Another part on the same set-up, of the same batch or another.
    fn new_program(&mut self, part: &Nominal, same_batch: bool);
}

impl Who {
    /// All, in the order of the tables.
    pub const ALL: [Who; 4] = [Who::Benderd, Who::Oracle, Who::Deadbeat, Who::HalfGain];

    /// A new one that knows nothing of the key.
    pub fn begin(self, world: &World, part: &Nominal, mishaps: Mishaps) -> Box<dyn Controller> {
        match self {
            Who::Benderd => Box::new(Benderd::new(part)),
            Who::Oracle => Box::new(Oracle {
                part: part.clone(),
                angles: Angles::new(world, part, mishaps),
                feeds: Feeds::new(part),
                turns: Turns::new(),
            }),
            Who::Deadbeat => Box::new(ByHand { part: part.clone(), gain: 1.0 }),
            Who::HalfGain => Box::new(ByHand { part: part.clone(), gain: 0.5 }),
        }
    }
}

struct Benderd {
    part: Nominal,
    history: History,
    knowledge: Knowledge,
    limits: Limits,
    batches: u32,
}

impl Benderd {
    fn new(part: &Nominal) -> Benderd {
        let history = History { batch: Some("batch 0".to_owned()), ..History::default() };
        let (knowledge, limits) = (Knowledge::default(), Limits::default());
        Benderd { part: part.clone(), history, knowledge, limits, batches: 0 }
    }

    fn step(&self) -> correct::Answer {
        correct::step(&self.part, &self.history, &self.knowledge, &self.limits)
    }
}

impl Controller for Benderd {
    fn first(&mut self) -> CommandTable {
        self.step().commanded
    }

    fn next(&mut self, scanned: Scanned) -> Said {
        self.history.parts.push(Part {
            revision: Some(scanned.revision),
            scan_id: Some(scanned.scan_id),
            rescan: scanned.rescan,
            ..Part::new(scanned.commanded, scanned.measured)
        });
        let answer = self.step();
        Said { table: answer.commanded, verdict: Some(answer.verdict) }
    }

    fn withdraw(&mut self) {
        self.history.parts.pop();
    }

    fn new_program(&mut self, part: &Nominal, same_batch: bool) {
        self.knowledge = correct::learn(&self.part, &self.history, &self.knowledge, &self.limits);
        self.batches += u32::from(!same_batch);
        self.history.parts.clear();
        self.history.batch = Some(format!("batch {}", self.batches));
        self.part = part.clone();
    }
}

struct Oracle {
    part: Nominal,
    angles: Angles,
    feeds: Feeds,
    turns: Turns,
}

impl Oracle {
    fn table(&self) -> CommandTable {
        let mut table = CommandTable::from_lra(&self.part.lra);
        let turns = self.turns.commands_for(&self.part);
        for (i, row) in table.bends.iter_mut().enumerate() {
            row.angle_rad = self.angles.command_for(i, row.angle_rad);
            row.rotation_rad = turns[i];
        }
        let commanded: Vec<f64> = table.bends.iter().map(|row| row.angle_rad).collect();
        for (j, row) in table.bends.iter_mut().enumerate() {
            row.length_mm = self.feeds.command_for(j, &commanded);
        }
        table
    }
}

impl Controller for Oracle {
    fn first(&mut self) -> CommandTable {
        self.table()
    }

    fn next(&mut self, scanned: Scanned) -> Said {
        let Scanned { commanded, measured, .. } = scanned;
        let rows = &commanded.bends;
        let angles: Vec<f64> = rows.iter().map(|row| row.angle_rad).collect();
        let seen: Vec<(f64, f64)> = measured.bends.iter().map(|b| (b.angle_rad, b.angle_sigma_rad)).collect();
        let formed: Vec<f64> = seen.iter().map(|(angle, _)| *angle).collect();
        let fed: Vec<f64> = rows.iter().map(|row| row.length_mm).collect();
        let corner = inspect::corners(&measured, &self.part.lra);
        let distances = inspect::distances(&measured, &corner).into_iter().take(rows.len());
        let distances: Vec<(f64, f64)> = distances.flatten().map(|d| (d.value, d.sigma)).collect();
        let turn = |i| inspect::rotation(&measured, i).map_or((0.0, 1.0), |r| (r.value, r.sigma));
        let turns: Vec<(f64, f64)> = (0..rows.len()).map(turn).collect();
        self.angles.learn(&angles, &seen);
        self.feeds.learn(&fed, &angles, &formed, &distances);
        self.turns.learn(&commanded, &turns);
        Said { table: self.table(), verdict: None }
    }

    fn new_program(&mut self, part: &Nominal, same_batch: bool) {
        self.part = part.clone();
        if same_batch {
            self.angles.new_program(part)
        } else {
            self.angles.new_batch(part)
        }
        self.feeds.new_program(part);
    }
}

/// Corrects every value of LRA by its own error, or by a share of it. Begins with benderd's first table: what a shop's own
/// tables know is no worse.
struct ByHand {
    part: Nominal,
    gain: f64,
}

impl Controller for ByHand {
    fn first(&mut self) -> CommandTable {
        Benderd::new(&self.part).first()
    }

    fn next(&mut self, scanned: Scanned) -> Said {
        let (mut table, measured) = (scanned.commanded, scanned.measured);
        let each = table.bends.iter_mut().zip(&self.part.lra.bends).zip(&measured.bends);
        for (i, ((row, wanted), seen)) in each.enumerate() {
            let correct = |value: f64, error: f64| value + self.gain * error;
            row.angle_rad = correct(row.angle_rad, wanted.angle_rad - seen.angle_rad).max(0.0);
            if let Some(found) = seen.length_mm {
                row.length_mm = correct(row.length_mm, wanted.length_mm - found).max(0.0);
            }
            if let Some(found) = seen.rotation_rad.filter(|_| i > 0) {
                row.rotation_rad = correct(row.rotation_rad, wrap_angle(wanted.rotation_rad - found));
            }
        }
        Said { table, verdict: None }
    }

    fn new_program(&mut self, part: &Nominal, _: bool) {
        self.part = part.clone();
    }
}
