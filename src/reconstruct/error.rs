//! Why a cloud gave no tube: each reason with its figures and what to do.

use thiserror::Error;

/// Why there is no result.
#[derive(Debug, Error, PartialEq)]
pub enum ReconstructError {
    /// Nothing in the cloud is curved like a tube.
    #[error(
        "no tube in the scan: no curvature radius that enough of the {points} points agree on ({faces} planar faces \
        set aside; the points lie {spacing_mm:.2} mm apart, where a tube needs one per third of its radius or more \
        densely); is this a scan of a tube, in the right unit?"
    )]
    NoTube {
        /// Points in the cloud.
        points: usize,
        /// Planar faces that were found.
        faces: usize,
        /// Usual distance of the points looked at.
        spacing_mm: f64,
    },
    /// A tube's surface, of which too little was seen.
    #[error(
        "only {seen_mm:.0} mm of a tube of radius {radius_mm:.2} mm are seen in one piece, where {wanted_mm:.0} are needed; scan \
        more of it, clear of what holds or hides it"
    )]
    TooShort {
        /// Length of the longest piece of its centre line.
        seen_mm: f64,
        /// Radius of the tube.
        radius_mm: f64,
        /// Length that would do.
        wanted_mm: f64,
    },
    /// The points on the surface are too few or too scattered.
    #[error(
        "the tube's centre line cannot be found: only {found} of {points} points lie on a tube of radius {radius_mm:.2} mm; scan more densely (a point per {wanted_mm:.2} mm or closer)"
    )]
    TooSparse {
        /// Points on a tube.
        found: usize,
        /// Points in the cloud.
        points: usize,
        /// Radius of that tube.
        radius_mm: f64,
        /// Spacing that would do.
        wanted_mm: f64,
    },
    /// More tubes than could be told apart by their size.
    #[error(
        "the scan shows {} separate tubes (centre lines of {}); scan one part at a time, or name the nominal",
        .lengths_mm.len(), list(.lengths_mm)
    )]
    SeveralTubes {
        /// Lengths of their centre lines.
        lengths_mm: Vec<f64>,
    },
    /// The centre line closes on itself.
    #[error("the centre line closes on itself after {length_mm:.1} mm: a ring has no ends to measure from")]
    Ring {
        /// Its length.
        length_mm: f64,
    },
    /// No arc-line spline follows the centre line.
    #[error(
        "the centre line of {length_mm:.1} mm (tube radius {radius_mm:.2} mm) is not made of straights and at most \
        {most} bends: a coil, a hose, or more than one part?"
    )]
    NotBent {
        /// Length of the centre line.
        length_mm: f64,
        /// Radius of the tube.
        radius_mm: f64,
        /// Most bends that are looked for.
        most: usize,
    },
    /// The data does not say how far a bend turns.
    #[error(
        "the scan does not determine the angle of bend {bend} (its sigma would be {sigma_deg:.0} degrees); scan that \
        part of the tube, more densely or with less noise"
    )]
    Undetermined {
        /// Bend counted from 1, in the scan's order.
        bend: usize,
        /// Standard deviation that the angle would have.
        sigma_deg: f64,
    },
    /// No straight was seen behind the first or the last bend: how far it turns in all is not known.
    #[error(
        "the scan stops within bend {bend}, or what goes on behind it was not recognised: its angle is not known; scan \
        past it to the end of the tube, clear of what holds it there"
    )]
    EndsInBend {
        /// Bend counted from 1, in the scan's order.
        bend: usize,
    },
    /// The fitted tube does not explain the points.
    #[error(
        "only {used} of {points} points lie on the tube found (radius {radius_mm:.2} mm, {bends} bends); clear the scene or scan again"
    )]
    PoorFit {
        /// Points on the surface.
        used: usize,
        /// Points in the cloud.
        points: usize,
        /// Radius of the tube.
        radius_mm: f64,
        /// Bends found.
        bends: usize,
    },
}

fn list(lengths: &[f64]) -> String {
    lengths.iter().map(|l| format!("{l:.0} mm")).collect::<Vec<_>>().join(", ")
}
