//! Deviation to colour: blue inside the fitted surface, orange outside, grey on it. The two hues and their falling
//! lightness are told apart also without colour vision, and in print.

use std::fmt::{Result, Write};

use super::svg::{line, text};
use crate::reconstruct::Reconstruction;

/// Colours that a picture has; an odd number, so that the middle one means "on the surface".
pub(super) const CLASSES: usize = 11;

/// From -1 to 1 in equal steps.
const ANCHORS: [[f64; 3]; 5] = [
    [8.0, 48.0, 120.0],
    [70.0, 145.0, 200.0],
    [221.0, 221.0, 217.0],
    [235.0, 145.0, 60.0],
    [140.0, 40.0, 4.0],
];

/// What is not the tube.
const OTHER: [u8; 3] = [150, 150, 150];

/// A noise's sigma over the median of its size.
const SIGMA_PER_MEDIAN: f64 = 1.4826;

/// The colour of a share of the scale, -1 to 1 (beyond: the ends' colours).
pub fn tint(share: f64) -> [u8; 3] {
    let at = (share.clamp(-1.0, 1.0) + 1.0) / 2.0 * (ANCHORS.len() - 1) as f64;
    let k = (at as usize).min(ANCHORS.len() - 2);
    std::array::from_fn(|i| {
        (ANCHORS[k][i] + (at - k as f64) * (ANCHORS[k + 1][i] - ANCHORS[k][i])).round() as u8
    })
}

/// Which deviations the colours stand for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scale {
    /// Sigma of the points about the fitted surface, from the median.
    pub noise_mm: f64,
    /// The deviation at the scale's ends: 98 of 100 of the fit's points are within, and 3 sigma at least.
    pub limit_mm: f64,
    /// Points farther than this from the surface are shown as something else than the tube.
    pub near_mm: f64,
}

impl Scale {
    /// The scale that suits a reconstruction and the deviations of its cloud.
    pub fn of(found: &Reconstruction, residuals_mm: &[f64]) -> Scale {
        let noise_mm = SIGMA_PER_MEDIAN * found.measured.residual_median_mm;
        // The points that the fit used are those next to the surface.
        let mut sizes: Vec<f64> = residuals_mm.iter().map(|r| r.abs()).collect();
        let used = found.measured.points_used.min(sizes.len());
        let place = (0.98 * used.saturating_sub(1) as f64) as usize;
        let most =
            if used > 0 { *sizes.select_nth_unstable_by(place, f64::total_cmp).1 } else { f64::INFINITY };
        let most = if most.is_finite() { most } else { 0.0 };
        let limit_mm = most.max(3.0 * noise_mm).max(1e-6);
        Scale { noise_mm, limit_mm, near_mm: (1.5 * limit_mm).max(found.measured.tube_radius_mm / 4.0) }
    }

    /// A scale of its own for means of deviations: 98 of 100 within, and 3 sigma of a mean of `count` points at least.
    pub(super) fn of_means(&self, means_mm: &[f64], count: f64) -> Scale {
        let mut sizes: Vec<f64> = means_mm.iter().map(|m| m.abs()).collect();
        sizes.sort_unstable_by(f64::total_cmp);
        let most = sizes.get((0.98 * sizes.len() as f64) as usize).copied().unwrap_or(0.0);
        Scale { limit_mm: most.max(3.0 * self.noise_mm / count.max(1.0).sqrt()).max(1e-6), ..*self }
    }

    /// Colour of a point, by its deviation.
    pub fn colour(&self, deviation_mm: f64) -> [u8; 3] {
        if deviation_mm.abs() <= self.near_mm { tint(deviation_mm / self.limit_mm) } else { OTHER }
    }

    /// Number of a deviation's class, from inside to outside.
    pub(super) fn class(&self, deviation_mm: f64) -> usize {
        let share = (deviation_mm / self.limit_mm).clamp(-1.0, 1.0);
        (((share + 1.0) / 2.0 * CLASSES as f64) as usize).min(CLASSES - 1)
    }

    /// The bar with its numbers.
    pub(super) fn bar(&self, svg: &mut String, x: f64, y: f64, width: f64) -> Result {
        let cell = width / CLASSES as f64;
        for k in 0..CLASSES {
            let at = x + k as f64 * cell;
            writeln!(
                svg,
                "<rect x=\"{at:.1}\" y=\"{y:.1}\" width=\"{:.1}\" height=\"12\" fill=\"{}\"/>",
                cell + 0.3,
                class_colour(k)
            )?;
        }
        let small = "font-size=\"12\" fill=\"#57606a\" text-anchor";
        for (share, sign) in [(-1.0, "−"), (-0.5, "−"), (0.0, ""), (0.5, "+"), (1.0, "+")] {
            let at = x + (share + 1.0) / 2.0 * width;
            line(svg, (at, y + 12.0), (at, y + 16.0), "stroke=\"#57606a\"")?;
            let words = format!("{sign}{:.3}", (share * self.limit_mm).abs());
            text(svg, at, y + 29.0, &format!("{small}=\"middle\""), &words)?;
        }
        text(svg, x - 24.0, y + 11.0, &format!("{small}=\"end\""), "inside the surface")?;
        text(svg, x + width + 24.0, y + 11.0, &format!("{small}=\"start\""), "outside (mm)")
    }
}

/// Colour of a class, as SVG writes it.
pub(super) fn class_colour(class: usize) -> String {
    let [r, g, b] = tint(2.0 * class as f64 / (CLASSES - 1) as f64 - 1.0);
    format!("#{r:02x}{g:02x}{b:02x}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn classes_are_symmetric_and_the_middle_is_the_surface() {
        let scale = Scale { noise_mm: 0.02, limit_mm: 0.11, near_mm: 3.0 };
        assert_eq!(scale.class(0.0), CLASSES / 2);
        assert_eq!((scale.class(-9.0), scale.class(9.0)), (0, CLASSES - 1));
        assert!(
            (0..20)
                .map(|k| 0.0055 * f64::from(k) + 1e-6)
                .all(|d| { scale.class(d) + scale.class(-d) == CLASSES - 1 })
        );
        assert_eq!(scale.colour(3.1), OTHER);
        assert_eq!(class_colour(CLASSES / 2), "#ddddd9");
    }
}
