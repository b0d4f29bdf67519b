//! PLY files: ascii, binary little and big endian, any scalar types, any order of properties and elements.
//!
//! Only the element `vertex` is kept, and of it x, y, z and (when all three are there) nx, ny, nz. Source:
//! G. Turk, "The PLY Polygon File Format", 1994.

mod ascii;
mod binary;
mod header;

use nalgebra::Point3;

use super::CloudError;
use super::raw::Raw;
use header::{Element, Encoding, Header, Kind};

/// Reads the vertices of a PLY file.
pub(super) fn read(file: &str, bytes: &[u8]) -> Result<Raw, CloudError> {
    let header = Header::parse(file, bytes)?;
    match header.encoding {
        Encoding::Ascii => ascii::read(file, bytes, &header),
        Encoding::Little => binary::read::<false>(file, bytes, &header),
        Encoding::Big => binary::read::<true>(file, bytes, &header),
    }
}

/// Where the wanted values stand among a vertex's properties.
struct Wanted {
    /// Indices of x, y, z.
    point: [usize; 3],
    /// Indices of nx, ny, nz.
    normal: Option<[usize; 3]>,
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
        Some(Wanted { point: find(["x", "y", "z"])?, normal: find(["nx", "ny", "nz"]) })
    }
}

/// Takes the vertices in as they are read.
struct Sink {
    wanted: Wanted,
    raw: Raw,
}

impl Sink {
    /// `capacity` must be bounded by what the file can hold, not by what its header says.
    fn new(wanted: Wanted, capacity: usize) -> Sink {
        let normals = wanted.normal.map(|_| Vec::with_capacity(capacity));
        Sink { wanted, raw: Raw { points: Vec::with_capacity(capacity), normals, notes: Vec::new() } }
    }

    /// One vertex, its values by property.
    fn push(&mut self, values: &[f64]) {
        let [x, y, z] = self.wanted.point.map(|i| values[i]);
        self.raw.points.push(Point3::new(x, y, z));
        if let (Some(at), Some(normals)) = (self.wanted.normal, &mut self.raw.normals) {
            normals.push(at.map(|i| values[i] as f32));
        }
    }
}

/// Fewer vertices than announced.
fn truncated(file: &str, element: &Element, found: u64) -> CloudError {
    let what =
        if element.name == "vertex" { "vertices".to_owned() } else { format!("elements {:?}", element.name) };
    CloudError::Truncated { file: file.to_owned(), what, expected: element.count, found }
}
