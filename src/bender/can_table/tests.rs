//! Tables over CAN: exchanges against the simulated station under a clock turned by hand, on a bus that loses and repeats frames.

use std::collections::VecDeque;

use proptest::prelude::*;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::bender::can::FrameId;
use crate::bender::exchange::{Action, Event, Failure};
use crate::bender::{TableId, Transport, decode_status_image};
use crate::sim::bender::MachineModel;
use crate::sim::can_station::CanStation;
use crate::sim::faults::Fault;
use crate::sim::station::{Controller, Station as _};

const NOTHING: [u8; 0] = [];

/// A machine with its station, a bus that is not what it should be, and a clock turned by hand.
struct Shop {
    profile: Profile,
    model: MachineModel,
    station: CanStation,
    rng: ChaCha8Rng,
    /// Of a thousand frames.
    lost: u32,
    twice: u32,
    fault: Option<Fault>,
    now_ms: u64,
    /// What the daemon sent.
    sent: Vec<Frame>,
}

fn profile(fd: bool) -> Profile {
    let name = "reference-can";
    let text =
        std::fs::read_to_string(format!("{}/protocols/{name}.toml", env!("CARGO_MANIFEST_DIR"))).unwrap();
    let text = if fd { text.replacen("fd = false", "fd = true", 1) } else { text };
    Profile::parse(&crate::config::Document::new("p.toml", text)).unwrap()
}

impl Shop {
    fn new(fd: bool, seed: u64, (lost, twice): (u32, u32)) -> Shop {
        let profile = profile(fd);
        let (model, rng) = (MachineModel::new(profile.clone(), "AB-1", 3), ChaCha8Rng::seed_from_u64(seed));
        let (station, sent) = (CanStation::new(), Vec::new());
        Shop { profile, model, station, rng, lost, twice, fault: None, now_ms: 0, sent }
    }

    /// How often a frame arrives.
    fn arrives(&mut self) -> usize {
        match self.rng.random_range(0..1000) {
            chance if chance < self.lost => 0,
            chance if chance < self.lost + self.twice => 2,
            _ => 1,
        }
    }

    fn protocol(&self) -> CanTable {
        let Transport::Can(settings) = &self.profile.transport else { panic!() };
        CanTable::new(&self.profile, settings, None)
    }

    fn ask(&mut self, ask: &Ask) -> Result<Vec<u8>, Failure> {
        let mut exchange = self.protocol().begin(ask);
        let (mut event, mut waiting) = (Event::Begun, VecDeque::<Frame>::new());
        loop {
            let (pieces, until_ms) = match exchange.on(event, self.now_ms) {
                Action::Done(bytes) => return Ok(bytes),
                Action::Failed(failure) => return Err(failure),
                Action::Send { pieces, until_ms } => (pieces, until_ms),
            };
            let mut mute = false;
            for piece in pieces {
                self.sent.push(piece.clone());
                for _ in 0..self.arrives() {
                    let mut controller = Controller::new(&mut self.model, self.fault, &mut mute);
                    waiting.extend(self.station.hear(piece.clone(), &mut controller));
                }
            }
            event = loop {
                if let Some(frame) = waiting.pop_front() {
                    match self.arrives() {
                        0 => continue,
                        2 => waiting.push_back(frame.clone()), // and once more, later
                        _ => {}
                    }
                    break Event::Received(frame);
                }
                if self.now_ms >= until_ms {
                    break Event::Timeout;
                }
                self.now_ms += 10;
                self.model.tick();
                let mut controller = Controller::new(&mut self.model, self.fault, &mut mute);
                waiting.extend(self.station.cycle(&mut controller));
            };
        }
    }

    fn patiently(&mut self, ask: &Ask) -> Vec<u8> {
        for _ in 0..100 {
            match self.ask(ask) {
                Ok(bytes) => return bytes,
                Err(Failure::Broken(_)) => {}
                Err(other) => panic!("{other:?}"),
            }
        }
        panic!("{ask:?} never came through")
    }
}

/// A staging image of random values with so many rows.
fn image(rows: usize, seed: u64) -> Vec<u8> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut image: Vec<u8> = (0..8 + 32 + 8 + 12 * rows).map(|_| rng.random_range(0..=255)).collect();
    image[40..44].copy_from_slice(&[(rows >> 8) as u8, rows as u8, 0, 0]);
    image
}

#[test]
fn a_status_is_of_one_cycle() {
    let mut shop = Shop::new(false, 1, (0, 0));
    let image = shop.ask(&Ask::Status).unwrap();
    assert_eq!(image, shop.model.status_image());
    assert_eq!(decode_status_image(&shop.profile, &image).unwrap().program, "AB-1");
    assert!(shop.sent.is_empty(), "nothing is asked");
    // Frames of two cycles make no status.
    let mut listening = shop.protocol().begin(&Ask::Status);
    listening.on(Event::Begun, 0);
    let mut cycles: Vec<Vec<Frame>> = Vec::new();
    while cycles.len() < 3 {
        let mut mute = false;
        let mut controller = Controller::new(&mut shop.model, None, &mut mute);
        cycles.push(shop.station.cycle(&mut controller));
        cycles.retain(|cycle| !cycle.is_empty());
    }
    let mixed = cycles[0][..15].iter().chain(&cycles[1][15..]).chain(&cycles[2][..15]);
    for frame in mixed {
        let action = listening.on(Event::Received(frame.clone()), 0);
        assert!(matches!(action, Action::Send { .. }), "{frame}");
    }
    assert!(matches!(listening.on(Event::Received(cycles[2][15].clone()), 0), Action::Done(_)));
}

#[test]
fn a_table_goes_item_by_item_and_comes_back() {
    for (fd, frames_a_row) in [(false, 3), (true, 1)] {
        let mut shop = Shop::new(fd, 1, (0, 0));
        let staged = image(40, 7);
        assert_eq!(shop.ask(&Ask::Stage(staged.clone())).unwrap(), NOTHING);
        assert_eq!(shop.sent.len(), 2 + 1 + 8 + 1 + 40 * frames_a_row);
        assert_eq!(shop.model.staging()[..staged.len()], staged);
        assert_eq!(shop.ask(&Ask::ReadBack { bytes: staged.len() }).unwrap(), staged);
        assert_eq!(shop.ask(&Ask::ReadBack { bytes: 50 }).unwrap(), staged[..50]);
        assert_eq!(shop.ask(&Ask::Recall).unwrap(), NOTHING, "no table yet");
        let payload = image(2, 8)[8..].to_vec();
        shop.model.edit_at_screen(payload.clone());
        assert_eq!(shop.ask(&Ask::Recall).unwrap(), payload);
    }
}

#[test]
fn the_frames_of_a_table_written_out_by_hand() {
    let mut shop = Shop::new(false, 1, (0, 0));
    let head =
        [&[0, 0, 0, 7, 0xAA, 0xBB, 0xCC, 0xDD][..], b"AB-1", &[0; 28], &[0, 1, 0, 0], &[0, 0, 0x27, 0x0F]]
            .concat();
    let staged = [&head[..], &[0, 0, 0x2E, 0xE0, 0xFF, 0xFF, 0x15, 0xA0, 0, 1, 0x5F, 0x90]].concat();
    shop.ask(&Ask::Stage(staged)).unwrap();
    let sent: Vec<String> = shop.sent.iter().map(Frame::to_string).collect();
    assert_eq!(
        sent[..4],
        ["320#0001000007000000", "320#01010000DDCCBBAA", "320#0201000001000000", "320#0701000041422D31"]
    );
    assert_eq!(
        sent[10..],
        [
            "320#0701070000000000",
            "320#030100000F270000",
            "320#04010000E02E0000",
            "320#05010000A015FFFF",
            "320#06010000905F0100"
        ]
    );
}

#[test]
fn an_item_is_repeated_twice_and_the_commit_never() {
    let mut shop = Shop::new(false, 1, (1000, 0));
    let error = shop.ask(&Ask::Stage(image(1, 1))).unwrap_err();
    assert_eq!(error, Failure::Broken("Revision 0 was sent 3 times and not echoed within 1000 ms".into()));
    assert_eq!((shop.sent.len(), shop.now_ms), (3, 3000));
    shop.sent.clear();
    let id = TableId { revision: 2, crc: 0xAABB_CCDD };
    let error = shop.ask(&Ask::Commit(id)).unwrap_err();
    assert_eq!(error, Failure::Broken("COMMIT_ECHO did not come within 1000 ms".into()));
    assert_eq!(shop.sent.iter().map(Frame::to_string).collect::<Vec<_>>(), ["322#02000000DDCCBBAA"]);
    let text = format!("{:?}", shop.ask(&Ask::Status).unwrap_err());
    assert!(text.contains("no status message (310, 311) was heard within 1000 ms"), "{text}");
    shop.lost = 0;
    assert_eq!(shop.ask(&Ask::Commit(id)).unwrap(), NOTHING);
}

#[test]
fn results_of_the_machine() {
    let mut shop = Shop::new(false, 1, (0, 0));
    shop.fault = Some(Fault::Busy);
    assert_eq!(shop.ask(&Ask::Stage(image(1, 1))), Err(Failure::Busy));
    shop.fault = None;
    let text = format!("{:?}", shop.ask(&Ask::Stage(image(41, 1))).unwrap_err());
    assert!(text.contains("Refused(\"Length 40: there is no such item or row"), "{text}");
    shop.fault = Some(Fault::SilentAfterCommit);
    assert!(matches!(shop.ask(&Ask::Commit(TableId { revision: 1, crc: 2 })), Err(Failure::Broken(_))));
}

#[test]
fn an_old_echo_is_not_taken_for_the_next() {
    let mut shop = Shop::new(false, 1, (0, 0));
    let mut exchange = shop.protocol().begin(&Ask::ReadBack { bytes: 48 });
    let Action::Send { until_ms, .. } = exchange.on(Event::Begun, 0) else { panic!() };
    // Another item, another operation, another row, another message: the time runs on.
    for old in ["0100000007000000", "0001000007000000", "0000010007000000", "0000000007"] {
        let data: Vec<u8> =
            (0..old.len() / 2).map(|i| u8::from_str_radix(&old[2 * i..2 * i + 2], 16).unwrap()).collect();
        for id in [0x321, 0x323] {
            let action = exchange.on(Event::Received(Frame::new(FrameId::Standard(id), &data[..])), 500);
            assert_eq!(action, Action::Send { pieces: vec![], until_ms });
        }
    }
    let own = Frame::new(FrameId::Standard(0x321), [0, 0, 0, 0, 7, 0, 0, 0]);
    let Action::Send { pieces, until_ms } = exchange.on(Event::Received(own), 500) else { panic!() };
    assert_eq!((pieces[0].to_string().as_str(), until_ms), ("320#0100000000000000", 1500));
    // A write's echo has the value that was written.
    let mut exchange = shop.protocol().begin(&Ask::Stage(image(1, 1)));
    exchange.on(Event::Begun, 0);
    let other = Frame::new(FrameId::Standard(0x321), [0, 1, 0, 0, 7, 0, 0, 0]);
    assert!(
        matches!(exchange.on(Event::Received(other), 0), Action::Send { pieces, .. } if pieces.is_empty())
    );
    assert!(shop.ask(&Ask::Status).is_ok());
}

proptest! {
    #[test]
    fn any_table_survives_a_bus_that_loses_and_repeats(seed: u64, rows in 0..40_usize, fd: bool, lost in 0..100_u32, twice in 0..100_u32) {
        let mut shop = Shop::new(fd, seed, (lost, twice));
        let staged = image(rows, seed);
        shop.patiently(&Ask::Stage(staged.clone()));
        prop_assert_eq!(shop.patiently(&Ask::ReadBack { bytes: staged.len() }), &staged[..]);
        shop.model.edit_at_screen(staged[8..].to_vec());
        prop_assert_eq!(shop.patiently(&Ask::Recall), &staged[8..]);
        let status = shop.patiently(&Ask::Status);
        prop_assert!(decode_status_image(&shop.profile, &status).is_ok());
    }

    #[test]
    fn no_frames_do_harm(
        which in 0..4_usize, fd: bool,
        frames in proptest::collection::vec((0x310..0x326_u16, 0..9_u8, 0..3_u8, proptest::collection::vec(any::<u8>(), 0..16)), 0..80),
    ) {
        let shop = Shop::new(fd, 1, (0, 0));
        let asks = [Ask::Status, Ask::ReadBack { bytes: 100 }, Ask::Recall, Ask::Commit(TableId { revision: 1, crc: 2 })];
        let mut exchange = shop.protocol().begin(&asks[which]);
        let mut action = exchange.on(Event::Begun, 0);
        for (id, item, operation, rest) in frames {
            if !matches!(action, Action::Send { .. }) {
                break;
            }
            let data = [&[item, operation][..], &rest].concat();
            action = exchange.on(Event::Received(Frame::new(FrameId::Standard(id), data)), 0);
        }
    }
}
