//! What happens to one answer of a simulated bender on its way.

use super::trouble::WireFaults;
use crate::bender::Letter;
use crate::bender::can::Frame;

/// What happens to one answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReplyFault {
    /// It is lost.
    Lost,
    /// It comes later.
    Late {
        /// Milliseconds.
        ms: u64,
    },
    /// It comes twice.
    Twice,
    /// Its end is missing.
    Truncated,
    /// A bit of it is flipped.
    Corrupted,
    /// Another unit's number is on it.
    WrongUnit,
    /// Bytes come before it that nobody sent.
    Garbage,
}

/// What comes over a port in one piece, and what arrives of it when it is damaged.
pub trait Damaged: Sized {
    /// The pieces that arrive.
    fn damaged(self, fault: ReplyFault, faults: &mut WireFaults) -> Vec<Self>;

    /// What arrives when no more than so many bytes go out; of what cannot be cut, nothing.
    fn cut(self, _bytes: usize) -> Vec<Self> {
        Vec::new()
    }
}

impl Damaged for Vec<u8> {
    fn damaged(mut self, fault: ReplyFault, faults: &mut WireFaults) -> Vec<Vec<u8>> {
        match fault {
            ReplyFault::Lost => return Vec::new(),
            ReplyFault::Late { .. } => {}
            ReplyFault::Twice => self = self.repeat(2),
            ReplyFault::Truncated => self.truncate(faults.chance(self.len())),
            ReplyFault::Corrupted => {
                let bit = faults.chance(8 * self.len());
                if let Some(byte) = self.get_mut(bit / 8) {
                    *byte ^= 1 << (bit % 8);
                }
            }
            ReplyFault::WrongUnit => {
                if let Some(unit) = self.first_mut() {
                    *unit = unit.wrapping_add(1);
                }
            }
            ReplyFault::Garbage => {
                let count = 1 + faults.chance(19);
                let garbage: Vec<u8> = (0..count).map(|_| faults.chance(256) as u8).collect();
                self = [garbage, self].concat();
            }
        }
        vec![self]
    }

    fn cut(mut self, bytes: usize) -> Vec<Vec<u8>> {
        self.truncate(bytes);
        if self.is_empty() { Vec::new() } else { vec![self] }
    }
}

impl Damaged for Letter {
    /// A file comes whole or not at all, but what is in it may be wrong.
    fn damaged(mut self, fault: ReplyFault, faults: &mut WireFaults) -> Vec<Letter> {
        if fault == ReplyFault::Twice {
            return vec![self.clone(), self];
        }
        let damages_table = self.table.is_some() && faults.chance(2) == 0;
        let file = if damages_table { self.table.get_or_insert_default() } else { &mut self.text };
        let mut arriving = std::mem::take(file).damaged(fault, faults);
        match arriving.pop() {
            None => Vec::new(),
            Some(bytes) => {
                *file = bytes;
                vec![self]
            }
        }
    }

    fn cut(mut self, bytes: usize) -> Vec<Letter> {
        self.text.truncate(bytes);
        vec![self]
    }
}

impl Damaged for Frame {
    /// What is damaged on a bus is thrown away by every controller on it: it is lost.
    fn damaged(self, fault: ReplyFault, _: &mut WireFaults) -> Vec<Frame> {
        match fault {
            ReplyFault::Late { .. } => vec![self],
            ReplyFault::Twice => vec![self.clone(), self],
            _ => Vec::new(),
        }
    }
}
