//! What takes long says what it is doing: one line on a terminal, nothing in a pipe, and nothing for what is soon done.

use std::io::{IsTerminal, Write};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Work that ends sooner shows nothing.
const PATIENCE: Duration = Duration::from_millis(300);

/// Time between two pictures of the line.
const BEAT: Duration = Duration::from_millis(100);

const WHEEL: [char; 8] = ['⣷', '⣯', '⣟', '⡿', '⢿', '⣻', '⣽', '⣾'];

/// The line; it is gone when this is dropped.
pub struct Progress {
    line: Option<(Sender<&'static str>, JoinHandle<()>)>,
}

impl Progress {
    /// Shown on a terminal at stderr when `wanted`.
    pub fn new(wanted: bool) -> Progress {
        let shown = wanted && std::io::stderr().is_terminal();
        let line = shown.then(|| {
            let (sender, stages) = channel();
            (sender, std::thread::spawn(move || show(&stages, &mut std::io::stderr(), PATIENCE, BEAT)))
        });
        Progress { line }
    }

    /// What begins now.
    pub fn stage(&self, name: &'static str) {
        if let Some((sender, _)) = &self.line {
            // The line's thread ends only after this.
            let _ = sender.send(name);
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some((sender, thread)) = self.line.take() {
            drop(sender);
            let _ = thread.join();
        }
    }
}

/// Draws until nobody sends any more, then wipes the line.
fn show(stages: &Receiver<&'static str>, out: &mut impl Write, patience: Duration, beat: Duration) {
    let begin = Instant::now();
    let (mut name, mut turn, mut drawn) = ("", 0, false);
    loop {
        let wait = if drawn { beat } else { patience.saturating_sub(begin.elapsed()) };
        match stages.recv_timeout(wait) {
            Ok(next) => name = next,
            Err(RecvTimeoutError::Timeout) => turn += 1,
            Err(RecvTimeoutError::Disconnected) => break,
        }
        if begin.elapsed() >= patience {
            let wheel = WHEEL[turn % WHEEL.len()];
            // A terminal that is gone needs no line.
            let _ = write!(out, "\r\x1b[K{wheel} {name} ({:.1} s)", begin.elapsed().as_secs_f64());
            let _ = out.flush();
            drawn = true;
        }
    }
    if drawn {
        let _ = write!(out, "\r\x1b[K");
        let _ = out.flush();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is written when stages were told and the work is over.
    fn shown(patience: Duration) -> String {
        let (sender, stages) = channel();
        ["reading", "fitting"].iter().for_each(|s| sender.send(*s).unwrap());
        drop(sender);
        let mut out = Vec::new();
        show(&stages, &mut out, patience, BEAT);
        String::from_utf8(out).unwrap()
    }

    #[test]
    fn short_work_shows_nothing() {
        assert_eq!(shown(Duration::from_secs(3600)), "");
    }

    #[test]
    fn long_work_names_its_stages_and_leaves_no_line() {
        let text = shown(Duration::ZERO);
        assert!(text.contains("reading (") && text.contains("fitting ("), "{text:?}");
        assert!(text.ends_with("\r\x1b[K"), "{text:?}");
    }
}
