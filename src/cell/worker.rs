//! The machine's side of a cell's driver: one task that owns the link and does one thing at a time.
//!
//! Reads and deliveries are asked for over a channel and answered as events, so that the cell can be disarmed, or
//! give up waiting, while the machine is slow. It also settles deliveries that were cut short: an intent in the
//! journal without a definite outcome is closed by what the machine holds at the next contact.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use serde_json::json;
use tokio::sync::mpsc;

use super::event::{Delivered, Event, InForce, Ticket};
use super::intents::JournalledIntents;
use super::journalling::record;
use crate::bender::{
    Bender, Intent, IntentLog, Job, LogError, Outcome, Reason, TableId, decode_payload, deliver,
};
use crate::journal::{Journal, JournalError};

/// What the machine's task is asked for.
#[derive(Debug)]
pub enum Ask {
    /// The active table.
    Read(Ticket),
    /// A delivery.
    Deliver(Ticket, Job),
    /// Somebody has looked after the machine.
    Reset,
}

/// The task's belongings.
pub struct Worker<B> {
    bender: B,
    /// The cell's name, under which the journal knows this machine.
    name: String,
    journal: Journal,
    /// Ticket of the delivery that the cell still wants to be committed; 0: of none.
    wanted: Arc<AtomicU64>,
    /// A commit that may have gone out and whose end nobody has seen.
    open: Option<TableId>,
}

/// Remembers which table was about to be committed.
struct Committing<'a> {
    log: JournalledIntents<'a>,
    id: Option<TableId>,
    ticket: Ticket,
    wanted: &'a AtomicU64,
}

impl IntentLog for Committing<'_> {
    fn intent(&mut self, intent: &Intent) -> Result<(), LogError> {
        self.log.intent(intent)?;
        self.id = Some(intent.new);
        Ok(())
    }

    fn still_wanted(&self) -> Result<(), String> {
        if self.wanted.load(Ordering::SeqCst) == self.ticket.0 {
            return Ok(());
        }
        Err("the cell was disarmed, or had waited for too long, before the commit: nothing was committed"
            .to_owned())
    }

    fn outcome(&mut self, job: &Job, intent: Option<&Intent>, outcome: &Outcome) -> Result<(), LogError> {
        self.log.outcome(job, intent, outcome)
    }
}

impl<B: Bender> Worker<B> {
    /// Looks into the journal for a delivery of an earlier run that has no end.
    pub fn new(
        bender: B,
        name: &str,
        journal: Journal,
        wanted: Arc<AtomicU64>,
    ) -> Result<Worker<B>, JournalError> {
        let open = open_intent(&journal, name)?;
        Ok(Worker { bender, name: name.to_owned(), journal, wanted, open })
    }

    /// Answers until nobody asks any more.
    pub async fn run(mut self, mut asks: mpsc::Receiver<Ask>, events: mpsc::Sender<Event>) {
        while let Some(ask) = asks.recv().await {
            let event = match ask {
                Ask::Read(ticket) => self.read(ticket).await,
                Ask::Deliver(ticket, job) => Event::Delivered(ticket, self.deliver(ticket, &job).await),
                Ask::Reset => {
                    self.bender.reset();
                    continue;
                }
            };
            if events.send(event).await.is_err() {
                return;
            }
        }
    }

    async fn read(&mut self, ticket: Ticket) -> Event {
        let active = match self.bender.read_active().await {
            Ok(active) => active,
            Err(error) => return Event::MachineLost(ticket, error.to_string()),
        };
        let id = active.status.active;
        let table = match id.revision {
            0 => Default::default(),
            _ => match decode_payload(self.bender.profile(), &active.payload) {
                Ok((_, table)) => table,
                Err(why) => {
                    return Event::MachineLost(ticket, format!("its active table is unreadable: {why}"));
                }
            },
        };
        self.settle(id, active.status.pending);
        Event::MachineRead(ticket, InForce { id, program: active.status.program, table })
    }

    /// The machine's word on a delivery that was cut short, once it has dealt with it.
    fn settle(&mut self, found: TableId, pending: TableId) {
        let Some(intended) = self.open.take_if(|intended| *intended != pending) else { return };
        let applied = found == intended;
        tracing::warn!(cell = self.name, %intended, %found, applied, "an unfinished delivery is resolved");
        let content =
            json!({ "machine": self.name, "intended": intended, "found": found, "applied": applied });
        record(&mut self.journal, "resolution", &content);
    }

    async fn deliver(&mut self, ticket: Ticket, job: &Job) -> Delivered {
        let log = JournalledIntents::new(&mut self.journal, self.name.as_str());
        let mut log = Committing { log, id: None, ticket, wanted: &self.wanted };
        let outcome = deliver(&mut self.bender, job, &mut log).await;
        let committed = log.id;
        match outcome {
            Outcome::Applied(id) | Outcome::AlreadyActive(id) => Delivered::Applied(id),
            Outcome::Rejected { reasons } => Delivered::Rejected(words(&reasons)),
            Outcome::NotApplied { why } => Delivered::NotApplied(why),
            Outcome::Unknown { why } => {
                self.open = committed;
                Delivered::Unknown(why, committed)
            }
        }
    }
}

fn words(reasons: &[Reason]) -> String {
    reasons.iter().map(|r| r.text.as_str()).collect::<Vec<_>>().join("; ")
}

/// The last intent of this machine, if no definite outcome or resolution followed it.
fn open_intent(journal: &Journal, name: &str) -> Result<Option<TableId>, JournalError> {
    let (mut seq, mut open) = (0, None);
    loop {
        let records = journal.list(seq, 1000)?;
        let Some(last) = records.last() else { return Ok(open) };
        seq = last.seq;
        for record in &records {
            if !matches!(record.kind.as_str(), "intent" | "outcome" | "resolution") {
                continue;
            }
            let content: serde_json::Value = serde_json::from_str(&record.content).unwrap_or_default();
            if content["machine"] != name {
                continue;
            }
            match record.kind.as_str() {
                "intent" => open = table_id(&content["intent"]["new"]),
                "outcome" if content["result"]["outcome"] == "unknown" => {}
                _ => open = None,
            }
        }
    }
}

fn table_id(value: &serde_json::Value) -> Option<TableId> {
    let number = |key: &str| value[key].as_u64().and_then(|n| u32::try_from(n).ok());
    Some(TableId { revision: number("revision")?, crc: number("crc")? })
}
