//! A script of what goes wrong at a simulated bender: `benderd simulate bender --script FILE`. config/faults.toml is an example, with
//! every event in it.

use std::path::Path;

use serde::Deserialize;

use super::reply_fault::ReplyFault;
use super::trouble::{Trouble, When};
use crate::config::{At, ConfigError, Document};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawScript {
    version: At<i64>,
    event: Vec<At<RawEvent>>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawEvent {
    at_answer: Option<u64>,
    at_ms: Option<u64>,
    at: Option<RawAt>,
    what: RawWhat,
    late_ms: Option<u64>,
    after_bytes: Option<usize>,
}

#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum RawAt {
    Commit,
    TakenOver,
}

#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum RawWhat {
    Lost,
    Late,
    Twice,
    Truncated,
    Corrupted,
    WrongUnit,
    Garbage,
    Cut,
    Busy,
    HalfClose,
    Reboot,
    EmergencyStop,
    Edit,
    OtherProgram,
    Running,
    Frozen,
    BusOff,
}

/// Reads a script.
pub fn load(path: &Path) -> Result<Vec<(When, Trouble)>, ConfigError> {
    parse(&Document::read(path)?)
}

/// The events of a script.
pub fn parse(doc: &Document) -> Result<Vec<(When, Trouble)>, ConfigError> {
    let raw: RawScript = doc.parse()?;
    if *raw.version.get_ref() != 1 {
        return Err(doc.value_error(raw.version.span(), "version", raw.version.get_ref(), 1));
    }
    raw.event.iter().map(|event| Ok((when(doc, event)?, trouble(doc, event)?))).collect()
}

fn when(doc: &Document, event: &At<RawEvent>) -> Result<When, ConfigError> {
    let RawEvent { at_answer, at_ms, at, .. } = event.get_ref();
    match (at_answer, at_ms, at) {
        (Some(number @ 1..), None, None) => Ok(When::Answer(*number)),
        (None, Some(ms), None) => Ok(When::Ms(*ms)),
        (None, None, Some(RawAt::Commit)) => Ok(When::Commit),
        (None, None, Some(RawAt::TakenOver)) => Ok(When::TakenOver),
        _ => {
            let given = [at_answer.is_some(), at_ms.is_some(), at.is_some()];
            let names = ["at_answer", "at_ms", "at"].into_iter().zip(given);
            let found: Vec<&str> = names.filter(|(_, is)| *is).map(|(name, _)| name).collect();
            let found = if found.is_empty() { "nothing".to_owned() } else { found.join(" and ") };
            let allowed =
                "one of at_answer (from 1), at_ms, at (\"commit\": written, not dealt with; \"taken-over\")";
            Err(doc.value_error(event.span(), "event's time", found, allowed))
        }
    }
}

fn trouble(doc: &Document, event: &At<RawEvent>) -> Result<Trouble, ConfigError> {
    let RawEvent { what, late_ms, after_bytes, .. } = event.get_ref();
    let wrong = |allowed: &str| {
        let found = format!("{what:?} with late_ms {late_ms:?}, after_bytes {after_bytes:?}");
        Err(doc.value_error(event.span(), "event", found, allowed))
    };
    Ok(match (what, late_ms, after_bytes) {
        (RawWhat::Late, Some(ms), None) => Trouble::Reply(ReplyFault::Late { ms: *ms }),
        (RawWhat::Cut, None, Some(bytes)) => Trouble::Cut { bytes: *bytes },
        (RawWhat::EmergencyStop, None, Some(bytes)) => Trouble::EmergencyStop { bytes: *bytes },
        (RawWhat::Late, ..) => return wrong("late with late_ms and without after_bytes"),
        (RawWhat::Cut | RawWhat::EmergencyStop, ..) => {
            return wrong("cut and emergency-stop with after_bytes and without late_ms");
        }
        (RawWhat::Lost, None, None) => Trouble::Reply(ReplyFault::Lost),
        (RawWhat::Twice, None, None) => Trouble::Reply(ReplyFault::Twice),
        (RawWhat::Truncated, None, None) => Trouble::Reply(ReplyFault::Truncated),
        (RawWhat::Corrupted, None, None) => Trouble::Reply(ReplyFault::Corrupted),
        (RawWhat::WrongUnit, None, None) => Trouble::Reply(ReplyFault::WrongUnit),
        (RawWhat::Garbage, None, None) => Trouble::Reply(ReplyFault::Garbage),
        (RawWhat::Busy, None, None) => Trouble::Busy,
        (RawWhat::HalfClose, None, None) => Trouble::HalfClose,
        (RawWhat::BusOff, None, None) => Trouble::BusOff,
        (RawWhat::Reboot, None, None) => Trouble::Reboot,
        (RawWhat::Edit, None, None) => Trouble::Edit,
        (RawWhat::OtherProgram, None, None) => Trouble::OtherProgram,
        (RawWhat::Running, None, None) => Trouble::Running,
        (RawWhat::Frozen, None, None) => Trouble::Frozen,
        _ => return wrong("late_ms belongs to late, after_bytes to cut and emergency-stop"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const EXAMPLE: &str = include_str!("../../config/faults.toml");

    fn complaint(text: &str) -> String {
        parse(&Document::new("f.toml", text)).unwrap_err().to_string()
    }

    #[test]
    fn the_example_has_every_event_and_every_time() {
        let events = parse(&Document::new("faults.toml", EXAMPLE)).unwrap();
        let mut kinds: Vec<String> = events.iter().map(|(_, trouble)| trouble.to_string()).collect();
        kinds.sort();
        kinds.dedup();
        assert_eq!(kinds.len(), 17, "{kinds:?}");
        assert_eq!(events[0], (When::Answer(2), Trouble::Reply(ReplyFault::Lost)));
        for when in [When::Ms(60_000), When::Commit, When::TakenOver] {
            assert!(events.iter().any(|(at, _)| *at == when), "{when}");
        }
    }

    #[test]
    fn what_is_no_script_is_refused_with_its_line() {
        let event = |lines: &str| format!("version = 1\n[[event]]\n{lines}\n");
        assert!(complaint("version = 2\nevent = []").contains("line 1: version = 2, allowed is 1"));
        assert!(complaint(&event("what = \"lost\"")).contains("event's time = nothing"));
        let both = complaint(&event("at_ms = 1\nat_answer = 1\nwhat = \"lost\""));
        assert!(both.contains("at_answer and at_ms"), "{both}");
        assert!(complaint(&event("at_answer = 0\nwhat = \"lost\"")).contains("(from 1)"));
        assert!(complaint(&event("at_ms = 1\nwhat = \"late\"")).contains("late with late_ms"));
        assert!(complaint(&event("at_ms = 1\nwhat = \"emergency-stop\"")).contains("after_bytes"));
        assert!(complaint(&event("at_ms = 1\nlate_ms = 1\nwhat = \"busy\"")).contains("belongs to late"));
        assert!(complaint(&event("at_ms = 1\nwhat = \"sulk\"")).contains("unknown variant `sulk`"));
        assert!(complaint(&event("at_ms = 1\nwhat = \"lost\"\nwhy = 1")).contains("unknown field `why`"));
    }
}
