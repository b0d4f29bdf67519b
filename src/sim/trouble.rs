//! What goes wrong at a simulated bender, once and when: by a script or by chance that a seed decides. One place for the simulator on
//! its own and for campaigns.

use std::collections::VecDeque;
use std::fmt;

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::bender::MachineModel;
use super::reply_fault::ReplyFault;
use crate::bender::Profile;

/// What goes wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trouble {
    /// The answer is damaged on its way.
    Reply(ReplyFault),
    /// The answer ends after so many bytes.
    Cut {
        /// How many go out.
        bytes: usize,
    },
    /// The machine says that it is busy, and does nothing.
    Busy,
    /// The machine closes its writing side instead of answering.
    HalfClose,
    /// The machine's controller leaves the bus, and is back a moment later; a machine on no bus does not notice.
    BusOff,
    /// Power off and on: the answer is lost, with all that is volatile.
    Reboot,
    /// Emergency stop, while an answer goes out: its state bit is set from then on.
    EmergencyStop {
        /// So many bytes of the answer still go out.
        bytes: usize,
    },
    /// The operator enters another table at the screen.
    Edit,
    /// The operator loads another program.
    OtherProgram,
    /// A part starts.
    Running,
    /// The controller's program stands still.
    Frozen,
}

impl Trouble {
    /// What it does to the machine itself.
    pub fn strike(self, model: &mut MachineModel) {
        match self {
            Trouble::Reboot => model.power_cycle(),
            Trouble::EmergencyStop { .. } => model.emergency_stop(),
            Trouble::Edit => model.operator_edits(),
            Trouble::OtherProgram => model.rename_program("SOMETHING-ELSE"),
            Trouble::Running => model.set_between_parts(false),
            Trouble::Frozen => model.frozen = true,
            Trouble::Reply(_)
            | Trouble::Cut { .. }
            | Trouble::Busy
            | Trouble::HalfClose
            | Trouble::BusOff => {}
        }
    }

    /// What it does to the next answer, when it came between answers.
    fn afterwards(self) -> Option<Trouble> {
        match self {
            Trouble::Reboot => Some(Trouble::Reply(ReplyFault::Lost)),
            Trouble::EmergencyStop { bytes } => Some(Trouble::Cut { bytes }),
            Trouble::Edit | Trouble::OtherProgram | Trouble::Running | Trouble::Frozen => None,
            other => Some(other),
        }
    }

    /// Whether it is only about an answer.
    fn is_of_the_link(self) -> bool {
        self.afterwards() == Some(self)
    }
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Trouble::Reply(ReplyFault::Lost) => write!(f, "lost"),
            Trouble::Reply(ReplyFault::Late { ms }) => write!(f, "{ms} ms late"),
            Trouble::Reply(ReplyFault::Twice) => write!(f, "sent twice"),
            Trouble::Reply(ReplyFault::Truncated) => write!(f, "truncated"),
            Trouble::Reply(ReplyFault::Corrupted) => write!(f, "corrupted"),
            Trouble::Reply(ReplyFault::WrongUnit) => write!(f, "sent with another unit's number"),
            Trouble::Reply(ReplyFault::Garbage) => write!(f, "garbage before it"),
            Trouble::Cut { bytes } => write!(f, "cut after {bytes} bytes"),
            Trouble::Busy => write!(f, "busy"),
            Trouble::HalfClose => write!(f, "writing side closed"),
            Trouble::BusOff => write!(f, "bus-off"),
            Trouble::Reboot => write!(f, "power off and on"),
            Trouble::EmergencyStop { bytes } => write!(f, "emergency stop, cut after {bytes} bytes"),
            Trouble::Edit => write!(f, "another table entered at the screen"),
            Trouble::OtherProgram => write!(f, "another program loaded"),
            Trouble::Running => write!(f, "a part started"),
            Trouble::Frozen => write!(f, "the controller's program stopped"),
        }
    }
}

/// When.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum When {
    /// At this answer, counted from 1.
    Answer(u64),
    /// So many milliseconds after the start.
    Ms(u64),
    /// When a commit was written, before the machine deals with it.
    Commit,
    /// When a table was taken over, before that is read.
    TakenOver,
}

impl fmt::Display for When {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            When::Answer(number) => write!(f, "answer {number}"),
            When::Ms(ms) => write!(f, "{ms} ms"),
            When::Commit => write!(f, "commit written"),
            When::TakenOver => write!(f, "table taken over"),
        }
    }
}

/// An answer takes up to this long anyway.
const USUAL_MS: u64 = 15;

/// What is going to happen to the answers and the machine.
#[derive(Debug, Clone)]
pub struct WireFaults {
    /// What is to come.
    events: Vec<(When, Trouble)>,
    /// What the next answers meet, whatever their number.
    next: VecDeque<Trouble>,
    /// What the next answer meets is decided.
    decided: bool,
    answers: u64,
    rng: ChaCha8Rng,
    usual_ms: u64,
    /// Of a thousand answers.
    per_mille: u32,
    latest_ms: u64,
}

impl WireFaults {
    /// Of a thousand answers so many have a fault; late ones come up to `latest_ms` later.
    pub fn new(seed: u64, per_mille: u32, latest_ms: u64) -> WireFaults {
        WireFaults {
            events: Vec::new(),
            next: VecDeque::new(),
            decided: false,
            answers: 0,
            rng: ChaCha8Rng::seed_from_u64(seed),
            usual_ms: USUAL_MS,
            per_mille,
            latest_ms,
        }
    }

    /// The same, with answers no later than this machine's link bears.
    pub fn by_chance(profile: &Profile, seed: u64, per_mille: u32) -> WireFaults {
        let quiet = profile.transport.line().map_or(profile.deadlines.request, |line| line.quiet);
        WireFaults::new(seed, per_mille, quiet.as_millis() as u64)
    }

    /// These events and nothing else.
    pub fn events(events: Vec<(When, Trouble)>) -> WireFaults {
        WireFaults { events, usual_ms: 0, ..WireFaults::new(0, 0, 0) }
    }

    /// These faults, one answer after the other, and none after them.
    pub fn script(faults: impl IntoIterator<Item = Option<ReplyFault>>) -> WireFaults {
        let numbered = faults.into_iter().zip(1..);
        let events =
            numbered.filter_map(|(fault, number)| Some((When::Answer(number), Trouble::Reply(fault?))));
        WireFaults::events(events.collect())
    }

    /// One more event.
    pub fn and(mut self, when: When, trouble: Trouble) -> WireFaults {
        self.events.push((when, trouble));
        self
    }

    /// How long the next answer takes, in milliseconds.
    pub fn usual_ms(&mut self) -> u64 {
        if self.usual_ms == 0 { 0 } else { self.rng.random_range(1..=self.usual_ms) }
    }

    /// Whether the machine will have no time for what it is asked next.
    pub fn is_busy(&mut self) -> bool {
        self.decide();
        self.next.front() == Some(&Trouble::Busy)
    }

    /// What the next answer meets, and which one it is.
    pub fn answer(&mut self) -> (u64, Option<Trouble>) {
        self.decide();
        self.decided = false;
        self.answers += 1;
        (self.answers, self.next.pop_front())
    }

    fn decide(&mut self) {
        if std::mem::replace(&mut self.decided, true) {
            return;
        }
        let number = self.answers + 1;
        let due = self.take_due(|when| when == When::Answer(number));
        self.next.extend(due.into_iter().map(|(_, trouble)| trouble));
        if self.next.is_empty() && self.rng.random_range(0..1000) < self.per_mille {
            let trouble = self.draw();
            self.next.push_back(trouble);
        }
    }

    /// What happens now at the machine: at a time, at a commit. What it does to answers, the next one meets.
    pub fn due(&mut self, now: When) -> Vec<(When, Trouble)> {
        let due = self.take_due(|when| match (when, now) {
            (When::Ms(at), When::Ms(now)) => at <= now,
            (when, now) => when == now,
        });
        self.next.extend(due.iter().filter_map(|(_, trouble)| trouble.afterwards()));
        due.into_iter().filter(|(_, trouble)| !trouble.is_of_the_link()).collect()
    }

    fn take_due(&mut self, is_due: impl Fn(When) -> bool) -> Vec<(When, Trouble)> {
        let (due, later) = self.events.iter().copied().partition(|(when, _)| is_due(*when));
        self.events = later;
        due
    }

    /// What passes by itself; an emergency stop or another program would be the last that a seed shows.
    fn draw(&mut self) -> Trouble {
        Trouble::Reply(match self.rng.random_range(0..10) {
            0 => ReplyFault::Lost,
            1 => ReplyFault::Late { ms: self.rng.random_range(1..=self.latest_ms.max(1)) },
            2 => ReplyFault::Twice,
            3 => ReplyFault::Truncated,
            4 => ReplyFault::Corrupted,
            5 => ReplyFault::WrongUnit,
            6 => ReplyFault::Garbage,
            7 => return Trouble::Busy,
            8 => return Trouble::HalfClose,
            _ => return Trouble::Reboot,
        })
    }

    /// A number below `below`, by chance.
    pub fn chance(&mut self, below: usize) -> usize {
        self.rng.random_range(0..below.max(1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_come_at_their_answer_their_time_or_their_commit_and_once() {
        let stop = Trouble::EmergencyStop { bytes: 3 };
        let mut faults = WireFaults::events(vec![
            (When::Answer(2), Trouble::Busy),
            (When::Ms(50), Trouble::Edit),
            (When::Ms(60), Trouble::HalfClose),
            (When::Commit, stop),
            (When::TakenOver, Trouble::Reboot),
        ]);
        assert!(!faults.is_busy());
        assert_eq!(faults.answer(), (1, None));
        assert!(faults.is_busy() && faults.is_busy());
        assert_eq!(faults.answer(), (2, Some(Trouble::Busy)));
        assert!(faults.due(When::Ms(49)).is_empty());
        assert_eq!(faults.due(When::Ms(70)), [(When::Ms(50), Trouble::Edit)]);
        assert_eq!(faults.answer(), (3, Some(Trouble::HalfClose)), "the next one meets it");
        assert_eq!(faults.due(When::Commit), [(When::Commit, stop)]);
        assert_eq!(faults.answer(), (4, Some(Trouble::Cut { bytes: 3 })));
        assert_eq!(faults.due(When::TakenOver), [(When::TakenOver, Trouble::Reboot)]);
        assert_eq!(faults.answer(), (5, Some(Trouble::Reply(ReplyFault::Lost))));
        assert!(faults.due(When::Commit).is_empty() && faults.due(When::Ms(1000)).is_empty());
        assert_eq!(faults.answer(), (6, None));
    }

    #[test]
    fn a_seed_decides_and_draws_every_kind() {
        let drawn = |seed| {
            let mut faults = WireFaults::new(seed, 500, 40);
            (0..400).map(|_| faults.answer().1).collect::<Vec<_>>()
        };
        assert_eq!(drawn(1), drawn(1));
        assert_ne!(drawn(1), drawn(2));
        let mut kinds: Vec<_> = drawn(1).into_iter().flatten().map(|t| t.to_string()).collect();
        kinds.retain(|kind| !kind.ends_with("late"));
        kinds.sort();
        kinds.dedup();
        assert_eq!(kinds.len(), 9, "{kinds:?}");
    }
}
