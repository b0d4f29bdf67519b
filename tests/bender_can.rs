//! Deliveries over CAN and CANopen: on a bus in memory in simulated time, and where `BENDERD_CAN` names an interface of this computer (a
//! vcan, say) the same once more over the socket; a bus-off and an adapter that is pulled out on the way.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code
#![allow(clippy::print_stdout)] // a test that skips says why, and how long a delivery took

use std::time::Duration;

use benderd::bender::can::{Bus, CanPort, MemoryBus, Socket, open_port};
use benderd::bender::{Bender as _, Job, Link, Operation, Outcome, Profile, Transport, deliver};
use benderd::config::Document;
use benderd::sim::bender::MachineModel;
use benderd::sim::bender_server::SimulatedBender;
use benderd::sim::door::Door;
use benderd::sim::faults::Fault;
use benderd::trial::deliveries::Memory;
use benderd::tube::{CommandRow, CommandTable};
use tokio::time::Instant;

/// Profiles of every way over a bus.
const WAYS: [(&str, &str, &str); 4] = [
    ("reference-can", "", ""),
    ("reference-can", "fd = false", "fd = true"),
    ("reference-canopen", "", ""),
    ("reference-canopen", "\"block\"", "\"segmented\""),
];

fn profile((name, from, to): (&str, &str, &str)) -> Profile {
    let text =
        std::fs::read_to_string(format!("{}/protocols/{name}.toml", env!("CARGO_MANIFEST_DIR"))).unwrap();
    Profile::parse(&Document::new("p.toml", text.replacen(from, to, 1))).unwrap()
}

/// Where daemon and machine meet.
#[derive(Clone)]
enum Meeting {
    Memory(MemoryBus),
    Interface(String),
}

impl Meeting {
    fn name(&self) -> &str {
        match self {
            Meeting::Memory(_) => "can0",
            Meeting::Interface(name) => name,
        }
    }

    fn link(&self, profile: &Profile) -> Link {
        match self.clone() {
            Meeting::Interface(name) => Link::new(profile.clone(), name).unwrap(),
            Meeting::Memory(bus) => {
                let open = move |name: &str| Ok(Box::new(bus.join(name)?) as Box<dyn Bus>);
                Link::on_bus(profile.clone(), self.name(), Box::new(open)).unwrap()
            }
        }
    }

    fn machine_port(&self, fd: bool) -> CanPort {
        let patience = Duration::from_secs(1);
        match self {
            Meeting::Memory(bus) => CanPort::new(Box::new(bus.join("machine").unwrap()), "machine", patience),
            Meeting::Interface(name) => open_port(name, None, fd, patience).unwrap(),
        }
    }
}

/// A machine on the bus, until it is dropped.
fn machine(meeting: &Meeting, profile: &Profile, fault: Option<Fault>) -> SimulatedBender {
    let fd = matches!(&profile.transport, Transport::Can(can) if can.fd);
    let place = meeting.clone();
    let door =
        Door::Bus(Box::new(move || Ok(place.machine_port(fd))), "bus".into(), Box::new(profile.clone()));
    SimulatedBender::start(door, MachineModel::new(profile.clone(), "P1", 3), fault, |_| ()).unwrap()
}

fn job(length_mm: f64) -> Job {
    let row = CommandRow { length_mm, rotation_rad: -0.5, angle_rad: 1.25 };
    let table = CommandTable { bends: vec![row; 3], last_length_mm: 50.0 };
    Job { program: "P1".into(), table, expected_active: None, operation: Operation::New, approved: false }
}

/// One delivery after the other; the second is the table in force when the machine says so.
async fn deliveries(meeting: Meeting, way: (&str, &str, &str)) {
    let profile = profile(way);
    let machine = machine(&meeting, &profile, None);
    let mut link = meeting.link(&profile);
    for (revision, length_mm) in [(1, 100.0), (2, 120.5)] {
        let mut log = Memory::default();
        let begun = Instant::now();
        let outcome = deliver(&mut link, &job(length_mm), &mut log).await;
        assert!(matches!(outcome, Outcome::Applied(_)), "{way:?}: {outcome:?}");
        assert_eq!((machine.with(|m| m.active()).revision, log.intents.len()), (revision, 1));
        let active = link.read_active().await.unwrap();
        assert_eq!(active.payload, machine.with(|m| m.active_payload()));
        println!("{} {}: a table of 3 bends in {} ms", way.0, way.2, begun.elapsed().as_millis());
    }
    let outcome = deliver(&mut link, &job(120.5), &mut Memory::default()).await;
    assert!(matches!(outcome, Outcome::AlreadyActive(_)), "{outcome:?}");
}

#[tokio::test(start_paused = true)]
async fn tables_arrive_over_a_bus_in_memory() {
    for way in WAYS {
        deliveries(Meeting::Memory(MemoryBus::new()), way).await;
    }
}

#[tokio::test(start_paused = true)]
async fn machines_on_one_bus_get_their_own_tables() {
    let meeting = Meeting::Memory(MemoryBus::new());
    let profiles =
        [profile(WAYS[2]), profile(("reference-canopen", "node = 5 ", "node = 6 ")), profile(WAYS[0])];
    let machines = profiles.each_ref().map(|profile| machine(&meeting, profile, None));
    let [mut a, mut b, mut c] = profiles.each_ref().map(|profile| meeting.link(profile));
    let [first, second, third] = [100.0, 200.0, 300.0].map(job);
    let [mut log_a, mut log_b, mut log_c] = [(), (), ()].map(|()| Memory::default());
    let outcomes = tokio::join!(
        deliver(&mut a, &first, &mut log_a),
        deliver(&mut b, &second, &mut log_b),
        deliver(&mut c, &third, &mut log_c),
    );
    assert!(
        matches!(outcomes, (Outcome::Applied(_), Outcome::Applied(_), Outcome::Applied(_))),
        "{outcomes:?}"
    );
    let lengths = machines.map(|m| m.with(|m| m.active_table()).unwrap().bends[0].length_mm);
    assert_eq!(lengths, [100.0, 200.0, 300.0]);
}

#[tokio::test]
async fn tables_arrive_over_an_interface() {
    let Ok(name) = std::env::var("BENDERD_CAN") else {
        println!(
            "skipped: BENDERD_CAN names no CAN interface (`ip link add dev vcan0 type vcan mtu 72`, `ip link set vcan0 up`)"
        );
        return;
    };
    for way in WAYS {
        if way.2 == "fd = true" && Socket::open(&name, true).is_err() {
            println!("skipped: {name} carries no CAN FD");
            continue;
        }
        deliveries(Meeting::Interface(name.clone()), way).await;
    }
}

#[tokio::test(start_paused = true)]
async fn a_commit_whose_echo_is_lost_is_found_out_by_reading() {
    for (name, from, to) in [WAYS[0], WAYS[2]] {
        let profile = profile((name, from, to));
        for (fault, applied) in [(Fault::DropAfterApply, true), (Fault::DropBeforeApply, false)] {
            let meeting = Meeting::Memory(MemoryBus::new());
            let machine = machine(&meeting, &profile, Some(fault));
            let mut log = Memory::default();
            let outcome = deliver(&mut meeting.link(&profile), &job(100.0), &mut log).await;
            assert_eq!(matches!(outcome, Outcome::Applied(_)), applied, "{name}: {outcome:?}");
            assert_eq!(matches!(outcome, Outcome::NotApplied { .. }), !applied, "{name}: {outcome:?}");
            assert_eq!((machine.with(|m| m.active()).revision == 1, log.intents.len()), (applied, 1));
        }
    }
}

#[tokio::test(start_paused = true)]
async fn after_bus_off_and_after_an_adapter_was_pulled_out_the_link_comes_back() {
    for way in [WAYS[0], WAYS[2]] {
        let profile = profile(way);
        let bus = MemoryBus::new();
        let meeting = Meeting::Memory(bus.clone());
        let _machine = machine(&meeting, &profile, None);
        let mut link = meeting.link(&profile);
        link.read_status().await.unwrap();
        bus.bus_off("can0");
        let text = link.read_status().await.unwrap_err().to_string();
        assert!(text.contains("can0 is bus-off"), "{text}");
        bus.restart("can0");
        come_back(&mut link).await;
        bus.vanish("can0");
        let text = link.read_status().await.unwrap_err().to_string();
        assert!(text.contains("No such device"), "{text}");
        bus.reappear("can0");
        come_back(&mut link).await;
        let outcome = deliver(&mut link, &job(100.0), &mut Memory::default()).await;
        assert!(matches!(outcome, Outcome::Applied(_)), "{way:?}: {outcome:?}");
    }
}

/// The link's waits between attempts are over within a few seconds.
async fn come_back(link: &mut Link) {
    for _ in 0..10 {
        if link.read_status().await.is_ok() {
            return;
        }
        tokio::time::advance(Duration::from_secs(1)).await;
    }
    panic!("the link does not come back");
}

#[tokio::test(start_paused = true)]
async fn another_machine_on_the_bus_is_not_written_to() {
    let mut other = profile(WAYS[0]);
    other.identification = 0x4F54_4852;
    let meeting = Meeting::Memory(MemoryBus::new());
    let machine = machine(&meeting, &other, None);
    let outcome = deliver(&mut meeting.link(&profile(WAYS[0])), &job(100.0), &mut Memory::default()).await;
    assert!(format!("{outcome:?}").contains("not this machine"), "{outcome:?}");
    assert!(machine.with(|m| m.staging_is_empty()));
}
