//! Deliveries in the journal: an `intent` before each commit, an `outcome` after each delivery, and `resolved`
//! when a later look at the machine decides what an outcome left open.
//!
//! `bender` says what must be kept, `journal` keeps it; this is where the two meet.

use std::time::{SystemTime, UNIX_EPOCH};

use serde_json::{Value, json};

use crate::bender::{Intent, IntentLog, Job, LogError, Outcome, TableId};
use crate::journal::{Journal, JournalError, Record};
use crate::tube::CommandTable;

/// A journal in the shape that a delivery wants.
#[derive(Debug)]
pub struct JournalledIntents<'a> {
    journal: &'a mut Journal,
    machine: String,
    /// Record of the last outcome, once it is on disk.
    pub recorded: Option<Record>,
}

impl<'a> JournalledIntents<'a> {
    /// Intents of the machine at this endpoint go to this journal.
    pub fn new(journal: &'a mut Journal, machine: impl Into<String>) -> JournalledIntents<'a> {
        JournalledIntents { journal, machine: machine.into(), recorded: None }
    }

    /// Decides an earlier commit whose outcome is open (it was unknown, or the program died before writing it
    /// down) by the table that the machine holds now, and records that. None when nothing is open, or while the machine has not dealt
    /// with it.
    pub fn resolve(&mut self, active: TableId, pending: TableId) -> Result<Option<Outcome>, JournalError> {
        let Some((new, old)) = self.open_intent()? else { return Ok(None) };
        if pending == new {
            return Ok(None);
        }
        let outcome = if active == new {
            Outcome::Applied(new)
        } else if active == old {
            Outcome::NotApplied { why: format!("{new} did not take effect, the machine holds {active}") }
        } else {
            Outcome::Unknown {
                why: format!("{new} was committed over {old}, the machine now holds {active}"),
            }
        };
        let content = json!({ "machine": self.machine, "committed": new, "result": outcome });
        self.append("resolved", content)?;
        Ok(Some(outcome))
    }

    /// New and old table of the last intent, if nothing decided it since.
    fn open_intent(&self) -> Result<Option<(TableId, TableId)>, JournalError> {
        let mut open = None;
        self.each_record(|kind, content| match kind {
            "intent" => open = Some((id_of(&content["intent"]["new"]), id_of(&content["intent"]["old"]))),
            "outcome" if content["result"]["outcome"] != "unknown" => open = None,
            "resolved" => open = None,
            _ => {}
        })?;
        Ok(open)
    }

    /// The rows of the table that was put in force last for this program; none where there never was one.
    pub fn last_applied(&self, program: &str) -> Result<Option<CommandTable>, JournalError> {
        let (mut intent, mut applied) = (Value::Null, Value::Null);
        self.each_record(|kind, content| match kind {
            "intent" => intent = content["intent"].clone(),
            "outcome" | "resolved"
                if content["result"]["outcome"] == "applied" && content["committed"] == intent["new"] =>
            {
                applied = intent.clone();
            }
            _ => {}
        })?;
        let is_meant = applied["program"] == program;
        Ok(is_meant.then(|| serde_json::from_value(applied["table"].clone()).ok()).flatten())
    }

    /// This machine's records, in order.
    fn each_record(&self, mut act: impl FnMut(&str, &Value)) -> Result<(), JournalError> {
        let mut after = 0;
        loop {
            let records = self.journal.list(after, 1000)?;
            let Some(last) = records.last() else { return Ok(()) };
            after = last.seq;
            for record in records {
                match serde_json::from_str::<Value>(&record.content) {
                    Ok(content) if content["machine"] == self.machine.as_str() => act(&record.kind, &content),
                    _ => {}
                }
            }
        }
    }

    fn append(&mut self, kind: &str, content: Value) -> Result<Record, JournalError> {
        // A clock before 1970 is wrong in any case; the order of records does not depend on it.
        let time_ms = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_millis());
        self.journal.append(i64::try_from(time_ms).unwrap_or(i64::MAX), kind, &content.to_string())
    }
}

impl IntentLog for JournalledIntents<'_> {
    fn intent(&mut self, intent: &Intent) -> Result<(), LogError> {
        let content = json!({ "machine": self.machine, "intent": intent });
        self.append("intent", content)?;
        Ok(())
    }

    fn outcome(&mut self, job: &Job, intent: Option<&Intent>, outcome: &Outcome) -> Result<(), LogError> {
        let content = json!({
            "machine": self.machine,
            "program": job.program,
            "committed": intent.map(|i| i.new),
            "result": outcome,
        });
        self.recorded = Some(self.append("outcome", content)?);
        Ok(())
    }
}

/// What is missing or damaged reads as no table, which matches none.
fn id_of(value: &Value) -> TableId {
    let number = |key: &str| value[key].as_u64().and_then(|n| u32::try_from(n).ok()).unwrap_or(0);
    TableId { revision: number("revision"), crc: number("crc") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bender::Operation;

    const OLD: TableId = TableId { revision: 7, crc: 1 };
    const NEW: TableId = TableId { revision: 8, crc: 2 };
    const NONE: TableId = TableId { revision: 0, crc: 0 };

    fn intent() -> Intent {
        Intent {
            bender: "b".into(),
            program: "P1".into(),
            new: NEW,
            old: OLD,
            table: CommandTable::default(),
        }
    }

    fn job() -> Job {
        Job {
            program: "P1".into(),
            table: CommandTable::default(),
            expected_active: None,
            operation: Operation::New,
            approved: false,
        }
    }

    fn with_log(test: impl FnOnce(&mut JournalledIntents)) {
        let dir = tempfile::tempdir().unwrap();
        let mut journal = Journal::open(&dir.path().join("j.db")).unwrap();
        test(&mut JournalledIntents::new(&mut journal, "m:1"));
    }

    #[test]
    fn an_intent_without_an_outcome_is_decided_by_the_machine_once() {
        for (found, expected) in
            [(NEW, "applied"), (OLD, "not_applied"), (TableId { revision: 9, crc: 3 }, "unknown")]
        {
            with_log(|log| {
                assert_eq!(log.resolve(found, NONE).unwrap(), None, "nothing is open at first");
                log.intent(&intent()).unwrap();
                let outcome = serde_json::to_value(log.resolve(found, NONE).unwrap()).unwrap();
                assert_eq!(outcome["outcome"], expected);
                assert_eq!(log.resolve(found, NONE).unwrap(), None, "decided once");
            });
        }
    }

    #[test]
    fn a_commit_that_the_machine_has_not_dealt_with_stays_open() {
        with_log(|log| {
            log.intent(&intent()).unwrap();
            assert_eq!(log.resolve(OLD, NEW).unwrap(), None);
            assert_eq!(log.resolve(NEW, NONE).unwrap(), Some(Outcome::Applied(NEW)), "not before");
        });
    }

    #[test]
    fn a_known_outcome_closes_the_intent_and_an_unknown_one_does_not() {
        with_log(|log| {
            log.intent(&intent()).unwrap();
            log.outcome(&job(), Some(&intent()), &Outcome::Applied(NEW)).unwrap();
            assert_eq!(log.resolve(OLD, NONE).unwrap(), None);
            log.intent(&intent()).unwrap();
            log.outcome(&job(), Some(&intent()), &Outcome::Unknown { why: "w".into() }).unwrap();
            assert_eq!(log.resolve(NEW, NONE).unwrap(), Some(Outcome::Applied(NEW)));
        });
    }

    #[test]
    fn what_was_put_in_force_last_is_found_also_when_only_a_later_look_said_so() {
        with_log(|log| {
            assert_eq!(log.last_applied("P1").unwrap(), None);
            let of = |last_length_mm| Intent {
                table: CommandTable { last_length_mm, ..CommandTable::default() },
                ..intent()
            };
            log.intent(&of(1.0)).unwrap();
            assert_eq!(log.last_applied("P1").unwrap(), None, "nobody knows yet");
            log.outcome(&job(), Some(&of(1.0)), &Outcome::Applied(NEW)).unwrap();
            let found = |log: &JournalledIntents| log.last_applied("P1").unwrap().unwrap().last_length_mm;
            assert_eq!(found(log), 1.0);
            log.intent(&of(2.0)).unwrap();
            log.outcome(&job(), Some(&of(2.0)), &Outcome::NotApplied { why: "w".into() }).unwrap();
            assert_eq!(found(log), 1.0);
            log.intent(&of(3.0)).unwrap();
            log.resolve(NEW, NONE).unwrap();
            assert_eq!(found(log), 3.0);
            assert_eq!(log.last_applied("P2").unwrap(), None, "another program's");
        });
    }

    #[test]
    fn another_machine_is_another_matter() {
        let dir = tempfile::tempdir().unwrap();
        let mut journal = Journal::open(&dir.path().join("j.db")).unwrap();
        JournalledIntents::new(&mut journal, "m:1").intent(&intent()).unwrap();
        assert_eq!(JournalledIntents::new(&mut journal, "m:2").resolve(NEW, NONE).unwrap(), None);
    }
}
