//! A TCP stream to a machine on which nothing arrives after it was given up.
//!
//! Closed as usual, the system goes on sending what has not got through, for minutes: a commit that benderd gave up would arrive when the
//! network is back, long after its outcome was told. So the stream is closed hard as long as a request is unanswered, by
//! whomever, also by the system when the program is killed; and softly where nothing is, since a machine with room for one
//! client might not hear of a hard one. Used by `open`.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use socket2::SockRef;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;

/// The stream.
#[derive(Debug)]
pub struct Socket {
    stream: TcpStream,
    unanswered: bool,
}

impl Socket {
    /// Connects.
    pub async fn connect(endpoint: &str) -> io::Result<Socket> {
        let stream = TcpStream::connect(endpoint).await?;
        // Small requests wait for each other otherwise; a socket that cannot do this still works.
        let _ = stream.set_nodelay(true);
        Ok(Socket { stream, unanswered: false })
    }

    /// Nothing is sent where that cannot be had.
    fn set_unanswered(&mut self, unanswered: bool) -> io::Result<()> {
        if self.unanswered != unanswered {
            SockRef::from(&self.stream).set_linger(unanswered.then_some(Duration::ZERO))?;
            self.unanswered = unanswered;
        }
        Ok(())
    }
}

impl AsyncRead for Socket {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        out: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = out.filled().len();
        ready!(Pin::new(&mut self.stream).poll_read(cx, out))?;
        // Whoever answers has what was sent. At the end of the stream nothing is known.
        if out.filled().len() > before {
            self.set_unanswered(false)?;
        }
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Socket {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, data: &[u8]) -> Poll<io::Result<usize>> {
        self.set_unanswered(true)?;
        Pin::new(&mut self.stream).poll_write(cx, data)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    use tokio::net::TcpListener;

    #[tokio::test]
    async fn a_stream_with_a_request_unanswered_is_closed_hard_and_one_without_softly() {
        let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
        let endpoint = listener.local_addr().unwrap().to_string();
        for answers in [true, false] {
            let mut ours = Socket::connect(&endpoint).await.unwrap();
            let mut theirs = listener.accept().await.unwrap().0;
            let linger = |socket: &Socket| SockRef::from(&socket.stream).linger().unwrap();
            assert_eq!(linger(&ours), None);
            ours.write_all(b"?").await.unwrap();
            assert_eq!(linger(&ours), Some(Duration::ZERO));
            assert_eq!(theirs.read_u8().await.unwrap(), b'?');
            if answers {
                theirs.write_all(b"!").await.unwrap();
                ours.read_u8().await.unwrap();
                assert_eq!(linger(&ours), None);
            }
            drop(ours);
            let end = theirs.read(&mut [0]).await.map_err(|e| e.kind());
            assert_eq!(end, if answers { Ok(0) } else { Err(io::ErrorKind::ConnectionReset) });
        }
    }
}
