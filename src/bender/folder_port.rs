//! A shared folder as a port: letters of one text and at most one table, each written under another name, synced, then renamed.
//!
//! Both ends use it, each with the other's names. Files are worked on outside of the async threads: a share that hangs must not stop
//! the rest.

use std::fs::File;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, SystemTime};

use tokio::task::{JoinHandle, spawn_blocking};
use tokio::time::{Instant, sleep_until};

use super::exchange::Port;
use super::recording::Frames;
use super::ring::{Content, Direction};

/// Longest file that is read: a table of the longest program takes a tenth.
const LONGEST: u64 = 256 * 1024;

/// What goes one way.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Letter {
    /// Command or answer.
    pub text: Vec<u8>,
    /// The table that belongs to it.
    pub table: Option<Vec<u8>>,
}

/// File names of one direction.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Names {
    text: PathBuf,
    table: PathBuf,
}

/// One end of a folder.
#[derive(Debug)]
pub struct FolderPort {
    folder: PathBuf,
    out: Names,
    back: Names,
    look: Duration,
    /// A letter older than this was meant for a time that is over.
    oldest: Duration,
    /// A letter is put there within this time, or not at all.
    latest: Duration,
    /// Whether a letter that is too old is an error: benderd takes what lay there away before it asks.
    tells_old: bool,
    /// The next look, and the one that is under way: a call that is cancelled must not lose what it finds.
    next: Instant,
    looking: Option<JoinHandle<io::Result<Option<Letter>>>>,
    frames: Option<Frames>,
}

impl FolderPort {
    /// benderd's end of what belongs to the bender of this number; the folder is looked at every `look`.
    pub fn of_daemon(folder: &Path, number: u16, look: Duration, oldest: Duration) -> io::Result<FolderPort> {
        let port = FolderPort::new(folder, number, [("cmd", "tab"), ("ans", "out")], look, oldest)?;
        Ok(FolderPort { tells_old: true, ..port })
    }

    /// The machine's end.
    pub fn of_machine(
        folder: &Path,
        number: u16,
        look: Duration,
        oldest: Duration,
    ) -> io::Result<FolderPort> {
        FolderPort::new(folder, number, [("ans", "out"), ("cmd", "tab")], look, oldest)
    }

    fn new(
        folder: &Path,
        number: u16,
        endings: [(&str, &str); 2],
        look: Duration,
        oldest: Duration,
    ) -> io::Result<FolderPort> {
        if !folder.is_dir() {
            let why = format!("{} is no folder, or its share is not mounted", folder.display());
            return Err(io::Error::new(io::ErrorKind::NotFound, why));
        }
        let name = |ending: &str| folder.join(format!("bender{number}.{ending}"));
        let [out, back] = endings.map(|(text, table)| Names { text: name(text), table: name(table) });
        remove_unfinished(folder, &out);
        let next = Instant::now();
        Ok(FolderPort {
            folder: folder.to_owned(),
            out,
            back,
            look,
            oldest,
            latest: oldest,
            tells_old: false,
            next,
            looking: None,
            frames: None,
        })
    }

    /// Keeps the letters that go through it there for a while.
    pub fn recorded(mut self, frames: Frames) -> FolderPort {
        self.frames = Some(frames);
        self
    }

    /// What cannot be put there within this time is not put there any more.
    pub fn putting_within(mut self, latest: Duration) -> FolderPort {
        self.latest = latest;
        self
    }

    fn record(&self, direction: Direction, letter: &Letter) {
        if let Some(frames) = &self.frames {
            frames.add(direction, Content::Text(in_one_line(letter)));
        }
    }
}

impl Port for FolderPort {
    type Piece = Letter;

    /// An old answer, and a command that nobody took.
    async fn discard(&mut self) -> io::Result<()> {
        if let Some(looking) = self.looking.take() {
            looking.await.map_err(io::Error::other)??;
        }
        let names = [&self.out.text, &self.back.text, &self.back.table].map(Clone::clone);
        apart(move || names.iter().try_for_each(|name| remove(name))).await
    }

    async fn send(&mut self, letter: Letter) -> io::Result<()> {
        self.record(Direction::Sent, &letter);
        let (folder, names) = (self.folder.clone(), self.out.clone());
        let until = Instant::now() + self.latest;
        apart(move || {
            if let Some(table) = &letter.table {
                put(&names.table, table, until)?;
            }
            put(&names.text, &letter.text, until)?;
            // The names, too; not every share can.
            let _ = File::open(folder).and_then(|folder| folder.sync_all());
            Ok(())
        })
        .await
    }

    async fn receive(&mut self) -> io::Result<Letter> {
        loop {
            if self.looking.is_none() {
                sleep_until(self.next).await;
            }
            let (names, oldest, tells_old) = (self.back.clone(), self.oldest, self.tells_old);
            let look = move || take(&names, oldest, tells_old);
            let looking = self.looking.get_or_insert_with(|| spawn_blocking(look));
            let found = looking.await;
            self.looking = None;
            self.next = Instant::now() + self.look;
            if let Some(letter) = found.map_err(io::Error::other)?? {
                self.record(Direction::Received, &letter);
                return Ok(letter);
            }
        }
    }
}

/// A letter for people: what its text says, and how long its table is.
fn in_one_line(letter: &Letter) -> String {
    let text = String::from_utf8_lossy(&letter.text);
    let lines: Vec<&str> = text.lines().filter(|line| !line.is_empty()).collect();
    let table = letter.table.as_ref().map(|table| format!(" + table of {} bytes", table.len()));
    lines.join("; ") + &table.unwrap_or_default()
}

/// Works on files where a share that hangs holds up nobody else.
pub(super) async fn apart<T: Send + 'static>(
    work: impl FnOnce() -> io::Result<T> + Send + 'static,
) -> io::Result<T> {
    spawn_blocking(work).await.map_err(io::Error::other)?
}

/// All of it under this name, or nothing. It outlives a caller who has given up, and its time in the folder begins when it is written:
/// so what a share held up for too long is not put there any more.
fn put(name: &Path, bytes: &[u8], until: Instant) -> io::Result<()> {
    let new = unfinished(name);
    let written = File::create(&new).and_then(|mut file| {
        file.write_all(bytes)?;
        file.sync_all()
    });
    let done = match written {
        Err(error) => Err(at(name, "cannot be written", &error)),
        Ok(()) if Instant::now() >= until => {
            let why =
                format!("{} is not put there any more: the share took too long to write it", name.display());
            Err(io::Error::new(io::ErrorKind::TimedOut, why))
        }
        Ok(()) => std::fs::rename(&new, name).map_err(|error| at(name, "cannot be put there", &error)),
    };
    if done.is_err() {
        let _ = std::fs::remove_file(new); // it is in nobody's way
    }
    done
}

/// The name under which a file is written: no other of this program nor of another one writes under it.
fn unfinished(name: &Path) -> PathBuf {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    let mut new = name.as_os_str().to_owned();
    new.push(format!(".{}-{}.new", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed)));
    PathBuf::from(new)
}

/// What a program that died, or a share that hung, has left under such names.
fn remove_unfinished(folder: &Path, names: &Names) {
    let Ok(entries) = std::fs::read_dir(folder) else { return };
    for path in entries.flatten().map(|entry| entry.path()) {
        let begins = |name: &Path| {
            path.with_extension("").with_extension("") == name || path.with_extension("") == name
        };
        if path.extension().is_some_and(|e| e == "new") && (begins(&names.text) || begins(&names.table)) {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// The system's error with the file, and what may be behind it.
fn at(name: &Path, what: &str, error: &io::Error) -> io::Error {
    let suspicion = match error.kind() {
        io::ErrorKind::NotFound => {
            ": the share is gone, or another program works on this bender's files (a second benderd?)"
        }
        _ => "",
    };
    io::Error::new(error.kind(), format!("{} {what}: {error}{suspicion}", name.display()))
}

/// The letter that lies there; it is taken away.
fn take(names: &Names, oldest: Duration, tells_old: bool) -> io::Result<Option<Letter>> {
    let Some((text, written)) = read(&names.text)? else { return Ok(None) };
    let table = read(&names.table)?.map(|(table, _)| table);
    remove(&names.text)?;
    remove(&names.table)?;
    // A clock that went back makes nothing old.
    let age = SystemTime::now().duration_since(written).unwrap_or_default();
    if age > oldest && tells_old {
        let why = format!(
            "{}: an answer {} s old by its own time was taken away: compare the clocks of the share and of this computer",
            names.text.display(),
            age.as_secs()
        );
        return Err(io::Error::new(io::ErrorKind::InvalidData, why));
    }
    Ok((age <= oldest).then_some(Letter { text, table }))
}

fn read(name: &Path) -> io::Result<Option<(Vec<u8>, SystemTime)>> {
    let about = match std::fs::metadata(name) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        about => about.map_err(|error| at(name, "cannot be looked at", &error))?,
    };
    if about.len() > LONGEST {
        let why = format!("{} has {} bytes, allowed are {LONGEST}", name.display(), about.len());
        return Err(io::Error::new(io::ErrorKind::InvalidData, why));
    }
    let bytes = std::fs::read(name).map_err(|error| at(name, "cannot be read", &error))?;
    Ok(Some((bytes, about.modified()?)))
}

fn remove(name: &Path) -> io::Result<()> {
    match std::fs::remove_file(name) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            Err(at(name, "cannot be taken away", &error))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LOOK: Duration = Duration::from_millis(5);

    fn ends(folder: &Path, oldest: Duration) -> (FolderPort, FolderPort) {
        let daemon = FolderPort::of_daemon(folder, 7, LOOK, oldest).unwrap();
        (daemon, FolderPort::of_machine(folder, 7, LOOK, oldest).unwrap())
    }

    fn files(folder: &Path) -> Vec<String> {
        let names = std::fs::read_dir(folder).unwrap().map(|f| f.unwrap().file_name());
        let mut names: Vec<String> = names.map(|n| n.into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[tokio::test(start_paused = true)]
    async fn a_letter_arrives_whole_and_nothing_is_left_of_it() {
        let folder = tempfile::tempdir().unwrap();
        let (mut daemon, mut machine) = ends(folder.path(), Duration::from_secs(60));
        let letter = Letter { text: b"stage".to_vec(), table: Some(b"rows".to_vec()) };
        daemon.send(letter.clone()).await.unwrap();
        assert_eq!(files(folder.path()), ["bender7.cmd", "bender7.tab"]);
        assert_eq!(machine.receive().await.unwrap(), letter);
        assert!(files(folder.path()).is_empty());
        machine.send(Letter { text: b"done".to_vec(), table: None }).await.unwrap();
        assert_eq!(daemon.receive().await.unwrap().text, b"done");
        assert!(files(folder.path()).is_empty());
    }

    #[tokio::test(start_paused = true)]
    async fn a_call_that_is_cancelled_loses_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let (mut daemon, mut machine) = ends(folder.path(), Duration::from_secs(60));
        for turn in 0..50_u8 {
            daemon.send(Letter { text: vec![turn], table: None }).await.unwrap();
            let letter = loop {
                let short = Duration::from_micros(u64::from(turn) * 100);
                if let Ok(letter) = tokio::time::timeout(short, machine.receive()).await {
                    break letter.unwrap();
                }
            };
            assert_eq!(letter.text, [turn]);
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_command_that_nobody_took_is_withdrawn_and_an_old_one_is_not_carried_out() {
        let folder = tempfile::tempdir().unwrap();
        let (mut daemon, mut machine) = ends(folder.path(), Duration::from_secs(60));
        daemon.send(Letter { text: b"commit".to_vec(), table: None }).await.unwrap();
        daemon.discard().await.unwrap();
        assert!(files(folder.path()).is_empty());
        // Written by a daemon that died, found two minutes later.
        daemon.send(Letter { text: b"commit".to_vec(), table: None }).await.unwrap();
        let file = File::options().write(true).open(folder.path().join("bender7.cmd")).unwrap();
        file.set_modified(SystemTime::now() - Duration::from_secs(120)).unwrap();
        let found = tokio::time::timeout(Duration::from_secs(1), machine.receive()).await;
        assert!(found.is_err(), "{found:?}");
        assert!(files(folder.path()).is_empty());
    }

    /// A share that hung let an old command appear: it was given up, and its file was fresh.
    #[tokio::test(start_paused = true)]
    async fn what_took_too_long_to_write_is_not_put_there() {
        let folder = tempfile::tempdir().unwrap();
        let (daemon, _) = ends(folder.path(), Duration::from_secs(60));
        let letter = Letter { text: b"commit".to_vec(), table: Some(b"rows".to_vec()) };
        let error = daemon.putting_within(Duration::ZERO).send(letter).await.unwrap_err().to_string();
        assert!(error.contains("bender7.tab is not put there any more: the share took too long"), "{error}");
        assert!(files(folder.path()).is_empty());
    }

    #[tokio::test(start_paused = true)]
    async fn an_answer_that_looks_old_tells_of_the_clocks() {
        let folder = tempfile::tempdir().unwrap();
        let (mut daemon, mut machine) = ends(folder.path(), Duration::from_secs(60));
        machine.send(Letter { text: b"done".to_vec(), table: None }).await.unwrap();
        let file = File::options().write(true).open(folder.path().join("bender7.ans")).unwrap();
        file.set_modified(SystemTime::now() - Duration::from_secs(3600)).unwrap();
        let error = daemon.receive().await.unwrap_err().to_string();
        assert!(
            error.contains("bender7.ans: an answer 3600 s old by its own time was taken away"),
            "{error}"
        );
        assert!(error.contains("compare the clocks"), "{error}");
        assert!(files(folder.path()).is_empty());
    }

    /// It was "No such file or directory (os error 2)".
    #[tokio::test(start_paused = true)]
    async fn a_file_that_another_program_took_is_named() {
        let error = at(
            Path::new("f/bender7.cmd"),
            "cannot be put there",
            &io::Error::from_raw_os_error(libc::ENOENT),
        );
        let said = "f/bender7.cmd cannot be put there: No such file or directory (os error 2): the share is gone, or another \
                    program works on this bender's files (a second benderd?)";
        assert_eq!(error.to_string(), said);
        assert_eq!(error.kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn what_was_left_unfinished_is_taken_away_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let kept = ["bender7.ans.1-1.new", "bender7.cmdx.1-1.new", "bender70.cmd.1-1.new", "other.new"];
        for name in
            kept.into_iter().chain(["bender7.cmd.new", "bender7.cmd.1-1.new", "bender7.tab.4711-12.new"])
        {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let names = ["cmd", "tab"].map(|ending| folder.path().join(format!("bender7.{ending}")));
        remove_unfinished(folder.path(), &Names { text: names[0].clone(), table: names[1].clone() });
        assert_eq!(files(folder.path()), kept);
        assert_ne!(unfinished(&names[0]), unfinished(&names[0]));
        let new = unfinished(&names[0]).file_name().unwrap().to_string_lossy().into_owned();
        assert!(new.starts_with("bender7.cmd.") && new.ends_with(".new"), "{new}");
    }

    #[tokio::test(start_paused = true)]
    async fn what_is_no_folder_or_no_letter_says_so() {
        let folder = tempfile::tempdir().unwrap();
        let error = FolderPort::of_daemon(&folder.path().join("x"), 7, LOOK, LOOK).unwrap_err().to_string();
        assert!(error.contains("is no folder, or its share is not mounted"), "{error}");
        let (mut daemon, _) = ends(folder.path(), Duration::from_secs(60));
        std::fs::write(folder.path().join("bender7.ans"), vec![b' '; LONGEST as usize + 1]).unwrap();
        let error = daemon.receive().await.unwrap_err().to_string();
        assert!(error.contains("has 262145 bytes, allowed are 262144"), "{error}");
    }
}
