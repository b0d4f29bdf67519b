//! Every state meets every event: the transition table as a snapshot.

use std::fmt::Write as _;

use super::*;
use crate::tube::CommandRow;

fn job() -> Job {
    let row = CommandRow { length_mm: 120.0, rotation_rad: 0.0, angle_rad: 1.0 };
    Job {
        program: "P1".into(),
        table: CommandTable { bends: vec![row], last_length_mm: 50.0 },
        expected_active: None,
        operation: Operation::New,
        approved: false,
    }
}

fn profile() -> Profile {
    Profile::load("reference-modbus").unwrap()
}

const OLD: TableId = TableId { revision: 7, crc: 0xAAAA };

fn crc() -> u32 {
    prepare(&profile(), &job()).unwrap().crc
}

fn new() -> TableId {
    TableId { revision: 8, crc: crc() }
}

fn status(heartbeat: u16) -> Status {
    Status {
        heartbeat,
        state: 0b0011,
        program: "P1".into(),
        bend_count: 1,
        active: OLD,
        ack_revision: 8,
        ack: Ack::None,
        pending: TableId::default(),
    }
}

fn with(change: impl Fn(&mut Status)) -> Status {
    let mut s = status(2);
    change(&mut s);
    s
}

fn image() -> Vec<u8> {
    let payload = prepare(&profile(), &job()).unwrap().payload;
    staging_image(&profile(), &Staged { id: new(), payload })
}

fn active(change: impl Fn(&mut Status), payload: Vec<u8>) -> Event {
    Event::ActiveRead(ActiveTable { status: with(change), payload })
}

/// Every kind of event, with the variants that make a difference.
fn events() -> Vec<(&'static str, Event)> {
    let payload = prepare(&profile(), &job()).unwrap().payload;
    let mut damaged = image();
    damaged[21] ^= 1;
    vec![
        ("status: fine", Event::StatusRead(status(2))),
        ("status: heartbeat as before", Event::StatusRead(status(1))),
        ("status: other program", Event::StatusRead(with(|s| s.program = "P2".into()))),
        ("status: other bend count", Event::StatusRead(with(|s| s.bend_count = 2))),
        ("status: running a part", Event::StatusRead(with(|s| s.state = 0b0001))),
        ("status: emergency stop", Event::StatusRead(with(|s| s.state = 0b1011))),
        ("status: a commit pending", Event::StatusRead(with(|s| s.pending = OLD))),
        ("status: other table", Event::StatusRead(with(|s| s.active.revision = 9))),
        ("status: the job's table", Event::StatusRead(with(|s| s.active = new()))),
        ("status: the job's table, running", Event::StatusRead(with(|s| (s.active, s.state) = (new(), 1)))),
        ("written", Event::Written),
        ("read-back: equal", Event::ReadBack(image())),
        ("read-back: one bit off", Event::ReadBack(damaged)),
        ("read-back: short", Event::ReadBack(image()[..20].to_vec())),
        ("intent journalled", Event::IntentJournalled),
        ("committed", Event::Committed),
        ("active: new", active(|s| s.active = new(), payload.clone())),
        ("active: new name, other rows", active(|s| s.active = new(), vec![0; payload.len()])),
        ("active: old", active(|_| (), vec![])),
        ("active: old, commit pending", active(|s| s.pending = new(), vec![])),
        ("active: old, refused", active(|s| s.ack = Ack::Refused(4), vec![])),
        (
            "active: old, refused an earlier one",
            active(|s| (s.ack, s.ack_revision) = (Ack::Refused(4), 7), vec![]),
        ),
        ("active: a third table", active(|s| s.active.revision = 9, vec![])),
        ("failed", Event::Failed("the cable fell out".into())),
        ("timeout", Event::Timeout),
    ]
}

/// A delivery led to each state by the shortest way; the commit goes out at 100 ms.
fn deliveries() -> Vec<(&'static str, Delivery)> {
    let lead = |events: Vec<Event>| {
        let (mut delivery, _) = Delivery::start(&profile(), &job());
        for event in events {
            delivery.on(event, 100);
        }
        delivery
    };
    let to_compare = || vec![Event::StatusRead(status(1)), Event::Written];
    let to_recheck = || [to_compare(), vec![Event::ReadBack(image())]].concat();
    let to_journal = || [to_recheck(), vec![Event::StatusRead(status(2))]].concat();
    let to_commit = || [to_journal(), vec![Event::IntentJournalled]].concat();
    let to_confirm = || [to_commit(), vec![Event::Committed]].concat();
    vec![
        ("asking", lead(vec![])),
        ("staging", lead(vec![Event::StatusRead(status(1))])),
        ("comparing", lead(to_compare())),
        ("rechecking", lead(to_recheck())),
        ("listening", lead([to_recheck(), vec![Event::StatusRead(status(1))]].concat())),
        ("journalling", lead(to_journal())),
        ("committing", lead(to_commit())),
        ("confirming", lead(to_confirm())),
        ("confirming, commit unanswered", lead([to_commit(), vec![Event::Failed("x".into())]].concat())),
        ("pausing", lead([to_confirm(), vec![active(|_| (), vec![])]].concat())),
        ("done", lead(vec![Event::Timeout])),
    ]
}

fn show(action: &Action) -> String {
    match action {
        Action::WriteStaging(staged) => format!("write staging ({})", staged.id),
        Action::ReadStaging { bytes } => format!("read staging ({bytes} bytes)"),
        Action::JournalIntent(intent) => format!("journal intent ({} over {})", intent.new, intent.old),
        Action::Commit(id) => format!("commit ({id})"),
        Action::Wait { until_ms } => format!("wait until {until_ms}"),
        Action::Finish(Outcome::Rejected { reasons }) => {
            let texts = reasons.iter().map(Reason::to_string).collect::<Vec<_>>();
            format!("finish: rejected: {}", texts.join("; "))
        }
        Action::Finish(Outcome::NotApplied { .. }) => "finish: not applied".into(),
        Action::Finish(Outcome::Applied(id)) => format!("finish: applied ({id})"),
        Action::Finish(Outcome::AlreadyActive(id)) => format!("finish: already active ({id})"),
        other => format!("{other:?}"),
    }
}

/// Per state, the events that lead to the same; what most lead to is said once.
#[test]
fn transition_table() {
    let mut out = String::new();
    for (name, delivery) in deliveries() {
        let mut results: Vec<(String, Vec<&str>)> = Vec::new();
        for (event_name, event) in events() {
            let mut after = delivery.clone();
            let action = after.on(event, 200);
            let result = format!("{:?}: {}", after.state, show(&action));
            match results.iter_mut().find(|(known, _)| *known == result) {
                Some((_, names)) => names.push(event_name),
                None => results.push((result, vec![event_name])),
            }
        }
        let _ = writeln!(out, "{name}");
        let most = results.iter().map(|(_, names)| names.len()).max();
        for (result, names) in results {
            let others = names.len() > 5 && Some(names.len()) == most;
            for name in if others { vec!["every other event"] } else { names } {
                let _ = writeln!(out, "  {name:36} -> {result}");
            }
        }
    }
    insta::assert_snapshot!(out);
}

#[test]
fn a_commit_goes_out_only_from_a_journalled_intent() {
    for (name, delivery) in deliveries() {
        for (event_name, event) in events() {
            let action = delivery.clone().on(event, 200);
            let commits = matches!(action, Action::Commit(_));
            assert_eq!(
                commits,
                name == "journalling" && event_name == "intent journalled",
                "{name}, {event_name}"
            );
        }
    }
}

fn confirming() -> Delivery {
    deliveries().into_iter().find(|(name, _)| *name == "confirming").unwrap().1
}

#[test]
fn the_old_table_counts_as_not_applied_once_a_late_commit_is_impossible() {
    // settle_ms is 500 in the reference profile; the commit went out at 100.
    let mut d = confirming();
    assert!(matches!(d.on(active(|_| (), vec![]), 200), Action::Wait { until_ms: 220 }));
    d.on(Event::Timeout, 220);
    assert!(matches!(d.on(active(|_| (), vec![]), 699), Action::Wait { .. }));
    d.on(Event::Timeout, 700);
    let Action::Finish(Outcome::NotApplied { why }) = d.on(active(|_| (), vec![]), 700) else { panic!() };
    assert_eq!(why, "the commit did not take effect: the active table is still revision 7, CRC 0000AAAA");
}

#[test]
fn a_link_that_failed_in_between_starts_the_quiet_time_again() {
    let mut d = confirming();
    d.on(active(|_| (), vec![]), 200);
    d.on(Event::Timeout, 300);
    d.on(Event::Failed("gone".into()), 600);
    d.on(Event::Timeout, 620);
    assert!(matches!(d.on(active(|_| (), vec![]), 900), Action::Wait { .. }));
}

#[test]
fn unknown_at_the_deadline_and_not_before() {
    // confirm_ms is 5000.
    let mut d = confirming();
    assert!(matches!(d.on(Event::Failed("gone".into()), 5099), Action::Wait { .. }));
    d.on(Event::Timeout, 5100);
    let Action::Finish(Outcome::Unknown { why }) = d.on(Event::Failed("gone".into()), 5100) else { panic!() };
    assert!(why.contains("revision 8") && why.contains("5000 ms") && why.contains("gone"), "{why}");
}

#[test]
fn a_heartbeat_that_stands_still_is_refused_at_its_deadline() {
    let recheck = || deliveries().into_iter().find(|(name, _)| *name == "rechecking").unwrap().1;
    // heartbeat_ms is 1000, the first look was at 100.
    assert!(matches!(recheck().on(Event::StatusRead(status(1)), 1099), Action::Wait { .. }));
    let Action::Finish(Outcome::Rejected { reasons }) = recheck().on(Event::StatusRead(status(1)), 1100)
    else {
        panic!()
    };
    assert_eq!(reasons[0].code, "heartbeat");
}

#[test]
fn limits_end_a_delivery_before_anything_is_read() {
    let mut job = job();
    job.table.bends[0].length_mm = 9.0;
    let (_, action) = Delivery::start(&profile(), &job);
    let Action::Finish(Outcome::Rejected { reasons }) = action else { panic!("{action:?}") };
    assert_eq!(reasons[0].to_string(), "bend 1: length 9.00 mm, the machine takes 10.00 to 6000.00");
}

#[test]
fn a_table_changed_at_the_machine_is_refused() {
    let mut job = job();
    job.expected_active = Some(TableId { revision: 6, crc: 1 });
    let (mut delivery, _) = Delivery::start(&profile(), &job);
    let Action::Finish(Outcome::Rejected { reasons }) = delivery.on(Event::StatusRead(status(1)), 0) else {
        panic!()
    };
    assert_eq!(reasons[0].code, "table_changed");
}

#[test]
fn the_last_revision_is_not_wrapped() {
    let (mut delivery, _) = Delivery::start(&profile(), &job());
    let full = with(|s| s.active.revision = u32::MAX);
    let Action::Finish(Outcome::Rejected { reasons }) = delivery.on(Event::StatusRead(full), 0) else {
        panic!()
    };
    assert_eq!(reasons[0].code, "revision");
}

/// As the reference machine has it after a refused attempt: the next one carries the same revision.
fn refused_before() -> Delivery {
    let before = |heartbeat| Status { ack: Ack::Refused(4), ..status(heartbeat) };
    let (mut delivery, _) = Delivery::start(&profile(), &job());
    for event in [
        Event::StatusRead(before(1)),
        Event::Written,
        Event::ReadBack(image()),
        Event::StatusRead(before(2)),
        Event::IntentJournalled,
        Event::Committed,
    ] {
        delivery.on(event, 100);
    }
    delivery
}

#[test]
fn a_refusal_that_stood_there_before_the_commit_is_not_its_answer() {
    let refused = || active(|s| s.ack = Ack::Refused(4), vec![]);
    let payload = prepare(&profile(), &job()).unwrap().payload;
    let mut d = refused_before();
    assert!(matches!(d.on(refused(), 120), Action::Wait { .. }));
    d.on(Event::Timeout, 140);
    assert_eq!(d.on(active(|s| s.active = new(), payload), 140), Action::Finish(Outcome::Applied(new())));
    // Once the machine was seen with this commit, the same words are about it.
    let mut d = refused_before();
    d.on(active(|s| (s.ack, s.pending) = (Ack::Refused(4), new()), vec![]), 120);
    d.on(Event::Timeout, 140);
    let Action::Finish(Outcome::Rejected { reasons }) = d.on(refused(), 140) else { panic!() };
    assert_eq!(reasons[0].code, "machine");
    // Never seen with it: nothing can come any more once it is quiet.
    let mut d = refused_before();
    d.on(refused(), 120);
    d.on(Event::Timeout, 620);
    let Action::Finish(Outcome::NotApplied { why }) = d.on(refused(), 620) else { panic!() };
    assert!(why.contains("the machine's last word is a refusal") && why.contains("(code 4)"), "{why}");
}

#[test]
fn what_was_seen_too_long_before_the_commit_is_not_relied_on() {
    let journalling = || deliveries().into_iter().find(|(name, _)| *name == "journalling").unwrap().1;
    // heartbeat_ms is 1000, the machine was seen at 100.
    assert_eq!(journalling().on(Event::IntentJournalled, 1100), Action::Commit(new()));
    let Action::Finish(Outcome::NotApplied { why }) = journalling().on(Event::IntentJournalled, 1101) else {
        panic!()
    };
    assert!(why.contains("the journal took 1001 ms") && why.contains("nothing was committed"), "{why}");
}

#[test]
fn the_jobs_own_table_is_not_taken_for_delivered_while_another_may_replace_it() {
    let (mut delivery, _) = Delivery::start(&profile(), &job());
    let status = with(|s| (s.active, s.pending) = (new(), OLD));
    let Action::Finish(Outcome::Rejected { reasons }) = delivery.on(Event::StatusRead(status), 0) else {
        panic!()
    };
    assert_eq!(reasons[0].code, "commit_pending");
}

#[test]
fn why_the_commit_was_not_confirmed_is_told() {
    let mut d = deliveries().into_iter().find(|(name, _)| *name == "committing").unwrap().1;
    d.on(Event::Failed("the machine was busy".into()), 150);
    d.on(active(|_| (), vec![]), 200);
    d.on(Event::Timeout, 700);
    let Action::Finish(Outcome::NotApplied { why }) = d.on(active(|_| (), vec![]), 700) else { panic!() };
    assert!(why.ends_with("; when it was sent: the machine was busy"), "{why}");
}
