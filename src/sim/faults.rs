//! Ways in which a simulated bender misbehaves: one that is asked for, or what happens to its answers on the wire, by a script or by
//! chance that a seed decides.

use std::collections::VecDeque;
use std::str::FromStr;

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::bender::MachineModel;
use crate::bender::Letter;
use crate::bender::can::Frame;

/// A way to misbehave.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// Takes connections and answers nothing.
    Silent,
    /// Answers everything this much later.
    Late {
        /// Milliseconds.
        ms: u64,
    },
    /// Has another program loaded.
    OtherProgram,
    /// The loaded program has one bend more.
    OtherBends,
    /// Is in the middle of a part.
    Running,
    /// Flips a bit of what is staged.
    CorruptStaging,
    /// Drops the connection at the commit, which is lost.
    DropBeforeApply,
    /// Drops the connection at the commit, which is taken.
    DropAfterApply,
    /// Takes the commit and answers nothing from then on.
    SilentAfterCommit,
    /// Answers everything with "busy".
    Busy,
    /// Its program stands still.
    Frozen,
}

impl Fault {
    /// What can be asked for, in words.
    pub const NAMES: &str = "silent, late:MS, other-program, other-bends, running, corrupt-staging, \
                             drop-before-apply, drop-after-apply, silent-after-commit, busy, frozen";

    /// What it does to the machine itself.
    pub fn prepare(self, model: &mut MachineModel) {
        match self {
            Fault::OtherProgram => model.rename_program("SOMETHING-ELSE"),
            Fault::OtherBends => model.add_bend(),
            Fault::Running => model.set_between_parts(false),
            Fault::CorruptStaging => model.corrupts_staging = true,
            Fault::Frozen => model.frozen = true,
            _ => {} // a fault of the link
        }
    }
}

impl FromStr for Fault {
    type Err = String;

    fn from_str(text: &str) -> Result<Fault, String> {
        if let Some(ms) = text.strip_prefix("late:") {
            let ms = ms.parse().map_err(|_| format!("late:{ms}: milliseconds must be a whole number"))?;
            return Ok(Fault::Late { ms });
        }
        match text {
            "silent" => Ok(Fault::Silent),
            "other-program" => Ok(Fault::OtherProgram),
            "other-bends" => Ok(Fault::OtherBends),
            "running" => Ok(Fault::Running),
            "corrupt-staging" => Ok(Fault::CorruptStaging),
            "drop-before-apply" => Ok(Fault::DropBeforeApply),
            "drop-after-apply" => Ok(Fault::DropAfterApply),
            "silent-after-commit" => Ok(Fault::SilentAfterCommit),
            "busy" => Ok(Fault::Busy),
            "frozen" => Ok(Fault::Frozen),
            other => Err(format!("unknown fault {other:?}, known are {}", Fault::NAMES)),
        }
    }
}

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

/// What happens to the answers, one after the other.
#[derive(Debug, Clone)]
pub struct WireFaults {
    /// First these, then by chance.
    script: VecDeque<Option<ReplyFault>>,
    rng: ChaCha8Rng,
    usual_ms: u64,
    /// Of a thousand answers.
    per_mille: u32,
    latest_ms: u64,
}

impl WireFaults {
    /// Of a thousand answers so many have a fault; late ones come up to `latest_ms` later.
    pub fn new(seed: u64, per_mille: u32, latest_ms: u64) -> WireFaults {
        let rng = ChaCha8Rng::seed_from_u64(seed);
        WireFaults { script: VecDeque::new(), rng, usual_ms: USUAL_MS, per_mille, latest_ms }
    }

    /// These faults, and none after them.
    pub fn script(faults: impl IntoIterator<Item = Option<ReplyFault>>) -> WireFaults {
        WireFaults { script: faults.into_iter().collect(), usual_ms: 0, ..WireFaults::new(0, 0, 0) }
    }

    /// How long the next answer takes, in milliseconds.
    pub fn usual_ms(&mut self) -> u64 {
        if self.usual_ms == 0 { 0 } else { self.rng.random_range(1..=self.usual_ms) }
    }

    /// What happens to the next answer.
    pub fn fault(&mut self) -> Option<ReplyFault> {
        if let Some(next) = self.script.pop_front() {
            return next;
        }
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

    /// A number below `below`, by chance.
    pub fn chance(&mut self, below: usize) -> usize {
        self.rng.random_range(0..below.max(1))
    }
}

/// What comes over a port in one piece, and what arrives of it when it is damaged.
pub trait Damaged: Sized {
    /// The pieces that arrive.
    fn damaged(self, fault: ReplyFault, faults: &mut WireFaults) -> Vec<Self>;
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
