//! A Modbus client of one unit: one request in flight, every reply checked, after any doubt the stream dropped or the line left alone.
//!
//! tokio-modbus has no deadlines and checks neither the count of a read nor the echo of a write; after a timeout a TCP stream stays
//! off by one, and an RTU client takes a late reply for the next one. So each call here has a deadline, compares what came
//! with what was asked, and keeps the connection only when all is right; [`Caller`] says when the next request may be made. A line
//! is kept through a doubt: it falls silent for as long as a reply may take, and what arrived is thrown away (`line`). A call
//! that is cancelled is a doubt, too.
//!
//! Under `modbus` and `direct`.

use std::borrow::Cow;

use tokio::time::{Duration, Instant, sleep_until, timeout_at};
use tokio_modbus::client::{Client as _, rtu};
use tokio_modbus::{ExceptionCode, Request, Response, Slave};

use super::caller::{BUSY_RETRIES, Caller, Next, RETRIES, millis};
use super::contact::{Event, RulesError};
use super::link::LinkError;
use super::open::{Connection, Opener, open};
use super::plan;
use super::profile::Profile;
use super::recording::Frames;
use super::transport::Transport;

/// What the library says when it finds no frame of RTU in what it heard.
const NO_FRAME: &str = "Too many retries";

/// One unit behind Modbus.
pub struct ModbusClient {
    profile: Profile,
    unit_id: u8,
    opener: Option<Opener>,
    caller: Caller<Connection>,
    frames: Frames,
    /// When something was last heard.
    heard: Instant,
}

impl ModbusClient {
    /// A link that connects at its first use; `endpoint` is what the profile's transport takes. Where there is an `opener`, over
    /// the wires that it makes.
    pub fn new(
        profile: Profile,
        unit_id: u8,
        endpoint: String,
        opener: Option<Opener>,
    ) -> Result<ModbusClient, RulesError> {
        let silence_ms = profile.transport.line().map(|line| millis(line.quiet));
        let asking_ms = millis(profile.deadlines.request);
        let caller = Caller::new(endpoint, &profile.deadlines, asking_ms, silence_ms)?;
        Ok(ModbusClient {
            profile,
            unit_id,
            opener,
            caller,
            frames: Frames::default(),
            heard: Instant::now(),
        })
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
                    let opening =
                        open(&self.profile, self.unit_id, &endpoint, self.opener.as_mut(), &self.frames);
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
                once = rtu::attach_slave(line.clone(), Slave(self.unit_id));
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
            Ok(Ok(Err(exception @ (ExceptionCode::ServerDeviceBusy | ExceptionCode::Acknowledge)))) => {
                let what = format!("{what}: {}", name(exception));
                (Event::Answered, Err(LinkError::Busy { endpoint, what }))
            }
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
        let pause = Duration::from_millis(self.profile.deadlines.poll_ms);
        let line_retries = if self.profile.transport.line().is_some() { RETRIES } else { 0 };
        let (mut patience, mut repeats, mut failed) = (BUSY_RETRIES, line_retries, None);
        loop {
            match self.call(request.clone()).await {
                Err(LinkError::Busy { .. }) if patience > 0 => {
                    patience -= 1;
                    tokio::time::sleep(pause).await;
                }
                Err(error @ (LinkError::Timeout { .. } | LinkError::Broken { .. })) if repeats > 0 => {
                    repeats -= 1;
                    failed.get_or_insert(error);
                }
                // It cannot be asked again yet; why is what failed first.
                Err(resting @ LinkError::Resting { .. }) => return Err(failed.unwrap_or(resting)),
                other => return other,
            }
        }
    }

    /// What went by last.
    pub fn frames(&self) -> &Frames {
        &self.frames
    }

    /// When it may be called, and what was seen.
    pub fn caller(&mut self) -> &mut Caller<Connection> {
        &mut self.caller
    }

    /// Where it is.
    pub fn endpoint(&self) -> &str {
        self.caller.endpoint()
    }

    /// Registers' bytes, high byte first; repeated when need be.
    pub async fn read(&mut self, requests: Vec<plan::Request>) -> Result<Vec<u8>, LinkError> {
        let mut out = Vec::new();
        for plan::Request { address, registers, .. } in requests {
            let words = self.call_patiently(Request::ReadHoldingRegisters(address, registers)).await?;
            out.extend(words.into_iter().flat_map(u16::to_be_bytes));
        }
        Ok(out)
    }

    /// Bits of coils, the first the lowest; repeated when need be.
    pub async fn read_coils(&mut self, address: u16, count: u16) -> Result<u16, LinkError> {
        let words = self.call_patiently(Request::ReadCoils(address, count)).await?;
        Ok(words[0])
    }

    /// Writes that may be repeated.
    pub async fn write(&mut self, requests: Vec<plan::Request>, bytes: &[u8]) -> Result<(), LinkError> {
        let words = words_of(bytes);
        let mut rest = &words[..];
        for request in requests {
            let (now, later) = rest.split_at(usize::from(request.registers));
            self.call_patiently(Request::WriteMultipleRegisters(request.address, Cow::Borrowed(now))).await?;
            rest = later;
        }
        Ok(())
    }

    /// One write that is never repeated, and is not made when anything failed since the machine's state was read.
    pub async fn write_once(&mut self, address: u16, bytes: &[u8]) -> Result<(), LinkError> {
        let request = Request::WriteMultipleRegisters(address, Cow::Owned(words_of(bytes)));
        self.caller.check_seen(|| describe(&request))?;
        self.call(request).await?;
        Ok(())
    }

    /// An answer that cannot be right.
    pub fn nonsense(&self, why: String) -> LinkError {
        LinkError::Nonsense { endpoint: self.endpoint().to_owned(), why }
    }
}

fn words_of(bytes: &[u8]) -> Vec<u16> {
    bytes.chunks_exact(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect()
}

fn describe(request: &Request<'_>) -> String {
    match request {
        Request::ReadHoldingRegisters(at, count) => format!("reading registers {at} to {}", at + (count - 1)),
        Request::ReadCoils(at, count) => format!("reading coils {at} to {}", at + (count - 1)),
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
        (Request::ReadCoils(_, count), Response::ReadCoils(bits)) => {
            // They come in whole bytes.
            if bits.len() < usize::from(*count) || bits.len() >= usize::from(*count) + 8 {
                return Err(format!("the answer has {} coils instead of {count}", bits.len()));
            }
            let bits = bits.iter().take(usize::from(*count).min(16)).enumerate();
            Ok(vec![bits.map(|(i, bit)| u16::from(*bit) << i).sum()])
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
        tokio_modbus::Error::Transport(e) if e.to_string() == NO_FRAME => {
            "bytes came that are no frame: compare baud rate, parity, stop bits and unit with the controller's; on RS-485 look for \
             others that send on the same wires"
                .into()
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

    /// A line at another baud rate: the error was "Too many retries".
    #[tokio::test(start_paused = true)]
    async fn a_line_that_babbles_says_what_to_compare() {
        use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, duplex};
        let profile = Profile::load("reference-rtu").unwrap();
        let (here, mut there) = duplex(65_536);
        let mut here = Some(here);
        let opener: Opener = Box::new(move || {
            let wire = here.take().ok_or(std::io::ErrorKind::NotFound)?;
            Ok(Box::new(wire) as Box<dyn super::super::line::Wire>)
        });
        let mut client = ModbusClient::new(profile, 1, "line".into(), Some(opener)).unwrap();
        let machine = tokio::spawn(async move {
            let mut request = [0; 8];
            while there.read_exact(&mut request).await.is_ok() {
                there.write_all(&[0x55; 200]).await.unwrap();
            }
        });
        let request = plan::Request { writes: false, address: 0, registers: 36 };
        let error = client.read(vec![request]).await.unwrap_err().to_string();
        assert!(error.contains("no frame: compare baud rate, parity"), "{error}");
        drop(client);
        machine.await.unwrap();
    }

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
