//! A port on the bus in memory: who hears what, no room, bus-off, storms, an adapter that is pulled out.

use std::time::Duration;

use std::future::Future;

use super::*;
use crate::bender::exchange::Port as _;

const PATIENCE: Duration = Duration::from_millis(200);

fn frame(number: u8) -> Frame {
    Frame::new(FrameId::Standard(0x100), [number])
}

fn port(bus: &MemoryBus, interface: &str) -> CanPort {
    CanPort::new(Box::new(bus.join(interface).unwrap()), interface, PATIENCE)
}

async fn error<T>(result: impl Future<Output = std::io::Result<T>>) -> (std::io::ErrorKind, String) {
    let Err(error) = result.await else { panic!("no error") };
    (error.kind(), error.to_string())
}

#[tokio::test(start_paused = true)]
async fn what_one_sends_all_others_receive() {
    let bus = MemoryBus::new();
    let (mut a, mut b, mut c) = (port(&bus, "a"), port(&bus, "b"), port(&bus, "c"));
    a.send(frame(1)).await.unwrap();
    b.send(frame(2)).await.unwrap();
    assert_eq!(c.receive().await.unwrap(), frame(1));
    assert_eq!(c.receive().await.unwrap(), frame(2));
    assert_eq!(a.receive().await.unwrap(), frame(2), "and not its own");
    assert_eq!(b.receive().await.unwrap(), frame(1));
    a.send(frame(3)).await.unwrap();
    b.discard().await.unwrap();
    let nothing = tokio::time::timeout(PATIENCE, b.receive()).await;
    assert!(nothing.is_err(), "thrown away");
    a.send(frame(4)).await.unwrap();
    assert_eq!(b.receive().await.unwrap(), frame(4), "a call that was cancelled loses nothing");
    drop(c);
    let long = Frame::new(FrameId::Standard(1), vec![0; 9]);
    assert_eq!(error(a.send(long)).await.0, std::io::ErrorKind::InvalidInput);
}

#[tokio::test(start_paused = true)]
async fn no_room_is_waited_for_and_no_longer_than_patience() {
    let bus = MemoryBus::new();
    let (mut a, mut b) = (port(&bus, "a"), port(&bus, "b"));
    bus.jam("a");
    for number in 0..10 {
        a.send(frame(number)).await.unwrap();
    }
    let begun = tokio::time::Instant::now();
    let (kind, text) = error(a.send(frame(10))).await;
    assert_eq!(kind, std::io::ErrorKind::TimedOut);
    assert!(text.contains("a took no frame for 200 ms: nobody acknowledges"), "{text}");
    assert!(begun.elapsed() >= PATIENCE && begun.elapsed() < PATIENCE * 2);
    // The next one waits, and goes when there is room.
    let (sent, ()) = tokio::join!(a.send(frame(10)), async {
        tokio::time::advance(PATIENCE / 2).await;
        bus.clear("a");
    });
    sent.unwrap();
    for number in 0..=10 {
        assert_eq!(b.receive().await.unwrap(), frame(number));
    }
}

#[tokio::test(start_paused = true)]
async fn bus_off_is_an_error_and_a_restart_its_end() {
    let bus = MemoryBus::new();
    let (mut a, mut b) = (port(&bus, "a"), port(&bus, "b"));
    bus.bus_off("a");
    let (kind, text) = error(a.receive()).await;
    assert_eq!(kind, std::io::ErrorKind::NetworkDown);
    assert!(text.contains("a is bus-off") && text.contains("restart-ms"), "{text}");
    b.send(frame(1)).await.unwrap();
    bus.restart("a");
    b.send(frame(2)).await.unwrap();
    assert_eq!(a.receive().await.unwrap(), frame(2));
    // Seen before a request: an error while it lasts, none when it is over.
    bus.bus_off("a");
    assert!(error(a.discard()).await.1.contains("bus-off"));
    bus.bus_off("a");
    bus.restart("a");
    a.discard().await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn errors_on_the_bus_are_no_frames_and_no_end() {
    let bus = MemoryBus::new();
    let (mut a, mut b) = (port(&bus, "a"), port(&bus, "b"));
    for _ in 0..500 {
        bus.disturb("a", Condition::Noise(0x80));
        bus.disturb("a", Condition::ErrorPassive);
    }
    assert!(tokio::time::timeout(PATIENCE, a.receive()).await.is_err());
    b.send(frame(1)).await.unwrap();
    assert_eq!(a.receive().await.unwrap(), frame(1));
}

#[tokio::test(start_paused = true)]
async fn an_adapter_that_is_pulled_out_is_an_error_until_it_is_opened_anew() {
    let bus = MemoryBus::new();
    let (mut a, mut b) = (port(&bus, "a"), port(&bus, "b"));
    let (gone, ()) = tokio::join!(error(a.receive()), async {
        tokio::task::yield_now().await;
        bus.vanish("a");
    });
    assert!(gone.1.contains("No such device"), "{gone:?}");
    assert!(error(a.send(frame(1))).await.1.contains("No such device"));
    assert!(bus.join("a").is_err());
    bus.reappear("a");
    assert!(error(a.send(frame(1))).await.1.contains("No such device"), "the old node is no more");
    port(&bus, "a").send(frame(2)).await.unwrap();
    assert_eq!(b.receive().await.unwrap(), frame(2));
}

#[tokio::test(start_paused = true)]
async fn who_does_not_listen_loses_frames_and_holds_nobody_up() {
    let bus = MemoryBus::new();
    let (mut a, mut b) = (port(&bus, "a"), port(&bus, "b"));
    for number in 0..2000_u32 {
        a.send(frame(number as u8)).await.unwrap();
    }
    for number in 0..1000_u32 {
        assert_eq!(b.receive().await.unwrap(), frame(number as u8));
    }
    assert!(tokio::time::timeout(PATIENCE, b.receive()).await.is_err());
}
