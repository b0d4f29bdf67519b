//! What goes wrong around a bender: scans of other tubes, tubes bent otherwise than is said. One is put into a job at a time, as the
//! scan that is shown; benderd must stop for it, or read it rightly.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::controllers::Scanned;
use crate::correct::Verdict;
use crate::tube::{Lra, MeasuredTube};

/// Gross errors of a scan's angle.
pub const GROSS_RAD: f64 = 3.0 * std::f64::consts::PI / 180.0;

/// Which one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum MixUp {
    /// Scanned from the other end: no harm, to be read as what it is.
    Reversed,
    /// Bent to the other hand.
    Mirrored,
    /// Another part was scanned.
    Swapped,
    /// Bent with an older revision of the table.
    WrongRevision,
    /// A row of the program was left out.
    MissingBend,
    /// The scan before is shown again.
    SameScan,
    /// One angle is measured grossly wrong.
    Outlier,
}

impl MixUp {
    /// All of them.
    pub const ALL: [MixUp; 7] = [
        MixUp::Reversed,
        MixUp::Mirrored,
        MixUp::Swapped,
        MixUp::WrongRevision,
        MixUp::MissingBend,
        MixUp::SameScan,
        MixUp::Outlier,
    ];

    /// Its name in reports.
    pub fn name(self) -> &'static str {
        match self {
            MixUp::Reversed => "scanned from the other end",
            MixUp::Mirrored => "mirrored",
            MixUp::Swapped => "another part",
            MixUp::WrongRevision => "bent with an older table",
            MixUp::MissingBend => "a bend missing",
            MixUp::SameScan => "the same scan twice",
            MixUp::Outlier => "one angle 3 degrees off",
        }
    }

    /// Whether this verdict is the right one.
    pub fn is_met_by(self, verdict: Verdict) -> bool {
        match self {
            MixUp::Reversed => !matches!(verdict, Verdict::Hold),
            MixUp::Outlier => matches!(verdict, Verdict::Rescan | Verdict::Hold),
            _ => verdict == Verdict::Hold,
        }
    }

    /// Whether the scan that was shown is of no use and the right one follows.
    pub fn is_withdrawn(self) -> bool {
        !matches!(self, MixUp::Reversed | MixUp::Outlier)
    }

    /// The tube that is scanned instead of the right one; `other` is another part's.
    pub fn tube(self, right: &Lra, other: &Lra, rng: &mut ChaCha8Rng) -> Lra {
        match self {
            MixUp::Mirrored => right.mirrored(),
            MixUp::Swapped => other.clone(),
            MixUp::MissingBend => without(right, rng.random_range(0..right.bends.len().max(1))),
            _ => right.clone(),
        }
    }

    /// What is wrong with the scan itself.
    pub fn scan(self, mut measured: MeasuredTube, rng: &mut ChaCha8Rng) -> MeasuredTube {
        match self {
            MixUp::Reversed => measured.reversed(),
            MixUp::Outlier if !measured.bends.is_empty() => {
                let bend = rng.random_range(0..measured.bends.len());
                let off_rad = if rng.random_bool(0.5) { GROSS_RAD } else { -GROSS_RAD };
                let angle_rad = &mut measured.bends[bend].angle_rad;
                *angle_rad = (*angle_rad + off_rad).max(0.0);
                measured
            }
            _ => measured,
        }
    }

    /// What is said of the scan, after the one before.
    pub fn entry(self, entry: Scanned, before: Option<&Scanned>) -> Scanned {
        match before.filter(|_| self == MixUp::SameScan) {
            Some(before) => {
                Scanned { measured: before.measured.clone(), scan_id: before.scan_id.clone(), ..entry }
            }
            None => entry,
        }
    }
}

/// A tube with one row left out: its straights become one.
fn without(tube: &Lra, bend: usize) -> Lra {
    let mut out = tube.clone();
    if bend < out.bends.len() {
        let gone = out.bends.remove(bend);
        match out.bends.get_mut(bend) {
            Some(next) => {
                next.length_mm += gone.length_mm;
                next.rotation_rad += gone.rotation_rad;
            }
            None => out.last_length_mm += gone.length_mm,
        }
    }
    out
}
