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
use crate::sim::forming::{Plant, World};
use crate::tube::{CommandTable, Lra, MeasuredTube, Nominal};

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
        let truth = Truth::of(&formed, part);
        let mix_up = self.mix_up.filter(|(_, tube)| *tube == self.bent).map(|(which, _)| which);
        // Where the table was never changed there is no older one.
        let mix_up = mix_up.filter(|which| *which != MixUp::WrongRevision || self.older.is_some());
        let (mut said, met) = match mix_up {
            Some(which) => self.first_look(which, &formed, part),
            None => (self.show(&formed, part, 0, false), None),
        };
        let mut scans = 1;
        while said.verdict == Some(Verdict::Rescan) && scans < SCANS {
            // The second scan is kept for who looked at something else first.
            said = self.show(&formed, part, scans + usize::from(mix_up.is_some()), true);
            scans += 1;
        }
        let held_falsely = said.verdict == Some(Verdict::Hold) && !self.has_changed();
        self.put(said.table);
        let good = truth.is_good(part);
        Tube { truth, good, verdict: said.verdict, scans, held_falsely, mix_up: mix_up.zip(met) }
    }

    /// What is said of something mixed up, whether rightly; and of the tube itself where the former was withdrawn.
    fn first_look(&mut self, which: MixUp, formed: &Lra, part: &Nominal) -> (Said, Option<bool>) {
        let said = self.mixed_up(which, formed, part);
        let met = said.verdict.map(|verdict| which.is_met_by(verdict));
        if !which.is_withdrawn() || said.verdict != Some(Verdict::Hold) {
            return (said, met);
        }
        self.controller.withdraw();
        (self.show(formed, part, 1, false), met)
    }

    /// Whether the tubes did change, unannounced: then somebody should look.
    fn has_changed(&self) -> bool {
        matches!(self.shop.scenario, Scenario::Shift { at, .. } if self.bent > at as u64)
    }

    /// Shows what should not be shown.
    fn mixed_up(&mut self, which: MixUp, formed: &Lra, part: &Nominal) -> Said {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed ^ 0x313c_0001);
        let older = self.older.clone().filter(|_| which == MixUp::WrongRevision);
        let tube = match &older {
            Some((table, _)) => self.plant.clone().bend(table, part.lra.developed_length_mm()).lra,
            None => which.tube(formed, &super::parts::other(part, self.seed).lra, &mut rng),
        };
        let measured = which.scan(self.scan(&tube, part, 0), &mut rng);
        let mut entry = which.entry(self.entry(measured, 0, false), self.shown.as_ref());
        entry.revision = older.map_or(entry.revision, |(_, revision)| revision);
        self.told(entry)
    }

    /// Bends a tube with the table in force.
    fn bend(&mut self, part: &Nominal) -> Lra {
        self.bent += 1;
        self.plant.bend(&self.table, part.lra.developed_length_mm()).lra
    }

    /// Scans the tube that was bent last.
    fn scan(&self, formed: &Lra, part: &Nominal, again: usize) -> MeasuredTube {
        let stream = self.bent * (SCANS as u64 + 2) + again as u64;
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed ^ 0x5ca9_0000);
        rng.set_stream(stream);
        let mut measured = self.shop.scanner.scan(formed, part.od_mm / 2.0, &mut rng);
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
    fn show(&mut self, formed: &Lra, part: &Nominal, again: usize, rescan: bool) -> Said {
        let measured = self.scan(formed, part, again);
        self.told(self.entry(measured, again, rescan))
    }

    fn told(&mut self, entry: Scanned) -> Said {
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
