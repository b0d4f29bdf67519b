//! The accuracy run as text: a row per case, totals as a plain or a markdown table.

use super::guidance::{guidance, remark as guidance_remark};
use super::{Case, Coverage, Kind, Set, Tally, Value, Verdict, coverage, errors, rms_over_bound};

/// Kinds whose largest error and error over bound stand in a case's row.
const IN_ROW: [Kind; 5] = [Kind::Angle, Kind::Rotation, Kind::Intersection, Kind::Clr, Kind::TubeRadius];

/// The line above the rows.
pub fn heading() -> String {
    format!(
        "{:>5} {:>7} {:>5} {:>8} {:>7}  {}\n{:>37}{}",
        "seed",
        "radius",
        "bends",
        "points",
        "ms",
        "largest error, and rms of error over bound, of:",
        "",
        IN_ROW.map(|k| format!("{:>20}", k.name())).concat()
    )
}

/// One case, and whatever is wrong with it.
pub fn row(case: &Case) -> String {
    let values = &case.judgement.values;
    let cell = |kind: &Kind| {
        let own = || values.iter().filter(|v| v.kind == *kind);
        let largest = errors(own()).largest;
        let over = rms_over_bound(own()).map_or("-".to_owned(), |o| format!("{o:.2}"));
        format!("{largest:>14.4} {over:>5}")
    };
    let cells = if values.is_empty() { String::new() } else { IN_ROW.iter().map(cell).collect() };
    let Case { seed, tube_radius_mm, bends, points, elapsed_ms, nuisances, .. } = case;
    format!(
        "{seed:>5} {tube_radius_mm:>7.2} {bends:>5} {points:>8} {elapsed_ms:>7.0}  {cells}  {nuisances}{}{}",
        remark(case),
        guidance_remark(case)
    )
}

/// What is wrong with a case.
fn remark(case: &Case) -> String {
    match &case.judgement.verdict {
        Verdict::Right => String::new(),
        Verdict::WrongCount(found) => format!("  <-- {found} bends found"),
        Verdict::Refused(reason) => format!("  <-- refused: {reason}"),
        Verdict::SilentlyWrong => {
            let wrong = case.judgement.values.iter().filter(|v| v.is_silently_wrong());
            format!("  <-- silently wrong: {}", wrong.map(wrong_value).collect::<Vec<_>>().join(", "))
        }
    }
}

fn wrong_value(v: &Value) -> String {
    let (error, sigma) = (v.error.unwrap_or(0.0), v.sigma.unwrap_or(0.0));
    format!("{} {} is {error:.3} off at sigma {sigma:.3}", v.kind.name(), v.row)
}

/// One number, or a dash.
fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or("-".to_owned(), |v| format!("{v:.digits$}"))
}

const COLUMNS: [&str; 11] = [
    "value",
    "given",
    "null",
    "median",
    "95 %",
    "max",
    "/bound round",
    "/bound oval",
    "with sigma",
    "< 1 sigma",
    "< 2 sigma",
];

fn cells(tally: &Tally, kind: Kind) -> [String; 11] {
    let e = errors(tally.values(kind, None));
    let over = |round| number(rms_over_bound(tally.values(kind, Some(round))), 3);
    let Coverage { count, one, two } = coverage(tally.values(kind, None));
    let percent = |share: f64| number((count > 0).then_some(100.0 * share), 1);
    let size = |v: f64| number((e.given > 0).then_some(v), 4);
    [
        kind.name().to_owned(),
        e.given.to_string(),
        e.not_given.to_string(),
        size(e.median),
        size(e.most),
        size(e.largest),
        over(true),
        over(false),
        count.to_string(),
        percent(one),
        percent(two),
    ]
}

fn summary(tally: &Tally) -> String {
    format!(
        "{} right of {}; number of bends wrong {}, refused {}, silently wrong {}",
        tally.right(),
        tally.cases.len(),
        tally.count(|v| matches!(v, Verdict::WrongCount(_))),
        tally.count(|v| matches!(v, Verdict::Refused(_))),
        tally.count(|v| *v == Verdict::SilentlyWrong),
    )
}

/// The totals, and as the last line whether the targets are met.
pub fn totals(tally: &Tally, set: Set) -> String {
    let line = |cells: [String; 11]| {
        let rest: String = cells[1..].iter().map(|c| format!(" {c:>12}")).collect();
        format!("{:<20}{rest}\n", cells[0])
    };
    let mut out = line(COLUMNS.map(str::to_owned));
    Kind::ALL.iter().for_each(|k| out += &line(cells(tally, *k)));
    out += &format!("{}; median {:.0} ms a case\n", summary(tally), tally.median_ms());
    out += &guidance(tally);
    let misses = tally.misses(set);
    match misses.is_empty() {
        true => out + "targets met",
        false => out + "targets missed: " + &misses.join("; "),
    }
}

/// The totals as a markdown table with a line above it, without times.
pub fn markdown(tally: &Tally, set: Set) -> String {
    let seed = |case: Option<&Case>| case.map_or(0, |c| c.seed);
    let (first, last) = (seed(tally.cases.first()), seed(tally.cases.last()));
    let line = |cells: [String; 11]| format!("| {} |\n", cells.join(" | "));
    let mut out = format!("Set `{}`, seeds {first} to {last}: {}.\n\n", set.name(), summary(tally));
    out += &(line(COLUMNS.map(str::to_owned)) + "|:--" + &"|--:".repeat(10) + "|\n");
    Kind::ALL.iter().for_each(|k| out += &line(cells(tally, *k)));
    let guidance = guidance(tally);
    if !guidance.is_empty() {
        out += &format!("\n{guidance}");
    }
    out.trim_end().to_owned()
}
