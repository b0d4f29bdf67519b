//! A CAN socket that the runtime watches: the one unsafe call of CAN. Under `socket`.

use std::io;

use socketcan::CanFdSocket;
use tokio::io::unix::AsyncFd;

/// Hands a socket that does not block to the runtime. Must be called inside a tokio runtime.
#[allow(unsafe_code)]
pub fn watched(socket: CanFdSocket) -> io::Result<AsyncFd<CanFdSocket>> {
    // SAFETY: the socket gives the same descriptor as long as it lives, and closes it when it is dropped, which is after the
    // `AsyncFd` that owns it was taken from the reactor.
    Ok(unsafe { AsyncFd::register(socket) }?)
}
