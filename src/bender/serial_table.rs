//! The serial table protocol (protocols/serial-table.md): what is asked becomes frames, piece by piece, each repeated when its answer
//! does not come or comes garbled. Pure but for opening the port.
//!
//! Over `serial_frame`, under `table_link`.

use std::collections::VecDeque;
use std::io;

use super::exchange::{Action, Ask, Event, Exchange, Failure, Protocol};
use super::line_port::LinePort;
use super::open::{Opener, wire};
use super::profile::Profile;
use super::recording::Frames;
use super::serial_frame::{Decoder, Frame, MOST_PAYLOAD};

/// How often one frame is sent again.
const REPEATS: u32 = 2;

/// Bytes of an area in one frame: an offset and a length take four.
pub const PIECE: usize = MOST_PAYLOAD - 4;

/// Codes of a refusal.
const GARBLED: u8 = 1;
const BUSY: u8 = 3;

/// The protocol on one line.
pub struct SerialTable {
    profile: Profile,
    opener: Option<Opener>,
    frames: Frames,
    unit: u8,
    sequence: u8,
    reply_ms: u64,
}

impl SerialTable {
    /// With the machine `unit` on the line; over wires that `opener` makes, where there is one.
    pub fn new(profile: &Profile, unit: u8, opener: Option<Opener>) -> SerialTable {
        let reply_ms = super::caller::millis(profile.deadlines.request);
        SerialTable {
            profile: profile.clone(),
            opener,
            frames: Frames::default(),
            unit,
            sequence: 0,
            reply_ms,
        }
    }

    /// A frame of the next number.
    fn frame(&mut self, kind: u8, payload: Vec<u8>) -> Frame {
        self.sequence = self.sequence.wrapping_add(1);
        Frame { unit: self.unit, sequence: self.sequence, kind, payload }
    }
}

impl Protocol for SerialTable {
    type Port = LinePort;

    fn begin(&mut self, ask: &Ask) -> Box<dyn Exchange<Piece = Vec<u8>>> {
        let requests = match ask {
            Ask::Status => vec![self.frame(b'S', Vec::new())],
            Ask::Stage(image) => (0..image.len())
                .step_by(PIECE)
                .map(|at| {
                    let offset = (at as u16).to_be_bytes();
                    let payload = [&offset, &image[at..image.len().min(at + PIECE)]].concat();
                    self.frame(b'W', payload)
                })
                .collect(),
            Ask::ReadBack { bytes } => (0..*bytes)
                .step_by(PIECE)
                .map(|at| self.frame(b'R', span(at, PIECE.min(bytes - at))))
                .collect(),
            Ask::Commit(id) => {
                let payload = [id.revision.to_be_bytes(), id.crc.to_be_bytes()].concat();
                vec![self.frame(b'C', payload)]
            }
            Ask::Recall => {
                // As many as the longest table takes; what is behind the end of a shorter one is not asked for.
                let most = super::wire::payload_bytes(&self.profile, self.profile.limits.max_bends);
                (0..most).step_by(PIECE).map(|at| self.frame(b'T', span(at, PIECE.min(most - at)))).collect()
            }
        };
        Box::new(Transfer {
            requests: requests.into(),
            reply_ms: self.reply_ms,
            until_ms: 0,
            repeats: if matches!(ask, Ask::Commit(_)) { 0 } else { REPEATS },
            left: 0,
            decoder: Decoder::default(),
            answer: Vec::new(),
        })
    }

    fn frames(&self) -> &Frames {
        &self.frames
    }

    async fn open(&mut self, endpoint: &str) -> io::Result<LinePort> {
        let wire = wire(&self.profile, endpoint, self.opener.as_mut(), &self.frames).await?;
        let echo = self.profile.transport.line().is_some_and(|line| line.echo);
        Ok(LinePort::new(wire, echo))
    }
}

fn span(offset: usize, count: usize) -> Vec<u8> {
    [(offset as u16).to_be_bytes(), (count as u16).to_be_bytes()].concat()
}

/// One exchange: frame after frame.
struct Transfer {
    /// The first is the one that is out.
    requests: VecDeque<Frame>,
    reply_ms: u64,
    until_ms: u64,
    /// For each frame.
    repeats: u32,
    left: u32,
    decoder: Decoder,
    answer: Vec<u8>,
}

impl Transfer {
    /// Sends the first of the frames that are left.
    fn send(&mut self, now_ms: u64) -> Action<Vec<u8>> {
        let Some(frame) = self.requests.front() else {
            return Action::Done(std::mem::take(&mut self.answer));
        };
        self.until_ms = now_ms + self.reply_ms;
        Action::Send { pieces: vec![frame.encode()], until_ms: self.until_ms }
    }

    fn begin(&mut self, now_ms: u64) -> Action<Vec<u8>> {
        self.left = self.repeats;
        self.send(now_ms)
    }

    fn again(&mut self, now_ms: u64, why: &str) -> Action<Vec<u8>> {
        if self.left == 0 {
            let times = self.repeats + 1;
            return Action::Failed(Failure::Broken(format!("{why}, asked {times} times")));
        }
        self.left -= 1;
        self.send(now_ms)
    }

    fn hear(&mut self, answer: &Frame, now_ms: u64) -> Option<Action<Vec<u8>>> {
        let asked = self.requests.front()?;
        // A refusal of what was garbled cannot name its request.
        let garbled = answer.kind == b'N' && answer.payload == [GARBLED];
        if answer.unit != asked.unit || answer.sequence != asked.sequence && !garbled {
            return None; // another machine's, or an older request's
        }
        match (answer.kind, asked.kind) {
            (b'A', b'T') => {
                let most = usize::from(asked.payload[3]);
                Some(self.recalled(&answer.payload, most, now_ms))
            }
            (b'A', kind) => {
                let asked_bytes = match kind {
                    b'R' => usize::from(asked.payload[3]),
                    b'S' => answer.payload.len(), // who reads it knows how long it is
                    _ => 0,
                };
                if answer.payload.len() != asked_bytes {
                    let found = answer.payload.len();
                    return Some(Action::Failed(Failure::Broken(format!(
                        "the answer has {found} bytes instead of {asked_bytes}"
                    ))));
                }
                self.answer.extend(&answer.payload);
                self.requests.pop_front();
                Some(self.begin(now_ms))
            }
            (b'N', _) if garbled => Some(self.again(now_ms, "the machine received it garbled")),
            (b'N', _) if answer.payload == [BUSY] => Some(Action::Failed(Failure::Busy)),
            (b'N', _) => Some(Action::Failed(Failure::Refused(refusal(&answer.payload)))),
            _ => None, // the echo of a request, if anything
        }
    }

    /// A piece of the active table, which says how long that is; `asked` bytes of it were asked for.
    fn recalled(&mut self, payload: &[u8], asked: usize, now_ms: u64) -> Action<Vec<u8>> {
        let Some((length, bytes)) = payload.split_at_checked(2) else {
            return Action::Failed(Failure::Broken("a recalled piece without the table's length".into()));
        };
        let length = usize::from(u16::from_be_bytes([length[0], length[1]]));
        let left = length.saturating_sub(self.answer.len());
        self.answer.extend(bytes);
        self.requests.pop_front();
        let found = self.answer.len();
        // Fewer than asked at the end only: behind a gap the next piece would be taken for what is missing.
        if found > length || bytes.len() != left.min(asked) || (found < length && self.requests.is_empty()) {
            return Action::Failed(Failure::Broken(format!(
                "{found} bytes of a table of {length} were recalled"
            )));
        }
        if found == length {
            self.requests.clear();
        }
        self.begin(now_ms)
    }
}

impl Exchange for Transfer {
    type Piece = Vec<u8>;

    fn on(&mut self, event: Event<Vec<u8>>, now_ms: u64) -> Action<Vec<u8>> {
        match event {
            Event::Begun => self.begin(now_ms),
            Event::Timeout => self.again(now_ms, &format!("no answer within {} ms", self.reply_ms)),
            Event::Received(bytes) => {
                for answer in self.decoder.take(&bytes) {
                    if let Some(action) = self.hear(&answer, now_ms) {
                        return action;
                    }
                }
                Action::Send { pieces: Vec::new(), until_ms: self.until_ms }
            }
        }
    }
}

fn refusal(payload: &[u8]) -> String {
    let meaning = match payload {
        [2] => "outside of the area",
        [4] => "a kind that it does not know",
        _ => "a code that the contract does not name",
    };
    format!("{meaning} (code {})", payload.first().map_or("none".into(), u8::to_string))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bender::TableId;

    fn exchange(ask: &Ask) -> Box<dyn Exchange<Piece = Vec<u8>>> {
        let profile = Profile::load("reference-serial").unwrap();
        SerialTable::new(&profile, 1, None).begin(ask)
    }

    fn answer(sequence: u8, kind: u8, payload: &[u8]) -> Event<Vec<u8>> {
        Event::Received(Frame { unit: 1, sequence, kind, payload: payload.to_vec() }.encode())
    }

    /// The frame that is sent.
    fn sent(action: Action<Vec<u8>>) -> Frame {
        let Action::Send { pieces, .. } = action else { panic!("{action:?}") };
        let [bytes] = &pieces[..] else { panic!("{pieces:?}") };
        Decoder::default().take(bytes).remove(0)
    }

    #[test]
    fn a_long_read_goes_piece_by_piece_and_each_is_repeated_twice() {
        let mut exchange = exchange(&Ask::ReadBack { bytes: 130 });
        let first = sent(exchange.on(Event::Begun, 0));
        assert_eq!((first.sequence, first.kind, &first.payload[..]), (1, b'R', &[0, 0, 0, 124][..]));
        assert_eq!(sent(exchange.on(Event::Timeout, 500)), first, "repeated as it was");
        let second = sent(exchange.on(answer(1, b'A', &[7; 124]), 600));
        assert_eq!((second.sequence, &second.payload[..]), (2, &[0, 124, 0, 6][..]));
        // The answer to the repetition comes late, and is none to the second frame.
        let waits = exchange.on(answer(1, b'A', &[8; 124]), 601);
        assert_eq!(waits, Action::Send { pieces: vec![], until_ms: 1100 });
        let Action::Done(bytes) = exchange.on(answer(2, b'A', &[9; 6]), 700) else { panic!() };
        assert_eq!(bytes, [vec![7; 124], vec![9; 6]].concat());
    }

    #[test]
    fn silence_garbling_and_refusals_end_it() {
        let mut silent = exchange(&Ask::Status);
        sent(silent.on(Event::Begun, 0));
        sent(silent.on(Event::Timeout, 500));
        sent(silent.on(answer(0, b'N', &[GARBLED]), 600));
        let Action::Failed(Failure::Broken(why)) = silent.on(Event::Timeout, 1100) else { panic!() };
        assert_eq!(why, "no answer within 500 ms, asked 3 times");

        let mut outside = exchange(&Ask::ReadBack { bytes: 9 });
        sent(outside.on(Event::Begun, 0));
        let refused = outside.on(answer(1, b'N', &[2]), 1);
        assert_eq!(refused, Action::Failed(Failure::Refused("outside of the area (code 2)".into())));

        let mut busy = exchange(&Ask::Status);
        sent(busy.on(Event::Begun, 0));
        assert_eq!(busy.on(answer(1, b'N', &[BUSY]), 1), Action::Failed(Failure::Busy));

        let mut short = exchange(&Ask::ReadBack { bytes: 9 });
        sent(short.on(Event::Begun, 0));
        let failed = short.on(answer(1, b'A', &[0; 8]), 1);
        assert!(matches!(failed, Action::Failed(Failure::Broken(_))), "{failed:?}");
    }

    #[test]
    fn a_commit_is_never_repeated() {
        for event in [Event::Timeout, answer(1, b'N', &[GARBLED])] {
            let mut commit = exchange(&Ask::Commit(TableId { revision: 8, crc: 9 }));
            assert_eq!(sent(commit.on(Event::Begun, 0)).payload, [0, 0, 0, 8, 0, 0, 0, 9]);
            let failed = commit.on(event, 500);
            assert!(matches!(failed, Action::Failed(Failure::Broken(_))), "{failed:?}");
        }
    }

    #[test]
    fn a_recalled_table_ends_where_it_says() {
        let mut exchange = exchange(&Ask::Recall);
        assert_eq!(sent(exchange.on(Event::Begun, 0)).payload, [0, 0, 0, 124]);
        let piece = |bytes: usize| [vec![0, 130], vec![5; bytes]].concat();
        assert_eq!(sent(exchange.on(answer(1, b'A', &piece(124)), 1)).payload, [0, 124, 0, 124]);
        assert_eq!(exchange.on(answer(2, b'A', &piece(6)), 2), Action::Done(vec![5; 130]));
    }

    #[test]
    fn a_recalled_table_with_a_gap_or_longer_than_any_is_none() {
        let piece = |length: u16, bytes: usize| [&length.to_be_bytes()[..], &vec![5; bytes]].concat();
        let broken = |action| matches!(action, Action::Failed(Failure::Broken(_)));
        let mut gap = exchange(&Ask::Recall);
        sent(gap.on(Event::Begun, 0));
        assert!(broken(gap.on(answer(1, b'A', &piece(130, 100)), 1)));

        let mut long = exchange(&Ask::Recall);
        sent(long.on(Event::Begun, 0));
        for sequence in 1..5 {
            sent(long.on(answer(sequence, b'A', &piece(700, 124)), 1));
        }
        assert!(broken(long.on(answer(5, b'A', &piece(700, 24)), 1)), "the longest has 520 bytes");
    }

    #[test]
    fn the_answer_to_a_write_carries_nothing() {
        for ask in [Ask::Stage(vec![1, 2]), Ask::Commit(TableId { revision: 8, crc: 9 })] {
            let mut exchange = exchange(&ask);
            sent(exchange.on(Event::Begun, 0));
            let failed = exchange.on(answer(1, b'A', &[0]), 1);
            assert!(matches!(failed, Action::Failed(Failure::Broken(_))), "{failed:?}");
        }
    }
}
