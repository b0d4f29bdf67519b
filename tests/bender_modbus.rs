//! The Modbus TCP link over real sockets: whole deliveries, and replies that must not be believed.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

use std::time::Duration;

use benderd::bender::{
    Bender, Device, Job, Link, LinkError, Operation, Outcome, Profile, TableId, Transport, WordOrder, deliver,
};
use benderd::sim::bender::MachineModel;
use benderd::sim::bender_server::SimulatedBender;
use benderd::sim::door::Door;
use benderd::sim::faults::Fault;
use benderd::sim::frames::Framing;
use benderd::trial::deliveries::Memory;
use benderd::tube::{CommandRow, CommandTable};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};

fn profile() -> Profile {
    let mut profile = Profile::load("reference-modbus").unwrap();
    profile.deadlines.request = Duration::from_millis(300);
    profile.deadlines.confirm_ms = 800;
    profile.deadlines.settle_ms = 100;
    profile
}

fn job(bends: usize) -> Job {
    let row = |i| CommandRow { length_mm: 20.0 + i as f64, rotation_rad: -0.5, angle_rad: 1.0 };
    let table = CommandTable { bends: (0..bends).map(row).collect(), last_length_mm: 70.0 };
    Job { program: "P1".into(), table, expected_active: None, operation: Operation::New, approved: false }
}

async fn bender(profile: &Profile, bends: u16, fault: Option<Fault>) -> SimulatedBender {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let model = MachineModel::new(profile.clone(), "P1", bends);
    SimulatedBender::start(Door::Socket(Framing::Tcp, listener), model, fault, |_| ()).unwrap()
}

fn link(profile: Profile, to: &SimulatedBender) -> Link {
    Link::new(profile, to.address().to_string()).unwrap()
}

#[tokio::test]
async fn a_table_is_delivered_whatever_the_word_order_and_the_size_of_requests() {
    for order in [WordOrder::Abcd, WordOrder::Cdab, WordOrder::Badc, WordOrder::Dcba] {
        for limit in [4, 10, 100, 122] {
            let mut profile = profile();
            profile.table.word_order = order;
            let Transport::ModbusTcp(Device::Staged(map)) = &mut profile.transport else { panic!() };
            map.max_write_registers = limit;
            map.max_read_registers = limit.max(36);
            let bender = bender(&profile, 40, None).await;
            let mut log = Memory::default();
            let outcome = deliver(&mut link(profile, &bender), &job(40), &mut log).await;
            assert!(
                matches!(outcome, Outcome::Applied(id) if id.revision == 1),
                "{order:?} {limit}: {outcome:?}"
            );
            let active = bender.with(|m| m.active_table()).unwrap();
            assert_eq!(active.bends.len(), 40);
            assert!((active.bends[39].length_mm - 59.0).abs() < 1e-9);
            assert_eq!((log.intents.len(), log.outcomes), (1, vec![outcome]));
        }
    }
}

#[tokio::test]
async fn the_same_table_is_not_sent_twice() {
    let bender = bender(&profile(), 2, None).await;
    let mut link = link(profile(), &bender);
    let mut log = Memory::default();
    let first = deliver(&mut link, &job(2), &mut log).await;
    let Outcome::Applied(id) = first else { panic!("{first:?}") };
    bender.with(MachineModel::power_cycle);
    assert_eq!(deliver(&mut link, &job(2), &mut log).await, Outcome::AlreadyActive(id));
    assert!(bender.with(|m| m.staging_is_empty()));
    assert_eq!(log.intents.len(), 1);
}

#[tokio::test]
async fn nothing_is_committed_when_the_intent_cannot_be_journalled() {
    let bender = bender(&profile(), 2, None).await;
    let mut log = Memory { full: true, ..Memory::default() };
    let outcome = deliver(&mut link(profile(), &bender), &job(2), &mut log).await;
    assert!(matches!(&outcome, Outcome::NotApplied { why } if why.contains("disk full")), "{outcome:?}");
    assert_eq!(bender.with(|m| m.active_table()), None);
}

#[tokio::test]
async fn a_connection_lost_at_the_commit_is_decided_by_reading() {
    for (fault, applied) in [(Fault::DropAfterApply, true), (Fault::DropBeforeApply, false)] {
        let bender = bender(&profile(), 2, Some(fault)).await;
        let outcome = deliver(&mut link(profile(), &bender), &job(2), &mut Memory::default()).await;
        assert_eq!(matches!(outcome, Outcome::Applied(_)), applied, "{outcome:?}");
        assert_eq!(matches!(outcome, Outcome::NotApplied { .. }), !applied, "{outcome:?}");
        assert_eq!(bender.with(|m| m.active_table()).is_some(), applied);
    }
}

#[tokio::test]
async fn a_machine_that_falls_silent_at_the_commit_leaves_the_outcome_unknown() {
    let bender = bender(&profile(), 2, Some(Fault::SilentAfterCommit)).await;
    let mut log = Memory::default();
    let outcome = deliver(&mut link(profile(), &bender), &job(2), &mut log).await;
    assert!(matches!(&outcome, Outcome::Unknown { why } if why.contains("no answer")), "{outcome:?}");
    assert_eq!(log.outcomes, [outcome]);
}

#[tokio::test]
async fn a_bit_flipped_in_the_staging_area_is_found_before_the_commit() {
    let bender = bender(&profile(), 2, Some(Fault::CorruptStaging)).await;
    let mut log = Memory::default();
    let outcome = deliver(&mut link(profile(), &bender), &job(2), &mut log).await;
    let Outcome::Rejected { reasons } = outcome else { panic!("{outcome:?}") };
    assert_eq!(reasons[0].code, "read_back");
    assert_eq!(log.intents, []);
}

#[tokio::test]
async fn a_foreign_device_is_recognised_by_its_constants() {
    let mut other = profile();
    other.identification = 0x1234_5678;
    let bender = bender(&other, 2, None).await;
    let error = link(profile(), &bender).read_status().await.unwrap_err();
    assert!(matches!(error, LinkError::Nonsense { .. }), "{error}");
    assert!(error.to_string().contains("0x12345678"), "{error}");
}

/// One Modbus TCP request: transaction id and what follows the unit id; None when the other side hung up.
async fn request(stream: &mut TcpStream) -> Option<(u16, Vec<u8>)> {
    let mut header = [0; 7];
    stream.read_exact(&mut header).await.ok()?;
    let mut rest = vec![0; usize::from(u16::from_be_bytes([header[4], header[5]])) - 1];
    stream.read_exact(&mut rest).await.ok()?;
    Some((u16::from_be_bytes([header[0], header[1]]), rest))
}

async fn reply(stream: &mut TcpStream, transaction: u16, pdu: &[u8]) {
    let ([a, b], [c, d]) = (transaction.to_be_bytes(), (pdu.len() as u16 + 1).to_be_bytes());
    let frame = [&[a, b, 0, 0, c, d, 1], pdu].concat();
    let _ = stream.write_all(&frame).await; // the other side may have hung up, which is the point
}

/// A status of 36 registers with this heartbeat.
fn status_pdu(heartbeat: u8) -> Vec<u8> {
    let mut registers = [0; 72];
    registers[..4].copy_from_slice(b"BEND");
    registers[5] = 1;
    registers[7] = heartbeat;
    [&[3, 72], &registers[..]].concat()
}

#[tokio::test]
async fn a_late_answer_is_never_taken_for_the_next_one() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let mut profile = profile();
    profile.deadlines.request = Duration::from_millis(100);
    let mut link = Link::new(profile, listener.local_addr().unwrap().to_string()).unwrap();
    let (timed_out, wait) = tokio::sync::oneshot::channel();
    let server = tokio::spawn(async move {
        let (mut first, _) = listener.accept().await.unwrap();
        let (transaction, _) = request(&mut first).await.unwrap();
        wait.await.unwrap();
        // Too late; the second one has the very transaction id that a request after it would have.
        reply(&mut first, transaction, &status_pdu(1)).await;
        reply(&mut first, transaction + 1, &status_pdu(1)).await;
        let (mut second, _) = listener.accept().await.unwrap();
        let (transaction, _) = request(&mut second).await.unwrap();
        reply(&mut second, transaction, &status_pdu(2)).await;
    });
    let error = link.read_status().await.unwrap_err();
    assert!(matches!(error, LinkError::Timeout { .. }), "{error}");
    timed_out.send(()).unwrap();
    assert_eq!(link.read_status().await.unwrap().heartbeat, 2, "the late answer was taken");
    server.await.unwrap();
}

#[tokio::test]
async fn replies_that_do_not_fit_drop_the_connection_and_the_next_one_is_fine() {
    let fine = status_pdu(1);
    let wrong: Vec<(&str, Vec<u8>)> = vec![
        ("one register less", [&[3, 70], &fine[2..72]].concat()),
        ("two registers more", [&[3, 76], &fine[2..], &[0; 4]].concat()),
        ("a byte less than announced", fine[..73].to_vec()),
        ("an odd number of bytes", [&[3, 71], &fine[2..73]].concat()),
        ("another function", vec![16, 0, 0, 0, 36]),
        ("an exception of another function", vec![0x90, 2]),
        ("no content", vec![3]),
        ("nothing at all", vec![]),
    ];
    for (name, pdu) in wrong {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let mut link = Link::new(profile(), listener.local_addr().unwrap().to_string()).unwrap();
        let server = tokio::spawn(async move {
            let (mut first, _) = listener.accept().await.unwrap();
            let (transaction, _) = request(&mut first).await.unwrap();
            reply(&mut first, transaction, &pdu).await;
            assert!(request(&mut first).await.is_none(), "the connection was used again");
            let (mut second, _) = listener.accept().await.unwrap();
            let (transaction, _) = request(&mut second).await.unwrap();
            reply(&mut second, transaction, &status_pdu(7)).await;
        });
        let error = link.read_status().await.unwrap_err();
        assert!(matches!(error, LinkError::Broken { .. } | LinkError::Timeout { .. }), "{name}: {error}");
        assert_eq!(link.read_status().await.unwrap().heartbeat, 7, "{name}");
        server.await.unwrap_or_else(|e| panic!("{name}: {e}"));
    }
}

#[tokio::test]
async fn busy_is_asked_again_a_few_times_and_then_reported() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let mut link = Link::new(profile(), listener.local_addr().unwrap().to_string()).unwrap();
    let server = tokio::spawn(async move {
        let (mut stream, _) = listener.accept().await.unwrap();
        let mut requests = 0;
        while let Some((transaction, _)) = request(&mut stream).await {
            requests += 1;
            // Three times busy, then an answer; after that busy for ever.
            let answer = if requests == 4 { status_pdu(4) } else { vec![0x83, 6] };
            reply(&mut stream, transaction, &answer).await;
        }
        requests
    });
    assert_eq!(link.read_status().await.unwrap().heartbeat, 4);
    let error = link.read_status().await.unwrap_err();
    assert!(error.to_string().contains("exception 6"), "{error}");
    drop(link);
    assert_eq!(server.await.unwrap(), 8);
}

#[tokio::test]
async fn nobody_there_is_one_clear_error() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    drop(listener);
    let error = Link::new(profile(), &address).unwrap().read_status().await.unwrap_err();
    assert!(matches!(error, LinkError::Connect { .. }), "{error}");
    assert!(error.to_string().contains(&address), "{error}");
}

#[tokio::test]
async fn a_machine_that_is_not_there_is_not_called_without_pause() {
    let address = {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        listener.local_addr().unwrap().to_string()
    };
    let mut profile = profile();
    profile.deadlines.poll_ms = 60_000;
    let mut link = Link::new(profile, &address).unwrap();
    // The first failure may be an idle connection's end: tried again at once.
    for _ in 0..2 {
        let error = link.read_status().await.unwrap_err();
        assert!(matches!(error, LinkError::Connect { .. }), "{error}");
    }
    let error = link.read_status().await.unwrap_err();
    assert!(
        matches!(error, LinkError::Resting { failures: 2, ms: 44_000..=60_000, .. }),
        "{error}: {address} was called again"
    );
}

/// A commit rests on the status read before. When the connection was lost since, it is not sent, on the next one neither.
#[tokio::test]
async fn a_commit_is_not_sent_on_another_connection_than_the_status_before_it() {
    let profile = profile();
    let bender = bender(&profile, 3, None).await;
    let mut link = link(profile, &bender);
    let id = TableId { revision: 1, crc: 7 };
    let outdated = |result| matches!(result, Err(LinkError::Outdated { .. }));
    assert!(outdated(link.commit(id).await), "no status was read yet");
    link.read_status().await.unwrap();
    // A call that is cancelled ends the connection.
    tokio::select! {
        biased;
        answer = link.read_staging(8) => panic!("answered at once: {answer:?}"),
        () = std::future::ready(()) => {}
    }
    assert!(outdated(link.commit(id).await));
    link.read_staging(8).await.unwrap();
    let error = link.commit(id).await.unwrap_err();
    assert!(matches!(error, LinkError::Outdated { .. }), "connected again, not looked again: {error}");
    assert!(error.to_string().contains("writing registers 32 to 35 was not sent"), "{error}");
    link.read_status().await.unwrap();
    link.commit(id).await.unwrap();
}

#[tokio::test]
async fn what_is_another_machine_is_left_alone_until_somebody_has_looked_after_it() {
    let mut other = profile();
    other.identification = 0x4F54_4845;
    let bender = bender(&other, 3, None).await;
    let mut link = link(profile(), &bender);
    let error = link.read_status().await.unwrap_err().to_string();
    assert!(error.contains("register 0 holds 0x4F544845"), "{error}");
    let error = link.read_status().await.unwrap_err();
    assert!(matches!(error, LinkError::Foreign { ms: 50_000..=60_000, .. }), "{error}");
    link.reset();
    let error = link.read_status().await.unwrap_err().to_string();
    assert!(error.contains("register 0 holds 0x4F544845"), "asked again: {error}");
}
