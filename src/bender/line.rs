//! A line under a request-and-reply protocol: what arrived before a request is no answer to it, and what the line echoes is none
//! either.
//!
//! Between a serial port (or a socket that stands for one) and a protocol's client. A late reply would else be taken for the
//! answer to the next request: tokio-modbus compares unit and function only.

use std::collections::VecDeque;
use std::fmt::Debug;
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, ready};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

/// Bytes thrown away before a request, at most: what sends more never falls silent.
const MOST_STALE: usize = 64 * 1024;

/// What a line is made of: a serial port, or a socket that stands for one.
pub trait Wire: AsyncRead + AsyncWrite + Debug + Send + Unpin {}

impl<T: AsyncRead + AsyncWrite + Debug + Send + Unpin> Wire for T {}

/// An open line on which every request begins with an empty input. Its clones are the same line.
#[derive(Clone)]
pub struct Line {
    shared: Arc<Mutex<Shared>>,
    /// This clone has begun to write a request: what arrives from now on may be its answer.
    asking: bool,
}

struct Shared {
    wire: Box<dyn Wire>,
    /// Whether the line gives back what is sent; and of that, what has not come back yet.
    echo: bool,
    awaited: VecDeque<u8>,
}

impl Line {
    /// A line over something that is open.
    pub fn new(wire: Box<dyn Wire>, echo: bool) -> Line {
        let shared = Shared { wire, echo, awaited: VecDeque::new() };
        Line { shared: Arc::new(Mutex::new(shared)), asking: false }
    }

    /// Never waits: nobody else holds it while a future is polled.
    fn shared(&self) -> MutexGuard<'_, Shared> {
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Shared {
    /// Throws away what has arrived.
    fn discard(&mut self, cx: &mut Context<'_>) -> io::Result<()> {
        self.awaited.clear();
        let (mut scratch, mut stale) = ([0; 1024], 0);
        loop {
            let mut buffer = ReadBuf::new(&mut scratch);
            match Pin::new(&mut self.wire).poll_read(cx, &mut buffer) {
                Poll::Pending => return Ok(()),
                // Closed: what is written next will say so.
                Poll::Ready(Ok(())) if buffer.filled().is_empty() => return Ok(()),
                Poll::Ready(Ok(())) => stale += buffer.filled().len(),
                Poll::Ready(Err(error)) => return Err(error),
            }
            if stale > MOST_STALE {
                let why = format!("the line does not fall silent: {stale} bytes that nobody asked for");
                return Err(io::Error::new(io::ErrorKind::InvalidData, why));
            }
        }
    }

    /// Takes the echo of what was sent out of the input.
    fn swallow(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        while !self.awaited.is_empty() {
            let mut scratch = [0; 256];
            let most = scratch.len().min(self.awaited.len());
            let mut buffer = ReadBuf::new(&mut scratch[..most]);
            ready!(Pin::new(&mut self.wire).poll_read(cx, &mut buffer))?;
            if buffer.filled().is_empty() {
                break; // closed: the next read says so
            }
            for found in buffer.filled() {
                let sent = self.awaited.pop_front().unwrap_or_default();
                if sent != *found {
                    let why = format!(
                        "the line's echo has {found:02X} where {sent:02X} was sent: something else sends at the same time, or \
                         the line has no echo"
                    );
                    return Poll::Ready(Err(io::Error::new(io::ErrorKind::InvalidData, why)));
                }
            }
        }
        Poll::Ready(Ok(()))
    }
}

impl AsyncRead for Line {
    fn poll_read(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let line = self.get_mut();
        line.asking = false;
        let mut shared = line.shared();
        ready!(shared.swallow(cx))?;
        Pin::new(&mut shared.wire).poll_read(cx, buffer)
    }
}

impl AsyncWrite for Line {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let line = self.get_mut();
        let mut shared = line.shared.lock().unwrap_or_else(PoisonError::into_inner);
        if !line.asking {
            shared.discard(cx)?;
            line.asking = true;
        }
        let written = ready!(Pin::new(&mut shared.wire).poll_write(cx, bytes))?;
        if shared.echo {
            shared.awaited.extend(&bytes[..written]);
        }
        Poll::Ready(Ok(written))
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.shared().wire).poll_flush(cx)
    }

    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.shared().wire).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, duplex};

    /// Sends a request and reads as many bytes of its answer.
    async fn ask(line: &mut Line, request: &[u8], answer: usize) -> Vec<u8> {
        line.write_all(request).await.unwrap();
        line.flush().await.unwrap();
        let mut out = vec![0; answer];
        line.read_exact(&mut out).await.unwrap();
        out
    }

    #[tokio::test]
    async fn what_came_before_a_request_is_not_its_answer() {
        let (here, mut there) = duplex(4096);
        let mut line = Line::new(Box::new(here), false);
        there.write_all(b"late").await.unwrap();
        let machine = tokio::spawn(async move {
            let mut request = [0; 3];
            for answer in [b"one", b"two"] {
                there.read_exact(&mut request).await.unwrap();
                there.write_all(answer).await.unwrap();
                there.write_all(b" and more").await.unwrap();
            }
            there
        });
        assert_eq!(ask(&mut line, b"ask", 3).await, b"one");
        assert_eq!(ask(&mut line, b"ask", 3).await, b"two");
        machine.await.unwrap();
    }

    #[tokio::test]
    async fn an_echo_is_taken_out_and_one_that_differs_is_an_error() {
        let (here, mut there) = duplex(4096);
        let mut line = Line::new(Box::new(here), true);
        let machine = tokio::spawn(async move {
            let mut request = [0; 3];
            there.read_exact(&mut request).await.unwrap();
            there.write_all(b"askyes").await.unwrap();
            there.read_exact(&mut request).await.unwrap();
            there.write_all(b"axk").await.unwrap();
            there
        });
        assert_eq!(ask(&mut line, b"ask", 3).await, b"yes");
        line.write_all(b"ask").await.unwrap();
        let error = line.read_u8().await.unwrap_err().to_string();
        assert!(error.contains("echo has 78 where 73 was sent"), "{error}");
        machine.await.unwrap();
    }

    #[tokio::test]
    async fn a_line_that_never_falls_silent_is_an_error() {
        #[derive(Debug)]
        struct Babble;
        impl AsyncRead for Babble {
            fn poll_read(
                self: Pin<&mut Self>,
                _: &mut Context<'_>,
                buffer: &mut ReadBuf<'_>,
            ) -> Poll<io::Result<()>> {
                buffer.put_slice(&vec![0x55; buffer.remaining()]);
                Poll::Ready(Ok(()))
            }
        }
        impl AsyncWrite for Babble {
            fn poll_write(
                self: Pin<&mut Self>,
                _: &mut Context<'_>,
                bytes: &[u8],
            ) -> Poll<io::Result<usize>> {
                Poll::Ready(Ok(bytes.len()))
            }
            fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
                Poll::Ready(Ok(()))
            }
            fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
                Poll::Ready(Ok(()))
            }
        }
        let error = Line::new(Box::new(Babble), false).write_all(b"ask").await.unwrap_err().to_string();
        assert!(error.contains("does not fall silent"), "{error}");
    }
}
