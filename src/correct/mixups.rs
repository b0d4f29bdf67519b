//! Scans and tables that do not belong together, as far as the history itself tells: nothing is learned from these.
//!
//! Beside `replay`, which holds each scan against the part (wrong hand, wrong part, bends missing).

use super::history::History;
use super::replay::{Job, Replay, Used};
use super::verdict::{Code, Reason};
use crate::inspect::Known;
use crate::tube::Nominal;

/// By so much must the table before explain a tube better (difference of the sums of squares, in sigmas).
const CLEARLY: f64 = 60.0;

/// And so well must it (mean square, in sigmas).
const WELL: f64 = 3.0;

/// The first thing in a history that cannot be.
pub fn found(history: &History) -> Option<Reason> {
    same_scan(history).or_else(|| revisions(history))
}

/// One scan entered for two tubes.
fn same_scan(history: &History) -> Option<Reason> {
    let parts = &history.parts;
    for (i, part) in parts.iter().enumerate() {
        for (k, earlier) in parts[..i].iter().enumerate() {
            let Some(id) = part.scan_identities().find(|id| earlier.scan_identities().any(|e| e == *id))
            else {
                continue;
            };
            let text = format!("parts {} and {} are the same scan ({id}): one scan per part", k + 1, i + 1);
            return Some(Reason::new(Code::SameScan, text));
        }
    }
    None
}

/// A revision is one table, and there is no way back to an older one.
fn revisions(history: &History) -> Option<Reason> {
    let numbered = || history.parts.iter().enumerate().filter_map(|(i, p)| Some((i + 1, p.revision?, p)));
    for (number, revision, part) in numbered() {
        for (earlier, older, before) in numbered().take_while(|(k, ..)| *k < number) {
            let text = if revision == older && part.commanded != before.commanded {
                format!(
                    "parts {earlier} and {number} were both bent with revision {revision}, but with different tables"
                )
            } else if revision < older {
                format!(
                    "part {number} was bent with revision {revision}, part {earlier} before it with {older}"
                )
            } else {
                continue;
            };
            let text = format!("{text}: which table was this tube bent with?");
            return Some(Reason::new(Code::Revision, text));
        }
    }
    None
}

/// Whether the machine held another table than was answered for the newest tube, and nobody has approved that. The last straight does
/// not count: not every machine keeps it.
pub fn edited(job: &Job) -> Option<Reason> {
    let newest = job.history.parts.last().filter(|part| !part.approved)?;
    let machine = &job.limits.machine;
    let steps = (machine.length_resolution_mm, machine.angle_resolution_rad);
    let differences = newest.answered.as_ref()?.differences(&newest.commanded, steps);
    let text = || {
        format!(
            "the machine did not hold the table that was answered ({}): somebody changed it there. Put it back, or approve this tube \
             with the table as it is",
            differences.join("; ")
        )
    };
    (!differences.is_empty()).then(|| Reason::new(Code::TableEdited, text()))
}

/// Whether the newest tube is as the table before would have made it, and not as its own.
pub fn old_table(nominal: &Nominal, replay: &Replay) -> Option<Reason> {
    let [.., before, newest] = replay.used.as_slice() else { return None };
    let bends = 0..nominal.lra.bends.len();
    let misfit = |used: &Used| -> f64 {
        let one = |i: usize| {
            let (commanded, seen) = (used.commanded.bends[i].angle_rad, newest.measured.bends[i]);
            let Known { value, sigma } = replay.before.springback.next_at(i, commanded);
            ((commanded - seen.angle_rad - value) / sigma.hypot(seen.angle_sigma_rad)).powi(2)
        };
        bends.clone().filter(|i| !newest.outliers.contains(i)).map(one).sum()
    };
    let (own, older) = (misfit(newest), misfit(before));
    if own - older < CLEARLY || older > WELL * bends.len() as f64 {
        return None;
    }
    let text = "the newest tube is as the table before it would have made it: was the corrected table in force when it was bent?";
    Some(Reason::new(Code::Revision, text))
}
