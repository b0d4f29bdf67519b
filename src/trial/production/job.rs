//! One simulated job: tube after tube is bent, scanned and corrected. The same seed gives every controller the same plant, the same
//! scatter and the same errors of the scans.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::controllers::{Controller, Said, Scanned, Who};
use super::mixups::{GROSS_RAD, MixUp};
use super::oracle::angles::Mishaps;
use super::scanner::Scanner;
use super::truth::Truth;
use crate::correct::Verdict;
use crate::sim::forming::{FormedTube, Plant, World};
use crate::tube::{CommandTable, MeasuredTube, Nominal};

/// Scans of one tube, at most.
const SCANS: usize = 3;

/// What happens in a job.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Scenario {
    /// Nothing is known of the key.
    Cold,
    /// Another part was bent on it before: so many tubes, and of the same batch or not.
    Known {
        /// Tubes that were learned from.
        learned: usize,
        /// Whether the batch is the same.
        same_batch: bool,
    },
    /// Before this part (from 0) the tubes change, unannounced: their spring-back by this factor or its inverse.
    Shift {
        /// The first tube of the new ones.
        at: usize,
        /// Factor.
        factor: f64,
    },
    /// This share of the angles is measured 3 degrees off.
    Gross {
        /// Share.
        share: f64,
    },
    /// One thing is mixed up, with one of the tubes after the first.
    MixUps,
}

/// Where a job is done.
#[derive(Debug, Clone)]
pub struct Shop {
    /// The plant.
    pub world: World,
    /// The scan arm.
    pub scanner: Scanner,
    /// What happens.
    pub scenario: Scenario,
    /// Tubes that are bent of the part that counts.
    pub parts: usize,
}

/// One tube of a job.
#[derive(Debug, Clone)]
pub struct Tube {
    /// What it really is.
    pub truth: Truth,
    /// Whether that is good.
    pub good: bool,
    /// benderd's verdict after its last scan.
    pub verdict: Option<Verdict>,
    /// How often it was scanned.
    pub scans: usize,
    /// Whether benderd held it though nothing was wrong.
    pub held_falsely: bool,
    /// What was mixed up with it, and whether that was met rightly.
    pub mix_up: Option<(MixUp, bool)>,
}

/// A job under way.
pub struct Job<'a> {
    shop: &'a Shop,
    seed: u64,
    plant: Plant,
    controller: Box<dyn Controller>,
    table: CommandTable,
    revision: u64,
    /// The table before, and its revision.
    older: Option<(CommandTable, u64)>,
    bent: u64,
    /// What was shown last.
    shown: Option<Scanned>,
    /// What will be mixed up with which tube, counted from 1.
    mix_up: Option<(MixUp, u64)>,
}

impl Shop {
    fn mishaps(&self) -> Mishaps {
        match self.scenario {
            Scenario::Gross { share } => Mishaps { gross: share, ..Mishaps::default() },
            Scenario::Shift { factor, .. } => {
                Mishaps { shift: (1.0 / self.parts as f64, factor.ln()), ..Mishaps::default() }
            }
            _ => Mishaps::default(),
        }
    }

    /// Does a whole job; `before` is the part that a known key was learned with.
    pub fn run(&self, who: Who, part: &Nominal, before: &Nominal, seed: u64) -> Vec<Tube> {
        match self.scenario {
            Scenario::Known { learned, same_batch } => {
                let mut job = Job::begin(self, who, before, seed);
                for _ in 0..learned {
                    job.tube(before);
                }
                job.change(part, same_batch);
                (0..self.parts).map(|_| job.tube(part)).collect()
            }
            _ => {
                let mut job = Job::begin(self, who, part, seed);
                let tube = |k| {
                    job.may_shift(k);
                    job.tube(part)
                };
                (0..self.parts).map(tube).collect()
            }
        }
    }
}

impl<'a> Job<'a> {
    /// Sets everything up.
    pub fn begin(shop: &'a Shop, who: Who, part: &Nominal, seed: u64) -> Job<'a> {
        let plant = Plant::of(shop.world.clone(), part, seed);
        let mut controller = who.begin(&shop.world, part, shop.mishaps());
        let table = controller.first();
        // Who gives no verdicts is not shown them: somebody sorts them out.
        let judges = who == Who::Benderd && shop.parts > 1;
        let mix_up = (shop.scenario == Scenario::MixUps && judges).then(|| {
            let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x313c_0000);
            let which = MixUp::ALL[rng.random_range(0..MixUp::ALL.len())];
            let tube = rng.random_range(2..=shop.parts as u64);
            // The first correction is the one that matters.
            (which, if which == MixUp::WrongRevision { 2 } else { tube })
        });
        Job { shop, seed, plant, controller, table, revision: 1, older: None, bent: 0, shown: None, mix_up }
    }

    fn change(&mut self, part: &Nominal, same_batch: bool) {
        if !same_batch {
            self.plant.new_batch();
        }
        self.plant.new_program(part);
        self.controller.new_program(part, same_batch);
        self.table = self.controller.first();
        self.revision += 1;
    }

    fn may_shift(&mut self, tube: usize) {
        if let Scenario::Shift { at, factor } = self.shop.scenario
            && at == tube
        {
            self.plant.shift_batch(if self.seed.is_multiple_of(2) { factor } else { 1.0 / factor });
        }
    }

    /// Bends a tube, scans it as often as is asked for, and takes the next table.
    pub fn tube(&mut self, part: &Nominal) -> Tube {
        let formed = self.bend(part);
        let truth = Truth::of(&formed.lra, part);
        let possible = |which: &MixUp| *which != MixUp::WrongRevision || self.older.is_some();
        let due = self.mix_up.filter(|(_, tube)| *tube == self.bent).map(|(which, _)| which);
        let mix_up = due.filter(possible);
        let mut met = None;
        let mut again = 0;
        let mut said = match mix_up {
            Some(which) => {
                let said = self.mixed_up(which, &formed, part);
                met = said.verdict.map(|verdict| which.is_met_by(verdict));
                again += 1;
                if which.is_withdrawn() && said.verdict == Some(Verdict::Hold) {
                    self.controller.withdraw();
                    self.take(self.scan(&formed, part, again), again, false)
                } else {
                    said
                }
            }
            None => self.take(self.scan(&formed, part, 0), 0, false),
        };
        let mut scans = 1;
        while said.verdict == Some(Verdict::Rescan) && scans < SCANS {
            again += 1;
            said = self.take(self.scan(&formed, part, again), again, true);
            scans += 1;
        }
        let held_falsely = said.verdict == Some(Verdict::Hold) && !self.has_changed();
        self.put(said.table);
        let good = truth.is_good(part);
        Tube { truth, good, verdict: said.verdict, scans, held_falsely, mix_up: mix_up.zip(met) }
    }

    /// Whether the tubes did change, unannounced: then somebody should look.
    fn has_changed(&self) -> bool {
        matches!(self.shop.scenario, Scenario::Shift { at, .. } if self.bent > at as u64)
    }

    /// Shows what should not be shown.
    fn mixed_up(&mut self, which: MixUp, formed: &FormedTube, part: &Nominal) -> Said {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed ^ 0x313c_0001);
        let mut other = super::parts::other(part, self.seed);
        other.lra.bends.iter_mut().for_each(|b| b.angle_rad *= rng.random_range(0.99..1.01));
        let lra = match &self.older {
            Some((table, _)) if which == MixUp::WrongRevision => {
                self.plant.clone().bend(table, part.lra.developed_length_mm()).lra
            }
            _ => which.tube(&formed.lra, &other.lra, &mut rng),
        };
        let measured = which.scan(self.scan(&FormedTube { lra, ..formed.clone() }, part, 0), &mut rng);
        let mut entry = which.entry(self.entry(measured, 0, false), self.shown.as_ref());
        if let Some((_, revision)) = self.older.as_ref().filter(|_| which == MixUp::WrongRevision) {
            entry.revision = *revision;
        }
        self.shown = Some(entry.clone());
        self.controller.next(entry)
    }

    /// Bends a tube with the table in force.
    fn bend(&mut self, part: &Nominal) -> FormedTube {
        self.bent += 1;
        self.plant.bend(&self.table, part.lra.developed_length_mm())
    }

    /// Scans the tube that was bent last.
    fn scan(&self, formed: &FormedTube, part: &Nominal, again: usize) -> MeasuredTube {
        let stream = self.bent * (SCANS as u64 + 2) + again as u64;
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed ^ 0x5ca9_0000);
        rng.set_stream(stream);
        let mut measured = self.shop.scanner.scan(&formed.lra, part.od_mm / 2.0, &mut rng);
        if let Scenario::Gross { share } = self.shop.scenario {
            for bend in &mut measured.bends {
                let (wrong, more) = (rng.random_bool(share), rng.random_bool(0.5));
                let off = if more { GROSS_RAD } else { -GROSS_RAD };
                bend.angle_rad = (bend.angle_rad + if wrong { off } else { 0.0 }).max(0.0);
            }
        }
        measured
    }

    /// Shows a scan of the tube that was bent last; `rescan`: another one.
    fn take(&mut self, measured: MeasuredTube, again: usize, rescan: bool) -> Said {
        let entry = self.entry(measured, again, rescan);
        self.shown = Some(entry.clone());
        self.controller.next(entry)
    }

    fn entry(&self, measured: MeasuredTube, again: usize, rescan: bool) -> Scanned {
        let scan_id = format!("{}-{}-{again}", self.seed, self.bent);
        Scanned { commanded: self.table.clone(), measured, revision: self.revision, scan_id, rescan }
    }

    /// Puts a table in force, whoever made it.
    pub fn put(&mut self, table: CommandTable) {
        if table != self.table {
            self.older = Some((std::mem::replace(&mut self.table, table), self.revision));
            self.revision += 1;
        }
    }
}
