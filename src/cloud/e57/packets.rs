//! The packets of an E57 scan, walked over before they are read: whether they hold what is announced, and whether their
//! byte streams keep step.
//!
//! A reader holds back the values of a stream that runs ahead until the others have caught up; of a file that lies it would
//! hold a hundred times the file's size. The walk looks at sizes only, so it costs next to nothing.

use e57::PointCloud;

use super::bits;

/// Bytes of a page, and those of them that are not its checksum. The reader knows no other size.
const PAGE: u64 = 1024;
const DATA: u64 = PAGE - 4;
/// Values by which a stream may run ahead of another: writers round to some tens.
const AHEAD: u64 = 1 << 16;

/// How many of the announced points are there in full; else why they cannot be read.
pub(super) fn held(bytes: &[u8], scan: &PointCloud) -> Result<u64, String> {
    let sizes: Vec<u64> = scan.prototype.iter().map(|r| bits(&r.data_type)).collect();
    let mut streams: Vec<(u64, u64)> = sizes.iter().map(|bits| (*bits, 0)).collect();
    let mut pages = Pages { bytes, at: logical(scan.file_offset) };
    let header: Option<[u8; 32]> = pages.take();
    let Some(header) = header.filter(|h| h[0] == 1) else {
        return Err(format!("no points begin at byte {}, where a scan in it should", scan.file_offset));
    };
    pages.at = logical(number(&header[16..24]));
    let (mut least, mut between) = (0, None);
    while least < scan.records {
        let begin = pages.at;
        let Some([kind, _, short, long, low, high]) = pages.take() else { return Ok(least) };
        match (kind, between) {
            (1, None) => {}
            (1, Some(kind)) => {
                return Err(format!("between its points there is a packet of kind {kind}, only 1 is read"));
            }
            // An index, or nothing: the reader stumbles over them, but then all points may have come.
            (0 | 2, _) => {
                between = Some(kind);
                pages.at = begin + u64::from(u16::from_le_bytes([short, long])) + 1;
                continue;
            }
            _ => return Ok(least),
        }
        let count = usize::from(u16::from_le_bytes([low, high]));
        if count != streams.len() {
            return Err(format!("a packet has {count} byte streams, {} are announced", streams.len()));
        }
        let mut long = 0;
        for (_, total) in &mut streams {
            let Some(size) = pages.take() else { return Ok(least) };
            let size = u64::from(u16::from_le_bytes(size));
            *total += 8 * size;
            long += size;
        }
        // Packets begin at multiples of four.
        pages.at = (pages.at + long).next_multiple_of(4);
        let values = || streams.iter().filter_map(|(bits, total)| total.checked_div(*bits));
        if pages.at > bytes.len() as u64 / PAGE * DATA {
            return Ok(least);
        }
        least = values().min().unwrap_or(0);
        let most = values().max().unwrap_or(0);
        if most - least > AHEAD {
            return Err(format!(
                "its byte streams do not keep step: one has {most} values where another has {least}"
            ));
        }
    }
    Ok(least)
}

fn number(bytes: &[u8]) -> u64 {
    bytes.iter().rev().fold(0, |n, byte| n << 8 | u64::from(*byte))
}

/// Where a byte of the file is when checksums are left out.
fn logical(physical: u64) -> u64 {
    physical - physical / PAGE * (PAGE - DATA)
}

/// A file without its checksums.
struct Pages<'a> {
    bytes: &'a [u8],
    at: u64,
}

impl Pages<'_> {
    /// The next bytes; None at the end of the file.
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let mut out = [0; N];
        for byte in &mut out {
            let (page, within) = (self.at / DATA, (self.at % DATA) as usize);
            *byte = *self.bytes.chunks_exact(PAGE as usize).nth(usize::try_from(page).ok()?)?.get(within)?;
            self.at += 1;
        }
        Some(out)
    }
}
