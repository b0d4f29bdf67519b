//! Deliveries in the journal: an `intent` before each commit, an `outcome` after each delivery.
//!
//! `bender` says what must be kept, `journal` keeps it; this is where the two meet.

use std::time::{SystemTime, UNIX_EPOCH};

use serde_json::json;

use crate::bender::{Intent, IntentLog, Job, LogError, Outcome};
use crate::journal::{Journal, JournalError, Record};

/// A journal in the shape that a delivery wants.
#[derive(Debug)]
pub struct JournalledIntents<'a> {
    journal: &'a mut Journal,
    bender: String,
    /// Record of the outcome, once it is on disk.
    pub recorded: Option<Record>,
}

impl<'a> JournalledIntents<'a> {
    /// Intents of the machine named `bender` go to this journal.
    pub fn new(journal: &'a mut Journal, bender: impl Into<String>) -> JournalledIntents<'a> {
        JournalledIntents { journal, bender: bender.into(), recorded: None }
    }

    fn append(&mut self, kind: &str, content: serde_json::Value) -> Result<Record, JournalError> {
        // A clock before 1970 is wrong in any case; the order of records does not depend on it.
        let time_ms = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_millis());
        self.journal.append(i64::try_from(time_ms).unwrap_or(i64::MAX), kind, &content.to_string())
    }
}

impl IntentLog for JournalledIntents<'_> {
    fn intent(&mut self, intent: &Intent) -> Result<(), LogError> {
        let content = json!({ "machine": self.bender, "intent": intent });
        self.append("intent", content)?;
        Ok(())
    }

    fn outcome(&mut self, job: &Job, intent: Option<&Intent>, outcome: &Outcome) -> Result<(), LogError> {
        let content = json!({
            "machine": self.bender,
            "program": job.program,
            "committed": intent.map(|i| i.new),
            "result": outcome,
        });
        self.recorded = Some(self.append("outcome", content)?);
        Ok(())
    }
}
