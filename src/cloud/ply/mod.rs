//! PLY files: ascii, binary little and big endian, any scalar types, any order of properties and elements.
//!
//! Only the element `vertex` is kept, and of it x, y, z and (when all three are there) nx, ny, nz. Source:
//! G. Turk, "The PLY Polygon File Format", 1994.

mod ascii;
mod binary;
mod header;

use std::io::Read;

use sha2::Sha256;
use sha2::digest::Output;

use super::CloudError;
use super::raw::{Points, Raw};
use super::stream::Source;
use header::{Element, Encoding, Header, Kind, Scalar};

/// Reads the vertices of a PLY file.
pub(super) fn read(file: &str, bytes: &[u8]) -> Result<Raw, CloudError> {
    let header = Header::parse(file, bytes)?;
    match header.encoding {
        Encoding::Ascii => ascii::read(file, bytes, &header),
        Encoding::Little => binary::read::<false>(file, bytes, &header),
        Encoding::Big => binary::read::<true>(file, bytes, &header),
    }
}

/// Reads and hashes a binary file with vertices of one size block by block, given its head; None when it is
/// another kind of PLY, which must be read as a whole.
pub(super) fn stream(
    head: &[u8],
    source: &mut Source<impl Read>,
    block: usize,
) -> Result<Option<(Raw, Output<Sha256>)>, CloudError> {
    let header = Header::parse(source.file, head)?;
    let Some((vertex, before)) = header.elements.split_last() else { return Ok(None) };
    let stride = vertex.stride().filter(|_| before.iter().all(|e| e.stride() == Some(0)));
    let (Some(stride), false) = (stride, header.encoding == Encoding::Ascii) else { return Ok(None) };
    // What the file is said to hold bounds the allocation, not what its header says.
    let fits = ((head.len() - header.data) as u64 + source.left()) / stride as u64;
    let mut sink = Sink::new(Wanted::of(vertex), vertex.count.min(fits) as usize);
    let (mut found, mut rest) = (0, 0);
    let digest = source.pass(head, header.data, block, |bytes| {
        let whole = vertex.count.saturating_sub(found).min((bytes.len() / stride) as u64);
        let used = whole as usize * stride;
        match header.encoding {
            Encoding::Big => sink.records::<true>(&bytes[..used], stride),
            _ => sink.records::<false>(&bytes[..used], stride),
        }
        found += whole;
        if found < vertex.count {
            return used;
        }
        rest += (bytes.len() - used) as u64;
        bytes.len()
    })?;
    if found < vertex.count {
        return Err(truncated(source.file, vertex, found));
    }
    Ok(Some((sink.raw(binary::left_over(&header, rest)), digest)))
}

/// Where the wanted values stand among a vertex's properties.
#[derive(Clone)]
struct Wanted {
    /// Indices of x, y, z.
    point: [usize; 3],
    /// Indices of nx, ny, nz.
    normal: Option<[usize; 3]>,
    /// Offset and type of each property in a binary record of scalars.
    layout: Vec<(usize, Scalar)>,
}

impl Wanted {
    /// Finds them; the header has checked that x, y and z are there as scalars.
    fn of(vertex: &Element) -> Option<Wanted> {
        let find = |names: [&str; 3]| {
            let found = names.map(|name| {
                vertex.properties.iter().position(|p| p.name == name && matches!(p.kind, Kind::Scalar(_)))
            });
            Some([found[0]?, found[1]?, found[2]?])
        };
        let mut at = 0;
        let place = |p: &header::Property| match p.kind {
            Kind::Scalar(s) => {
                at += s.size();
                (at - s.size(), s)
            }
            Kind::List { item, .. } => (at, item),
        };
        let layout = vertex.properties.iter().map(place).collect();
        Some(Wanted { point: find(["x", "y", "z"])?, normal: find(["nx", "ny", "nz"]), layout })
    }

    /// Whether single precision holds every coordinate of a binary record.
    fn single(&self) -> bool {
        self.point.iter().all(|&i| !matches!(self.layout[i].1, Scalar::F64 | Scalar::I32 | Scalar::U32))
    }
}

/// Takes the vertices in as they are read.
struct Sink {
    wanted: Option<Wanted>,
    points: Points,
    normals: Option<Vec<[f32; 3]>>,
}

impl Sink {
    /// `capacity` must be bounded by what the file can hold, not by what its header says.
    fn new(wanted: Option<Wanted>, capacity: usize) -> Sink {
        let single = wanted.as_ref().is_some_and(Wanted::single);
        Sink::holding(wanted, capacity, single)
    }

    /// For a text, which may have more digits than its header's type.
    fn of_text(wanted: Option<Wanted>, capacity: usize) -> Sink {
        Sink::holding(wanted, capacity, false)
    }

    fn holding(wanted: Option<Wanted>, capacity: usize, single: bool) -> Sink {
        let normals = wanted.as_ref().and_then(|w| w.normal).map(|_| Vec::with_capacity(capacity));
        let points = if single {
            Points::Single(Vec::with_capacity(capacity))
        } else {
            Points::Double(Vec::with_capacity(capacity))
        };
        Sink { wanted, points, normals }
    }

    /// One vertex, its values by property.
    fn push(&mut self, values: &[f64]) {
        let Some(wanted) = &self.wanted else { return };
        let point = wanted.point.map(|i| values[i]);
        match &mut self.points {
            Points::Single(out) => out.push(point.map(|v| v as f32)),
            Points::Double(out) => out.push(point),
        }
        if let (Some(at), Some(normals)) = (wanted.normal, &mut self.normals) {
            normals.push(at.map(|i| values[i] as f32));
        }
    }

    /// Takes in what another has of later vertices.
    fn append(&mut self, mut later: Sink) {
        match (&mut self.points, &mut later.points) {
            (Points::Single(to), Points::Single(from)) => to.append(from),
            (Points::Double(to), Points::Double(from)) => to.append(from),
            _ => {}
        }
        if let (Some(to), Some(from)) = (&mut self.normals, &mut later.normals) {
            to.append(from);
        }
    }

    fn raw(self, note: Option<String>) -> Raw {
        Raw { normals: self.normals, notes: note.into_iter().collect(), ..Raw::new(self.points) }
    }
}

/// Fewer vertices than announced.
fn truncated(file: &str, element: &Element, found: u64) -> CloudError {
    let what =
        if element.name == "vertex" { "vertices".to_owned() } else { format!("elements {:?}", element.name) };
    CloudError::Truncated { file: file.to_owned(), what, expected: element.count, found }
}
