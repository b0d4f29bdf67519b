//! The data of a binary PLY file, either byte order.

use nalgebra::Point3;

use super::header::{Element, Header, Kind, Scalar};
use super::{CloudError, Raw, Sink, Wanted, truncated};

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
    let mut out = Raw::default();
    for element in &header.elements {
        let mut sink = None;
        if element.name == "vertex"
            && let Some(wanted) = Wanted::of(element)
        {
            // The smallest record is three bytes: a header cannot make this allocate beyond the file's size.
            let smallest = element.stride().unwrap_or(3).max(3) as u64;
            let fits = (bytes.len() - cursor.at) as u64 / smallest;
            sink = Some(Sink::new(wanted, element.count.min(fits) as usize));
        }
        match element.stride() {
            Some(stride) => fixed::<BIG>(file, &mut cursor, element, stride, sink.as_mut())?,
            None => varying::<BIG>(file, &mut cursor, element, sink.as_mut())?,
        }
        out = sink.map_or(out, |s| s.raw);
    }
    let rest = bytes.len() - cursor.at;
    if !header.more && rest > 0 {
        out.notes.push(format!("{rest} bytes after the last vertex passed over"));
    }
    Ok(out)
}

/// Records of one size.
fn fixed<const BIG: bool>(
    file: &str,
    cursor: &mut Cursor,
    element: &Element,
    stride: usize,
    sink: Option<&mut Sink>,
) -> Result<(), CloudError> {
    if stride == 0 {
        return Ok(());
    }
    let left = cursor.bytes.len() - cursor.at;
    let whole = usize::try_from(element.count).ok().and_then(|n| n.checked_mul(stride));
    let data =
        whole.and_then(|n| cursor.take(n)).ok_or_else(|| truncated(file, element, (left / stride) as u64))?;
    let Some(sink) = sink else { return Ok(()) };
    let layout = layout(element);
    let [x, y, z] = sink.wanted.point.map(|i| layout[i]);
    let value = |record: &[u8], (at, scalar): (usize, Scalar)| decode::<BIG>(&record[at..], scalar);
    sink.raw
        .points
        .extend(data.chunks_exact(stride).map(|r| Point3::new(value(r, x), value(r, y), value(r, z))));
    if let (Some(at), Some(normals)) = (sink.wanted.normal, &mut sink.raw.normals) {
        let at = at.map(|i| layout[i]);
        normals.extend(data.chunks_exact(stride).map(|r| at.map(|p| value(r, p) as f32)));
    }
    Ok(())
}

/// Offset and type of each property in a record of scalars.
fn layout(element: &Element) -> Vec<(usize, Scalar)> {
    let mut at = 0;
    let place = |p: &super::header::Property| match p.kind {
        Kind::Scalar(s) => {
            at += s.size();
            (at - s.size(), s)
        }
        Kind::List { item, .. } => (at, item),
    };
    element.properties.iter().map(place).collect()
}

/// Records with lists: one by one.
fn varying<const BIG: bool>(
    file: &str,
    cursor: &mut Cursor,
    element: &Element,
    mut sink: Option<&mut Sink>,
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
        if let Some(sink) = sink.as_deref_mut() {
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
