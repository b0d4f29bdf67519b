//! One caller of one machine: its connection, and when it may be used. [`Contact`] decides; this keeps the clock and the errors.
//!
//! Under every link (`modbus`, `table_link`).

use std::future::Future;
use std::io;

use tokio::time::{Duration, Instant, sleep_until, timeout_at};

use super::contact::{Action, Contact, Event, Rules, RulesError, State};
use super::link::LinkError;
use super::profile::Deadlines;
use super::wire::crc_of;

/// Between two attempts to connect no more than this share of the time in which a commit is confirmed: after it the machine
/// must be asked.
const LONGEST_WAIT_SHARE: u64 = 4;

/// How often a machine that says "busy" is asked again.
pub const BUSY_RETRIES: u32 = 3;

/// How often what was garbled or lost is asked again, where that may be.
pub const RETRIES: u32 = 2;

/// A constant that is wrong so many times in a row is no damage on the way: it is another machine.
pub const FOREIGN_LOOKS: usize = 2;

/// A connection of the kind `C`, or none.
pub struct Caller<C> {
    endpoint: String,
    deadlines: Deadlines,
    contact: Contact,
    since: Instant,
    connection: Option<C>,
    /// The contact's epoch in which the machine's state was read last.
    seen: Option<u64>,
}

/// What comes before a request.
pub enum Next {
    /// A connection must be opened, until then.
    Open(Instant),
    /// The request may be sent; its answer is waited for until then.
    Send(Instant),
}

impl<C> Caller<C> {
    /// Connects at its first use. `asking_ms` is the longest that one request takes; `silence_ms` as in [`Rules::new`].
    pub fn new(
        endpoint: String,
        deadlines: &Deadlines,
        asking_ms: u64,
        silence_ms: Option<u64>,
    ) -> Result<Caller<C>, RulesError> {
        let first_ms = deadlines.poll_ms;
        let waits = (first_ms, (deadlines.confirm_ms / LONGEST_WAIT_SHARE).max(first_ms));
        let rules = Rules::new(waits, millis(deadlines.connect), asking_ms, silence_ms)?;
        let contact = Contact::new(rules, u64::from(crc_of(endpoint.as_bytes())));
        Ok(Caller {
            endpoint,
            deadlines: deadlines.clone(),
            contact,
            since: Instant::now(),
            connection: None,
            seen: None,
        })
    }

    /// Where the machine is.
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// The clock that the contact goes by.
    pub fn now_ms(&self) -> u64 {
        millis(self.since.elapsed())
    }

    /// The time at a contact's millisecond.
    pub fn at(&self, ms: u64) -> Instant {
        self.since + Duration::from_millis(ms)
    }

    /// The connection, which [`Caller::next`] promised.
    pub fn connection(&mut self) -> Result<&mut C, LinkError> {
        let Caller { connection, contact, endpoint, since, .. } = self;
        connection.as_mut().ok_or_else(|| resting(endpoint, contact, *since))
    }

    /// A call that was cancelled has left the contact waiting for its answer.
    pub fn give_up_cancelled(&mut self) {
        if matches!(self.contact.state(), State::Opening { .. } | State::Asking { .. }) {
            self.perform(Event::Doubted);
        }
    }

    /// What is to be done before the next request can be sent; lets a line be silent.
    pub async fn next(&mut self) -> Result<Next, LinkError> {
        loop {
            match self.contact.on(Event::Wanted, self.now_ms()) {
                Action::Send { until_ms } => return Ok(Next::Send(self.at(until_ms))),
                Action::Open { until_ms } => return Ok(Next::Open(self.at(until_ms))),
                Action::Refuse { until_ms } if matches!(self.contact.state(), State::Silent { .. }) => {
                    sleep_until(self.at(until_ms)).await;
                }
                _ => return Err(resting(&self.endpoint, &self.contact, self.since)),
            }
        }
    }

    /// Opens the connection, until then.
    pub async fn open(
        &mut self,
        until: Instant,
        opening: impl Future<Output = io::Result<C>>,
    ) -> Result<(), LinkError> {
        let opened = match timeout_at(until, opening).await {
            Ok(opened) => opened.map_err(|e| e.to_string()),
            Err(_) => Err(format!("no answer within {} ms", self.deadlines.connect.as_millis())),
        };
        match opened {
            Ok(connection) => {
                self.connection = Some(connection);
                self.perform(Event::Opened);
                Ok(())
            }
            Err(why) => {
                self.perform(Event::NotOpened);
                Err(LinkError::Connect { endpoint: self.endpoint.clone(), why })
            }
        }
    }

    /// Tells the contact what happened, and drops a connection that was given up.
    pub fn perform(&mut self, event: Event) {
        let now_ms = self.now_ms();
        self.contact.on(event, now_ms);
        if !self.contact.keeps_connection() {
            self.connection = None;
        }
    }

    /// The machine's state was read: what rests on it may be sent as long as nothing fails.
    pub fn has_seen(&mut self) {
        self.seen = Some(self.contact.epoch());
    }

    /// Whether nothing failed since; `what` is what rests on it.
    pub fn check_seen(&mut self, what: impl FnOnce() -> String) -> Result<(), LinkError> {
        self.give_up_cancelled();
        if self.seen == Some(self.contact.epoch()) {
            return Ok(());
        }
        Err(LinkError::Outdated { endpoint: self.endpoint.clone(), what: what() })
    }
}

/// Why nothing can be asked now.
fn resting(endpoint: &str, contact: &Contact, since: Instant) -> LinkError {
    let left_ms = |until_ms: u64| until_ms.saturating_sub(millis(since.elapsed()));
    let (endpoint, failures) = (endpoint.to_owned(), contact.failures());
    match contact.state() {
        State::Faulted { until_ms } => LinkError::Foreign { endpoint, ms: left_ms(until_ms) },
        State::Away { retry_ms } => LinkError::Resting { endpoint, failures, ms: left_ms(retry_ms) },
        _ => LinkError::Resting { endpoint, failures, ms: 0 },
    }
}

/// Whole milliseconds.
pub fn millis(time: Duration) -> u64 {
    u64::try_from(time.as_millis()).unwrap_or(u64::MAX)
}
