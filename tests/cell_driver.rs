//! The cell's driver over a real socket: the simulated bender answers on 127.0.0.1, measuring is stood in for by a
//! script, so that these tests are about what the driver does with results, not about the results.

#![allow(clippy::unwrap_used, clippy::expect_used)] // clippy does not count the helpers of an integration test as test code

use std::path::PathBuf;
use std::sync::Mutex;
use std::time::Duration;

use benderd::arm::{ArmError, Filing, FolderSettings, ScanFile, ScanSource, WatchedFolder};
use benderd::bender::{Link, Profile};
use benderd::cell::{Command, Craft, Decision, Driver, Dwell, Identity, Notice, Part, State};
use benderd::config::Mode;
use benderd::correct::{Answer, Code, Reason, Verdict};
use benderd::journal::{Journal, Record};
use benderd::sim::bender::MachineModel;
use benderd::sim::bender_server::SimulatedBender;
use benderd::sim::door::Door;
use benderd::sim::faults::Fault;
use benderd::sim::frames::Framing;
use benderd::tube::{CommandRow, CommandTable, MeasuredTube};
use tokio::net::TcpListener;
use tokio::sync::{broadcast, mpsc};

const PROGRAM: &str = "bracket";

/// Verdicts one after the other; every scan measures well unless it holds the word "cube".
struct Script(Mutex<Vec<Verdict>>);

fn table(angle_deg: f64) -> CommandTable {
    let row = CommandRow { length_mm: 50.0, rotation_rad: 0.0, angle_rad: angle_deg.to_radians() };
    CommandTable { bends: vec![row], last_length_mm: 100.0 }
}

impl Craft for Script {
    fn measure(&self, scan: &ScanFile) -> Result<MeasuredTube, String> {
        match std::fs::read_to_string(&scan.path) {
            Ok(text) if !text.contains("cube") => {
                let json = r#"{"tube_radius_mm": 5.0, "last_length_mm": 100.0, "bends": []}"#;
                serde_json::from_str(json).map_err(|e| e.to_string())
            }
            other => Err(format!("no tube in {other:?}")),
        }
    }

    fn decide(&self, parts: &[Part]) -> Decision {
        let verdict = self.0.lock().unwrap().remove(0);
        let answer = Answer {
            verdict,
            commanded: table(90.0 + parts.len() as f64),
            springback_deg: Vec::new(),
            springback_sigma_deg: Vec::new(),
            predicted: None,
            reasons: vec![Reason::new(Code::Scatter, "as scripted")],
        };
        Decision { answer, inspection: None }
    }
}

/// A cell with its driver running, and everything around it.
struct Cell {
    dir: tempfile::TempDir,
    bender: SimulatedBender,
    notices: broadcast::Receiver<Notice>,
    commands: mpsc::Sender<Command>,
    task: tokio::task::JoinHandle<()>,
}

async fn cell(mode: Mode, fault: Option<Fault>, verdicts: &[Verdict]) -> Cell {
    let dir = tempfile::tempdir().unwrap();
    let profile = Profile::load("reference-modbus").unwrap();
    let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
    let model = MachineModel::new(profile.clone(), PROGRAM, 1);
    let bender = SimulatedBender::start(Door::Socket(Framing::Tcp, listener), model, fault, |_| {}).unwrap();
    let settings = FolderSettings {
        poll: Duration::from_millis(5),
        settle_time: Duration::from_millis(20),
        ..FolderSettings::new(dir.path().join("scans"))
    };
    let source = WatchedFolder::open(settings).await.unwrap();
    let journal = || Journal::open(&dir.path().join("journal.db")).unwrap();
    let identity = Identity { name: "b1".into(), program: PROGRAM.into(), mode, dwell: Dwell::default() };
    let link = Link::new(profile, bender.address().to_string()).unwrap();
    let craft = Script(Mutex::new(verdicts.to_vec()));
    let driver = Driver::new(identity, link, source, craft, [journal(), journal()]).unwrap();
    let notices = driver.listen();
    let (commands, receiver) = mpsc::channel(1);
    let task = tokio::spawn(driver.run(receiver));
    Cell { dir, bender, notices, commands, task }
}

impl Cell {
    async fn until(&mut self, wanted: impl Fn(&State) -> bool) -> State {
        let seen = async {
            loop {
                if let Notice::State(state) = self.notices.recv().await.unwrap()
                    && wanted(&state)
                {
                    return state;
                }
            }
        };
        tokio::time::timeout(Duration::from_secs(60), seen).await.expect("the state is reached")
    }

    async fn arm(&mut self) {
        self.until(|s| *s == State::Disarmed).await;
        self.commands.send(Command::Arm).await.unwrap();
    }

    fn put(&self, name: &str, text: &str) {
        std::fs::write(self.dir.path().join("scans").join(name), text).unwrap();
    }

    fn exists(&self, path: &str) -> bool {
        self.dir.path().join("scans").join(path).exists()
    }

    fn revision(&self) -> u32 {
        self.bender.with(|m| m.active().revision)
    }

    /// Stops the driver; the kinds of the machine's journal records in order, state changes left out.
    async fn stop(self) -> Vec<Record> {
        drop(self.commands);
        self.task.await.unwrap();
        let journal = Journal::open(&self.dir.path().join("journal.db")).unwrap();
        journal.verify().unwrap();
        journal.list(0, 1000).unwrap().into_iter().filter(|r| r.kind != "state").collect()
    }
}

fn kinds(records: &[Record]) -> Vec<&str> {
    records.iter().map(|r| r.kind.as_str()).collect()
}

#[tokio::test]
async fn armed_it_delivers_corrects_and_keeps_the_table_of_a_good_part() {
    let mut cell =
        cell(Mode::Automatic, None, &[Verdict::FirstPiece, Verdict::Correct, Verdict::InTolerance]).await;
    cell.arm().await;
    cell.until(|s| *s == State::Ready).await;
    cell.put("one.ply", "a tube");
    cell.until(|s| *s == State::Ready).await;
    assert_eq!(cell.revision(), 2);
    cell.put("two.ply", "a tube");
    cell.until(|s| *s == State::InTolerance).await;
    assert_eq!(cell.revision(), 2);
    let angle = cell.bender.with(|m| m.active_table()).unwrap().bends[0].angle_rad.to_degrees();
    assert!((angle - 91.0).abs() < 1e-9);
    assert!(cell.exists("done/one.ply"));
    let records = cell.stop().await;
    let expected = [
        "decision",
        "intent",
        "outcome", // first piece
        "scan",
        "measurement",
        "decision",
        "intent",
        "outcome", // corrected
        "scan",
        "measurement",
        "decision", // good
    ];
    assert_eq!(kinds(&records), expected);
}

#[tokio::test]
async fn observing_measures_and_decides_and_writes_nothing() {
    let mut cell = cell(Mode::Observe, None, &[Verdict::Correct]).await;
    cell.until(|s| *s == State::Ready).await;
    cell.put("one.ply", "a tube");
    cell.until(|s| matches!(s, State::Deciding(_))).await;
    cell.until(|s| *s == State::Ready).await;
    assert_eq!(cell.revision(), 0);
    assert!(cell.bender.with(|m| m.staging_is_empty()));
    assert_eq!(kinds(&cell.stop().await), ["scan", "measurement", "decision"]);
}

#[tokio::test]
async fn an_unusable_scan_lies_in_failed_with_its_reason_and_the_cell_goes_on() {
    let mut cell = cell(Mode::Automatic, None, &[Verdict::FirstPiece, Verdict::InTolerance]).await;
    cell.arm().await;
    cell.until(|s| *s == State::Ready).await;
    cell.put("one.ply", "a cube");
    cell.until(|s| *s == State::Ready).await;
    cell.put("two.ply", "a tube");
    cell.until(|s| *s == State::InTolerance).await;
    assert!(cell.exists("failed/one.ply"));
    let why = std::fs::read_to_string(cell.dir.path().join("scans/failed/one.ply.txt")).unwrap();
    assert!(why.contains("no tube in"), "{why}");
    assert!(kinds(&cell.stop().await).contains(&"refusal"));
}

#[tokio::test]
async fn scans_from_before_the_table_are_set_aside() {
    let mut cell = cell(Mode::Automatic, None, &[Verdict::FirstPiece]).await;
    cell.put("old.ply", "a tube");
    cell.arm().await;
    cell.until(|s| *s == State::Ready).await;
    assert!(cell.exists("failed/old.ply"));
    assert_eq!(kinds(&cell.stop().await), ["decision", "intent", "outcome"]);
}

#[tokio::test]
async fn a_machine_that_says_no_holds_the_cell_with_the_reason() {
    for (fault, expected) in [
        (Fault::OtherBends, "the loaded program's 2"),
        (Fault::Running, "between parts"),
        (Fault::CorruptStaging, "does not read back"),
        (Fault::OtherProgram, "has program"),
    ] {
        let mut cell = cell(Mode::Automatic, Some(fault), &[Verdict::FirstPiece]).await;
        cell.arm().await;
        let state = cell.until(|s| matches!(s, State::Held(_))).await;
        assert!(state.to_string().contains(expected), "{fault:?}: {state}");
        assert_eq!(cell.revision(), 0, "{fault:?}");
        assert!(!kinds(&cell.stop().await).contains(&"intent"), "{fault:?}");
    }
}

#[tokio::test]
async fn a_silent_machine_faults_the_cell() {
    let mut cell = cell(Mode::Automatic, Some(Fault::Silent), &[]).await;
    let state = cell.until(|s| matches!(s, State::Faulted(_))).await;
    assert!(state.to_string().contains("no answer within"), "{state}");
}

/// Each answer takes 300 ms: the cell is disarmed long before the commit.
#[tokio::test]
async fn a_delivery_that_is_disarmed_on_its_way_is_not_committed() {
    let mut cell = cell(Mode::Automatic, Some(Fault::Late { ms: 300 }), &[Verdict::FirstPiece]).await;
    cell.arm().await;
    cell.until(|s| matches!(s, State::Delivering(_))).await;
    cell.commands.send(Command::Disarm).await.unwrap();
    cell.until(|s| *s == State::Disarmed).await;
    assert_eq!(cell.revision(), 0);
    let records = cell.stop().await;
    assert!(!kinds(&records).contains(&"intent"), "{:?}", kinds(&records));
    let outcome = records.iter().find(|r| r.kind == "outcome").unwrap();
    assert!(outcome.content.contains("disarmed") && outcome.content.contains("not_applied"), "{outcome:?}");
}

#[tokio::test]
async fn a_commit_whose_answer_is_lost_is_found_to_be_applied_and_sent_once() {
    let mut cell = cell(Mode::Automatic, Some(Fault::DropAfterApply), &[Verdict::FirstPiece]).await;
    cell.arm().await;
    cell.until(|s| *s == State::Ready).await;
    assert_eq!(cell.revision(), 1);
    assert_eq!(kinds(&cell.stop().await), ["decision", "intent", "outcome"]);
}

#[tokio::test]
async fn an_intent_without_an_end_is_closed_by_what_the_machine_holds() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("journal.db");
    let mut journal = Journal::open(&path).unwrap();
    // What a daemon that was killed between commit and read-back leaves behind.
    let intent = r#"{"machine": "b1", "intent": {"new": {"revision": 7, "crc": 9}}}"#;
    journal.append(1, "intent", intent).unwrap();
    let profile = Profile::load("reference-modbus").unwrap();
    let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
    let model = MachineModel::new(profile.clone(), PROGRAM, 1);
    let bender = SimulatedBender::start(Door::Socket(Framing::Tcp, listener), model, None, |_| {}).unwrap();
    let identity = Identity {
        name: "b1".into(),
        program: PROGRAM.into(),
        mode: Mode::Automatic,
        dwell: Dwell::default(),
    };
    let link = Link::new(profile, bender.address().to_string()).unwrap();
    let open = || Journal::open(&path).unwrap();
    let driver =
        Driver::new(identity, link, NoScans, Script(Mutex::new(Vec::new())), [open(), open()]).unwrap();
    let mut notices = driver.listen();
    let (commands, receiver) = mpsc::channel(1);
    let task = tokio::spawn(driver.run(receiver));
    while !matches!(notices.recv().await.unwrap(), Notice::State(State::Disarmed)) {}
    drop(commands);
    task.await.unwrap();
    let last = open().list(0, 100).unwrap().into_iter().find(|r| r.kind == "resolution").unwrap();
    let content: serde_json::Value = serde_json::from_str(&last.content).unwrap();
    assert_eq!((&content["applied"], &content["intended"]["revision"]), (&false.into(), &7.into()));
}

/// An arm that never scans.
struct NoScans;

impl ScanSource for NoScans {
    async fn next(&mut self) -> Result<ScanFile, ArmError> {
        std::future::pending().await
    }

    async fn file(&mut self, _: &ScanFile, _: Filing<'_>) -> Result<(), ArmError> {
        Ok(())
    }

    async fn set_aside(&mut self, _: &str) -> Result<usize, ArmError> {
        Ok(0)
    }
}

/// An arm whose one scan cannot be filed away.
struct Stuck;

impl ScanSource for Stuck {
    async fn next(&mut self) -> Result<ScanFile, ArmError> {
        Ok(ScanFile { path: PathBuf::from("/nowhere/scan.ply"), bytes: 1 })
    }

    async fn file(&mut self, scan: &ScanFile, _: Filing<'_>) -> Result<(), ArmError> {
        let source = std::io::Error::from(std::io::ErrorKind::PermissionDenied);
        Err(ArmError::Io { path: scan.path.display().to_string(), what: "be moved", source })
    }

    async fn set_aside(&mut self, _: &str) -> Result<usize, ArmError> {
        Ok(0)
    }
}

#[tokio::test]
async fn a_scan_that_cannot_be_filed_away_is_not_taken_twice() {
    let dir = tempfile::tempdir().unwrap();
    let profile = Profile::load("reference-modbus").unwrap();
    let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
    let model = MachineModel::new(profile.clone(), PROGRAM, 1);
    let bender = SimulatedBender::start(Door::Socket(Framing::Tcp, listener), model, None, |_| {}).unwrap();
    let identity =
        Identity { name: "b1".into(), program: PROGRAM.into(), mode: Mode::Observe, dwell: Dwell::default() };
    let link = Link::new(profile, bender.address().to_string()).unwrap();
    let open = || Journal::open(&dir.path().join("journal.db")).unwrap();
    let driver =
        Driver::new(identity, link, Stuck, Script(Mutex::new(Vec::new())), [open(), open()]).unwrap();
    let mut notices = driver.listen();
    let (_commands, receiver) = mpsc::channel(1);
    tokio::spawn(driver.run(receiver));
    loop {
        if let Notice::State(State::Held(hold)) = notices.recv().await.unwrap() {
            let reason = hold.reason;
            assert!(
                reason.contains("cannot be filed away") && reason.contains("/nowhere/scan.ply"),
                "{reason}"
            );
            break;
        }
    }
    let scans = open().list(0, 100).unwrap().into_iter().filter(|r| r.kind == "scan").count();
    assert_eq!(scans, 1);
}
