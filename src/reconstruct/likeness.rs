//! Which part the tube is: the nominal's as formed, its mirror image, the nominal with a bend missing or too many, or
//! another one. Beside [`guided`](super::guided) and [`direction`](super::direction), which ask; what is said begins with
//! fixed words, for whoever looks for them.

use crate::tube::{Lra, MeasuredTube, wrap_angle};

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// What forming may change: angle (at least, and as a share), rotation, length (at least, and in tube radii), beside some
/// sigmas.
const ANGLE_RAD: f64 = 9.5 * DEGREE;
const ANGLE_SHARE: f64 = 0.11;
const ROTATION_RAD: f64 = 12.0 * DEGREE;
const LENGTH_MM: f64 = 5.0;
const LENGTH_RADII: f64 = 1.0;
const SIGMAS: f64 = 4.0;

/// From this angle on a bend knows its plane.
const CLEAR_RAD: f64 = 8.0 * DEGREE;

/// So much more alike the mirror image must be where forming may have made the tube of either: rotations off by 0.7 of what
/// forming may change.
const CLEARLY: f64 = 0.5;

/// A bend of less than this share of its nominal angle was not bent.
const NOT_BENT_SHARE: f64 = 0.2;

/// Bends missing or too many that are told from another part.
const MOST_AMISS: usize = 2;

/// Bends named in one warning.
const MOST_NAMED: usize = 3;

/// A row of a table, with what is not known of it: an infinite sigma is a value that says nothing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Row {
    pub length_mm: f64,
    pub length_sigma_mm: f64,
    pub rotation_rad: f64,
    pub rotation_sigma_rad: f64,
    pub angle_rad: f64,
    pub angle_sigma_rad: f64,
    /// CLR.
    pub radius_mm: f64,
}

/// A table taken as it is; the first length and rotation, which the ends decide, say nothing.
pub fn rows(lra: &Lra) -> Vec<Row> {
    let row = |(i, b): (usize, &crate::tube::Bend)| Row {
        length_mm: b.length_mm,
        length_sigma_mm: if i == 0 { f64::INFINITY } else { 0.0 },
        rotation_rad: b.rotation_rad,
        rotation_sigma_rad: if i == 0 { f64::INFINITY } else { 0.0 },
        angle_rad: b.angle_rad,
        angle_sigma_rad: 0.0,
        radius_mm: b.radius_mm,
    };
    lra.bends.iter().enumerate().map(row).collect()
}

/// The rows of a measurement; `lra` is its fitted table.
pub fn measured_rows(measured: &MeasuredTube, lra: &Lra) -> Vec<Row> {
    let known = |sigma: Option<f64>| sigma.unwrap_or(f64::INFINITY);
    let mut out = rows(lra);
    for (row, bend) in out.iter_mut().zip(&measured.bends) {
        row.angle_sigma_rad = bend.angle_sigma_rad;
        row.length_sigma_mm = row.length_sigma_mm.max(known(bend.length_sigma_mm));
        row.rotation_sigma_rad = row.rotation_sigma_rad.max(known(bend.rotation_sigma_rad));
    }
    out
}

/// How far angle, rotation and length of row `i` are off, over what forming and the sigmas allow.
fn off(found: &[Row], part: &[Row], i: usize, tube_radius_mm: f64) -> [f64; 3] {
    let (f, p) = (&found[i], &part[i]);
    let (f_before, p_before) = match i {
        0 => (f, p),
        _ => (&found[i - 1], &part[i - 1]),
    };
    let over = |off: f64, usual: f64, one: f64, other: f64| off.abs() / (usual + SIGMAS * one.hypot(other));
    // A small turn's plane may swing.
    let turns = [f, p, f_before, p_before].map(|r| r.angle_rad);
    let known = turns.into_iter().fold(1.0, f64::min).max(0.05);
    // What an angle lacks of its arc lengthens the straights.
    let arcs = ANGLE_RAD * (p.radius_mm + p_before.radius_mm);
    let length = LENGTH_MM.max(LENGTH_RADII * tube_radius_mm) + arcs;
    [
        over(
            f.angle_rad - p.angle_rad,
            ANGLE_RAD.max(ANGLE_SHARE * p.angle_rad),
            f.angle_sigma_rad,
            p.angle_sigma_rad,
        ),
        over(
            wrap_angle(f.rotation_rad - p.rotation_rad),
            ROTATION_RAD / known,
            f.rotation_sigma_rad,
            p.rotation_sigma_rad,
        )
        .max(off_across(found, part, i)),
        over(f.length_mm - p.length_mm, length, f.length_sigma_mm, p.length_sigma_mm),
    ]
}

/// How far the plane of row `i` is off against that of the last clear bend before it, over what forming and the sigmas
/// allow: of shallow bends between them each knows its own plane badly, but what they turn together is known.
fn off_across(found: &[Row], part: &[Row], i: usize) -> f64 {
    let angle = |k: usize| found[k].angle_rad.min(part[k].angle_rad);
    let Some(before) = (0..i).rev().find(|k| angle(*k) >= CLEAR_RAD) else { return 0.0 };
    if angle(i) < CLEAR_RAD || before + 1 == i {
        return 0.0;
    }
    let between = before + 1..=i;
    let turned = |rows: &[Row]| rows[between.clone()].iter().map(|r| r.rotation_rad).sum::<f64>();
    let sigmas = found[between.clone()].iter().map(|r| r.rotation_sigma_rad);
    let sigma = sigmas.fold(f64::INFINITY, f64::min);
    let swing: f64 = found[before + 1..i].iter().map(|r| r.angle_rad).sum();
    let usual = ROTATION_RAD / angle(i).min(angle(before)).min(1.0) + swing;
    wrap_angle(turned(found) - turned(part)).abs() / (usual + SIGMAS * sigma)
}

/// Whether forming may have made the one of the other.
pub fn is_formed(found: &[Row], part: &[Row], tube_radius_mm: f64) -> bool {
    found.len() == part.len()
        && (0..found.len()).all(|i| off(found, part, i, tube_radius_mm).iter().all(|o| *o <= 1.0))
}

/// How unlike two tables of as many bends are; infinite for others.
pub fn unlikeness(found: &[Row], part: &[Row], tube_radius_mm: f64) -> f64 {
    if found.len() != part.len() {
        return f64::INFINITY;
    }
    let most = |o: f64| (o * o).min(9.0);
    (0..found.len()).flat_map(|i| off(found, part, i, tube_radius_mm)).map(most).sum()
}

/// The rows as they are with bend `i` left straight.
fn without(rows: &[Row], i: usize) -> Vec<Row> {
    let mut out = rows.to_vec();
    let gone = out.remove(i);
    if let Some(next) = out.get_mut(i) {
        next.rotation_rad += gone.rotation_rad;
        next.rotation_sigma_rad = next.rotation_sigma_rad.max(gone.rotation_sigma_rad);
        // How much of its arc went into the straight nobody knows.
        next.length_sigma_mm = f64::INFINITY;
    }
    out
}

/// Every way to leave `count` bends straight: which, and the rows then.
fn fewer(rows: &[Row], count: usize) -> Vec<(Vec<usize>, Vec<Row>)> {
    if count == 0 {
        return vec![(Vec::new(), rows.to_vec())];
    }
    let mut out = Vec::new();
    for (gone, rest) in fewer(rows, count - 1) {
        // From the last to the first, so that indices stay true.
        let below = gone.last().copied().unwrap_or(rows.len());
        for i in 0..below {
            out.push((gone.iter().copied().chain([i]).collect(), without(&rest, i)));
        }
    }
    out
}

/// What speaks against the tube being the nominal's, in words; nothing when forming may have made it so. `part` is the
/// nominal's table without rows of angle 0.
pub fn doubts(found: &[Row], part: &Lra, tube_radius_mm: f64) -> Vec<String> {
    let wanted = rows(part);
    let formed = |found: &[Row], part: &[Row]| is_formed(found, part, tube_radius_mm);
    let missing: Vec<String> = found.iter().zip(&wanted).enumerate().filter_map(not_bent).collect();
    let hand = part.mirrored();
    let hands = [rows(&hand.reversed()), rows(&hand)];
    let is_formed = formed(found, &wanted);
    // A tube that is nearly flat may be made of either hand.
    let unlike = |part: &[Row]| unlikeness(found, part, tube_radius_mm);
    let clearly = if is_formed { unlike(&wanted) - CLEARLY } else { f64::INFINITY };
    if hands.iter().any(|h| formed(found, h) && unlike(h) < clearly) {
        return vec![
            "looks like the mirror image: every bend is as the nominal's other hand has it; check program and loading"
                .to_owned(),
        ];
    }
    if is_formed {
        return missing;
    }
    let both = [(wanted.clone(), false), (rows(&part.reversed()), true)];
    let (n, m) = (found.len(), wanted.len());
    if n < m && m - n <= MOST_AMISS {
        for (rows, reversed) in &both {
            let ways = fewer(rows, m - n);
            if let Some((gone, _)) = ways.iter().find(|(_, rest)| formed(found, rest)) {
                let number = |i: usize| if *reversed { m - i } else { i + 1 };
                let mut numbers: Vec<usize> = gone.iter().map(|i| number(*i)).collect();
                numbers.sort_unstable();
                let why =
                    "not bent, not scanned, or too little to be seen; the other bends are the nominal's";
                return numbers
                    .iter()
                    .map(|k| format!("bend {k} of the nominal is missing: {why}"))
                    .collect();
            }
        }
        let ways = hands.map(|rows| fewer(&rows, m - n)).concat();
        if ways.iter().any(|(_, rest)| formed(found, rest)) {
            let text = "looks like the mirror image: the bends found are as the nominal's other hand has them; check program \
                        and loading";
            return vec![text.to_owned()];
        }
    }
    if n > m && n - m <= MOST_AMISS {
        for (rows, _) in &both {
            if let Some((extra, _)) = fewer(found, n - m).iter().find(|(_, rest)| formed(rest, rows)) {
                let words = |i: &usize| {
                    let angle = found[*i].angle_rad.to_degrees();
                    format!("a bend that the nominal lacks: bend {} of the scan, {angle:.2} degrees", i + 1)
                };
                return extra.iter().rev().map(words).collect();
            }
        }
    }
    if n == m {
        missing.into_iter().chain([far_off(found, &wanted, tube_radius_mm)]).collect()
    } else {
        vec![other_count(found, &wanted)]
    }
}

/// Says that a bend of the nominal is hardly there.
fn not_bent((i, (found, wanted)): (usize, (&Row, &Row))) -> Option<String> {
    let lacking = wanted.angle_rad - found.angle_rad;
    let gone =
        found.angle_rad < NOT_BENT_SHARE * wanted.angle_rad && lacking > SIGMAS * found.angle_sigma_rad;
    gone.then(|| {
        let [angle, sigma, wanted] =
            [found.angle_rad, found.angle_sigma_rad, wanted.angle_rad].map(f64::to_degrees);
        format!(
            "bend {} of the nominal is missing: {angle:.2} +- {sigma:.2} degrees where the nominal has {wanted:.2}",
            i + 1
        )
    })
}

/// Names the rows that no forming makes of the nominal.
fn far_off(found: &[Row], wanted: &[Row], tube_radius_mm: f64) -> String {
    let mut named = Vec::new();
    for i in 0..found.len() {
        let [angle, rotation, length] = off(found, wanted, i, tube_radius_mm);
        let (f, w) = (&found[i], &wanted[i]);
        let mut name = |off: f64, what: &str, one: f64, other: f64, unit: &str| {
            if off > 1.0 {
                named.push(format!("{what} bend {} {one:.1} {unit}, the nominal's {other:.1}", i + 1));
            }
        };
        name(angle, "angle of", f.angle_rad.to_degrees(), w.angle_rad.to_degrees(), "degrees");
        let degrees = |rad: f64| wrap_angle(rad).to_degrees();
        name(rotation, "rotation of", degrees(f.rotation_rad), degrees(w.rotation_rad), "degrees");
        name(length, "length before", f.length_mm, w.length_mm, "mm");
    }
    let more = named.len().saturating_sub(MOST_NAMED);
    named.truncate(MOST_NAMED);
    let more = if more > 0 { format!("; and {more} more") } else { String::new() };
    format!("another part, or bent far off: {}{more}", named.join("; "))
}

fn other_count(found: &[Row], wanted: &[Row]) -> String {
    let list = |rows: &[Row]| {
        rows.iter().map(|r| format!("{:.0}", r.angle_rad.to_degrees())).collect::<Vec<_>>().join(", ")
    };
    format!(
        "another part: {} bends found ({} degrees), the nominal has {} ({})",
        found.len(),
        list(found),
        wanted.len(),
        list(wanted)
    )
}
