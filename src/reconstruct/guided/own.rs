//! The nominal's structure beside the scan's own, which was asked in doubt; and what the user is told of either.

use super::super::likeness::{is_formed, rows};
use super::super::model::TubeModel;
use super::super::moves::without_bend;
use super::super::places::SHALLOW_RAD;
use super::super::search::DOUBT;
use super::super::sections::CentreLine;
use super::super::structure::{Shown, Structure};
use super::{AS_IT_IS, Chosen, Effort, FULLY, Guided, SIGMAS, fitted, told};

/// Two answers that differ by less than this and the sigmas are the same.
const SAME_ANGLE_RAD: f64 = 0.05 * std::f64::consts::PI / 180.0;

/// What is told of the nominal's structure beside the scan's own.
const KEPT: &str = "the scan's own explains it no better";
const LEFT: &str = "the scan's own explains it better";

/// What the five values of one bend more cost.
fn bend_price(line: &CentreLine, correlation: f64) -> f64 {
    5.0 * (line.count / correlation).max(2.0).ln()
}

impl Guided {
    /// Bends that the free search would not spend their values on.
    pub(super) fn resting(&self) -> Vec<String> {
        let worth_a_look = DOUBT * bend_price(&self.line, self.correlation);
        let mut out: Vec<(usize, String)> = Vec::new();
        for (i, bend) in self.best.model.lra.bends.iter().enumerate() {
            let sigma = self.angle_sigma_rad(i);
            if bend.angle_rad < SHALLOW_RAD && (bend.angle_rad / sigma).powi(2) < worth_a_look {
                let less = without_bend(&self.best.model, i);
                let effort = Effort { goal: self.best.score, ..FULLY };
                let less = fitted(&self.line, less, self.prior, self.correlation, effort);
                if less.score >= self.best.score {
                    continue;
                }
                let number = self.number(i);
                let text = format!(
                    "bend {number} rests on the nominal: {:.2} +- {:.2} degrees are too few for the scan to show it by itself",
                    bend.angle_rad.to_degrees(),
                    sigma.to_degrees()
                );
                out.push((number, text));
            }
        }
        out.sort_by_key(|(number, _)| *number);
        out.into_iter().map(|(_, text)| text).collect()
    }

    /// The better of the nominal's structure and the scan's own.
    pub(super) fn or_own(&self, own: Structure, shown: &Shown) -> Chosen {
        let n = self.part.bends.len();
        let line = CentreLine::measure(shown.sample, &own.model, true);
        let correlation = line.correlation(&own.model);
        let mine = fitted(&line, self.best.model.clone(), self.prior, correlation, FULLY);
        let other = fitted(&line, own.model.clone(), own.prior, correlation, AS_IT_IS);
        let bends = other.model.lra.bends.len();
        let sure = self.is_determined();
        let formed = self.is_formed_of_the_nominal();
        // The nominal's, but for what its further bends cost no worse: the free search spared itself the shallow ones.
        let saved = bend_price(&line, correlation) * n.saturating_sub(bends) as f64;
        let spared = formed && mine.score - saved <= other.score;
        let gain = other.score - mine.score;
        // As fitted beside the scan's own: its own fit may have lost its way.
        let mine_is_kept = || {
            let found =
                Guided::of(line.clone(), mine.model.clone(), self.prior, self.part.clone(), self.reversed);
            (told(found.structure(shown), KEPT, gain, true), found.resting())
        };
        if sure && (mine.score <= other.score || spared) {
            return mine_is_kept();
        }
        let groups = self.groups(&other.model);
        if bends == n && groups.is_empty() {
            return if sure { mine_is_kept() } else { (told(own, LEFT, gain, false), self.resting()) };
        }
        // The nominal's bends after all, which its own fit had misplaced.
        if is_formed(&rows(&other.model.lra), &rows(&self.part), other.model.tube_radius_mm) {
            return (told(own, LEFT, gain, false), Vec::new());
        }
        let what = if bends == 1 { "bend" } else { "bends" };
        let list = if groups.is_empty() { String::new() } else { format!("; {}", groups.join("; ")) };
        (
            told(own, LEFT, gain, false),
            vec![format!("the scan by itself shows {bends} {what}, the nominal has {n}{list}")],
        )
    }

    /// Bend by bend of the nominal where the other model has other angles there, both in figures.
    fn groups(&self, other: &TubeModel) -> Vec<String> {
        let spine = self.best.model.spine();
        let middle = |i: usize| {
            let arc = &spine.segments()[2 * i + 1];
            arc.start_mm + 0.5 * arc.length_mm
        };
        let n = self.part.bends.len();
        let mut there: Vec<Vec<f64>> = vec![Vec::new(); n];
        let theirs = other.spine();
        for (k, bend) in other.lra.bends.iter().enumerate() {
            let arc = &theirs.segments()[2 * k + 1];
            let point = arc.frame_at(0.5 * arc.length_mm).translation.vector.into();
            let at = spine.closest(&point).arc_length_mm;
            let nearest = (0..n).min_by(|a, b| (middle(*a) - at).abs().total_cmp(&(middle(*b) - at).abs()));
            there[nearest.unwrap_or(0)].push(bend.angle_rad);
        }
        let mut out: Vec<(usize, String)> = Vec::new();
        for (i, angles) in there.iter().enumerate() {
            let angle = self.best.model.lra.bends[i].angle_rad;
            let same = SAME_ANGLE_RAD + SIGMAS * self.angle_sigma_rad(i);
            if angles.len() != 1 || (angles[0] - angle).abs() > same {
                let mut theirs: Vec<String> =
                    angles.iter().map(|a| format!("{:.2}", a.to_degrees())).collect();
                if self.reversed {
                    theirs.reverse();
                }
                let own = if theirs.is_empty() { "none".to_owned() } else { theirs.join(" + ") };
                let number = self.number(i);
                let mine = angle.to_degrees();
                let text =
                    format!("bend {number}: {mine:.2} by the nominal's structure, {own} by the scan's own");
                out.push((number, text));
            }
        }
        out.sort_by_key(|(number, _)| *number);
        out.into_iter().map(|(_, text)| text).collect()
    }
}
