//! Where the sections of bends turn from round to oval, cut into short stretches: a real bend does so in a way of its own, so
//! each stretch may be as oval as it likes within what is known of it. Told exactly, the place of a ramp would tell more of some
//! bends than all else, and mislead.
//!
//! Under `lanes`, which sums a moment per stretch, and `moments`, which eliminates the doubt.

use super::model::TubeModel;
use super::section::{OVAL_DOUBT, OVAL_DOUBT_SHARE};

/// Stretches of a ramp.
const STRETCHES: usize = 4;

/// Bends less oval than this, in tube radii, have no ramps to speak of.
const LEAST_OVAL_RADII: f64 = 1e-3;

/// The ramps of a tube.
#[derive(Debug, Clone)]
pub struct Ramps {
    /// First stretch of every segment that has ramps.
    first: Vec<Option<usize>>,
    /// Segment of every stretch, and how oval it may be beside what the model says.
    stretches: Vec<(usize, f64)>,
}

impl Ramps {
    /// Of those bends that are oval.
    pub fn of(model: &TubeModel) -> Ramps {
        let mut out = Ramps::none(2 * model.lra.bends.len() + 1);
        let radius = model.tube_radius_mm;
        for (i, oval_mm) in model.ovality_mm.iter().enumerate() {
            if oval_mm.abs() > LEAST_OVAL_RADII * radius {
                let segment = 2 * i + 1;
                let doubt_mm = (OVAL_DOUBT * radius).hypot(OVAL_DOUBT_SHARE * oval_mm);
                out.first[segment] = Some(out.stretches.len());
                out.stretches.extend([(segment, doubt_mm); 2 * STRETCHES]);
            }
        }
        out
    }

    /// None of so many segments.
    pub fn none(segments: usize) -> Ramps {
        Ramps { first: vec![None; segments], stretches: Vec::new() }
    }

    /// Number of stretches.
    pub fn len(&self) -> usize {
        self.stretches.len()
    }

    /// Segment of every stretch, and how oval it may be beside what the model says.
    pub fn doubts(&self) -> impl Iterator<Item = (usize, f64)> + '_ {
        self.stretches.iter().copied()
    }

    /// Segment of a stretch, and whether it is at that one's end.
    pub fn place(&self, stretch: usize) -> (usize, bool) {
        let segment = self.stretches[stretch].0;
        let first = self.first[segment].unwrap_or(stretch);
        (segment, stretch - first >= STRETCHES)
    }

    /// The stretch at a share of the ramp at a segment's begin or at its end.
    pub fn stretch(&self, segment: usize, at_end: bool, share: f64) -> Option<usize> {
        let within = ((share * STRETCHES as f64) as usize).min(STRETCHES - 1);
        Some(self.first[segment]? + usize::from(at_end) * STRETCHES + within)
    }
}
