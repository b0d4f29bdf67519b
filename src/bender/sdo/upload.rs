//! An upload: an object's bytes, expedited, by segments, or in blocks of up to 127 segments, of which the last good one is acknowledged.

use super::codes::{CHECKSUM, LENGTH, NO_MEMORY, SEQUENCE, TOGGLE, crc16};
use super::dialogue::{Bytes, Dialogue, Transfer, number};
use crate::bender::can::Frame;
use crate::bender::exchange::Action;

/// Segments of a block: as many as there can be.
const BLOCK: u8 = 127;

/// The longest object that is fetched.
const MOST_BYTES: usize = 64 * 1024;

/// How often in a row a block that stopped is asked for again.
const STUCK: u32 = 2;

/// Bytes on their way from an object.
pub struct Upload {
    block: bool,
    state: State,
    data: Vec<u8>,
    /// What the server announced.
    size: Option<usize>,
    crc: bool,
    stuck: u32,
}

#[derive(Debug)]
enum State {
    /// The request is out.
    Initiated,
    /// A segment with this toggle bit is asked for.
    Segments { toggle: bool },
    /// Segments of a block are coming; the last good one, and whether it was the last of all.
    Block { good: u8, last: bool },
}

impl Upload {
    /// In blocks where the server can.
    pub fn new(block: bool) -> Upload {
        Upload { block, state: State::Initiated, data: Vec::new(), size: None, crc: false, stuck: 0 }
    }

    fn initiated(&mut self, dialogue: &mut Dialogue, bytes: Bytes, now_ms: u64) -> Action<Frame> {
        let in_blocks = self.block && bytes[0] & 0xE1 == 0xC0;
        // A server without block transfer may answer as if it had not been asked for.
        if !in_blocks && bytes[0] >> 5 != 2 || !dialogue.names(&bytes) {
            return dialogue.wait();
        }
        if !in_blocks && bytes[0] & 2 != 0 {
            let unused = if bytes[0] & 1 == 0 { 0 } else { usize::from(bytes[0] >> 2 & 3) };
            return Action::Done(bytes[4..8 - unused].to_vec());
        }
        let sized = bytes[0] & if in_blocks { 2 } else { 1 } != 0;
        self.size = sized.then(|| usize::try_from(number(&bytes)).unwrap_or(usize::MAX));
        if let Some(size @ MOST_BYTES..) = self.size {
            return dialogue.abort(
                NO_MEMORY,
                &format!("{size} bytes are announced, {MOST_BYTES} at most are taken"),
                now_ms,
            );
        }
        if in_blocks {
            self.crc = bytes[0] & 4 != 0;
            self.state = State::Block { good: 0, last: false };
            dialogue.send([[0xA3, 0, 0, 0, 0, 0, 0, 0]], now_ms)
        } else {
            self.ask_segment(false, dialogue, now_ms)
        }
    }

    fn ask_segment(&mut self, toggle: bool, dialogue: &mut Dialogue, now_ms: u64) -> Action<Frame> {
        self.state = State::Segments { toggle };
        dialogue.send([[0x60 | u8::from(toggle) << 4, 0, 0, 0, 0, 0, 0, 0]], now_ms)
    }

    fn segment(&mut self, toggle: bool, dialogue: &mut Dialogue, bytes: Bytes, now_ms: u64) -> Action<Frame> {
        if (bytes[0] >> 4 & 1 == 1) != toggle {
            return dialogue.abort(TOGGLE, "a segment came twice, or one was lost", now_ms);
        }
        let unused = usize::from(bytes[0] >> 1 & 7);
        self.data.extend(&bytes[1..8 - unused]);
        if self.data.len() > MOST_BYTES {
            return dialogue.abort(NO_MEMORY, &format!("more than {MOST_BYTES} bytes came"), now_ms);
        }
        if bytes[0] & 1 == 0 {
            return self.ask_segment(!toggle, dialogue, now_ms);
        }
        match self.wrong_size() {
            Some(why) => dialogue.abort(LENGTH, &why, now_ms),
            None => Action::Done(std::mem::take(&mut self.data)),
        }
    }

    fn wrong_size(&self) -> Option<String> {
        let (size, found) = (self.size?, self.data.len());
        (size != found).then(|| format!("{size} bytes were announced, {found} came"))
    }

    /// A segment of a block, whose first byte is its number and whether it is the last of all.
    fn block_segment(
        &mut self,
        good: u8,
        dialogue: &mut Dialogue,
        bytes: Bytes,
        now_ms: u64,
    ) -> Action<Frame> {
        let (number, is_last) = (bytes[0] & 0x7F, bytes[0] & 0x80 != 0);
        let in_order = number == good + 1;
        let (good, last) = if in_order { (number, is_last) } else { (good, false) };
        if in_order {
            self.stuck = 0;
            self.data.extend(&bytes[1..]);
            if self.data.len() > MOST_BYTES {
                return dialogue.abort(NO_MEMORY, &format!("more than {MOST_BYTES} bytes came"), now_ms);
            }
        }
        self.state = State::Block { good, last };
        if number != BLOCK && !is_last {
            return dialogue.wait_anew(now_ms);
        }
        if good == 0 {
            self.stuck += 1;
            if self.stuck > STUCK {
                let why = format!("of {} blocks in a row nothing came in order", self.stuck);
                return dialogue.abort(SEQUENCE, &why, now_ms);
            }
        }
        self.acknowledge(good, last, dialogue, now_ms)
    }

    /// Says how far the block is good; the next one begins behind that.
    fn acknowledge(&mut self, good: u8, last: bool, dialogue: &mut Dialogue, now_ms: u64) -> Action<Frame> {
        self.state = State::Block { good: if last { good } else { 0 }, last };
        dialogue.send([[0xA2, good, BLOCK, 0, 0, 0, 0, 0]], now_ms)
    }

    /// The end of a block transfer.
    fn end(&mut self, dialogue: &mut Dialogue, bytes: Bytes, now_ms: u64) -> Action<Frame> {
        let unused = usize::from(bytes[0] >> 2 & 7);
        self.data.truncate(self.data.len().saturating_sub(unused));
        let (expected, found) = (u16::from_le_bytes([bytes[1], bytes[2]]), crc16(&self.data));
        if self.crc && expected != found {
            let why = format!("the checksum of what came is {found:04X}, the server says {expected:04X}");
            return dialogue.abort(CHECKSUM, &why, now_ms);
        }
        if let Some(why) = self.wrong_size() {
            return dialogue.abort(LENGTH, &why, now_ms);
        }
        let done = Action::Done(std::mem::take(&mut self.data));
        dialogue.close([0xA1, 0, 0, 0, 0, 0, 0, 0], done, now_ms)
    }
}

impl Transfer for Upload {
    fn begin(&mut self, dialogue: &mut Dialogue, now_ms: u64) -> Action<Frame> {
        self.state = State::Initiated;
        let frame = if self.block {
            // With a checksum; the server must not choose another way by itself.
            dialogue.about_with(0xA4, BLOCK.into())
        } else {
            dialogue.about(0x40)
        };
        dialogue.send([frame], now_ms)
    }

    fn answer(&mut self, dialogue: &mut Dialogue, bytes: Bytes, now_ms: u64) -> Action<Frame> {
        match self.state {
            State::Initiated => self.initiated(dialogue, bytes, now_ms),
            State::Segments { toggle } if bytes[0] >> 5 == 0 => self.segment(toggle, dialogue, bytes, now_ms),
            State::Block { last: true, .. } if bytes[0] & 0xE3 == 0xC1 => self.end(dialogue, bytes, now_ms),
            State::Block { good, last: false } => self.block_segment(good, dialogue, bytes, now_ms),
            // No answer to what is out: one that was late, or came twice.
            _ => dialogue.wait(),
        }
    }

    fn silence(&mut self, dialogue: &mut Dialogue, now_ms: u64) -> Option<Action<Frame>> {
        let State::Block { good, last } = self.state else { return None };
        self.stuck += 1;
        (self.stuck <= STUCK).then(|| self.acknowledge(good, last, dialogue, now_ms))
    }

    fn unknown(&mut self, dialogue: &mut Dialogue, now_ms: u64) -> Option<Action<Frame>> {
        (self.block && matches!(self.state, State::Initiated)).then(|| {
            self.block = false;
            self.begin(dialogue, now_ms)
        })
    }
}
