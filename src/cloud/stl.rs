//! STL files, binary and ascii: the corners of their facets, every one once. For clouds that a scanner's software
//! has meshed already.
//!
//! A binary file is told by its size, since its header may begin with "solid" too.

use super::CloudError;
use super::raw::{Points, Raw};
use super::text::Lines;

/// A comment of 80 bytes and the number of facets.
const HEADER: usize = 84;
/// Normal, three corners, and two bytes nobody uses.
const FACET: usize = 50;
const KEYWORDS: [&[u8]; 6] = [b"solid", b"facet", b"outer", b"endloop", b"endfacet", b"endsolid"];

/// Reads the corners of an STL file.
pub(super) fn read(file: &str, bytes: &[u8]) -> Result<Raw, CloudError> {
    let announced =
        bytes.get(HEADER - 4..HEADER).map(|b| u64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])));
    let exact = announced.is_some_and(|n| bytes.len() as u64 == HEADER as u64 + n * FACET as u64);
    if bytes.trim_ascii_start().starts_with(b"solid") && !exact {
        return ascii(file, bytes);
    }
    let Some(announced) = announced else {
        return Err(CloudError::Binary {
            file: file.to_owned(),
            offset: bytes.len(),
            found: "the end of the file".to_owned(),
            allowed: format!("a header of {HEADER} bytes, or \"solid\" at the beginning"),
        });
    };
    let facets = bytes[HEADER..].chunks_exact(FACET);
    let found = facets.len() as u64;
    if announced > found {
        let (file, what) = (file.to_owned(), "facets".to_owned());
        return Err(CloudError::Truncated { file, what, expected: announced, found });
    }
    let number = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
    let corner = |b: &[u8]| [number(b), number(&b[4..]), number(&b[8..])];
    let points =
        facets.take(announced as usize).flat_map(|f| [12, 24, 36].map(|at| corner(&f[at..]))).collect();
    let mut raw = Raw { corners: true, ..Raw::new(Points::Single(points)) };
    let rest = bytes.len() as u64 - HEADER as u64 - announced * FACET as u64;
    if rest > 0 {
        raw.notes.push(format!("{rest} bytes after the last facet passed over"));
    }
    Ok(raw)
}

fn ascii(file: &str, bytes: &[u8]) -> Result<Raw, CloudError> {
    let (mut points, mut ended) = (Vec::new(), false);
    for line in Lines::new(file, bytes, 1) {
        let mut words = line.words();
        let Some(word) = words.next() else { continue };
        let keyword = word.to_ascii_lowercase();
        if keyword == b"vertex" {
            let mut next = || match words.next() {
                Some(word) => line.number(word),
                None => Err(line.refuse_end("x, y and z of a vertex")),
            };
            points.push([next()?, next()?, next()?]);
        } else if !KEYWORDS.contains(&keyword.as_slice()) {
            return Err(line.refuse(word, "facet, outer loop, vertex, endloop, endfacet or endsolid"));
        }
        ended = keyword == b"endsolid";
    }
    if !ended {
        let (file, what) = (file.to_owned(), "line \"endsolid\"".to_owned());
        return Err(CloudError::Truncated { file, what, expected: 1, found: 0 });
    }
    Ok(Raw { corners: true, ..Raw::new(Points::Double(points)) })
}
