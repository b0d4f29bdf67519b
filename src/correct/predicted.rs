//! What the answer says of the next tube: where its check points will be, and why no table brings them nearer.

use serde::{Deserialize, Serialize};

use super::next_tube::NextTube;
use super::replay::{Job, Replay};
use super::shape::Case;
use super::values::Value;
use super::verdict::{Answer, Code, Reason, Verdict};
use crate::inspect::{Place, check_point};
use crate::tube::deg::to_degrees_clean;
use crate::tube::{Alignment, CommandTable, Nominal};

/// The mean of the next tubes at the table answered, as the machine rounds it.
///
/// Its sigmas hold what is not known of spring-back, feeds and planes, and the usual scatter of bends, feeds and the rotation
/// axis, as if independent of each other. They do not hold slip, a change of material, the cut length (the last straight
/// counts as the part's) or what a scan adds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Predicted {
    /// How it is laid over the nominal.
    pub alignment: Alignment,
    /// Allowed deviation of a check point.
    pub envelope_mm: f64,
    /// The check point that is farthest off.
    pub worst: PredictedPoint,
    /// All in feed order; rows of angle 0 begin no straight.
    pub points: Vec<PredictedPoint>,
    /// Angle formed less wanted, of each bend.
    pub angle_deviation_deg: Vec<f64>,
}

/// One check point.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PredictedPoint {
    /// Straight counted from 1.
    pub straight: usize,
    /// Where on it.
    pub place: Place,
    /// Distance from the nominal's.
    pub deviation_mm: f64,
    /// By how much the next tube's may lie elsewhere, in the worst direction.
    pub sigma_mm: f64,
}

/// The answer with what is expected of its table; a hold bends nothing, unless it proposes a table for approval.
pub fn foretold(job: &Job, replay: &Replay, mut answer: Answer) -> Answer {
    let wanted = job.nominal.lra.bends.len();
    let proposes = answer.is_about(Code::BatchChanged);
    if (answer.verdict == Verdict::Hold && !proposes) || answer.commanded.bends.len() != wanted {
        return answer;
    }
    let Replay { model, used, .. } = replay;
    let case = Case { model, nominal: job.nominal, newest: used.last(), limits: job.limits };
    let Some(tube) = case.next_tube(&answer.commanded) else { return answer };
    if proposes || matches!(answer.verdict, Verdict::FirstPiece | Verdict::Correct) {
        answer.reasons.extend(reasons(&case, &answer.commanded, &tube));
    }
    answer.predicted = Some(predicted(&case, &answer.commanded, &tube));
    answer
}

fn predicted(case: &Case, table: &CommandTable, tube: &NextTube) -> Predicted {
    let sigmas = tube.point_sigmas(&tube.overlay.moves(), &tube.sigmas(case.model, table));
    let point = |(k, (off, sigma_mm)): (usize, (&nalgebra::Vector3<f64>, f64))| {
        let (straight, place) = check_point(k);
        PredictedPoint { straight, place, deviation_mm: off.norm(), sigma_mm }
    };
    let points: Vec<PredictedPoint> = tube.overlay.off_mm.iter().zip(sigmas).enumerate().map(point).collect();
    Predicted {
        alignment: case.nominal.tolerance.alignment,
        envelope_mm: case.nominal.tolerance.envelope_mm,
        worst: points[tube.worst_point().0],
        points,
        angle_deviation_deg: tube
            .own_off(case.nominal)
            .chunks(3)
            .map(|off| to_degrees_clean(off[2]))
            .collect(),
    }
}

/// What was gained for the whole tube, and what stands in the way of a good one.
fn reasons(case: &Case, table: &CommandTable, tube: &NextTube) -> Vec<Reason> {
    let nominal = case.nominal;
    let mut out = Vec::new();
    let Some(each) = case.next_tube(&case.each_for_itself(table)) else { return out };
    if !case.matters(&each) {
        return out;
    }
    let (before, after) = (each.worst_point().1, tube.worst_point().1);
    if after < before {
        let text = format!(
            "the table is made for the whole tube: check points up to {after:.2} mm off are expected, {before:.2} with each value \
             for itself"
        );
        out.push(Reason::new(Code::WholeTube, text));
    }
    if tube.share(nominal) <= 1.0 {
        return out;
    }
    let within_limits = case.next_tube_within_limits(table);
    if within_limits.is_some_and(|tube| tube.share(nominal) > 1.0) {
        out.push(out_of_reach(case, table, tube));
    } else if each.share(nominal) > 1.0 {
        let machine = &case.limits.machine;
        let text = format!(
            "{}: the machine's steps of {} mm and {} degrees are too coarse for the tolerance; widen it, or expect to sort tubes \
             out",
            off(tube, nominal),
            machine.length_resolution_mm,
            to_degrees_clean(machine.angle_resolution_rad)
        );
        out.push(Reason::new(Code::Resolution, text));
    }
    out
}

/// What is expected to be off most of all, beside what is allowed.
fn off(tube: &NextTube, nominal: &Nominal) -> String {
    let tolerance = &nominal.tolerance;
    let ((bend, angle), (point, mm)) = (tube.worst_angle(nominal), tube.worst_point());
    if angle.abs() / tolerance.angle_rad > mm / tolerance.envelope_mm {
        let (angle, allowed) = (angle.to_degrees(), tolerance.angle_rad.to_degrees());
        return format!("angle {} is expected {angle:+.2} degrees off, allowed is {allowed:.2}", bend + 1);
    }
    let (straight, place) = check_point(point);
    let allowed = tolerance.envelope_mm;
    format!("the {place} of straight {straight} is expected {mm:.2} mm off, allowed is {allowed:.2}")
}

fn out_of_reach(case: &Case, table: &CommandTable, tube: &NextTube) -> Reason {
    let short = |v: &Value| (v.best - v.aim()) / v.tolerance;
    let values = case.values(table);
    let farthest = values.iter().enumerate().max_by(|a, b| short(a.1).abs().total_cmp(&short(b.1).abs()));
    let off = off(tube, case.nominal);
    let Some((k, value)) = farthest else { return Reason::new(Code::OutOfReach, off) };
    let (what, unit, size) = [
        ("feed", "mm", 1.0),
        ("rotation", "degrees", 1f64.to_radians()),
        ("angle", "degrees", 1f64.to_radians()),
    ][k % 3];
    let (aim, best) = (value.aim() / size, value.best / size);
    let advice = if k % 3 == 0 && value.best < value.low && case.is_shortest(k / 3, value.low) {
        "the machine feeds no less: a longer straight or another clamp is needed"
    } else if k % 3 == 1 && value.low == value.high {
        "its plane cannot be seen well enough to correct it: scan both its bends more densely"
    } else {
        "a part may bring no more: bend the next one and go on from it"
    };
    let text = format!(
        "{off}, and no other value can make up for it: {what} {} is held at {aim:.2} {unit} where {best:.2} would be right; {advice}",
        k / 3 + 1
    );
    Reason::at(Code::OutOfReach, k / 3, text)
}
