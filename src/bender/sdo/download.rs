//! A download: bytes to an object, expedited, by segments, or in blocks of up to 127 segments that are acknowledged together and sent
//! again from the last good one.

use super::codes::{BLOCK_SIZE, SEQUENCE, TIMED_OUT, TOGGLE, crc16};
use super::dialogue::{Bytes, Dialogue, Transfer};
use crate::bender::can::Frame;
use crate::bender::exchange::Action;

/// Data bytes of a segment.
const SEGMENT: usize = 7;

/// Blocks of which nothing arrives, one after the other, at most.
const STUCK: u32 = 3;

/// Bytes on their way to an object.
pub struct Download {
    data: Vec<u8>,
    block: bool,
    state: State,
}

#[derive(Debug)]
enum State {
    /// The request is out.
    Initiated,
    /// A segment is out; the data up to its end, and its toggle bit.
    Segment { to: usize, toggle: bool },
    /// The request for a block transfer is out.
    BlockInitiated,
    /// So many segments are out, from this byte on.
    Block { from: usize, segments: usize, crc: bool, stuck: u32 },
    /// The end of the block transfer is out.
    BlockEnded,
}

impl Download {
    /// In blocks where the server can.
    pub fn new(data: Vec<u8>, block: bool) -> Download {
        // Four bytes and less go in one frame anyway.
        let block = block && data.len() > 4;
        Download { data, block, state: State::Initiated }
    }

    fn size(&self) -> u32 {
        u32::try_from(self.data.len()).unwrap_or(u32::MAX)
    }

    fn is_expedited(&self) -> bool {
        (1..=4).contains(&self.data.len())
    }

    fn segment(&mut self, from: usize, toggle: bool, dialogue: &mut Dialogue, now_ms: u64) -> Action<Frame> {
        let to = self.data.len().min(from + SEGMENT);
        let (part, last) = (&self.data[from..to], to == self.data.len());
        let mut bytes = [0; 8];
        bytes[0] = u8::from(toggle) << 4 | ((SEGMENT - part.len()) as u8) << 1 | u8::from(last);
        bytes[1..=part.len()].copy_from_slice(part);
        self.state = State::Segment { to, toggle };
        dialogue.send([bytes], now_ms)
    }

    /// As many segments as the server takes at once, or the end.
    fn block(
        &mut self,
        from: usize,
        (size, crc, stuck): (u8, bool, u32),
        dialogue: &mut Dialogue,
        now_ms: u64,
    ) -> Action<Frame> {
        if !(1..=127).contains(&size) {
            return dialogue.abort(
                BLOCK_SIZE,
                &format!("the server asks for blocks of {size} segments"),
                now_ms,
            );
        }
        let rest = self.data.get(from..).unwrap_or(&[]);
        if rest.is_empty() {
            let unused = (SEGMENT - self.data.len() % SEGMENT) % SEGMENT;
            let [low, high] = if crc { crc16(&self.data).to_le_bytes() } else { [0; 2] };
            self.state = State::BlockEnded;
            return dialogue.send([[0xC1 | (unused as u8) << 2, low, high, 0, 0, 0, 0, 0]], now_ms);
        }
        let parts: Vec<&[u8]> = rest.chunks(SEGMENT).collect();
        let segments = parts.len().min(size.into());
        let frames = parts[..segments].iter().zip(1_u8..).map(|(part, number)| {
            let mut bytes = [0; 8];
            let last = usize::from(number) == parts.len();
            bytes[0] = u8::from(last) << 7 | number;
            bytes[1..=part.len()].copy_from_slice(part);
            bytes
        });
        let action = dialogue.send(frames, now_ms);
        self.state = State::Block { from, segments, crc, stuck };
        action
    }
}

impl Transfer for Download {
    fn begin(&mut self, dialogue: &mut Dialogue, now_ms: u64) -> Action<Frame> {
        let frame = if self.block {
            self.state = State::BlockInitiated;
            // With a checksum, with the size.
            dialogue.about_with(0xC6, self.size())
        } else {
            self.state = State::Initiated;
            if self.is_expedited() {
                let mut bytes = dialogue.about(0x23 | ((4 - self.data.len()) as u8) << 2);
                bytes[4..4 + self.data.len()].copy_from_slice(&self.data);
                bytes
            } else {
                dialogue.about_with(0x21, self.size())
            }
        };
        dialogue.send([frame], now_ms)
    }

    fn answer(&mut self, dialogue: &mut Dialogue, bytes: Bytes, now_ms: u64) -> Action<Frame> {
        match self.state {
            State::Initiated if bytes[0] == 0x60 && dialogue.names(&bytes) => {
                if self.is_expedited() {
                    return Action::Done(Vec::new());
                }
                self.segment(0, false, dialogue, now_ms)
            }
            State::Segment { to, toggle } if bytes[0] >> 5 == 1 => {
                if (bytes[0] >> 4 & 1 == 1) != toggle {
                    return dialogue.abort(
                        TOGGLE,
                        "a segment was acknowledged twice, or one was lost",
                        now_ms,
                    );
                }
                if to == self.data.len() {
                    return Action::Done(Vec::new());
                }
                self.segment(to, !toggle, dialogue, now_ms)
            }
            State::BlockInitiated if bytes[0] & 0xE3 == 0xA0 && dialogue.names(&bytes) => {
                self.block(0, (bytes[4], bytes[0] & 4 != 0, 0), dialogue, now_ms)
            }
            State::Block { from, segments, crc, stuck } if bytes[0] == 0xA2 => {
                let good = usize::from(bytes[1]);
                if good > segments {
                    let why = format!("{good} segments were acknowledged where {segments} were sent");
                    return dialogue.abort(SEQUENCE, &why, now_ms);
                }
                let stuck = if good == 0 { stuck + 1 } else { 0 };
                if stuck > STUCK {
                    return dialogue.abort(TIMED_OUT, &format!("nothing of {stuck} blocks arrived"), now_ms);
                }
                self.block(from + good * SEGMENT, (bytes[2], crc, stuck), dialogue, now_ms)
            }
            State::BlockEnded if bytes[0] == 0xA1 => Action::Done(Vec::new()),
            // No answer to what is out: one that was late, or came twice.
            _ => dialogue.wait(),
        }
    }

    fn unknown(&mut self, dialogue: &mut Dialogue, now_ms: u64) -> Option<Action<Frame>> {
        matches!(self.state, State::BlockInitiated).then(|| {
            self.block = false;
            self.begin(dialogue, now_ms)
        })
    }
}
