//! Contact with a machine: when to connect, when to ask, when to keep silent, and when to stop trying. One state machine for every
//! kind of link; a link performs its actions and has no opinion of its own.
//!
//! ```text
//!            Wanted           Opened          Wanted           Answered
//! Away ───────────────► Opening ──────► Ready ──────► Asking ───────────► Ready
//!   ▲ not before retry    │ NotOpened     │ Closed      │ Doubted: a line keeps Silent, a stream is dropped
//!   └─────────────────────┴───────────────┴─────────────┘
//!   ▲ after its time, or Reset                    │ Foreign: not the machine that it should be
//!   └──────────────────── Faulted ◄───────────────┘
//! ```
//!
//! Each time that something fails a new epoch begins: what was learned of the machine before may no longer be so, and a command that
//! rests on it is refused.
//!
//! Nothing is queued: what cannot be asked now is refused now, so nothing is asked later than it was meant to be. No state but
//! `Away` and `Ready`, which wait for nothing, lasts beyond a time of its own.

use thiserror::Error;

/// The times of one link, checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Rules {
    first_ms: u64,
    most_ms: u64,
    opening_ms: u64,
    asking_ms: u64,
    silence_ms: Option<u64>,
}

/// Waits are shorter than doubling says by up to this share, so that many cells do not call on one machine in step.
const JITTER: f64 = 0.25;

/// What is not the machine that it should be is looked at again after this long: somebody may have plugged it right.
const FAULTED_MS: u64 = 60_000;

/// Why times make no rules.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("{what} is {ms} ms, allowed is {allowed}")]
pub struct RulesError {
    what: &'static str,
    ms: u64,
    allowed: String,
}

impl Rules {
    /// Waits between attempts from `first_ms`, doubling to `most_ms`; how long opening and a reply may take. With
    /// `silence_ms` a doubt is followed by so much silence, as on a line that cannot be closed; without, the connection
    /// is dropped.
    pub fn new(
        (first_ms, most_ms): (u64, u64),
        opening_ms: u64,
        asking_ms: u64,
        silence_ms: Option<u64>,
    ) -> Result<Rules, RulesError> {
        let above_0 =
            |what, ms| (ms > 0).then_some(()).ok_or(RulesError { what, ms, allowed: "1 and more".into() });
        above_0("the first wait", first_ms)?;
        above_0("the time to connect", opening_ms)?;
        above_0("the time for a reply", asking_ms)?;
        above_0("the silence", silence_ms.unwrap_or(1))?;
        if most_ms < first_ms {
            let allowed = format!("{first_ms} (the first) and more");
            return Err(RulesError { what: "the longest wait", ms: most_ms, allowed });
        }
        Ok(Rules { first_ms, most_ms, opening_ms, asking_ms, silence_ms })
    }

    /// The wait after so many failures since the last answer. After the first there is none: many machines close a
    /// connection that was idle.
    fn wait_ms(&self, failures: u32, seed: u64) -> u64 {
        let Some(doublings) = failures.checked_sub(2) else { return 0 };
        let doubled = self.first_ms.saturating_mul(1 << doublings.min(40)).min(self.most_ms);
        let share = JITTER * unit(seed ^ u64::from(failures));
        doubled - (share * doubled as f64) as u64
    }
}

/// A number in 0 to 1 that looks like chance (splitmix64).
fn unit(seed: u64) -> f64 {
    let mut z = seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
}

/// Where the contact stands. Times are the caller's clock, in milliseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// Not connected.
    Away {
        /// The next attempt no sooner.
        retry_ms: u64,
    },
    /// Connecting.
    Opening {
        /// Given up then.
        until_ms: u64,
    },
    /// Connected, nothing asked.
    Ready,
    /// One request is out.
    Asking {
        /// Given up then.
        until_ms: u64,
    },
    /// After a doubt: nothing is sent, what arrives is thrown away.
    Silent {
        /// No longer.
        until_ms: u64,
    },
    /// Something else answers than the machine. Nothing is sent to it.
    Faulted {
        /// No longer.
        until_ms: u64,
    },
}

/// What happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// A request is to be sent.
    Wanted,
    /// The connection is open.
    Opened,
    /// It could not be opened.
    NotOpened,
    /// The reply came, and fits.
    Answered,
    /// No reply in time, or one that does not fit.
    Doubted,
    /// The other side closed the connection, or the device is gone.
    Closed,
    /// An answer shows that this is not the machine that it should be.
    Foreign,
    /// Somebody has looked after it.
    Reset,
}

/// What is to be done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action {
    /// Connect, and give up then.
    Open {
        /// When.
        until_ms: u64,
    },
    /// Throw away what has arrived, send the request, and give up then.
    Send {
        /// When.
        until_ms: u64,
    },
    /// The request cannot be sent before.
    Refuse {
        /// When.
        until_ms: u64,
    },
    /// Nothing.
    Nothing,
}

/// One machine's contact.
#[derive(Debug, Clone)]
pub struct Contact {
    rules: Rules,
    seed: u64,
    state: State,
    /// Since the last answer.
    failures: u32,
    epoch: u64,
}

impl Contact {
    /// Not connected; the first attempt may be made at once. `seed` tells its waits from another's.
    pub fn new(rules: Rules, seed: u64) -> Contact {
        Contact { rules, seed, state: State::Away { retry_ms: 0 }, failures: 0, epoch: 0 }
    }

    /// Where it stands.
    pub fn state(&self) -> State {
        self.state
    }

    /// Whether there is a connection to keep: one that was given up is dropped, whether an event said so or a time that is over.
    pub fn keeps_connection(&self) -> bool {
        !matches!(self.state, State::Away { .. } | State::Faulted { .. })
    }

    /// Attempts and requests that failed since the last answer.
    pub fn failures(&self) -> u32 {
        self.failures
    }

    /// Counts what ended: two equal ones have nothing between them that failed.
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// One event in, one action out.
    pub fn on(&mut self, event: Event, now_ms: u64) -> Action {
        use State::{Asking, Away, Faulted, Opening, Ready, Silent};
        self.let_pass(now_ms);
        let (state, action) = match (self.state, event) {
            (Away { retry_ms }, Event::Wanted) if now_ms < retry_ms => {
                (self.state, Action::Refuse { until_ms: retry_ms })
            }
            (Away { .. }, Event::Wanted) => {
                let until_ms = now_ms + self.rules.opening_ms;
                (Opening { until_ms }, Action::Open { until_ms })
            }
            (Opening { .. }, Event::Opened) => (Ready, Action::Nothing),
            (Opening { .. }, Event::NotOpened | Event::Doubted)
            | (Opening { .. } | Ready | Asking { .. } | Silent { .. }, Event::Closed) => {
                (self.away(now_ms), Action::Nothing)
            }
            // One request at a time.
            (
                Opening { until_ms } | Asking { until_ms } | Silent { until_ms } | Faulted { until_ms },
                Event::Wanted,
            ) => (self.state, Action::Refuse { until_ms }),
            (Ready | Asking { .. }, Event::Foreign) => {
                self.fail();
                (Faulted { until_ms: now_ms + FAULTED_MS }, Action::Nothing)
            }
            (Faulted { .. }, Event::Reset) => (Away { retry_ms: now_ms }, Action::Nothing),
            (Ready, Event::Wanted) => {
                let until_ms = now_ms + self.rules.asking_ms;
                (Asking { until_ms }, Action::Send { until_ms })
            }
            (Asking { .. }, Event::Answered) => {
                self.failures = 0;
                (Ready, Action::Nothing)
            }
            (Asking { .. } | Ready, Event::Doubted) => (self.doubtful(now_ms), Action::Nothing),
            // What belongs to a connection that is no more.
            (state, _) => (state, Action::Nothing),
        };
        self.state = state;
        action
    }

    /// What a time that is over does by itself.
    fn let_pass(&mut self, now_ms: u64) {
        self.state = match self.state {
            State::Opening { until_ms } if now_ms >= until_ms => self.away(until_ms),
            State::Asking { until_ms } if now_ms >= until_ms => self.doubtful(until_ms),
            State::Faulted { until_ms } if now_ms >= until_ms => State::Away { retry_ms: until_ms },
            other => other,
        };
        if matches!(self.state, State::Silent { until_ms } if now_ms >= until_ms) {
            self.state = State::Ready;
        }
    }

    /// After an attempt that failed, or a connection that was lost.
    fn away(&mut self, now_ms: u64) -> State {
        self.fail();
        State::Away { retry_ms: now_ms + self.rules.wait_ms(self.failures, self.seed) }
    }

    fn fail(&mut self) {
        self.failures = self.failures.saturating_add(1);
        self.epoch += 1;
    }

    /// A reply may still come, and would be taken for that to the next request.
    fn doubtful(&mut self, now_ms: u64) -> State {
        match self.rules.silence_ms {
            Some(silence_ms) => {
                self.fail();
                State::Silent { until_ms: now_ms + silence_ms }
            }
            None => self.away(now_ms),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fmt::Write as _;

    use super::*;
    use proptest::prelude::*;

    const EVENTS: [Event; 8] = [
        Event::Wanted,
        Event::Opened,
        Event::NotOpened,
        Event::Answered,
        Event::Doubted,
        Event::Closed,
        Event::Foreign,
        Event::Reset,
    ];

    fn rules(silence_ms: Option<u64>) -> Rules {
        Rules::new((50, 1600), 2000, 300, silence_ms).unwrap()
    }

    /// Every state on every event, at 1000 ms.
    #[test]
    fn transitions() {
        let states = [
            State::Away { retry_ms: 1000 },
            State::Away { retry_ms: 1100 },
            State::Opening { until_ms: 3000 },
            State::Opening { until_ms: 1000 },
            State::Ready,
            State::Asking { until_ms: 1300 },
            State::Asking { until_ms: 1000 },
            State::Silent { until_ms: 1500 },
            State::Silent { until_ms: 1000 },
            State::Faulted { until_ms: 1500 },
            State::Faulted { until_ms: 1000 },
        ];
        let mut table = String::new();
        for (kind, silence_ms) in [("a stream", None), ("a line", Some(500))] {
            writeln!(table, "{kind}").unwrap();
            for state in states {
                for event in EVENTS {
                    let mut contact = Contact { state, failures: 2, ..Contact::new(rules(silence_ms), 7) };
                    let action = contact.on(event, 1000);
                    let (after, failures, epoch) = (contact.state, contact.failures, contact.epoch);
                    writeln!(
                        table,
                        "  {state:?} + {event:?} -> {after:?}, {action:?}, {failures} failures, epoch {epoch}"
                    )
                    .unwrap();
                }
            }
        }
        insta::assert_snapshot!(table);
    }

    #[test]
    fn waits_double_to_the_longest_and_no_two_contacts_keep_step() {
        let rules = rules(None);
        assert_eq!(rules.wait_ms(1, 7), 0);
        for (attempts, doubled) in [(2, 50), (3, 100), (4, 200), (7, 1600), (8, 1600), (4_000_000, 1600)] {
            let waits = [1, 2, 3].map(|seed| rules.wait_ms(attempts, seed));
            assert!(waits.iter().all(|w| (doubled * 3 / 4..=doubled).contains(w)), "{attempts}: {waits:?}");
            assert!(waits[0] != waits[1] || waits[1] != waits[2], "{attempts}: {waits:?}");
        }
    }

    #[test]
    fn times_that_make_no_rules_are_refused() {
        assert!(Rules::new((1, 1), 1, 1, Some(1)).is_ok());
        let refused = [
            Rules::new((0, 1), 1, 1, None),
            Rules::new((2, 1), 1, 1, None),
            Rules::new((1, 1), 0, 1, None),
            Rules::new((1, 1), 1, 0, None),
            Rules::new((1, 1), 1, 1, Some(0)),
        ];
        assert!(refused.iter().all(Result::is_err));
        assert_eq!(
            refused[1].clone().unwrap_err().to_string(),
            "the longest wait is 1 ms, allowed is 2 (the first) and more"
        );
    }

    #[test]
    fn a_late_answer_is_not_taken_for_the_next_ones() {
        let mut line = Contact { state: State::Ready, ..Contact::new(rules(Some(500)), 7) };
        assert_eq!(line.on(Event::Wanted, 0), Action::Send { until_ms: 300 });
        // It comes when its time is over, and 500 ms of silence have begun with that.
        line.on(Event::Answered, 301);
        assert_eq!(line.on(Event::Wanted, 302), Action::Refuse { until_ms: 800 });
        assert_eq!(line.on(Event::Wanted, 800), Action::Send { until_ms: 1100 });
    }

    proptest! {
        #[test]
        fn whatever_happens_one_request_is_out_and_every_wait_ends(
            events in proptest::collection::vec((0..EVENTS.len(), 0..700u64), 1..200),
            silence_ms in proptest::option::of(1..2000u64),
            seed in any::<u64>(),
        ) {
            let mut contact = Contact::new(rules(silence_ms), seed);
            let (mut now, mut epoch, mut failures) = (0, 0, 0);
            for (event, later) in events {
                now += later;
                let before = { let mut c = contact.clone(); c.let_pass(now); c.state() };
                match contact.on(EVENTS[event], now) {
                    Action::Send { .. } => prop_assert_eq!(before, State::Ready),
                    Action::Open { .. } => prop_assert!(matches!(before, State::Away { .. }), "{before:?}"),
                    _ => (),
                }
                let ends_ms = match contact.state() {
                    State::Away { retry_ms, .. } => retry_ms,
                    State::Opening { until_ms }
                    | State::Asking { until_ms }
                    | State::Silent { until_ms }
                    | State::Faulted { until_ms } => until_ms,
                    State::Ready => now,
                };
                let longest_ms = if matches!(contact.state(), State::Faulted { .. }) { FAULTED_MS } else { 2000 };
                prop_assert!(ends_ms <= now + longest_ms.max(silence_ms.unwrap_or(0)));
                // A new epoch begins with every failure, and with nothing else.
                let failed = contact.failures() > failures;
                prop_assert!(!failed || contact.epoch() > epoch, "{event} {:?}", contact.state());
                prop_assert!(failed || contact.failures() == 0 || contact.epoch() == epoch);
                (epoch, failures) = (contact.epoch(), contact.failures());
            }
            // Left alone for as long as the longest of its times in a row, it can be asked again.
            let refused = matches!(contact.on(Event::Wanted, now + FAULTED_MS), Action::Refuse { .. });
            prop_assert!(!refused, "{:?}", contact.state());
        }
    }
}
