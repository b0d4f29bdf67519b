//! Where a section of the centre line tells nothing: something else was scanned beside the tube, the tube ends, or its points
//! are those of no one section.
//!
//! Under `sections`.

use nalgebra::Point3;

use super::model::TubeModel;
use super::moves::mean_radius_mm;
use super::section::OVAL_UNTOLD;
use crate::tube::{Bend, Spine};

/// A section with a larger share of points near the tube and not on it tells nothing: outside it a jaw grips the tube there,
/// inside it is an end with its face and its bore (which do less harm).
const MOST_OUTSIDE: f64 = 0.25;
const MOST_STRANGERS: f64 = 0.5;
/// With this share of strangers the points may not be those of one section.
const SEVERAL: f64 = 0.08;
/// What chance puts outside of three sections, in standard deviations, and a share that does no harm.
const CHANCE: f64 = 3.5;
const LEAST_BESET: f64 = 0.05;
/// So near to an end, in tube radii, and no more than such a share of the end straight, burr, bore and face are among the
/// points however few they are: a bend would be found there for them.
const SILENT_RADII: f64 = 0.75;
const END_SHARE: f64 = 0.375;

/// Where sections tell nothing.
#[derive(Debug, Clone, Default)]
pub struct Crowded {
    /// Middles of the sections.
    pub places: Vec<Point3<f64>>,
    /// How far around each.
    pub reach_mm: f64,
}

impl Crowded {
    /// Whether a point lies there.
    pub fn holds(&self, p: &Point3<f64>) -> bool {
        self.places.iter().any(|c| (p - c).norm_squared() < self.reach_mm * self.reach_mm)
    }
}

/// Points of a section near the tube's surface, and of them those outside and inside of it.
pub struct Strangers {
    all: f64,
    outside: f64,
    inside: f64,
}

impl Strangers {
    /// Among points that lie off their section by so much.
    pub fn among(offs: impl Iterator<Item = f64> + Clone, cutoff_mm: f64) -> Strangers {
        let outside = offs.clone().filter(|off| *off > cutoff_mm).count() as f64;
        let inside = offs.clone().filter(|off| *off < -cutoff_mm).count() as f64;
        Strangers { all: offs.count() as f64, outside, inside }
    }

    /// Whether something else than the tube was scanned beside it: many points near its surface and not on it.
    pub fn are_a_crowd(&self) -> bool {
        self.outside > MOST_OUTSIDE * self.all || self.outside + self.inside > MOST_STRANGERS * self.all
    }

    /// Whether so many points miss the section that it may be none.
    pub fn are_several(&self) -> bool {
        self.outside + self.inside > SEVERAL * self.all
    }
}

/// Where together with both neighbours there are more points outside than chance puts there of what is usual along the tube:
/// the face of a jaw leaves the tube so flatly that some of its points pass for the tube's.
pub fn beset(strangers: &[Strangers]) -> Vec<bool> {
    let usual = strangers.iter().filter(|s| !s.are_a_crowd());
    let (outside, all) = usual.fold((0.0, 0.0), |(o, n), s| (o + s.outside, n + s.all));
    let usual = outside / f64::max(all, 1.0);
    let around = |i: usize| &strangers[i.saturating_sub(1)..(i + 2).min(strangers.len())];
    let is_beset = |i: usize| {
        let (outside, all) = around(i).iter().fold((0.0, 0.0), |(o, n), s| (o + s.outside, n + s.all));
        let expected = usual * all;
        outside - expected > (CHANCE * (expected + 1.0).sqrt()).max(LEAST_BESET * all)
    };
    (0..strangers.len()).map(is_beset).collect()
}

/// Whether a section holds a bend too short for an ovality of its own, on a tube so thick that its points would not lie on any
/// one section: those left would lean to one side.
pub fn is_oval_untold(
    base: &TubeModel,
    spine: &Spine,
    (at_mm, length_mm): (f64, f64),
    cutoff_mm: f64,
) -> bool {
    // Bends so short do not know their own CLR.
    let usual = mean_radius_mm(base).unwrap_or(0.0);
    let half = 0.5 * length_mm;
    let is_in_a_short_one = |(i, bend): (usize, &Bend)| {
        let arc = &spine.segments()[2 * i + 1];
        let holds = (arc.start_mm - half..arc.start_mm + arc.length_mm + half).contains(&at_mm);
        holds && !base.is_arc_oval(bend.angle_rad * bend.radius_mm.min(usual))
    };
    OVAL_UNTOLD * base.tube_radius_mm > cutoff_mm && base.lra.bends.iter().enumerate().any(is_in_a_short_one)
}

/// Whether a place is where the end of the tube is seen.
pub fn is_at_an_end(base: &TubeModel, spine: &Spine, at_mm: f64) -> bool {
    let near = |straight_mm: f64| (SILENT_RADII * base.tube_radius_mm).min(END_SHARE * straight_mm);
    let first_mm = base.lra.bends.first().map_or(spine.length_mm(), |b| b.length_mm);
    at_mm < near(first_mm) || spine.length_mm() - at_mm < near(base.lra.last_length_mm)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A section of 35 points with so many of them outside.
    fn section(outside: usize) -> Strangers {
        let offs = (0..35).map(move |k| if k < outside { 1.0 } else { 0.01 });
        Strangers::among(offs, 0.2)
    }

    #[test]
    fn the_flat_face_of_a_jaw_besets_its_sections() {
        // One flying point in every third section, and a jaw's face along six.
        let jaw = 20..26;
        let outside = |k: usize| if jaw.contains(&k) { 5 } else { usize::from(k.is_multiple_of(3)) };
        let sections: Vec<Strangers> = (0..60).map(|k| section(outside(k))).collect();
        assert!(sections.iter().all(|s| !s.are_a_crowd()));
        let found: Vec<usize> =
            beset(&sections).iter().enumerate().filter(|(_, b)| **b).map(|(k, _)| k).collect();
        assert_eq!(found, (20..26).collect::<Vec<_>>());
    }

    #[test]
    fn flying_points_beset_nothing() {
        let sections: Vec<Strangers> = (0..60).map(|k| section([0, 2, 0, 1, 3][k % 5])).collect();
        assert!(beset(&sections).iter().all(|b| !b));
    }

    #[test]
    fn a_jaw_that_grips_is_a_crowd() {
        assert!(!section(8).are_a_crowd() && section(9).are_a_crowd());
        let bore =
            |inside: usize| Strangers::among((0..35).map(move |k| if k < inside { -1.0 } else { 0.0 }), 0.2);
        assert!(!bore(17).are_a_crowd() && bore(18).are_a_crowd());
    }
}
