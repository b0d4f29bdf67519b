//! What the cell itself puts on record: scans, measurements, decisions, changes of state.

use std::time::{SystemTime, UNIX_EPOCH};

use serde::Serialize;

use crate::journal::Journal;

/// Appends a record. A journal that takes nothing (a full disk) does not stop measuring; it stops deliveries by
/// itself, since no intent can be written either.
pub fn record(journal: &mut Journal, kind: &str, content: &impl Serialize) {
    // A clock before 1970 is wrong in any case; the order of records does not depend on it.
    let time_ms = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_millis());
    let time_ms = i64::try_from(time_ms).unwrap_or(i64::MAX);
    let result = serde_json::to_string(content).map_err(|e| e.to_string());
    let result = result.and_then(|text| journal.append(time_ms, kind, &text).map_err(|e| e.to_string()));
    if let Err(error) = result {
        tracing::error!(kind, error, "not journalled");
    }
}
