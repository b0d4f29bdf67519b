//! The ten-row map: rows of whole millimetres and degrees that are in force as soon as they are written.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

use assert_cmd::Command;
use benderd::bender::{Bender as _, Job, Link, Operation, Outcome, Profile, deliver};
use benderd::sim::bender::MachineModel;
use benderd::sim::bender_server::SimulatedBender;
use benderd::sim::door::Door;
use benderd::sim::reply_fault::ReplyFault;
use benderd::sim::trouble::WireFaults;
use benderd::trial::deliveries::Memory;
use benderd::tube::{CommandRow, CommandTable};

async fn machine() -> (SimulatedBender, Link) {
    let mut profile = Profile::load("ten-row").unwrap();
    profile.deadlines.request = std::time::Duration::from_millis(200);
    profile.deadlines.confirm_ms = 600;
    profile.deadlines.settle_ms = 100;
    let (door, _) = Door::open(&profile, "127.0.0.1:0").await.unwrap();
    let model = MachineModel::new(profile.clone(), "", 0);
    let bender = SimulatedBender::start(door, model, None, |_| ()).unwrap();
    let link = Link::new(profile, bender.address()).unwrap();
    (bender, link)
}

/// Four bends, 50.4 mm and 20.4 degrees apart.
fn job(approved: bool) -> Job {
    let row = |rotation: f64| CommandRow {
        length_mm: 50.4,
        rotation_rad: rotation.to_radians(),
        angle_rad: 45_f64.to_radians(),
    };
    let table = CommandTable { bends: vec![row(0.0), row(20.4), row(20.4), row(20.4)], last_length_mm: 80.0 };
    Job { program: "bracket".into(), table, expected_active: None, operation: Operation::New, approved }
}

fn rejected(outcome: &Outcome) -> String {
    let Outcome::Rejected { reasons } = outcome else { panic!("{outcome:?}") };
    reasons.iter().map(|r| r.text.clone()).collect::<Vec<_>>().join("; ")
}

#[tokio::test]
async fn rows_go_in_with_the_operators_approval_and_not_without() {
    let (bender, mut link) = machine().await;
    let refused = deliver(&mut link, &job(false), &mut Memory::default()).await;
    assert!(rejected(&refused).contains("approve the write"), "{refused:?}");
    assert!(bender.with(|m| m.active_payload()).is_empty(), "nothing was written");
    let outcome = deliver(&mut link, &job(true), &mut Memory::default()).await;
    assert!(matches!(outcome, Outcome::Applied(_)), "{outcome:?}");
    // Positions from the first row on, rounded there: nothing is lost along the table.
    let column = |first| bender.with(|m| m.read(first, 10).unwrap());
    assert_eq!(column(3523), [50, 101, 151, 202, 0, 0, 0, 0, 0, 0]);
    assert_eq!(column(3583), [0, 20, 41, 61, 0, 0, 0, 0, 0, 0]);
    assert_eq!(column(3553), [45, 45, 45, 45, 0, 0, 0, 0, 0, 0]);
    let again = deliver(&mut link, &job(true), &mut Memory::default()).await;
    assert!(matches!(again, Outcome::AlreadyActive(_)), "{again:?}");
}

/// What `check --plan` prints: function, first address and count of each request.
fn printed_requests() -> Vec<[u16; 3]> {
    let output =
        Command::cargo_bin("benderd").unwrap().args(["check", "--plan", "ten-row"]).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    let lines = text.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
    let of = |words: Vec<&str>| {
        let function = match words[..] {
            ["read", _, "registers", ..] => 3,
            ["read", _, "coils", ..] => 1,
            ["write", ..] => 16,
            _ => return None,
        };
        Some([function, words[3].parse().unwrap(), words[1].parse().unwrap()])
    };
    lines.filter_map(of).collect()
}

#[tokio::test]
async fn a_delivery_asks_what_the_printed_plan_says() {
    let (_bender, mut link) = machine().await;
    assert!(matches!(deliver(&mut link, &job(true), &mut Memory::default()).await, Outcome::Applied(_)));
    let request = |line: String| {
        let frame = line.split_once(" > ")?.1.to_owned();
        let byte = |word: &str| u16::from_str_radix(word, 16).unwrap();
        let bytes: Vec<u16> = frame.split(' ').map(byte).collect();
        let word = |at: usize| bytes[at] << 8 | bytes[at + 1];
        Some([bytes[7], word(8), word(10)]) // behind the header of Modbus TCP
    };
    let asked: Vec<[u16; 3]> = link.last_frames().into_iter().filter_map(request).collect();
    assert_eq!(asked, printed_requests());
}

#[tokio::test]
async fn a_machine_that_runs_or_has_another_die_gets_nothing() {
    let (bender, mut link) = machine().await;
    bender.with(|m| m.set_between_parts(false));
    let refused = deliver(&mut link, &job(true), &mut Memory::default()).await;
    assert!(rejected(&refused).contains("\"running\" (bit 0) is on, must be off"), "{refused:?}");
    let mut other = Profile::load("ten-row").unwrap();
    other.identification = 76;
    let mut link = Link::new(other, bender.address()).unwrap();
    let Outcome::NotApplied { why } = deliver(&mut link, &job(true), &mut Memory::default()).await else {
        panic!()
    };
    assert!(why.contains("register 2520 holds 60") && why.contains("another die"), "{why}");
}

#[tokio::test]
async fn a_correction_names_what_somebody_changed_at_the_screen() {
    let (bender, mut link) = machine().await;
    assert!(matches!(deliver(&mut link, &job(true), &mut Memory::default()).await, Outcome::Applied(_)));
    bender.with(|m| m.write(3554, &[47]).unwrap());
    let mut correction = job(true);
    correction.table.bends[0].angle_rad = 46_f64.to_radians();
    correction.operation = Operation::Correct { last: job(true).table };
    let refused = deliver(&mut link, &correction, &mut Memory::default()).await;
    assert_eq!(rejected(&refused), "bend 45.000 deg was committed, the machine holds 47.000");
}

/// Nobody can tell half a table from a whole one at such a machine: that is said.
#[tokio::test]
async fn half_a_table_is_unknown_and_the_next_delivery_makes_it_whole() {
    let (bender, mut link) = machine().await;
    // Identification, rows, coils, rows again, twice before the commit; then the first column is written, and the second one's answer is lost.
    let answers = [None; 2 * 8 + 1].into_iter().chain([Some(ReplyFault::Lost)]);
    bender.set_wire_faults(Some(WireFaults::script(answers)));
    let outcome = deliver(&mut link, &job(true), &mut Memory::default()).await;
    let Outcome::Unknown { why } = &outcome else { panic!("{outcome:?}") };
    assert!(why.contains("neither the old nor the new one"), "{why}");
    bender.set_wire_faults(None);
    let outcome = deliver(&mut link, &job(true), &mut Memory::default()).await;
    assert!(matches!(outcome, Outcome::Applied(_)), "{outcome:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn push_asks_for_the_approval() {
    let (bender, _) = machine().await;
    let folder = tempfile::tempdir().unwrap();
    let table = "length_mm,rotation_deg,angle_deg,radius_mm\n50.4,0,45,60\n80,0,0,\n";
    std::fs::write(folder.path().join("bracket.csv"), table).unwrap();
    let address = bender.address().to_owned();
    let push = move |more: &[&str]| {
        let mut args =
            vec!["push", "bracket.csv", "--bender", "ten-row", "--on", &address, "--journal", "j.db"];
        args.extend(more);
        Command::cargo_bin("benderd").unwrap().current_dir(folder.path()).args(args).output().unwrap()
    };
    let outputs = tokio::task::spawn_blocking(move || (push(&[]), push(&["--approve"]))).await.unwrap();
    assert_eq!(outputs.0.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&outputs.0.stderr).contains("approve the write"));
    assert_eq!(outputs.1.status.code(), Some(0), "{}", String::from_utf8_lossy(&outputs.1.stderr));
}
