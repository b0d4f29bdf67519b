//! The data of an ascii PLY file: one line per record.

use super::super::text::{Line, Lines};
use super::header::{Element, Header, Kind};
use super::{CloudError, Raw, Sink, Wanted, truncated};

/// Reads the vertices, passing over the lines that stand before them.
pub(super) fn read(file: &str, bytes: &[u8], header: &Header) -> Result<Raw, CloudError> {
    let mut lines = Lines::new(file, &bytes[header.data..], header.data_line);
    let mut out = Raw::default();
    for element in header.elements.iter().filter(|e| !e.properties.is_empty()) {
        let Some(wanted) = Wanted::of(element).filter(|_| element.name == "vertex") else {
            skip(file, &mut lines, element)?;
            continue;
        };
        // A value takes two bytes or more with its separator: the file's size bounds the allocation.
        let fits = bytes.len() as u64 / (2 * element.properties.len() as u64);
        let mut sink = Sink::new(wanted, element.count.min(fits) as usize);
        let mut values = vec![0.0; element.properties.len()];
        for done in 0..element.count {
            let line = lines.next().ok_or_else(|| truncated(file, element, done))?;
            record(&line, element, &mut values)?;
            sink.push(&values);
        }
        out = sink.raw;
    }
    let rest = lines.count();
    if !header.more && rest > 0 {
        out.notes.push(format!("{rest} lines after the last vertex passed over"));
    }
    Ok(out)
}

fn skip(file: &str, lines: &mut Lines, element: &Element) -> Result<(), CloudError> {
    for done in 0..element.count {
        lines.next().ok_or_else(|| truncated(file, element, done))?;
    }
    Ok(())
}

/// One vertex: exactly the values that the header names, or values would shift into their neighbours' place.
fn record(line: &Line, element: &Element, values: &mut [f64]) -> Result<(), CloudError> {
    let mut words = line.words();
    for (property, value) in element.properties.iter().zip(values) {
        let missing = || line.refuse_end(&format!("a value for {:?}", property.name));
        match property.kind {
            Kind::Scalar(_) => *value = line.number(words.next().ok_or_else(missing)?)?,
            Kind::List { .. } => {
                let word = words.next().ok_or_else(missing)?;
                let n: u64 = std::str::from_utf8(word)
                    .ok()
                    .and_then(|w| w.parse().ok())
                    .ok_or_else(|| line.refuse(word, "the number of items of a list"))?;
                for _ in 0..n {
                    words.next().ok_or_else(missing)?;
                }
            }
        }
    }
    match words.next() {
        Some(extra) => Err(line.refuse(extra, "the end of the line: the header names no more values")),
        None => Ok(()),
    }
}
