//! STL: corners once, files that lie or are cut.

use super::ply::floats;
use super::*;

pub(super) fn stl(points: &[Point3<f64>]) -> Vec<u8> {
    let mut out = vec![b's'; 80];
    out[..5].copy_from_slice(b"solid");
    out.extend((points.len() as u32 / 3).to_le_bytes());
    for facet in points.chunks_exact(3) {
        out.extend([0; 12]);
        out.extend(floats(facet));
        out.extend([0; 2]);
    }
    out
}

#[test]
fn corners_of_facets_come_once() {
    let points = &sample()[..399];
    let strip: Vec<_> = points.windows(3).flatten().copied().collect();
    let scan = accepted("s.stl", &stl(&strip));
    assert!(error_mm(&scan.cloud, points) < 5e-5 && scan.notes.is_empty());
    let corner = |p: &Point3<f64>| format!("  Vertex {} {} {}\n", p.x, p.y, p.z);
    let facet = |f: &[Point3<f64>]| {
        let corners: String = f.iter().map(corner).collect();
        format!("facet normal 0 0 1\n outer loop\n{corners} endloop\nendfacet\n")
    };
    let ascii = format!("solid a tube\n{}endsolid\n", strip.chunks(3).map(facet).collect::<String>());
    assert!(error_mm(&accepted("s.STL", ascii.as_bytes()).cloud, points) < 5e-5);
    says(
        &refusal("s.stl", ascii.replacen("0.75 ", "0.7x ", 1).as_bytes()),
        &["line 5, column 10", "a number"],
    );
    says(
        &refusal("s.stl", ascii.replacen("outer", "inner", 1).as_bytes()),
        &["line 3", "\"inner\"", "vertex"],
    );
    says(&refusal("s.stl", ascii.replace("endsolid", "").as_bytes()), &["endsolid", "before the file ends"]);
}

#[test]
fn an_stl_that_lies_or_is_cut() {
    let mut file = stl(&sample()[..399]);
    file[..5].copy_from_slice(b"STL: ");
    says(&refusal("s.stl", &file[..file.len() - 1]), &["133 facets announced", "132 found"]);
    says(&refusal("s.stl", &file[..60]), &["byte 60", "84 bytes"]);
    file.extend([0; 9]);
    assert_eq!(accepted("s.stl", &file).notes, ["9 bytes after the last facet passed over"]);
    file[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
    says(&refusal("s.stl", &file), &["4294967295 facets announced", "133 found"]);
    let mut nan = stl(&sample()[..399]);
    nan[96..100].copy_from_slice(&f32::NAN.to_le_bytes());
    says(&refusal("s.stl", &nan), &["1 of 399 points"]);
}
