//! Many deliveries over a link that fails: random tables, damaged answers, trouble at the machine, all by a seed; and what must hold
//! afterwards, whatever happened.
//!
//! Under tokio's paused clock ten thousand of them take seconds; over a real line, as long as they take.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;
use std::time::Duration;

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use tokio::sync::mpsc;

use super::TrialError;
use crate::bender::can::{Bus, CanPort, MemoryBus};
use crate::bender::{
    Bender as _, Intent, IntentLog, Job, Link, LogError, Operation, Outcome, Profile, TableId, Transport,
    Wire, crc_of, deliver, encode_payload,
};
use crate::sim::bender::{MachineEvent, MachineModel};
use crate::sim::bender_server::SimulatedBender;
use crate::sim::door::{BUS_PATIENCE, Door, Speech};
use crate::sim::pty::Kept;
use crate::sim::trouble::{Trouble, When, WireFaults};
use crate::tube::{CommandRow, CommandTable};

/// Room for bytes on a wire in memory.
const WIRE_BYTES: usize = 4096;

/// The program that the machine has loaded.
const PROGRAM: &str = "P1";

/// Trouble at the machine comes within this time of the delivery's begin, or so many answers, or at the commit; in one of so many
/// deliveries.
const TROUBLE_WITHIN_MS: u64 = 400;
const TROUBLE_WITHIN_ANSWERS: u64 = 15;
const TROUBLE_ONE_IN: u32 = 4;

/// An emergency stop cuts an answer off before this byte.
const MOST_BYTES: usize = 260;

/// The longest that is waited for a machine to come back, in looks of one second.
const LOOKS: usize = 90;

/// What became of one delivery.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Ending {
    /// In force.
    Applied,
    /// Refused by the gate or by the machine.
    Rejected,
    /// Failed before the commit, or the machine did not take it.
    NotApplied,
    /// Not known at first; a later look showed the new table.
    UnknownThenApplied,
    /// Not known at first; a later look showed another table.
    UnknownThenNot,
}

/// How often each ending came about, and what must never be.
#[derive(Debug, Clone, Default)]
pub struct Totals {
    /// Counts.
    pub endings: BTreeMap<Ending, usize>,
    /// Seeds where something that must hold did not, and what.
    pub wrong: Vec<(u64, String)>,
}

impl Totals {
    /// Adds one case.
    pub fn add(&mut self, seed: u64, case: Result<Ending, String>) {
        match case {
            Ok(ending) => *self.endings.entry(ending).or_default() += 1,
            Err(what) => self.wrong.push((seed, what)),
        }
    }
}

impl fmt::Display for Totals {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let of = |ending| self.endings.get(&ending).copied().unwrap_or(0);
        write!(
            f,
            "applied {}, rejected {}, not applied {}, unknown then resolved {} (applied {}, not {}); wrong {}",
            of(Ending::Applied),
            of(Ending::Rejected),
            of(Ending::NotApplied),
            of(Ending::UnknownThenApplied) + of(Ending::UnknownThenNot),
            of(Ending::UnknownThenApplied),
            of(Ending::UnknownThenNot),
            self.wrong.len()
        )
    }
}

/// The machine's end of a wire, and a link at the other end.
pub struct Ends {
    /// Where the machine is reached.
    pub door: Door,
    /// What reaches it.
    pub link: Link,
}

/// Wires in memory, as many as are opened; for machines with a folder, that folder.
pub fn in_memory(profile: &Profile, folder: &Path) -> Result<Ends, TrialError> {
    if let Transport::Folder(number) = profile.transport {
        let on = folder.display().to_string();
        let door = Door::folder(profile, number, &on)?;
        return Ok(Ends { door, link: Link::new(profile.clone(), on)? });
    }
    if matches!(profile.transport, Transport::Can(_) | Transport::Canopen(_)) {
        return on_bus(profile);
    }
    let (made, wires) = mpsc::unbounded_channel();
    let open = move || {
        let (here, there) = tokio::io::duplex(WIRE_BYTES);
        made.send(there).map_err(|_| std::io::Error::other("the machine is gone"))?;
        Ok(Box::new(here) as Box<dyn Wire>)
    };
    let link = Link::over(profile.clone(), "a wire in memory", Box::new(open))?;
    let speech =
        Speech::of(&profile.transport).ok_or_else(|| std::io::Error::other("this transport has no wires"))?;
    Ok(Ends { door: Door::Memory(speech, wires), link })
}

/// A CAN bus in memory.
fn on_bus(profile: &Profile) -> Result<Ends, TrialError> {
    let bus = MemoryBus::new();
    let machine = bus.clone();
    let join = move || Ok(CanPort::new(Box::new(machine.join("machine")?), "machine", BUS_PATIENCE));
    let open = move |name: &str| Ok(Box::new(bus.join(name)?) as Box<dyn Bus>);
    let link = Link::on_bus(profile.clone(), "can0", Box::new(open))?;
    Ok(Ends { door: Door::Bus(Box::new(join), "in memory".into(), Box::new(profile.clone())), link })
}

/// The transport's own: a socket, a pseudo terminal in this folder, the folder itself, the profile's CAN interface.
pub async fn real(profile: &Profile, folder: &Path) -> Result<(Ends, Option<Kept>), TrialError> {
    let on = match &profile.transport {
        Transport::Folder(_) => folder.display().to_string(),
        Transport::Can(_) | Transport::Canopen(_) => profile.endpoint.clone(),
        transport if transport.serial().is_some() => folder.join("line").display().to_string(),
        _ => "127.0.0.1:0".to_owned(),
    };
    let (door, kept) = Door::open(profile, &on).await?;
    let link = Link::new(profile.clone(), door.address()?)?;
    Ok((Ends { door, link }, kept))
}

/// One delivery; what must hold and did not.
pub async fn run(
    seed: u64,
    per_mille: u32,
    profile: &Profile,
    ends: Ends,
) -> Result<Result<Ending, String>, TrialError> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let bends = rng.random_range(1..=profile.limits.max_bends);
    let encode = |table: &CommandTable| encode_payload(profile, PROGRAM, table).unwrap_or_default();
    let last = table(&mut rng, bends);
    let old = encode(&last);
    let operation = if seed.is_multiple_of(2) { Operation::Correct { last } } else { Operation::New };
    let job = Job {
        program: PROGRAM.into(),
        table: table(&mut rng, bends),
        expected_active: None,
        operation,
        approved: false,
    };
    let new = encode(&job.table);
    let edited = encode(&table(&mut rng, bends));

    let mut model = MachineModel::new(profile.clone(), PROGRAM, bends as u16);
    model.edit_at_screen(old.clone());
    model.at_screen = Some(edited.clone());
    let (tell, told) = std::sync::mpsc::channel();
    let bender = SimulatedBender::start(ends.door, model, None, move |event| drop(tell.send(event)))?;
    let mut faults = WireFaults::by_chance(profile, seed, per_mille);
    if let Some((when, trouble)) = trouble(&mut rng) {
        faults = faults.and(when, trouble);
    }
    bender.set_wire_faults(Some(faults));

    let (mut link, mut log) = (ends.link, Memory::default());
    let outcome = deliver(&mut link, &job, &mut log).await;
    bender.set_wire_faults(None);
    bender.with(|m| m.frozen = false);
    // What was still under way has arrived, and the machine has dealt with it.
    tokio::time::sleep(Duration::from_millis(profile.deadlines.settle_ms)).await;
    let active = bender.with(|m| (m.active(), m.active_payload()));
    let events = told.try_iter().filter(|event| !matches!(event, MachineEvent::Trouble(_))).collect();
    let found = Found { outcome, active, events, intents: log.intents, old, new, edited };
    Ok(match found.check() {
        Err(what) => Err(what),
        Ok(()) => found.ending(&mut link).await,
    })
}

/// What a delivery left behind.
struct Found {
    outcome: Outcome,
    active: (TableId, Vec<u8>),
    events: Vec<MachineEvent>,
    intents: Vec<Intent>,
    old: Vec<u8>,
    new: Vec<u8>,
    edited: Vec<u8>,
}

impl Found {
    /// Whether the machine holds a whole table that somebody meant, and the record agrees with it.
    fn check(&self) -> Result<(), String> {
        let (id, payload) = &self.active;
        if crc_of(payload) != id.crc || ![&self.old, &self.new, &self.edited].contains(&payload) {
            return Err(format!("the active table is neither the old nor the new one, whole: {id}"));
        }
        let commits = self.events.len();
        if commits > self.intents.len() || self.intents.len() > 1 {
            return Err(format!("{commits} commits arrived, {} intents were journalled", self.intents.len()));
        }
        let taken = self.events.iter().any(|e| matches!(e, MachineEvent::TakenOver { .. }));
        match &self.outcome {
            Outcome::Applied(_) if !taken => Err("said to be applied, never taken over".into()),
            Outcome::Rejected { .. } | Outcome::NotApplied { .. } if taken => {
                Err(format!("taken over, and said to be {:?}", self.outcome))
            }
            _ => Ok(()),
        }
    }

    /// What became of it; of what is unknown, by a later look.
    async fn ending(&self, link: &mut Link) -> Result<Ending, String> {
        Ok(match &self.outcome {
            Outcome::Applied(_) | Outcome::AlreadyActive(_) => Ending::Applied,
            Outcome::Rejected { .. } => Ending::Rejected,
            Outcome::NotApplied { .. } => Ending::NotApplied,
            Outcome::Unknown { .. } => {
                let mut seen = Err("never".to_owned());
                for _ in 0..LOOKS {
                    tokio::time::sleep(Duration::from_secs(1)).await;
                    seen = link.read_active().await.map_err(|e| e.to_string());
                    if seen.is_ok() {
                        break;
                    }
                }
                let seen = seen.map_err(|e| format!("unknown, and the machine is not heard again: {e}"))?;
                if (seen.status.active, &seen.payload) != (self.active.0, &self.active.1) {
                    return Err("the later look shows what is not there".into());
                }
                let applied = seen.payload == self.new;
                if applied { Ending::UnknownThenApplied } else { Ending::UnknownThenNot }
            }
        })
    }
}

/// A table that the reference machines can make.
pub fn table(rng: &mut ChaCha8Rng, bends: usize) -> CommandTable {
    let mut row = || CommandRow {
        length_mm: rng.random_range(20.0..500.0),
        rotation_rad: rng.random_range(-3.0..3.0),
        angle_rad: rng.random_range(0.1..3.0),
    };
    CommandTable { bends: (0..bends).map(|_| row()).collect(), last_length_mm: 50.0 }
}

/// What happens at the machine meanwhile, and when: mostly nothing.
fn trouble(rng: &mut ChaCha8Rng) -> Option<(When, Trouble)> {
    if rng.random_range(0..TROUBLE_ONE_IN) > 0 {
        return None;
    }
    let trouble = match rng.random_range(0..7) {
        0 => Trouble::Reboot,
        1 => Trouble::Edit,
        2 => Trouble::Running,
        3 => Trouble::Frozen,
        4 => Trouble::OtherProgram,
        5 => Trouble::EmergencyStop { bytes: rng.random_range(0..MOST_BYTES) },
        _ => Trouble::HalfClose,
    };
    let when = match rng.random_range(0..4) {
        0 => When::Ms(rng.random_range(0..TROUBLE_WITHIN_MS)),
        1 => When::Answer(rng.random_range(1..=TROUBLE_WITHIN_ANSWERS)),
        2 => When::Commit,
        _ => When::TakenOver,
    };
    Some((when, trouble))
}

/// Keeps in memory what a journal would keep.
#[derive(Debug, Default)]
pub struct Memory {
    /// In their order.
    pub intents: Vec<Intent>,
    /// In theirs.
    pub outcomes: Vec<Outcome>,
    /// Takes no intent any more.
    pub full: bool,
}

impl IntentLog for Memory {
    fn intent(&mut self, intent: &Intent) -> Result<(), LogError> {
        if self.full {
            return Err("disk full".into());
        }
        self.intents.push(intent.clone());
        Ok(())
    }

    fn outcome(&mut self, _: &Job, _: Option<&Intent>, outcome: &Outcome) -> Result<(), LogError> {
        self.outcomes.push(outcome.clone());
        Ok(())
    }
}
