//! The Modbus link on lines: late answers, echoes, garbage; deliveries over a line in memory, a pseudo terminal and a device server.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use benderd::bender::{
    Bender as _, Device, Job, Link, LinkError, Operation, Outcome, Profile, TableId, Transport, Wire, deliver,
};
use benderd::sim::bender::MachineModel;
use benderd::sim::bender_server::SimulatedBender;
use benderd::sim::door::{Door, Speech};
use benderd::sim::faults::Fault;
use benderd::sim::frames::Framing;
use benderd::sim::pty::machine_end;
use benderd::sim::reply_fault::ReplyFault;
use benderd::sim::trouble::WireFaults;
use benderd::trial::deliveries::{Ending, Memory, Totals, in_memory, real, run};
use benderd::tube::{CommandRow, CommandTable};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, DuplexStream, duplex};
use tokio::sync::mpsc;
use tokio_modbus::Slave;
use tokio_modbus::client::{Reader as _, rtu};

const REQUEST_MS: u64 = 300;
const QUIET_MS: u64 = 500;

/// Four registers a request.
fn profile() -> Profile {
    let mut profile = Profile::load("reference-rtu").unwrap();
    profile.deadlines.request = Duration::from_millis(REQUEST_MS);
    let Transport::ModbusRtu(Device::Staged(map), ..) = &mut profile.transport else { panic!() };
    map.max_read_registers = 4;
    profile
}

fn link(profile: Profile, wire: DuplexStream) -> Link {
    let mut wire = Some(wire);
    let open = move || Ok(Box::new(wire.take().unwrap()) as Box<dyn Wire>);
    Link::over(profile, "a line in memory", Box::new(open)).unwrap()
}

/// A machine at the end of a wire in memory, whose staging area holds its own addresses; what happens to its answers.
fn machine(wire: DuplexStream, faults: &[Option<ReplyFault>]) -> SimulatedBender {
    let mut model = MachineModel::new(profile(), "P1", 3);
    model.write(1000, &(1000..1100).collect::<Vec<u16>>()).unwrap();
    let (tell, wires) = mpsc::unbounded_channel();
    tell.send(wire).unwrap();
    let bender =
        SimulatedBender::start(Door::Memory(Speech::Modbus(Framing::Rtu), wires), model, None, |_| ())
            .unwrap();
    bender.set_wire_faults(Some(WireFaults::script(faults.iter().copied())));
    bender
}

fn late(ms: u64) -> Option<ReplyFault> {
    Some(ReplyFault::Late { ms })
}

fn words(bytes: &[u8]) -> Vec<u16> {
    bytes.chunks_exact(2).map(|p| u16::from_be_bytes([p[0], p[1]])).collect()
}

/// Why lines need the silence and the emptied input: the library takes the late answer for the next one, without an error. When it
/// no longer does, this test says so.
#[tokio::test(start_paused = true)]
async fn the_library_alone_takes_a_late_answer_for_the_next_one() {
    let (here, there) = duplex(4096);
    let _machine = machine(there, &[late(REQUEST_MS + 100)]);
    let mut client = rtu::attach_slave(here, Slave(1));
    let first = client.read_holding_registers(1000, 4);
    assert!(tokio::time::timeout(Duration::from_millis(REQUEST_MS), first).await.is_err());
    let second = client.read_holding_registers(2000, 4).await.unwrap().unwrap();
    assert_eq!(second, [1000, 1001, 1002, 1003], "asked were 2000 to 2003, which are all 0");
}

/// The same line: what was late is thrown away, and the request repeated.
#[tokio::test(start_paused = true)]
async fn a_late_answer_is_never_taken_for_the_next_one() {
    // Up to the last moment in which the silence lasts.
    for late_ms in [REQUEST_MS + 1, REQUEST_MS + 100, REQUEST_MS + QUIET_MS - 1] {
        let (here, there) = duplex(4096);
        let _machine = machine(there, &[late(late_ms), None, late(late_ms)]);
        let mut link = link(profile(), here);
        let staging = link.read_staging(24).await.unwrap();
        assert_eq!(words(&staging), (1000..1012).collect::<Vec<u16>>(), "{late_ms} ms");
    }
}

/// An answer that comes when the next request is out already is that one's, as far as anybody can tell: what is lost after that
/// must be less than what `quiet_ms` promises.
#[tokio::test(start_paused = true)]
async fn nothing_is_sent_before_the_silence_is_over() {
    let (here, mut there) = duplex(4096);
    let asked = tokio::spawn(async move {
        let (mut times, mut bytes) = (Vec::new(), [0; 256]);
        while let Ok(1..) = there.read(&mut bytes).await {
            times.push(tokio::time::Instant::now());
        }
        times
    });
    let mut link = link(profile(), here);
    let error = link.read_staging(8).await.unwrap_err();
    assert!(matches!(error, LinkError::Timeout { .. }), "{error}");
    drop(link);
    let times = asked.await.unwrap();
    let apart: Vec<u128> = times.windows(2).map(|w| (w[1] - w[0]).as_millis()).collect();
    assert_eq!(apart, [800, 800], "once and twice more, each after the deadline and the silence");
}

#[tokio::test(start_paused = true)]
async fn a_call_that_is_cancelled_leaves_the_line_silent_too() {
    let (here, there) = duplex(4096);
    let _machine = machine(there, &[late(100)]);
    let mut link = link(profile(), here);
    let begun = tokio::time::Instant::now();
    assert!(tokio::time::timeout(Duration::from_millis(50), link.read_staging(8)).await.is_err());
    assert_eq!(words(&link.read_staging(8).await.unwrap()), [1000, 1001, 1002, 1003]);
    assert!(begun.elapsed() >= Duration::from_millis(50 + QUIET_MS), "{:?}", begun.elapsed());
}

/// Many machines serve one connection at a time: a stream that is given up is closed, and not only when the next one is opened.
#[tokio::test(start_paused = true)]
async fn a_stream_is_closed_when_it_is_given_up_also_when_nobody_looked_in_time() {
    let (here, mut there) = duplex(4096);
    let closed = tokio::spawn(async move {
        // Header, function, address, count.
        let mut bytes = [0; 12];
        there.read_exact(&mut bytes).await.unwrap();
        there.read(&mut bytes).await
    });
    let mut link = link(Profile::load("reference-modbus").unwrap(), here);
    // Cancelled, and its deadline passes unseen.
    assert!(tokio::time::timeout(Duration::from_millis(50), link.read_staging(8)).await.is_err());
    tokio::time::advance(Duration::from_secs(2)).await;
    let error = link.commit(TableId { revision: 1, crc: 7 }).await.unwrap_err();
    assert!(matches!(error, LinkError::Outdated { .. }), "{error}");
    let closed = tokio::time::timeout(Duration::from_secs(5), closed).await;
    assert!(matches!(closed, Ok(Ok(Ok(0)))), "{closed:?}");
}

#[tokio::test(start_paused = true)]
async fn a_line_with_an_echo_works_when_the_profile_says_so() {
    let (here, mut line) = duplex(4096);
    let (to_and_from, there) = duplex(4096);
    let _machine = machine(there, &[]);
    tokio::spawn(async move {
        let (mut from_machine, mut to_machine) = tokio::io::split(to_and_from);
        let (mut request, mut answer) = ([0; 256], [0; 256]);
        while let Ok(count @ 1..) = line.read(&mut request).await {
            line.write_all(&request[..count]).await.unwrap();
            to_machine.write_all(&request[..count]).await.unwrap();
            let count = from_machine.read(&mut answer).await.unwrap();
            line.write_all(&answer[..count]).await.unwrap();
        }
    });
    let mut profile = profile();
    let Transport::ModbusRtu(_, settings, _) = &mut profile.transport else { panic!() };
    settings.echo = true;
    let staging = link(profile, here).read_staging(8).await.unwrap();
    assert_eq!(words(&staging), [1000, 1001, 1002, 1003]);
}

/// 400 seeds with every tenth answer damaged, and trouble at the machine; `examples/deliveries` runs more.
#[test]
fn whatever_a_wire_does_the_table_is_whole_and_the_record_true() {
    for profile in ["reference-rtu", "reference-modbus", "reference-serial"] {
        campaign(&Profile::load(profile).unwrap(), 400);
    }
    campaign(&Profile::load("reference-folder").unwrap(), 50); // its files are real
}

fn campaign(profile: &Profile, count: u64) {
    let (mut totals, folder) = (Totals::default(), tempfile::tempdir().unwrap());
    for seed in 1..=count {
        let runtime =
            tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build().unwrap();
        let case = runtime
            .block_on(async { run(seed, 100, profile, in_memory(profile, folder.path()).unwrap()).await });
        totals.add(seed, case.unwrap());
    }
    assert!(totals.wrong.is_empty(), "{totals}: {:?}", totals.wrong);
    assert!(totals.endings[&Ending::Applied] as u64 > count / 2, "{totals}");
    assert!(totals.endings.len() >= 3, "nearly every ending came about: {totals}");
}

/// Deadlines for a line that answers at once.
fn quick(name: &str) -> Profile {
    let mut profile = Profile::load(name).unwrap();
    profile.deadlines.request = Duration::from_millis(200);
    profile.deadlines.settle_ms = 50;
    profile
}

#[tokio::test]
async fn a_table_is_delivered_through_a_pseudo_terminal() {
    for profile in ["reference-rtu", "reference-serial"] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("line");
        let profile = quick(profile);
        let (ends, kept) = real(&profile, folder.path()).await.unwrap();
        assert_eq!(run(2, 0, &profile, ends).await.unwrap(), Ok(Ending::Applied));
        drop(kept);
        assert!(!path.is_symlink(), "its name is taken away");
    }
}

fn job(length_mm: f64) -> Job {
    let row = CommandRow { length_mm, rotation_rad: 0.0, angle_rad: 1.0 };
    let table = CommandTable { bends: vec![row], last_length_mm: 50.0 };
    Job { program: "P1".into(), table, expected_active: None, operation: Operation::New, approved: false }
}

/// A line and a folder cannot be cut: the machine is heard again, and what became of the commit is found out by reading.
#[tokio::test]
async fn a_commit_that_is_not_answered_on_a_line_or_in_a_folder_is_found_out() {
    for (name, fault, applied) in [
        ("reference-rtu", Fault::DropAfterApply, true),
        ("reference-serial", Fault::DropBeforeApply, false),
        ("reference-folder", Fault::DropAfterApply, true),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let profile = quick(name);
        let (mut ends, _kept) = real(&profile, folder.path()).await.unwrap();
        let model = MachineModel::new(profile, "P1", 1);
        let _bender = SimulatedBender::start(ends.door, model, Some(fault), |_| ()).unwrap();
        let outcome = deliver(&mut ends.link, &job(100.0), &mut Memory::default()).await;
        assert_eq!(matches!(outcome, Outcome::Applied(_)), applied, "{name}: {outcome:?}");
        assert_eq!(matches!(outcome, Outcome::NotApplied { .. }), !applied, "{name}: {outcome:?}");
    }
}

#[tokio::test]
async fn a_table_is_delivered_through_a_folder() {
    let folder = tempfile::tempdir().unwrap();
    let profile = Profile::load("reference-folder").unwrap();
    let (ends, _) = real(&profile, folder.path()).await.unwrap();
    assert_eq!(run(2, 0, &profile, ends).await.unwrap(), Ok(Ending::Applied));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "nothing is left behind");
}

/// Two benders with files in one folder: each gets its own table.
#[tokio::test]
async fn two_machines_share_a_folder() {
    let folder = tempfile::tempdir().unwrap();
    let [one, two] = [1, 2].map(|number| {
        let mut profile = quick("reference-folder");
        profile.transport = Transport::Folder(number);
        profile
    });
    let (mut ends, _kept) = real(&one, folder.path()).await.unwrap();
    let (mut others, _kept) = real(&two, folder.path()).await.unwrap();
    let start = |door, profile| {
        SimulatedBender::start(door, MachineModel::new(profile, "P1", 1), None, |_| ()).unwrap()
    };
    let benders = [start(ends.door, one), start(others.door, two)];
    let [first, second] = [job(100.0), job(200.0)];
    let (mut log, mut other_log) = (Memory::default(), Memory::default());
    let outcomes = tokio::join!(
        deliver(&mut ends.link, &first, &mut log),
        deliver(&mut others.link, &second, &mut other_log)
    );
    assert!(matches!(outcomes, (Outcome::Applied(_), Outcome::Applied(_))), "{outcomes:?}");
    let lengths = benders.map(|b| b.with(|m| m.active_table()).unwrap().bends[0].length_mm);
    assert_eq!(lengths, [100.0, 200.0]);
}

/// What was written to the log.
#[derive(Clone, Default)]
struct Logged(Arc<Mutex<Vec<u8>>>);

impl std::io::Write for Logged {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap().extend(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// What a delivery to such a machine leaves in the log.
async fn logged(level: tracing::Level, fault: Option<Fault>) -> String {
    let (log, folder) = (Logged::default(), tempfile::tempdir().unwrap());
    let writer = log.clone();
    let subscriber = tracing_subscriber::fmt()
        .with_max_level(level)
        .with_ansi(false)
        .with_writer(move || writer.clone())
        .finish();
    let profile = quick("reference-rtu");
    let (mut ends, _kept) = real(&profile, folder.path()).await.unwrap();
    let model = MachineModel::new(profile, "P1", 1);
    let _bender = SimulatedBender::start(ends.door, model, fault, |_| ()).unwrap();
    let _here = tracing::subscriber::set_default(subscriber);
    let outcome = deliver(&mut ends.link, &job(100.0), &mut Memory::default()).await;
    assert_eq!(matches!(outcome, Outcome::Applied(_)), fault.is_none(), "{outcome:?}");
    let text = log.0.lock().unwrap().clone();
    String::from_utf8(text).unwrap()
}

#[tokio::test]
async fn after_a_delivery_that_failed_its_frames_are_in_the_log() {
    // Unit 1 reads (03) from 0; the staging area's first registers are written (10) and come back with a bit flipped.
    let text = logged(tracing::Level::DEBUG, Some(Fault::CorruptStaging)).await;
    for line in [" s > 01 03 00 00 00", " s < 01 03 ", " s > 01 10 03 E8 00", " s < 01 10 03 E8 00"] {
        assert!(text.contains(line), "{line} is not in\n{text}");
    }
    assert!(text.contains("endpoint="), "{text}");
    assert!(!logged(tracing::Level::INFO, Some(Fault::CorruptStaging)).await.contains(" s > "));
    assert!(!logged(tracing::Level::DEBUG, None).await.contains(" s > "), "only after failures");
}

#[tokio::test]
async fn a_table_is_delivered_through_sockets() {
    for profile in ["reference-rtu-over-tcp", "reference-modbus"] {
        let profile = quick(profile);
        let (ends, _) = real(&profile, Path::new("no terminal")).await.unwrap();
        assert_eq!(run(2, 0, &profile, ends).await.unwrap(), Ok(Ending::Applied));
    }
}

#[tokio::test]
async fn a_port_that_another_program_has_open_or_that_cannot_do_rs485_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bender");
    let mut profile = quick("reference-rtu");
    let Transport::ModbusRtu(_, _, settings) = &mut profile.transport else { panic!() };
    let _end = machine_end(&path, settings).unwrap();
    let _other = benderd::bender::serial_port(path.to_str().unwrap(), settings).unwrap();
    let failed = |profile: Profile| {
        let path = path.display().to_string();
        async move { Link::new(profile, path).unwrap().read_status().await.unwrap_err().to_string() }
    };
    let text = failed(profile.clone()).await;
    assert!(text.contains("another program has it open"), "{text}");
    drop(_other);
    let Transport::ModbusRtu(_, _, settings) = &mut profile.transport else { panic!() };
    settings.rs485 = true;
    let text = failed(profile).await;
    assert!(text.contains("serial.rs485 = false"), "{text}");
    assert!(text.contains("bender: cannot connect"), "{text}");
}
