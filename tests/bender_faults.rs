//! What goes wrong at a simulated bender by a script: each event happens at its time, is told, and does what it says.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

use std::sync::mpsc::{Receiver, channel};

use benderd::bender::{Bender as _, Link, LinkError, Profile, Status, TableId};
use benderd::sim::bender::{MachineEvent, MachineModel};
use benderd::sim::bender_server::SimulatedBender;
use benderd::sim::reply_fault::ReplyFault;
use benderd::sim::trouble::{Trouble, When, WireFaults};
use benderd::trial::deliveries::in_memory;
use tempfile::TempDir;
use tokio::time::Duration;

struct Bench {
    link: Link,
    bender: SimulatedBender,
    told: Receiver<MachineEvent>,
    _folder: TempDir,
}

/// A machine in memory to which this happens.
fn bench(profile: &str, events: &[(When, Trouble)]) -> Bench {
    let folder = tempfile::tempdir().unwrap();
    let profile = Profile::load(profile).unwrap();
    let ends = in_memory(&profile, folder.path()).unwrap();
    let (tell, told) = channel();
    let model = MachineModel::new(profile, "P1", 3);
    let bender = SimulatedBender::start(ends.door, model, None, move |event| drop(tell.send(event))).unwrap();
    bender.set_wire_faults(Some(WireFaults::events(events.to_vec())));
    Bench { link: ends.link, bender, told, _folder: folder }
}

impl Bench {
    /// What was told, after another look at the machine so that its next cycle is over.
    async fn told(&mut self) -> Vec<String> {
        tokio::time::timeout(Duration::from_millis(100), std::future::pending::<()>()).await.unwrap_err();
        let trouble = |event| if let MachineEvent::Trouble(what) = event { Some(what) } else { None };
        self.told.try_iter().filter_map(trouble).collect()
    }

    /// The status, when the machine is heard again.
    async fn status(&mut self) -> Status {
        for _ in 0..20 {
            if let Ok(status) = self.link.read_status().await {
                return status;
            }
            tokio::time::timeout(Duration::from_secs(1), std::future::pending::<()>()).await.unwrap_err();
        }
        panic!("not heard again");
    }
}

const LINKS: [&str; 4] = ["reference-modbus", "reference-rtu", "reference-rtu-over-tcp", "reference-serial"];

#[tokio::test(start_paused = true)]
async fn what_happens_to_an_answer_is_got_over() {
    let all = [
        Trouble::Reply(ReplyFault::Lost),
        Trouble::Reply(ReplyFault::Late { ms: 50 }),
        Trouble::Reply(ReplyFault::Twice),
        Trouble::Reply(ReplyFault::Truncated),
        Trouble::Reply(ReplyFault::Corrupted),
        Trouble::Reply(ReplyFault::WrongUnit),
        Trouble::Reply(ReplyFault::Garbage),
        Trouble::Cut { bytes: 0 },
        Trouble::Cut { bytes: 5 },
        Trouble::Busy,
        Trouble::HalfClose,
    ];
    for profile in LINKS {
        for trouble in all {
            let mut bench = bench(profile, &[(When::Answer(2), trouble)]);
            bench.link.read_status().await.unwrap();
            let _ = bench.link.read_status().await; // a stream may fail; a line asks again
            assert_eq!(bench.status().await.program, "P1", "{profile}, {trouble}");
            assert_eq!(bench.told().await, [format!("answer 2: {trouble}")], "{profile}");
        }
    }
}

#[tokio::test(start_paused = true)]
async fn a_busy_machine_does_nothing_and_is_asked_again() {
    for profile in LINKS {
        let mut bench = bench(profile, &[(When::Answer(2), Trouble::Busy)]);
        bench.link.read_status().await.unwrap();
        let refused = bench.link.commit(TableId { revision: 1, crc: 7 }).await.unwrap_err();
        assert!(matches!(refused, LinkError::Busy { .. } | LinkError::Exception { .. }), "{refused}");
        let status = bench.link.read_status().await.unwrap();
        assert_eq!((status.pending.revision, status.ack_revision), (0, 0), "{profile}: the commit was taken");
    }
}

#[tokio::test(start_paused = true)]
async fn what_happens_to_the_machine_stays() {
    for profile in LINKS {
        for when in [When::Answer(2), When::Ms(25)] {
            let after = async |trouble| {
                let mut bench = bench(profile, &[(when, trouble)]);
                bench.link.read_status().await.unwrap();
                let _ = bench.link.read_status().await;
                let told = bench.told().await;
                assert_eq!(told[0], format!("{when}: {trouble}"), "{profile}");
                bench.status().await
            };
            let stopped = after(Trouble::EmergencyStop { bytes: 7 }).await;
            assert_eq!(stopped.state, 0b1011, "{profile}");
            assert_eq!(after(Trouble::Running).await.state, 0b0001, "{profile}");
            assert_eq!(after(Trouble::OtherProgram).await.program, "SOMETHING-ELSE", "{profile}");
            assert_eq!(after(Trouble::Edit).await.active.revision, 1, "{profile}");
            assert_eq!(after(Trouble::Reboot).await.ack_revision, 0, "{profile}");
        }
    }
}

#[tokio::test(start_paused = true)]
async fn a_reboot_at_the_commit_forgets_it_and_its_answer() {
    for profile in LINKS {
        let mut bench = bench(profile, &[(When::Commit, Trouble::Reboot)]);
        bench.bender.with(|m| m.write_staging(0, &[1; 40]));
        bench.link.read_status().await.unwrap();
        assert!(bench.link.commit(TableId { revision: 1, crc: 7 }).await.is_err(), "{profile}");
        assert!(bench.bender.with(|m| m.staging_is_empty()), "{profile}");
        let told = bench.told().await;
        assert_eq!(told, ["commit written: power off and on", "answer 2: lost"], "{profile}");
        assert_eq!(bench.status().await.pending.revision, 0, "{profile}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_frozen_controller_beats_no_more() {
    let mut bench = bench("reference-modbus", &[(When::Ms(10), Trouble::Frozen)]);
    assert_eq!(bench.told().await.len(), 1);
    let before = bench.status().await.heartbeat;
    bench.told().await;
    assert_eq!(bench.status().await.heartbeat, before);
}

#[tokio::test(start_paused = true)]
async fn a_machine_that_leaves_the_bus_is_heard_again() {
    for profile in ["reference-can", "reference-canopen"] {
        let mut bench = bench(profile, &[(When::Answer(2), Trouble::BusOff)]);
        assert_eq!(bench.status().await.program, "P1", "{profile}");
        assert_eq!(bench.status().await.program, "P1", "{profile}");
        assert_eq!(bench.told().await, ["answer 2: bus-off"], "{profile}");
    }
    // What is on no bus does not notice.
    let mut bench = bench("reference-rtu", &[(When::Answer(1), Trouble::BusOff)]);
    assert_eq!(bench.link.read_status().await.unwrap().program, "P1");
}
