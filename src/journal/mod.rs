//! The record: what was measured, decided, sent and acknowledged, chained by hash.
//!
//! One SQLite file, append-only. Each record's hash covers the record before it, so that nothing can be
//! changed or taken out unseen; [`Journal::verify`] walks the chain. A record is on disk when `append` returns
//! (write-ahead log with a sync per commit). The caller gives the time: this room has no clock.

use std::path::Path;
use std::time::Duration;

use rusqlite::{Connection, OptionalExtension as _, TransactionBehavior, params};
use serde::Serialize;
use sha2::{Digest as _, Sha256};
use thiserror::Error;

/// Version of the table below, kept in the file's `user_version`.
const SCHEMA_VERSION: i64 = 1;

/// Marks the file as ours in SQLite's `application_id`: "Bndr".
const APPLICATION_ID: i64 = 0x426E_6472;

const SCHEMA: &str = "
    CREATE TABLE record (
        seq INTEGER PRIMARY KEY,      -- 1, 2, 3, ... without a gap
        time_ms INTEGER NOT NULL,     -- Unix time
        kind TEXT NOT NULL,
        content TEXT NOT NULL,        -- JSON
        previous TEXT NOT NULL,       -- hash of the record before, 64 zeros for the first
        hash TEXT NOT NULL
    ) STRICT;
    CREATE TRIGGER record_is_not_changed BEFORE UPDATE ON record
        BEGIN SELECT RAISE(ABORT, 'the journal is append-only'); END;
    CREATE TRIGGER record_is_not_deleted BEFORE DELETE ON record
        BEGIN SELECT RAISE(ABORT, 'the journal is append-only'); END;
";

/// Why the journal cannot be used.
#[derive(Debug, Error)]
pub enum JournalError {
    /// SQLite said no: disk full, no permission, not a database.
    #[error("journal {file}: {cause}; check the disk, the permissions and that no other program locks it")]
    Sqlite {
        /// Path as given.
        file: String,
        /// What SQLite said.
        cause: rusqlite::Error,
    },
    /// A database of something else.
    #[error("journal {file}: this is a database of another program (application id 0x{found:08X})")]
    Foreign {
        /// Path as given.
        file: String,
        /// Its mark.
        found: i64,
    },
    /// A file of a newer benderd.
    #[error(
        "journal {file}: schema version {found}, this benderd knows {SCHEMA_VERSION}; use a newer benderd"
    )]
    Newer {
        /// Path as given.
        file: String,
        /// Its version.
        found: i64,
    },
    /// The chain is broken.
    #[error("journal {file}, record {seq}: {what}; keep the file and restore a backup")]
    Broken {
        /// Path as given.
        file: String,
        /// Where.
        seq: i64,
        /// What is wrong.
        what: String,
    },
}

/// One record.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Record {
    /// Counted from 1 without a gap.
    pub seq: i64,
    /// Unix time in milliseconds, as the caller gave it.
    pub time_ms: i64,
    /// What it is about, e.g. `intent`.
    pub kind: String,
    /// JSON.
    pub content: String,
    /// Hash of the record before (64 zeros for the first).
    pub previous: String,
    /// SHA-256 over all of the above, in hexadecimal.
    pub hash: String,
}

impl Record {
    fn expected_hash(&self) -> String {
        let mut sha = Sha256::new();
        // Every part has a fixed length or its length in front: no two records give the same bytes.
        sha.update(self.previous.as_bytes());
        sha.update(self.seq.to_be_bytes());
        sha.update(self.time_ms.to_be_bytes());
        for part in [&self.kind, &self.content] {
            sha.update((part.len() as u64).to_be_bytes());
            sha.update(part.as_bytes());
        }
        sha.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
    }
}

/// An open journal.
#[derive(Debug)]
pub struct Journal {
    file: String,
    connection: Connection,
}

impl Journal {
    /// Opens a journal, or makes a new one. The folder must exist.
    pub fn open(path: &Path) -> Result<Journal, JournalError> {
        let file = path.display().to_string();
        let wrap = |cause| JournalError::Sqlite { file: file.clone(), cause };
        let mut connection = Connection::open(path).map_err(wrap)?;
        connection.busy_timeout(Duration::from_secs(5)).map_err(wrap)?;
        let pragma = |c: &Connection, name| c.pragma_query_value(None, name, |row| row.get::<_, i64>(0));
        // Whose file it is comes before anything that would write to it.
        let application = pragma(&connection, "application_id").map_err(wrap)?;
        let version = pragma(&connection, "user_version").map_err(wrap)?;
        let tables: i64 =
            connection.query_row("SELECT count(*) FROM sqlite_schema", [], |row| row.get(0)).map_err(wrap)?;
        if application != APPLICATION_ID && (application != 0 || tables != 0) {
            return Err(JournalError::Foreign { file, found: application });
        }
        if version > SCHEMA_VERSION {
            return Err(JournalError::Newer { file, found: version });
        }
        connection.pragma_update(None, "journal_mode", "WAL").map_err(wrap)?;
        connection.pragma_update(None, "synchronous", "FULL").map_err(wrap)?;
        let transaction =
            connection.transaction_with_behavior(TransactionBehavior::Immediate).map_err(wrap)?;
        // Read again under the lock: another process may have made the file meanwhile.
        if pragma(&transaction, "user_version").map_err(wrap)? == 0 {
            transaction.execute_batch(SCHEMA).map_err(wrap)?;
            transaction.pragma_update(None, "application_id", APPLICATION_ID).map_err(wrap)?;
            transaction.pragma_update(None, "user_version", SCHEMA_VERSION).map_err(wrap)?;
        }
        transaction.commit().map_err(wrap)?;
        Ok(Journal { file, connection })
    }

    /// The file's name as given.
    pub fn file(&self) -> &str {
        &self.file
    }

    /// Adds a record; it is on disk when this returns. Several processes may do so on one file.
    pub fn append(&mut self, time_ms: i64, kind: &str, content: &str) -> Result<Record, JournalError> {
        let file = &self.file;
        let wrap = |cause| JournalError::Sqlite { file: file.clone(), cause };
        let transaction =
            self.connection.transaction_with_behavior(TransactionBehavior::Immediate).map_err(wrap)?;
        let last: Option<(i64, String)> = transaction
            .query_row("SELECT seq, hash FROM record ORDER BY seq DESC LIMIT 1", [], |row| {
                Ok((row.get(0)?, row.get(1)?))
            })
            .optional()
            .map_err(wrap)?;
        let (seq, previous) = last.unwrap_or_else(|| (0, first_previous()));
        let mut record = Record {
            seq: seq + 1,
            time_ms,
            kind: kind.to_owned(),
            content: content.to_owned(),
            previous,
            hash: String::new(),
        };
        record.hash = record.expected_hash();
        transaction
            .execute(
                "INSERT INTO record VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
                params![record.seq, time_ms, kind, content, record.previous, record.hash],
            )
            .map_err(wrap)?;
        transaction.commit().map_err(wrap)?;
        Ok(record)
    }

    /// The records after `after` (0: from the first), oldest first, at most `limit`.
    pub fn list(&self, after: i64, limit: usize) -> Result<Vec<Record>, JournalError> {
        let query = || -> rusqlite::Result<Vec<Record>> {
            let mut statement = self.connection.prepare_cached(
                "SELECT seq, time_ms, kind, content, previous, hash FROM record WHERE seq > ?1 ORDER BY seq LIMIT ?2",
            )?;
            let limit = i64::try_from(limit).unwrap_or(i64::MAX);
            statement.query_map(params![after, limit], record_of)?.collect()
        };
        query().map_err(|cause| JournalError::Sqlite { file: self.file.clone(), cause })
    }

    /// Walks the whole chain; the number of records when it is whole.
    pub fn verify(&self) -> Result<i64, JournalError> {
        let (mut seq, mut previous) = (0, first_previous());
        loop {
            let records = self.list(seq, 1000)?;
            if records.is_empty() {
                return Ok(seq);
            }
            for record in records {
                let broken = |what: &str| {
                    let what = what.to_owned();
                    Err(JournalError::Broken { file: self.file.clone(), seq: record.seq, what })
                };
                if record.seq != seq + 1 {
                    return broken(&format!("the record before it is {seq}, some are missing"));
                }
                if record.previous != previous {
                    return broken("does not follow the record before it");
                }
                if record.hash != record.expected_hash() {
                    return broken("its content is not what its hash was made of");
                }
                (seq, previous) = (record.seq, record.hash);
            }
        }
    }
}

fn record_of(row: &rusqlite::Row) -> rusqlite::Result<Record> {
    Ok(Record {
        seq: row.get(0)?,
        time_ms: row.get(1)?,
        kind: row.get(2)?,
        content: row.get(3)?,
        previous: row.get(4)?,
        hash: row.get(5)?,
    })
}

fn first_previous() -> String {
    "0".repeat(64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn journal() -> (tempfile::TempDir, std::path::PathBuf, Journal) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("journal.db");
        let journal = Journal::open(&path).unwrap();
        (dir, path, journal)
    }

    #[test]
    fn records_survive_reopening_and_form_a_chain() {
        let (_dir, path, mut journal) = journal();
        let first = journal.append(1000, "intent", r#"{"a":1}"#).unwrap();
        assert_eq!((first.seq, first.previous.as_str()), (1, "0".repeat(64).as_str()));
        drop(journal);
        let mut journal = Journal::open(&path).unwrap();
        let second = journal.append(999, "outcome", "{}").unwrap();
        assert_eq!((second.seq, &second.previous), (2, &first.hash));
        assert_eq!(journal.list(0, 10).unwrap(), [first, second.clone()]);
        assert_eq!(journal.list(1, 10).unwrap(), [second]);
        assert_eq!(journal.verify().unwrap(), 2);
    }

    #[test]
    fn two_writers_share_one_chain() {
        let (_dir, path, mut one) = journal();
        let mut two = Journal::open(&path).unwrap();
        for i in 0..5 {
            one.append(i, "a", "1").unwrap();
            two.append(i, "b", "2").unwrap();
        }
        assert_eq!(one.verify().unwrap(), 10);
    }

    #[test]
    fn a_sync_goes_with_every_record() {
        let (_dir, _, journal) = journal();
        let number =
            |name: &str| journal.connection.pragma_query_value(None, name, |r| r.get::<_, i64>(0)).unwrap();
        let mode: String = journal.connection.pragma_query_value(None, "journal_mode", |r| r.get(0)).unwrap();
        assert_eq!((mode.as_str(), number("synchronous")), ("wal", 2)); // 2 is FULL
    }

    #[test]
    fn records_cannot_be_changed_or_deleted_by_sql() {
        let (_dir, _, mut journal) = journal();
        journal.append(1, "a", "1").unwrap();
        for sql in ["UPDATE record SET content = '2'", "DELETE FROM record"] {
            let text = journal.connection.execute(sql, []).unwrap_err().to_string();
            assert!(text.contains("append-only"), "{text}");
        }
    }

    #[test]
    fn whoever_changes_a_record_all_the_same_is_found() {
        for (sql, seq, what) in [
            ("UPDATE record SET content = '9' WHERE seq = 2", 2, "its content"),
            ("UPDATE record SET time_ms = 9 WHERE seq = 2", 2, "its content"),
            ("DELETE FROM record WHERE seq = 2", 3, "some are missing"),
            ("UPDATE record SET hash = previous WHERE seq = 1", 1, "its content"),
        ] {
            let (_dir, _, mut journal) = journal();
            (1..=3).for_each(|i| drop(journal.append(i, "a", "1").unwrap()));
            journal
                .connection
                .execute_batch("DROP TRIGGER record_is_not_changed; DROP TRIGGER record_is_not_deleted")
                .unwrap();
            journal.connection.execute(sql, []).unwrap();
            match journal.verify() {
                Err(JournalError::Broken { seq: found, what: text, .. }) => {
                    assert_eq!(found, seq, "{sql}");
                    assert!(text.contains(what), "{sql}: {text}");
                }
                other => panic!("{sql}: {other:?}"),
            }
        }
    }

    #[test]
    fn files_of_others_and_of_the_future_are_left_alone() {
        let (_dir, path, journal) = journal();
        journal.connection.pragma_update(None, "user_version", 2).unwrap();
        drop(journal);
        assert!(matches!(Journal::open(&path), Err(JournalError::Newer { found: 2, .. })));

        let dir = tempfile::tempdir().unwrap();
        let other = dir.path().join("other.db");
        Connection::open(&other).unwrap().execute_batch("CREATE TABLE t (x)").unwrap();
        assert!(matches!(Journal::open(&other), Err(JournalError::Foreign { found: 0, .. })));

        let text = dir.path().join("text.db");
        std::fs::write(&text, "this is no database, only some text of a few dozen characters").unwrap();
        let message = Journal::open(&text).unwrap_err().to_string();
        assert!(message.contains("text.db") && message.contains("not a database"), "{message}");
        let nowhere = Journal::open(&dir.path().join("missing/journal.db")).unwrap_err().to_string();
        assert!(nowhere.contains("missing/journal.db"), "{nowhere}");
    }
}
