//! Text scans (.xyz .asc .pts .csv .txt): a point per line, x y z first, further columns passed over.
//!
//! Values are separated by white space, commas or semicolons, whichever the first data line uses: held
//! through the whole file, so that a decimal comma is refused and never read as two columns. Also here: lines
//! and numbers with their place, which ascii PLY and STL use too. Lines end with \n, \r\n or \r.

use memchr::{memchr_iter, memchr2};
use rayon::prelude::*;

use super::CloudError;
use super::raw::{Points, Raw};

/// Bytes of text per task, and tasks under way before their points are put together.
const PIECE: usize = 1 << 17;
const PIECES: usize = 32;

/// One line of a file.
pub(super) struct Line<'a> {
    file: &'a str,
    number: usize,
    text: &'a [u8],
}

/// The lines of a text that are not blank.
#[derive(Clone)]
pub(super) struct Lines<'a> {
    file: &'a str,
    rest: &'a [u8],
    number: usize,
}

impl<'a> Lines<'a> {
    /// `first` is the number of the first line.
    pub fn new(file: &'a str, text: &'a [u8], first: usize) -> Lines<'a> {
        Lines { file, rest: text, number: first - 1 }
    }

    /// The lines of this that `later`, further on in the same text, has passed.
    pub fn until(&self, later: &Lines<'a>) -> Lines<'a> {
        Lines { rest: &self.rest[..self.rest.len() - later.rest.len()], ..*self }
    }

    /// The next line that is no comment, consumed only if it is of the given kind.
    fn take_if(&mut self, kind: impl Fn(&Line) -> bool) -> Option<Line<'a>> {
        let mut ahead = self.clone();
        let line = ahead.find(|l| !is_comment(l)).filter(kind)?;
        *self = ahead;
        Some(line)
    }

    /// The first `bytes` bytes, and on to the end of the line.
    fn cut(&mut self, bytes: usize) -> Lines<'a> {
        let begin = self.clone();
        let later = self.rest.get(bytes..).unwrap_or_default();
        let (piece, rest) = self.rest.split_at(self.rest.len() - ended(later).1.len());
        self.rest = rest;
        let alone = |at: &usize| piece.get(at + 1) != Some(&b'\n');
        self.number += memchr_iter(b'\n', piece).count() + memchr_iter(b'\r', piece).filter(alone).count();
        Lines { rest: piece, ..begin }
    }
}

/// A text's first line without its ending, and what comes after.
fn ended(text: &[u8]) -> (&[u8], &[u8]) {
    let Some(end) = memchr2(b'\n', b'\r', text) else { return (text, &[]) };
    let (line, rest) = text.split_at(end);
    (line, rest.strip_prefix(b"\r\n").unwrap_or(&rest[1..]))
}

/// Passes lines to `each` on all cores, cut into pieces, and what it made of each piece to `put`, in order. Of
/// several faults the first in the file is returned.
pub(super) fn in_pieces<'a, T: Send>(
    lines: &Lines<'a>,
    empty: impl Fn() -> T + Sync,
    each: impl Fn(&Line<'a>, &mut T) -> Result<(), CloudError> + Sync,
    mut put: impl FnMut(T),
) -> Result<(), CloudError> {
    let mut lines = lines.clone();
    let piece = |mut lines: Lines<'a>| {
        let mut out = empty();
        lines.try_for_each(|line| each(&line, &mut out)).map(|()| out)
    };
    while !lines.rest.is_empty() {
        let mut pieces: Vec<Lines> = Vec::with_capacity(PIECES);
        while pieces.len() < PIECES && !lines.rest.is_empty() {
            pieces.push(lines.cut(PIECE));
        }
        let parts: Vec<Result<T, CloudError>> = pieces.into_par_iter().map(piece).collect();
        for part in parts {
            put(part?);
        }
    }
    Ok(())
}

impl<'a> Iterator for Lines<'a> {
    type Item = Line<'a>;

    fn next(&mut self) -> Option<Line<'a>> {
        while !self.rest.is_empty() {
            let (text, rest) = ended(self.rest);
            self.rest = rest;
            self.number += 1;
            let text = text.trim_ascii_end();
            if !text.trim_ascii_start().is_empty() {
                return Some(Line { file: self.file, number: self.number, text });
            }
        }
        None
    }
}

impl<'a> Line<'a> {
    /// Its words between white space.
    pub fn words(&self) -> impl Iterator<Item = &'a [u8]> + use<'a> {
        self.text.split(u8::is_ascii_whitespace).filter(|w| !w.is_empty())
    }

    /// A word of this line as a number.
    pub fn number(&self, word: &[u8]) -> Result<f64, CloudError> {
        fast_float2::parse(word).map_err(|_| self.refuse(word, "a number"))
    }

    /// A complaint about a word of this line.
    pub fn refuse(&self, word: &[u8], allowed: &str) -> CloudError {
        // A word is a part of the line, so its address tells its column.
        let column = 1 + (word.as_ptr() as usize).saturating_sub(self.text.as_ptr() as usize);
        self.refuse_at(column, format!("{:?}", shortened(word)), allowed)
    }

    /// A complaint about the line ending too early.
    pub fn refuse_end(&self, allowed: &str) -> CloudError {
        self.refuse_at(self.text.len() + 1, "the end of the line".to_owned(), allowed)
    }

    fn refuse_at(&self, column: usize, found: String, allowed: &str) -> CloudError {
        let file = self.file.to_owned();
        CloudError::Text { file, line: self.number, column, found, allowed: allowed.to_owned() }
    }
}

/// A text short enough for an error.
pub(super) fn shortened(word: &[u8]) -> String {
    let text = String::from_utf8_lossy(&word[..word.len().min(200)]);
    let mut out: String = text.chars().take(40).collect();
    if out.len() < word.len() && out.chars().count() == 40 {
        out.push_str("...");
    }
    out
}

/// What stands between values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Separator {
    Space,
    Comma,
    Semicolon,
}

impl Separator {
    /// What a line uses.
    fn of(line: &Line) -> Separator {
        if line.text.contains(&b';') {
            Separator::Semicolon
        } else if line.text.contains(&b',') {
            Separator::Comma
        } else {
            Separator::Space
        }
    }

    /// The values of a line; empty ones included, except for white space.
    fn split<'a>(self, line: &Line<'a>) -> impl Iterator<Item = &'a [u8]> + use<'a> {
        let between = move |b: &u8| match self {
            Separator::Space => b.is_ascii_whitespace(),
            Separator::Comma => *b == b',',
            Separator::Semicolon => *b == b';',
        };
        let kept = move |v: &&[u8]| self != Separator::Space || !v.is_empty();
        line.text.split(between).map(<[u8]>::trim_ascii).filter(kept)
    }
}

/// Reads a text scan.
pub(super) fn read(file: &str, bytes: &[u8]) -> Result<Raw, CloudError> {
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    let mut lines = Lines::new(file, bytes, 1);
    let announced = lines.take_if(|l| count_line(l).is_some()).and_then(|l| count_line(&l));
    let columns = lines.take_if(is_header).map_or([0, 1, 2], |l| columns(&l));
    let Some(first) = lines.clone().find(|l| !is_comment(l)) else {
        return Err(CloudError::Truncated {
            file: file.to_owned(),
            what: "points".to_owned(),
            expected: announced.unwrap_or(1),
            found: 0,
        });
    };
    let separator = Separator::of(&first);
    // From the length of the first line; the file's size bounds it.
    let mut points = Vec::with_capacity(bytes.len() / (first.text.len() + 1));
    let take = |line: &Line, out: &mut Vec<[f64; 3]>| {
        if !is_comment(line) {
            out.push(point(line, separator, columns)?);
        }
        Ok(())
    };
    in_pieces(&lines, Vec::new, take, |mut part| points.append(&mut part))?;
    let found = points.len() as u64;
    let mut raw = Raw::new(Points::Double(points));
    match announced {
        Some(expected) if expected > found => {
            let (file, what) = (file.to_owned(), "points".to_owned());
            return Err(CloudError::Truncated { file, what, expected, found });
        }
        Some(expected) if expected < found => {
            raw.notes.push(format!("{expected} points announced, all {found} found were read"));
        }
        _ => {}
    }
    Ok(raw)
}

fn is_comment(line: &Line) -> bool {
    let text = line.text.trim_ascii_start();
    text.starts_with(b"#") || text.starts_with(b"//")
}

/// The number on a line that holds a single whole number (PTS files begin with one).
fn count_line(line: &Line) -> Option<u64> {
    std::str::from_utf8(line.text.trim_ascii()).ok()?.parse().ok()
}

/// A line of names: no value is a number or begins like one (a first data line with a fault is no header).
fn is_header(line: &Line) -> bool {
    let name = |v: &[u8]| {
        let begins = v.first().copied().unwrap_or(b'"');
        !begins.is_ascii_digit() && !b"+-.,".contains(&begins) && fast_float2::parse::<f64, _>(v).is_err()
    };
    Separator::of(line).split(line).all(name)
}

/// Where x, y and z stand by the header's names ("x", "X [mm]", "x_mm", "\"x\""); the first three columns
/// when it does not name them.
fn columns(header: &Line) -> [usize; 3] {
    let named = |value: &[u8], axis: u8| {
        let name: Vec<u8> = value.iter().filter(|&&b| b != b'"').map(u8::to_ascii_lowercase).collect();
        name.first() == Some(&axis) && name.get(1).is_none_or(|b| b" _[(".contains(b))
    };
    let find = |axis: u8| Separator::of(header).split(header).position(|v| named(v, axis));
    match (find(b'x'), find(b'y'), find(b'z')) {
        (Some(x), Some(y), Some(z)) => [x, y, z],
        _ => [0, 1, 2],
    }
}

fn point(line: &Line, separator: Separator, columns: [usize; 3]) -> Result<[f64; 3], CloudError> {
    let mut at = [None; 3];
    let last = columns[0].max(columns[1]).max(columns[2]);
    for (i, value) in separator.split(line).enumerate().take(last + 1) {
        if let Some(axis) = columns.iter().position(|&c| c == i) {
            at[axis] = Some(value);
        }
    }
    let mut out = [0.0; 3];
    for (slot, value) in at.into_iter().zip(&mut out) {
        let word = slot.ok_or_else(|| line.refuse_end("at least x, y and z on every line"))?;
        *value = match line.number(word) {
            Err(_) if word.contains(&b',') => Err(line.refuse(word, "a number with a decimal point"))?,
            other => other?,
        };
    }
    Ok(out)
}
