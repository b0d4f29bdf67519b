//! Performs what the cell asks for. Async, and thin: every decision is the state machine's or a pure room's.
//!
//! One loop takes scans, commands, results and the clock, and hands them to [`Cell`] one by one. Measuring and
//! deciding run off the async workers, the machine has a task of its own ([`worker`](super::worker)); both answer
//! with events, so the cell can be disarmed at any time.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use serde_json::json;
use tokio::sync::{broadcast, mpsc};
use tokio::time::Instant;

use super::event::{Action, Decision, Dwell, Event, InForce, Ticket};
use super::journalling::record;
use super::machine::{Cell, Part};
use super::state::{Hold, State};
use super::worker::{Ask, Worker};
use crate::arm::{ArmError, Filing, ScanFile, ScanSource};
use crate::bender::{Bender, Job};
use crate::config::Mode;
use crate::journal::{Journal, JournalError};
use crate::tube::MeasuredTube;

/// Events and asks in flight; the cell asks for one thing at a time.
const QUEUE: usize = 16;

/// Notices kept for a listener that is slow.
const NOTICES: usize = 256;

/// Wait after a scan source has failed.
const SOURCE_RETRY: Duration = Duration::from_secs(5);

/// What takes long and needs no hardware: measuring a scan, deciding on the parts so far. Called off the async
/// workers.
pub trait Craft: Send + Sync + 'static {
    /// One scan to a measured tube, or the operator's reason why not.
    fn measure(&self, scan: &ScanFile) -> Result<MeasuredTube, String>;

    /// The next step after these parts, oldest first.
    fn decide(&self, parts: &[Part]) -> Decision;
}

/// What the operator may tell a cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    /// Go to work, or go on after a hold.
    Arm,
    /// Stop.
    Disarm,
}

/// What a cell tells whoever listens.
#[derive(Debug, Clone)]
pub enum Notice {
    /// It is in another state.
    State(State),
    /// The next step was decided.
    Decided(Box<Decided>),
}

/// A decision with what it was taken on.
#[derive(Debug, Clone)]
pub struct Decided {
    /// The machine's table at the time.
    pub in_force: Option<InForce>,
    /// The part decided on; none for a first piece.
    pub measured: Option<MeasuredTube>,
    /// The step.
    pub decision: Decision,
}

/// Who a cell is.
#[derive(Debug, Clone)]
pub struct Identity {
    /// Name in logs and journal.
    pub name: String,
    /// The part's program at the machine.
    pub program: String,
    /// What it may do.
    pub mode: Mode,
    /// Longest times.
    pub dwell: Dwell,
}

/// One cell at work.
pub struct Driver<S, C> {
    identity: Identity,
    cell: Cell,
    source: S,
    craft: Arc<C>,
    journal: Journal,
    notices: broadcast::Sender<Notice>,
    asks: mpsc::Sender<Ask>,
    /// Ticket of the delivery that may be committed, as the machine's task sees it; 0: of none.
    wanted: Arc<AtomicU64>,
    /// For work that is handed out; its events come back through `results`.
    events: mpsc::Sender<Event>,
    results: mpsc::Receiver<Event>,
    started: Instant,
    /// Why a scan could not be filed, until the cell has heard of it.
    filing_error: Option<String>,
}

impl<S: ScanSource, C: Craft> Driver<S, C> {
    /// Starts the machine's task. The two journals are two connections to the same file. Must be called inside a
    /// tokio runtime.
    pub fn new<B: Bender + 'static>(
        identity: Identity,
        bender: B,
        source: S,
        craft: C,
        journals: [Journal; 2],
    ) -> Result<Driver<S, C>, JournalError> {
        let [journal, for_worker] = journals;
        let (asks, asked) = mpsc::channel(QUEUE);
        let (events, results) = mpsc::channel(QUEUE);
        let wanted = Arc::new(AtomicU64::new(0));
        let worker = Worker::new(bender, &identity.name, for_worker, Arc::clone(&wanted))?;
        tokio::spawn(worker.run(asked, events.clone()));
        Ok(Driver {
            cell: Cell::new(identity.mode, &identity.program, identity.dwell),
            identity,
            source,
            craft: Arc::new(craft),
            journal,
            notices: broadcast::channel(NOTICES).0,
            asks,
            wanted,
            events,
            results,
            started: Instant::now(),
            filing_error: None,
        })
    }

    /// What this cell will tell from now on.
    pub fn listen(&self) -> broadcast::Receiver<Notice> {
        self.notices.subscribe()
    }

    /// Runs until every sender of `commands` is gone; a delivery under way is brought to its end first.
    pub async fn run(mut self, mut commands: mpsc::Receiver<Command>) {
        let mut stopping = false;
        self.take(Event::Start).await;
        while !stopping || matches!(self.cell.state(), State::Delivering(_)) {
            // The next scan could be one that should have been filed: a person must look before it is taken.
            if let Some(reason) = self.filing_error.take_if(|_| self.cell.wants_scan()) {
                self.take(Event::FilingFailed(reason)).await;
            }
            let wake = self.cell.wake_at().map(|at| self.started + at);
            let event = tokio::select! {
                command = commands.recv(), if !stopping => match command {
                    Some(Command::Arm) => {
                        self.ask(Ask::Reset);
                        Event::Arm
                    }
                    Some(Command::Disarm) => Event::Disarm,
                    None => {
                        stopping = true;
                        Event::Disarm
                    }
                },
                Some(event) = self.results.recv() => event,
                scan = next_scan(&mut self.source), if self.cell.wants_scan() => Event::Scan(scan),
                () = sleep_until(wake), if wake.is_some() => Event::Tick,
            };
            self.take(event).await;
        }
    }

    /// One event to the cell, and what comes of it.
    async fn take(&mut self, event: Event) {
        self.put_on_record(&event);
        let before = self.cell.state().clone();
        let actions = self.cell.on(self.started.elapsed(), event);
        // Before anything else: what is disarmed must not be committed any more.
        self.wanted.store(self.cell.wants_commit().map_or(0, |ticket| ticket.0), Ordering::SeqCst);
        for action in actions {
            if let Err(error) = self.perform(action).await {
                self.filing_error = Some(format!("scans cannot be filed away: {error}"));
            }
        }
        // Only now: whoever hears "waiting for a scan" may bring one, and older ones are out of the way.
        self.tell_state(&before);
    }

    async fn perform(&mut self, action: Action) -> Result<(), ArmError> {
        match action {
            Action::ReadMachine(ticket) => self.ask(Ask::Read(ticket)),
            Action::Deliver(ticket, table, expected, operation) => {
                let program = self.identity.program.clone();
                let job = Job { program, table, expected_active: Some(expected), operation, approved: false };
                self.ask(Ask::Deliver(ticket, job));
            }
            Action::Measure(ticket, scan) => self.hand_out(move |craft| measured(craft, ticket, &scan)),
            Action::Decide(ticket) => {
                let parts = self.cell.history().to_vec();
                self.hand_out(move |craft| Event::Decided(ticket, Box::new(craft.decide(&parts))));
            }
            Action::FileDone(scan) => self.source.file(&scan, Filing::Done).await?,
            Action::FileFailed(scan, why) => self.source.file(&scan, Filing::Failed(&why)).await?,
            Action::SetAside(why) => {
                let count = self.source.set_aside(why).await?;
                if count > 0 {
                    tracing::warn!(cell = self.identity.name, count, "scans set aside: {why}");
                }
            }
        }
        Ok(())
    }

    /// A machine's task that takes nothing more is noticed by the longest dwell.
    fn ask(&self, ask: Ask) {
        if let Err(error) = self.asks.try_send(ask) {
            tracing::error!(cell = self.identity.name, %error, "the machine's task does not answer");
        }
    }

    fn hand_out(&self, work: impl FnOnce(&C) -> Event + Send + 'static) {
        let (craft, events) = (Arc::clone(&self.craft), self.events.clone());
        tokio::task::spawn_blocking(move || {
            // Nobody listens any more when the cell has stopped.
            let _ = events.blocking_send(work(&craft));
        });
    }

    fn tell_state(&mut self, before: &State) {
        let state = self.cell.state();
        if state == before {
            return;
        }
        let (cell, words) = (self.identity.name.as_str(), state.to_string());
        match state {
            State::Held(_) | State::Faulted(_) => tracing::warn!(cell, "{words}"),
            _ => tracing::info!(cell, "{words}"),
        }
        let mut content = json!({ "machine": cell, "state": words });
        if let State::Held(Hold { code: Some(code), .. }) = state {
            content["code"] = json!(code);
        }
        record(&mut self.journal, "state", &content);
        // Without a listener there is nobody to tell.
        let _ = self.notices.send(Notice::State(state.clone()));
    }

    /// Measurements and decisions go to the journal before anything follows from them.
    fn put_on_record(&mut self, event: &Event) {
        let cell = self.identity.name.as_str();
        match event {
            Event::Scan(scan) => {
                let content = json!({ "machine": cell, "file": scan.path, "bytes": scan.bytes });
                record(&mut self.journal, "scan", &content);
            }
            Event::Measured(ticket, measured) if self.cell.is_current(*ticket) => {
                let table = self.cell.in_force().map(|f| f.id);
                let content = json!({ "machine": cell, "bent_with": table, "measured": measured });
                record(&mut self.journal, "measurement", &content);
            }
            Event::MeasureFailed(ticket, why) if self.cell.is_current(*ticket) => {
                tracing::warn!(cell, "scan refused: {why}");
                record(&mut self.journal, "refusal", &json!({ "machine": cell, "why": why }));
            }
            Event::Decided(ticket, decision) if self.cell.is_current(*ticket) => {
                let content = json!({ "machine": cell, "answer": decision.answer });
                record(&mut self.journal, "decision", &content);
                tracing::info!(cell, verdict = ?decision.answer.verdict, "{}", decision.reasons());
                self.tell_decision(decision);
            }
            _ => {}
        }
    }

    fn tell_decision(&self, decision: &Decision) {
        let after_scan = matches!(self.cell.state(), State::Deciding(Some(_)));
        let part = self.cell.history().last().filter(|_| after_scan);
        let decided = Decided {
            in_force: part.map(|p| p.in_force.clone()).or(self.cell.in_force().cloned()),
            measured: part.map(|p| p.measured.clone()),
            decision: decision.clone(),
        };
        let _ = self.notices.send(Notice::Decided(Box::new(decided)));
    }
}

fn measured<C: Craft>(craft: &C, ticket: Ticket, scan: &ScanFile) -> Event {
    match craft.measure(scan) {
        Ok(tube) => Event::Measured(ticket, Box::new(tube)),
        Err(why) => Event::MeasureFailed(ticket, why),
    }
}

/// The next scan; a source that fails (a network share that is away) is asked again.
async fn next_scan<S: ScanSource>(source: &mut S) -> ScanFile {
    let mut told = String::new();
    loop {
        match source.next().await {
            Ok(scan) => return scan,
            Err(error) if error.to_string() != told => {
                told = error.to_string();
                tracing::error!("no scans: {told}; trying again every {} s", SOURCE_RETRY.as_secs());
            }
            Err(_) => {}
        }
        tokio::time::sleep(SOURCE_RETRY).await;
    }
}

async fn sleep_until(at: Option<Instant>) {
    if let Some(at) = at {
        tokio::time::sleep_until(at).await;
    }
}
