//! Tables to bytes and back, the CRC over them, and the status word by word.
//!
//! Bytes are in the order in which registers go over the wire (high byte first); what is 32 bits wide is
//! arranged by the profile's word order. A payload is
//!
//! ```text
//! program      program_bytes bytes of ASCII, padded with zero
//! bend count   u16
//! spare        u16, 0
//! last length  i32
//! rows         bend count x (length i32, rotation i32, angle i32)
//! ```
//!
//! The CRC-32 (IEEE 802.3) covers the whole payload, the program's name included: a table staged for one
//! program can never be taken for the table of another.

use serde::Serialize;

use super::limits::Reason;
use super::profile::{Profile, WordOrder};
use super::rows::{rows_of, steps_of};
use crate::tube::CommandTable;

/// Which table: its revision and the CRC of its payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize)]
pub struct TableId {
    /// Counts up by one with every table taken over; 0 means no table.
    pub revision: u32,
    /// CRC-32 over the payload.
    pub crc: u32,
}

impl std::fmt::Display for TableId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.revision {
            0 => write!(f, "none"),
            revision => write!(f, "revision {revision}, CRC {:08X}", self.crc),
        }
    }
}

/// What the machine answered to a commit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ack {
    /// Nothing yet.
    None,
    /// Taken over.
    Taken,
    /// Refused, with the code of the wire contract.
    Refused(u16),
}

impl Ack {
    /// From the register.
    pub fn from_code(code: u16) -> Ack {
        match code {
            0 => Ack::None,
            1 => Ack::Taken,
            code => Ack::Refused(code),
        }
    }

    /// What a code of refusal means.
    pub fn meaning(code: u16) -> &'static str {
        match code {
            2 => "revision or CRC of the commit are not those of the staging area",
            3 => "the staged rows do not have the staged CRC",
            4 => "the machine is not between parts",
            5 => "another program is loaded",
            6 => "the loaded program has another number of bends",
            7 => "the revision is not the active one plus 1",
            8 => "a value is outside the machine's own limits",
            _ => "a code that the wire contract does not name",
        }
    }
}

/// One look at the machine, all of one moment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Status {
    /// Counts up while the controller's program runs.
    pub heartbeat: u16,
    /// State word, bits as the profile names them.
    pub state: u16,
    /// Name of the loaded program.
    pub program: String,
    /// Bends of the loaded program.
    pub bend_count: u16,
    /// The table in force.
    pub active: TableId,
    /// The revision that `ack` speaks of.
    pub ack_revision: u32,
    /// The last acknowledgement.
    pub ack: Ack,
    /// A commit that the controller has not dealt with yet (revision 0: none).
    pub pending: TableId,
}

/// A table ready to be staged.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Staged {
    /// Its name.
    pub id: TableId,
    /// Its bytes.
    pub payload: Vec<u8>,
}

/// CRC-32 (IEEE 802.3) of a payload.
pub fn crc_of(payload: &[u8]) -> u32 {
    crc32fast::hash(payload)
}

/// A table as bytes; every reason why it cannot be written down.
pub fn encode_payload(
    profile: &Profile,
    program: &str,
    table: &CommandTable,
) -> Result<Vec<u8>, Vec<Reason>> {
    let mut reasons = Vec::new();
    let mut out = program_bytes(profile, program).unwrap_or_else(|reason| {
        reasons.push(reason);
        Vec::new()
    });
    let direct = profile.transport.direct().is_some();
    let (rows, most, last_length_mm) = if direct {
        out.fill(0); // such a machine knows neither the program nor what is behind the last bend
        (profile.limits.max_bends, f64::from(i16::MAX), 0.0)
    } else {
        (table.bends.len(), f64::from(i32::MAX), table.last_length_mm)
    };
    let count = u16::try_from(rows).unwrap_or(u16::MAX); // more rows than that break a limit anyway
    out.extend(count.to_be_bytes());
    out.extend([0, 0]);
    let mut put = |bend: Option<usize>, column: &str, number: f64| {
        if (-most - 1.0..=most).contains(&number) {
            out.extend(profile.table.word_order.arrange((number as i32).to_be_bytes()));
        } else {
            let text = format!("{column}: {number} steps do not fit the machine's numbers");
            reasons.push(Reason::new("not_encodable", bend, text));
        }
    };
    put(None, "last length", (last_length_mm / profile.table.length_resolution_mm).round());
    for (i, row) in steps_of(&profile.table, table).iter().enumerate() {
        for (column, number) in profile.table.columns.iter().zip(row.numbers) {
            put(Some(i + 1), column, number);
        }
    }
    for _ in table.bends.len()..rows {
        out.extend([0; Profile::ROW_BYTES]);
    }
    if reasons.is_empty() { Ok(out) } else { Err(reasons) }
}

/// Program and table of a payload; why not, in words.
pub fn decode_payload(profile: &Profile, payload: &[u8]) -> Result<(String, CommandTable), String> {
    let header = profile.payload_header_bytes();
    if payload.len() < header {
        return Err(format!("a payload has at least {header} bytes, found {}", payload.len()));
    }
    let name = profile.table.program_bytes;
    let count = usize::from(u16::from_be_bytes([payload[name], payload[name + 1]]));
    let expected = header + count * Profile::ROW_BYTES;
    if payload.len() != expected {
        return Err(format!("{count} bends make {expected} bytes, found {}", payload.len()));
    }
    let value = |at: usize| u32_at(profile.table.word_order, payload, at) as i32;
    let numbers = |i: usize| {
        let at = header + i * Profile::ROW_BYTES;
        [value(at), value(at + 4), value(at + 8)]
    };
    let mut numbers: Vec<[i32; 3]> = (0..count).map(numbers).collect();
    if profile.transport.direct().is_some() {
        // What is behind the last bend is 0.
        let bends = numbers.iter().rposition(|row| *row != [0; 3]).map_or(0, |last| last + 1);
        numbers.truncate(bends);
    }
    let table = CommandTable {
        bends: rows_of(&profile.table, &numbers),
        last_length_mm: f64::from(value(header - 4)) * profile.table.length_resolution_mm,
    };
    Ok((text_of(&payload[..name]), table))
}

/// Bytes of a payload with this many bends.
pub fn payload_bytes(profile: &Profile, bends: usize) -> usize {
    profile.payload_header_bytes() + bends * Profile::ROW_BYTES
}

/// What stands in the staging area for this table: revision, CRC, payload.
pub fn staging_image(profile: &Profile, staged: &Staged) -> Vec<u8> {
    let mut image = commit_image(profile, staged.id);
    image.extend(&staged.payload);
    image
}

/// What is written to the commit word for this table: revision, CRC.
pub fn commit_image(profile: &Profile, id: TableId) -> Vec<u8> {
    let order = profile.table.word_order;
    [order.arrange(id.revision.to_be_bytes()), order.arrange(id.crc.to_be_bytes())].concat()
}

/// Whether this is the machine that it should be: its two constants, and where they were found. An error names the one that is
/// wrong.
pub(super) fn check_constants(
    profile: &Profile,
    (at, identification): (&str, u32),
    (layout_at, layout): (&str, u16),
) -> Result<(), String> {
    let Profile { name, identification: expected, layout: expected_layout, .. } = profile;
    if identification != *expected {
        return Err(format!(
            "{at} holds 0x{identification:08X} where profile {name:?} expects 0x{expected:08X}: not this machine, or another word \
             order or address base"
        ));
    }
    if layout != *expected_layout {
        return Err(format!(
            "{layout_at} says layout {layout}, profile {name:?} is for layout {expected_layout}"
        ));
    }
    Ok(())
}

pub(super) fn u32_at(order: WordOrder, bytes: &[u8], at: usize) -> u32 {
    u32::from_be_bytes(order.arrange([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]))
}

/// Whether the machine can hold a program of this name.
pub fn check_program(profile: &Profile, program: &str) -> Result<(), Reason> {
    program_bytes(profile, program).map(drop)
}

fn program_bytes(profile: &Profile, program: &str) -> Result<Vec<u8>, Reason> {
    let longest = profile.table.program_bytes;
    let printable = |b: u8| b == b' ' || b.is_ascii_graphic();
    if program.trim_matches(' ').is_empty() || program.len() > longest || !program.bytes().all(printable) {
        let text = format!("program name {program:?}, allowed are 1 to {longest} ASCII characters");
        return Err(Reason::new("program_name", None, text));
    }
    let mut out = program.trim_end_matches(' ').as_bytes().to_vec();
    out.resize(longest, 0);
    Ok(out)
}

/// Up to the first zero, without the blanks with which some controllers pad; what is not ASCII becomes '?'.
pub(super) fn text_of(bytes: &[u8]) -> String {
    let used = bytes.split(|b| *b == 0).next().unwrap_or(&[]);
    let character = |b: &u8| if *b == b' ' || b.is_ascii_graphic() { char::from(*b) } else { '?' };
    used.iter().map(character).collect::<String>().trim_end_matches(' ').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tube::CommandRow;
    use proptest::prelude::*;

    fn profile() -> Profile {
        Profile::load("reference-modbus").unwrap()
    }

    fn table() -> CommandTable {
        let row = |l: f64, r: f64, a: f64| CommandRow {
            length_mm: l,
            rotation_rad: r.to_radians(),
            angle_rad: a.to_radians(),
        };
        CommandTable {
            bends: vec![row(120.0, 0.0, 92.1), row(150.004, -60.0, 181.2345)],
            last_length_mm: 99.996,
        }
    }

    #[test]
    fn bytes_of_a_table_written_out_by_hand() {
        let bytes = encode_payload(&profile(), "AB-1", &table()).unwrap();
        assert_eq!(&bytes[..6], b"AB-1\0\0");
        let tail = &bytes[32..];
        let expected: [i32; 7] = [10_000, 12_000, 0, 92_100, 15_000, -60_000, 181_235];
        assert_eq!(&tail[..4], &[0, 2, 0, 0]);
        assert_eq!(&tail[4..], expected.map(i32::to_be_bytes).concat());
        assert_eq!(crc_of(b"123456789"), 0xCBF4_3926, "the check value of CRC-32/ISO-HDLC");
    }

    #[test]
    fn word_orders_of_one_number() {
        let mut p = profile();
        let header = p.payload_header_bytes();
        for (order, bytes) in [
            (WordOrder::Abcd, [0, 1, 0xD4, 0xC0]),
            (WordOrder::Cdab, [0xD4, 0xC0, 0, 1]),
            (WordOrder::Badc, [1, 0, 0xC0, 0xD4]),
            (WordOrder::Dcba, [0xC0, 0xD4, 1, 0]),
        ] {
            p.table.word_order = order;
            let row = CommandRow { length_mm: 1200.0, rotation_rad: 0.0, angle_rad: 0.0 };
            let one = CommandTable { bends: vec![row], last_length_mm: 0.0 };
            let payload = encode_payload(&p, "A", &one).unwrap();
            assert_eq!(payload[header..header + 4], bytes, "{order:?}");
        }
    }

    #[test]
    fn a_reversed_machine_gets_the_other_sign_and_reads_back_the_same() {
        let mut p = profile();
        p.table.rotation_reversed = true;
        let payload = encode_payload(&p, "A", &table()).unwrap();
        let at = p.payload_header_bytes() + 12 + 4;
        assert_eq!(payload[at..at + 4], 60_000_i32.to_be_bytes());
        let (_, back) = decode_payload(&p, &payload).unwrap();
        assert!((back.bends[1].rotation_rad.to_degrees() + 60.0).abs() < 1e-9);
    }

    #[test]
    fn a_direct_table_goes_to_its_last_row_with_any_number_in_it() {
        // Found at a machine where only the first of three columns had been written: it was shown as holding nothing.
        let profile = Profile::load("ten-row").unwrap();
        let none = CommandTable { bends: Vec::new(), last_length_mm: 0.0 };
        let mut payload = encode_payload(&profile, "A", &none).unwrap();
        assert!(decode_payload(&profile, &payload).unwrap().1.bends.is_empty());
        let header = profile.payload_header_bytes();
        for (row, feed) in [(0, 120_i32), (1, 270)] {
            let at = header + row * Profile::ROW_BYTES;
            payload[at..at + 4].copy_from_slice(&feed.to_be_bytes());
        }
        let (_, half) = decode_payload(&profile, &payload).unwrap();
        let rows: Vec<[f64; 2]> = half.bends.iter().map(|row| [row.length_mm, row.angle_rad]).collect();
        assert_eq!(rows, [[120.0, 0.0], [150.0, 0.0]]);
    }

    #[test]
    fn the_least_number_is_one_too() {
        for reversed in [false, true] {
            let mut p = profile();
            p.table.rotation_reversed = reversed;
            let mut payload = encode_payload(&p, "AB-1", &table()).unwrap();
            let at = p.payload_header_bytes() + 4;
            payload[at..at + 4].copy_from_slice(&i32::MIN.to_be_bytes());
            let (program, least) = decode_payload(&p, &payload).unwrap();
            assert_eq!(encode_payload(&p, &program, &least).unwrap(), payload);
        }
    }

    #[test]
    fn what_cannot_be_written_down_is_refused_with_its_row() {
        let refused = |program: &str, table: &CommandTable| {
            let reasons = encode_payload(&profile(), program, table).unwrap_err();
            reasons.into_iter().map(|r| (r.code, r.bend)).collect::<Vec<_>>()
        };
        let mut bad = table();
        bad.bends[1].length_mm = f64::NAN;
        assert_eq!(refused("A", &bad), [("not_encodable", Some(2))]);
        bad.bends[1].length_mm = 21_474_836.48; // i32::MAX + 1 steps of 0.01
        assert_eq!(refused("A", &bad), [("not_encodable", Some(2))]);
        assert_eq!(refused("", &table()), [("program_name", None)]);
        assert_eq!(refused(&"x".repeat(33), &table()), [("program_name", None)]);
        assert_eq!(refused("Bügel", &table()), [("program_name", None)]);
        assert!(encode_payload(&profile(), &"x".repeat(32), &table()).is_ok());
    }

    proptest! {
        #[test]
        fn a_table_comes_back_within_a_step(
            rows in prop::collection::vec((0.0..6000.0, -360.0..360.0, 0.0..359.0), 0..40),
            last in 0.0..6000.0,
            reversed: bool,
            order in prop::sample::select(vec![WordOrder::Abcd, WordOrder::Cdab, WordOrder::Badc, WordOrder::Dcba]),
        ) {
            let mut p = profile();
            p.table.rotation_reversed = reversed;
            p.table.word_order = order;
            let bends = rows.iter().map(|(l, r, a): &(f64, f64, f64)| CommandRow {
                length_mm: *l, rotation_rad: r.to_radians(), angle_rad: a.to_radians(),
            }).collect();
            let table = CommandTable { bends, last_length_mm: last };
            let payload = encode_payload(&p, "P1", &table).unwrap();
            let (program, back) = decode_payload(&p, &payload).unwrap();
            prop_assert_eq!(program, "P1");
            prop_assert_eq!(back.bends.len(), table.bends.len());
            // What one row's rounding leaves over goes into the next one's.
            for (a, b) in table.bends.iter().zip(&back.bends) {
                prop_assert!((a.length_mm - b.length_mm).abs() <= 0.01 + 1e-9);
                prop_assert!((a.rotation_rad - b.rotation_rad).to_degrees().abs() <= 0.001 + 1e-9);
                prop_assert!((a.angle_rad - b.angle_rad).to_degrees().abs() <= 0.0005 + 1e-9);
            }
            // A table that came from the wire goes back to the same bytes.
            prop_assert_eq!(encode_payload(&p, "P1", &back).unwrap(), payload);
        }

        #[test]
        fn any_bytes_decode_or_say_why(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
            let p = profile();
            if let Ok((_, table)) = decode_payload(&p, &bytes) {
                prop_assert_eq!(bytes.len(), payload_bytes(&p, table.bends.len()));
            }
            let _ = crate::bender::registers::decode_status(&p, p.transport.modbus().unwrap(), &bytes);
        }
    }
}
