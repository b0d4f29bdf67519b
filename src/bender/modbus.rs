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

use super::caller::{Caller, Next, millis};
use super::contact::{Event, RulesError};
use super::link::{ActiveTable, Bender, LinkError};
use super::open::{Connection, Opener, open};
use super::plan;
use super::profile::Profile;
use super::recording::Frames;
use super::registers::{ModbusMap, decode_status};
use super::transport::Transport;
use super::wire::{Staged, Status, TableId, commit_image, crc_of, payload_bytes, staging_image};

/// How often a device that says "busy" is asked again.
const BUSY_RETRIES: u32 = 3;

/// How often what a line garbled or lost is asked again.
const LINE_RETRIES: u32 = 2;

/// A constant that is wrong so many times in a row is no damage on the way: it is another machine.
const FOREIGN_LOOKS: usize = 2;

/// A bender behind Modbus.
pub struct ModbusLink {
    profile: Profile,
    map: ModbusMap,
    opener: Option<Opener>,
    caller: Caller<Connection>,
    frames: Frames,
    /// When something was last heard.
    heard: Instant,
}

impl ModbusLink {
    /// A link that connects at its first use; `endpoint` is what the profile's transport takes. Where there is an `opener`, over
    /// the wires that it makes.
    pub fn new(
        profile: Profile,
        map: ModbusMap,
        endpoint: String,
        opener: Option<Opener>,
    ) -> Result<ModbusLink, RulesError> {
        let silence_ms = profile.transport.line().map(|line| millis(line.quiet));
        let asking_ms = millis(profile.deadlines.request);
        let caller = Caller::new(endpoint, &profile.deadlines, asking_ms, silence_ms)?;
        Ok(ModbusLink { profile, map, opener, caller, frames: Frames::default(), heard: Instant::now() })
    }

    /// Opens the connection if need be, and lets a line be silent; until when a reply is waited for.
    async fn ready(&mut self) -> Result<Instant, LinkError> {
        self.caller.give_up_cancelled();
        // Between two frames on a serial line it is silent.
        if let Transport::ModbusRtu(_, _, serial) = &self.profile.transport {
            sleep_until(self.heard + serial.gap()).await;
        }
        loop {
            match self.caller.next().await? {
                Next::Send(until) => return Ok(until),
                Next::Open(until) => {
                    let endpoint = self.caller.endpoint().to_owned();
                    let opener = self.opener.as_mut();
                    let opening = open(&self.profile, self.map.unit_id, &endpoint, opener, &self.frames);
                    self.caller.open(until, opening).await?;
                }
            }
        }
    }

    /// One request and its checked reply.
    async fn call(&mut self, request: Request<'_>) -> Result<Vec<u16>, LinkError> {
        let until = self.ready().await?;
        let (endpoint, what) = (self.caller.endpoint().to_owned(), describe(&request));
        let broken = |what, why| LinkError::Broken { endpoint: endpoint.clone(), what, why };
        let mut once;
        let client = match self.caller.connection()? {
            Connection::Stream(client) => client,
            Connection::Line(line) => {
                once = rtu::attach_slave(line.clone(), Slave(self.map.unit_id));
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
        self.caller.perform(event);
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
        LinkError::Nonsense { endpoint: self.caller.endpoint().to_owned(), why }
    }
}

impl Bender for ModbusLink {
    fn profile(&self) -> &Profile {
        &self.profile
    }

    fn endpoint(&self) -> &str {
        self.caller.endpoint()
    }

    fn reset(&mut self) {
        self.caller.perform(Event::Reset);
    }

    fn last_frames(&self) -> Vec<String> {
        self.frames.lines()
    }

    async fn read_status(&mut self) -> Result<Status, LinkError> {
        let mut wrong = String::new();
        for _ in 0..FOREIGN_LOOKS {
            let bytes = self.read(vec![plan::status(&self.profile, &self.map)]).await?;
            match decode_status(&self.profile, &self.map, &bytes) {
                Ok(status) => {
                    self.caller.has_seen();
                    return Ok(status);
                }
                Err(why) => wrong = why,
            }
        }
        self.caller.perform(Event::Foreign);
        Err(self.nonsense(wrong))
    }

    async fn write_staging(&mut self, staged: &Staged) -> Result<(), LinkError> {
        let image = staging_image(&self.profile, staged);
        let words = words_of(&image);
        let mut rest = &words[..];
        for request in plan::writes(&self.map, self.map.registers.staging, image.len()) {
            let (now, later) = rest.split_at(usize::from(request.registers));
            self.call_patiently(Request::WriteMultipleRegisters(request.address, Cow::Borrowed(now))).await?;
            rest = later;
        }
        Ok(())
    }

    async fn read_staging(&mut self, bytes: usize) -> Result<Vec<u8>, LinkError> {
        self.read(plan::reads(&self.map, self.map.registers.staging, bytes)).await
    }

    async fn commit(&mut self, id: TableId) -> Result<(), LinkError> {
        let words = words_of(&commit_image(&self.profile, id));
        let request = Request::WriteMultipleRegisters(self.map.registers.commit, Cow::Owned(words));
        self.caller.check_seen(|| describe(&request))?;
        self.call(request).await?;
        Ok(())
    }

    async fn read_active(&mut self) -> Result<ActiveTable, LinkError> {
        let status = self.read_status().await?;
        let (address, header) = (self.map.registers.active, self.profile.payload_header_bytes());
        if status.active.revision == 0 {
            return Ok(ActiveTable { status, payload: Vec::new() });
        }
        let mut payload = self.read(plan::reads(&self.map, address, header)).await?;
        let name = self.profile.table.program_bytes;
        let bends = usize::from(u16::from_be_bytes([payload[name], payload[name + 1]]));
        let most = self.profile.limits.max_bends;
        if bends > most {
            return Err(
                self.nonsense(format!("the active table says {bends} bends, its area has room for {most}"))
            );
        }
        let rows = payload_bytes(&self.profile, bends) - header;
        payload.extend(self.read(plan::reads(&self.map, plan::rows(&self.profile, &self.map), rows)).await?);
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
