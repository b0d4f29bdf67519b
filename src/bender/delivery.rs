//! Delivering a table: stage, verify, commit, as a pure state machine.
//!
//! ```text
//! ReadStatus ► WriteStaging ► ReadStaging ► ReadStatus ► JournalIntent ► Commit ► ReadActive ► Finish
//!   gate         1 table        bit for bit   gate again   on disk         once     the truth
//! ```
//!
//! A correction begins with the table in force instead (`recall`): it must be the one that was committed last.
//!
//! One event in (with the time, in milliseconds of the driver's clock), one action out. Three things hold
//! whatever happens: a commit goes out at most once, never before an equal read-back and a journalled intent;
//! after the commit only reads decide; and what cannot be decided before the deadline is `Unknown`.

use serde::Serialize;

use super::limits::{Reason, check_limits};
use super::link::ActiveTable;
use super::profile::{Deadlines, Profile};
use super::recall::{Operation, objections};
use super::wire::{Ack, Staged, Status, TableId, crc_of, encode_payload, staging_image};
use crate::tube::CommandTable;

/// What is to be delivered.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    /// Name of the program that must be loaded.
    pub program: String,
    /// The table, in LRA's sense of rotation.
    pub table: CommandTable,
    /// The table that must be in force, where the caller knows: another one was made at the machine.
    pub expected_active: Option<TableId>,
    /// Whether it makes the rows or corrects what was committed last.
    pub operation: Operation,
    /// Whether the operator approved this write: a machine without a staging area takes none without.
    pub approved: bool,
}

/// A job that broke no limit, as bytes.
#[derive(Debug, Clone, PartialEq)]
pub struct Prepared {
    /// What was asked.
    pub job: Job,
    /// The table as the machine will hold it.
    pub payload: Vec<u8>,
    /// CRC of the payload.
    pub crc: u32,
}

/// What the journal must hold before a commit goes out.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Intent {
    /// Profile of the machine.
    pub bender: String,
    /// Program that the table is for.
    pub program: String,
    /// The table about to be committed.
    pub new: TableId,
    /// The table in force until then.
    pub old: TableId,
    /// Its rows, as asked for (the machine rounds them to its steps).
    pub table: CommandTable,
}

/// How a delivery ended.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case", tag = "outcome")]
pub enum Outcome {
    /// The machine's active table is the job's: read back, row for row.
    Applied(TableId),
    /// It was so before: nothing was sent.
    AlreadyActive(TableId),
    /// The gate or the machine said no; the active table is what it was.
    Rejected {
        /// Why, with figures.
        reasons: Vec<Reason>,
    },
    /// Something failed on the way; the active table is what it was.
    NotApplied {
        /// What failed.
        why: String,
    },
    /// A commit went out and reads could not decide what became of it.
    Unknown {
        /// What was seen last.
        why: String,
    },
}

/// What happened.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// `ReadStatus` answered.
    StatusRead(Status),
    /// `WriteStaging` answered.
    Written,
    /// `ReadStaging` answered with these bytes.
    ReadBack(Vec<u8>),
    /// The intent is on disk.
    IntentJournalled,
    /// The machine confirmed that it received the commit word.
    Committed,
    /// `ReadActive` answered.
    ActiveRead(ActiveTable),
    /// The action failed; a write may have been applied all the same.
    Failed(String),
    /// The wait is over.
    Timeout,
}

/// What is to be done next; exactly one event answers it.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    /// Read the status.
    ReadStatus,
    /// Write this to the staging area.
    WriteStaging(Staged),
    /// Read this many bytes of the staging area.
    ReadStaging {
        /// Bytes.
        bytes: usize,
    },
    /// Put this on disk.
    JournalIntent(Intent),
    /// Write the commit word, once.
    Commit(TableId),
    /// Read status and active table.
    ReadActive,
    /// Let time pass.
    Wait {
        /// Until then, in the time given with events.
        until_ms: u64,
    },
    /// Done.
    Finish(Outcome),
}

/// What is waited for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    /// The table that is to be corrected.
    Recalling,
    /// The first status.
    Asking,
    /// The staging area being written.
    Staging,
    /// The staging area's content.
    Comparing,
    /// The second status.
    Rechecking,
    /// The heartbeat's next beat.
    Listening,
    /// The intent on disk.
    Journalling,
    /// The machine's word that the commit arrived.
    Committing,
    /// The truth after the commit.
    Confirming,
    /// The next look after the commit.
    Pausing,
    /// Nothing.
    Done,
}

/// One delivery.
#[derive(Debug, Clone)]
pub struct Delivery {
    profile: Profile,
    job: Option<Prepared>,
    state: State,
    /// First look, and when.
    first: Option<(Status, u64)>,
    id: TableId,
    image: Vec<u8>,
    /// When the machine's state was read last before the commit, and what it had said to an earlier one by then.
    rechecked: (u64, u32, Ack),
    committed_ms: u64,
    /// The machine confirmed the commit's arrival: a refusal seen from then on may be about this commit.
    answered: bool,
    /// The machine was seen with this commit before it: its next refusal is about it.
    taken: bool,
    /// Why the commit was not confirmed.
    doubt: Option<String>,
    /// Since when the old table is in force with no commit pending.
    quiet_since_ms: Option<u64>,
    outcome: Option<Outcome>,
}

/// Checks a job against the machine's limits and writes it down in the machine's integers.
pub fn prepare(profile: &Profile, job: &Job) -> Result<Prepared, Vec<Reason>> {
    let mut reasons = check_limits(profile, &job.table);
    match encode_payload(profile, &job.program, &job.table) {
        Ok(payload) if reasons.is_empty() => {
            Ok(Prepared { job: job.clone(), crc: crc_of(&payload), payload })
        }
        Ok(_) => Err(reasons),
        Err(more) => {
            reasons.extend(more);
            Err(reasons)
        }
    }
}

/// Why this job may not go to a machine in this status; empty when it may.
pub fn gate(profile: &Profile, job: &Prepared, status: &Status) -> Vec<Reason> {
    let direct = profile.transport.direct().is_some();
    let mut reasons = if direct { Vec::new() } else { identity(job, status) };
    if direct && !job.job.approved {
        let text = "this machine has no staging area: what is written is in force at once, half of it too; the operator must see \
                    that nothing is bent and the right program is loaded, and approve the write";
        reasons.push(Reason::new("approval", None, text));
    }
    for bit in &profile.state_bits {
        let set = status.state >> bit.bit & 1 == 1;
        if set != bit.must_be {
            let (is, must) = if set { ("on", "off") } else { ("off", "on") };
            let text = format!(
                "state word 0x{:04X}: {:?} (bit {}) is {is}, must be {must}",
                status.state, bit.name, bit.bit
            );
            reasons.push(Reason::new("state", None, text));
        }
    }
    if status.pending.revision != 0 {
        let text = format!("the machine has not dealt with an earlier commit yet ({})", status.pending);
        reasons.push(Reason::new("commit_pending", None, text));
    }
    if let Some(expected) = job.job.expected_active
        && expected != status.active
    {
        let text = format!(
            "the machine's table was changed by somebody else: expected {expected}, found {}",
            status.active
        );
        reasons.push(Reason::new("table_changed", None, text));
    }
    if status.active.revision == u32::MAX {
        let text = format!("active revision {} is the last one; reset it at the machine", u32::MAX);
        reasons.push(Reason::new("revision", None, text));
    }
    reasons
}

fn identity(job: &Prepared, status: &Status) -> Vec<Reason> {
    let mut reasons = Vec::new();
    let program = job.job.program.trim_end_matches(' ');
    if status.program != program {
        let text =
            format!("the table is for program {program:?}, the machine has {:?} loaded", status.program);
        reasons.push(Reason::new("program", None, text));
    }
    let bends = job.job.table.bends.len();
    if usize::from(status.bend_count) != bends {
        let text = format!("the table's bend count is {bends}, the loaded program's {}", status.bend_count);
        reasons.push(Reason::new("bend_count", None, text));
    }
    reasons
}

impl Delivery {
    /// Starts with the limits; a job that breaks one ends here, nothing is read or written.
    pub fn start(profile: &Profile, job: &Job) -> (Delivery, Action) {
        let mut delivery = Delivery {
            profile: profile.clone(),
            job: None,
            state: State::Asking,
            first: None,
            id: TableId::default(),
            image: Vec::new(),
            rechecked: (0, 0, Ack::None),
            committed_ms: 0,
            answered: false,
            taken: false,
            doubt: None,
            quiet_since_ms: None,
            outcome: None,
        };
        let action = match prepare(profile, job) {
            Ok(prepared) => {
                let corrects = matches!(prepared.job.operation, Operation::Correct { .. });
                delivery.job = Some(prepared);
                if corrects { delivery.go(State::Recalling, Action::ReadActive) } else { Action::ReadStatus }
            }
            Err(reasons) => delivery.finish(Outcome::Rejected { reasons }),
        };
        (delivery, action)
    }

    /// The next action. An event that does not answer the last action counts as its failure.
    pub fn on(&mut self, event: Event, now_ms: u64) -> Action {
        match (self.state, event) {
            (State::Done, _) => self.finished(),
            (State::Recalling, Event::ActiveRead(active)) => self.recall(active, now_ms),
            (State::Asking, Event::StatusRead(status)) => self.stage(status, now_ms),
            (State::Staging, Event::Written) => {
                self.go(State::Comparing, Action::ReadStaging { bytes: self.image.len() })
            }
            (State::Comparing, Event::ReadBack(bytes)) => self.compare(&bytes),
            (State::Rechecking, Event::StatusRead(status)) => self.recheck(&status, now_ms),
            (State::Listening, Event::Timeout) => self.go(State::Rechecking, Action::ReadStatus),
            (State::Journalling, Event::IntentJournalled) => self.commit(now_ms),
            (State::Committing, Event::Committed) => {
                self.answered = true;
                self.go(State::Confirming, Action::ReadActive)
            }
            (State::Committing, event) => {
                self.doubt = Some(describe(event));
                self.go(State::Confirming, Action::ReadActive)
            }
            (State::Confirming, Event::ActiveRead(active)) => self.judge(&active, now_ms),
            (State::Confirming, event) => {
                self.quiet_since_ms = None;
                self.look_again(now_ms, describe(event))
            }
            (State::Pausing, _) => self.go(State::Confirming, Action::ReadActive),
            (_, event) => self.finish(Outcome::NotApplied { why: describe(event) }),
        }
    }

    /// Before a correction: the machine still holds what was committed, or already what is to be.
    fn recall(&mut self, active: ActiveTable, now_ms: u64) -> Action {
        let Some(Prepared { job, crc, .. }) = &self.job else { return self.finished() };
        if let Operation::Correct { last } = &job.operation
            && *crc != active.status.active.crc
        {
            let reasons = objections(&self.profile, &job.program, last, &job.table, &active);
            if !reasons.is_empty() {
                return self.finish(Outcome::Rejected { reasons });
            }
        }
        self.stage(active.status, now_ms)
    }

    /// Step 1: who is there; step 2: write the staging area.
    fn stage(&mut self, status: Status, now_ms: u64) -> Action {
        let Some(job) = &self.job else { return self.finished() };
        let direct = self.profile.transport.direct().is_some();
        let wrong = if direct { Vec::new() } else { identity(job, &status) };
        let nothing_to_come = status.pending.revision == 0; // else it would replace the table that is active
        if wrong.is_empty() && nothing_to_come && status.active.revision != 0 && status.active.crc == job.crc
        {
            return self.finish(Outcome::AlreadyActive(status.active));
        }
        let reasons = gate(&self.profile, job, &status);
        if !reasons.is_empty() {
            return self.finish(Outcome::Rejected { reasons });
        }
        // The gate keeps the sum from overflowing.
        let revision = status.active.revision.wrapping_add(u32::from(!direct)); // such a machine counts none
        self.id = TableId { revision, crc: job.crc };
        let staged = Staged { id: self.id, payload: job.payload.clone() };
        self.image = staging_image(&self.profile, &staged);
        self.first = Some((status, now_ms));
        self.go(State::Staging, Action::WriteStaging(staged))
    }

    /// Step 3: bit for bit.
    fn compare(&mut self, bytes: &[u8]) -> Action {
        if bytes == self.image {
            return self.go(State::Rechecking, Action::ReadStatus);
        }
        let at = bytes.iter().zip(&self.image).position(|(a, b)| a != b);
        let at = at.unwrap_or(bytes.len().min(self.image.len()));
        let place = self.profile.transport.staging_place(at);
        let hex = |side: &[u8]| {
            side.get(at & !1..(at | 1) + 1)
                .map_or("nothing".into(), |w| format!("0x{:02X}{:02X}", w[0], w[1]))
        };
        let text = format!(
            "the staging area does not read back as written: {place} holds {}, written was {}; \
             nothing was committed",
            hex(bytes),
            hex(&self.image)
        );
        self.finish(Outcome::Rejected { reasons: vec![Reason::new("read_back", None, text)] })
    }

    /// Still the same machine in the same state, and its program runs: staging took time. Then step 4.
    fn recheck(&mut self, status: &Status, now_ms: u64) -> Action {
        let (Some(job), Some((first, first_ms))) = (&self.job, &self.first) else { return self.finished() };
        let mut reasons = gate(&self.profile, job, status);
        if status.active != first.active {
            let text =
                format!("the active table changed from {} to {} meanwhile", first.active, status.active);
            reasons.push(Reason::new("table_changed", None, text));
        }
        if self.profile.transport.direct().is_none() && status.heartbeat == first.heartbeat {
            let waited = now_ms.saturating_sub(*first_ms);
            if reasons.is_empty() && waited < self.profile.deadlines.heartbeat_ms {
                let until_ms = now_ms + self.profile.deadlines.poll_ms;
                return self.go(State::Listening, Action::Wait { until_ms });
            }
            let text = format!(
                "the heartbeat stands still at {} for {waited} ms: the controller's program does not run",
                status.heartbeat
            );
            reasons.push(Reason::new("heartbeat", None, text));
        }
        if !reasons.is_empty() {
            return self.finish(Outcome::Rejected { reasons });
        }
        self.rechecked = (now_ms, status.ack_revision, status.ack);
        let intent = Intent {
            bender: self.profile.name.clone(),
            program: job.job.program.clone(),
            new: self.id,
            old: first.active,
            table: job.job.table.clone(),
        };
        self.go(State::Journalling, Action::JournalIntent(intent))
    }

    /// Step 4: the one commit, if what it rests on was seen a moment ago: a disk can be slow.
    fn commit(&mut self, now_ms: u64) -> Action {
        let (age_ms, allowed_ms) =
            (now_ms.saturating_sub(self.rechecked.0), self.profile.deadlines.heartbeat_ms);
        if age_ms > allowed_ms {
            let why = format!(
                "the journal took {age_ms} ms, and the machine's state may be trusted for {allowed_ms} ms (heartbeat_ms) only; \
                 nothing was committed: look at the disk that the journal is on, then deliver again"
            );
            return self.finish(Outcome::NotApplied { why });
        }
        self.committed_ms = now_ms;
        self.go(State::Committing, Action::Commit(self.id))
    }

    /// Step 5: the active table, not the acknowledgement, is the truth.
    fn judge(&mut self, active: &ActiveTable, now_ms: u64) -> Action {
        let (Some(job), Some((first, _))) = (&self.job, &self.first) else { return self.finished() };
        let status = &active.status;
        if status.active == self.id {
            if active.payload == job.payload {
                return self.finish(Outcome::Applied(self.id));
            }
            self.quiet_since_ms = None;
            return self.look_again(now_ms, format!("the machine names {} but holds other rows", self.id));
        }
        if status.active != first.active {
            self.quiet_since_ms = None;
            let why = format!("the active table is neither the old nor the new one but {}", status.active);
            return self.look_again(now_ms, why);
        }
        if status.pending.revision != 0 {
            self.taken |= status.pending == self.id;
            self.quiet_since_ms = None;
            return self.look_again(now_ms, "the machine has not dealt with the commit yet".into());
        }
        // The same as before the commit may be the answer to an earlier one of the same revision.
        let is_new = self.taken || (status.ack_revision, status.ack) != (self.rechecked.1, self.rechecked.2);
        if let Ack::Refused(code) = status.ack
            && self.answered
            && is_new
            && status.ack_revision == self.id.revision
        {
            let text = format!("the machine refused {}: {} (code {code})", self.id, Ack::meaning(code));
            return self.finish(Outcome::Rejected { reasons: vec![Reason::new("machine", None, text)] });
        }
        let since = *self.quiet_since_ms.get_or_insert(now_ms);
        if now_ms.saturating_sub(since) >= self.profile.deadlines.settle_ms {
            let said = self.said(status);
            let why =
                format!("the commit did not take effect: the active table is still {}{said}", status.active);
            return self.finish(Outcome::NotApplied { why });
        }
        self.look_again(now_ms, format!("the active table is still {}", status.active))
    }

    /// Why the commit was not confirmed, where it was not.
    fn doubted(&self) -> String {
        self.doubt.as_ref().map_or(String::new(), |doubt| format!("; when it was sent: {doubt}"))
    }

    /// What else is known of a commit that did nothing.
    fn said(&self, status: &Status) -> String {
        let mut out = self.doubted();
        if let Ack::Refused(code) = status.ack
            && status.ack_revision == self.id.revision
        {
            out += &format!("; the machine's last word is a refusal: {} (code {code})", Ack::meaning(code));
        }
        out
    }

    fn look_again(&mut self, now_ms: u64, why: String) -> Action {
        let Deadlines { confirm_ms, poll_ms, .. } = self.profile.deadlines;
        if now_ms.saturating_sub(self.committed_ms) >= confirm_ms {
            let why = format!(
                "{} was committed, and {confirm_ms} ms later it is not known whether it is active: {why}{}",
                self.id,
                self.doubted()
            );
            return self.finish(Outcome::Unknown { why });
        }
        self.go(State::Pausing, Action::Wait { until_ms: now_ms + poll_ms })
    }

    fn go(&mut self, state: State, action: Action) -> Action {
        self.state = state;
        action
    }

    fn finish(&mut self, outcome: Outcome) -> Action {
        self.state = State::Done;
        self.outcome = Some(outcome);
        self.finished()
    }

    fn finished(&self) -> Action {
        let none = || Outcome::NotApplied { why: "nothing was started".into() };
        Action::Finish(self.outcome.clone().unwrap_or_else(none))
    }
}

fn describe(event: Event) -> String {
    match event {
        Event::Failed(why) => why,
        Event::Timeout => "no answer in time".into(),
        Event::StatusRead(_) => "a status came that was not asked for".into(),
        Event::Written => "a write was confirmed that was not made".into(),
        Event::ReadBack(_) => "a read-back came that was not asked for".into(),
        Event::IntentJournalled => "an intent was confirmed that was not journalled".into(),
        Event::Committed => "a commit was confirmed that was not made".into(),
        Event::ActiveRead(_) => "an active table came that was not asked for".into(),
    }
}

#[cfg(test)]
#[path = "delivery_tests.rs"]
mod tests;
