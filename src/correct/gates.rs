//! Measurement gates: a scan that nothing should be concluded from is asked for again, with what to scan.
//!
//! An end that was not scanned is no reason by itself: its feed stays as it is, and only a tube that is good otherwise is
//! scanned again for it (`Unseen`). Short straights need no gate: their bends' sigmas say what they are worth.

use super::estimate::{Outlier, median};
use super::replay::{Replay, Used};
use super::verdict::{Code, Reason};
use crate::tube::{MeasuredTube, Nominal};

/// Axes of neighbouring straights that pass each other farther apart were not measured on one tube standing still.
const NEAREST_PASS_MM: f64 = 2.0;

/// A straight's points scatter too much when by so many times the tube's middle one, and two sigma are over half the envelope.
const STRAIGHT_TIMES: f64 = 2.0;

/// A scan is worse than this part's usual when its points lie so many times as far off, or so small a share of the usual is used.
const SCORE_TIMES: f64 = 2.0;
const SCORE_SHARE: f64 = 0.75;

/// So many tubes make what is usual.
const USUAL: usize = 3;

/// Measurements that nothing should be concluded from: too uncertain, or unlike this bend's others.
pub fn doubts(nominal: &Nominal, newest: &Used, outliers: &[Outlier]) -> Vec<Reason> {
    let deg = f64::to_degrees;
    let tolerance = nominal.tolerance.angle_rad;
    let bends = newest.measured.bends.iter().enumerate();
    let uncertain = bends.filter(|(_, b)| 2.0 * b.angle_sigma_rad > tolerance).map(|(i, b)| {
        let text = format!(
            "angle {} is known to +-{:.2} degrees (one sigma) only, tolerance is {:.2}: scan both its straights again",
            i + 1,
            deg(b.angle_sigma_rad),
            deg(tolerance)
        );
        Reason::at(Code::TooUncertain, i, text)
    });
    let odd = outliers.iter().map(|o| {
        let text = format!(
            "bend {}: spring-back {:.2} degrees where {:.2} +-{:.2} is expected: scan again; if it stays, look at clamp and mandrel",
            o.bend + 1,
            deg(o.found_rad),
            deg(o.expected_rad.value),
            deg(o.expected_rad.sigma)
        );
        Reason::at(Code::Outlier, o.bend, text)
    });
    uncertain.chain(odd).chain(straights(nominal, newest)).chain(nearest_pass(newest)).collect()
}

/// The fit of each straight, at two sigma.
fn straights(nominal: &Nominal, newest: &Used) -> Vec<Reason> {
    let all = &newest.measured.straight_rms_mm;
    let Some(usual) = median(all.iter().copied().flatten().collect()) else { return Vec::new() };
    let most = (STRAIGHT_TIMES * usual).max(nominal.tolerance.envelope_mm / 4.0);
    let bad = all.iter().enumerate().filter_map(|(i, rms)| Some((i, (*rms)?))).filter(|(_, rms)| *rms > most);
    bad.map(|(i, rms)| {
        let text = format!(
            "straight {}: its points lie +-{:.2} mm (two sigma) about the tube, allowed is {:.2}, the others {:.2}: scan it again; if it \
             stays, it is bowed or dented: take another tube",
            i + 1,
            2.0 * rms,
            2.0 * most,
            2.0 * usual
        );
        Reason::new(Code::StraightFit, text)
    })
    .collect()
}

/// How far the axes beside each bend pass each other, where they were measured one by one.
fn nearest_pass(newest: &Used) -> Vec<Reason> {
    let all = newest.measured.nearest_pass_mm.iter().enumerate();
    let far = all.filter_map(|(i, gap)| Some((i, (*gap)?))).filter(|(_, gap)| *gap > NEAREST_PASS_MM);
    far.map(|(i, gap)| {
        let text = format!(
            "bend {}: the axes beside it pass {gap:.2} mm from each other, allowed is {NEAREST_PASS_MM:.2}: scan both straights again, \
             the tube held still",
            i + 1
        );
        Reason::at(Code::NearestPass, i, text)
    })
    .collect()
}

/// The scan against those of this part's tubes before. What a second scan shows too is how this tube is.
pub fn scan_score(replay: &Replay) -> Option<Reason> {
    let (newest, earlier) = replay.used.split_last()?;
    let usual = |of: fn(&MeasuredTube) -> Option<f64>| {
        let known: Vec<f64> = earlier.iter().filter_map(|used| of(&used.measured)).collect();
        median(known.clone()).filter(|_| known.len() >= USUAL).zip(of(&newest.measured))
    };
    let residual = usual(|m| Some(m.residual_median_mm).filter(|r| *r > 0.0));
    let share = usual(|m| (m.points_total > 0).then(|| m.points_used as f64 / m.points_total as f64));
    let what = match (residual, share) {
        _ if newest.scans > 1 => return None,
        (Some((usual, found)), _) if found > SCORE_TIMES * usual => {
            format!(
                "half its points lie more than {found:.3} mm off the tube, {usual:.3} is usual for this part"
            )
        }
        (_, Some((usual, found))) if found < SCORE_SHARE * usual => {
            let percent = |share: f64| 100.0 * share;
            format!(
                "{:.0} % of its points are of the tube, {:.0} % is usual for this part",
                percent(found),
                percent(usual)
            )
        }
        _ => return None,
    };
    let text = format!(
        "this scan is worse than those before: {what}; see that arm and tube stand firm, clean the tube, scan it again"
    );
    Some(Reason::new(Code::ScanScore, text))
}
