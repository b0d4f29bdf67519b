//! The last frames of a link, oldest first, for the log and for the fitter. Pure; `recording` feeds it.

use std::collections::VecDeque;
use std::fmt;

/// So many are kept.
const MOST: usize = 256;

/// A serial port hands a frame over in pieces: what follows within this time in the same direction belongs to it.
const SAME_FRAME_MS: u64 = 10;

/// Longest frame that pieces are added to.
const LONGEST: usize = 1024;

/// Which way a frame went.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// To the machine.
    Sent,
    /// From it.
    Received,
}

/// What a frame is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Content {
    /// Bytes of a wire.
    Bytes(Vec<u8>),
    /// What comes over a port that carries no bytes (a file, a bus frame), in words.
    Text(String),
}

/// One frame.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Entry {
    /// When it began, and when its last piece came; in milliseconds since the link was made.
    at_ms: u64,
    last_ms: u64,
    direction: Direction,
    content: Content,
}

/// The last frames.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Ring {
    entries: VecDeque<Entry>,
}

impl Ring {
    /// Adds one; the oldest goes where there is no room.
    pub fn push(&mut self, at_ms: u64, direction: Direction, content: Content) {
        if let (Some(last), Content::Bytes(more)) = (self.entries.back_mut(), &content)
            && last.direction == direction
            && at_ms.saturating_sub(last.last_ms) <= SAME_FRAME_MS
            && let Content::Bytes(bytes) = &mut last.content
            && bytes.len() + more.len() <= LONGEST
        {
            bytes.extend(more);
            last.last_ms = at_ms;
            return;
        }
        if self.entries.len() == MOST {
            self.entries.pop_front();
        }
        self.entries.push_back(Entry { at_ms, last_ms: at_ms, direction, content });
    }

    /// One line each: `  12.345 s > 01 03 00 00 00 24 45 D1`.
    pub fn lines(&self) -> Vec<String> {
        self.entries.iter().map(ToString::to_string).collect()
    }
}

impl fmt::Display for Entry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let way = if self.direction == Direction::Sent { '>' } else { '<' };
        write!(f, "{:>4}.{:03} s {way}", self.at_ms / 1000, self.at_ms % 1000)?;
        match &self.content {
            Content::Text(text) => write!(f, " {text}"),
            Content::Bytes(bytes) if is_text(bytes) => {
                write!(f, " {:?}", String::from_utf8_lossy(bytes))
            }
            Content::Bytes(bytes) => bytes.iter().try_for_each(|byte| write!(f, " {byte:02X}")),
        }
    }
}

/// Whether bytes are lines of text, as serial tables are.
fn is_text(bytes: &[u8]) -> bool {
    bytes.len() > 1 && bytes.iter().all(|b| b.is_ascii_graphic() || matches!(b, b' ' | b'\r' | b'\n'))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(bytes: &[u8]) -> Content {
        Content::Bytes(bytes.to_vec())
    }

    #[test]
    fn frames_are_lines_and_pieces_of_one_are_one_line() {
        let mut ring = Ring::default();
        ring.push(12_345, Direction::Sent, bytes(&[1, 3, 0, 0, 0, 0x24, 0x45, 0xD1]));
        ring.push(12_350, Direction::Received, bytes(&[1, 3]));
        ring.push(12_355, Direction::Received, bytes(&[0x48]));
        ring.push(12_400, Direction::Received, bytes(&[0xFF]));
        ring.push(12_401, Direction::Sent, bytes(b":0101S\r\n"));
        ring.push(3_600_000, Direction::Received, Content::Text("bender1.ans, 40 bytes".into()));
        let expected = [
            "  12.345 s > 01 03 00 00 00 24 45 D1",
            "  12.350 s < 01 03 48",
            "  12.400 s < FF",
            "  12.401 s > \":0101S\\r\\n\"",
            "3600.000 s < bender1.ans, 40 bytes",
        ];
        assert_eq!(ring.lines(), expected);
    }

    #[test]
    fn the_oldest_goes() {
        let mut ring = Ring::default();
        for at in 0..300 {
            ring.push(100 * at, Direction::Sent, bytes(&[at as u8]));
        }
        let lines = ring.lines();
        assert_eq!((lines.len(), lines[0].as_str()), (MOST, "   4.400 s > 2C"));
    }
}
