//! What a self-test makes of what was read: good or not, with figures, and what to change. Pure.

use super::limits::check_limits;
use super::link::{ActiveTable, LinkError};
use super::plan;
use super::profile::Profile;
use super::selftest::{Step, Times, Verdict};
use super::transport::Transport;
use super::wire::{Staged, Status, TableId, crc_of, decode_payload, encode_payload, payload_bytes};
use crate::tube::CommandTable;

/// An answer that takes more than this share of its deadline will miss it one day.
const NEAR: f64 = 0.5;

/// What the profile says, in one line.
pub fn profile(profile: &Profile) -> Step {
    let bends = profile.limits.max_bends;
    let asks = match profile.transport.modbus() {
        Some(map) => {
            let requests: usize = plan::delivery(profile, map, bends).iter().map(|s| s.requests.len()).sum();
            format!(
                "unit {}, status in one read of {} registers, a table of {bends} bends in {requests} requests",
                map.unit_id,
                plan::status(profile, map).registers
            )
        }
        None => format!("tables of up to {bends} bends"),
    };
    Step::ok("profile", format!("{} is valid: {asks}", profile.name))
}

/// How fast it answers.
pub fn first_answer(first_ms: f64, times: &Times) -> Step {
    let Times { median, worst, .. } = *times;
    let found = format!("after {first_ms:.1} ms; 20 more: median {median:.1} ms, worst {worst:.1} ms");
    Step::ok("first answer", found)
        .with("first_ms", first_ms)
        .with("median_ms", median)
        .with("worst_ms", worst)
}

/// The constants are right.
pub fn identified(profile: &Profile) -> Step {
    let found = format!("identification 0x{:08X} and layout {}", profile.identification, profile.layout);
    Step::ok("identification", found)
}

/// Something else answers; `guess` is a change that explains it.
pub fn foreign(profile: &Profile, error: &LinkError, guess: Option<String>) -> Step {
    let mut step = Step::new("identification", Verdict::Failed, error.to_string());
    let other = match (error, profile.transport.modbus()) {
        (LinkError::Exception { .. }, Some(map)) => format!(
            "no other word order, address base or usual unit is understood: compare [registers] with the controller's list, \
             and whether it gives {} registers in one read",
            plan::status(profile, map).registers
        ),
        (LinkError::Exception { .. }, None) if profile.transport.direct().is_some() => format!(
            "compare [direct] with the controller's list: {}; does this machine have a staging area, so that it needs another profile",
            direct_places(profile)
        ),
        (_, None) if profile.transport.direct().is_some() => format!(
            "is this the machine, with the die of the profile? If it is, compare constants.identification = {} and [direct] with the \
             controller's list: {}",
            profile.identification,
            direct_places(profile)
        ),
        (_, Some(map)) => format!(
            "no other word order, address base or usual unit is understood: is this the machine? If it is, compare \
             registers.identification = {} and registers.layout = {}, and the [constants], with the controller's program",
            map.registers.identification, map.registers.layout
        ),
        _ => "is this the machine? If it is, compare [constants] identification and layout with the controller's program".into(),
    };
    step.advice.push(guess.unwrap_or(other));
    step
}

/// What a machine without a staging area keeps where.
fn direct_places(profile: &Profile) -> String {
    let Some(map) = profile.transport.direct() else { return String::new() };
    let names = ["length", "rotation", "angle"];
    let rows = profile.limits.max_bends as u16;
    let columns =
        names.iter().zip(map.columns).map(|(name, at)| format!("{name} = {at} to {}", at + (rows - 1)));
    format!(
        "identification = {}, {}, state_coils = {} to {}",
        map.identification,
        columns.collect::<Vec<_>>().join(", "),
        map.state_coils,
        map.state_coils + (map.coils - 1)
    )
}

/// The connection opens, and nothing is answered; `guess` is a change that explains it.
pub fn no_answer(profile: &Profile, endpoint: &str, error: &LinkError, guess: Option<String>) -> Step {
    let mut step = Step::new("first answer", Verdict::Failed, error.to_string());
    if let Some(guess) = guess {
        step.advice.push(guess);
        return step;
    }
    match &profile.transport {
        Transport::ModbusTcp(device) | Transport::ModbusRtuOverTcp(device, _) => step.advice.push(format!(
            "something listens there and keeps silent: is the controller's program running (RUN), is unit_id = {} its \
             number, and does it speak {}",
            device.unit_id(),
            if profile.transport.line().is_some() { "RTU frames over TCP" } else { "Modbus TCP" }
        )),
        transport if transport.serial().is_some() => step.advice.extend(line_advice(transport)),
        Transport::Folder(number) => step.advice.push(format!(
            "does the controller look at {endpoint} (its name for the share may be another), is unit_id = {number} its number, does \
             its program run; do the clocks of controller, share and this computer agree (a file that looks old is not used)"
        )),
        Transport::Can(_) => step.advice.push(format!(
            "no status came on {endpoint}: is the controller on, is its bit rate the interface's (`ip -details link show \
             {endpoint}`), does `candump {endpoint}` show the cyclic messages with the identifiers of the database"
        )),
        Transport::Canopen(canopen) => step.advice.push(format!(
            "no SDO answer came on {endpoint}: is the controller on, is node = {} its number, is its bit rate the interface's (`ip \
             -details link show {endpoint}`)",
            canopen.node
        )),
        _ => step.advice.push("is the controller on, and does its program run".into()),
    }
    let request_ms = profile.deadlines.request.as_millis();
    step.advice.push(format!("a slow controller needs a longer deadlines.request_ms than {request_ms}"));
    step
}

fn line_advice(transport: &Transport) -> Vec<String> {
    let Some(serial) = transport.serial() else { return Vec::new() };
    let mut advice = vec![
        format!(
            "compare baud = {}, parity = {:?} and stop_bits = {} of [serial] with the controller's",
            serial.baud, serial.parity, serial.stop_bits
        ),
        "RS-485: exchange the wires A and B, look at ground and termination; RS-232: is it a null-modem cable (2 and 3 \
         crossed)"
            .into(),
    ];
    if transport.line().is_some_and(|line| line.echo) {
        advice.push(
            "line.echo = true: right only when the adapter hears what it sends itself; try false".into(),
        );
    } else {
        advice.push(
            "does --frames show each request coming back? Then the line has an echo: set line.echo = true"
                .into(),
        );
    }
    if !serial.rs485 {
        advice.push("a transceiver that the kernel must switch needs serial.rs485 = true".into());
    }
    advice
}

/// Whether the controller's program runs, and how fast.
pub fn heartbeat(profile: &Profile, beats: u32, waited_ms: f64, longest_ms: f64) -> Step {
    let limit_ms = profile.deadlines.heartbeat_ms;
    let place = place_of(profile, "heartbeat");
    if beats == 0 {
        let found = format!("stands still for {waited_ms:.0} ms (deadlines.heartbeat_ms = {limit_ms})");
        let advice = format!(
            "start the controller's program (RUN) and see that it counts {place} up; if it does so more slowly, raise \
             deadlines.heartbeat_ms"
        );
        return Step::failed("heartbeat", found, advice).with("longest_ms", waited_ms);
    }
    let found = format!(
        "{beats} beats in {waited_ms:.0} ms, {:.0} a second; stood still for {longest_ms:.0} ms at most, allowed are \
         {limit_ms} ms",
        f64::from(beats) * 1000.0 / waited_ms
    );
    let step = if longest_ms > NEAR * limit_ms as f64 {
        let least = (3.0 * longest_ms).ceil();
        Step::failed(
            "heartbeat",
            found,
            format!("too near to the limit: set deadlines.heartbeat_ms = {least} or more"),
        )
    } else {
        Step::ok("heartbeat", found)
    };
    step.with("beats_per_s", f64::from(beats) * 1000.0 / waited_ms).with("longest_ms", longest_ms)
}

/// What holds a value, for people.
fn place_of(profile: &Profile, name: &str) -> String {
    let register = profile
        .transport
        .modbus()
        .and_then(|map| super::registers::fields(profile, map).into_iter().find(|field| field.name == name));
    register.map_or(format!("the {name}"), |field| format!("register {}", field.address))
}

/// Each condition on the state word.
pub fn state_bits(profile: &Profile, state: u16) -> Vec<Step> {
    let mut steps = Vec::new();
    for bit in &profile.state_bits {
        let on = |set| if set { "on" } else { "off" };
        let set = state >> bit.bit & 1 == 1;
        let found = format!("{:?} (bit {}) is {}, must be {}", bit.name, bit.bit, on(set), on(bit.must_be));
        steps.push(if set == bit.must_be {
            Step::ok("state bit", found)
        } else {
            let advice = format!(
                "bring the machine to where {:?} is {}; if it is there already, bit {} of {} (0x{state:04X}) is another one: \
                 correct this [[state_bit]]",
                bit.name,
                on(bit.must_be),
                bit.bit,
                place_of(profile, "state")
            );
            Step::failed("state bit", found, advice)
        });
    }
    steps
}

/// What is loaded.
pub fn program(profile: &Profile, status: &Status) -> Step {
    let Status { program, bend_count, .. } = status;
    let found = format!("{program:?} with {bend_count} bends is loaded");
    let most = profile.limits.max_bends;
    let place = place_of(profile, "program");
    let advice = if program.is_empty() {
        format!("load a program at the machine; if one is loaded, its name is not in {place}")
    } else if !program.bytes().all(|byte| byte.is_ascii_graphic() || byte == b' ') {
        format!("this is no name: it is not in {place}, or the two characters of each register are swapped")
    } else if !(1..=most).contains(&usize::from(*bend_count)) {
        format!(
            "the profile's limits.max_bends is {most}: load a program of 1 to {most} bends; if one is loaded, its count is \
             not in {}",
            place_of(profile, "bend count")
        )
    } else {
        return Step::ok("program", found).with("bends", f64::from(*bend_count));
    };
    Step::failed("program", found, advice)
}

/// The table in force: whole, and one that the profile's limits allow.
pub fn active(profile: &Profile, read: Result<ActiveTable, LinkError>) -> Step {
    const STEP: &str = "active table";
    let ActiveTable { status, payload } = match read {
        Ok(active) => active,
        Err(error @ LinkError::Nonsense { .. }) => {
            let advice = "if the machine stood still meanwhile: compare where its active table begins, the order of its \
                          values and over which bytes its CRC-32 goes with the contract (`benderd check --plan`)";
            return Step::failed(STEP, error.to_string(), advice);
        }
        Err(error) => {
            let advice =
                format!("compare {} with the controller's list", place_of(profile, "active revision"));
            return Step::failed_by(STEP, &error, advice);
        }
    };
    if status.active.revision == 0 {
        return Step::ok(STEP, "none: the machine has not taken one over yet");
    }
    let (program, table) = match decode_payload(profile, &payload) {
        Ok(decoded) => decoded,
        Err(why) => return Step::failed(STEP, why, "compare [table] with the controller's program"),
    };
    let found =
        format!("{}: {} bends for program {program:?}, CRC is right", status.active, table.bends.len());
    if profile.transport.direct().is_some() && table.bends.is_empty() {
        return Step::ok(STEP, "its rows are all 0");
    }
    let reasons = check_limits(profile, &table);
    if reasons.is_empty() {
        return Step::ok(STEP, format!("{found}, within the profile's limits"));
    }
    let advice =
        "the machine bends what the profile forbids: compare [limits], and the resolutions in [table]";
    let texts: Vec<String> = reasons.iter().map(ToString::to_string).collect();
    Step::failed(STEP, format!("{found}, but {}", texts.join("; ")), advice)
}

/// A read of `most` registers was not answered, one of `good` was (0: none).
pub fn largest(most: usize, good: usize, error: &LinkError) -> Step {
    let found = format!("{most} registers in one read: {error}; {good} are answered");
    let advice = if good >= 4 {
        format!(
            "set modbus.max_read_registers = {good} (and look up how many the controller takes in a write)"
        )
    } else {
        "no read of the staging area is answered: compare registers.staging with the controller's list".into()
    };
    Step::failed("largest request", found, advice).with("registers", good as f64)
}

/// What stands in the staging area.
pub fn staging(profile: &Profile, bytes: usize, read: Result<Vec<u8>, LinkError>, ms: f64) -> Step {
    match read {
        Ok(found) => {
            let holds = if found.iter().all(|b| *b == 0) { "empty" } else { "holds a table that was staged" };
            Step::ok("staging area", format!("{} bytes read in {ms:.1} ms, {holds}", found.len()))
                .with("read_ms", ms)
        }
        Err(error) => {
            let from = profile.transport.staging_place(0);
            let advice = format!(
                "the whole area of {bytes} bytes, from {from} on, must be readable: is it as long there"
            );
            Step::failed_by("staging area", &error, advice)
        }
    }
}

/// A table whose bytes all differ from their neighbours, as long as the longest, for the program that is loaded. Revision 0: it can
/// never be committed.
pub fn pattern(profile: &Profile, program: &str) -> Staged {
    let none = CommandTable { bends: Vec::new(), last_length_mm: 0.0 };
    let bends = profile.limits.max_bends;
    let name = profile.table.program_bytes;
    let mut payload = encode_payload(profile, program, &none).unwrap_or_default();
    payload.resize(payload_bytes(profile, bends), 0);
    payload[name..name + 2].copy_from_slice(&(bends as u16).to_be_bytes());
    for (i, byte) in payload.iter_mut().enumerate().skip(name + 4) {
        *byte = (37 * i + 11) as u8;
    }
    Staged { id: TableId { revision: 0, crc: crc_of(&payload) }, payload }
}

/// How writing the staging area went.
pub fn written(
    profile: &Profile,
    image: &[u8],
    written: Result<(), LinkError>,
    read: Result<Vec<u8>, LinkError>,
    cleared: bool,
) -> Step {
    const STEP: &str = "write staging";
    let read = match written.and(read) {
        Ok(read) => read,
        Err(error) => {
            let most = profile.transport.modbus().map(|map| map.max_write_registers);
            let advice = match most {
                Some(most) => format!(
                    "may the area be written at all, and {most} registers at once? Else lower modbus.max_write_registers; \
                     look at the staging area before the next delivery"
                ),
                None => "may the area be written at all? Look at it before the next delivery".into(),
            };
            return Step::failed_by(STEP, &error, advice);
        }
    };
    if let Some(at) = image
        .iter()
        .zip(&read)
        .position(|(a, b)| a != b)
        .or((read.len() != image.len()).then_some(read.len()))
    {
        let found = format!(
            "{} holds {}, written was 0x{:02X}",
            profile.transport.staging_place(at),
            read.get(at).map_or("nothing".into(), |byte| format!("0x{byte:02X}")),
            image.get(at).copied().unwrap_or_default()
        );
        let advice = "something else writes there, or the area is not as long, or not plain memory: look at the controller's \
                      program";
        return Step::failed(STEP, found, advice);
    }
    if !cleared {
        let advice = "the pattern was read back right and could not be cleared: it cannot be committed (revision 0); switch the \
                      controller off and on to clear it";
        return Step::failed(STEP, "the area does not read as zeros after it was cleared", advice);
    }
    let found =
        format!("{} bytes written as revision 0, read back bit for bit, cleared to zeros", image.len());
    Step::ok(STEP, found)
}

/// Whether the deadlines fit, and how long a delivery takes.
pub fn times(profile: &Profile, times: &Times) -> Step {
    let request_ms = profile.deadlines.request.as_millis() as f64;
    let write = times.write.unwrap_or(times.read);
    // Status, stage, read back, status, commit, and what is in force: twice, since the machine takes a moment.
    let delivery_ms =
        3.0 * times.median + write + times.read + 2.0 * times.active.max(times.median + times.read);
    let found = format!(
        "the slowest answer took {:.1} ms of deadlines.request_ms = {request_ms}; a delivery of {} bends will take about {:.2} s",
        times.worst,
        profile.limits.max_bends,
        delivery_ms / 1000.0
    );
    let step = if times.worst > request_ms {
        let advice = "it came only when asked again: look at cable, plugs, shield and termination (--frames shows what \
                      arrived); if the controller is as slow as that, raise deadlines.request_ms";
        Step::failed("times", found, advice)
    } else if times.worst > NEAR * request_ms {
        let least = (3.0 * times.worst).ceil();
        Step::failed(
            "times",
            found,
            format!("too near to the limit: set deadlines.request_ms = {least} or more"),
        )
    } else {
        Step::ok("times", found)
    };
    step.with("worst_ms", times.worst).with("request_ms", request_ms).with("delivery_ms", delivery_ms)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reference() -> Profile {
        Profile::load("reference-modbus").unwrap()
    }

    fn advice(step: &Step) -> String {
        assert_eq!(step.result, Verdict::Failed, "{step:?}");
        step.advice.join("; ")
    }

    #[test]
    fn a_heart_that_stands_still_or_nearly_does_says_which_key_to_change() {
        let p = reference();
        assert!(advice(&heartbeat(&p, 0, 1001.0, 0.0)).contains("counts register 3 up"));
        assert!(advice(&heartbeat(&p, 2, 1001.0, 600.0)).contains("deadlines.heartbeat_ms = 1800"));
        assert_eq!(heartbeat(&p, 100, 1000.0, 30.0).result, Verdict::Ok);
    }

    #[test]
    fn each_state_bit_is_named() {
        let steps = state_bits(&reference(), 0b1001);
        let results: Vec<bool> = steps.iter().map(|s| s.result == Verdict::Ok).collect();
        assert_eq!(results, [true, false, true, false]);
        assert!(steps[1].found.contains("\"between parts\" (bit 1) is off, must be on"), "{:?}", steps[1]);
        assert!(advice(&steps[3]).contains("bit 3 of register 4 (0x0009)"), "{:?}", steps[3]);
    }

    #[test]
    fn the_pattern_has_its_program_and_no_revision() {
        let p = reference();
        let staged = pattern(&p, "AB-1");
        assert_eq!(staged.id.revision, 0);
        assert_eq!(decode_payload(&p, &staged.payload).unwrap().0, "AB-1");
        let image = super::super::wire::staging_image(&p, &staged);
        assert_eq!(written(&p, &image, Ok(()), Ok(image.clone()), true).result, Verdict::Ok);
        let mut other = image.clone();
        other[100] ^= 1;
        let step = written(&p, &image, Ok(()), Ok(other), true);
        assert!(step.found.starts_with("register 1050 holds 0x"), "{step:?}");
        assert!(
            advice(&written(&p, &image, Ok(()), Ok(image.clone()), false)).contains("cannot be committed")
        );
    }

    #[test]
    fn slow_answers_say_which_deadline_to_change() {
        let times_of = |worst| Times { median: 5.0, worst, read: 40.0, write: None, active: 30.0 };
        assert!(advice(&times(&reference(), &times_of(700.0))).contains("deadlines.request_ms = 2100"));
        assert!(advice(&times(&reference(), &times_of(1200.0))).contains("only when asked again"));
        let good = times(&reference(), &times_of(20.0));
        assert!(good.found.contains("40 bends will take about 0.1"), "{good:?}");
    }
}
