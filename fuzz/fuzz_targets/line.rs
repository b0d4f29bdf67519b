//! A line with and without echo, through the port of the serial table: what is received is what arrived after the request, less its
//! echo, and an echo that is another one's is an error.

#![no_main]

use std::collections::VecDeque;
use std::io;
use std::pin::{Pin, pin};
use std::sync::{Arc, LazyLock, Mutex};
use std::task::{Context, Poll, Waker};

use benderd::bender::{Port as _, Profile, Protocol as _, SerialTable, Transport, Wire};
use benderd_fuzz::Script;
use libfuzzer_sys::fuzz_target;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

static PROFILE: LazyLock<Profile> = LazyLock::new(|| Profile::load("reference-serial").unwrap());

/// What happens on the wire, and what has.
#[derive(Debug, Default)]
struct State {
    /// To arrive, one after the other; an empty piece: nothing now.
    arriving: VecDeque<Vec<u8>>,
    /// Bytes that are taken of one write, at most; 0: it must wait once.
    takes: VecDeque<usize>,
    /// Of the request that is out.
    sent: Vec<u8>,
    /// Arrived since.
    arrived: Vec<u8>,
    last_was_write: bool,
}

#[derive(Debug, Clone, Default)]
struct Ends(Arc<Mutex<State>>);

impl AsyncRead for Ends {
    fn poll_read(
        self: Pin<&mut Self>,
        _: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let mut state = self.0.lock().unwrap();
        state.last_was_write = false;
        match state.arriving.pop_front() {
            Some(mut piece) if !piece.is_empty() => {
                let later = piece.split_off(piece.len().min(buffer.remaining()));
                buffer.put_slice(&piece);
                state.arrived.extend(piece);
                if !later.is_empty() {
                    state.arriving.push_front(later);
                }
                Poll::Ready(Ok(()))
            }
            _ => Poll::Pending,
        }
    }
}

impl AsyncWrite for Ends {
    fn poll_write(self: Pin<&mut Self>, _: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let mut state = self.0.lock().unwrap();
        if !state.last_was_write {
            // A new request: what arrived before is no answer to it.
            state.sent.clear();
            state.arrived.clear();
            state.last_was_write = true;
        }
        match state.takes.pop_front() {
            Some(0) => Poll::Pending,
            taken => {
                let count = bytes.len().min(taken.unwrap_or(usize::MAX));
                state.sent.extend(&bytes[..count]);
                Poll::Ready(Ok(count))
            }
        }
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

/// Polls so often; none: it still waits, and is cancelled.
fn poll<T>(future: impl Future<Output = T>, times: usize) -> Option<T> {
    let mut future = pin!(future);
    let mut cx = Context::from_waker(Waker::noop());
    (0..times).find_map(|_| match future.as_mut().poll(&mut cx) {
        Poll::Ready(value) => Some(value),
        Poll::Pending => None,
    })
}

fuzz_target!(|data: &[u8]| {
    let mut script = Script::new(data);
    let echo = script.any() & 1 == 1;
    let mut profile = PROFILE.clone();
    if let Transport::SerialTable(_, line, _) = &mut profile.transport {
        line.echo = echo;
    }
    let ends = Ends::default();
    let wire = ends.clone();
    let opener = Box::new(move || Ok(Box::new(wire.clone()) as Box<dyn Wire>));
    let mut protocol = SerialTable::new(&profile, 1, Some(opener));
    let mut port = poll(protocol.open("/dev/none"), 1).expect("nothing to wait for").unwrap();
    let mut received: Vec<u8> = Vec::new();
    while let Some(what) = script.byte() {
        let count = usize::from(what >> 2);
        match what & 3 {
            0 => {
                let piece = script.take(count).to_vec();
                ends.0.lock().unwrap().arriving.push_back(piece);
            }
            // The echo as it should be, with what is behind it.
            1 => {
                let mut state = ends.0.lock().unwrap();
                let piece = [&state.sent[..], script.take(count)].concat();
                state.arriving.push_back(piece);
            }
            2 => {
                if count > 32 {
                    let take = usize::from(script.any());
                    ends.0.lock().unwrap().takes.push_back(take);
                }
                received.clear();
                let piece = script.take(1 + count % 32).to_vec();
                let sent = poll(port.send(piece.clone()), 3);
                if !matches!(sent, Some(Ok(()))) {
                    return; // the link opens the line anew, or is silent
                }
            }
            _ => {
                let outcome = poll(port.receive(), 1 + count % 4);
                let state = ends.0.lock().unwrap();
                let behind =
                    if echo { state.arrived.strip_prefix(&state.sent[..]) } else { Some(&state.arrived[..]) };
                match outcome {
                    Some(Ok(piece)) => {
                        received.extend(piece);
                        assert_eq!(Some(&received[..]), behind, "of {:02X?}", state.arrived);
                    }
                    Some(Err(error)) => {
                        assert!(
                            echo && !state.sent.starts_with(&state.arrived) && behind.is_none(),
                            "{error}"
                        );
                        return;
                    }
                    None => {
                        let echoed = state.sent.starts_with(&state.arrived);
                        assert!(behind.map_or(echoed, |behind| behind == received));
                    }
                }
            }
        }
    }
});
