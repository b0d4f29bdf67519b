//! Whether a real machine is what its profile says: for the fitter, step by step, each with what to change when it fails.
//!
//! Reads everything. Writes nothing but, when asked to, the staging area; never commits. What a step makes of what was read is in
//! `selftest_judge`, what would explain a machine that is not understood in `selftest_advice`.

use std::collections::BTreeMap;

use serde::Serialize;
use tokio::time::{Duration, Instant};

use super::any_link::Link;
use super::link::{Bender as _, LinkError};
use super::profile::Profile;
use super::selftest_advice::{Guess, others, silent_ones, with_smaller_reads};
use super::wire::{Staged, Status, TableId, payload_bytes};
use super::{selftest_endpoint as endpoint, selftest_judge as judge};

/// So many looks for the usual time of an answer.
const LOOKS: usize = 20;

/// What to do about a machine that answers, and has no time.
const BUSY: &str = "the machine answers and has no time: wait and try again; if it stays so, another client keeps it busy (a visualization, \
                    another benderd): stop that";

/// How a step ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// As it should be.
    Ok,
    /// Not so.
    Failed,
    /// Not tried.
    Skipped,
}

/// One step and what came of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Step {
    /// Its name.
    pub step: &'static str,
    /// How it ended.
    pub result: Verdict,
    /// What was found, with figures.
    pub found: String,
    /// What to change.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub advice: Vec<String>,
    /// The figures for programs; names say the unit.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub figures: BTreeMap<&'static str, f64>,
}

impl Step {
    pub(super) fn new(step: &'static str, result: Verdict, found: impl Into<String>) -> Step {
        Step { step, result, found: found.into(), advice: Vec::new(), figures: BTreeMap::new() }
    }

    pub(super) fn ok(step: &'static str, found: impl Into<String>) -> Step {
        Step::new(step, Verdict::Ok, found)
    }

    pub(super) fn failed(step: &'static str, found: impl Into<String>, advice: impl Into<String>) -> Step {
        Step { advice: vec![advice.into()], ..Step::new(step, Verdict::Failed, found) }
    }

    /// An error of the link ended it. A machine that had no time is no reason to change anything.
    pub(super) fn failed_by(step: &'static str, error: &LinkError, advice: impl Into<String>) -> Step {
        let advice = match error {
            LinkError::Busy { .. } => BUSY.to_owned(),
            _ => advice.into(),
        };
        Step::failed(step, error.to_string(), advice)
    }

    pub(super) fn with(mut self, figure: &'static str, value: f64) -> Step {
        self.figures.insert(figure, (value * 1000.0).round() / 1000.0);
        self
    }
}

/// What came of it all.
#[derive(Debug, Clone, Default)]
pub struct Report {
    /// In their order.
    pub steps: Vec<Step>,
    /// The last frames of each link that was tried, one line each.
    pub frames: Vec<String>,
}

impl Report {
    /// Whether nothing failed.
    pub fn passed(&self) -> bool {
        self.steps.iter().all(|step| step.result != Verdict::Failed)
    }
}

/// What steps took, in milliseconds.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Times {
    pub median: f64,
    pub worst: f64,
    pub read: f64,
    pub write: Option<f64>,
    pub active: f64,
}

/// Steps after the machine was understood.
const AFTER: [&str; 8] = [
    "heartbeat",
    "state bit",
    "program",
    "active table",
    "largest request",
    "staging area",
    "write staging",
    "times",
];

struct Test<'a> {
    profile: Profile,
    endpoint: &'a str,
    link: Link,
    report: Report,
    tell: &'a mut dyn FnMut(&Step),
    times: Times,
}

/// Looks at a machine. Each step is told as it ends; `write_staging` lets the staging area be written, and cleared again.
pub async fn run(
    profile: &Profile,
    endpoint: &str,
    write_staging: bool,
    tell: &mut dyn FnMut(&Step),
) -> Result<Report, super::RulesError> {
    let link = Link::new(profile.clone(), endpoint)?;
    let (report, times) = (Report::default(), Times::default());
    let mut test = Test { profile: profile.clone(), endpoint, link, report, tell, times };
    test.all(write_staging).await;
    test.keep_frames("");
    Ok(test.report)
}

impl Test<'_> {
    async fn all(&mut self, write_staging: bool) {
        self.note(judge::profile(&self.profile));
        if !self.note(endpoint::check(&self.profile, self.endpoint).await) {
            self.skip(&["first answer", "identification"], "the machine is not reached");
            return self.skip(&AFTER, "the machine is not reached");
        }
        let Some(status) = self.understand().await else {
            return self.skip(&AFTER, "what is read there would mean nothing");
        };
        // A machine whose rows are written directly counts nothing, knows no program, and has nothing to stage in.
        let direct = self.profile.transport.direct().is_some();
        if direct {
            self.skip(&["heartbeat"], "such a machine has none");
        } else {
            let step = match self.heartbeat().await {
                Ok(step) => step,
                Err(error) => Step::failed_by("heartbeat", &error, "look at cable and plugs"),
            };
            self.note(step);
        }
        for step in judge::state_bits(&self.profile, status.state) {
            self.note(step);
        }
        if direct {
            self.skip(&["program"], "such a machine does not say which is loaded: look at its screen");
        } else {
            self.note(judge::program(&self.profile, &status));
        }
        let begun = Instant::now();
        let active = self.link.read_active().await;
        self.times.active = ms_since(begun);
        self.note(judge::active(&self.profile, active));
        if direct {
            let why = "such a machine has no staging area: what is written is in force";
            self.skip(&["largest request", "staging area", "write staging"], why);
            self.note(judge::times(&self.profile, &self.times));
            return;
        }
        self.largest_request().await;
        self.staging().await;
        if write_staging {
            self.write_staging(&status).await;
        } else {
            self.skip(
                &["write staging"],
                "not asked for: --write-staging writes a test pattern, never a commit",
            );
        }
        self.note(judge::times(&self.profile, &self.times));
    }

    /// Tells a step; whether it was all right.
    fn note(&mut self, step: Step) -> bool {
        (self.tell)(&step);
        let good = step.result != Verdict::Failed;
        self.report.steps.push(step);
        good
    }

    fn skip(&mut self, steps: &[&'static str], why: &str) {
        for step in steps {
            self.note(Step::new(step, Verdict::Skipped, why));
        }
    }

    /// Takes another link to the same place; the one before is closed before the new one connects.
    fn use_profile(&mut self, profile: &Profile, name: &str) {
        self.keep_frames(name);
        // Its times are those of a profile that made a link before.
        if let Ok(link) = Link::new(profile.clone(), self.endpoint) {
            self.link = link;
        }
    }

    fn keep_frames(&mut self, next: &str) {
        self.report.frames.extend(self.link.last_frames());
        if !next.is_empty() {
            self.report.frames.push(format!("tried: {next}"));
        }
    }

    /// The first answers: their times, and whether they are this machine's.
    async fn understand(&mut self) -> Option<Status> {
        let begun = Instant::now();
        let first = self.link.read_status().await;
        let first_ms = ms_since(begun);
        let error = match first {
            Ok(status) => {
                if !self.answer_times(first_ms).await {
                    return None;
                }
                self.note(judge::identified(&self.profile));
                return Some(status);
            }
            Err(error) => error,
        };
        if let LinkError::Busy { .. } = error {
            self.note(Step::failed_by("first answer", &error, ""));
            self.skip(&["identification"], "the machine had no time to answer");
            return None;
        }
        let answered = matches!(error, LinkError::Nonsense { .. } | LinkError::Exception { .. });
        if answered {
            self.note(Step::ok("first answer", format!("after {first_ms:.1} ms")).with("first_ms", first_ms));
            let guesses = [others(&self.profile), silent_ones(&self.profile)].concat();
            let advice = self.first_that_explains(guesses).await;
            self.note(judge::foreign(&self.profile, &error, advice));
        } else {
            let guesses = silent_ones(&self.profile);
            let advice = self.first_that_explains(guesses).await;
            self.note(judge::no_answer(&self.profile, self.endpoint, &error, advice));
            self.skip(&["identification"], "nothing was answered");
        }
        None
    }

    async fn answer_times(&mut self, first_ms: f64) -> bool {
        let mut times = Vec::new();
        for _ in 0..LOOKS {
            let begun = Instant::now();
            if let Err(error) = self.link.read_status().await {
                let advice = "the connection is not steady: look at cable, plugs, shield and termination; \
                              --frames shows what arrived";
                let mut step = Step::failed_by("first answer", &error, advice);
                step.found = format!("{} of {LOOKS} answered, then: {error}", times.len());
                self.note(step);
                return false;
            }
            times.push(ms_since(begun));
        }
        times.sort_by(f64::total_cmp);
        (self.times.median, self.times.worst) = (times[LOOKS / 2], times[LOOKS - 1]);
        self.note(judge::first_answer(first_ms, &self.times));
        true
    }

    /// What to change, when a profile changed so understands the machine.
    async fn first_that_explains(&mut self, guesses: Vec<Guess>) -> Option<String> {
        for guess in guesses {
            self.use_profile(&guess.profile, &guess.change);
            if self.link.read_status().await.is_ok() {
                return Some(guess.change);
            }
        }
        None
    }

    async fn heartbeat(&mut self) -> Result<Step, LinkError> {
        let limit_ms = self.profile.deadlines.heartbeat_ms;
        let poll = Duration::from_millis(self.profile.deadlines.poll_ms);
        let mut before = self.link.read_status().await?.heartbeat;
        let begun = Instant::now();
        let (mut beats, mut beaten, mut longest_ms) = (0_u32, begun, 0.0_f64);
        while begun.elapsed() < Duration::from_millis(limit_ms) {
            tokio::time::sleep(poll).await;
            let now = self.link.read_status().await?.heartbeat;
            longest_ms = longest_ms.max(ms_since(beaten));
            if now != before {
                beats += u32::from(now.wrapping_sub(before));
                (before, beaten) = (now, Instant::now());
            }
        }
        Ok(judge::heartbeat(&self.profile, beats, ms_since(begun), longest_ms))
    }

    /// Whether one request may be as large as the profile says; if not, how large.
    async fn largest_request(&mut self) {
        let Some(map) = self.profile.transport.modbus() else {
            return self.skip(&["largest request"], "this protocol's frames are of one size");
        };
        let area = (8 + payload_bytes(&self.profile, self.profile.limits.max_bends)) / 2;
        let most = usize::from(map.max_read_registers).min(area) & !1;
        let Err(error) = self.link.read_staging(2 * most).await else {
            let found = format!("{most} registers in one read are answered (modbus.max_read_registers)");
            self.note(Step::ok("largest request", found).with("registers", most as f64));
            return;
        };
        if let LinkError::Busy { .. } = error {
            self.note(Step::failed_by("largest request", &error, ""));
            return;
        }
        // The most that is answered lies from `good` on and below `bad`; both even.
        let (mut good, mut bad) = (0, most);
        while bad - good > 2 {
            let tried = ((good + bad) / 2) & !1;
            let smaller = with_smaller_reads(&self.profile, tried as u16);
            self.use_profile(&smaller, &format!("reads of {tried} registers"));
            let accepted = self.link.read_staging(2 * tried).await.is_ok();
            if accepted { good = tried } else { bad = tried }
        }
        self.note(judge::largest(most, good, &error));
        if good >= 4 {
            // The rest is tried with what works.
            self.profile = with_smaller_reads(&self.profile, good as u16);
            let profile = self.profile.clone();
            self.use_profile(&profile, &format!("reads of {good} registers"));
        }
    }

    async fn staging(&mut self) {
        let bytes = 8 + payload_bytes(&self.profile, self.profile.limits.max_bends);
        let begun = Instant::now();
        let read = self.link.read_staging(bytes).await;
        self.times.read = ms_since(begun);
        self.note(judge::staging(&self.profile, bytes, read, self.times.read));
    }

    /// Stages a pattern, reads it back and clears it. It can never be put in force: it is staged as revision 0, and a commit names the
    /// active revision plus 1, while a commit word of revision 0 is none at all (protocols/reference-modbus.md). What another
    /// client has staged meanwhile is lost; its own read-back tells it so.
    async fn write_staging(&mut self, status: &Status) {
        if status.pending.revision != 0 {
            let found =
                format!("the machine has a commit to deal with ({}): nothing was written", status.pending);
            let advice =
                "end the delivery that is under way (stop benderd), or switch the controller off and on";
            self.note(Step::failed("write staging", found, advice));
            return;
        }
        let staged = judge::pattern(&self.profile, &status.program);
        let image = super::wire::staging_image(&self.profile, &staged);
        let begun = Instant::now();
        let mut written = self.link.write_staging(&staged).await;
        self.times.write = Some(ms_since(begun));
        let mut read = Ok(Vec::new());
        if written.is_ok() {
            read = self.link.read_staging(image.len()).await;
        }
        let (cleared, left) = self.clear_staging(image.len()).await;
        if written.is_ok() && cleared.is_err() {
            written = cleared;
        }
        self.note(judge::written(&self.profile, &image, written, read, left));
    }

    /// Zeros over all of it, in two writes, since a table's text is as long as its count of bends says; and whether it then holds
    /// zeros only.
    async fn clear_staging(&mut self, bytes: usize) -> (Result<(), LinkError>, bool) {
        let bends = self.profile.limits.max_bends;
        for rows in [bends, 0] {
            let mut payload = vec![0; payload_bytes(&self.profile, rows)];
            let count = self.profile.table.program_bytes;
            payload[count..count + 2].copy_from_slice(&(rows as u16).to_be_bytes());
            let empty = Staged { id: TableId::default(), payload };
            if let Err(error) = self.link.write_staging(&empty).await {
                return (Err(error), false);
            }
        }
        match self.link.read_staging(bytes).await {
            Ok(found) => (Ok(()), found.iter().all(|byte| *byte == 0)),
            Err(error) => (Err(error), false),
        }
    }
}

fn ms_since(begun: Instant) -> f64 {
    begun.elapsed().as_secs_f64() * 1000.0
}
