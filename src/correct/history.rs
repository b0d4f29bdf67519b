//! The contract of `benderd correct`: the history of a job as it comes in.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use thiserror::Error;

use crate::inspect;
use crate::tube::{CommandTable, MeasuredTube, Nominal};

/// A history that cannot be used.
#[derive(Debug, Error, PartialEq)]
#[error("part {part} of the history: {detail}")]
pub struct HistoryError {
    /// Counted from 1.
    pub part: usize,
    /// What was found and what is allowed.
    pub detail: String,
}

/// A job so far: what was commanded and what was measured, part by part.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct History {
    /// Which set-up bends; with die, tube and material from the part it is the key that knowledge is kept by.
    #[serde(default)]
    pub key: SetUp,
    /// The material's batch, where known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub batch: Option<String>,
    /// Oldest first; empty asks for the first piece's table.
    pub parts: Vec<Part>,
}

/// What the part file does not know of a set-up.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SetUp {
    /// Name of the bender.
    pub bender: String,
    /// Lubrication set-up.
    pub lubrication: String,
}

/// What was changed before a tube.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Changed {
    /// The batch of material.
    Batch,
    /// Die, mandrel, wiper, lubrication.
    Tooling,
    /// What is known of spring-back was imported.
    Knowledge,
    /// The table, by somebody else than the corrections.
    Table,
    /// An earlier table was gone back to.
    RollBack,
}

/// One bent and scanned tube.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Part {
    /// The table it was bent with.
    pub commanded: CommandTable,
    /// What `reconstruct --json` printed.
    pub measured: MeasuredTube,
    /// Revision of the table.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub revision: Option<u64>,
    /// Identity of the scan.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scan_id: Option<String>,
    /// The table that had been answered for it, where `commanded` is what the machine held.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub answered: Option<CommandTable>,
    /// Name of the program that ran.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub program: Option<String>,
    /// What was changed before it: the first tube in tolerance from here on waits for approval.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub changed: Option<Changed>,
    /// Somebody has looked at this tube and at its table, and lets the job go on.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub approved: bool,
    /// Length that the tube was cut to.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cut_length_mm: Option<f64>,
    /// Whether this is another scan of the tube of the entry before, not another tube.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub rescan: bool,
}

impl Part {
    /// A tube and the table that it was bent with; nothing else is known.
    pub fn new(commanded: CommandTable, measured: MeasuredTube) -> Part {
        Part {
            commanded,
            measured,
            revision: None,
            scan_id: None,
            answered: None,
            program: None,
            changed: None,
            approved: false,
            cut_length_mm: None,
            rescan: false,
        }
    }

    /// What two entries of the same scan have in common: its id, or the digest of its file.
    pub fn scan_identities(&self) -> impl Iterator<Item = &str> {
        let digest = Some(self.measured.scan_sha256.as_str()).filter(|s| s.len() == 64);
        self.scan_id.as_deref().filter(|s| !s.is_empty()).into_iter().chain(digest)
    }
}

impl History {
    /// Refuses values that no tube and no table can have, naming the part.
    pub fn validate(&self) -> Result<(), HistoryError> {
        for (i, part) in self.parts.iter().enumerate() {
            let place = |detail: String| HistoryError { part: i + 1, detail };
            part.commanded.validate().map_err(|e| place(format!("commanded, {e}")))?;
            inspect::check(&part.measured).map_err(|e| place(e.to_string()))?;
            if part.cut_length_mm.is_some_and(|cut| !(0.0..=1e5).contains(&cut)) {
                return Err(place("cut_length_mm is outside 0 to 100000".to_owned()));
            }
            if part.rescan && (i == 0 || self.parts[i - 1].commanded != part.commanded) {
                return Err(place(
                    "rescan is true, but there is no entry before it that was bent with the same table"
                        .to_owned(),
                ));
            }
        }
        Ok(())
    }

    /// Identity of this job: part, batch and first piece, so that a longer history of the same job has the
    /// same. None before the first piece.
    pub fn job_id(&self, nominal: &Nominal) -> Option<String> {
        let first = self.parts.first()?;
        let scan: String = match first.scan_identities().next() {
            Some(id) => id.to_owned(),
            None => {
                let angle = |b: &crate::tube::MeasuredBend| format!("{:.9} ", b.angle_rad);
                first.measured.bends.iter().map(angle).collect()
            }
        };
        let row = |r: &crate::tube::CommandRow| format!("{:.9} {:.9} ", r.length_mm, r.angle_rad);
        let table: String = first.commanded.bends.iter().map(row).collect();
        let batch = self.batch.as_deref().unwrap_or("");
        let digest = Sha256::digest(format!("{}\n{batch}\n{scan}\n{table}", nominal.name));
        Some(digest.iter().take(8).map(|b| format!("{b:02x}")).collect())
    }
}
