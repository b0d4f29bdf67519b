//! The centre line as a table of points, for other programs.

use std::fmt::Write;

use crate::tube::{Segment, SegmentKind, Spine};

/// Points of the spine are no farther apart than this.
const STEP_MM: f64 = 1.0;

/// The spine as CSV: `arc_length_mm,x_mm,y_mm,z_mm,segment,kind,mark`, in the scan's coordinates (millimetres) and the tube's
/// direction of travel. Segments count from 1: line, arc, line, ..., and a point between two belongs to the one that ends there;
/// `mark` says `end` at both ends of the tube, `tangent` where a bend begins or ends, and is empty elsewhere.
pub fn spine_csv(spine: &Spine) -> String {
    let mut csv = "arc_length_mm,x_mm,y_mm,z_mm,segment,kind,mark\n".to_owned();
    let segments = spine.segments();
    if let Some(first) = segments.first() {
        row(&mut csv, first, 1, 0.0, "end");
    }
    for (number, segment) in (1..).zip(segments) {
        let steps = (segment.length_mm / STEP_MM).ceil().max(1.0) as usize;
        for k in 1..=steps {
            let mark = match k {
                _ if k < steps => "",
                _ if number == segments.len() => "end",
                _ => "tangent",
            };
            row(&mut csv, segment, number, segment.length_mm * k as f64 / steps as f64, mark);
        }
    }
    csv
}

fn row(csv: &mut String, segment: &Segment, number: usize, along_mm: f64, mark: &str) {
    let kind = if segment.kind == SegmentKind::Line { "line" } else { "arc" };
    let p = segment.frame_at(along_mm).translation.vector;
    let at = segment.start_mm + along_mm;
    // Writing to a String cannot fail.
    let _ = writeln!(csv, "{at:.6},{:.6},{:.6},{:.6},{number},{kind},{mark}", p.x, p.y, p.z);
}
