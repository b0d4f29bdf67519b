//! The first good piece after a change waits for a person.
//!
//! Who writes the history says what was changed before a tube, and, once somebody has looked at it, that it was approved.

use super::history::{Changed, History};
use super::verdict::{Code, Reason};

/// What still has to be approved: the change that no approved tube follows.
pub fn awaited(history: &History) -> Option<Reason> {
    let parts = &history.parts;
    let (at, changed) = parts.iter().enumerate().rev().find_map(|(i, part)| Some((i, part.changed?)))?;
    if parts[at..].iter().any(|part| part.approved) {
        return None;
    }
    let what = match changed {
        Changed::Batch => "the batch of material was changed",
        Changed::Tooling => "the tooling was changed",
        Changed::Knowledge => "what is known of spring-back was imported",
        Changed::Table => "the table was changed at the machine",
        Changed::RollBack => "an earlier table was gone back to",
    };
    let text = format!(
        "{what} before part {}, and this is the first tube in tolerance since: gauge it, and approve it before more are bent",
        at + 1
    );
    Some(Reason::new(Code::Unapproved, text))
}
