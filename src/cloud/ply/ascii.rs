//! The data of an ascii PLY file: one line per record.

use super::super::text::{Line, Lines, in_pieces};
use super::header::{Element, Header, Kind};
use super::{CloudError, Raw, Sink, Wanted, truncated};

/// Reads the vertices, passing over the lines that stand before them.
pub(super) fn read(file: &str, bytes: &[u8], header: &Header) -> Result<Raw, CloudError> {
    let mut lines = Lines::new(file, &bytes[header.data..], header.data_line);
    let mut out = Sink::of_text(None, 0);
    for element in header.elements.iter().filter(|e| !e.properties.is_empty()) {
        let begin = lines.clone();
        skip(file, &mut lines, element)?;
        if element.name != "vertex" {
            continue;
        }
        // Checked by now: this many vertices are there.
        out = Sink::of_text(Wanted::of(element), element.count as usize);
        let empty = || (vec![0.0; element.properties.len()], Sink::of_text(Wanted::of(element), 0));
        let take = |line: &Line, (values, sink): &mut (Vec<f64>, Sink)| {
            record(line, element, values)?;
            sink.push(values);
            Ok(())
        };
        in_pieces(&begin.until(&lines), empty, take, |(_, part)| out.append(part))?;
    }
    let rest = if header.more { 0 } else { lines.count() };
    Ok(out.raw((rest > 0).then(|| format!("{rest} lines after the last vertex passed over"))))
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
