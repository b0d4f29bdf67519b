//! The texts of the shared folder (protocols/shared-folder.md): commands, answers and tables, as TOML. Pure; both ends read and write
//! them with it, so its tests hold against the contract's own examples.

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

use super::profile::{Profile, WordOrder};
use super::wire::{crc_of, text_of, u32_at};

/// Version of the texts.
const VERSION: u32 = 1;

/// What the machine is to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Verb {
    /// Say how it stands.
    Status,
    /// Keep the table that comes along, without using it.
    Stage,
    /// Give the staged table back.
    Readback,
    /// Put the staged table in force.
    Commit,
    /// Give the table in force.
    Recall,
}

/// A command.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Command {
    /// 1.
    #[serde(deserialize_with = "version")]
    pub version: u32,
    /// The answer repeats it.
    pub sequence: u32,
    /// What for.
    pub command: Verb,
    /// Of a commit.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub revision: Option<u32>,
    /// Of a commit: the table's.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub crc: Option<u32>,
    /// CRC-32 of the table file that belongs to it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub table_crc: Option<u32>,
}

impl Command {
    /// Without revision, CRC and table.
    pub fn new(sequence: u32, command: Verb) -> Command {
        Command { version: VERSION, sequence, command, revision: None, crc: None, table_crc: None }
    }
}

/// How a command ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Said {
    /// It is done.
    Done,
    /// No time now.
    Busy,
    /// It could not be read.
    Garbled,
    /// It cannot be done.
    Refused,
}

/// An answer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Answer {
    /// 1.
    #[serde(deserialize_with = "version")]
    pub version: u32,
    /// The command's; 0 where that could not be read.
    pub sequence: u32,
    /// How it ended.
    pub result: Said,
    /// CRC-32 of the table file that belongs to it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub table_crc: Option<u32>,
    /// Of `status`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub status: Option<StatusText>,
}

impl Answer {
    /// Without table and status.
    pub fn new(sequence: u32, result: Said) -> Answer {
        Answer { version: VERSION, sequence, result, table_crc: None, status: None }
    }
}

/// The status; see `status_image`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "the names of the status image")]
pub struct StatusText {
    pub identification: u32,
    pub layout: u16,
    pub heartbeat: u16,
    pub state: u16,
    pub program: String,
    pub bends: u16,
    pub active_revision: u32,
    pub active_crc: u32,
    pub acknowledged_revision: u32,
    pub acknowledgement: u16,
    pub commit_revision: u32,
    pub commit_crc: u32,
}

impl StatusText {
    /// As the row of bytes that every machine's status becomes.
    pub fn image(&self, program_bytes: usize) -> Option<Vec<u8>> {
        let mut image = Vec::new();
        image.extend(self.identification.to_be_bytes());
        image.extend(
            [self.layout, self.heartbeat, self.state, self.bends].iter().flat_map(|v| v.to_be_bytes()),
        );
        let longs = [self.active_revision, self.active_crc, self.acknowledged_revision];
        image.extend(longs.iter().flat_map(|v| v.to_be_bytes()));
        image.extend([self.acknowledgement, 0].iter().flat_map(|v| v.to_be_bytes()));
        image.extend([self.commit_revision, self.commit_crc].iter().flat_map(|v| v.to_be_bytes()));
        image.extend(padded(&self.program, program_bytes)?);
        Some(image)
    }

    /// From it; none where it is too short.
    pub fn of_image(image: &[u8]) -> Option<StatusText> {
        let word = |at: usize| Some(u16::from_be_bytes([*image.get(at)?, *image.get(at + 1)?]));
        let long = |at: usize| Some(u32_at(WordOrder::Abcd, image.get(at..at + 4)?, 0));
        Some(StatusText {
            identification: long(0)?,
            layout: word(4)?,
            heartbeat: word(6)?,
            state: word(8)?,
            bends: word(10)?,
            active_revision: long(12)?,
            active_crc: long(16)?,
            acknowledged_revision: long(20)?,
            acknowledgement: word(24)?,
            commit_revision: long(28)?,
            commit_crc: long(32)?,
            program: text_of(image.get(36..)?),
        })
    }
}

/// A table, in the machine's whole steps: the same numbers as in the payload.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TableText {
    /// 1.
    #[serde(deserialize_with = "version")]
    pub version: u32,
    /// 0: none.
    pub revision: u32,
    /// CRC-32 of the payload that these numbers make.
    pub crc: u32,
    /// What it is for.
    pub program: String,
    /// Straight after the last bend.
    pub last_length: i32,
    /// Length, rotation, angle of each bend.
    pub rows: Vec<[i32; 3]>,
}

impl TableText {
    /// Of a staging image: revision, CRC, payload; none where the payload is not as long as its rows.
    pub fn of_image(profile: &Profile, image: &[u8]) -> Option<TableText> {
        let long = |at: usize| Some(u32_at(WordOrder::Abcd, image.get(at..at + 4)?, 0));
        let name = 8 + profile.table.program_bytes;
        let bends = usize::from(u16::from_be_bytes([*image.get(name)?, *image.get(name + 1)?]));
        let value = |at: usize| Some(long(at)? as i32);
        let row = |i: usize| {
            let at = name + 8 + i * Profile::ROW_BYTES;
            Some([value(at)?, value(at + 4)?, value(at + 8)?])
        };
        Some(TableText {
            version: VERSION,
            revision: long(0)?,
            crc: long(4)?,
            program: text_of(image.get(8..name)?),
            last_length: value(name + 4)?,
            rows: (0..bends).map(row).collect::<Option<_>>()?,
        })
    }

    /// The staging image; none where the program's name is too long.
    pub fn image(&self, profile: &Profile) -> Option<Vec<u8>> {
        let mut image = Vec::new();
        image.extend([self.revision, self.crc].iter().flat_map(|v| v.to_be_bytes()));
        image.extend(padded(&self.program, profile.table.program_bytes)?);
        image.extend(u16::try_from(self.rows.len()).ok()?.to_be_bytes());
        image.extend([0, 0]);
        image.extend(self.last_length.to_be_bytes());
        image.extend(self.rows.iter().flatten().flat_map(|v| v.to_be_bytes()));
        Some(image)
    }
}

/// A text as a file's bytes, and their CRC.
pub fn written(text: &impl Serialize) -> (Vec<u8>, u32) {
    // These types have no value that TOML cannot hold.
    let bytes = toml::to_string(text).unwrap_or_default().into_bytes();
    let crc = crc_of(&bytes);
    (bytes, crc)
}

/// A text of a file's bytes; why not, in words.
pub fn read<'a, T: Deserialize<'a>>(bytes: &'a [u8]) -> Result<T, String> {
    let text = std::str::from_utf8(bytes).map_err(|error| error.to_string())?;
    toml::from_str(text).map_err(|error| error.to_string())
}

/// The table file that a text names by its CRC.
pub fn table(crc: Option<u32>, bytes: Option<&[u8]>) -> Result<TableText, String> {
    let (Some(crc), Some(bytes)) = (crc, bytes) else { return Err("without a table".into()) };
    let found = crc_of(bytes);
    if found != crc {
        return Err(format!("the table file has CRC {found}, named is {crc}"));
    }
    read(bytes)
}

/// A text of another version may mean anything by its names.
fn version<'a, D: Deserializer<'a>>(deserializer: D) -> Result<u32, D::Error> {
    match u32::deserialize(deserializer)? {
        VERSION => Ok(VERSION),
        found => Err(D::Error::custom(format!("version {found}, known is {VERSION}"))),
    }
}

fn padded(text: &str, bytes: usize) -> Option<Vec<u8>> {
    let mut out = text.as_bytes().to_vec();
    (out.len() <= bytes).then(|| {
        out.resize(bytes, 0);
        out
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn profile() -> Profile {
        Profile::load("reference-folder").unwrap()
    }

    /// The contract's own examples.
    #[test]
    fn the_examples_of_the_contract_are_read() {
        let contract = include_str!("../../protocols/shared-folder.md");
        let mut examples = contract.split("```toml\n").skip(1).map(|e| e.split("```").next().unwrap());
        let command: Command = read(examples.next().unwrap().as_bytes()).unwrap();
        assert_eq!((command.sequence, command.command, command.crc), (1705, Verb::Commit, Some(3192556544)));
        let answer: Answer = read(examples.next().unwrap().as_bytes()).unwrap();
        assert_eq!((answer.result, answer.status.unwrap().state), (Said::Done, 3));
        let table: TableText = read(examples.next().unwrap().as_bytes()).unwrap();
        assert_eq!(table.rows[1], [15_000, -60_000, 181_235]);
        let image = table.image(&profile()).unwrap();
        assert_eq!(crc_of(&image[8..]), table.crc);
        assert!(examples.next().is_none());
    }

    #[test]
    fn what_is_no_command_is_refused() {
        for wrong in ["", "version = 1", "version = 1\nsequence = 1\ncommand = \"dance\"", "\u{0}"] {
            assert!(read::<Command>(wrong.as_bytes()).is_err(), "{wrong:?}");
        }
        assert!(read::<Command>(b"version = 1\nsequence = 1\ncommand = \"status\"\nmore = 1").is_err());
        assert!(read::<Command>(b"\xFF").is_err());
        let why = read::<Command>(b"version = 2\nsequence = 1\ncommand = \"status\"").unwrap_err();
        assert!(why.contains("version 2, known is 1"), "{why}");
        let none = "version = 0\nrevision = 0\ncrc = 0\nprogram = \"\"\nlast_length = 0\nrows = []";
        assert!(read::<TableText>(none.as_bytes()).is_err());
        assert!(read::<TableText>(none.replacen('0', "1", 1).as_bytes()).is_ok());
    }

    proptest! {
        #[test]
        fn a_table_comes_back_as_it_was(
            program in "[A-Za-z0-9 \"\\\\-]{1,32}", last: i32,
            rows in prop::collection::vec(any::<[i32; 3]>(), 0..40), revision: u32,
        ) {
            let program = format!("x{}", program.trim_end()).chars().take(32).collect::<String>().trim_end().to_owned();
            let text = TableText { version: 1, revision, crc: 7, program, last_length: last, rows };
            let image = text.image(&profile()).unwrap();
            prop_assert_eq!(TableText::of_image(&profile(), &image).unwrap(), text.clone());
            let (bytes, crc) = written(&text);
            prop_assert_eq!(table(Some(crc), Some(&bytes)).unwrap(), text);
        }

        #[test]
        fn any_image_is_a_table_or_none(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
            let _ = TableText::of_image(&profile(), &bytes);
            let _ = StatusText::of_image(&bytes);
        }
    }
}
