//! Files read in blocks, pipes, and such as grow or end early.

use super::ply::{floats, header};
use super::*;

/// Gives its bytes in dribs, as a pipe does, and says nothing of their number.
struct Drips<'a>(&'a [u8], usize);

impl std::io::Read for Drips<'_> {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        let n = out.len().min(self.1).min(self.0.len());
        out[..n].copy_from_slice(&self.0[..n]);
        self.0 = &self.0[n..];
        Ok(n)
    }
}

/// More points than the head of a file holds, so that blocks follow.
fn long() -> Vec<u8> {
    let points: Vec<_> =
        (0..200_000).map(|i| Point3::new(f64::from(i % 1000), f64::from(i / 1000), 0.5)).collect();
    let mut file = header("binary_little_endian", "200000").into_bytes();
    file.extend(floats(&points));
    file
}

#[test]
fn blocks_of_any_size_and_pipes_read_alike() {
    let file = long();
    let whole = accepted("s.ply", &file);
    assert_eq!((whole.cloud.len(), whole.notes.len()), (200_000, 0));
    for (block, drip, size) in
        [(1000, 64, 0), (4096, 4096, 0), (65_537, 1000, 7), (1 << 20, 1 << 16, u64::MAX / 4)]
    {
        let source = stream::Source::new("s.ply", Drips(&file, drip), size, 1 << 30);
        let scan = door::scan(Path::new("s.ply"), source, block, Unit::Millimetre).unwrap();
        assert!(scan == whole, "blocks of {block}, {drip} bytes at a time");
    }
}

#[test]
fn a_stream_that_ends_early_or_grows_or_never_ends() {
    let file = long();
    let read = |bytes: &[u8], size: u64, most: u64| {
        let source = stream::Source::new("s.ply", bytes, size, most);
        door::scan(Path::new("s.ply"), source, 1 << 16, Unit::Millimetre)
    };
    let all = file.len() as u64;
    // Truncated between the look at its size and the reading, within a record.
    let short = read(&file[..file.len() - 25], all, 1 << 30).unwrap_err().to_string();
    says(&short, &["200000 vertices announced", "199997 found"]);
    let mut grown = file.clone();
    grown.extend([7; 300_000]);
    let scan = read(&grown, all, 1 << 30).unwrap();
    assert_eq!(scan.notes, ["300000 bytes after the last vertex passed over"]);
    assert_eq!(scan.cloud, accepted("s.ply", &file).cloud);
    says(&read(&grown, all, all).unwrap_err().to_string(), &["at most"]);
    says(&read(&file, 0, 1000).unwrap_err().to_string(), &["at most 1000 are read"]);
    assert!(read(&file, all, all).is_ok());
}

#[test]
fn long_texts_keep_order_and_line_numbers() {
    let points: Vec<_> =
        (0..60_000).map(|i| Point3::new(f64::from(i % 300), f64::from(i / 300), 0.25)).collect();
    let rows = text(&points, " ").replace("\n7 ", "\n\n# seven\n7 ");
    let scan = accepted("s.xyz", rows.as_bytes());
    assert_eq!(error_mm(&scan.cloud, &points), 0.0);
    // Two faults: the first is named, wherever the pieces are cut.
    for line in [1, 20_000, 59_999] {
        let mut lines: Vec<&str> = rows.lines().collect();
        lines[line] = "1 2 x3";
        lines[60_001] = "1 2 x3";
        let bad = lines.join("\n");
        says(&refusal("s.xyz", bad.as_bytes()), &[&format!("line {}, column 5", line + 1)]);
    }
    let ply = header("ascii", "60000") + &text(&points, " ");
    assert_eq!(error_mm(&accepted("s.ply", ply.as_bytes()).cloud, &points), 0.0);
    let bad = ply.replacen("\n150 150 ", "\n150 1s0 ", 1);
    says(&refusal("s.ply", bad.as_bytes()), &["line 45158, column 5"]);
}

#[test]
fn more_than_the_head_without_end_of_header() {
    let mut file = b"ply\ncomment ".to_vec();
    file.extend(vec![b'a'; 3 << 20]);
    says(&refusal("s.ply", &file), &["end_header"]);
}
