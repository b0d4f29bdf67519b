//! What a profile makes benderd ask of a machine, request by request: the link makes these requests, `benderd check --plan` prints
//! them for the PLC programmer.

use super::direct::DirectMap;
use super::profile::Profile;
use super::registers::{ModbusMap, status_span};
use super::wire::payload_bytes;

/// One request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Request {
    /// Whether it writes.
    pub writes: bool,
    /// First register, counted from 0.
    pub address: u16,
    /// How many.
    pub registers: u16,
}

impl Request {
    /// The last register.
    pub fn last(&self) -> u16 {
        self.address + (self.registers - 1)
    }
}

/// One step of a delivery.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Step {
    /// What is done.
    pub what: &'static str,
    /// In this order.
    pub requests: Vec<Request>,
}

/// The requests of one delivery of a table with so many bends, in order.
pub fn delivery(profile: &Profile, map: &ModbusMap, bends: usize) -> Vec<Step> {
    let r = &map.registers;
    let (payload, header) = (payload_bytes(profile, bends), profile.payload_header_bytes());
    let step = |what, requests| Step { what, requests };
    let status = || vec![status(profile, map)];
    let active = [reads(map, r.active, header), reads(map, rows(profile, map), payload - header)].concat();
    vec![
        step("who is there, and may it be changed", status()),
        step("stage", writes(map, r.staging, 8 + payload)),
        step("read back", reads(map, r.staging, 8 + payload)),
        step("still so, and the program runs", status()),
        step("commit, once", vec![Request { writes: true, address: r.commit, registers: 4 }]),
        step("what is in force now", [status(), active].concat()),
    ]
}

/// The three columns of a machine whose rows are written directly.
pub fn columns(profile: &Profile, map: &DirectMap, writes: bool) -> [Request; 3] {
    // The profile's check keeps them below 65536.
    map.columns.map(|address| Request { writes, address, registers: profile.limits.max_bends as u16 })
}

/// Its constant.
pub fn constant(map: &DirectMap) -> Request {
    Request { writes: false, address: map.identification, registers: 1 }
}

/// The one request that shows the status.
pub fn status(profile: &Profile, map: &ModbusMap) -> Request {
    let (address, registers) = status_span(profile, map);
    Request { writes: false, address, registers }
}

/// Where the rows of the active table begin; the profile's check keeps the area below 65536.
pub fn rows(profile: &Profile, map: &ModbusMap) -> u16 {
    map.registers.active + (profile.payload_header_bytes() / 2) as u16
}

/// Requests that read so many bytes.
pub fn reads(map: &ModbusMap, address: u16, bytes: usize) -> Vec<Request> {
    chunks(false, address, bytes / 2, map.max_read_registers)
}

/// Requests that write so many bytes.
pub fn writes(map: &ModbusMap, address: u16, bytes: usize) -> Vec<Request> {
    chunks(true, address, bytes / 2, map.max_write_registers)
}

/// `limit` is even and so is the distance of every 32-bit value from the start, so none is split.
fn chunks(writes: bool, address: u16, registers: usize, limit: u16) -> Vec<Request> {
    let step = usize::from(limit);
    let one = |done: usize| Request {
        writes,
        address: address + done as u16,
        registers: step.min(registers - done) as u16,
    };
    (0..registers).step_by(step).map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunks_cover_everything_and_start_even() {
        let list = |registers, limit| {
            chunks(false, 1000, registers, limit).iter().map(|r| (r.address, r.registers)).collect::<Vec<_>>()
        };
        assert_eq!(list(100, 100), [(1000, 100)]);
        assert_eq!(list(101, 100), [(1000, 100), (1100, 1)]);
        assert_eq!(list(264, 100), [(1000, 100), (1100, 100), (1200, 64)]);
        assert_eq!(list(0, 100), []);
    }

    #[test]
    fn the_commit_is_one_request_after_all_others_that_write() {
        let profile = Profile::load("reference-modbus").unwrap();
        let map = profile.transport.modbus().unwrap();
        for bends in 1..=profile.limits.max_bends {
            let requests: Vec<Request> =
                delivery(&profile, map, bends).into_iter().flat_map(|s| s.requests).collect();
            let commit = requests.iter().position(|r| r.address == map.registers.commit).unwrap();
            assert!(requests[commit].writes && requests[commit].registers == 4);
            assert!(requests[commit + 1..].iter().all(|r| !r.writes));
        }
    }
}
