//! E57 files whose header, XML or packets lie, with checksums that are right: each is refused with the reason or read
//! right, at once and in little memory.

use ::e57 as format;

use super::e57::{e57, metres};
use super::*;

const PAGE: usize = 1024;

/// The checksum of a page: CRC-32C, bit by bit.
fn checksum(data: &[u8]) -> u32 {
    !data.iter().fold(!0, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| crc >> 1 ^ if crc & 1 == 1 { 0x82f6_3b78 } else { 0 })
    })
}

/// The file with its checksums made right again.
fn sealed(mut file: Vec<u8>) -> Vec<u8> {
    for page in file.chunks_exact_mut(PAGE) {
        let (data, sum) = page.split_at_mut(PAGE - 4);
        sum.copy_from_slice(&checksum(data).to_be_bytes());
    }
    file
}

/// Bytes of the file that are not checksums, counted on from the beginning.
fn put(file: &mut [u8], at: usize, bytes: &[u8]) {
    for (i, byte) in (at..).zip(bytes) {
        file[i / (PAGE - 4) * PAGE + i % (PAGE - 4)] = *byte;
    }
}

fn plain() -> Vec<u8> {
    e57(&[(None, metres(&sample()))], |xml| xml)
}

/// A header with another number: 24 is where the XML's place stands, 32 its length.
fn with_header(at: usize, value: u64) -> String {
    let mut file = plain();
    put(&mut file, at, &value.to_le_bytes());
    refusal("s.e57", &sealed(file))
}

/// The refusal of a file with another XML part.
fn with_xml(xml: impl Fn(String) -> String) -> String {
    refusal("s.e57", &e57(&[(None, metres(&sample()))], xml))
}

#[test]
fn the_test_knows_the_checksum() {
    assert!(sealed(plain()) == plain());
}

#[test]
fn headers_that_lie_about_the_xml() {
    says(&with_header(32, 0), &["s.e57", "XML"]);
    says(&with_header(32, u64::MAX), &["larger than"]);
    says(&with_header(32, 1 << 25), &["33554432 bytes of XML"]);
    says(&with_header(32, 100), &["XML"]);
    says(&with_header(24, u64::MAX), &["behind end of file"]);
    says(&with_header(24, 0), &["XML"]);
    says(&with_header(40, 1 << 19), &["page size"]);
    says(&with_header(40, 5), &["s.e57"]);
}

#[test]
fn record_counts_and_places_that_cannot_be() {
    says(
        &with_xml(|xml| xml.replace("Count=\"400\"", "Count=\"1000000000000000\"")),
        &["1000000000000000 points announced"],
    );
    says(
        &with_xml(|xml| xml.replace("Count=\"400\"", "Count=\"18446744073709551615\"")),
        &["18446744073709551615 points announced"],
    );
    says(&with_xml(|xml| xml.replace("Count=\"400\"", "Count=\"-1\"")), &["recordCount"]);
    says(&with_xml(|xml| xml.replace("Offset=\"48\"", "Offset=\"99999999999\"")), &["byte 99999999999"]);
    says(
        &with_xml(|xml| xml.replace("Offset=\"48\"", "Offset=\"18446744073709551615\"")),
        &["no points begin at byte 18446744073709551615"],
    );
    says(&with_xml(|xml| xml.replace("Offset=\"48\"", "Offset=\"1000\"")), &["no points begin at byte 1000"]);
    // The same points claimed again and again would be as many as anyone likes.
    let often = |xml: String| {
        let (begin, end) = (xml.find("<vectorChild").unwrap(), xml.rfind("</data3D>").unwrap());
        xml[..begin].to_owned() + &xml[begin..end].repeat(1000) + &xml[end..]
    };
    says(&with_xml(often), &["400 points announced"]);
    let nowhere = |at: u64| {
        let mut file = plain();
        // In the header of the section that holds the points, which follows the file's.
        put(&mut file, 48 + 16, &at.to_le_bytes());
        refusal("s.e57", &sealed(file))
    };
    says(&nowhere(u64::MAX), &["400 points announced", "0 found"]);
    says(&nowhere(0), &["400 points announced", "0 found"]);
}

#[test]
fn xml_that_would_take_its_parser_hours_or_gigabytes() {
    let begin = std::time::Instant::now();
    let nested = |xml: String| {
        let (open, close) = ("<a>".repeat(300_000), "</a>".repeat(300_000));
        xml.replace("</e57Root>", &format!("{open}{close}</e57Root>"))
    };
    // Elements that nobody knows are no fault, however deep.
    assert_eq!(accepted("s.e57", &e57(&[(None, metres(&sample()))], nested)).cloud.len(), 400);
    let attributes = |xml: String| {
        let many: String = (0..200_000).map(|i| format!(" a{i}=''")).collect();
        xml.replace("</e57Root>", &format!("<a{many}/></e57Root>"))
    };
    says(&with_xml(attributes), &["a tag", "does not end within 4096 bytes"]);
    let namespaces = |xml: String| {
        let open: String = (0..60_000).map(|i| format!("<a xmlns:n{i}='{i}'>")).collect();
        xml.replace("</e57Root>", &format!("{open}{}</e57Root>", "</a>".repeat(60_000)))
    };
    says(&with_xml(namespaces), &["namespaces"]);
    let entities = |xml: String| {
        let lol = (1..9).map(|i| format!("<!ENTITY l{i} '{}'>", format!("&l{};", i - 1).repeat(10)));
        let lol: String = lol.collect();
        xml.replace("<e57Root", &format!("<!DOCTYPE d [<!ENTITY l0 'ha'>{lol}]><e57Root"))
    };
    says(&with_xml(entities), &["XML"]);
    says(&with_xml(|xml| xml + &" ".repeat(5 << 20)), &["at most 4194304"]);
    says(&with_xml(|xml| xml[..xml.len() / 2].to_owned()), &["XML"]);
    says(&with_xml(|_| String::new()), &["XML"]);
    assert!(begin.elapsed().as_secs() < 20, "{:?}", begin.elapsed());
}

#[test]
fn prototypes_without_sense() {
    says(&with_xml(|xml| xml.replace("cartesianX", "columnIndex")), &["neither Cartesian nor spherical"]);
    says(&with_xml(|xml| xml.replace("data3D", "data2D")), &["no scan in it"]);
    let scaled = |xml: String, scale: &str| {
        let scaled = format!("<cartesianY type=\"ScaledInteger\" scale=\"{scale}\"");
        xml.replace("<cartesianY type=\"Float\"", &scaled)
    };
    for scale in ["NaN", "0", "inf"] {
        says(&with_xml(|xml| scaled(xml, scale)), &[&format!("CartesianY has scale {scale} ")]);
    }
    says(
        &with_xml(|xml| xml.replace("minimum=\"0\" maximum=\"2\"", "minimum=\"2\" maximum=\"0\"")),
        &["invalid"],
    );
    let many = |xml: String| {
        xml.replace("</prototype>", &(r#"<intensity type="Float"/>"#.repeat(70) + "</prototype>"))
    };
    says(&with_xml(many), &["74 values each, at most 64"]);
    // Bits enough for a point, but none of them a coordinate's.
    let one_place = |xml: String| {
        let constant = |xml: String, axis: &str| {
            let double = format!("<cartesian{axis} type=\"Float\"");
            xml.replace(&double, &format!("<cartesian{axis} type=\"Integer\" minimum=\"7\" maximum=\"7\""))
        };
        ["X", "Y", "Z"].into_iter().fold(xml, constant).replace("maximum=\"2\"", "")
    };
    says(&with_xml(one_place), &["s.e57"]);
    let invalid: Vec<_> = metres(&sample()).into_iter().map(|(p, _)| (p, 2)).collect();
    says(&refusal("s.e57", &e57(&[(None, invalid)], |xml| xml)), &["all its 400 points", "invalid"]);
}

#[test]
fn a_pose_does_not_stretch_the_scan() {
    let turned = |q: f64| {
        let rotation = format::Quaternion { w: q, x: 0.0, y: 0.0, z: 0.0 };
        let pose = format::Transform { rotation, translation: format::Translation::default() };
        e57(&[(Some(pose), metres(&sample()))], |xml| xml)
    };
    // What four digits make of a quaternion.
    assert!(error_mm(&accepted("s.e57", &turned(0.9999)).cloud, &sample()) < 5e-5);
    for length in [0.0, 0.5, 1e200, f64::NAN] {
        says(&refusal("s.e57", &turned(length)), &["quaternion of length"]);
    }
}

/// Where the file's first packet has the sizes of its byte streams: after the headers of file, section and packet.
const SIZES: usize = 48 + 32 + 6;

/// The refusal of a file whose first packet has byte streams of other sizes.
fn with_sizes(points: usize, sizes: [u16; 4]) -> String {
    let line = (0..points).map(|i| Point3::new(0.1 * i as f64, 0.0, 0.0));
    let mut file = e57(&[(None, metres(&line.collect::<Vec<_>>()))], |xml| xml);
    put(&mut file, SIZES, &sizes.map(u16::to_le_bytes).concat());
    refusal("s.e57", &sealed(file))
}

#[test]
fn packets_whose_byte_streams_disagree() {
    says(&with_sizes(400, [0; 4]), &["s.e57"]);
    says(&with_sizes(400, [0, 6400, 3200, 100]), &["400 points announced", "0 found"]);
    says(&with_sizes(400, [3200, 3200, 3200, 0]), &["s.e57"]);
    says(&with_sizes(400, [u16::MAX; 4]), &["400 points announced", "0 found"]);
    // Two bits a value: a stream that a reader would have to hold until the others have caught up.
    says(&with_sizes(5000, [8, 8, 8, 60_000]), &["do not keep step", "240000 values where another has 1"]);
    let mut kinds = plain();
    put(&mut kinds, SIZES - 6, &[2, 0, 11, 0]);
    put(&mut kinds, SIZES + 6, &[0, 0, 3, 0, 1, 0, 3, 0, 4, 0]);
    says(&refusal("s.e57", &sealed(kinds.clone())), &["packet of kind 0", "only 1 is read"]);
    put(&mut kinds, SIZES + 10, &[3]);
    says(&refusal("s.e57", &sealed(kinds)), &["400 points announced", "0 found"]);
    let mut counts = plain();
    put(&mut counts, SIZES - 2, &[3]);
    says(&refusal("s.e57", &sealed(counts)), &["3 byte streams, 4 are announced"]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(128))]
    #[test]
    fn no_lie_under_right_checksums_panics(
        // Mostly where the structure is: the first bytes and the XML at the end.
        spots in prop::collection::vec((any::<bool>(), 0usize..2000, any::<u8>()), 1..6),
    ) {
        let mut file = plain();
        let end = file.len() / PAGE * (PAGE - 4);
        for (begin, at, byte) in spots {
            let at = if begin { at % 300 } else { end - 1 - at };
            put(&mut file, at, &[byte]);
        }
        let _ = parse_scan(Path::new("s.e57"), &sealed(file), Unit::Millimetre);
    }
}
