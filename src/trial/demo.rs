//! The demo: the daemon's own cell loop in a simulated shop, part after part, until a part is good.

use std::time::Duration;

use tokio::sync::{broadcast, mpsc};

use super::record::PartRecord;
use super::shop::Shop;
use super::{TrialError, story};
use crate::arm::{FolderSettings, WatchedFolder};
use crate::bender::{Link, Profile};
use crate::cell::{Chain, Command, Decided, Driver, Dwell, Identity, Notice, State};
use crate::cloud::Unit;
use crate::config::Mode;
use crate::correct::Verdict;
use crate::inspect;
use crate::journal::Journal;
use crate::sim::forming::FormedTube;
use crate::tube::Nominal;

/// A part that is not good by then shows that something is wrong.
const MAX_PARTS: usize = 6;

/// Scans of one tube before the operator gives up; the cell itself holds at three.
const MAX_SCANS: usize = 4;

/// The name of the cell, in its journal.
const CELL: &str = "demo";

/// What is demonstrated.
#[derive(Debug, Clone)]
pub struct Demo {
    /// The part to make.
    pub nominal: Nominal,
    /// The machine's profile.
    pub profile: Profile,
    /// Decides everything that is random.
    pub seed: u64,
}

/// How it went.
#[derive(Debug, Clone)]
pub struct DemoResult {
    /// The parts made, in order.
    pub parts: Vec<PartRecord>,
    /// Whether the last one was good.
    pub in_tolerance: bool,
}

/// Runs the demo and tells it to `say` as it goes, whole lines at a time. Leaves no files behind.
pub async fn run(demo: &Demo, say: &mut (dyn FnMut(&str) + Send)) -> Result<DemoResult, TrialError> {
    let folder = tempfile::tempdir()?;
    let scans = folder.path().join("scans");
    let settings = FolderSettings {
        poll: Duration::from_millis(20),
        settle_time: Duration::from_millis(200),
        ..FolderSettings::new(&scans)
    };
    let source = WatchedFolder::open(settings).await?;
    let mut shop = Shop::open(&demo.nominal, demo.profile.clone(), &scans, demo.seed).await?;
    say(&story::header(demo, &shop.address()));
    let journal = folder.path().join("journal.db");
    let identity = Identity {
        name: CELL.into(),
        program: demo.nominal.name.clone(),
        mode: Mode::Automatic,
        dwell: Dwell::default(),
    };
    let link = Link::new(demo.profile.clone(), shop.address())?;
    let chain = Chain::new(CELL, demo.nominal.clone(), Unit::Millimetre, demo.profile.limits.clone());
    let journals = [Journal::open(&journal)?, Journal::open(&journal)?];
    let driver = Driver::new(identity, link, source, chain, journals)?;
    let notices = driver.listen();
    let (commands, receiver) = mpsc::channel(1);
    let running = tokio::spawn(driver.run(receiver));
    let result =
        Operator { shop: &mut shop, notices, commands: &commands, parts: Vec::new() }.work(say).await;
    drop(commands);
    let _ = running.await;
    let result = result?;
    let records = Journal::open(&journal)?.verify()?;
    say(&story::ending(&result, records));
    Ok(result)
}

/// The person at the cell: arms it, bends, scans, and looks at what comes of it.
struct Operator<'a> {
    shop: &'a mut Shop,
    notices: broadcast::Receiver<Notice>,
    commands: &'a mpsc::Sender<Command>,
    parts: Vec<PartRecord>,
}

impl Operator<'_> {
    async fn work(mut self, say: &mut (dyn FnMut(&str) + Send)) -> Result<DemoResult, TrialError> {
        self.wait_for(|state| *state == State::Disarmed).await?;
        if self.commands.send(Command::Arm).await.is_err() {
            return Err(TrialError::Stopped);
        }
        self.wait_for(ready).await?;
        for number in 1..=MAX_PARTS {
            let tube = self.shop.bend().ok_or(TrialError::NoTable)?;
            let decided = self.scan_until_decided(&tube).await?;
            let good = self.note(number, &decided, say)?;
            self.wait_for(ready).await?;
            if good {
                return Ok(DemoResult { parts: self.parts, in_tolerance: true });
            }
        }
        Ok(DemoResult { parts: self.parts, in_tolerance: false })
    }

    /// Scans the same tube again while the cell asks for it.
    async fn scan_until_decided(&mut self, tube: &FormedTube) -> Result<Decided, TrialError> {
        for _ in 0..MAX_SCANS {
            self.shop.scan(tube).await?;
            loop {
                match self.next().await? {
                    Notice::Decided(decided) if decided.decision.answer.verdict == Verdict::Rescan => {}
                    Notice::Decided(decided) => return Ok(*decided),
                    Notice::State(state) => {
                        stopped(&state)?;
                        if ready(&state) {
                            break;
                        }
                    }
                }
            }
        }
        Err(TrialError::Held("the tube could not be measured".into()))
    }

    /// Puts the part on record and says whether it is good. A tube of the
    /// wrong length is the operator's to cut: no feed corrects it.
    fn note(
        &mut self,
        number: usize,
        decided: &Decided,
        say: &mut (dyn FnMut(&str) + Send),
    ) -> Result<bool, TrialError> {
        let decision = &decided.decision;
        let (Some(in_force), Some(measured), Some(inspection)) =
            (&decided.in_force, &decided.measured, &decision.inspection)
        else {
            return Err(TrialError::Held(decision.reasons()));
        };
        let answer = &decision.answer;
        let part = PartRecord {
            number,
            revision: in_force.id.revision,
            commanded: in_force.table.clone(),
            measured: measured.clone(),
            inspection: (**inspection).clone(),
            next: (answer.verdict == Verdict::Correct).then(|| answer.commanded.clone()),
        };
        // The loop answers for what a table can do; the tail is the cut's matter and must be good as well.
        let good = part.inspection.verdict == inspect::Verdict::InTolerance
            && answer.verdict == Verdict::InTolerance;
        let off_mm = self.shop.too_long_mm(&part).filter(|_| !good);
        say(&story::part(&part, off_mm));
        self.shop.cut_longer(-off_mm.unwrap_or(0.0));
        self.parts.push(part);
        Ok(good)
    }

    async fn wait_for(&mut self, wanted: impl Fn(&State) -> bool) -> Result<(), TrialError> {
        loop {
            if let Notice::State(state) = self.next().await? {
                if wanted(&state) {
                    return Ok(());
                }
                stopped(&state)?;
            }
        }
    }

    async fn next(&mut self) -> Result<Notice, TrialError> {
        // The cell is slower than this loop: nothing is missed, and it ends only when it has broken down.
        self.notices.recv().await.map_err(|_| TrialError::Stopped)
    }
}

fn ready(state: &State) -> bool {
    matches!(state, State::Ready | State::InTolerance)
}

fn stopped(state: &State) -> Result<(), TrialError> {
    match state {
        State::Held(hold) => Err(TrialError::Held(hold.reason.clone())),
        State::Faulted(fault) => Err(TrialError::Held(fault.reason.clone())),
        _ => Ok(()),
    }
}
