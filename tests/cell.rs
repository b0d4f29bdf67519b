//! The cell's state machine: every state against every event as one table, and what an operator relies on.

#![allow(clippy::unwrap_used, clippy::expect_used)] // clippy does not count the helpers of an integration test as test code

use std::path::PathBuf;
use std::time::Duration;

use benderd::arm::ScanFile;
use benderd::bender::TableId;
use benderd::cell::{Action, Cell, Decision, Delivered, Dwell, Event, Hold, InForce, Purpose, State, Ticket};
use benderd::config::Mode;
use benderd::correct::{Answer, Changed, Code, Reason, Verdict};
use benderd::tube::{CommandTable, MeasuredTube};

/// A cell with a clock turned by hand. It remembers the ticket of the last work it was asked for.
struct Bench {
    cell: Cell,
    now: Duration,
    ticket: Ticket,
    log: Vec<Action>,
}

fn scan() -> ScanFile {
    ScanFile { path: PathBuf::from("a.ply"), bytes: 1 }
}

fn table(last_length_mm: f64) -> CommandTable {
    CommandTable { bends: Vec::new(), last_length_mm }
}

fn id(revision: u32) -> TableId {
    TableId { revision, crc: revision + 100 }
}

fn in_force(revision: u32) -> InForce {
    InForce { id: id(revision), program: "bracket".into(), table: table(f64::from(revision)) }
}

fn tube() -> Box<MeasuredTube> {
    let text = r#"{"tube_radius_mm": 5.0, "last_length_mm": 100.0, "bends": []}"#;
    Box::new(serde_json::from_str(text).unwrap())
}

fn decision(verdict: Verdict) -> Box<Decision> {
    let answer = Answer {
        verdict,
        commanded: table(7.0),
        springback_deg: Vec::new(),
        springback_sigma_deg: Vec::new(),
        predicted: None,
        reasons: vec![Reason::new(Code::Scatter, "why")],
    };
    Box::new(Decision { answer, inspection: None })
}

impl Bench {
    fn new(mode: Mode) -> Bench {
        let cell = Cell::new(mode, "bracket", Dwell::default());
        Bench { cell, now: Duration::ZERO, ticket: Ticket(0), log: Vec::new() }
    }

    fn on(&mut self, event: Event) -> Vec<Action> {
        let actions = self.cell.on(self.now, event);
        for action in &actions {
            match action {
                Action::ReadMachine(t)
                | Action::Measure(t, _)
                | Action::Decide(t)
                | Action::Deliver(t, ..) => {
                    self.ticket = *t;
                }
                _ => {}
            }
        }
        self.log.extend(actions.iter().cloned());
        actions
    }

    fn read(&mut self, revision: u32) -> Vec<Action> {
        self.on(Event::MachineRead(self.ticket, in_force(revision)))
    }

    fn decide(&mut self, verdict: Verdict) -> Vec<Action> {
        self.on(Event::Decided(self.ticket, decision(verdict)))
    }

    fn overdue(&mut self) -> Vec<Action> {
        self.now = self.cell.wake_at().expect("a state with a dwell");
        self.on(Event::Tick)
    }

    /// Brings the cell to a state by the shortest way that leads there.
    fn at(mode: Mode, name: &str) -> Option<Bench> {
        let mut b = Bench::new(mode);
        let observe = mode == Mode::Observe;
        if name == "Disarmed" {
            return Some(b);
        }
        b.on(Event::Start);
        if name == "Reading(Contact)" {
            return Some(b);
        }
        if name == "Faulted(Contact)" {
            b.on(Event::MachineLost(b.ticket, "gone".into()));
            return Some(b);
        }
        b.read(1);
        if !observe {
            b.on(Event::Arm);
            if name == "Reading(Arming)" {
                return Some(b);
            }
            b.read(1);
            if name == "Deciding(first piece)" {
                return Some(b);
            }
            b.decide(Verdict::FirstPiece);
            if name == "Delivering" {
                return Some(b);
            }
            if name.contains("Resolve") {
                let intent = Some(id(2));
                b.on(Event::Delivered(b.ticket, Delivered::Unknown("cut".into(), intent)));
                if name == "Reading(Resolve)" {
                    b.overdue();
                }
                return Some(b);
            }
            b.on(Event::Delivered(b.ticket, Delivered::Applied(id(2))));
        }
        if name == "Ready" {
            return Some(b);
        }
        b.on(Event::Scan(scan()));
        if name == "Reading(Recall)" {
            return Some(b);
        }
        b.read(2);
        if name == "Measuring" {
            return Some(b);
        }
        b.on(Event::Measured(b.ticket, tube()));
        match name {
            "Deciding(scan)" => {}
            "InTolerance" => drop(b.decide(Verdict::InTolerance)),
            "Held" if observe => return None,
            "Held" => drop(b.decide(Verdict::Hold)),
            _ => return None,
        }
        Some(b)
    }

    fn events(&self) -> Vec<(&'static str, Event)> {
        let (t, old) = (self.ticket, Ticket(0));
        let other = InForce { program: "flange".into(), ..in_force(2) };
        let delivered = |outcome| Event::Delivered(t, outcome);
        vec![
            ("start", Event::Start),
            ("arm", Event::Arm),
            ("disarm", Event::Disarm),
            ("time is up", Event::Tick),
            ("machine read, same table", Event::MachineRead(t, in_force(2))),
            ("machine read, other table", Event::MachineRead(t, in_force(9))),
            ("machine read, other program", Event::MachineRead(t, other)),
            ("machine lost", Event::MachineLost(t, "gone".into())),
            ("late machine read", Event::MachineRead(old, in_force(2))),
            ("scan", Event::Scan(scan())),
            ("filing failed", Event::FilingFailed("no permission".into())),
            ("measured", Event::Measured(t, tube())),
            ("measuring failed", Event::MeasureFailed(t, "a cube".into())),
            ("late measured", Event::Measured(old, tube())),
            ("decided first piece", Event::Decided(t, decision(Verdict::FirstPiece))),
            ("decided in tolerance", Event::Decided(t, decision(Verdict::InTolerance))),
            ("decided correct", Event::Decided(t, decision(Verdict::Correct))),
            ("decided rescan", Event::Decided(t, decision(Verdict::Rescan))),
            ("decided hold", Event::Decided(t, decision(Verdict::Hold))),
            ("late decided correct", Event::Decided(old, decision(Verdict::Correct))),
            ("delivered", delivered(Delivered::Applied(id(3)))),
            ("delivery rejected", delivered(Delivered::Rejected("no".into()))),
            ("delivery not applied", delivered(Delivered::NotApplied("cut".into()))),
            ("delivery unknown", delivered(Delivered::Unknown("cut".into(), None))),
            ("late delivered", Event::Delivered(old, Delivered::Applied(id(3)))),
        ]
    }
}

const STATES: [&str; 14] = [
    "Disarmed",
    "Reading(Contact)",
    "Reading(Arming)",
    "Reading(Recall)",
    "Reading(Resolve)",
    "Ready",
    "InTolerance",
    "Measuring",
    "Deciding(first piece)",
    "Deciding(scan)",
    "Delivering",
    "Held",
    "Faulted(Contact)",
    "Faulted(Resolve)",
];

fn purpose(why: &Purpose) -> &'static str {
    match why {
        Purpose::Contact => "Contact",
        Purpose::Arming => "Arming",
        Purpose::Recall(_) => "Recall",
        Purpose::Resolve(_) => "Resolve",
    }
}

fn name(state: &State) -> String {
    match state {
        State::Disarmed => "Disarmed".into(),
        State::Reading(why) => format!("Reading({})", purpose(why)),
        State::Ready => "Ready".into(),
        State::InTolerance => "InTolerance".into(),
        State::Measuring(_) => "Measuring".into(),
        State::Deciding(None) => "Deciding(first piece)".into(),
        State::Deciding(Some(_)) => "Deciding(scan)".into(),
        State::Delivering(_) => "Delivering".into(),
        State::Held(_) => "Held".into(),
        State::Faulted(fault) => format!("Faulted({})", purpose(&fault.then)),
    }
}

fn action(action: &Action) -> &'static str {
    match action {
        Action::ReadMachine(_) => "read machine",
        Action::Measure(..) => "measure",
        Action::Decide(_) => "decide",
        Action::Deliver(..) => "deliver",
        Action::FileDone(_) => "file done",
        Action::FileFailed(..) => "file failed",
        Action::SetAside(_) => "set aside",
    }
}

#[test]
fn every_state_against_every_event() {
    let mut text = String::new();
    for mode in [Mode::Automatic, Mode::Observe] {
        for state in STATES {
            let Some(bench) = Bench::at(mode, state).filter(|b| name(b.cell.state()) == state) else {
                continue;
            };
            text += &format!("\n{mode:?}: {state}\n");
            for (label, event) in bench.events() {
                let mut b = Bench::at(mode, state).unwrap();
                let before = b.cell.state().clone();
                b.now = b.cell.wake_at().unwrap_or(b.now);
                let actions = b.on(event);
                if *b.cell.state() != before || !actions.is_empty() {
                    let actions: Vec<&str> = actions.iter().map(action).collect();
                    let line = format!("  {label:28}-> {:24}{}", name(b.cell.state()), actions.join(", "));
                    text += &format!("{}\n", line.trim_end());
                }
            }
        }
    }
    insta::assert_snapshot!(text);
}

#[test]
fn every_state_can_be_reached_in_automatic() {
    for state in STATES {
        let bench = Bench::at(Mode::Automatic, state).unwrap_or_else(|| panic!("no way to {state}"));
        assert_eq!(name(bench.cell.state()), state);
    }
}

#[test]
fn a_cell_comes_up_disarmed_and_writes_nothing_until_armed() {
    let mut b = Bench::new(Mode::Automatic);
    b.on(Event::Start);
    b.read(1);
    b.on(Event::Scan(scan()));
    assert_eq!((b.cell.state(), b.log.len()), (&State::Disarmed, 1));
    assert!(!b.cell.wants_scan());
}

#[test]
fn an_order_to_arm_is_not_lost_while_the_machine_is_first_read() {
    let mut b = Bench::at(Mode::Automatic, "Reading(Contact)").unwrap();
    b.on(Event::Arm);
    assert!(matches!(b.read(1)[..], [Action::Decide(_)]));
}

#[test]
fn observing_never_delivers() {
    for verdict in
        [Verdict::FirstPiece, Verdict::Correct, Verdict::InTolerance, Verdict::Hold, Verdict::Rescan]
    {
        let mut b = Bench::at(Mode::Observe, "Deciding(scan)").unwrap();
        b.decide(verdict);
        assert!(b.cell.wants_scan(), "{verdict:?}");
        assert!(!b.log.iter().any(|a| matches!(a, Action::Deliver(..))));
    }
}

#[test]
fn a_late_answer_from_before_a_disarm_is_dropped() {
    let mut b = Bench::at(Mode::Automatic, "Deciding(scan)").unwrap();
    let late = b.ticket;
    b.on(Event::Disarm);
    assert_eq!(b.on(Event::Decided(late, decision(Verdict::Correct))), []);
    assert_eq!(b.cell.state(), &State::Disarmed);
}

#[test]
fn a_delivery_that_is_disarmed_ends_disarmed_but_is_not_forgotten() {
    let mut b = Bench::at(Mode::Automatic, "Delivering").unwrap();
    b.on(Event::Disarm);
    assert_eq!(name(b.cell.state()), "Delivering");
    b.on(Event::Delivered(b.ticket, Delivered::Applied(id(2))));
    assert_eq!(b.cell.state(), &State::Disarmed);
    assert_eq!(b.cell.in_force().unwrap().id, id(2));
}

#[test]
fn an_unknown_delivery_is_resolved_by_reading_and_never_sent_again() {
    let mut b = Bench::at(Mode::Automatic, "Reading(Resolve)").unwrap();
    let deliveries = |b: &Bench| b.log.iter().filter(|a| matches!(a, Action::Deliver(..))).count();
    for _ in 0..3 {
        b.on(Event::Disarm);
        b.on(Event::Arm);
        b.on(Event::MachineLost(b.ticket, "gone".into()));
        assert_eq!(name(b.cell.state()), "Faulted(Resolve)");
        b.overdue();
    }
    assert_eq!(deliveries(&b), 1);
    b.read(2);
    assert_eq!(b.cell.state(), &State::Disarmed);
    // It had arrived: armed again, the cell knows the table as its own.
    b.on(Event::Arm);
    b.read(2);
    b.decide(Verdict::FirstPiece);
    b.on(Event::Delivered(b.ticket, Delivered::Applied(id(2))));
    b.on(Event::Scan(scan()));
    assert!(matches!(b.read(2)[..], [Action::Measure(..)]));
}

#[test]
fn a_table_changed_at_the_machine_holds() {
    let mut b = Bench::at(Mode::Automatic, "Reading(Recall)").unwrap();
    b.read(3);
    let State::Held(Hold { reason, code }) = b.cell.state() else { panic!("{:?}", b.cell.state()) };
    assert_eq!(*code, Some(Code::TableEdited));
    assert!(reason.contains("expected revision 2") && reason.contains("found revision 3"), "{reason}");
}

#[test]
fn armed_again_after_a_hold_the_job_goes_on_and_after_a_foreign_table_it_begins_afresh() {
    for (found, parts) in [(2, 1), (3, 0)] {
        let mut b = Bench::at(Mode::Automatic, "Deciding(scan)").unwrap();
        b.decide(Verdict::Correct);
        b.on(Event::Delivered(b.ticket, Delivered::Rejected("not between parts".into())));
        b.on(Event::Arm);
        b.read(found);
        assert_eq!(name(b.cell.state()), "Deciding(first piece)");
        assert_eq!(b.cell.history().len(), parts);
    }
}

#[test]
fn a_part_that_was_held_has_no_say() {
    let mut b = Bench::at(Mode::Automatic, "Deciding(scan)").unwrap();
    assert_eq!(b.cell.history().len(), 1);
    b.decide(Verdict::Hold);
    assert_eq!(b.cell.history().len(), 0);
}

#[test]
fn a_changed_batch_begins_with_the_tube_that_showed_it() {
    let mut b = Bench::at(Mode::Automatic, "Deciding(scan)").unwrap();
    b.decide(Verdict::InTolerance);
    b.on(Event::Scan(scan()));
    b.read(2);
    b.on(Event::Measured(b.ticket, tube()));
    assert_eq!(b.cell.history().len(), 2);
    let mut held = decision(Verdict::Hold);
    held.answer.reasons = vec![Reason::new(Code::BatchChanged, "another batch")];
    b.on(Event::Decided(b.ticket, held));
    assert_eq!((name(b.cell.state()).as_str(), b.cell.history().len()), ("Held", 1));
    b.on(Event::Arm);
    b.read(2);
    assert_eq!((name(b.cell.state()).as_str(), b.cell.history().len()), ("Deciding(first piece)", 1));
}

/// A cell whose first tube is held for this.
fn held_for(code: Code) -> Bench {
    let mut b = Bench::at(Mode::Automatic, "Deciding(scan)").unwrap();
    let mut held = decision(Verdict::Hold);
    held.answer.reasons = vec![Reason::new(code, "look")];
    b.on(Event::Decided(b.ticket, held));
    let State::Held(hold) = b.cell.state() else { panic!("{:?}", b.cell.state()) };
    assert_eq!(hold.code, Some(code));
    b
}

#[test]
fn armed_again_after_worse_twice_the_last_good_table_is_delivered_and_its_first_tube_marked() {
    let mut b = held_for(Code::WorseTwice);
    b.on(Event::Arm);
    let actions = b.read(2);
    let [Action::Deliver(_, rolled_back, over, _)] = &actions[..] else { panic!("{actions:?}") };
    assert_eq!((rolled_back, *over), (&table(7.0), id(2)));
    b.on(Event::Delivered(b.ticket, Delivered::Applied(id(3))));
    b.on(Event::Scan(scan()));
    b.read(3);
    b.on(Event::Measured(b.ticket, tube()));
    let changed: Vec<_> = b.cell.history().iter().map(|part| part.changed).collect();
    assert_eq!(changed, [None, Some(Changed::RollBack)]);
}

#[test]
fn a_roll_back_is_not_delivered_over_a_table_that_somebody_changed_meanwhile() {
    let mut b = held_for(Code::WorseTwice);
    b.on(Event::Arm);
    assert!(matches!(b.read(9)[..], [Action::Decide(_)]));
    assert!(b.cell.history().is_empty());
}

#[test]
fn disarmed_in_between_arming_approves_nothing_that_was_not_said_again() {
    let mut b = held_for(Code::Unapproved);
    b.on(Event::Disarm);
    b.on(Event::Arm);
    assert!(matches!(b.read(2)[..], [Action::Decide(_)]));
    assert!(!b.cell.history()[0].approved);
}

#[test]
fn arming_after_the_first_good_tube_of_a_change_approves_it() {
    let mut b = held_for(Code::Unapproved);
    assert!(!b.cell.history()[0].approved);
    b.on(Event::Arm);
    assert!(matches!(b.read(2)[..], [Action::Decide(_)]));
    assert!(b.cell.history()[0].approved);
    b.decide(Verdict::InTolerance);
    assert!(b.cell.wants_scan());
}

#[test]
fn the_first_tube_of_a_changed_batch_or_after_a_change_at_the_machine_is_marked() {
    let b = held_for(Code::BatchChanged);
    assert_eq!(b.cell.history()[0].changed, Some(Changed::Batch));
    let mut b = Bench::at(Mode::Automatic, "Reading(Recall)").unwrap();
    b.read(3);
    b.on(Event::Arm);
    b.read(3);
    b.decide(Verdict::FirstPiece);
    b.on(Event::Delivered(b.ticket, Delivered::Applied(id(4))));
    b.on(Event::Scan(scan()));
    b.read(4);
    b.on(Event::Measured(b.ticket, tube()));
    assert_eq!(b.cell.history()[0].changed, Some(Changed::Table));
}

#[test]
fn a_tube_that_is_scanned_again_stays_one_tube() {
    let mut b = Bench::at(Mode::Automatic, "Deciding(scan)").unwrap();
    b.decide(Verdict::Rescan);
    assert_eq!(name(b.cell.state()), "Ready");
    let scan_again = |b: &mut Bench| {
        b.on(Event::Scan(scan()));
        b.read(2);
        b.on(Event::Measured(b.ticket, tube()));
        b.cell.history().iter().map(|part| part.rescan).collect::<Vec<bool>>()
    };
    assert_eq!(scan_again(&mut b), [false, true]);
    b.decide(Verdict::InTolerance);
    assert_eq!(scan_again(&mut b), [false, true, false], "the next tube is another one");
}

#[test]
fn three_unusable_scans_in_a_row_hold_and_two_do_not() {
    let mut b = Bench::at(Mode::Automatic, "Ready").unwrap();
    for round in 1..=3 {
        b.on(Event::Scan(scan()));
        b.read(2);
        let actions = b.on(Event::MeasureFailed(b.ticket, "a cube".into()));
        assert!(matches!(&actions[..], [Action::FileFailed(_, why)] if why == "a cube"));
        assert_eq!(b.cell.wants_scan(), round < 3, "round {round}");
    }
    let State::Held(Hold { reason, .. }) = b.cell.state() else { panic!("{:?}", b.cell.state()) };
    assert!(reason.contains("3 scans in a row") && reason.contains("a cube"), "{reason}");
}

#[test]
fn a_state_ends_at_its_longest_dwell_and_not_a_moment_before() {
    for state in STATES {
        let mut b = Bench::at(Mode::Automatic, state).unwrap();
        let Some(at) = b.cell.wake_at() else { continue };
        b.now = at - Duration::from_nanos(1);
        b.on(Event::Tick);
        assert_eq!(name(b.cell.state()), state);
        b.overdue();
        assert_ne!(name(b.cell.state()), state);
    }
}

#[test]
fn a_lost_machine_is_tried_again_at_growing_intervals_up_to_the_cap() {
    let mut b = Bench::at(Mode::Automatic, "Faulted(Contact)").unwrap();
    let mut waits = Vec::new();
    for _ in 0..10 {
        waits.push((b.cell.wake_at().unwrap() - b.now).as_secs());
        b.overdue();
        b.on(Event::MachineLost(b.ticket, "gone".into()));
    }
    assert_eq!(waits, [1, 2, 4, 8, 16, 32, 60, 60, 60, 60]);
}

#[test]
fn a_delivery_that_never_answers_faults_with_its_outcome_unknown() {
    let mut b = Bench::at(Mode::Automatic, "Delivering").unwrap();
    b.overdue();
    let State::Faulted(fault) = b.cell.state() else { panic!("{:?}", b.cell.state()) };
    assert_eq!(
        (fault.reason.as_str(), &fault.then),
        ("delivering took longer than allowed", &Purpose::Resolve(None))
    );
}
