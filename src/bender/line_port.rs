//! A line as a port: bytes as they come.

use std::io;

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

use super::exchange::Port;
use super::line::{Line, Wire};

/// A line under a protocol of frames.
pub struct LinePort {
    line: Line,
}

impl LinePort {
    /// Over something that is open; `echo`: whether it gives back what is sent.
    pub fn new(wire: Box<dyn Wire>, echo: bool) -> LinePort {
        LinePort { line: Line::new(wire, echo) }
    }
}

impl Port for LinePort {
    type Piece = Vec<u8>;

    /// The line does it before each first byte that is written.
    async fn discard(&mut self) -> io::Result<()> {
        Ok(())
    }

    async fn send(&mut self, piece: Vec<u8>) -> io::Result<()> {
        self.line.write_all(&piece).await?;
        self.line.flush().await
    }

    async fn receive(&mut self) -> io::Result<Vec<u8>> {
        let mut bytes = [0; 256];
        match self.line.read(&mut bytes).await? {
            0 => Err(io::Error::new(io::ErrorKind::UnexpectedEof, "the line was closed")),
            count => Ok(bytes[..count].to_vec()),
        }
    }
}
