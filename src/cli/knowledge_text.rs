//! What `benderd knowledge` says to people.

use crate::correct::import::Merged;
use crate::correct::knowledge::{JobRecord, Key};
use crate::correct::summary::{At, Listed, PairDeg, Pairs, Shown, Sure};

/// Names of batches that fit in a line.
const NAMES: usize = 3;

/// The list of keys.
pub fn list(keys: &[Listed]) -> String {
    if keys.is_empty() {
        return "nothing was learned yet\n".to_owned();
    }
    let heads = [
        "no",
        "material",
        "OD x wall mm",
        "CLR mm",
        "bender",
        "lubrication",
        "jobs",
        "tubes",
        "batches",
        "at 20 deg",
        "at 90 deg",
        "at 120 deg",
    ];
    let mut rows = vec![heads.map(str::to_owned).to_vec()];
    rows.extend(keys.iter().map(row));
    let mut out = columns(&rows, &[1, 4, 5, 8]);
    out += "at: spring-back in degrees of a commanded angle, ± one sigma of the law, for tubes of the newest batch\n";
    if let Some(key) = keys.iter().find(|key| key.springback.is_none()) {
        out += &format!(
            "no spring-back where the material is not in the materials file ({:?}): name one by --materials\n",
            key.key.material
        );
    }
    out
}

fn row(listed: &Listed) -> Vec<String> {
    let key = listed.key;
    let mut cells = vec![
        listed.number.to_string(),
        key.material.clone(),
        format!("{} x {}", key.od_mm, key.wall_mm),
        key.clr_mm.to_string(),
        or_dash(&key.bender),
        or_dash(&key.lubrication),
        listed.jobs.to_string(),
        listed.tubes.to_string(),
        names(&listed.batches),
    ];
    match &listed.springback {
        Some(all) => {
            cells.extend(all.iter().map(|at| format!("{:.2} ±{:.2}", at.springback_deg, at.sigma_deg)))
        }
        None => cells.extend(["-"; 3].map(str::to_owned)),
    }
    cells
}

/// One key.
pub fn show(shown: &Shown) -> String {
    let Listed { number, key, jobs, tubes, parts, batches, batch, .. } = &shown.listed;
    let mut out = format!("key {number}: {}\n", of(key));
    out +=
        &format!("from {jobs} jobs, {tubes} tubes; parts {}; batches {}\n\n", names(parts), names(batches));
    let [x1, x2, x3] = shown.coefficients.map(|x| plain(x, 2));
    let usual = shown.usual_springback_deg;
    out += &format!(
        "spring-back(c) = {usual:.2} (x1 + x2 c/90 + x3 sqrt(c/90)) degrees, c the commanded angle\n"
    );
    out += &format!("x1 = {x1}  x2 = {x2}  x3 = {x3}\n\n");
    let whose = batch.map_or("tubes of a batch without name".to_owned(), |b| format!("tubes of batch {b}"));
    out += &format!("{whose}, degrees:\n{}", along(&shown.law));
    if batch.is_some() {
        out += &format!("tubes of a new batch, degrees:\n{}", along(&shown.new_batch));
    }
    out += &format!(
        "\nradius: {} of the spring-back opens the arc, and {} % besides: CLR {} forms {:.2} mm at 90 degrees\n",
        plain(shown.opening_share, 2),
        plain(percent(shown.constant_growth), 2),
        key.clr_mm,
        shown.formed_radius_mm
    );
    out += &format!("backlash of the turning head: {} degrees\n\n", plain(shown.backlash_deg, 2));
    out + &measurements(shown)
}

fn along(law: &[At]) -> String {
    let heads = ["commanded", "spring-back", "± of the law", "± of the next bend"].map(str::to_owned);
    let cells = |at: &At| {
        vec![
            format!("{:.0}", at.commanded_deg),
            format!("{:.2}", at.springback_deg),
            format!("{:.2}", at.sigma_deg),
            format!("{:.2}", at.next_sigma_deg),
        ]
    };
    let rows: Vec<Vec<String>> = std::iter::once(heads.to_vec()).chain(law.iter().map(cells)).collect();
    columns(&rows, &[])
}

fn measurements(shown: &Shown) -> String {
    if shown.measurements.is_empty() {
        return "no measurements\n".to_owned();
    }
    let heads =
        ["part", "batch", "tubes", "CLR mm", "commanded deg", "spring-back deg", "±"].map(str::to_owned);
    let deg = f64::to_degrees;
    let rows = shown.measurements.iter().map(|m| {
        vec![
            m.part.to_owned(),
            or_dash(m.batch.unwrap_or("")),
            if m.tubes == 0 { "told".to_owned() } else { m.tubes.to_string() },
            m.radius_mm.to_string(),
            format!("{:.2}", deg(m.commanded_rad)),
            format!("{:.2}", deg(m.springback_rad)),
            format!("{:.2}", deg(m.sigma_rad)),
        ]
    });
    let rows: Vec<Vec<String>> = std::iter::once(heads.to_vec()).chain(rows).collect();
    columns(&rows, &[0, 1])
}

/// The pair, and which of both a controller wants.
pub fn pairs(pairs: &Pairs) -> String {
    let whose = pairs.batch.map_or(String::new(), |b| format!(", tubes of batch {b}"));
    let mut out = format!("{}{whose}\n\n", of(pairs.key));
    let heads = ["", "at 20 deg", "at 120 deg", "constant deg", "per degree", "off the law by deg"]
        .map(str::to_owned);
    let cells = |what: &str, pair: &PairDeg| {
        vec![
            what.to_owned(),
            format!("{:.3}", pair.springback_at_20_deg),
            format!("{:.3}", pair.springback_at_120_deg),
            format!("{:.3}", pair.constant_deg),
            format!("{:.5}", pair.per_degree),
            format!("{:.2}", pair.off_law_deg),
        ]
    };
    let rows = [heads.to_vec(), cells("designed", &pairs.designed), cells("commanded", &pairs.commanded)];
    out += &columns(&rows, &[0]);
    out + "\n\
        designed: for a controller into which the drawing's angle is typed and which adds spring-back to it.\n\
        commanded: for one that looks spring-back up with the angle it bends to, overbend included.\n\
        Not sure? Type 0 at 20 and 10 at 120, and program 100 degrees without a tube: one of the first kind goes to 108.0, one of\n\
        the second to 108.9.\n"
}

/// What became of another file's jobs.
pub fn merged(merged: Merged) -> String {
    let Merged { new, longer, known } = merged;
    format!("{new} jobs new, {longer} with more tubes than before, {known} known already")
}

/// What was put in.
pub fn put(key: &Key, record: &JobRecord) -> String {
    format!("{} with {} angles put in for {}", record.part, record.bends.len(), of(key))
}

fn of(key: &Key) -> String {
    let Key { bender, lubrication, od_mm, wall_mm, material, clr_mm } = key;
    format!(
        "{material}, OD {od_mm} x {wall_mm} mm, CLR {clr_mm} mm, bender {}, lubrication {}",
        or_dash(bender),
        or_dash(lubrication)
    )
}

fn or_dash(name: &str) -> String {
    if name.is_empty() { "-" } else { name }.to_owned()
}

/// The last few, the others counted.
fn names(all: &[&str]) -> String {
    let more = all.len().saturating_sub(NAMES);
    let shown = all[more..].join(", ");
    match more {
        0 => or_dash(&shown),
        _ => format!("{more} more, {shown}"),
    }
}

fn percent(share: Sure) -> Sure {
    Sure { value: 100.0 * share.value, sigma: 100.0 * share.sigma }
}

fn plain(sure: Sure, digits: usize) -> String {
    format!("{:.digits$} ±{:.digits$}", sure.value, sure.sigma)
}

/// Rows under their heads; these columns hold words, the others numbers.
fn columns(rows: &[Vec<String>], words: &[usize]) -> String {
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..rows.first().map_or(0, Vec::len)).map(width).collect();
    let mut out = String::new();
    for row in rows {
        let cells = row.iter().enumerate().map(|(i, cell)| {
            let wide = widths[i];
            if words.contains(&i) { format!("{cell:<wide$}") } else { format!("{cell:>wide$}") }
        });
        out += cells.collect::<Vec<_>>().join("  ").trim_end();
        out.push('\n');
    }
    out
}
