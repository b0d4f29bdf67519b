//! Deviations to the next bending table: spring-back, feeds, planes, limits, verdicts.
//!
//! Between `inspect` and `bender`. [`step`] is pure: history and knowledge in, one [`Answer`] out, nothing kept.
//! The way through: [`history`] (the contract) -> [`replay`] (turn each scan round, learn from it: [`estimate`]
//! angles, [`lengths`] feeds, [`rotations`] planes) -> `inspect` (is the newest good?) -> [`plan`] (the next table within
//! limits; [`shape`] has the whole tube in view) -> [`predicted`] (what it will bend) -> [`verdict`].
//!
//! What jobs leave behind is [`knowledge`], on disk by [`store`]; [`import`] puts in what others know, [`learned`] and
//! [`summary`] say what is believed of a key.

mod approval;
mod belief;
mod check;
pub mod estimate;
mod gates;
pub mod history;
pub mod import;
pub mod knowledge;
pub mod learned;
pub mod lengths;
mod mixups;
pub mod next_tube;
pub mod plan;
pub mod predicted;
pub mod replay;
pub mod rotations;
pub mod rounding;
mod rows;
mod scans;
pub mod shape;
mod steps;
pub mod store;
pub mod summary;
pub mod values;
pub mod verdict;
mod worse;

pub use history::{Changed, History, Part, SetUp};
pub use knowledge::Knowledge;
pub use plan::Limits;
pub use predicted::{Predicted, PredictedPoint};
pub use verdict::{Answer, Code, Reason, Verdict};

use crate::inspect::{self, Inspection};
use crate::tube::{Bend, CommandTable, MeasuredTube, Nominal};
use predicted::foretold;
use replay::{Job, Newest, Replay, Used, replay};
use rows::Rows;
use shape::{Case, shaped};

/// A change of all bends together that is likelier than this is no chance.
const CERTAIN: f64 = 0.995;
/// An angle is surely off, or out, by so many standard deviations of the next tube's.
const SURE_SIGMAS: f64 = 2.0;

/// One step of the loop: what the history says, and the table to bend with next.
pub fn step(nominal: &Nominal, history: &History, knowledge: &Knowledge, limits: &Limits) -> Answer {
    let rows = Rows::of(nominal);
    let (bent, merged) = (rows.merged(nominal), rows.merge(history));
    rows.expand(step_of_bends(&Job { nominal: &bent, history: &merged, knowledge, limits }))
}

/// What was known with what this job showed put in; a job replaces its own earlier record.
pub fn learn(nominal: &Nominal, history: &History, knowledge: &Knowledge, limits: &Limits) -> Knowledge {
    let rows = Rows::of(nominal);
    let (nominal, history) = (rows.merged(nominal), rows.merge(history));
    let mut out = knowledge.clone();
    if mixups::found(&history).is_none() {
        let job = Job { nominal: &nominal, history: &history, knowledge, limits };
        let replay = replay(&job, false);
        if let Some(record) = knowledge::record(&nominal, &history, &replay.used) {
            out.put(&knowledge::Key::of(&nominal, &history.key), record);
        }
    }
    out
}

/// For tables without rows of angle 0.
fn step_of_bends(job: &Job) -> Answer {
    let read = replay(job, false);
    foretold(job, &read, either_way(job, &read))
}

/// What is decided, unless it depends on from which end the newest part was scanned.
fn either_way(job: &Job, read: &Replay) -> Answer {
    let decided = decide(job, read);
    let Newest::Used { ambiguous: true, .. } = read.newest else { return decided };
    let turned = decide(job, &replay(job, true));
    if matters(&decided, &turned, job.nominal) {
        let text = "the scan fits the part from both ends, and the next table depends on which it was: mark the \
                    first end and scan again";
        return held(job, read, vec![Reason::new(Code::Direction, text)]);
    }
    decided
}

fn decide(job: &Job, replay: &Replay) -> Answer {
    if let Some(reason) = mixups::found(job.history) {
        return held(job, replay, vec![reason]);
    }
    match (&replay.newest, replay.used.last()) {
        (Newest::Refused(reason), _) => held(job, replay, vec![reason.clone()]),
        (Newest::Used { outliers, .. }, Some(newest)) => {
            if let Some(reason) = mixups::edited(job).or_else(|| mixups::old_table(job.nominal, replay)) {
                return held(job, replay, vec![reason]);
            }
            let mut doubts = gates::doubts(job.nominal, newest, outliers);
            doubts.extend(gates::scan_score(replay));
            if doubts.is_empty() {
                settled(job, replay, judged(job, replay, newest))
            } else {
                answer(Verdict::Rescan, newest.commanded.clone(), replay, doubts)
            }
        }
        (Newest::None, _) | (Newest::Used { .. }, None) => first_piece(job, replay),
    }
}

fn first_piece(job: &Job, replay: &Replay) -> Answer {
    let mut table = plan::first(&replay.model, job.nominal);
    plan::clamp(&mut table, job.limits);
    let case = Case { model: &replay.model, nominal: job.nominal, newest: None, limits: job.limits };
    let table = shaped(&case, table);
    let violations = plan::violations(&table, job.nominal, job.limits);
    if !violations.is_empty() {
        return held(job, replay, violations);
    }
    answer(Verdict::FirstPiece, table, replay, Vec::new())
}

/// The newest part is a fair measurement of what its table bends: good, to correct, or past correcting.
fn judged(job: &Job, replay: &Replay, newest: &Used) -> Answer {
    let nominal = job.nominal;
    let in_force = newest.commanded.clone();
    let inspection = match inspect::inspect(&trimmed(&newest.measured, nominal), nominal) {
        Ok(inspection) => inspection,
        Err(e) => return held(job, replay, vec![Reason::new(Code::Unusable, e.to_string())]),
    };
    let mut reasons: Vec<Reason> = cut_length(&newest.measured, job).into_iter().collect();
    let (table, changes) = plan::next(&replay.model, nominal, newest, job.limits);
    let violations = plan::violations(&table, nominal, job.limits);
    if inspection.verdict == inspect::Verdict::InTolerance {
        let narrow = narrow(nominal, replay, newest);
        if narrow.is_empty() || table == in_force || !violations.is_empty() {
            return answer(Verdict::InTolerance, in_force, replay, reasons);
        }
        reasons.extend(narrow);
    }
    if !violations.is_empty() {
        return held(job, replay, violations);
    }
    reasons.extend(changes);
    if table != in_force {
        return answer(Verdict::Correct, table, replay, reasons);
    }
    if inspection.verdict != inspect::Verdict::Uncertain {
        let text = format!("{}, but no row by more than its dead band: the table stays", inspection.advice);
        reasons.push(Reason::new(Code::Scatter, text));
        return answer(Verdict::Correct, in_force, replay, reasons);
    }
    undecided(job, replay, newest, reasons, &inspection)
}

/// Angles that the newest tube's table surely makes off, as it shows, and so far that the next may be out though this one is not.
fn narrow(nominal: &Nominal, replay: &Replay, newest: &Used) -> Vec<Reason> {
    let deg = f64::to_degrees;
    let tolerance = nominal.tolerance.angle_rad;
    let reason = |(i, wanted): (usize, &Bend)| {
        let commanded_rad = newest.commanded.bends.get(i)?.angle_rad;
        let seen = newest.measured.bends.get(i)?.angle_rad - wanted.angle_rad;
        let next = replay.model.springback.next_at(i, commanded_rad);
        let off = commanded_rad - next.value - wanted.angle_rad;
        let doubt = SURE_SIGMAS * next.sigma;
        let text = format!(
            "angle {}: this tube is good, but its table bends {:+.2} +-{:.2} degrees off (one sigma), tolerance is {:.2}: the next \
             may not be",
            i + 1,
            deg(off),
            deg(next.sigma),
            deg(tolerance)
        );
        let shows = seen * off.signum() > 0.5 * off.abs();
        let is_narrow = shows && off.abs() > doubt && off.abs() + doubt > tolerance;
        is_narrow.then(|| Reason::at(Code::Margin, i, text))
    };
    nominal.lra.bends.iter().enumerate().filter_map(reason).collect()
}

/// Neither good nor bad for certain, and nothing to change: scanned again where that can tell, else left as it is.
fn undecided(
    job: &Job,
    replay: &Replay,
    newest: &Used,
    mut reasons: Vec<Reason>,
    inspection: &Inspection,
) -> Answer {
    let in_force = newest.commanded.clone();
    let sharper = trimmed(&scans::with_one_more(&newest.measured, newest.scans), job.nominal);
    let could_decide =
        inspect::inspect(&sharper, job.nominal).is_ok_and(|seen| seen.verdict != inspect::Verdict::Uncertain);
    if could_decide || !inspection.is_whole() {
        reasons.push(Reason::new(Code::Unseen, inspection.advice.clone()));
        return answer(Verdict::Rescan, in_force, replay, reasons);
    }
    let text = format!(
        "{}; another scan like {} would not decide it: the table stays, it is as good as it can be made; gauge this \
         tube, or scan more densely",
        inspection.advice,
        if newest.scans > 1 { "these" } else { "this" }
    );
    reasons.push(Reason::new(Code::Unproven, text));
    answer(Verdict::Correct, in_force, replay, reasons)
}

/// The same tube with its last straight as long as wanted: that end is the cut length's matter.
fn trimmed(measured: &MeasuredTube, nominal: &Nominal) -> MeasuredTube {
    let mut out = measured.clone();
    let n = nominal.lra.bends.len();
    let wanted = nominal.lra.last_length_mm;
    let corner = inspect::corners(measured, &nominal.lra);
    out.last_length_mm = Some(wanted);
    out.last_length_sigma_mm = Some(0.0);
    if let (Some(last), Some(true)) = (nominal.lra.bends.last(), corner.last()) {
        // By its corner distance, so that the formed radius does not matter.
        let tangent = last.radius_mm * (measured.bends[n - 1].angle_rad / 2.0).tan();
        out.intersection_mm.resize(n + 1, None);
        out.intersection_sigma_mm.resize(n + 1, None);
        out.intersection_mm[n] = Some(wanted + tangent);
        out.intersection_sigma_mm[n] = Some(0.0);
    }
    out
}

fn cut_length(whole: &MeasuredTube, job: &Job) -> Option<Reason> {
    let last = inspect::last_length(whole, job.nominal)?;
    let off = last.deviation?;
    if off.abs() <= job.nominal.tolerance.length_mm {
        return None;
    }
    let how = if off < 0.0 { "longer" } else { "shorter" };
    let cut = job.history.parts.last().and_then(|p| p.cut_length_mm);
    let figure = cut.map_or(String::new(), |c| format!(" ({:.1} mm)", c - off));
    let text = format!(
        "the last straight is {:.2} mm instead of {:.2}: cut the tube {:.2} mm {how}{figure}, no feed corrects that",
        last.nominal + off,
        last.nominal,
        off.abs()
    );
    Some(Reason::new(Code::CutLength, text))
}

/// What is judged, unless a person has to look first: at tubes that changed, at corrections that do harm, at the first good
/// tube after a change.
fn settled(job: &Job, replay: &Replay, judged: Answer) -> Answer {
    // First: a machine that turns every correction round looks like one change of batch after the other.
    if judged.verdict == Verdict::Correct
        && let Some((table, reason)) = worse::worse_twice(job.nominal, replay)
    {
        return answer(Verdict::Hold, table, replay, vec![reason]);
    }
    let judged = batch_changed(job, replay, judged);
    let awaited = approval::awaited(job.history).filter(|_| judged.verdict == Verdict::InTolerance);
    let Some(reason) = awaited else { return judged };
    let reasons = std::iter::once(reason).chain(judged.reasons).collect();
    Answer { verdict: Verdict::Hold, reasons, ..judged }
}

/// Tubes that suddenly spring back otherwise, all bends alike, are another batch, or the set-up was changed: somebody has to look, and
/// approve the table that was found.
fn batch_changed(job: &Job, replay: &Replay, judged: Answer) -> Answer {
    let Some(change) = replay.model.springback.change() else { return judged };
    let tolerance = job.nominal.tolerance.angle_rad;
    let bends = judged.commanded.bends.iter().enumerate();
    let most_rad =
        bends.map(|(i, row)| replay.before.springback.at(i, row.angle_rad).value).fold(0.0, f64::max);
    let matters = (change.by.value * most_rad).abs() > tolerance / 2.0;
    if judged.verdict != Verdict::Correct || change.chance < CERTAIN || !matters {
        return judged;
    }
    let percent = |share: f64| 100.0 * share;
    let text = format!(
        "all bends spring back {:+.0} +-{:.0} % against the tubes before: another batch of material, other lubrication, another \
         mandrel? The table is right for tubes like this one: approve it when the change is meant to stay",
        percent(change.by.value),
        percent(change.by.sigma)
    );
    let mut reasons = vec![Reason::new(Code::BatchChanged, text)];
    reasons.extend(judged.reasons);
    Answer { verdict: Verdict::Hold, reasons, ..judged }
}

/// Whether two answers differ by more than half a tolerance anywhere, or in verdict.
fn matters(a: &Answer, b: &Answer, nominal: &Nominal) -> bool {
    let tolerance = &nominal.tolerance;
    let both = a.commanded.bends.iter().zip(&b.commanded.bends);
    let differs = |(a, b): (&crate::tube::CommandRow, &crate::tube::CommandRow)| {
        (a.angle_rad - b.angle_rad).abs() > tolerance.angle_rad / 2.0
            || (a.rotation_rad - b.rotation_rad).abs() > tolerance.rotation_rad / 2.0
            || (a.length_mm - b.length_mm).abs() > tolerance.length_mm / 2.0
    };
    let stops = |a: &Answer| matches!(a.verdict, Verdict::Rescan | Verdict::Hold);
    stops(a) != stops(b) || both.into_iter().any(differs)
}

fn held(job: &Job, replay: &Replay, reasons: Vec<Reason>) -> Answer {
    let in_force = job.history.parts.last().map(|p| p.commanded.clone());
    let table = in_force.unwrap_or_else(|| CommandTable::from_lra(&job.nominal.lra));
    answer(Verdict::Hold, table, replay, reasons)
}

fn answer(verdict: Verdict, commanded: CommandTable, replay: &Replay, reasons: Vec<Reason>) -> Answer {
    // A table of another program has more or fewer rows than there is belief about.
    let bends = commanded.bends.iter().take(replay.model.springback.bends()).enumerate();
    let next: Vec<_> = bends.map(|(i, row)| replay.model.springback.next_at(i, row.angle_rad)).collect();
    let clean = crate::tube::deg::to_degrees_clean;
    Answer {
        verdict,
        springback_deg: next.iter().map(|k| clean(k.value)).collect(),
        springback_sigma_deg: next.iter().map(|k| clean(k.sigma)).collect(),
        predicted: None,
        commanded,
        reasons: reasons.into_iter().chain(replay.left_out.iter().cloned()).collect(),
    }
}
