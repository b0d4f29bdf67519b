//! The loop of one bending cell as a pure state machine: events and time in, actions out.
//!
//! Every transition is a named method; [`Cell::on`] only says which event leads to which. What is safe about
//! it: a table is delivered from `Deciding`, or with a person's approval when the cell is armed, in both cases after the
//! machine was just read, and a cell comes up, and comes back from every fault, disarmed. All transitions at a glance are in the
//! snapshot beside `tests/cell.rs`.

use std::time::Duration;

use super::event::{Action, Decision, Delivered, Dwell, Event, InForce, Ticket};
use super::state::{Fault, Hold, Purpose, State};
use crate::arm::ScanFile;
use crate::bender::{Operation, TableId};
use crate::config::Mode;
use crate::correct::{Answer, Changed, Code, Verdict};
use crate::tube::{CommandTable, MeasuredTube};

/// Scans in a row that could not be used before a person must look.
const MAX_UNUSABLE: u32 = 3;

/// Parts remembered; older ones have no say in the next table.
const MAX_HISTORY: usize = 200;

/// What is approved by arming after a hold.
#[derive(Debug, Clone, PartialEq)]
enum Approval {
    /// The tube measured last is good.
    Tube,
    /// This earlier table is gone back to.
    RollBack(CommandTable),
}

/// One part that was bent and measured.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// The table it was bent with.
    pub in_force: InForce,
    /// What came of it.
    pub measured: MeasuredTube,
    /// Whether this is another scan of the tube before.
    pub rescan: bool,
    /// What was changed before it.
    pub changed: Option<Changed>,
    /// Whether somebody has approved it.
    pub approved: bool,
}

/// One bending cell.
#[derive(Debug)]
pub struct Cell {
    mode: Mode,
    /// Name of the part, and of its program at the machine.
    program: String,
    dwell: Dwell,
    state: State,
    now: Duration,
    /// When the state was entered.
    since: Duration,
    ticket: Ticket,
    /// The operator disarmed while a delivery was under way.
    disarm_after: bool,
    /// The machine's table when it was last read.
    in_force: Option<InForce>,
    /// What this cell delivered last.
    ours: Option<TableId>,
    history: Vec<Part>,
    /// The last tube is to be scanned again.
    rescan: bool,
    /// What arming approves.
    approval: Option<Approval>,
    /// What was changed since the last tube.
    changed: Option<Changed>,
    /// Scans in a row that could not be used.
    unusable: u32,
    /// Attempts to reach the machine in a row that failed.
    attempts: u32,
}

impl Cell {
    /// A cell that has not started; `program` is the part's name at the machine.
    pub fn new(mode: Mode, program: &str, dwell: Dwell) -> Cell {
        Cell {
            mode,
            program: program.to_owned(),
            dwell,
            state: State::Disarmed,
            now: Duration::ZERO,
            since: Duration::ZERO,
            ticket: Ticket(0),
            disarm_after: false,
            in_force: None,
            ours: None,
            history: Vec::new(),
            rescan: false,
            approval: None,
            changed: None,
            unusable: 0,
            attempts: 0,
        }
    }

    /// Where the cell is.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Parts bent and measured since the cell was armed afresh, oldest first.
    pub fn history(&self) -> &[Part] {
        &self.history
    }

    /// The table that the machine held when it was last read.
    pub fn in_force(&self) -> Option<&InForce> {
        self.in_force.as_ref()
    }

    /// Whether a scan would be taken now.
    pub fn wants_scan(&self) -> bool {
        matches!(self.state, State::Ready | State::InTolerance)
    }

    /// Whether the work that carries this ticket is still waited for.
    pub fn is_current(&self, ticket: Ticket) -> bool {
        self.ticket == ticket
    }

    /// The delivery that may still be committed; none once it was disarmed or given up.
    pub fn wants_commit(&self) -> Option<Ticket> {
        (matches!(self.state, State::Delivering(_)) && !self.disarm_after).then_some(self.ticket)
    }

    /// When a [`Event::Tick`] is due: the end of the state's longest dwell, or the next attempt after a fault.
    pub fn wake_at(&self) -> Option<Duration> {
        let dwell = match &self.state {
            State::Reading(_) => self.dwell.reading,
            State::Measuring(_) => self.dwell.measuring,
            State::Deciding(_) => self.dwell.deciding,
            State::Delivering(_) => self.dwell.delivering,
            State::Faulted(_) => self
                .dwell
                .retry
                .saturating_mul(1 << self.attempts.saturating_sub(1).min(16))
                .min(self.dwell.retry_cap),
            State::Disarmed | State::Ready | State::InTolerance | State::Held(_) => return None,
        };
        Some(self.since + dwell)
    }

    /// Takes one event at `now` (a clock that does not go back) and returns what is to be done, in order.
    /// An event that has no meaning in this state changes nothing.
    pub fn on(&mut self, now: Duration, event: Event) -> Vec<Action> {
        self.now = now;
        match (self.state.clone(), event) {
            (State::Disarmed, Event::Start) => self.read(Purpose::Contact),
            (State::Disarmed | State::Held(_) | State::Reading(Purpose::Contact), Event::Arm) => self.arm(),
            (_, Event::Disarm) => self.disarm(),
            (state, Event::Tick) if self.wake_at().is_some_and(|at| at <= now) => self.overdue(state),
            (State::Ready | State::InTolerance, Event::Scan(scan)) => self.read(Purpose::Recall(scan)),
            (State::Ready | State::InTolerance, Event::FilingFailed(reason)) => self.hold(None, reason),
            (State::Reading(why), Event::MachineRead(t, read)) if t == self.ticket => {
                self.machine_read(why, read)
            }
            (State::Reading(why), Event::MachineLost(t, reason)) if t == self.ticket => {
                self.lost(why, reason)
            }
            (State::Measuring(scan), Event::Measured(t, tube)) if t == self.ticket => {
                self.measured(scan, *tube)
            }
            (State::Measuring(scan), Event::MeasureFailed(t, reason)) if t == self.ticket => {
                self.unusable(scan, reason)
            }
            (State::Deciding(scan), Event::Decided(t, decision)) if t == self.ticket => {
                self.decided(scan, *decision)
            }
            (State::Delivering(table), Event::Delivered(t, outcome)) if t == self.ticket => {
                self.delivered(table, outcome)
            }
            _ => Vec::new(),
        }
    }

    fn enter(&mut self, state: State) {
        // Only who arms out of the hold itself has read what is approved so.
        if matches!(state, State::Disarmed | State::Faulted(_)) {
            self.approval = None;
        }
        self.state = state;
        self.since = self.now;
    }

    fn next_ticket(&mut self) -> Ticket {
        self.ticket.0 += 1;
        self.ticket
    }

    fn read(&mut self, why: Purpose) -> Vec<Action> {
        self.enter(State::Reading(why));
        vec![Action::ReadMachine(self.next_ticket())]
    }

    /// Arming reads the machine first. Observing writes nothing: there a hold is left the same way.
    fn arm(&mut self) -> Vec<Action> {
        self.read(if self.mode == Mode::Observe { Purpose::Contact } else { Purpose::Arming })
    }

    /// A delivery under way is not committed any more, if it is not yet; its end is waited for, then the cell is disarmed.
    fn disarm(&mut self) -> Vec<Action> {
        let then = match &self.state {
            State::Faulted(fault) => Some(&fault.then),
            State::Reading(why) => Some(why),
            _ => None,
        };
        match (&self.state, then) {
            (State::Delivering(_), _) => self.disarm_after = true,
            // Ends disarmed by itself, and must not forget what it is to find out.
            (_, Some(Purpose::Resolve(_))) => {}
            _ => {
                self.next_ticket();
                self.enter(State::Disarmed);
            }
        }
        Vec::new()
    }

    fn machine_read(&mut self, why: Purpose, read: InForce) -> Vec<Action> {
        self.attempts = 0;
        let found = read.id;
        let ours = self.ours == Some(found);
        let other_program = (read.program != self.program).then(|| {
            format!(
                "the machine has program {:?} loaded, this cell's part is {:?}",
                read.program, self.program
            )
        });
        let before = self.in_force.replace(read);
        match (why, other_program) {
            (Purpose::Contact, _) => self.contacted(),
            (Purpose::Resolve(intent), _) => self.resolved(intent, found),
            (Purpose::Arming, Some(reason)) => {
                self.approval = None;
                self.hold(Some(Code::Program), reason)
            }
            (Purpose::Recall(scan), Some(reason)) => self.scan_of_other_program(scan, reason),
            (Purpose::Arming, None) if ours => self.approved(),
            (Purpose::Arming, None) => self.begin_job(),
            (Purpose::Recall(scan), None) if ours || self.mode == Mode::Observe => self.measure(scan),
            (Purpose::Recall(scan), None) => self.changed_at_machine(scan, found, before),
        }
    }

    fn contacted(&mut self) -> Vec<Action> {
        if self.mode == Mode::Observe {
            return self.wait();
        }
        self.enter(State::Disarmed);
        Vec::new()
    }

    /// The machine's word on a delivery that was cut short: it holds the table or it does not. Either way the cell
    /// comes back disarmed.
    fn resolved(&mut self, intent: Option<TableId>, found: TableId) -> Vec<Action> {
        if intent == Some(found) {
            self.ours = intent;
        }
        self.contacted()
    }

    /// A table is in force and the next scan is waited for. What lies in the folder was bent before.
    fn wait(&mut self) -> Vec<Action> {
        self.enter(State::Ready);
        vec![Action::SetAside("the tube was bent before the table now in force, or nobody can say by which")]
    }

    /// The job goes on as it was, or with what arming has approved.
    fn approved(&mut self) -> Vec<Action> {
        match self.approval.take() {
            Some(Approval::RollBack(table)) => {
                self.changed = Some(Changed::RollBack);
                return self.deliver(table);
            }
            Some(Approval::Tube) => {
                self.history.iter_mut().rev().take(1).for_each(|part| part.approved = true)
            }
            None => {}
        }
        self.decide(None)
    }

    /// Over a table that is not this cell's. Where there was one of its own, somebody has changed it.
    fn begin_job(&mut self) -> Vec<Action> {
        self.history.clear();
        self.approval = None;
        self.changed = self.ours.map(|_| Changed::Table);
        self.rescan = false;
        self.unusable = 0;
        self.decide(None)
    }

    fn decide(&mut self, scan: Option<ScanFile>) -> Vec<Action> {
        self.enter(State::Deciding(scan));
        vec![Action::Decide(self.next_ticket())]
    }

    fn measure(&mut self, scan: ScanFile) -> Vec<Action> {
        self.enter(State::Measuring(scan.clone()));
        vec![Action::Measure(self.next_ticket(), scan)]
    }

    fn changed_at_machine(&mut self, scan: ScanFile, found: TableId, before: Option<InForce>) -> Vec<Action> {
        let expected = self.ours.map_or_else(|| "none".to_owned(), |r| r.to_string());
        let held = self.in_force.as_ref().zip(before).map(|(now, before)| {
            // Read back, a table is in the machine's steps; the ids say already that it is another one.
            before
                .table
                .differences(&now.table, (0.0, 0.0))
                .iter()
                .map(|d| format!("; {d}"))
                .collect::<String>()
        });
        let reason = format!(
            "the machine's table is not the one that was delivered (expected {expected}, found {found}{}): somebody \
             changed it there; arming again begins the job afresh",
            held.unwrap_or_default()
        );
        drop(self.hold(Some(Code::TableEdited), reason.clone()));
        vec![Action::FileFailed(scan, reason)]
    }

    /// Observing waits for the program to come back; a cell that writes stops for a person.
    fn scan_of_other_program(&mut self, scan: ScanFile, reason: String) -> Vec<Action> {
        match self.mode {
            Mode::Observe => self.enter(State::Ready),
            Mode::Automatic => drop(self.hold(Some(Code::Program), reason.clone())),
        }
        vec![Action::FileFailed(scan, reason)]
    }

    /// The machine cannot be read. A scan that waited for it stays where it is.
    fn lost(&mut self, why: Purpose, reason: String) -> Vec<Action> {
        self.attempts = self.attempts.saturating_add(1);
        let then = if matches!(why, Purpose::Resolve(_)) { why } else { Purpose::Contact };
        self.fault(reason, then)
    }

    fn fault(&mut self, reason: String, then: Purpose) -> Vec<Action> {
        self.next_ticket();
        self.disarm_after = false;
        self.enter(State::Faulted(Box::new(Fault { reason, then })));
        Vec::new()
    }

    fn hold(&mut self, code: Option<Code>, reason: String) -> Vec<Action> {
        self.next_ticket();
        self.disarm_after = false;
        self.rescan = false;
        self.enter(State::Held(Hold { code, reason }));
        Vec::new()
    }

    fn measured(&mut self, scan: ScanFile, measured: MeasuredTube) -> Vec<Action> {
        let rescan = std::mem::take(&mut self.rescan);
        if let Some(in_force) = self.in_force.clone() {
            let changed = self.changed.take();
            self.history.push(Part { in_force, measured, rescan, changed, approved: false });
        }
        if self.history.len() > MAX_HISTORY {
            self.history.remove(0);
        }
        self.decide(Some(scan))
    }

    fn unusable(&mut self, scan: ScanFile, reason: String) -> Vec<Action> {
        self.unusable += 1;
        if self.unusable < MAX_UNUSABLE {
            self.enter(State::Ready);
        } else {
            let count = self.unusable;
            self.unusable = 0;
            self.hold(None, format!("{count} scans in a row could not be used; the last one: {reason}"));
        }
        vec![Action::FileFailed(scan, reason)]
    }

    fn decided(&mut self, scan: Option<ScanFile>, decision: Decision) -> Vec<Action> {
        match (decision.answer.verdict, scan) {
            (Verdict::Rescan, Some(scan)) => {
                // The next scan is of the same tube: together they may tell.
                self.rescan = !self.history.is_empty();
                self.unusable(scan, decision.reasons())
            }
            (Verdict::Hold, Some(scan)) => {
                if !self.keep_for_approval(&decision.answer) {
                    self.history.pop();
                }
                self.held_by_decision(scan, &decision)
            }
            (Verdict::Hold | Verdict::Rescan, None) => {
                self.keep_for_approval(&decision.answer);
                self.hold(decision.code(), decision.reasons())
            }
            (verdict, scan) => {
                self.unusable = 0;
                match scan {
                    Some(scan) => {
                        let mut actions = vec![Action::FileDone(scan)];
                        actions.extend(self.go_on(verdict, decision.answer.commanded));
                        actions
                    }
                    None if verdict == Verdict::InTolerance => self.wait(),
                    None => self.go_on(verdict, decision.answer.commanded),
                }
            }
        }
    }

    /// Whether the hold is one that arming approves: then its tube stays in the history.
    fn keep_for_approval(&mut self, answer: &Answer) -> bool {
        let newest = self.history.len().saturating_sub(1);
        if answer.is_about(Code::BatchChanged) {
            // This tube is the new batch's first. Observing, nobody is there to approve the next good one.
            self.history.drain(..newest);
            let changed = (self.mode == Mode::Automatic).then_some(Changed::Batch);
            self.history.iter_mut().for_each(|part| part.changed = changed);
        } else if answer.is_about(Code::WorseTwice) {
            self.approval = Some(Approval::RollBack(answer.commanded.clone()));
        } else if answer.is_about(Code::Unapproved) {
            self.approval = Some(Approval::Tube);
        } else {
            return false;
        }
        true
    }

    /// The part has no say in what follows: whoever arms again has looked at it. Observing has nothing to stop.
    fn held_by_decision(&mut self, scan: ScanFile, decision: &Decision) -> Vec<Action> {
        match self.mode {
            Mode::Observe => self.enter(State::Ready),
            Mode::Automatic => drop(self.hold(decision.code(), decision.reasons())),
        }
        vec![Action::FileDone(scan)]
    }

    fn go_on(&mut self, verdict: Verdict, table: CommandTable) -> Vec<Action> {
        match self.mode {
            Mode::Automatic if verdict != Verdict::InTolerance => return self.deliver(table),
            _ if verdict == Verdict::InTolerance => self.enter(State::InTolerance),
            _ => self.enter(State::Ready),
        }
        Vec::new()
    }

    fn deliver(&mut self, table: CommandTable) -> Vec<Action> {
        // Only a machine that was read leads here; without a table read there is none to be replaced.
        let expected = self.in_force.as_ref().map_or(TableId::default(), |f| f.id);
        let operation = match &self.in_force {
            Some(InForce { id, table: last, .. }) if self.ours == Some(*id) => {
                Operation::Correct { last: last.clone() }
            }
            _ => Operation::New,
        };
        self.enter(State::Delivering(table.clone()));
        vec![Action::Deliver(self.next_ticket(), table, expected, operation)]
    }

    fn delivered(&mut self, table: CommandTable, outcome: Delivered) -> Vec<Action> {
        match outcome {
            Delivered::Applied(id) => {
                self.ours = Some(id);
                self.in_force = Some(InForce { id, program: self.program.clone(), table });
                let actions = self.wait();
                if std::mem::take(&mut self.disarm_after) {
                    self.enter(State::Disarmed);
                }
                actions
            }
            Delivered::Rejected(reason) => self.hold(None, reason),
            Delivered::NotApplied(reason) => self.fault(reason, Purpose::Contact),
            Delivered::Unknown(reason, intent) => self.fault(reason, Purpose::Resolve(intent)),
        }
    }

    /// The longest dwell is over, or a faulted machine is due to be read again.
    fn overdue(&mut self, state: State) -> Vec<Action> {
        let late = |what: &str| format!("{what} took longer than allowed");
        match state {
            State::Faulted(fault) => self.read(fault.then),
            State::Reading(why) => self.lost(why, late("reading the machine")),
            State::Measuring(scan) => {
                self.next_ticket();
                self.unusable(scan, late("measuring"))
            }
            State::Deciding(scan) => {
                self.hold(None, late("deciding"));
                scan.map(|scan| Action::FileFailed(scan, late("deciding"))).into_iter().collect()
            }
            State::Delivering(_) => self.fault(late("delivering"), Purpose::Resolve(None)),
            State::Disarmed | State::Ready | State::InTolerance | State::Held(_) => Vec::new(),
        }
    }
}
