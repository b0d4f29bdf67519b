//! What can happen to a machine's answers on a line, by chance that a seed decides.

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

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

/// An answer takes up to this long anyway.
const USUAL_MS: u64 = 15;

/// Faults by chance.
#[derive(Debug, Clone)]
pub struct LineFaults {
    rng: ChaCha8Rng,
    /// Of a thousand answers.
    per_mille: u32,
    latest_ms: u64,
}

impl LineFaults {
    /// Of a thousand answers so many have a fault; late ones come up to `latest_ms` later.
    pub fn new(seed: u64, per_mille: u32, latest_ms: u64) -> LineFaults {
        LineFaults { rng: ChaCha8Rng::seed_from_u64(seed), per_mille, latest_ms }
    }

    /// How long the next answer takes, in milliseconds.
    pub fn usual_ms(&mut self) -> u64 {
        self.rng.random_range(1..=USUAL_MS)
    }

    /// What happens to the next answer.
    pub fn fault(&mut self) -> Option<ReplyFault> {
        if self.rng.random_range(0..1000) >= self.per_mille {
            return None;
        }
        Some(match self.rng.random_range(0..7) {
            0 => ReplyFault::Lost,
            1 => ReplyFault::Late { ms: self.rng.random_range(1..=self.latest_ms.max(1)) },
            2 => ReplyFault::Twice,
            3 => ReplyFault::Truncated,
            4 => ReplyFault::Corrupted,
            5 => ReplyFault::WrongUnit,
            _ => ReplyFault::Garbage,
        })
    }

    /// The bytes that arrive of an answer.
    pub fn damage(&mut self, fault: ReplyFault, mut bytes: Vec<u8>) -> Vec<u8> {
        match fault {
            ReplyFault::Lost => Vec::new(),
            ReplyFault::Late { .. } => bytes,
            ReplyFault::Twice => bytes.repeat(2),
            ReplyFault::Truncated => {
                bytes.truncate(self.rng.random_range(0..bytes.len().max(1)));
                bytes
            }
            ReplyFault::Corrupted => {
                let bit = self.rng.random_range(0..(8 * bytes.len()).max(1));
                if let Some(byte) = bytes.get_mut(bit / 8) {
                    *byte ^= 1 << (bit % 8);
                }
                bytes
            }
            ReplyFault::WrongUnit => {
                if let Some(unit) = bytes.first_mut() {
                    *unit = unit.wrapping_add(1);
                }
                bytes
            }
            ReplyFault::Garbage => {
                let count = self.rng.random_range(1..20);
                let garbage: Vec<u8> = (0..count).map(|_| self.rng.random_range(0..=255)).collect();
                [garbage, bytes].concat()
            }
        }
    }
}
