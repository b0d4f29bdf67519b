//! What knowing the nominal did: which structure was taken, whether an alarm was raised, and whether wrong nominals are
//! recognised. Read off what the user is told: the decisions and the warnings.

use nalgebra::Point3;

use super::nominal::{Drawn, Wrong};
use super::{Case, Tally};
use crate::reconstruct::Reconstruction;
use crate::tube::{MeasuredTube, Spine};

/// How a decision on the nominal's structure begins, and what is told when the free search was not asked.
const OF_THE_NOMINAL: &str = "the nominal's structure";
const UNDOUBTED: &str = "nothing in the scan speaks against it";

/// How the warning begins that gives both answers.
const DISAGREES: &str = "the scan by itself shows";

/// Which structure the answer has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Taken {
    /// The nominal's; the free search was not asked.
    Undoubted,
    /// The nominal's after the free search.
    Checked,
    /// The scan's own.
    Own,
}

/// What came of a wrong nominal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Answer {
    /// A warning says in what it is wrong.
    Recognised,
    /// A warning says that something else is wrong.
    CalledOtherwise,
    /// An error instead of a result.
    Refused,
    /// No word of it.
    Missed,
}

impl Answer {
    const ALL: [Answer; 4] = [Answer::Recognised, Answer::CalledOtherwise, Answer::Refused, Answer::Missed];
}

/// One case with its nominals.
#[derive(Debug, Clone, PartialEq)]
pub struct Guidance {
    /// None when it was refused.
    pub taken: Option<Taken>,
    /// The free search's answer was another, and both were given.
    pub disagrees: bool,
    /// What was said against the right nominal: false alarms.
    pub alarms: Vec<String>,
    /// Travelled against the nominal.
    pub against: bool,
    /// What came of the wrong nominals.
    pub wrong: Vec<(Wrong, Answer)>,
}

impl Guidance {
    /// Reads what was told with the right nominal; `spine` is the true one.
    pub fn of(found: Result<&Reconstruction, &String>, drawn: &Drawn, spine: &Spine) -> Guidance {
        let none = Guidance { taken: None, disagrees: false, alarms: vec![], against: false, wrong: vec![] };
        let Ok(found) = found else { return none };
        Guidance {
            taken: Some(taken(&found.measured)),
            disagrees: found.measured.warnings.iter().any(|w| w.starts_with(DISAGREES)),
            alarms: alarms(&found.measured).cloned().collect(),
            against: is_reversed(&found.spine, spine) != drawn.reversed,
            wrong: Vec::new(),
        }
    }
}

fn taken(measured: &MeasuredTube) -> Taken {
    let decision = measured.decisions.iter().find(|d| d.what.starts_with(OF_THE_NOMINAL));
    match decision {
        Some(d) if d.kept && d.what.ends_with(UNDOUBTED) => Taken::Undoubted,
        Some(d) if d.kept => Taken::Checked,
        _ => Taken::Own,
    }
}

/// Warnings that the tube is not, or not surely, the nominal's.
fn alarms(measured: &MeasuredTube) -> impl Iterator<Item = &String> {
    let is_alarm = |w: &&String| {
        w.starts_with(DISAGREES)
            || w.starts_with("tube radius")
            || Wrong::ALL.iter().any(|wrong| w.contains(wrong.words()))
    };
    measured.warnings.iter().filter(is_alarm)
}

/// What came of a wrong nominal.
pub fn answer(found: Result<&Reconstruction, &String>, wrong: Wrong) -> Answer {
    let Ok(found) = found else { return Answer::Refused };
    let said = |w: &&String| w.contains(wrong.words());
    match alarms(&found.measured).find(said).or(alarms(&found.measured).next()) {
        Some(w) if said(&w) => Answer::Recognised,
        Some(_) => Answer::CalledOtherwise,
        None => Answer::Missed,
    }
}

/// Whether the one runs against the other, by where their ends are.
fn is_reversed(found: &Spine, truth: &Spine) -> bool {
    let ends = |s: &Spine| -> [Point3<f64>; 2] { [s.point_at(0.0), s.point_at(s.length_mm())] };
    let ([a, b], [c, d]) = (ends(found), ends(truth));
    (a - d).norm() + (b - c).norm() < (a - c).norm() + (b - d).norm()
}

/// How the nominal was used, and the table of the wrong ones, as markdown; nothing without nominals.
pub fn guidance(tally: &Tally) -> String {
    let all: Vec<&Guidance> = tally.cases.iter().filter_map(|c| c.guidance.as_ref()).collect();
    if all.is_empty() {
        return String::new();
    }
    let count = |wanted: &dyn Fn(&Guidance) -> bool| all.iter().filter(|g| wanted(g)).count();
    let took = |t: Taken| count(&|g| g.taken == Some(t));
    let mut out = format!(
        "The right nominal: its structure taken without asking the free search {}, after asking it {}; the scan's own \
        taken {}. Warnings that the free search disagrees {}, false alarms of any kind {}, travelled the wrong way {}.\n\n",
        took(Taken::Undoubted),
        took(Taken::Checked),
        took(Taken::Own),
        count(&|g| g.disagrees),
        count(&|g| !g.alarms.is_empty()),
        count(&|g| g.against),
    );
    out +=
        "| the tube, beside its nominal, is | cases | said so | said otherwise | refused | no word of it |\n";
    out += &("|:--".to_owned() + &"|--:".repeat(5) + "|\n");
    for wrong in Wrong::ALL {
        let given = || all.iter().flat_map(|g| &g.wrong).filter(|(w, _)| *w == wrong);
        let counts = Answer::ALL.map(|answer| given().filter(|(_, a)| *a == answer).count().to_string());
        out += &format!("| {} | {} | {} |\n", wrong.name(), given().count(), counts.join(" | "));
    }
    out
}

/// What is worth a look in a case, for its row.
pub fn remark(case: &Case) -> String {
    let Some(g) = &case.guidance else { return String::new() };
    let mut words = match g.taken {
        Some(Taken::Undoubted) | None => Vec::new(),
        Some(Taken::Checked) => vec!["free search asked".to_owned()],
        Some(Taken::Own) => vec!["scan's own structure".to_owned()],
    };
    words.extend(g.against.then(|| "wrong way".to_owned()));
    words.extend(g.alarms.iter().map(|a| format!("false alarm: {a}")));
    let unseen = g.wrong.iter().filter(|(_, a)| *a != Answer::Recognised);
    words.extend(unseen.map(|(w, a)| format!("{}: {a:?}", w.name())));
    words.iter().map(|w| format!("  [{w}]")).collect()
}
