//! PLY: every variant alike, hostile headers, faults placed.

use super::*;

/// How one PLY file is written.
#[derive(Debug, Clone)]
struct Variant {
    /// "ascii", "binary_little_endian" or "binary_big_endian".
    format: &'static str,
    /// Types of x, y and z.
    types: [&'static str; 3],
    /// Properties of the vertex in order: indices into x y z nx ny nz, 6 an extra uchar, 7 a list.
    order: Vec<usize>,
    /// Whether elements stand before and after the vertices.
    others: bool,
    /// Line ending of the header.
    ending: &'static str,
}

const NAMES: [&str; 8] = ["x", "y", "z", "nx", "ny", "nz", "red", "indices"];

impl Variant {
    fn kind(&self, property: usize) -> &'static str {
        match property {
            0..=2 => self.types[property],
            3..=5 => "float",
            6 => "uchar",
            _ => "list uchar short",
        }
    }

    fn put(&self, out: &mut Vec<u8>, kind: &str, value: f64) {
        let bytes = match kind {
            "char" => vec![value as i8 as u8],
            "uchar" => vec![value as u8],
            "short" => (value as i16).to_le_bytes().to_vec(),
            "ushort" => (value as u16).to_le_bytes().to_vec(),
            "int" => (value as i32).to_le_bytes().to_vec(),
            "uint" => (value as u32).to_le_bytes().to_vec(),
            "float" => (value as f32).to_le_bytes().to_vec(),
            _ => value.to_le_bytes().to_vec(),
        };
        match self.format {
            "ascii" => out.extend(format!("{value} ").bytes()),
            "binary_big_endian" => out.extend(bytes.iter().rev()),
            _ => out.extend(bytes),
        }
    }

    fn put_list(&self, out: &mut Vec<u8>, items: &[f64]) {
        self.put(out, "uchar", items.len() as f64);
        items.iter().for_each(|v| self.put(out, "short", *v));
    }

    fn end_line(&self, out: &mut Vec<u8>) {
        if self.format == "ascii" {
            out.extend(b"\n");
        }
    }

    fn file(&self, points: &[Point3<f64>]) -> Vec<u8> {
        let mut header = vec!["ply".to_owned(), format!("format {} 1.0", self.format)];
        header.push("comment made by a test".to_owned());
        let other = |name: &str| format!("element {name} 2\nproperty float a\nproperty list uchar short b");
        let other = |name: &str| other(name).replace('\n', self.ending);
        header.extend(self.others.then(|| other("camera")));
        header.push(format!("element vertex {}", points.len()));
        header.extend(self.order.iter().map(|&p| format!("property {} {}", self.kind(p), NAMES[p])));
        header.extend(self.others.then(|| other("face")));
        header.push("end_header".to_owned() + self.ending);
        let mut out = header.join(self.ending).into_bytes();
        let put_other = |out: &mut Vec<u8>| {
            for i in 0..2 {
                self.put(out, "float", 7.5);
                self.put_list(out, &[1.0, 2.0, -3.0][..3 - i]);
                self.end_line(out);
            }
        };
        if self.others {
            put_other(&mut out);
        }
        for (i, p) in points.iter().enumerate() {
            for &property in &self.order {
                match property {
                    0..=2 => self.put(&mut out, self.types[property], p[property]),
                    3..=5 => self.put(&mut out, "float", normal(i)[property - 3]),
                    6 => self.put(&mut out, "uchar", 200.0),
                    _ => self.put_list(&mut out, &[4.0; 3][..i % 4]),
                }
            }
            self.end_line(&mut out);
        }
        if self.others {
            put_other(&mut out);
        }
        out
    }
}

fn normal(i: usize) -> [f64; 3] {
    let t = i as f64 * 0.1;
    [t.sin() as f32 as f64, t.cos() as f32 as f64, 0.0]
}

fn variants() -> impl Strategy<Value = Variant> {
    let format = prop::sample::select(vec!["ascii", "binary_little_endian", "binary_big_endian"]);
    let scalar =
        || prop::sample::select(vec!["char", "uchar", "short", "ushort", "int", "uint", "float", "double"]);
    let order = prop::sample::subsequence(vec![3, 4, 5, 6, 7], 0..=5).prop_flat_map(|extra| {
        let all: Vec<usize> = [0, 1, 2].into_iter().chain(extra).collect();
        Just(all).prop_shuffle()
    });
    let ending = prop::sample::select(vec!["\n", "\r\n"]);
    (format, scalar(), scalar(), scalar(), order, any::<bool>(), ending).prop_map(
        |(format, x, y, z, order, others, ending)| Variant {
            format,
            types: [x, y, z],
            order,
            others,
            ending,
        },
    )
}

/// Whole coordinates that every scalar type can hold, no two alike.
fn lattice() -> Vec<Point3<f64>> {
    (0..250).map(|i| Point3::new((i % 100) as f64, (i / 100) as f64 * 7.0, (i % 90) as f64)).collect()
}

proptest! {
    #[test]
    fn every_variant_of_ply_reads_alike(variant in variants()) {
        let points = lattice();
        let scan = accepted("s.ply", &variant.file(&points));
        prop_assert_eq!(error_mm(&scan.cloud, &points), 0.0);
        prop_assert!(scan.notes.is_empty(), "{:?}", scan.notes);
        let all_normals = [3, 4, 5].iter().all(|n| variant.order.contains(n));
        for i in [0, 17, 249] {
            prop_assert_eq!(scan.cloud.normal(i).is_some(), all_normals);
            let error = scan.cloud.normal(i).map_or(0.0, |n| (n - nalgebra::Vector3::from(normal(i))).norm());
            prop_assert!(error < 1e-6, "{}", error);
        }
    }

    #[test]
    fn what_is_written_is_read_again(
        at in (-1e6..1e6f64, -1e6..1e6f64, -1e6..1e6f64),
        coords in prop::collection::vec((-900.0..900.0f64, -900.0..900.0f64, -50.0..50.0f64), 120..300),
        with_normals: bool,
    ) {
        let points: Vec<_> =
            coords.iter().map(|c| Point3::new(at.0 + c.0, at.1 + c.1, at.2 + c.2)).collect();
        let mut cloud = PointCloud::from_points(&points);
        if with_normals {
            cloud = cloud.with_normals(vec![[0.0, 0.6, 0.8]; points.len()]).unwrap();
        }
        let folder = tempfile::tempdir().unwrap();
        for name in ["a.ply", "a.xyz"] {
            let path = folder.path().join(name);
            write_scan(&path, &cloud).unwrap();
            let scan = read_scan(&path, Unit::Millimetre).unwrap();
            prop_assert!(error_mm(&scan.cloud, &points) < 5e-4);
            let normal = (with_normals && name == "a.ply").then(|| [0.0, 0.6f32, 0.8f32].map(f64::from).into());
            prop_assert_eq!(scan.cloud.normal(5), normal);
        }
    }

    #[test]
    fn no_bytes_panic(bytes in prop::collection::vec(any::<u8>(), 0..600), kind in 0usize..4) {
        let mut file = ["", "ply\n", "ply\nformat binary_little_endian 1.0\n", ""][kind].as_bytes().to_vec();
        file.extend(bytes);
        let _ = parse_scan(Path::new(["s.xyz", "s.ply", "s.ply", "s.csv"][kind]), &file, Unit::Millimetre);
    }

    #[test]
    fn no_mutilation_of_a_good_file_panics(
        variant in variants(),
        cut in 0.0..1.0f64,
        spots in prop::collection::vec((0.0..1.0f64, any::<u8>()), 0..8),
        in_header: bool,
    ) {
        let mut file = variant.file(&lattice());
        let region = if in_header { 300 } else { file.len() };
        for (at, byte) in spots {
            let at = (at * region as f64) as usize;
            file[at] = byte;
        }
        let _ = parse_scan(Path::new("s.ply"), &file, Unit::Millimetre);
        file.truncate((cut * file.len() as f64) as usize);
        let _ = parse_scan(Path::new("s.ply"), &file, Unit::Millimetre);
    }

    #[test]
    fn a_truncated_ply_is_never_taken_for_a_whole_one(variant in variants(), cut in 1usize..200) {
        // Cut within the vertices (the last rows), so less than announced is there.
        let variant = Variant { others: false, ..variant };
        let mut file = variant.file(&lattice());
        // In ascii a lost line end or a lost last digit cannot be noticed: cut a whole row or more.
        let cut = if variant.format == "ascii" { cut + 60 } else { cut };
        file.truncate(file.len() - cut);
        prop_assert!(parse_scan(Path::new("s.ply"), &file, Unit::Millimetre).is_err());
    }
}

#[test]
fn normals_without_direction_are_passed_over_and_others_made_unit() {
    let with = |normal: &str| {
        let rows: String = sample().iter().map(|p| format!("{} {} {} {normal}\n", p.x, p.y, p.z)).collect();
        let names = "property float nx\nproperty float ny\nproperty float nz\nend_header\n";
        accepted("s.ply", (header("ascii", "400").replace("end_header\n", names) + &rows).as_bytes())
    };
    assert_eq!(with("0 0 -3").cloud.normal(7), Some([0.0, 0.0, -1.0].into()));
    for bad in ["0 0 0", "nan 0 1", "inf 0 0"] {
        let scan = with(bad);
        assert_eq!(scan.cloud.normal(7), None);
        assert_eq!(scan.notes, ["normals passed over: 400 have no direction"]);
    }
}

/// A header for `count` float vertices.
pub(super) fn header(format: &str, count: &str) -> String {
    format!(
        "ply\nformat {format} 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
}

pub(super) fn floats(points: &[Point3<f64>]) -> Vec<u8> {
    points.iter().flat_map(|p| [p.x, p.y, p.z]).flat_map(|v| (v as f32).to_le_bytes()).collect()
}

#[test]
fn a_ply_that_lacks_vertices_names_both_numbers() {
    let mut file = header("binary_little_endian", "400").into_bytes();
    file.extend(floats(&sample()[..300]));
    file.extend([0; 11]);
    says(&refusal("s.ply", &file), &["400 vertices announced", "300 found"]);
    let ascii = header("ascii", "400") + &text(&sample()[..300], " ");
    says(&refusal("s.ply", ascii.as_bytes()), &["400 vertices announced", "300 found"]);
}

#[test]
fn a_lying_count_allocates_nothing() {
    for count in ["18446744073709551615", "4611686018427387904", "1537228672809129302"] {
        for format in ["ascii", "binary_little_endian", "binary_big_endian"] {
            let mut file = header(format, count).into_bytes();
            file.extend(if format == "ascii" {
                text(&sample(), " ").into_bytes()
            } else {
                floats(&sample())
            });
            says(&refusal("s.ply", &file), &[count, "400 found"]);
        }
    }
    // Too small a count loses points: at least it is said.
    let mut file = header("binary_little_endian", "390").into_bytes();
    file.extend(floats(&sample()));
    assert_eq!(accepted("s.ply", &file).notes, ["120 bytes after the last vertex passed over"]);
    let ascii = header("ascii", "390") + &text(&sample(), " ");
    assert_eq!(accepted("s.ply", ascii.as_bytes()).notes, ["10 lines after the last vertex passed over"]);
    // A list of four thousand million items, and an element of endless nothing.
    let list = "ply\nformat binary_little_endian 1.0\nelement junk 9\nproperty list uint double a\n\
                element vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
    let mut file = list.as_bytes().to_vec();
    file.extend([0xff; 64]);
    says(&refusal("s.ply", &file), &["9 elements \"junk\" announced", "0 found"]);
    let mut file = header("binary_little_endian", "400")
        .replace("element vertex", "element nothing 18446744073709551615\nelement vertex")
        .into_bytes();
    file.extend(floats(&sample()));
    assert_eq!(accepted("s.ply", &file).cloud.len(), 400);
    let mut file = list.replace("uint", "int").into_bytes();
    file.extend([0xff; 64]);
    says(&refusal("s.ply", &file), &["byte 157", "a list of -1 items"]);
}

#[test]
fn faults_in_ascii_vertices_are_placed() {
    let rows = text(&sample()[..399], " ");
    for (bad, parts) in [
        ("1 2 abc", ["line 407, column 5", "\"abc\""]),
        ("1 2", ["line 407, column 4", "a value for \"z\""]),
        ("1 2 3 4", ["line 407, column 7", "no more values"]),
    ] {
        says(&refusal("s.ply", (header("ascii", "400") + &rows + bad + "\n").as_bytes()), &parts);
    }
}

#[test]
fn faults_in_headers_are_placed() {
    let good = header("ascii", "400");
    for (from, to, parts) in [
        ("ascii", "binary_middle_endian", ["line 2", "binary_little_endian"]),
        ("ascii 1.0", "ascii 2.0", ["line 2", "allowed is format"]),
        ("vertex 400", "vertex -4", ["line 3", "element NAME COUNT"]),
        ("float y", "half y", ["line 5", "a type out of"]),
        ("float y", "list uchar float y", ["line 7", "the properties x, y and z"]),
        ("float y", "list float float y", ["line 5", "integer"]),
        ("float y", "float x", ["line 5", "once"]),
        ("float y", "float", ["line 5", "property TYPE NAME"]),
        ("element vertex 400\n", "", ["line 3", "an element before"]),
        ("vertex 400", "point 400", ["line 7", "exactly one"]),
        ("format ascii 1.0\n", "", ["line 6", "format ascii 1.0"]),
        ("end_header\n", "", ["line 7", "end_header"]),
        ("end_header", "end", ["line 7", "end_header"]),
    ] {
        assert!(good.contains(from));
        says(&refusal("s.ply", good.replacen(from, to, 1).as_bytes()), &parts);
    }
}
