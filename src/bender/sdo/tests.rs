//! SDO transfers: transcripts written out by hand from CiA 301, and payloads through a simulated server over a bus that loses frames.

use std::collections::VecDeque;

use proptest::prelude::*;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::bender::exchange::{Action, Event, Failure};
use crate::bender::{TableId, Transport};
use crate::sim::bender::MachineModel;
use crate::sim::faults::Fault;
use crate::sim::sdo_server::SdoServer;
use crate::sim::station::{Controller, Station as _};

const REQUEST_MS: u64 = 1000;
const NOTHING: [u8; 0] = [];
const OBJECT: Object = Object { index: 0x2001, subindex: 0 };

type Talk = Box<dyn Exchange<Piece = Frame>>;

fn upload(block: bool) -> Talk {
    Box::new(Client::new(5, OBJECT, REQUEST_MS, Upload::new(block), Box::new(Ok)))
}

fn download(data: &[u8], block: bool) -> Talk {
    Box::new(Client::new(5, OBJECT, REQUEST_MS, Download::new(data.to_vec(), block), Box::new(Ok)))
}

fn bytes(hex: &str) -> Vec<u8> {
    let digits: Vec<u8> = hex.bytes().filter(u8::is_ascii_hexdigit).collect();
    digits.chunks(2).map(|two| u8::from_str_radix(std::str::from_utf8(two).unwrap(), 16).unwrap()).collect()
}

fn server_says(hex: &str) -> Event<Frame> {
    Event::Received(Frame::new(FrameId::Standard(0x585), bytes(hex)))
}

fn says(action: &Action<Frame>) -> String {
    match action {
        Action::Send { pieces, .. } => pieces.iter().map(|p| p.to_string()).collect::<Vec<_>>().join(" "),
        Action::Done(bytes) => format!("done, {} bytes", bytes.len()),
        Action::Failed(failure) => format!("{failure:?}"),
    }
}

/// What the client says at first, and then to each frame of the server.
fn transcript(talk: &mut Talk, server: &[&str]) -> Vec<String> {
    let mut lines = vec![says(&talk.on(Event::Begun, 0))];
    lines.extend(server.iter().map(|hex| says(&talk.on(server_says(hex), 0))));
    lines
}

#[test]
fn expedited_both_ways() {
    let lines = transcript(&mut download(&[0xAA, 0xBB], false), &["60 0120 00 00000000"]);
    assert_eq!(lines, ["605#2B012000AABB0000", "done, 0 bytes"]);
    let lines = transcript(&mut upload(false), &["4F 0120 00 2A000000"]);
    assert_eq!(lines, ["605#4001200000000000", "done, 1 bytes"]);
    let mut talk = upload(false);
    talk.on(Event::Begun, 0);
    // The size is not said: four bytes.
    assert_eq!(talk.on(server_says("42 0120 00 01020304"), 0), Action::Done(vec![1, 2, 3, 4]));
}

#[test]
fn segments_both_ways() {
    let lines = transcript(
        &mut download(b"ABCDEFGHI", false),
        &["60 0120 00 00000000", "20 00000000000000", "30 00000000000000"],
    );
    // Nine bytes; seven with toggle 0; two, so five unused, the last, with toggle 1.
    assert_eq!(
        lines,
        ["605#2101200009000000", "605#0041424344454647", "605#1B48490000000000", "done, 0 bytes"]
    );
    let mut talk = upload(false);
    let lines = transcript(&mut talk, &["41 0120 00 09000000", "00 41424344454647"]);
    assert_eq!(lines, ["605#4001200000000000", "605#6000000000000000", "605#7000000000000000"]);
    assert_eq!(talk.on(server_says("1B 48490000000000"), 0), Action::Done(b"ABCDEFGHI".to_vec()));
}

#[test]
fn blocks_both_ways() {
    // 16 bytes in blocks of two segments; of the first block only one segment is good.
    assert_eq!(codes::crc16(b"ABCDEFGHIJKLMNOP"), 0x6080);
    let lines = transcript(
        &mut download(b"ABCDEFGHIJKLMNOP", true),
        &["A4 0120 00 02 000000", "A2 01 02 0000000000", "A2 02 02 0000000000", "A1 00000000000000"],
    );
    assert_eq!(
        lines,
        [
            "605#C601200010000000",
            "605#0141424344454647 605#0248494A4B4C4D4E",
            "605#0148494A4B4C4D4E 605#824F500000000000",
            "605#D580600000000000",
            "done, 0 bytes"
        ]
    );
    let mut talk = upload(true);
    let lines = transcript(
        &mut talk,
        &[
            "C6 0120 00 10000000",
            "01 41424344454647",
            "03 4F500000000000",
            "83 4F500000000000",
            "01 48494A4B4C4D4E",
            "82 4F500000000000",
        ],
    );
    assert_eq!(
        lines,
        [
            "605#A40120007F000000",
            "605#A300000000000000",
            "",
            "",
            "605#A2017F0000000000",
            "",
            "605#A2027F0000000000"
        ],
        "segment 2 was lost: 1 is acknowledged, the rest comes again"
    );
    assert_eq!(says(&talk.on(server_says("D5 8060 0000000000"), 0)), "605#A100000000000000");
    assert_eq!(talk.on(Event::Timeout, 0), Action::Done(b"ABCDEFGHIJKLMNOP".to_vec()));
}

#[test]
fn a_block_that_stops_is_asked_for_again_from_the_last_good_segment() {
    let mut talk = upload(true);
    transcript(&mut talk, &["C6 0120 00 10000000", "01 41424344454647"]);
    assert_eq!(says(&talk.on(Event::Timeout, 1000)), "605#A2017F0000000000");
    assert_eq!(says(&talk.on(Event::Timeout, 2000)), "605#A2007F0000000000");
    assert_eq!(says(&talk.on(Event::Timeout, 3000)), "605#8001200000000405", "aborted: no answer in time");
    assert!(says(&talk.on(Event::Timeout, 3000)).contains("object 2001:00: no answer within 1000 ms"));
}

#[test]
fn what_does_not_fit_is_aborted_with_its_code() {
    let aborts = |mut talk: Talk, server: &[&str]| transcript(&mut talk, server).pop().unwrap();
    let toggle = "605#8001200000000305";
    assert_eq!(aborts(download(b"ABCDEFGHI", false), &["60 0120 00 00000000", "30 00000000000000"]), toggle);
    assert_eq!(aborts(upload(false), &["41 0120 00 09000000", "10 41424344454647"]), toggle);
    assert_eq!(aborts(download(b"ABCDEFGHI", true), &["A4 0120 00 00 000000"]), "605#8001200002000405");
    let sequence = ["A4 0120 00 7F 000000", "A2 03 7F 0000000000"];
    assert_eq!(aborts(download(b"ABCDEFGHI", true), &sequence), "605#8001200003000405");
    let checksum = ["C6 0120 00 02000000", "81 41420000000000", "D5 0000 0000000000"];
    assert_eq!(aborts(upload(true), &checksum), "605#8001200004000405");
    assert_eq!(aborts(upload(false), &["41 0120 00 00000200"]), "605#8001200005000405");
    let length = ["41 0120 00 09000000", "01 41424344454647"];
    assert_eq!(aborts(upload(false), &length), "605#8001200010000706");
}

#[test]
fn an_abort_is_put_into_words_and_one_of_another_object_is_old() {
    let mut talk = download(b"ABCDEFGHI", false);
    let lines = transcript(&mut talk, &["80 0220 00 22000008", "80 0120 00 12000706"]);
    assert_eq!(lines[1], "", "waits on");
    assert_eq!(lines[2], "Refused(\"SDO abort 06070012: more bytes than the object has\")");
    let mut talk = upload(true);
    let lines = transcript(&mut talk, &["80 0120 00 22000008"]);
    assert_eq!(lines[1], "Busy");
}

#[test]
fn a_server_that_knows_no_blocks_gets_segments() {
    let unknown = "80 0120 00 01000405";
    let lines = transcript(&mut download(b"ABCDEFGHI", true), &[unknown, unknown]);
    assert_eq!(lines[..2], ["605#C601200009000000", "605#2101200009000000"]);
    assert!(lines[2].contains("the command is not known"), "once only: {}", lines[2]);
    assert_eq!(transcript(&mut upload(true), &[unknown])[1], "605#4001200000000000");
    // Some answer as if segments had been asked for.
    assert_eq!(transcript(&mut upload(true), &["41 0120 00 09000000"])[1], "605#6000000000000000");
}

#[test]
fn late_answers_of_a_transfer_that_was_given_up_are_not_taken() {
    let mut talk = upload(false);
    // A segment, an acknowledgement, an answer about another object, too few bytes: none begins this transfer.
    let late = ["00 41424344454647", "20 00000000000000", "4F 0220 00 2A000000", "4F 0120 00"];
    let lines = transcript(&mut talk, &late);
    assert_eq!(lines[1..], ["", "", "", ""]);
    let other = Event::Received(Frame::new(FrameId::Standard(0x586), bytes("4F 0120 00 2A000000")));
    assert_eq!(says(&talk.on(other, 0)), "", "another node's");
    assert_eq!(talk.on(server_says("4F 0120 00 2A000000"), 0), Action::Done(vec![0x2A]));
}

#[test]
fn objects_by_their_text() {
    assert_eq!("2000:0a".parse(), Ok(Object { index: 0x2000, subindex: 10 }));
    assert_eq!(OBJECT.to_string(), "object 2001:00");
    for wrong in ["2000", "20:00", "2000:0", "x000:00", "2000:00:00", "+200:00"] {
        assert_eq!(wrong.parse::<Object>(), Err(()), "{wrong}");
    }
}

/// A machine with its server, a bus that loses frames, and a clock turned by hand.
struct Shop {
    profile: Profile,
    model: MachineModel,
    server: SdoServer,
    rng: ChaCha8Rng,
    lost_per_mille: u32,
    fault: Option<Fault>,
    now_ms: u64,
}

impl Shop {
    fn new(seed: u64, lost_per_mille: u32, knows_blocks: bool) -> Shop {
        let profile = Profile::load("reference-canopen").unwrap();
        let Transport::Canopen(settings) = profile.transport.clone() else { panic!() };
        let server =
            if knows_blocks { SdoServer::new(settings) } else { SdoServer::without_blocks(settings) };
        let (model, rng) = (MachineModel::new(profile.clone(), "P1", 3), ChaCha8Rng::seed_from_u64(seed));
        Shop { profile, model, server, rng, lost_per_mille, fault: None, now_ms: 0 }
    }

    fn arrives(&mut self) -> bool {
        self.rng.random_range(0..1000) >= self.lost_per_mille
    }

    /// One exchange, to its end.
    fn run(&mut self, mut talk: Talk) -> Result<Vec<u8>, Failure> {
        let (mut event, mut waiting) = (Event::Begun, VecDeque::<Frame>::new());
        loop {
            let (pieces, until_ms) = match talk.on(event, self.now_ms) {
                Action::Done(bytes) => return Ok(bytes),
                Action::Failed(failure) => return Err(failure),
                Action::Send { pieces, until_ms } => (pieces, until_ms),
            };
            let mut mute = false;
            for piece in pieces {
                if self.arrives() {
                    let mut controller = Controller::new(&mut self.model, self.fault, &mut mute);
                    waiting.extend(self.server.hear(piece, &mut controller));
                }
            }
            event = loop {
                if let Some(frame) = waiting.pop_front() {
                    if self.arrives() {
                        break Event::Received(frame);
                    }
                } else if self.now_ms >= until_ms {
                    break Event::Timeout;
                } else {
                    self.now_ms += 10;
                    let mut controller = Controller::new(&mut self.model, self.fault, &mut mute);
                    waiting.extend(self.server.cycle(&mut controller));
                }
            };
        }
    }

    fn ask(&mut self, ask: &Ask) -> Result<Vec<u8>, Failure> {
        let Transport::Canopen(settings) = self.profile.transport.clone() else { panic!() };
        let mut protocol = Canopen::new(&self.profile, &settings, None);
        self.run(protocol.begin(ask))
    }

    /// Again until it succeeds; how often it took.
    fn patiently(&mut self, ask: &Ask) -> (Vec<u8>, usize) {
        for attempt in 1..200 {
            match self.ask(ask) {
                Ok(bytes) => return (bytes, attempt),
                Err(Failure::Refused(why)) => panic!("{why}"),
                Err(_) => {}
            }
        }
        panic!("{ask:?} never came through")
    }
}

#[test]
fn all_that_is_asked_of_a_machine() {
    for knows_blocks in [true, false] {
        let mut shop = Shop::new(1, 0, knows_blocks);
        assert_eq!(shop.ask(&Ask::Status).unwrap(), shop.model.status_image());
        let image: Vec<u8> = (0..=255).cycle().take(528).collect();
        assert_eq!(shop.ask(&Ask::Stage(image.clone())).unwrap(), NOTHING);
        assert_eq!(shop.ask(&Ask::ReadBack { bytes: 90 }).unwrap(), image[..90]);
        assert_eq!(shop.ask(&Ask::Recall).unwrap(), NOTHING, "no table yet");
        let payload = [&[b'P'; 32][..], &[0, 2, 0, 0], &[1; 28]].concat();
        shop.model.edit_at_screen([&payload[..], &[9; 5]].concat());
        assert_eq!(shop.ask(&Ask::Recall).unwrap(), payload, "as long as its bend count says");
        shop.model.edit_at_screen(payload[..60].to_vec());
        assert!(
            says(&Action::Failed(shop.ask(&Ask::Recall).unwrap_err()))
                .contains("it has 60 bytes, 64 were asked for")
        );
        let id = TableId { revision: 3, crc: 0xAABB_CCDD };
        assert_eq!(shop.ask(&Ask::Commit(id)).unwrap(), NOTHING);
        assert!(format!("{:?}", shop.model.tick()).contains("revision: 3, crc: 2864434397"));
        assert!(
            matches!(shop.ask(&Ask::Stage(vec![1; 529])), Err(Failure::Refused(why)) if why.contains("06070012"))
        );
        shop.fault = Some(Fault::Busy);
        assert_eq!(shop.ask(&Ask::Status), Err(Failure::Busy));
        shop.fault = Some(Fault::Silent);
        assert!(
            matches!(shop.ask(&Ask::Status), Err(Failure::Broken(why)) if why.contains("no answer within 1000 ms"))
        );
    }
}

proptest! {
    #[test]
    fn any_payload_survives_a_bus_that_loses_frames(
        seed: u64, payload in proptest::collection::vec(any::<u8>(), 1..528), knows_blocks: bool, lost in 0..30_u32,
    ) {
        // 160 frames of segments seldom get through where 30 of 1000 are lost; blocks do.
        let mut shop = Shop::new(seed, if knows_blocks { lost } else { lost / 3 }, knows_blocks);
        shop.patiently(&Ask::Stage(payload.clone()));
        let (found, _) = shop.patiently(&Ask::ReadBack { bytes: payload.len() });
        prop_assert_eq!(found, payload);
    }

    #[test]
    fn no_answers_do_harm(
        block: bool, upwards: bool, data in proptest::collection::vec(any::<u8>(), 0..40),
        answers in proptest::collection::vec(
            (prop::sample::select(vec![0x41_u8, 0x43, 0x60, 0x20, 0x30, 0xA4, 0xA2, 0xA1, 0xC6, 0xC1, 0x80, 0, 1, 2, 0x81, 0x10]),
             any::<bool>(), proptest::collection::vec(any::<u8>(), 0..9)),
            0..60,
        ),
    ) {
        let mut talk = if upwards { upload(block) } else { download(&data, block) };
        let mut action = talk.on(Event::Begun, 0);
        for (command, about, rest) in answers {
            if !matches!(action, Action::Send { .. }) {
                break;
            }
            let mut answer = [vec![command], if about { vec![1, 0x20, 0] } else { Vec::new() }, rest].concat();
            answer.truncate(8);
            action = talk.on(Event::Received(Frame::new(FrameId::Standard(0x585), answer)), 0);
        }
    }

    #[test]
    fn no_requests_do_harm(requests in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 8), 0..60)) {
        let mut shop = Shop::new(1, 0, true);
        let mut mute = false;
        for request in requests {
            let mut controller = Controller::new(&mut shop.model, None, &mut mute);
            shop.server.hear(Frame::new(FrameId::Standard(0x605), request), &mut controller);
            shop.server.cycle(&mut controller);
        }
    }
}

#[test]
fn how_many_tries_a_table_takes_where_frames_are_lost() {
    let image = vec![0x5A; 528];
    for (knows_blocks, lost) in [(true, 0), (true, 10), (true, 30), (false, 0), (false, 10)] {
        let tries: usize = (0..100)
            .map(|seed| Shop::new(seed, lost, knows_blocks).patiently(&Ask::Stage(image.clone())).1)
            .sum();
        println!(
            "blocks {knows_blocks}, {lost} of 1000 frames lost: {:.2} tries a table of 528 bytes",
            tries as f64 / 100.0
        );
        assert!(lost > 0 || tries == 100);
    }
}
