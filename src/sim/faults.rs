//! One way in which a simulated bender misbehaves all the time; what happens once, by a script or by chance, is `trouble`'s.

use std::str::FromStr;

use super::bender::MachineModel;

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
