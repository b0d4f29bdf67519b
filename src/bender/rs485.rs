//! RS-485: has the kernel switch the transceiver's direction (TIOCSRS485), which no program can do in time.

use std::io;
use std::os::fd::AsRawFd;

/// Flags of `struct serial_rs485`: the kernel drives the direction; RTS is high while sending.
const ENABLED: u32 = 1;
const RTS_ON_SEND: u32 = 1 << 1;

/// `struct serial_rs485` of linux/serial.h.
#[repr(C)]
#[derive(Default)]
struct SerialRs485 {
    flags: u32,
    delay_rts_before_send_ms: u32,
    delay_rts_after_send_ms: u32,
    padding: [u32; 5],
}

/// Switches a serial port to RS-485. An error names what the port's driver lacks.
#[allow(unsafe_code)]
pub fn enable(port: &impl AsRawFd) -> io::Result<()> {
    let settings = SerialRs485 { flags: ENABLED | RTS_ON_SEND, ..SerialRs485::default() };
    // SAFETY: the port is borrowed, so its descriptor is open; the kernel reads as many bytes as the structure has, and writes its
    // answer into it at most.
    let result = unsafe { libc::ioctl(port.as_raw_fd(), libc::TIOCSRS485, &raw const settings) };
    if result == 0 {
        return Ok(());
    }
    let error = io::Error::last_os_error();
    match error.raw_os_error() {
        Some(libc::ENOTTY | libc::EINVAL) => {
            let why = "its driver cannot switch an RS-485 transceiver's direction; set serial.rs485 = false when the adapter \
                       does so by itself";
            Err(io::Error::new(io::ErrorKind::Unsupported, why))
        }
        _ => Err(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_structure_has_the_kernels_size() {
        assert_eq!(size_of::<SerialRs485>(), 32);
    }

    #[test]
    fn what_is_no_such_port_says_so() {
        let file = tempfile::tempfile().unwrap();
        let error = enable(&file).unwrap_err();
        assert!(error.to_string().contains("serial.rs485 = false"), "{error}");
    }
}
