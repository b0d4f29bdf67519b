//! What downloads and uploads have in common: the frames of one client with one server about one object, each answer within its time,
//! aborts both ways. Pure.

use super::codes::{DEVICE_STATE, NO_MEMORY, TIMED_OUT, UNKNOWN_COMMAND, meaning};
use super::{Object, cob_ids};
use crate::bender::can::{Frame, FrameId};
use crate::bender::exchange::{Action, Event, Exchange, Failure};

/// The data of a frame: always eight bytes.
pub type Bytes = [u8; 8];

/// First byte of an abort.
const ABORT: u8 = 0x80;

/// One transfer's side of the dialogue.
pub trait Transfer: Send {
    /// The first frame.
    fn begin(&mut self, dialogue: &mut Dialogue, now_ms: u64) -> Action<Frame>;

    /// A frame of the server that is no abort.
    fn answer(&mut self, dialogue: &mut Dialogue, bytes: Bytes, now_ms: u64) -> Action<Frame>;

    /// Nothing came in time: what is tried before it is given up.
    fn silence(&mut self, _dialogue: &mut Dialogue, _now_ms: u64) -> Option<Action<Frame>> {
        None
    }

    /// The server does not know the command: what is tried instead.
    fn unknown(&mut self, _dialogue: &mut Dialogue, _now_ms: u64) -> Option<Action<Frame>> {
        None
    }
}

/// Who talks with whom about what, and until when an answer is waited for.
pub struct Dialogue {
    request: FrameId,
    response: FrameId,
    object: Object,
    request_ms: u64,
    until_ms: u64,
    /// What is said after the last frame has gone.
    last: Option<Action<Frame>>,
}

impl Dialogue {
    /// Sends frames and waits for an answer.
    pub fn send(&mut self, frames: impl IntoIterator<Item = Bytes>, now_ms: u64) -> Action<Frame> {
        self.until_ms = now_ms + self.request_ms;
        let pieces = frames.into_iter().map(|bytes| Frame::new(self.request, bytes)).collect();
        Action::Send { pieces, until_ms: self.until_ms }
    }

    /// Waits on: what came was no answer, or not all of it.
    pub fn wait(&self) -> Action<Frame> {
        Action::Send { pieces: Vec::new(), until_ms: self.until_ms }
    }

    /// The same with new time: something of the answer came.
    pub fn wait_anew(&mut self, now_ms: u64) -> Action<Frame> {
        self.send([], now_ms)
    }

    /// Sends a last frame; then it is over.
    pub fn close(&mut self, bytes: Bytes, last: Action<Frame>, now_ms: u64) -> Action<Frame> {
        self.last = Some(last);
        Action::Send { pieces: vec![Frame::new(self.request, bytes)], until_ms: now_ms }
    }

    /// Aborts the transfer.
    pub fn abort(&mut self, code: u32, why: &str, now_ms: u64) -> Action<Frame> {
        let [a, b, c, d] = code.to_le_bytes();
        let mut bytes = self.about(ABORT);
        bytes[4..].copy_from_slice(&[a, b, c, d]);
        let failure = Failure::Broken(format!("{}: {why}", self.object));
        self.close(bytes, Action::Failed(failure), now_ms)
    }

    /// A frame that names the object, its last four bytes 0.
    pub fn about(&self, command: u8) -> Bytes {
        let [low, high] = self.object.index.to_le_bytes();
        [command, low, high, self.object.subindex, 0, 0, 0, 0]
    }

    /// The same with a number behind.
    pub fn about_with(&self, command: u8, number: u32) -> Bytes {
        let mut bytes = self.about(command);
        bytes[4..].copy_from_slice(&number.to_le_bytes());
        bytes
    }

    /// Whether a frame is about this object.
    pub fn names(&self, bytes: &Bytes) -> bool {
        bytes[1..4] == self.about(0)[1..4]
    }
}

/// The number in a frame's last four bytes.
pub fn number(bytes: &Bytes) -> u32 {
    u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]])
}

/// A transfer as an exchange; `finish` makes the answer of what was fetched.
pub struct Client<T> {
    dialogue: Dialogue,
    transfer: T,
    finish: Finish,
}

/// Makes the answer of an object's bytes.
pub type Finish = Box<dyn Fn(Vec<u8>) -> Result<Vec<u8>, String> + Send>;

impl<T: Transfer> Client<T> {
    /// A transfer with a node about an object; each answer within `request_ms`.
    pub fn new(node: u8, object: Object, request_ms: u64, transfer: T, finish: Finish) -> Client<T> {
        let (request, response) = cob_ids(node);
        let dialogue = Dialogue { request, response, object, request_ms, until_ms: 0, last: None };
        Client { dialogue, transfer, finish }
    }

    fn step(&mut self, event: Event<Frame>, now_ms: u64) -> Action<Frame> {
        let dialogue = &mut self.dialogue;
        if let Some(last) = dialogue.last.take() {
            return last;
        }
        let frame = match event {
            Event::Begun => return self.transfer.begin(dialogue, now_ms),
            Event::Timeout => {
                return self.transfer.silence(dialogue, now_ms).unwrap_or_else(|| {
                    let why =
                        format!("no answer within {} ms; the transfer was aborted", dialogue.request_ms);
                    dialogue.abort(TIMED_OUT, &why, now_ms)
                });
            }
            Event::Received(frame) => frame,
        };
        let Some(bytes) = Bytes::try_from(&frame.data[..]).ok().filter(|_| frame.id == dialogue.response)
        else {
            return dialogue.wait();
        };
        if bytes[0] != ABORT {
            return self.transfer.answer(dialogue, bytes, now_ms);
        }
        // One about another object belongs to a transfer that was given up; some servers name none.
        if !dialogue.names(&bytes) && bytes[1..4] != [0; 3] {
            return dialogue.wait();
        }
        match number(&bytes) {
            UNKNOWN_COMMAND => {
                let instead = self.transfer.unknown(dialogue, now_ms);
                instead.unwrap_or_else(|| Action::Failed(aborted(UNKNOWN_COMMAND)))
            }
            DEVICE_STATE => Action::Failed(Failure::Busy),
            code => Action::Failed(aborted(code)),
        }
    }
}

/// A transfer that the server aborted: it lost the thread, or it refuses.
fn aborted(code: u32) -> Failure {
    let text = format!("SDO abort {code:08X}: {}", meaning(code));
    let lost_the_thread = matches!(code >> 16, 0x0503 | 0x0504) && code != NO_MEMORY;
    if lost_the_thread { Failure::Broken(text) } else { Failure::Refused(text) }
}

impl<T: Transfer> Exchange for Client<T> {
    type Piece = Frame;

    fn on(&mut self, event: Event<Frame>, now_ms: u64) -> Action<Frame> {
        match self.step(event, now_ms) {
            Action::Done(bytes) => match (self.finish)(bytes) {
                Ok(answer) => Action::Done(answer),
                Err(why) => Action::Failed(Failure::Broken(format!("{}: {why}", self.dialogue.object))),
            },
            other => other,
        }
    }
}
