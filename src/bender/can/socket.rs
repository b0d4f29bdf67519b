//! A CAN interface of this computer: the kernel's raw socket, with error frames switched on, and its errors in words.

use std::io;
use std::task::{Context, Poll, ready};

use socketcan::{
    CanAnyFrame, CanDataFrame, CanFdFrame, CanFdSocket, EmbeddedFrame as _, ExtendedId, Id, Socket as _,
    SocketOptions as _, StandardId,
};
use tokio::io::unix::AsyncFd;

use super::bus::{Bus, has_no_room};
use super::frame::{Condition, Frame, FrameId, Heard};
use super::watched::watched;

/// Size of the kernel's structure for a CAN FD frame; an interface that carries them says so by it.
const FD_MTU: u32 = 72;

/// An open interface. It carries classic frames, and FD frames where the interface does.
pub struct Socket {
    fd: AsyncFd<CanFdSocket>,
    interface: String,
}

impl Socket {
    /// Opens an interface, for CAN FD if `fd`. Must be called inside a tokio runtime.
    pub fn open(interface: &str, fd: bool) -> io::Result<Socket> {
        let explained = |error| explain(error, interface);
        let socket = CanFdSocket::open(interface).map_err(explained)?;
        if fd {
            check_fd(interface)?;
        }
        socket.set_error_filter_accept_all().map_err(explained)?;
        socket.set_nonblocking(true).map_err(explained)?;
        Ok(Socket { fd: watched(socket)?, interface: interface.to_owned() })
    }
}

impl Bus for Socket {
    fn poll_send(&mut self, cx: &mut Context<'_>, frame: &Frame) -> Poll<io::Result<()>> {
        let out = outgoing(frame)?;
        loop {
            let mut guard = ready!(self.fd.poll_write_ready(cx))?;
            // Would block: the readiness was stale, and is waited for anew.
            if let Ok(sent) = guard.try_io(|socket| socket.get_ref().write_frame(&out)) {
                return Poll::Ready(sent.map_err(|error| explain(error, &self.interface)));
            }
        }
    }

    fn poll_receive(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<Heard>> {
        loop {
            let mut guard = ready!(self.fd.poll_read_ready(cx))?;
            match guard.try_io(|socket| socket.get_ref().read_frame()) {
                Ok(Ok(frame)) => {
                    if let Some(heard) = incoming(&frame) {
                        return Poll::Ready(Ok(heard));
                    }
                }
                Ok(Err(error)) => return Poll::Ready(Err(explain(error, &self.interface))),
                Err(_would_block) => {}
            }
        }
    }
}

/// As the library has it.
fn outgoing(frame: &Frame) -> io::Result<CanAnyFrame> {
    let id = match frame.id {
        FrameId::Standard(id) => StandardId::new(id).map(Id::from),
        FrameId::Extended(id) => ExtendedId::new(id).map(Id::from),
    };
    let made = id.filter(|_| Frame::is_possible_length(frame.data.len())).and_then(|id| {
        if frame.needs_fd() {
            CanFdFrame::new(id, &frame.data).map(CanAnyFrame::from)
        } else {
            CanDataFrame::new(id, &frame.data).map(CanAnyFrame::from)
        }
    });
    made.ok_or_else(|| {
        let why =
            format!("{frame} is no CAN frame: identifiers have 11 or 29 bits, data 0 to 8 or up to 64 bytes");
        io::Error::new(io::ErrorKind::InvalidInput, why)
    })
}

/// What a frame of the library tells; a remote frame tells nothing.
fn incoming(frame: &CanAnyFrame) -> Option<Heard> {
    let data_frame = |id: Id, data: &[u8]| {
        let id = match id {
            Id::Standard(id) => FrameId::Standard(id.as_raw()),
            Id::Extended(id) => FrameId::Extended(id.as_raw()),
        };
        Some(Heard::Frame(Frame::new(id, data)))
    };
    match frame {
        CanAnyFrame::Normal(frame) => data_frame(frame.id(), frame.data()),
        CanAnyFrame::Fd(frame) => data_frame(frame.id(), frame.data()),
        CanAnyFrame::Remote(_) => None,
        CanAnyFrame::Error(frame) => {
            Some(Heard::Condition(Condition::of_error_frame(frame.error_bits(), frame.data())))
        }
    }
}

/// Whether the interface carries CAN FD.
fn check_fd(interface: &str) -> io::Result<()> {
    let path = format!("/sys/class/net/{interface}/mtu");
    let mtu = std::fs::read_to_string(&path)?;
    if mtu.trim().parse::<u32>().is_ok_and(|mtu| mtu >= FD_MTU) {
        return Ok(());
    }
    let why = format!(
        "{interface} carries no CAN FD (its MTU is {}, CAN FD needs {FD_MTU}), and the profile has fd = true: `ip link set \
         {interface} type can ... dbitrate 2000000 fd on` (a virtual one: `ip link set {interface} mtu {FD_MTU}`), or fd = false",
        mtu.trim()
    );
    Err(io::Error::new(io::ErrorKind::Unsupported, why))
}

/// What the system's error means and what to do.
fn explain(error: io::Error, interface: &str) -> io::Error {
    if has_no_room(&error) {
        return error;
    }
    let advice = match error.raw_os_error() {
        Some(libc::ENODEV) if std::path::Path::new("/sys/class/net").join(interface).exists() => {
            format!("{interface} is there and is no CAN interface: `ip -details link show type can` lists those that are")
        }
        Some(libc::ENODEV) => format!(
            "there is no interface {interface} (any more): plug the adapter in and load its driver; `ip -br link` lists what there \
             is; a virtual one: `ip link add dev {interface} type vcan`"
        ),
        Some(libc::EAFNOSUPPORT | libc::EPROTONOSUPPORT | libc::ESOCKTNOSUPPORT) => "no CAN sockets here: the kernel lacks \
            them (`modprobe can_raw`), or the service's unit forbids them (RestrictAddressFamilies= must name AF_CAN)"
            .to_owned(),
        Some(libc::ENETDOWN) => format!(
            "the interface {interface} is down: `ip link set {interface} up type can bitrate 500000`, with the machine's bit rate \
             (a virtual one: `ip link set {interface} up`)"
        ),
        Some(libc::EINVAL) => {
            format!("{interface} does not carry this frame: a classic interface carries 8 bytes, CAN FD up to 64")
        }
        _ => return error,
    };
    io::Error::new(error.kind(), format!("{advice} ({error})"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_error_says_what_to_do() {
        let text = |errno| explain(io::Error::from_raw_os_error(errno), "can0").to_string();
        assert!(text(19).starts_with("there is no interface can0"), "{}", text(19));
        let other = explain(io::Error::from_raw_os_error(19), "lo").to_string();
        assert!(other.starts_with("lo is there and is no CAN interface"), "{other}");
        assert!(text(97).contains("modprobe can_raw") && text(97).contains("AF_CAN"), "{}", text(97));
        assert!(text(100).contains("ip link set can0 up type can bitrate"), "{}", text(100));
        assert!(text(22).contains("CAN FD"), "{}", text(22));
        let full = explain(io::Error::from_raw_os_error(105), "can0");
        assert_eq!(full.raw_os_error(), Some(105), "still known as no room");
        assert_eq!(text(13), io::Error::from_raw_os_error(13).to_string());
    }

    #[tokio::test]
    async fn an_interface_that_is_not_there_is_explained() {
        let Err(error) = Socket::open("nocan7", false) else { panic!("it is there") };
        let text = error.to_string();
        assert!(
            text.contains("ip link add dev nocan7 type vcan") || text.contains("modprobe can_raw"),
            "{text}"
        );
    }

    #[test]
    fn frames_pass_the_library_unchanged() {
        let long: Vec<u8> = (0..64).collect();
        for frame in [
            Frame::new(FrameId::Standard(0x7FF), []),
            Frame::new(FrameId::Standard(0x310), [1, 2, 3, 4, 5, 6, 7, 8]),
            Frame::new(FrameId::Extended(0x1FFF_FFFF), [9]),
            Frame::new(FrameId::Standard(0x324), &long[..16]),
            Frame::new(FrameId::Extended(1), long.clone()),
        ] {
            assert_eq!(incoming(&outgoing(&frame).unwrap()), Some(Heard::Frame(frame)));
        }
        for impossible in [
            Frame::new(FrameId::Standard(0x800), []),
            Frame::new(FrameId::Extended(0x2000_0000), []),
            Frame::new(FrameId::Standard(1), &long[..9]),
        ] {
            assert!(outgoing(&impossible).unwrap_err().to_string().contains("is no CAN frame"));
        }
    }

    #[test]
    fn an_error_frame_is_a_condition_and_a_remote_frame_nothing() {
        use socketcan::{CanErrorFrame, CanRemoteFrame, StandardId};
        let off = CanErrorFrame::new_error(0x40, &[0; 8]).unwrap();
        assert_eq!(incoming(&off.into()), Some(Heard::Condition(Condition::BusOff)));
        let remote = CanRemoteFrame::new_remote(StandardId::new(5).unwrap(), 0).unwrap();
        assert_eq!(incoming(&remote.into()), None);
    }
}
