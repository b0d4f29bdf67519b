//! Deliveries against a model machine with a failure at any step, under a clock turned by hand.
//!
//! Whatever happens: the active table is always a whole one that somebody meant to be active, a commit goes out
//! once at most and never before an equal read-back and a journalled intent, and the outcome is true, also a
//! while later. The same seed gives the same run.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

use std::collections::BTreeMap;

use benderd::bender::{
    Action, ActiveTable, Delivery, Event, Job, Operation, Outcome, Profile, Status, TableId, commit_image,
    crc_of, decode_status, encode_payload, staging_image, status_span,
};
use benderd::sim::bender::{MachineEvent, MachineModel};
use benderd::tube::CommandTable;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

const BENDS: usize = 3;

fn table(rng: &mut ChaCha8Rng) -> CommandTable {
    benderd::trial::deliveries::table(rng, BENDS)
}

fn words(bytes: &[u8]) -> Vec<u16> {
    bytes.chunks_exact(2).map(|p| u16::from_be_bytes([p[0], p[1]])).collect()
}

/// What goes wrong with one action.
#[derive(Clone, Copy, PartialEq)]
enum Trouble {
    None,
    AtTheMachine,
    LostOnTheWay,
    LostOnTheWayBack,
    /// Staging: a bit flips. Intent: the disk is full. Commit: it arrives later.
    Special,
}

struct World {
    rng: ChaCha8Rng,
    /// Of a hundred actions.
    trouble_percent: u32,
    profile: Profile,
    machine: MachineModel,
    now_ms: u64,
    /// A commit still on its way through the network.
    late: Option<(u64, TableId)>,
    taken_over: Vec<TableId>,
    /// Tables that may be active.
    meant: BTreeMap<TableId, Vec<u8>>,
    staged: Vec<u8>,
    read_back_was_equal: bool,
    intent: Option<TableId>,
    commits: u32,
}

impl World {
    fn new(seed: u64, trouble_percent: u32) -> (World, Job) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let profile = Profile::load("reference-modbus").unwrap();
        let mut machine = MachineModel::new(profile.clone(), "P1", BENDS as u16);
        machine.edit_at_screen(encode_payload(&profile, "P1", &table(&mut rng)).unwrap());
        if rng.random_bool(0.5) {
            // The refusal of an earlier attempt at the next revision still stands in the acknowledgement.
            let id = TableId { revision: machine.active().revision + 1, crc: 0 };
            machine
                .write(
                    profile.transport.modbus().unwrap().registers.commit,
                    &words(&commit_image(&profile, id)),
                )
                .unwrap();
            assert!(matches!(machine.tick(), Some(MachineEvent::Refused { .. })));
        }
        let job = Job {
            program: "P1".into(),
            table: table(&mut rng),
            expected_active: None,
            operation: Operation::New,
            approved: false,
        };
        let meant = BTreeMap::from([(machine.active(), machine.active_payload())]);
        let world = World {
            rng,
            trouble_percent,
            profile,
            machine,
            now_ms: 0,
            late: None,
            taken_over: Vec::new(),
            meant,
            staged: Vec::new(),
            read_back_was_equal: false,
            intent: None,
            commits: 0,
        };
        (world, job)
    }

    /// Lets the machine run; every cycle is looked at.
    fn pass(&mut self, ms: u64) {
        for _ in 0..ms.div_ceil(10) {
            self.now_ms += 10;
            if let Some((due, id)) = self.late
                && due <= self.now_ms
            {
                self.late = None;
                self.write_commit(id);
            }
            if let Some(MachineEvent::TakenOver { id, .. }) = self.machine.tick() {
                self.taken_over.push(id);
            }
            let (active, payload) = (self.machine.active(), self.machine.active_payload());
            assert_eq!(crc_of(&payload), active.crc, "the active table is whole");
            assert_eq!(self.meant.get(&active), Some(&payload), "the active table is one that was meant");
        }
    }

    fn write_commit(&mut self, id: TableId) {
        let image = commit_image(&self.profile, id);
        self.machine
            .write(self.profile.transport.modbus().unwrap().registers.commit, &words(&image))
            .unwrap();
    }

    fn trouble_at_the_machine(&mut self) {
        match self.rng.random_range(0..6) {
            0 => self.machine.power_cycle(),
            1 => {
                let table = table(&mut self.rng);
                self.machine.edit_at_screen(encode_payload(&self.profile, "P1", &table).unwrap());
                self.meant.insert(self.machine.active(), self.machine.active_payload());
            }
            2 => self.machine.set_between_parts(false),
            3 => self.machine.frozen = true,
            4 => self.machine.frozen = false,
            _ => self.machine.rename_program("P2"),
        }
    }

    fn read(&self, address: u16, bytes: usize) -> Vec<u8> {
        let words = self.machine.read(address, (bytes / 2) as u16).unwrap();
        words.into_iter().flat_map(u16::to_be_bytes).collect()
    }

    fn status(&self) -> Status {
        let (first, count) = status_span(&self.profile, self.profile.transport.modbus().unwrap());
        decode_status(
            &self.profile,
            self.profile.transport.modbus().unwrap(),
            &self.read(first, 2 * usize::from(count)),
        )
        .unwrap()
    }

    /// Performs an action, with or without trouble, and checks that it was allowed.
    fn perform(&mut self, action: &Action) -> Event {
        let mut trouble = Trouble::None;
        if self.rng.random_range(0..100) < self.trouble_percent {
            trouble = match self.rng.random_range(0..4) {
                0 => Trouble::AtTheMachine,
                1 => Trouble::LostOnTheWay,
                2 => Trouble::LostOnTheWayBack,
                _ => Trouble::Special,
            };
        }
        if trouble == Trouble::AtTheMachine {
            self.trouble_at_the_machine();
        }
        let uses_the_link = !matches!(action, Action::Wait { .. } | Action::JournalIntent(_));
        if let Action::Commit(id) = action {
            self.check_commit(*id);
        }
        let ms = self.rng.random_range(1..40);
        if uses_the_link && trouble == Trouble::LostOnTheWay {
            self.pass(1000);
            return Event::Failed("lost on the way".into());
        }
        let event = self.perform_whole(action, trouble);
        if uses_the_link && trouble == Trouble::LostOnTheWayBack {
            self.pass(1000);
            return Event::Failed("lost on the way back".into());
        }
        // An answer is old by the time it is there.
        self.pass(ms);
        event
    }

    fn check_commit(&mut self, id: TableId) {
        self.commits += 1;
        assert_eq!(self.commits, 1, "a commit goes out once");
        assert!(self.read_back_was_equal, "never before an equal read-back");
        assert_eq!(self.intent, Some(id), "never before its intent is journalled");
    }

    fn perform_whole(&mut self, action: &Action, trouble: Trouble) -> Event {
        let special = trouble == Trouble::Special;
        match action {
            Action::ReadStatus => Event::StatusRead(self.status()),
            Action::WriteStaging(staged) => {
                self.staged = staging_image(&self.profile, staged);
                let mut image = words(&self.staged);
                if special {
                    let at = self.rng.random_range(0..image.len());
                    image[at] ^= 1 << self.rng.random_range(0..16);
                }
                self.machine
                    .write(self.profile.transport.modbus().unwrap().registers.staging, &image)
                    .unwrap();
                self.meant.insert(staged.id, staged.payload.clone());
                Event::Written
            }
            Action::ReadStaging { bytes } => {
                let bytes = self.read(self.profile.transport.modbus().unwrap().registers.staging, *bytes);
                self.read_back_was_equal = bytes == self.staged;
                Event::ReadBack(bytes)
            }
            Action::JournalIntent(_) if special => Event::Failed("disk full".into()),
            Action::JournalIntent(intent) => {
                self.intent = Some(intent.new);
                Event::IntentJournalled
            }
            Action::Commit(id) if special => {
                // The profile promises that nothing arrives after settle_ms.
                let delay = self.rng.random_range(0..self.profile.deadlines.settle_ms - 20);
                self.late = Some((self.now_ms + delay, *id));
                Event::Failed("the commit is held up".into())
            }
            Action::Commit(id) => {
                self.write_commit(*id);
                Event::Committed
            }
            Action::ReadActive => {
                let payload = self.machine.active_payload();
                Event::ActiveRead(ActiveTable { status: self.status(), payload })
            }
            Action::Wait { until_ms } => {
                self.pass(until_ms.saturating_sub(self.now_ms));
                Event::Timeout
            }
            Action::Finish(_) => unreachable!("the caller stops there"),
        }
    }
}

/// Runs one delivery to its end and checks that its outcome is true.
fn run(seed: u64, trouble_percent: u32) -> Outcome {
    let (mut world, job) = World::new(seed, trouble_percent);
    let (mut delivery, mut action) = Delivery::start(&world.profile, &job);
    let payload = encode_payload(&world.profile, &job.program, &job.table).unwrap();
    let outcome = loop {
        if let Action::Finish(outcome) = action {
            break outcome;
        }
        let event = world.perform(&action);
        action = delivery.on(event, world.now_ms);
        assert!(world.now_ms < 60_000, "every delivery ends");
    };
    let is_active = world.machine.active_payload() == payload;
    match &outcome {
        Outcome::Applied(id) => {
            assert!(is_active && world.machine.active() == *id && world.taken_over == [*id]);
        }
        Outcome::AlreadyActive(_) => assert!(is_active && world.commits == 0),
        Outcome::Rejected { .. } | Outcome::NotApplied { .. } => {
            world.machine.frozen = false;
            world.machine.set_between_parts(true);
            world.pass(5000);
            assert_eq!(world.taken_over, [], "it stays so: {outcome:?}");
        }
        Outcome::Unknown { .. } => assert_eq!(world.commits, 1),
    }
    if world.commits == 0 {
        assert_eq!(world.taken_over, []);
    }
    outcome
}

fn kind(outcome: &Outcome) -> &'static str {
    match outcome {
        Outcome::Applied(_) => "applied",
        Outcome::AlreadyActive(_) => "already active",
        Outcome::Rejected { .. } => "rejected",
        Outcome::NotApplied { .. } => "not applied",
        Outcome::Unknown { .. } => "unknown",
    }
}

#[test]
fn without_trouble_every_delivery_is_applied() {
    for seed in 0..200 {
        assert_eq!(kind(&run(seed, 0)), "applied", "seed {seed}");
    }
}

#[test]
fn with_trouble_at_any_step_every_outcome_is_true() {
    let mut totals = BTreeMap::new();
    for seed in 0..20_000 {
        let outcome = std::panic::catch_unwind(|| run(seed, 5 + (seed % 30) as u32));
        let outcome = outcome.unwrap_or_else(|_| panic!("seed {seed}"));
        *totals.entry(kind(&outcome)).or_insert(0) += 1;
    }
    println!("20000 deliveries: {totals:?}");
    for kind in ["applied", "rejected", "not applied", "unknown"] {
        assert!(totals.get(kind).is_some_and(|n| *n > 100), "too few {kind} to mean much: {totals:?}");
    }
}

#[test]
fn the_same_seed_gives_the_same_outcome() {
    for seed in 0..200 {
        assert_eq!(run(seed, 20), run(seed, 20));
    }
}
