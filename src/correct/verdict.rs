//! The answer of one correction step: verdict, table, reasons. Its JSON form is a contract.

use serde::{Deserialize, Serialize};

use super::predicted::Predicted;
use crate::tube::CommandTable;

/// What to do next.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Bend the first piece with this table.
    FirstPiece,
    /// The last tube is good (apart from its last end, which the cut decides): keep the table.
    InTolerance,
    /// Bend the next tube with this table.
    Correct,
    /// The last scan does not tell enough: scan that tube again.
    Rescan,
    /// Something is wrong that no table can put right: look first.
    Hold,
}

/// Why, for machines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Code {
    /// A value in the history that no tube or table can have.
    Unusable,
    /// The same scan twice.
    SameScan,
    /// The commanded table is not this part's.
    Program,
    /// The machine held another table than was answered: somebody edited it there.
    TableEdited,
    /// The tube was bent with another revision of the table than it is said to be.
    Revision,
    /// All bends spring back by another factor than before.
    BatchChanged,
    /// Corrected tables made it worse twice: back to the last good one.
    WorseTwice,
    /// The first good tube after a change, which nobody has approved yet.
    Unapproved,
    /// The scan shows another number of bends.
    BendCount,
    /// The mirror image fits better.
    WrongHand,
    /// Too far off to be this part.
    WrongPart,
    /// Both directions fit, and lead to different tables.
    Direction,
    /// The scan's sigma leaves no room in the tolerance.
    TooUncertain,
    /// The points of a straight scatter too much about it.
    StraightFit,
    /// The axes beside a bend miss each other.
    NearestPass,
    /// The scan is worse than this part's usual.
    ScanScore,
    /// A bend that does not fit what it did before.
    Outlier,
    /// Check points were not measured, or not well enough: another scan can tell.
    Unseen,
    /// Neither shown to be good nor to be bad, and another scan would not change that.
    Unproven,
    /// The tube is good; by what is known of its table the next ones may not be.
    Margin,
    /// An angle changes.
    Angle,
    /// A feed changes.
    Length,
    /// A rotation changes.
    Rotation,
    /// A change was cut to the most that one part may bring.
    StepLimit,
    /// A command would go too far from the nominal.
    TotalLimit,
    /// A command would leave the machine's range.
    MachineLimit,
    /// A feed is held at the shortest that the machine can do.
    Clamped,
    /// The last straight is off: cut the tube longer or shorter.
    CutLength,
    /// Out of tolerance by scatter: nothing that a table could take out.
    Scatter,
    /// A feed came out unlike before: slip is not chased until it stays.
    Slip,
    /// Values are away from their own best so that the check points come nearer.
    WholeTube,
    /// A limit, a clamp or a plane that is not seen keeps the tube out of tolerance.
    OutOfReach,
    /// The machine's steps do.
    Resolution,
    /// An earlier part of the history was not used.
    LeftOut,
}

/// One reason.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reason {
    /// For machines.
    pub code: Code,
    /// For people, figures included.
    pub text: String,
    /// Bend or row it is about, counted from 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bend: Option<usize>,
}

impl Reason {
    /// About the whole tube.
    pub fn new(code: Code, text: impl Into<String>) -> Reason {
        Reason { code, text: text.into(), bend: None }
    }

    /// About one bend, from 0.
    pub fn at(code: Code, bend: usize, text: impl Into<String>) -> Reason {
        Reason { code, text: text.into(), bend: Some(bend + 1) }
    }
}

/// The answer of one step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Answer {
    /// What to do next.
    pub verdict: Verdict,
    /// The table to bend with; in rescan and hold the one in force, but where a hold proposes one for approval (another batch, worse
    /// twice).
    pub commanded: CommandTable,
    /// Predicted commanded minus formed angle per bend at this table.
    pub springback_deg: Vec<f64>,
    /// Sigma of that for the next tube, its scatter included.
    pub springback_sigma_deg: Vec<f64>,
    /// The next tube that is expected at this table; none in a hold, but where it proposes one for approval.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub predicted: Option<Predicted>,
    /// Why.
    pub reasons: Vec<Reason>,
}

impl Answer {
    /// Whether one of the reasons has this code.
    pub fn is_about(&self, code: Code) -> bool {
        self.reasons.iter().any(|reason| reason.code == code)
    }
}
