//! The messages of the table protocol on CAN, as a database has them: all that are needed are there and wide enough.
//!
//! Made when a profile is loaded; the exchanges pack and unpack by it.

use crate::bender::can::FrameId;
use crate::bender::dbc::{Database, DbcError, Message, Presence};
use crate::bender::profile::TableFormat;

/// What a table's item is called, what steps it is counted in, and whether it can be negative.
const ITEMS: [(&str, Steps); 8] = [
    ("Revision", Steps::Ones(32)),
    ("Crc", Steps::Ones(32)),
    ("BendCount", Steps::Ones(16)),
    ("LastLength", Steps::Lengths),
    ("Length", Steps::Lengths),
    ("Rotation", Steps::Angles),
    ("Angle", Steps::Angles),
    ("Program", Steps::Ones(32)),
];

/// Before an item: which, what is to be done with it, which row, what came of it.
const HEAD: [(&str, Steps); 4] = [
    ("Item", Steps::Ones(8)),
    ("Operation", Steps::Ones(8)),
    ("Row", Steps::Ones(8)),
    ("Result", Steps::Ones(8)),
];

/// Most characters of a program that the status has room for.
pub const PROGRAM_BYTES: usize = 32;

/// Most rows that can be numbered.
pub const ROWS: usize = 255;

#[derive(Debug, Clone, Copy)]
enum Steps {
    /// A whole number, unsigned, of at least so many bits.
    Ones(usize),
    /// Signed, 32 bits, in the profile's steps of length.
    Lengths,
    /// Signed, 32 bits, in the profile's steps of angle.
    Angles,
}

/// The messages.
#[derive(Debug, Clone, PartialEq)]
pub struct Contract {
    /// State of the machine.
    pub state: Message,
    /// The rest of the status, one item at a time.
    pub status: Message,
    /// An item of a table, asked for, and its echo.
    pub item: (Message, Message),
    /// The commit and its echo.
    pub commit: (Message, Message),
    /// With CAN FD a whole row and its echo.
    pub row: Option<(Message, Message)>,
}

impl Contract {
    /// The messages in a database, for tables of this format.
    pub fn of(database: &Database, table: &TableFormat, fd: bool) -> Result<Contract, DbcError> {
        let message = |name: &str, signals: &[(&str, Steps)]| {
            let message = database.message(name)?;
            signals.iter().try_for_each(|(signal, steps)| check(&message, signal, *steps, table))?;
            Ok(message)
        };
        let state = [
            ("Cycle", Steps::Ones(8)),
            ("Layout", Steps::Ones(8)),
            ("Heartbeat", Steps::Ones(16)),
            ("State", Steps::Ones(16)),
            ("BendCount", Steps::Ones(16)),
        ];
        let programs: Vec<String> = (0..table.program_bytes / 4).map(program_signal).collect();
        let programs = programs.iter().map(|name| (name.as_str(), Steps::Ones(32)));
        let status: Vec<(&str, Steps)> = [("Cycle", Steps::Ones(8))]
            .into_iter()
            .chain(STATUS_LONGS.map(|(n, _)| (n, Steps::Ones(32))))
            .chain(programs)
            .collect();
        let item = [HEAD.as_slice(), ITEMS.as_slice()].concat();
        let row: Vec<_> =
            HEAD.into_iter().chain(ITEMS.into_iter().filter(|(n, _)| ROW.contains(n))).collect();
        let commit = [("Revision", Steps::Ones(32)), ("Crc", Steps::Ones(32))];
        Ok(Contract {
            state: message("STATUS_STATE", &state)?,
            status: message("STATUS_ITEM", &status)?,
            item: (message("TABLE_ITEM", &item)?, message("TABLE_ECHO", &item)?),
            commit: (message("COMMIT", &commit)?, message("COMMIT_ECHO", &commit)?),
            row: if fd {
                Some((message("TABLE_ROW", &row)?, message("TABLE_ROW_ECHO", &row)?))
            } else {
                None
            },
        })
    }

    /// The identifiers of all its frames.
    pub fn ids(&self) -> Vec<FrameId> {
        let pairs = [Some(&self.item), Some(&self.commit), self.row.as_ref()];
        let pairs = pairs.into_iter().flatten().flat_map(|(asked, echo)| [asked, echo]);
        [&self.state, &self.status].into_iter().chain(pairs).map(|message| message.id).collect()
    }
}

/// What a row has, in its order.
pub const ROW: [&str; 3] = ["Length", "Rotation", "Angle"];

/// The status's 32-bit values and where they stand in its image.
pub const STATUS_LONGS: [(&str, usize); 7] = [
    ("Identification", 0),
    ("ActiveRevision", 12),
    ("ActiveCrc", 16),
    ("AckRevision", 20),
    ("AckCode", 24),
    ("CommitRevision", 28),
    ("CommitCrc", 32),
];

/// The signal with these four characters of the program in the status.
pub fn program_signal(four: usize) -> String {
    format!("Program{four}")
}

/// Whether a signal is there and can carry what it is for.
fn check(message: &Message, name: &str, steps: Steps, table: &TableFormat) -> Result<(), DbcError> {
    let signal = message.signal(name)?;
    let (bits, signed, factor) = match steps {
        Steps::Ones(bits) => (bits, false, 1.0),
        Steps::Lengths => (32, true, table.length_resolution_mm),
        Steps::Angles => (32, true, table.angle_resolution_deg),
    };
    let same = (signal.factor - factor).abs() < 1e-9 && signal.offset == 0.0;
    let switched = signal.presence == Presence::Always || message.switch().is_some();
    if signal.bits >= bits && signal.signed == signed && same && switched {
        return Ok(());
    }
    let sign = |signed| if signed { "signed" } else { "unsigned" };
    Err(DbcError::Unfit {
        what: format!("signal {name} of message {}", message.name),
        found: format!(
            "has {} bits, {}, factor {}, offset {}{}",
            signal.bits,
            sign(signal.signed),
            signal.factor,
            signal.offset,
            if switched { "" } else { ", and is multiplexed by nothing" }
        ),
        allowed: format!(
            "{bits} bits or more, {}, factor {factor} (the profile's resolution), offset 0",
            sign(signed)
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bender::Profile;

    const SHIPPED: &str = include_str!("../../../protocols/bender.dbc");

    fn complaint(from: &str, to: &str, fd: bool) -> Option<String> {
        assert!(SHIPPED.contains(from), "{from}");
        let table = Profile::load("reference-modbus").unwrap().table;
        let database = Database::parse(&SHIPPED.replace(from, to)).unwrap();
        Contract::of(&database, &table, fd).err().map(|e| e.to_string())
    }

    #[test]
    fn what_the_protocol_needs_is_checked_and_what_it_does_not_is_not() {
        assert_eq!(complaint("VERSION", "VERSION", true), None);
        let text = complaint(" CommitCrc m6", " CommitCRC m6", false).unwrap();
        assert!(
            text.starts_with(
                "signal CommitCrc of message STATUS_ITEM is missing; the database has Item, Cycle"
            ),
            "{text}"
        );
        assert!(
            complaint("TABLE_ECHO:", "TABLE_ANSWER:", false)
                .unwrap()
                .starts_with("message TABLE_ECHO is missing")
        );
        assert_eq!(complaint("TABLE_ROW_ECHO:", "NO_ROW:", false), None, "only CAN FD needs it");
        assert!(complaint("TABLE_ROW_ECHO:", "NO_ROW:", true).unwrap().contains("TABLE_ROW_ECHO"));
        let text = complaint("Length m4 : 32|32@1- (0.01,0)", "Length m4 : 32|32@1- (0.1,0)", false).unwrap();
        assert!(text.contains("Length of message TABLE_ITEM has 32 bits, signed, factor 0.1"), "{text}");
        assert!(text.contains("factor 0.01 (the profile's resolution)"), "{text}");
        assert!(complaint("Angle m6 : 32|32@1-", "Angle m6 : 32|32@1+", false).unwrap().contains("unsigned"));
        assert!(complaint("Program7 m15", "Program7 m15", false).is_none());
        assert!(complaint("Program7", "Program9", false).unwrap().contains("Program7"));
        assert!(complaint("SG_ Item M :", "SG_ Item :", false).unwrap().contains("multiplexed by nothing"));
    }
}
