//! The header of a PLY file: encoding, elements, properties.

use super::CloudError;

/// A header longer than this is not one.
const LONGEST_HEADER: usize = 1 << 20;
const SCALARS: &str = "char uchar short ushort int uint float double (or int8 .. float64)";

/// How the data after the header is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Encoding {
    Ascii,
    Little,
    Big,
}

/// A scalar type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(word: &str) -> Option<Scalar> {
        Some(match word {
            "char" | "int8" => Scalar::I8,
            "uchar" | "uint8" => Scalar::U8,
            "short" | "int16" => Scalar::I16,
            "ushort" | "uint16" => Scalar::U16,
            "int" | "int32" => Scalar::I32,
            "uint" | "uint32" => Scalar::U32,
            "float" | "float32" => Scalar::F32,
            "double" | "float64" => Scalar::F64,
            _ => return None,
        })
    }

    /// Bytes in a binary file.
    pub fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }

    fn is_integer(self) -> bool {
        !matches!(self, Scalar::F32 | Scalar::F64)
    }
}

/// One value or a counted list of values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Scalar(Scalar),
    List { count: Scalar, item: Scalar },
}

#[derive(Debug)]
pub(super) struct Property {
    pub name: String,
    pub kind: Kind,
}

#[derive(Debug)]
pub(super) struct Element {
    pub name: String,
    pub count: u64,
    pub properties: Vec<Property>,
}

impl Element {
    /// Bytes of one record in a binary file; None when it has lists.
    pub fn stride(&self) -> Option<usize> {
        self.properties.iter().try_fold(0, |sum, p| match p.kind {
            Kind::Scalar(s) => Some(sum + s.size()),
            Kind::List { .. } => None,
        })
    }
}

/// A checked header: exactly one element `vertex`, with scalar x, y and z.
#[derive(Debug)]
pub(super) struct Header {
    pub encoding: Encoding,
    /// All elements up to and including the vertices.
    pub elements: Vec<Element>,
    /// Whether more elements follow the vertices.
    pub more: bool,
    /// Where the data begins.
    pub data: usize,
    /// Line on which the data begins, from 1.
    pub data_line: usize,
}

/// One header line's words, and how to complain about them.
struct Line<'a> {
    file: &'a str,
    number: usize,
    words: Vec<&'a str>,
}

impl Line<'_> {
    fn refuse(&self, allowed: &str) -> CloudError {
        let found = format!("{:?}", super::super::text::shortened(self.words.join(" ").as_bytes()));
        let allowed = allowed.to_owned();
        CloudError::Text { file: self.file.to_owned(), line: self.number, column: 1, found, allowed }
    }

    fn scalar(&self, word: &str) -> Result<Scalar, CloudError> {
        Scalar::parse(word).ok_or_else(|| self.refuse(&format!("a type out of {SCALARS}")))
    }
}

impl Header {
    /// Parses and checks the header.
    pub fn parse(file: &str, bytes: &[u8]) -> Result<Header, CloudError> {
        let mut encoding = None;
        let mut elements: Vec<Element> = Vec::new();
        let (mut at, mut number) = (0, 0);
        loop {
            let Some((text, next)) = next_line(bytes, at) else {
                let line = Line { file, number: number + 1, words: vec!["the end of the file"] };
                return Err(line.refuse("a header that ends with the line \"end_header\""));
            };
            (at, number) = (next, number + 1);
            let text = String::from_utf8_lossy(text);
            let line = Line { file, number, words: text.split_whitespace().collect() };
            match line.words.as_slice() {
                ["ply"] if number == 1 => {}
                [] | ["comment" | "obj_info", ..] => {}
                ["format", name, "1.0"] if encoding.is_none() => {
                    encoding = Some(match *name {
                        "ascii" => Encoding::Ascii,
                        "binary_little_endian" => Encoding::Little,
                        "binary_big_endian" => Encoding::Big,
                        _ => return Err(line.refuse("ascii, binary_little_endian or binary_big_endian")),
                    });
                }
                ["element", name, count] => {
                    let count = count.parse().map_err(|_| line.refuse("element NAME COUNT"))?;
                    elements.push(Element { name: (*name).to_owned(), count, properties: Vec::new() });
                }
                ["property", rest @ ..] => add_property(&line, rest, elements.last_mut())?,
                ["end_header"] => break,
                _ => return Err(line.refuse("format, element, property, comment or end_header")),
            }
        }
        let line = Line { file, number, words: vec!["end_header"] };
        let encoding =
            encoding.ok_or_else(|| line.refuse("a line \"format ascii 1.0\" (or binary) before it"))?;
        let (elements, more) = up_to_vertices(&line, elements)?;
        Ok(Header { encoding, elements, more, data: at, data_line: number + 1 })
    }
}

/// The line at `at` without its ending, and where the next begins. Lines end with \n, \r\n or \r; None at
/// the end of the file or of what a header may take.
fn next_line(bytes: &[u8], at: usize) -> Option<(&[u8], usize)> {
    let rest = bytes.get(at..bytes.len().min(LONGEST_HEADER))?;
    let len = rest.iter().position(|&b| b == b'\n' || b == b'\r')?;
    let both = rest[len] == b'\r' && bytes.get(at + len + 1) == Some(&b'\n');
    Some((&rest[..len], at + len + if both { 2 } else { 1 }))
}

fn add_property(line: &Line, words: &[&str], element: Option<&mut Element>) -> Result<(), CloudError> {
    let element = element.ok_or_else(|| line.refuse("an element before its properties"))?;
    let (name, kind) = match words {
        ["list", count, item, name] => {
            let (count, item) = (line.scalar(count)?, line.scalar(item)?);
            if !count.is_integer() {
                return Err(line.refuse("a list counted by an integer type"));
            }
            (name, Kind::List { count, item })
        }
        [scalar, name] => (name, Kind::Scalar(line.scalar(scalar)?)),
        _ => return Err(line.refuse("property TYPE NAME or property list TYPE TYPE NAME")),
    };
    if element.properties.iter().any(|p| p.name == *name) {
        return Err(line.refuse("a name once per element"));
    }
    element.properties.push(Property { name: (*name).to_owned(), kind });
    Ok(())
}

fn up_to_vertices(line: &Line, mut elements: Vec<Element>) -> Result<(Vec<Element>, bool), CloudError> {
    if elements.iter().filter(|e| e.name == "vertex").count() != 1 {
        return Err(line.refuse("exactly one \"element vertex\" before it"));
    }
    let end = elements.iter().position(|e| e.name == "vertex").map_or(0, |i| i + 1);
    let vertex = &elements[end - 1];
    let has =
        |name: &str| vertex.properties.iter().any(|p| p.name == name && matches!(p.kind, Kind::Scalar(_)));
    if !["x", "y", "z"].into_iter().all(has) {
        return Err(line.refuse("vertices with the properties x, y and z, each one number"));
    }
    let more = elements.len() > end;
    elements.truncate(end);
    Ok((elements, more))
}
