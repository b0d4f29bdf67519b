//! A machine on a CAN bus whose frames are lost, late, twice, cut, damaged or invented, both ways: what the targets of CAN and CANopen
//! share. A script says what happens; where it ends, all is well.

use std::collections::VecDeque;

use benderd::bender::can::{Frame, FrameId};
use benderd::bender::{
    Ask, Exchange, ExchangeAction as Action, ExchangeEvent as Event, Failure, Profile, TableId, crc_of,
    decode_status_image,
};
use benderd::sim::bender::MachineModel;
use benderd::sim::station::{Controller, Station};

use crate::Script;

/// Frames and pauses after which an exchange has to be over, when all is well again.
const MOST_STEPS: usize = 20_000;

/// What the machine does in 10 ms.
const CYCLE_MS: u64 = 10;

/// A machine and what became of the frames between.
pub struct Bus<S> {
    pub station: S,
    pub model: MachineModel,
    /// Identifiers that invented frames have.
    pub ids: Vec<u16>,
    /// What the daemon sent.
    pub sent: Vec<Frame>,
    /// Whether any frame was not passed on as it was.
    pub troubled: bool,
    waiting: VecDeque<Frame>,
}

/// Any of the exchanges.
pub fn ask(script: &mut Script) -> Ask {
    match script.any() % 5 {
        0 => Ask::Status,
        1 => {
            let rows = usize::from(script.any() % 41);
            Ask::Stage(image(rows, script.any()))
        }
        2 => Ask::ReadBack { bytes: 8 + 40 + usize::from(script.any() % 41) * 12 },
        3 => Ask::Commit(TableId { revision: script.long(), crc: script.long() }),
        _ => Ask::Recall,
    }
}

/// A staging area's image with a table of so many rows, every byte of which is this.
fn image(rows: usize, byte: u8) -> Vec<u8> {
    let payload = payload(rows, byte);
    [&1_u32.to_be_bytes()[..], &crc_of(&payload).to_be_bytes(), &payload].concat()
}

fn payload(rows: usize, byte: u8) -> Vec<u8> {
    let mut payload = b"P".to_vec();
    payload.resize(32, 0);
    payload.extend([0, rows as u8, 0, 0, 0, 0, 0, 9]);
    payload.resize(40 + 12 * rows, byte);
    payload
}

impl<S: Station<Piece = Frame>> Bus<S> {
    /// A machine with a table in force, if the script says so.
    pub fn new(profile: &Profile, station: S, ids: Vec<u16>, script: &mut Script) -> Bus<S> {
        let mut model = MachineModel::new(profile.clone(), "P", 1);
        if let rows @ 1..=40 = script.any() {
            model.edit_at_screen(payload(rows.into(), 3));
            model.write_staging(0, &image(rows.into(), 5));
        }
        Bus { station, model, ids, sent: Vec::new(), troubled: false, waiting: VecDeque::new() }
    }

    /// Carries an exchange out to its end.
    pub fn run(
        &mut self,
        mut exchange: Box<dyn Exchange<Piece = Frame>>,
        script: &mut Script,
    ) -> Result<Vec<u8>, Failure> {
        let (mut now_ms, mut event) = (0, Event::Begun);
        for _ in 0..MOST_STEPS {
            let until_ms = match exchange.on(event, now_ms) {
                Action::Done(bytes) => return Ok(bytes),
                Action::Failed(failure) => return Err(failure),
                Action::Send { pieces, until_ms } => {
                    pieces.into_iter().for_each(|piece| self.request(piece, script));
                    until_ms
                }
            };
            event = loop {
                if let Some(frame) = self.waiting.pop_front() {
                    break Event::Received(frame);
                }
                if now_ms >= until_ms {
                    break Event::Timeout;
                }
                now_ms += CYCLE_MS;
                self.model.tick();
                let mut mute = false;
                let said = self.station.cycle(&mut Controller::new(&mut self.model, None, &mut mute));
                self.hear(said, script);
            };
        }
        panic!("it never ends");
    }

    fn request(&mut self, frame: Frame, script: &mut Script) {
        self.sent.push(frame.clone());
        for frame in self.passed(frame, script) {
            let mut mute = false;
            let answers = self.station.hear(frame, &mut Controller::new(&mut self.model, None, &mut mute));
            self.hear(answers, script);
        }
    }

    fn hear(&mut self, frames: Vec<Frame>, script: &mut Script) {
        for frame in frames {
            let passed = self.passed(frame, script);
            self.waiting.extend(passed);
        }
    }

    /// What becomes of a frame.
    fn passed(&mut self, mut frame: Frame, script: &mut Script) -> Vec<Frame> {
        let what = script.any();
        self.troubled |= (1..=6).contains(&what);
        match what {
            1 => return Vec::new(),
            2 => return vec![frame.clone(), frame],
            3 => {
                let at = usize::from(script.any()) % frame.data.len().max(1);
                if let Some(byte) = frame.data.get_mut(at) {
                    *byte ^= script.any();
                }
            }
            4 => frame.data.truncate(script.any().into()),
            // Before what was asked for.
            5 => {
                let id = self.ids[usize::from(script.any()) % self.ids.len()];
                let invented = Frame::new(FrameId::Standard(id), script.take(8));
                return vec![invented, frame];
            }
            // Instead of it.
            6 => return vec![Frame::new(frame.id, script.take(8))],
            _ => {}
        }
        vec![frame]
    }

    /// What must be so, whatever happened.
    pub fn check(&self, profile: &Profile, ask: &Ask, answer: Result<Vec<u8>, Failure>) {
        let staging = self.model.staging();
        let Ok(bytes) = answer else {
            let asks_for_nothing = matches!(ask, Ask::Recall) && self.model.active().revision == 0;
            assert!(self.troubled || asks_for_nothing, "failed with nothing in the way: {ask:?}: {answer:?}");
            return;
        };
        match ask {
            Ask::Status => drop(decode_status_image(profile, &bytes)),
            Ask::Stage(_) | Ask::Commit(_) => assert_eq!(bytes, [0; 0], "the answer to a write is empty"),
            Ask::ReadBack { bytes: asked } => assert_eq!(bytes.len(), *asked),
            Ask::Recall => assert!(bytes.is_empty() || bytes.len() >= 40, "{} bytes", bytes.len()),
        }
        if self.troubled {
            return;
        }
        match ask {
            Ask::Status => assert!(decode_status_image(profile, &bytes).is_ok()),
            Ask::Stage(image) => assert_eq!(staging[..image.len()], image[..]),
            Ask::ReadBack { bytes: asked } => assert_eq!(bytes, staging[..*asked]),
            Ask::Commit(_) => {}
            Ask::Recall => assert_eq!(bytes, self.model.active_payload()),
        }
    }
}
