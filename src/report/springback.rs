//! Spring-back of a key against the angle, as one SVG: the law with its band, where the next bend may come, what was
//! measured. docs/springback.md says how to read it.

use std::fmt::{Result, Write};

use super::legend::{Legend, QUIET, mark};
use super::svg::{line, polyline, text, ticks};
use crate::correct::knowledge::{BendPoint, JobRecord, Key, KeyRecord};
use crate::correct::learned::Learned;
use crate::tube::Material;

const WIDTH: f64 = 1100.0;
const HEIGHT: f64 = 580.0;
const LEFT: f64 = 70.0;
const RIGHT: f64 = 770.0;
const TOP: f64 = 116.0;
const BOTTOM: f64 = 510.0;
const LEGEND: f64 = 800.0;

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// One colour per batch, newest first, told apart also without colour vision (after Okabe and Ito); older ones share the last.
const BATCHES: [&str; 5] = ["#d55e00", "#009e73", "#cc79a7", "#e69f00", "#6e7781"];
const LAW: &str = "stroke=\"#0b4f8a\" stroke-width=\"2.2\"";
const NEXT: [(&str, &str); 2] = [
    ("stroke=\"#0b4f8a\" stroke-width=\"1\" stroke-dasharray=\"6 4\"", "next bend, one sigma"),
    ("stroke=\"#0b4f8a\" stroke-width=\"1\" stroke-dasharray=\"1.5 3\"", "next bend, two sigma"),
];
const BAND: [(&str, &str); 2] = [("#8fbfe6", "the law, one sigma"), ("#cfe4f5", "the law, two sigma")];
const PRIOR: &str = "stroke=\"#8c959f\" stroke-width=\"1.4\" stroke-dasharray=\"10 3 2 3\"";

/// The picture of a key, for tubes of its newest batch.
pub fn springback_svg(record: &KeyRecord, material: &Material) -> String {
    let mut svg = String::new();
    // Writing to a String cannot fail.
    let _ = Picture::of(record, material).draw(&mut svg);
    svg
}

struct Picture<'a> {
    record: &'a KeyRecord,
    learned: Learned,
    /// Before anything was learned.
    prior: Learned,
    /// Newest first.
    batches: Vec<Option<&'a str>>,
    most_angle_deg: f64,
    most_deg: f64,
    least_deg: f64,
}

impl<'a> Picture<'a> {
    fn of(record: &'a KeyRecord, material: &Material) -> Picture<'a> {
        let learned = Learned::of(record, material, record.newest_batch());
        let mut batches: Vec<Option<&str>> = Vec::new();
        for job in record.jobs.iter().rev().filter(|job| job.parts > 0) {
            if !batches.contains(&job.batch.as_deref()) {
                batches.push(job.batch.as_deref());
            }
        }
        let points = || record.jobs.iter().flat_map(|job| &job.bends);
        let largest = points().map(|p| p.commanded_rad.to_degrees()).fold(0.0, f64::max);
        let most_angle_deg = (largest + 10.0).clamp(135.0, 360.0);
        let end = learned.next(most_angle_deg * DEGREE);
        let reach =
            |p: &BendPoint, side: f64| (learned.on_the_die(p) + side * 2.0 * p.sigma_rad).to_degrees();
        let high = (end.value + 2.0 * end.sigma).to_degrees();
        Picture {
            most_deg: 1.04 * points().map(|p| reach(p, 1.0)).fold(high, f64::max),
            least_deg: points().map(|p| reach(p, -1.0)).fold(0.0, f64::min),
            prior: Learned::of(&record.unlearned(), material, None),
            record,
            learned,
            batches,
            most_angle_deg,
        }
    }

    fn x(&self, angle_deg: f64) -> f64 {
        LEFT + angle_deg / self.most_angle_deg * (RIGHT - LEFT)
    }

    fn y(&self, springback_deg: f64) -> f64 {
        let share = (springback_deg - self.least_deg) / (self.most_deg - self.least_deg);
        BOTTOM - share.clamp(0.0, 1.0) * (BOTTOM - TOP)
    }

    fn draw(&self, svg: &mut String) -> Result {
        let size = format!("viewBox=\"0 0 {WIDTH} {HEIGHT}\" width=\"{WIDTH}\" height=\"{HEIGHT}\"");
        writeln!(
            svg,
            "<svg xmlns=\"http://www.w3.org/2000/svg\" {size} \
             font-family=\"'DejaVu Sans', 'Segoe UI', Helvetica, Arial, sans-serif\" font-size=\"13\" fill=\"#24292f\">"
        )?;
        writeln!(svg, "<rect width=\"{WIDTH}\" height=\"{HEIGHT}\" rx=\"10\" fill=\"#ffffff\"/>")?;
        let [title, subtitle] = headings(self.record);
        text(svg, 28.0, 38.0, "font-size=\"19\" font-weight=\"600\"", &title)?;
        text(svg, 28.0, 60.0, "fill=\"#57606a\"", &subtitle)?;
        self.bands(svg)?;
        self.axes(svg)?;
        self.lines(svg)?;
        self.record.jobs.iter().try_for_each(|job| self.job(svg, job))?;
        self.legend(svg)?;
        writeln!(svg, "</svg>")
    }

    /// A curve over all angles, in the picture's places.
    fn curve(&self, springback_rad: impl Fn(f64) -> f64) -> Vec<(f64, f64)> {
        let angles = (1..=90).map(|k| self.most_angle_deg * f64::from(k) / 90.0);
        angles.map(|deg| (self.x(deg), self.y(springback_rad(deg * DEGREE).to_degrees()))).collect()
    }

    fn bands(&self, svg: &mut String) -> Result {
        for (sigmas, (colour, _)) in [2.0, 1.0].into_iter().zip(BAND.iter().rev()) {
            let side = |sign: f64| {
                self.curve(|angle| {
                    let law = self.learned.law(angle);
                    (law.value + sign * sigmas * law.sigma).max(0.0)
                })
            };
            let around = side(1.0).into_iter().chain(side(-1.0).into_iter().rev());
            let list: Vec<String> = around.map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
            writeln!(svg, "<polygon points=\"{}\" fill=\"{colour}\"/>", list.join(" "))?;
        }
        Ok(())
    }

    fn axes(&self, svg: &mut String) -> Result {
        let (values, digits) = ticks(self.least_deg, self.most_deg, 8.0);
        for value in values {
            let y = self.y(value);
            line(svg, (LEFT, y), (RIGHT, y), "stroke=\"#8c959f\" stroke-opacity=\"0.3\"")?;
            let words = format!("{value:.digits$}");
            text(svg, LEFT - 8.0, y + 4.5, &format!("text-anchor=\"end\" {QUIET}"), &words)?;
        }
        let (values, digits) = ticks(0.0, self.most_angle_deg, 10.0);
        for value in values {
            let x = self.x(value);
            line(svg, (x, BOTTOM), (x, BOTTOM + 5.0), "stroke=\"#8c959f\"")?;
            let words = format!("{value:.digits$}");
            text(svg, x, BOTTOM + 20.0, &format!("text-anchor=\"middle\" {QUIET}"), &words)?;
        }
        line(svg, (LEFT, BOTTOM), (RIGHT, BOTTOM), "stroke=\"#8c959f\"")?;
        line(svg, (LEFT, TOP), (LEFT, BOTTOM), "stroke=\"#8c959f\"")?;
        let middle = (LEFT + RIGHT) / 2.0;
        text(svg, middle, BOTTOM + 44.0, "text-anchor=\"middle\"", "commanded angle, degrees")?;
        text(svg, LEFT - 42.0, TOP - 14.0, "", "spring-back (commanded less formed angle), degrees")
    }

    fn lines(&self, svg: &mut String) -> Result {
        for (sigmas, (style, _)) in [1.0, 2.0].into_iter().zip(NEXT) {
            for side in [1.0, -1.0] {
                let at = |angle: f64| {
                    let next = self.learned.next(angle);
                    (next.value + side * sigmas * next.sigma).max(0.0)
                };
                polyline(svg, &self.curve(at), style)?;
            }
        }
        polyline(svg, &self.curve(|angle| self.prior.law(angle).value), PRIOR)?;
        polyline(svg, &self.curve(|angle| self.learned.law(angle).value), LAW)
    }

    fn colour(&self, batch: Option<&str>) -> &'static str {
        let place = self.batches.iter().position(|b| *b == batch).unwrap_or(BATCHES.len());
        BATCHES[place.min(BATCHES.len() - 1)]
    }

    /// A job's points with two sigma of each.
    fn job(&self, svg: &mut String, job: &JobRecord) -> Result {
        let told = job.parts == 0;
        let colour = if told { "#24292f" } else { self.colour(job.batch.as_deref()) };
        for point in &job.bends {
            let x = self.x(point.commanded_rad.to_degrees());
            let springback_rad = self.learned.on_the_die(point);
            let at = |sigmas: f64| self.y((springback_rad + sigmas * point.sigma_rad).to_degrees());
            let style = format!("stroke=\"{colour}\" stroke-width=\"1.2\"");
            for end in [at(2.0), at(-2.0)] {
                line(svg, (x - 3.0, end), (x + 3.0, end), &style)?;
            }
            line(svg, (x, at(2.0)), (x, at(-2.0)), &style)?;
            mark(svg, (x, at(0.0)), colour, told, point.radius_mm == self.record.key.clr_mm)?;
        }
        Ok(())
    }

    fn legend(&self, svg: &mut String) -> Result {
        let mut rows = Legend { svg, x: LEGEND, y: TOP + 4.0 };
        let batch = self.record.newest_batch();
        rows.heading(&format!(
            "For {}",
            batch.map_or("a batch without name".to_owned(), |b| format!("batch {b}"))
        ))?;
        rows.stroke(LAW, "the law")?;
        for (colour, words) in BAND {
            rows.area(colour, words)?;
        }
        for (style, words) in NEXT {
            rows.stroke(style, words)?;
        }
        rows.stroke(PRIOR, "before anything was learned")?;
        rows.heading("Measured: mean of a job, two sigma")?;
        for (i, batch) in self.batches.iter().enumerate().take(BATCHES.len()) {
            let tubes: usize = self.jobs_of(*batch).map(|job| job.parts).sum();
            let jobs = self.jobs_of(*batch).count();
            let name = batch.map_or("without name".to_owned(), |b| format!("batch {b}"));
            let more = self.batches.len() - i;
            let words = if i + 1 == BATCHES.len() && more > 1 {
                format!("{more} older batches")
            } else {
                format!("{name}: {}, {}", count(jobs, "job"), count(tubes, "tube"))
            };
            rows.mark(BATCHES[i], false, true, &words)?;
        }
        if self.batches.is_empty() {
            rows.words("no tube yet")?;
        }
        let other = |p: &BendPoint| p.radius_mm != self.record.key.clr_mm;
        if self.record.jobs.iter().flat_map(|job| &job.bends).any(other) {
            rows.mark("#6e7781", false, false, "hollow: other CLR, turned into this die's")?;
        }
        if self.record.jobs.iter().any(|job| job.parts == 0) {
            rows.mark("#24292f", true, true, "told by a table, not measured")?;
        }
        Ok(())
    }

    fn jobs_of(&self, batch: Option<&'a str>) -> impl Iterator<Item = &'a JobRecord> {
        self.record.jobs.iter().filter(move |job| job.parts > 0 && job.batch.as_deref() == batch)
    }
}

/// What the key is, and how much is known of it.
fn headings(record: &KeyRecord) -> [String; 2] {
    let Key { bender, lubrication, od_mm, wall_mm, material, clr_mm } = &record.key;
    let tubes: usize = record.jobs.iter().map(|job| job.parts).sum();
    let measured = record.jobs.iter().filter(|job| job.parts > 0).count();
    let named = |what: &str, name: &str| {
        if name.is_empty() { format!("no {what} named") } else { format!("{what} {name}") }
    };
    [
        format!("Spring-back of {material}, {od_mm} x {wall_mm} mm, CLR {clr_mm} mm"),
        format!(
            "{}, {}; {} measured in {}",
            named("bender", bender),
            named("lubrication", lubrication),
            count(tubes, "tube"),
            count(measured, "job")
        ),
    ]
}

fn count(n: usize, what: &str) -> String {
    format!("{n} {what}{}", if n == 1 { "" } else { "s" })
}
