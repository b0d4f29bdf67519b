//! Feeds the ring of a link's last frames: with the clock, and on wires of bytes by listening in.
//!
//! Under every link; ports that carry no bytes tell it themselves.

use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, ready};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::Instant;

use super::caller::millis;
use super::line::Wire;
use super::ring::{Content, Direction, Ring};

/// The last frames of one link. Its clones are the same.
#[derive(Debug, Clone)]
pub struct Frames {
    since: Instant,
    ring: Arc<Mutex<Ring>>,
}

impl Default for Frames {
    /// None yet; their times count from now.
    fn default() -> Frames {
        Frames { since: Instant::now(), ring: Arc::default() }
    }
}

impl Frames {
    /// A frame went by.
    pub fn add(&self, direction: Direction, content: Content) {
        let at_ms = millis(self.since.elapsed());
        self.ring.lock().unwrap_or_else(PoisonError::into_inner).push(at_ms, direction, content);
    }

    /// One line each, the oldest first.
    pub fn lines(&self) -> Vec<String> {
        self.ring.lock().unwrap_or_else(PoisonError::into_inner).lines()
    }
}

/// A wire whose bytes are kept for a while.
#[derive(Debug)]
pub struct Recorded {
    wire: Box<dyn Wire>,
    frames: Frames,
}

impl Recorded {
    /// Listens to this wire.
    pub fn new(wire: Box<dyn Wire>, frames: Frames) -> Recorded {
        Recorded { wire, frames }
    }
}

impl AsyncRead for Recorded {
    fn poll_read(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        let before = buffer.filled().len();
        ready!(Pin::new(&mut this.wire).poll_read(cx, buffer))?;
        let read = &buffer.filled()[before..];
        if !read.is_empty() {
            this.frames.add(Direction::Received, Content::Bytes(read.to_vec()));
        }
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Recorded {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        let written = ready!(Pin::new(&mut this.wire).poll_write(cx, bytes))?;
        this.frames.add(Direction::Sent, Content::Bytes(bytes[..written].to_vec()));
        Poll::Ready(Ok(written))
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().wire).poll_flush(cx)
    }

    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().wire).poll_shutdown(cx)
    }
}
