//! Replays a job's history into what is believed now: every part turned to the nominal's direction, checked,
//! learned from. No state is kept between steps: the same history gives the same belief.

use super::estimate::{Outlier, Springback};
use super::history::{History, Part};
use super::knowledge::{Key, Knowledge};
use super::lengths::Lengths;
use super::plan::{self, Limits};
use super::rotations::Rotations;
use super::scans::{self, Fused};
use super::verdict::{Code, Reason};
use crate::inspect::{self, Known};
use crate::tube::{CommandTable, Lra, MeasuredTube, Nominal};

/// A part that taught something.
#[derive(Debug, Clone)]
pub struct Used {
    /// Which part of the history, from 1.
    pub number: usize,
    /// Its table.
    pub commanded: CommandTable,
    /// Its measurement in the nominal's direction.
    pub measured: MeasuredTube,
    /// Bends whose angle was rejected.
    pub outliers: Vec<usize>,
    /// Scans behind the measurement.
    pub scans: usize,
}

/// Beliefs of one job.
#[derive(Debug, Clone)]
pub struct Model {
    /// Angles.
    pub springback: Springback,
    /// Feeds.
    pub lengths: Lengths,
    /// Planes.
    pub rotations: Rotations,
}

/// The history worked through.
#[derive(Debug, Clone)]
pub struct Replay {
    /// What is believed now.
    pub model: Model,
    /// What was believed before the newest tube.
    pub before: Model,
    /// The parts that were learned from, oldest first.
    pub used: Vec<Used>,
    /// What became of the newest part.
    pub newest: Newest,
    /// Earlier parts left out, and why.
    pub left_out: Vec<Reason>,
}

/// The newest part.
#[derive(Debug, Clone)]
pub enum Newest {
    /// There is none yet.
    None,
    /// It was learned from (the last of `used`).
    Used {
        /// Its other direction fits nearly as well.
        ambiguous: bool,
        /// Bends rejected.
        outliers: Vec<Outlier>,
    },
    /// It is no tube to learn from.
    Refused(Reason),
}

/// All that a step is given.
#[derive(Debug, Clone, Copy)]
pub struct Job<'a> {
    /// The part, without rows of angle 0.
    pub nominal: &'a Nominal,
    /// What was bent and measured.
    pub history: &'a History,
    /// What is known of the key.
    pub knowledge: &'a Knowledge,
    /// What a correction may do.
    pub limits: &'a Limits,
}

/// Works the history through. `turn_newest` reads the newest part against the better direction.
pub fn replay(job: &Job, turn_newest: bool) -> Replay {
    let Job { nominal, history, knowledge, .. } = *job;
    let key = Key::of(nominal, &history.key);
    let records = knowledge.of_others(&key, history.job_id(nominal).as_deref());
    let model = Model {
        springback: Springback::prior(nominal, &records, history.batch.as_deref()),
        lengths: Lengths::prior(&nominal.lra, &records),
        rotations: Rotations::prior(&nominal.lra, &records),
    };
    let mut out =
        Replay { before: model.clone(), model, used: Vec::new(), newest: Newest::None, left_out: Vec::new() };
    // The scans of the tube that is being read, in the nominal's direction.
    let mut scans: Vec<MeasuredTube> = Vec::new();
    for (i, part) in history.parts.iter().enumerate() {
        let newest = i + 1 == history.parts.len();
        let same_table = out.used.last().is_some_and(|used| used.commanded == part.commanded);
        let again = part.rescan && same_table && !scans.is_empty();
        match oriented(job, part, if again { &out.before } else { &out.model }, newest && turn_newest) {
            Ok((measured, ambiguous)) => {
                scans.push(measured);
                let whole = scans::fused(&scans).filter(|_| again);
                let fused = match whole {
                    Some(fused) => {
                        // What the tube taught is replaced by what it teaches now.
                        out.model = out.before.clone();
                        out.used.pop();
                        fused
                    }
                    None => {
                        scans.drain(..scans.len() - 1);
                        out.before = out.model.clone();
                        Fused::single(scans[0].clone())
                    }
                };
                let outliers = out.model.learn(nominal, &part.commanded, &fused);
                out.used.push(Used {
                    number: i + 1,
                    commanded: part.commanded.clone(),
                    measured: fused.measured,
                    outliers: outliers.iter().map(|o| o.bend).collect(),
                    scans: scans.len(),
                });
                out.newest = Newest::Used { ambiguous, outliers };
            }
            Err(reason) if newest => out.newest = Newest::Refused(reason),
            Err(reason) => {
                if !part.rescan {
                    scans.clear();
                }
                let text = format!("part {} of the history was left out: {}", i + 1, reason.text);
                out.left_out.push(Reason::new(Code::LeftOut, text));
            }
        }
    }
    out
}

impl Model {
    fn learn(&mut self, nominal: &Nominal, commanded: &CommandTable, fused: &Fused) -> Vec<Outlier> {
        let measured = &fused.measured;
        let angles: Vec<f64> = commanded.bends.iter().map(|r| r.angle_rad).collect();
        let known = |b: &crate::tube::MeasuredBend| Known { value: b.angle_rad, sigma: b.angle_sigma_rad };
        let formed: Vec<Known> = measured.bends.iter().map(known).collect();
        let outliers = self.springback.learn(&angles, &formed, &fused.agreed);
        self.lengths.learn(commanded, measured);
        self.rotations.learn(commanded, measured, nominal.tolerance.rotation_rad);
        outliers
    }

    /// The tube that a table should give, on the nominal's radii.
    pub(super) fn expected(&self, nominal: &Nominal, commanded: &CommandTable) -> Lra {
        let angles: Vec<f64> = commanded.bends.iter().map(|r| r.angle_rad).collect();
        let formed: Vec<f64> =
            angles.iter().enumerate().map(|(i, &c)| c - self.springback.at(i, c).value).collect();
        let mut out = nominal.lra.clone();
        for (i, bend) in out.bends.iter_mut().enumerate() {
            bend.length_mm = commanded.bends[i].length_mm + self.lengths.growth(i, &angles, &formed).value;
            bend.rotation_rad = commanded.bends[i].rotation_rad;
            bend.angle_rad = formed[i];
        }
        out
    }
}

/// The part's measurement in the nominal's direction, and whether the other fits nearly as well.
fn oriented(job: &Job, part: &Part, model: &Model, turn: bool) -> Result<(MeasuredTube, bool), Reason> {
    let Job { nominal, limits, .. } = *job;
    let wanted = nominal.lra.bends.len();
    let unusable = |text: String| Reason::new(Code::Unusable, text);
    inspect::check(&part.measured).map_err(|e| unusable(e.to_string()))?;
    part.commanded.validate().map_err(|e| unusable(format!("commanded table, {e}")))?;
    if part.commanded.bends.len() != wanted {
        let text = format!("the commanded table has {} bends, the part {wanted}", part.commanded.bends.len());
        return Err(Reason::new(Code::Program, text + ": which program ran?"));
    }
    if let Some(other) = part.program.as_ref().filter(|program| **program != nominal.name) {
        let text =
            format!("it was bent with program {other:?}, this part's is {:?}: load that one", nominal.name);
        return Err(Reason::new(Code::Program, text));
    }
    if let Some(off) = plan::violations(&part.commanded, nominal, limits).first() {
        let text = format!("the commanded table is not this part's: {}", off.text);
        return Err(Reason::new(Code::Program, text));
    }
    if let Some(text) = inspect::other_diameter(&part.measured, nominal) {
        return Err(Reason::new(Code::WrongPart, format!("{text}: which part was scanned?")));
    }
    let settled = part.measured.reversed.is_some();
    if part.measured.bends.len() != wanted {
        let seen = inspect::inspect(&part.measured, nominal).map_err(|e| unusable(e.to_string()))?;
        return Err(Reason::new(Code::BendCount, seen.advice));
    }
    let expected = model.expected(nominal, &part.commanded);
    let reading = inspect::reading(&part.measured, &expected, settled);
    if reading.wrong_hand {
        let text = "the mirror image of the part fits better: check program and loading";
        return Err(Reason::new(Code::WrongHand, text));
    }
    if !reading.misfit.far.is_empty() {
        let text =
            format!("not what this table bends: {}; which part was scanned?", reading.misfit.far.join(", "));
        return Err(Reason::new(Code::WrongPart, text));
    }
    let mut measured =
        if reading.reversed != turn { part.measured.reversed() } else { part.measured.clone() };
    measured.reversed = Some(settled || reading.reversed != turn);
    Ok((measured, !reading.clear))
}
