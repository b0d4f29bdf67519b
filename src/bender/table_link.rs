//! The link to a machine that keeps objects: one exchange at a time, each within its deadlines, after any doubt the line silent or
//! the connection dropped. [`Contact`](super::contact::Contact) says when, the protocol says what.

use tokio::time::{Duration, Instant, timeout_at};

use super::caller::{BUSY_RETRIES, Caller, FOREIGN_LOOKS, Next, RETRIES, millis};
use super::contact::{Event as Happened, RulesError};
use super::exchange::{Action, Ask, Event, Exchange, Failure, Port, Protocol};
use super::link::{ActiveTable, Bender, LinkError};
use super::profile::Profile;
use super::status_image::decode_status_image;
use super::wire::{Staged, Status, TableId, staging_image};

/// A bender behind a protocol.
pub struct TableLink<P: Protocol> {
    profile: Profile,
    protocol: P,
    caller: Caller<P::Port>,
}

/// How an exchange ended without an answer.
enum Ended {
    Failed(Failure),
    Io(std::io::Error),
}

impl<P: Protocol> TableLink<P> {
    /// A link that connects at its first use.
    pub fn new(profile: Profile, protocol: P, endpoint: String) -> Result<TableLink<P>, RulesError> {
        let silence_ms = profile.transport.line().map(|line| millis(line.quiet));
        let asking_ms = millis(profile.deadlines.transfer);
        let caller = Caller::new(endpoint, &profile.deadlines, asking_ms, silence_ms)?;
        Ok(TableLink { profile, protocol, caller })
    }

    async fn ready(&mut self) -> Result<Instant, LinkError> {
        self.caller.give_up_cancelled();
        loop {
            match self.caller.next().await? {
                Next::Send(until) => return Ok(until),
                Next::Open(until) => {
                    let endpoint = self.caller.endpoint().to_owned();
                    let opening = self.protocol.open(&endpoint);
                    self.caller.open(until, opening).await?;
                }
            }
        }
    }

    /// One exchange.
    async fn ask(&mut self, ask: &Ask) -> Result<Vec<u8>, LinkError> {
        let until = self.ready().await?;
        let exchange = self.protocol.begin(ask);
        let (now_ms, begun) = (self.caller.now_ms(), Instant::now());
        let clock = move || now_ms + millis(begun.elapsed());
        let port = self.caller.connection()?;
        let answer = timeout_at(until, perform(port, exchange, clock)).await;
        let (endpoint, what) = (self.caller.endpoint().to_owned(), describe(ask));
        let (event, result) = match answer {
            Ok(Ok(bytes)) => (Happened::Answered, Ok(bytes)),
            Ok(Err(Ended::Failed(Failure::Refused(exception)))) => {
                (Happened::Answered, Err(LinkError::Exception { endpoint, what, exception }))
            }
            Ok(Err(Ended::Failed(Failure::Busy))) => {
                (Happened::Answered, Err(LinkError::Busy { endpoint, what }))
            }
            Ok(Err(Ended::Failed(Failure::Broken(why)))) => {
                (Happened::Doubted, Err(LinkError::Broken { endpoint, what, why }))
            }
            Ok(Err(Ended::Io(error))) => {
                // What is merely garbled says nothing of the connection.
                let closed = error.kind() != std::io::ErrorKind::InvalidData;
                let event = if closed { Happened::Closed } else { Happened::Doubted };
                (event, Err(LinkError::Broken { endpoint, what, why: error.to_string() }))
            }
            Err(_) => {
                let ms = self.profile.deadlines.transfer.as_millis();
                (Happened::Doubted, Err(LinkError::Timeout { endpoint, what, ms }))
            }
        };
        self.caller.perform(event);
        result
    }

    /// The same for what may be repeated: all but the commit.
    async fn ask_patiently(&mut self, ask: &Ask) -> Result<Vec<u8>, LinkError> {
        let pause = Duration::from_millis(self.profile.deadlines.poll_ms);
        let (mut patience, mut repeats, mut failed) = (BUSY_RETRIES, RETRIES, None);
        loop {
            match self.ask(ask).await {
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

    fn nonsense(&self, why: String) -> LinkError {
        LinkError::Nonsense { endpoint: self.caller.endpoint().to_owned(), why }
    }
}

/// Does on a port what an exchange asks for.
async fn perform<P: Port>(
    port: &mut P,
    mut exchange: Box<dyn Exchange<Piece = P::Piece>>,
    clock: impl Fn() -> u64,
) -> Result<Vec<u8>, Ended> {
    port.discard().await.map_err(Ended::Io)?;
    let mut event = Event::Begun;
    loop {
        let now_ms = clock();
        match exchange.on(event, now_ms) {
            Action::Done(bytes) => return Ok(bytes),
            Action::Failed(failure) => {
                port.discard().await.map_err(Ended::Io)?; // what was asked is asked no more
                return Err(Ended::Failed(failure));
            }
            Action::Send { pieces, until_ms } => {
                for piece in pieces {
                    port.send(piece).await.map_err(Ended::Io)?;
                }
                let until = Instant::now() + Duration::from_millis(until_ms.saturating_sub(clock()));
                event = match timeout_at(until, port.receive()).await {
                    Ok(piece) => Event::Received(piece.map_err(Ended::Io)?),
                    Err(_) => Event::Timeout,
                };
            }
        }
    }
}

fn describe(ask: &Ask) -> String {
    match ask {
        Ask::Status => "reading the status".into(),
        Ask::Stage(image) => format!("writing {} bytes to the staging area", image.len()),
        Ask::ReadBack { bytes } => format!("reading {bytes} bytes of the staging area"),
        Ask::Commit(id) => format!("writing the commit of {id}"),
        Ask::Recall => "reading the active table".into(),
    }
}

impl<P: Protocol> Bender for TableLink<P> {
    fn profile(&self) -> &Profile {
        &self.profile
    }

    fn endpoint(&self) -> &str {
        self.caller.endpoint()
    }

    fn reset(&mut self) {
        self.caller.perform(Happened::Reset);
    }

    fn last_frames(&self) -> Vec<String> {
        self.protocol.frames().lines()
    }

    async fn read_status(&mut self) -> Result<Status, LinkError> {
        let mut wrong = String::new();
        for _ in 0..FOREIGN_LOOKS {
            let image = self.ask_patiently(&Ask::Status).await?;
            match decode_status_image(&self.profile, &image) {
                Ok(status) => {
                    self.caller.has_seen();
                    return Ok(status);
                }
                Err(why) => wrong = why,
            }
        }
        self.caller.perform(Happened::Foreign);
        Err(self.nonsense(wrong))
    }

    async fn write_staging(&mut self, staged: &Staged) -> Result<(), LinkError> {
        let image = staging_image(&self.profile, staged);
        self.ask_patiently(&Ask::Stage(image)).await?;
        Ok(())
    }

    async fn read_staging(&mut self, bytes: usize) -> Result<Vec<u8>, LinkError> {
        self.ask_patiently(&Ask::ReadBack { bytes }).await
    }

    async fn commit(&mut self, id: TableId) -> Result<(), LinkError> {
        let ask = Ask::Commit(id);
        self.caller.check_seen(|| describe(&ask))?;
        self.ask(&ask).await?;
        Ok(())
    }

    async fn read_active(&mut self) -> Result<ActiveTable, LinkError> {
        let status = self.read_status().await?;
        if status.active.revision == 0 {
            return Ok(ActiveTable { status, payload: Vec::new() });
        }
        let payload = self.ask_patiently(&Ask::Recall).await?;
        ActiveTable::checked(status, payload).map_err(|why| self.nonsense(why))
    }
}
