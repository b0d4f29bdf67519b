//! A watched folder: the commonest way in. Scan programs export into it, finished scans move to `done/` and
//! refused ones to `failed/`, each with a text that says why. Polled, see [`settle`](super::settle).

use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::time::Instant;

use super::settle::{Entry, Settle, is_unfinished};
use super::{ArmError, Filing, ScanFile, ScanSource};

/// Entries looked at, `done` and `failed` counting as one each. A full folder is an error, not a slow daemon.
const MAX_ENTRIES: usize = 10_000;

/// How a folder is watched.
#[derive(Debug, Clone, PartialEq)]
pub struct FolderSettings {
    /// The folder; made if it is missing.
    pub folder: PathBuf,
    /// Time between two looks.
    pub poll: Duration,
    /// A file written in place is complete when unchanged for this long.
    pub settle_time: Duration,
    /// Larger files are refused unread.
    pub max_bytes: u64,
}

impl FolderSettings {
    /// Usual settings for a local folder: looks ten times a second, settles in one, takes up to 2 GiB.
    pub fn new(folder: impl Into<PathBuf>) -> FolderSettings {
        FolderSettings {
            folder: folder.into(),
            poll: Duration::from_millis(100),
            settle_time: Duration::from_secs(1),
            max_bytes: 2 << 30,
        }
    }
}

/// The source over one folder.
#[derive(Debug)]
pub struct WatchedFolder {
    settings: FolderSettings,
    settle: Settle,
    started: Instant,
}

impl WatchedFolder {
    /// Makes the folder with its `done/` and `failed/` and starts watching. Fails without the permission to.
    pub async fn open(settings: FolderSettings) -> Result<WatchedFolder, ArmError> {
        let folders = [settings.folder.join("done"), settings.folder.join("failed")];
        blocking(move || folders.iter().try_for_each(|f| make_writable(f))).await?;
        let settle = Settle::new(settings.settle_time);
        Ok(WatchedFolder { settings, settle, started: Instant::now() })
    }

    async fn list(&self) -> Result<Vec<Entry>, ArmError> {
        let folder = self.settings.folder.clone();
        blocking(move || list(&folder)).await
    }

    async fn move_to(&self, path: &Path, sub: &'static str, why: Option<String>) -> Result<(), ArmError> {
        let (from, target) = (path.to_owned(), self.settings.folder.join(sub));
        blocking(move || move_into(&from, &target, why.as_deref())).await
    }
}

impl ScanSource for WatchedFolder {
    async fn next(&mut self) -> Result<ScanFile, ArmError> {
        loop {
            let listing = self.list().await?;
            for entry in self.settle.look(self.started.elapsed(), listing) {
                let path = self.settings.folder.join(&entry.name);
                if entry.bytes <= self.settings.max_bytes {
                    return Ok(ScanFile { path, bytes: entry.bytes });
                }
                let (found, limit) = (entry.bytes, self.settings.max_bytes);
                let why = format!("the file has {found} bytes, allowed is {limit}");
                tracing::warn!(scan = %path.display(), "scan refused: {why}");
                self.move_to(&path, "failed", Some(why)).await?;
            }
            tokio::time::sleep(self.settings.poll).await;
        }
    }

    async fn file(&mut self, scan: &ScanFile, filing: Filing<'_>) -> Result<(), ArmError> {
        match filing {
            Filing::Done => self.move_to(&scan.path, "done", None).await,
            Filing::Failed(why) => self.move_to(&scan.path, "failed", Some(why.to_owned())).await,
        }
    }

    async fn set_aside(&mut self, reason: &str) -> Result<usize, ArmError> {
        let mut listing = self.list().await?;
        // Moving a file from under a program that means to rename it would break that program.
        listing.retain(|e| !is_unfinished(&e.name));
        for entry in &listing {
            let path = self.settings.folder.join(&entry.name);
            self.move_to(&path, "failed", Some(reason.to_owned())).await?;
        }
        Ok(listing.len())
    }
}

/// File work off the async workers: a network share may hang.
async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, ArmError> + Send + 'static,
) -> Result<T, ArmError> {
    match tokio::task::spawn_blocking(work).await {
        Ok(result) => result,
        Err(join) => std::panic::resume_unwind(join.into_panic()),
    }
}

fn at<'a>(path: &'a Path, what: &'static str) -> impl FnOnce(io::Error) -> ArmError + 'a {
    move |source| ArmError::Io { path: path.display().to_string(), what, source }
}

/// Makes the folder and proves that files can be put there, now rather than after the first scan.
fn make_writable(folder: &Path) -> Result<(), ArmError> {
    std::fs::create_dir_all(folder).map_err(at(folder, "be made"))?;
    tempfile::tempfile_in(folder).map_err(at(folder, "be written to"))?;
    Ok(())
}

fn list(folder: &Path) -> Result<Vec<Entry>, ArmError> {
    let mut entries = Vec::new();
    for (i, entry) in std::fs::read_dir(folder).map_err(at(folder, "be read"))?.enumerate() {
        if i >= MAX_ENTRIES {
            return Err(ArmError::TooMany { path: folder.display().to_string(), limit: MAX_ENTRIES });
        }
        let entry = entry.map_err(at(folder, "be read"))?;
        // A file may vanish between listing and looking; links and folders are not scans.
        let Ok(meta) = entry.metadata() else { continue };
        let Ok(modified) = meta.modified() else { continue };
        if let (true, Ok(name)) = (meta.is_file(), entry.file_name().into_string()) {
            entries.push(Entry { name, inode: meta.ino(), bytes: meta.len(), modified });
        }
    }
    Ok(entries)
}

/// Moves a file into a folder under its own name, or that name with a number when it is taken there.
fn move_into(from: &Path, folder: &Path, why: Option<&str>) -> Result<(), ArmError> {
    let part = |p: Option<&std::ffi::OsStr>| p.map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    let (stem, extension) = (part(from.file_stem()), part(from.extension()));
    let dot = if extension.is_empty() { "" } else { "." };
    let mut to = folder.join(format!("{stem}{dot}{extension}"));
    let mut number = 1;
    while to.symlink_metadata().is_ok() {
        number += 1;
        to = folder.join(format!("{stem}-{number}{dot}{extension}"));
    }
    std::fs::rename(from, &to).map_err(at(from, "be moved"))?;
    if let Some(why) = why {
        let mut note = to.into_os_string();
        note.push(".txt");
        let note = PathBuf::from(note);
        std::fs::write(&note, format!("{why}\n")).map_err(at(&note, "be written"))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder whose clock is tokio's, which these tests turn by hand.
    async fn watched(max_bytes: u64) -> (tempfile::TempDir, WatchedFolder) {
        let dir = tempfile::tempdir().unwrap();
        let settings = FolderSettings { max_bytes, ..FolderSettings::new(dir.path().join("scans")) };
        let folder = WatchedFolder::open(settings).await.unwrap();
        (dir, folder)
    }

    fn put(folder: &WatchedFolder, name: &str, text: &str) {
        std::fs::write(folder.settings.folder.join(name), text).unwrap();
    }

    fn read(folder: &WatchedFolder, name: &str) -> String {
        std::fs::read_to_string(folder.settings.folder.join(name)).unwrap()
    }

    fn count(folder: &WatchedFolder, sub: &str) -> usize {
        std::fs::read_dir(folder.settings.folder.join(sub)).unwrap().count()
    }

    #[tokio::test(start_paused = true)]
    async fn a_scan_comes_after_the_settling_time_and_again_until_it_is_filed() {
        let (_dir, mut folder) = watched(100).await;
        put(&folder, "a.ply", "points");
        let before = Instant::now();
        let scan = folder.next().await.unwrap();
        assert!(before.elapsed() >= folder.settings.settle_time);
        assert_eq!((scan.path.file_name().unwrap().to_str(), scan.bytes), (Some("a.ply"), 6));
        assert_eq!(folder.next().await.unwrap(), scan);
        folder.file(&scan, Filing::Done).await.unwrap();
        assert_eq!(read(&folder, "done/a.ply"), "points");
        assert!(!scan.path.exists());
    }

    #[tokio::test(start_paused = true)]
    async fn a_failed_scan_lies_beside_its_reason_and_nothing_is_overwritten() {
        let (_dir, mut folder) = watched(100).await;
        for text in ["one", "two"] {
            put(&folder, "a.ply", text);
            let scan = folder.next().await.unwrap();
            folder.file(&scan, Filing::Failed("it is a cube")).await.unwrap();
        }
        assert_eq!(read(&folder, "failed/a.ply"), "one");
        assert_eq!(read(&folder, "failed/a-2.ply"), "two");
        assert_eq!(read(&folder, "failed/a-2.ply.txt"), "it is a cube\n");
    }

    #[tokio::test(start_paused = true)]
    async fn a_file_over_the_limit_is_refused_unread_and_one_at_the_limit_is_taken() {
        let (_dir, mut folder) = watched(5).await;
        put(&folder, "a.ply", "123456");
        put(&folder, "b.ply", "12345");
        let scan = folder.next().await.unwrap();
        assert_eq!(scan.path.file_name().unwrap(), "b.ply");
        assert_eq!(read(&folder, "failed/a.ply.txt"), "the file has 6 bytes, allowed is 5\n");
    }

    #[tokio::test(start_paused = true)]
    async fn hidden_unfinished_and_linked_files_are_left_alone() {
        let (_dir, mut folder) = watched(100).await;
        for name in [".hidden.ply", "b.ply.part", "c.tmp"] {
            put(&folder, name, "half");
        }
        let root = folder.settings.folder.clone();
        std::os::unix::fs::symlink("/etc/hostname", root.join("link.ply")).unwrap();
        let nothing = tokio::time::timeout(Duration::from_secs(60), folder.next()).await;
        assert!(nothing.is_err());
        std::fs::rename(root.join("b.ply.part"), root.join("b.ply")).unwrap();
        let before = Instant::now();
        assert_eq!(folder.next().await.unwrap().path, root.join("b.ply"));
        assert!(before.elapsed() < folder.settings.settle_time);
    }

    #[tokio::test(start_paused = true)]
    async fn what_was_there_before_is_set_aside_whole() {
        let (_dir, mut folder) = watched(100).await;
        put(&folder, "a.ply", "old");
        put(&folder, "b.ply", "still being written");
        put(&folder, "c.ply.part", "to be renamed by its owner");
        assert_eq!(folder.set_aside("older than the table").await.unwrap(), 2);
        assert_eq!((count(&folder, "failed"), count(&folder, "done")), (4, 0));
        assert_eq!(folder.set_aside("older than the table").await.unwrap(), 0);
    }

    #[tokio::test]
    async fn a_folder_that_is_a_file_is_a_clear_error() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let error = WatchedFolder::open(FolderSettings::new(file.path())).await.unwrap_err();
        assert!(error.to_string().contains("cannot be made"), "{error}");
    }
}
