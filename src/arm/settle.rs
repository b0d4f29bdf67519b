//! When a file in a watched folder is complete: pure, time comes in with each look at the folder.
//!
//! A scan program either writes under another name (hidden, `*.part`, `*.tmp`) and renames when done, or
//! writes under the final name from the start. The first is complete on sight: its inode was seen under the
//! other name. The second, and a rename too quick to be seen, is complete when its size and modification
//! time have not changed for the settling time. This needs no inotify, so it works on network shares too.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, SystemTime};

/// One regular file as listed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    /// File name without folder.
    pub name: String,
    /// Identity of the file, which a rename keeps.
    pub inode: u64,
    /// Size.
    pub bytes: u64,
    /// Last write by the file server's clock; only compared with itself.
    pub modified: SystemTime,
}

/// What was seen of the folder so far.
#[derive(Debug)]
pub struct Settle {
    settle_time: Duration,
    /// Files being written under a name that says so.
    unfinished: BTreeSet<u64>,
    /// Visible files and since when they have looked like this; None for those that were complete on sight.
    waiting: BTreeMap<String, (Entry, Option<Duration>)>,
}

/// Whether the name says that the file is not meant for us (yet).
pub fn is_unfinished(name: &str) -> bool {
    let lower = name.to_ascii_lowercase();
    lower.starts_with('.') || lower.ends_with(".part") || lower.ends_with(".tmp")
}

impl Settle {
    /// A fresh view; files must stay unchanged for `settle_time`.
    pub fn new(settle_time: Duration) -> Settle {
        Settle { settle_time, unfinished: BTreeSet::new(), waiting: BTreeMap::new() }
    }

    /// Takes one listing at `now` (any clock that does not go back) and returns the complete files, oldest
    /// write first, then by name.
    pub fn look(&mut self, now: Duration, listing: Vec<Entry>) -> Vec<Entry> {
        let mut unfinished = BTreeSet::new();
        let mut waiting = BTreeMap::new();
        for entry in listing {
            if is_unfinished(&entry.name) {
                unfinished.insert(entry.inode);
                continue;
            }
            let since = match self.waiting.get(&entry.name) {
                Some((seen, since)) if *seen == entry => *since,
                _ if self.unfinished.contains(&entry.inode) && entry.bytes > 0 => None,
                _ => Some(now),
            };
            waiting.insert(entry.name.clone(), (entry, since));
        }
        (self.unfinished, self.waiting) = (unfinished, waiting);
        let complete =
            |since: Option<Duration>| since.is_none_or(|s| now.saturating_sub(s) >= self.settle_time);
        let mut ready: Vec<Entry> =
            self.waiting.values().filter(|(_, since)| complete(*since)).map(|(e, _)| e.clone()).collect();
        ready.sort_by(|a, b| (a.modified, &a.name).cmp(&(b.modified, &b.name)));
        ready
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn entry(name: &str, inode: u64, bytes: u64, modified_s: u64) -> Entry {
        Entry {
            name: name.into(),
            inode,
            bytes,
            modified: SystemTime::UNIX_EPOCH + Duration::from_secs(modified_s),
        }
    }

    fn names(ready: &[Entry]) -> Vec<&str> {
        ready.iter().map(|e| e.name.as_str()).collect()
    }

    #[test]
    fn a_file_is_complete_at_the_settling_time_and_not_a_moment_before() {
        let mut settle = Settle::new(SECOND);
        let scan = || vec![entry("a.ply", 1, 10, 5)];
        assert_eq!(names(&settle.look(Duration::ZERO, scan())), [""; 0]);
        assert_eq!(names(&settle.look(SECOND - Duration::from_nanos(1), scan())), [""; 0]);
        assert_eq!(names(&settle.look(SECOND, scan())), ["a.ply"]);
    }

    #[test]
    fn growth_a_later_write_or_another_file_of_the_name_start_the_wait_again() {
        for changed in [entry("a.ply", 1, 11, 5), entry("a.ply", 1, 10, 6), entry("a.ply", 2, 10, 5)] {
            let mut settle = Settle::new(SECOND);
            settle.look(Duration::ZERO, vec![entry("a.ply", 1, 10, 5)]);
            assert_eq!(names(&settle.look(SECOND, vec![changed.clone()])), [""; 0]);
            assert_eq!(names(&settle.look(2 * SECOND, vec![changed])), ["a.ply"]);
        }
    }

    #[test]
    fn a_file_seen_under_another_name_is_complete_as_soon_as_it_is_renamed() {
        for unfinished in [".a.ply", "a.ply.part", "A.PLY.TMP"] {
            let mut settle = Settle::new(SECOND);
            assert_eq!(names(&settle.look(Duration::ZERO, vec![entry(unfinished, 7, 3, 5)])), [""; 0]);
            assert_eq!(names(&settle.look(100 * SECOND, vec![entry(unfinished, 7, 3, 5)])), [""; 0]);
            let now = 100 * SECOND + Duration::from_nanos(1);
            assert_eq!(names(&settle.look(now, vec![entry("a.ply", 7, 10, 6)])), ["a.ply"]);
            // And stays complete until it is taken.
            assert_eq!(names(&settle.look(now, vec![entry("a.ply", 7, 10, 6)])), ["a.ply"]);
        }
    }

    #[test]
    fn the_oldest_write_comes_first_then_the_name() {
        let mut settle = Settle::new(SECOND);
        let files = || vec![entry("b", 1, 1, 9), entry("c", 2, 1, 8), entry("a", 3, 1, 9)];
        settle.look(Duration::ZERO, files());
        assert_eq!(names(&settle.look(SECOND, files())), ["c", "a", "b"]);
    }
}
