//! The data of a binary PLY file, either byte order.

use super::header::{Element, Header, Kind, Scalar};
use super::{CloudError, Points, Raw, Sink, Wanted, truncated};

/// The bytes and how far they are read.
struct Cursor<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Cursor<'a> {
    /// The next `n` bytes; None when there are fewer (nothing is consumed then).
    fn take(&mut self, n: usize) -> Option<&'a [u8]> {
        let taken = self.bytes.get(self.at..self.at.checked_add(n)?)?;
        self.at += n;
        Some(taken)
    }
}

/// Reads the vertices, passing over what stands before them.
pub(super) fn read<const BIG: bool>(file: &str, bytes: &[u8], header: &Header) -> Result<Raw, CloudError> {
    let mut cursor = Cursor { bytes, at: header.data };
    let mut out = Sink::new(None, 0);
    for element in &header.elements {
        if element.name == "vertex" {
            // The smallest record is three bytes: a header cannot make this allocate beyond the file's size.
            let smallest = element.stride().unwrap_or(3).max(3) as u64;
            let fits = (bytes.len() - cursor.at) as u64 / smallest;
            out = Sink::new(Wanted::of(element), element.count.min(fits) as usize);
        }
        match element.stride() {
            Some(stride) => fixed::<BIG>(file, &mut cursor, element, stride, &mut out)?,
            None => varying::<BIG>(file, &mut cursor, element, &mut out)?,
        }
    }
    let rest = (bytes.len() - cursor.at) as u64;
    Ok(out.raw(left_over(header, rest)))
}

/// What is said of the bytes after the last vertex.
pub(super) fn left_over(header: &Header, rest: u64) -> Option<String> {
    (!header.more && rest > 0).then(|| format!("{rest} bytes after the last vertex passed over"))
}

/// Records of one size.
fn fixed<const BIG: bool>(
    file: &str,
    cursor: &mut Cursor,
    element: &Element,
    stride: usize,
    sink: &mut Sink,
) -> Result<(), CloudError> {
    if stride == 0 {
        return Ok(());
    }
    let left = cursor.bytes.len() - cursor.at;
    let whole = usize::try_from(element.count).ok().and_then(|n| n.checked_mul(stride));
    let data =
        whole.and_then(|n| cursor.take(n)).ok_or_else(|| truncated(file, element, (left / stride) as u64))?;
    if element.name == "vertex" {
        sink.records::<BIG>(data, stride);
    }
    Ok(())
}

impl Sink {
    /// Takes in whole records of one size.
    pub fn records<const BIG: bool>(&mut self, data: &[u8], stride: usize) {
        let Some(wanted) = &self.wanted else { return };
        let records = data.chunks_exact(stride);
        let [x, y, z] = wanted.point.map(|i| wanted.layout[i]);
        match &mut self.points {
            Points::Single(out) if [x.1, y.1, z.1] == [Scalar::F32; 3] => {
                let at = |r: &[u8], p: usize| f32::from_le_bytes(ordered::<BIG, 4>(&r[p..p + 4]));
                out.extend(records.map(|r| [at(r, x.0), at(r, y.0), at(r, z.0)]));
            }
            Points::Double(out) if [x.1, y.1, z.1] == [Scalar::F64; 3] => {
                let at = |r: &[u8], p: usize| f64::from_le_bytes(ordered::<BIG, 8>(&r[p..p + 8]));
                out.extend(records.map(|r| [at(r, x.0), at(r, y.0), at(r, z.0)]));
            }
            Points::Single(out) => {
                out.extend(records.map(|r| [x, y, z].map(|p| decode::<BIG>(&r[p.0..], p.1) as f32)));
            }
            Points::Double(out) => {
                out.extend(records.map(|r| [x, y, z].map(|p| decode::<BIG>(&r[p.0..], p.1))));
            }
        }
        if let (Some(at), Some(normals)) = (wanted.normal, &mut self.normals) {
            let at = at.map(|i| wanted.layout[i]);
            let records = data.chunks_exact(stride);
            normals.extend(records.map(|r| at.map(|p| decode::<BIG>(&r[p.0..], p.1) as f32)));
        }
    }
}

/// Records with lists: one by one.
fn varying<const BIG: bool>(
    file: &str,
    cursor: &mut Cursor,
    element: &Element,
    sink: &mut Sink,
) -> Result<(), CloudError> {
    let mut values = vec![0.0; element.properties.len()];
    // Each record consumes a byte or more, so the file's size bounds the loop whatever the header says.
    for done in 0..element.count {
        for (property, value) in element.properties.iter().zip(&mut values) {
            let short = || truncated(file, element, done);
            match property.kind {
                Kind::Scalar(s) => *value = decode::<BIG>(cursor.take(s.size()).ok_or_else(short)?, s),
                Kind::List { count, item } => {
                    let at = cursor.at;
                    let n = decode::<BIG>(cursor.take(count.size()).ok_or_else(short)?, count);
                    if n < 0.0 {
                        return Err(negative_list(file, at, n));
                    }
                    cursor.take((n as usize).saturating_mul(item.size())).ok_or_else(short)?;
                }
            }
        }
        if element.name == "vertex" {
            sink.push(&values);
        }
    }
    Ok(())
}

fn negative_list(file: &str, offset: usize, n: f64) -> CloudError {
    CloudError::Binary {
        file: file.to_owned(),
        offset,
        found: format!("a list of {n} items"),
        allowed: "0 or more".to_owned(),
    }
}

/// One value at the start of `bytes`, which holds at least its size.
fn decode<const BIG: bool>(bytes: &[u8], scalar: Scalar) -> f64 {
    match scalar {
        Scalar::I8 => f64::from(bytes[0] as i8),
        Scalar::U8 => f64::from(bytes[0]),
        Scalar::I16 => f64::from(u16::from_le_bytes(ordered::<BIG, 2>(bytes)) as i16),
        Scalar::U16 => f64::from(u16::from_le_bytes(ordered::<BIG, 2>(bytes))),
        Scalar::I32 => f64::from(u32::from_le_bytes(ordered::<BIG, 4>(bytes)) as i32),
        Scalar::U32 => f64::from(u32::from_le_bytes(ordered::<BIG, 4>(bytes))),
        Scalar::F32 => f64::from(f32::from_le_bytes(ordered::<BIG, 4>(bytes))),
        Scalar::F64 => f64::from_le_bytes(ordered::<BIG, 8>(bytes)),
    }
}

/// The first N bytes in little-endian order.
fn ordered<const BIG: bool, const N: usize>(bytes: &[u8]) -> [u8; N] {
    let mut out = [0; N];
    out.copy_from_slice(&bytes[..N]);
    if BIG {
        out.reverse();
    }
    out
}
