//! The Modbus link, over TCP and as RTU on lines: one request in flight, every reply checked, after any doubt the stream dropped or
//! the line left alone.
//!
//! tokio-modbus has no deadlines and checks neither the count of a read nor the echo of a write; after a timeout a TCP stream stays
//! off by one, and an RTU client takes a late reply for the next one. So each call here has a deadline, compares what came
//! with what was asked, and keeps the connection only when all is right; [`Contact`] says when the next request may be made. A line
//! is kept through a doubt: it falls silent for as long as a reply may take, and what arrived is thrown away (`line`). A call
//! that is cancelled is a doubt, too.

use std::borrow::Cow;

use tokio::time::{Duration, Instant, sleep_until, timeout_at};
use tokio_modbus::client::{Client as _, rtu};
use tokio_modbus::{ExceptionCode, Request, Response, Slave};

use super::contact::{Action, Contact, Event, Rules, RulesError, State};
use super::link::{ActiveTable, Bender, LinkError};
use super::open::{Connection, Opener, open};
use super::plan;
use super::profile::Profile;
use super::transport::Transport;
use super::wire::{
    Staged, Status, TableId, commit_image, crc_of, decode_status, payload_bytes, staging_image,
};

/// How often a device that says "busy" is asked again.
const BUSY_RETRIES: u32 = 3;

/// Between two attempts to connect no more than this share of the time in which a commit is confirmed: after it the machine
/// must be asked.
const LONGEST_WAIT_SHARE: u64 = 4;

/// How often what a line garbled or lost is asked again.
const LINE_RETRIES: u32 = 2;

/// A constant that is wrong so many times in a row is no damage on the way: it is another machine.
const FOREIGN_LOOKS: usize = 2;

/// A bender behind Modbus.
pub struct ModbusLink {
    profile: Profile,
    endpoint: String,
    opener: Option<Opener>,
    connection: Option<Connection>,
    contact: Contact,
    since: Instant,
    /// When something was last heard.
    heard: Instant,
    /// The contact's epoch in which the status was read last.
    seen: Option<u64>,
}

impl ModbusLink {
    /// A link that connects at its first use; `endpoint` is what the profile's transport takes.
    pub fn new(profile: Profile, endpoint: impl Into<String>) -> Result<ModbusLink, RulesError> {
        let (endpoint, deadlines) = (endpoint.into(), &profile.deadlines);
        let first_ms = deadlines.poll_ms;
        let waits = (first_ms, (deadlines.confirm_ms / LONGEST_WAIT_SHARE).max(first_ms));
        let silence_ms = profile.transport.line().map(|line| millis(line.quiet));
        let rules = Rules::new(waits, millis(deadlines.connect), millis(deadlines.request), silence_ms)?;
        let contact = Contact::new(rules, u64::from(crc_of(endpoint.as_bytes())));
        let now = Instant::now();
        Ok(ModbusLink {
            profile,
            endpoint,
            opener: None,
            connection: None,
            contact,
            since: now,
            heard: now,
            seen: None,
        })
    }

    /// The same over wires that `opener` makes; the endpoint is their name.
    pub fn over(
        profile: Profile,
        endpoint: impl Into<String>,
        opener: Opener,
    ) -> Result<ModbusLink, RulesError> {
        Ok(ModbusLink { opener: Some(opener), ..ModbusLink::new(profile, endpoint)? })
    }

    /// Tells the contact what happened.
    fn on(&mut self, event: Event) -> Action {
        self.contact.on(event, millis(self.since.elapsed()))
    }

    /// The time at a contact's millisecond.
    fn at(&self, ms: u64) -> Instant {
        self.since + Duration::from_millis(ms)
    }

    async fn connect(&mut self, until_ms: u64) -> Result<(), LinkError> {
        let until = self.at(until_ms);
        let opening = open(&self.profile, &self.endpoint, self.opener.as_mut());
        let opened = match timeout_at(until, opening).await {
            Ok(opened) => opened.map_err(|e| e.to_string()),
            Err(_) => Err(format!("no answer within {} ms", self.profile.deadlines.connect.as_millis())),
        };
        match opened {
            Ok(connection) => {
                self.connection = Some(connection);
                self.on(Event::Opened);
                Ok(())
            }
            Err(why) => {
                self.on(Event::NotOpened);
                Err(LinkError::Connect { endpoint: self.endpoint.clone(), why })
            }
        }
    }

    /// Opens the connection if need be, and lets a line be silent; until when a reply is waited for.
    async fn ready(&mut self) -> Result<Instant, LinkError> {
        loop {
            match self.on(Event::Wanted) {
                Action::Send { until_ms } => return Ok(self.at(until_ms)),
                Action::Open { until_ms } => self.connect(until_ms).await?,
                Action::Refuse { until_ms } if matches!(self.contact.state(), State::Silent { .. }) => {
                    sleep_until(self.at(until_ms)).await;
                }
                _ => return Err(self.resting()),
            }
        }
    }

    /// A call that was cancelled has left the contact waiting for its answer.
    fn give_up_cancelled(&mut self) {
        if matches!(self.contact.state(), State::Opening { .. } | State::Asking { .. }) {
            self.perform(Event::Doubted);
        }
    }

    /// Tells the contact what happened, and drops a connection that was given up.
    fn perform(&mut self, event: Event) {
        self.on(event);
        if !self.contact.keeps_connection() {
            self.connection = None;
        }
    }

    /// Between two frames on a serial line it is silent.
    async fn let_frame_end(&mut self) {
        if let Transport::ModbusRtu(_, serial) = &self.profile.transport {
            sleep_until(self.heard + serial.gap()).await;
        }
    }

    fn resting(&self) -> LinkError {
        let now_ms = millis(self.since.elapsed());
        let (endpoint, failures) = (self.endpoint.clone(), self.contact.failures());
        match self.contact.state() {
            State::Faulted { until_ms } => {
                LinkError::Foreign { endpoint, ms: until_ms.saturating_sub(now_ms) }
            }
            State::Away { retry_ms } => {
                LinkError::Resting { endpoint, failures, ms: retry_ms.saturating_sub(now_ms) }
            }
            _ => LinkError::Resting { endpoint, failures, ms: 0 },
        }
    }

    /// One request and its checked reply.
    async fn call(&mut self, request: Request<'_>) -> Result<Vec<u16>, LinkError> {
        self.give_up_cancelled();
        self.let_frame_end().await;
        let until = self.ready().await?;
        let (endpoint, what) = (self.endpoint.clone(), describe(&request));
        let broken = |what, why| LinkError::Broken { endpoint: endpoint.clone(), what, why };
        let Some(connection) = &mut self.connection else { return Err(self.resting()) };
        let mut once;
        let client = match connection {
            Connection::Stream(client) => client,
            Connection::Line(line) => {
                once = rtu::attach_slave(line.clone(), Slave(self.profile.unit_id));
                &mut once
            }
        };
        let answer = timeout_at(until, client.call(request.clone())).await;
        self.heard = Instant::now();
        let (event, result) = match answer {
            Err(_) => {
                let ms = self.profile.deadlines.request.as_millis();
                (Event::Doubted, Err(LinkError::Timeout { endpoint, what, ms }))
            }
            Ok(Err(error)) => {
                let event = if is_closed(&error) { Event::Closed } else { Event::Doubted };
                (event, Err(broken(what, explain(&error))))
            }
            // A refusal is a proper answer.
            Ok(Ok(Err(exception))) => {
                (Event::Answered, Err(LinkError::Exception { endpoint, what, exception: name(exception) }))
            }
            Ok(Ok(Ok(response))) => match fits(&request, response) {
                Ok(words) => (Event::Answered, Ok(words)),
                Err(why) => (Event::Doubted, Err(broken(what, why))),
            },
        };
        self.perform(event);
        result
    }

    /// The same for requests that may be repeated: "busy" is asked again, a few times, and what a line garbled or lost.
    async fn call_patiently(&mut self, request: Request<'_>) -> Result<Vec<u16>, LinkError> {
        let busy = [ExceptionCode::ServerDeviceBusy, ExceptionCode::Acknowledge].map(name);
        let pause = Duration::from_millis(self.profile.deadlines.poll_ms);
        let line_retries = if self.profile.transport.line().is_some() { LINE_RETRIES } else { 0 };
        let (mut patience, mut repeats) = (BUSY_RETRIES, line_retries);
        loop {
            match self.call(request.clone()).await {
                Err(LinkError::Exception { exception, .. }) if patience > 0 && busy.contains(&exception) => {
                    patience -= 1;
                    tokio::time::sleep(pause).await;
                }
                Err(LinkError::Timeout { .. } | LinkError::Broken { .. }) if repeats > 0 => repeats -= 1,
                other => return other,
            }
        }
    }

    async fn read(&mut self, requests: Vec<plan::Request>) -> Result<Vec<u8>, LinkError> {
        let mut out = Vec::new();
        for plan::Request { address, registers, .. } in requests {
            let words = self.call_patiently(Request::ReadHoldingRegisters(address, registers)).await?;
            out.extend(words.into_iter().flat_map(u16::to_be_bytes));
        }
        Ok(out)
    }

    fn nonsense(&self, why: String) -> LinkError {
        LinkError::Nonsense { endpoint: self.endpoint.clone(), why }
    }
}

impl Bender for ModbusLink {
    fn profile(&self) -> &Profile {
        &self.profile
    }

    fn endpoint(&self) -> &str {
        &self.endpoint
    }

    fn reset(&mut self) {
        self.perform(Event::Reset);
    }

    async fn read_status(&mut self) -> Result<Status, LinkError> {
        let mut wrong = String::new();
        for _ in 0..FOREIGN_LOOKS {
            let bytes = self.read(vec![plan::status(&self.profile)]).await?;
            match decode_status(&self.profile, &bytes) {
                Ok(status) => {
                    self.seen = Some(self.contact.epoch());
                    return Ok(status);
                }
                Err(why) => wrong = why,
            }
        }
        self.perform(Event::Foreign);
        Err(self.nonsense(wrong))
    }

    async fn write_staging(&mut self, staged: &Staged) -> Result<(), LinkError> {
        let image = staging_image(&self.profile, staged);
        let words = words_of(&image);
        let mut rest = &words[..];
        for request in plan::writes(&self.profile, self.profile.registers.staging, image.len()) {
            let (now, later) = rest.split_at(usize::from(request.registers));
            self.call_patiently(Request::WriteMultipleRegisters(request.address, Cow::Borrowed(now))).await?;
            rest = later;
        }
        Ok(())
    }

    async fn read_staging(&mut self, bytes: usize) -> Result<Vec<u8>, LinkError> {
        self.read(plan::reads(&self.profile, self.profile.registers.staging, bytes)).await
    }

    async fn commit(&mut self, id: TableId) -> Result<(), LinkError> {
        let words = words_of(&commit_image(&self.profile, id));
        let request = Request::WriteMultipleRegisters(self.profile.registers.commit, Cow::Owned(words));
        self.give_up_cancelled();
        if self.seen != Some(self.contact.epoch()) {
            let what = describe(&request);
            return Err(LinkError::Outdated { endpoint: self.endpoint.clone(), what });
        }
        self.call(request).await?;
        Ok(())
    }

    async fn read_active(&mut self) -> Result<ActiveTable, LinkError> {
        let status = self.read_status().await?;
        let (address, header) = (self.profile.registers.active, self.profile.payload_header_bytes());
        if status.active.revision == 0 {
            return Ok(ActiveTable { status, payload: Vec::new() });
        }
        let mut payload = self.read(plan::reads(&self.profile, address, header)).await?;
        let name = 2 * usize::from(self.profile.table.program_registers);
        let bends = usize::from(u16::from_be_bytes([payload[name], payload[name + 1]]));
        let most = self.profile.limits.max_bends;
        if bends > most {
            return Err(
                self.nonsense(format!("the active table says {bends} bends, its area has room for {most}"))
            );
        }
        let rows = payload_bytes(&self.profile, bends) - header;
        payload.extend(self.read(plan::reads(&self.profile, plan::rows(&self.profile), rows)).await?);
        let crc = crc_of(&payload);
        if crc != status.active.crc {
            return Err(self.nonsense(format!(
                "the active rows have CRC {crc:08X}, the machine says {}: caught in a change, or damaged",
                status.active
            )));
        }
        Ok(ActiveTable { status, payload })
    }
}

fn millis(time: Duration) -> u64 {
    u64::try_from(time.as_millis()).unwrap_or(u64::MAX)
}

fn words_of(bytes: &[u8]) -> Vec<u16> {
    bytes.chunks_exact(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect()
}

fn describe(request: &Request<'_>) -> String {
    match request {
        Request::ReadHoldingRegisters(at, count) => format!("reading registers {at} to {}", at + (count - 1)),
        Request::WriteMultipleRegisters(at, words) => {
            format!("writing registers {at} to {}", usize::from(*at) + words.len() - 1)
        }
        other => format!("calling function {}", other.function_code()),
    }
}

/// The words read (none for a write), if the reply is the one to this request.
fn fits(request: &Request<'_>, response: Response) -> Result<Vec<u16>, String> {
    match (request, response) {
        (Request::ReadHoldingRegisters(_, count), Response::ReadHoldingRegisters(words)) => {
            if words.len() == usize::from(*count) {
                Ok(words)
            } else {
                Err(format!("the answer has {} registers instead of {count}", words.len()))
            }
        }
        (Request::WriteMultipleRegisters(at, words), Response::WriteMultipleRegisters(echo, count)) => {
            if echo == *at && usize::from(count) == words.len() {
                Ok(Vec::new())
            } else {
                Err(format!("the answer confirms {count} registers from {echo}"))
            }
        }
        (_, other) => Err(format!("the answer is to function {}", other.function_code())),
    }
}

/// Whether the other side closed the connection, or the device is gone; what is merely garbled says nothing of that.
fn is_closed(error: &tokio_modbus::Error) -> bool {
    matches!(error, tokio_modbus::Error::Transport(e) if e.kind() != std::io::ErrorKind::InvalidData)
}

fn explain(error: &tokio_modbus::Error) -> String {
    match error {
        // The library reports a closed stream as whatever errno was last, often "Success".
        tokio_modbus::Error::Transport(e) if matches!(e.raw_os_error(), Some(0 | 11 | 115)) => {
            "the machine closed the connection".into()
        }
        other => other.to_string(),
    }
}

fn name(exception: ExceptionCode) -> String {
    format!("{exception} (exception {})", u8::from(exception))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reply_of_another_length_or_place_does_not_fit() {
        let read = Request::ReadHoldingRegisters(10, 3);
        assert_eq!(fits(&read, Response::ReadHoldingRegisters(vec![1, 2, 3])), Ok(vec![1, 2, 3]));
        assert!(fits(&read, Response::ReadHoldingRegisters(vec![1, 2])).is_err());
        assert!(fits(&read, Response::ReadHoldingRegisters(vec![1, 2, 3, 4])).is_err());
        assert!(fits(&read, Response::WriteMultipleRegisters(10, 3)).is_err());
        let write = Request::WriteMultipleRegisters(10, Cow::Owned(vec![1, 2]));
        assert!(fits(&write, Response::WriteMultipleRegisters(10, 2)).is_ok());
        assert!(fits(&write, Response::WriteMultipleRegisters(11, 2)).is_err());
        assert!(fits(&write, Response::WriteMultipleRegisters(10, 1)).is_err());
    }
}
